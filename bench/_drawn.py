"""Meshes of 20,000 faces that anybody can draw again: a mug with a handle, and a hollow bottle."""

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

FACES = 20_000


def mug() -> trimesh.Trimesh:
    """82 mm wide and 95 mm high, walls of 4 mm, a round handle; one watertight body."""
    outer = [(0.0, 0.0), (0.038, 0.0), (0.041, 0.006), (0.041, 0.095)]
    inner = [(0.037, 0.095), (0.037, 0.008), (0.034, 0.005), (0.0, 0.005)]
    body = _turned([*outer, *inner], 68)
    handle = trimesh.creation.torus(0.026, 0.005, major_sections=120, minor_sections=24)
    handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0], [0, 0, 0]))
    handle.apply_translation([0.0405, 0, 0.05])
    outside = trimesh.boolean.difference([handle, _turned([(0, -0.01), (0.039, -0.01), (0.039, 0.11), (0, 0.11)], 2)])
    return trimesh.boolean.union([body, outside])


def bottle() -> trimesh.Trimesh:
    """65 mm wide and 220 mm high, walls of 2 mm, open at the top; one watertight body."""
    outer = [(0.0, 0.0), (0.03, 0.0), (0.0325, 0.004), (0.0325, 0.13), (0.028, 0.15), (0.014, 0.175), (0.0135, 0.22)]
    inner = [(0.0115, 0.22), (0.012, 0.175), (0.026, 0.15), (0.0305, 0.13), (0.0305, 0.006), (0.0, 0.002)]
    return _turned([*outer, *inner], 78)


def _turned(profile: list[tuple[float, float]], rows: int, sections: int = 125) -> trimesh.Trimesh:
    """A solid of revolution about z of this profile (radius, height), cut into about so many rows of quads."""
    p = np.array(profile)
    length = np.linalg.norm(np.diff(p, axis=0), axis=1)
    each = np.maximum(np.round(rows * length / length.sum()).astype(int), 1)
    line: list[NDArray[np.float64]] = [
        a + (b - a) * (np.arange(n) / n)[:, None] for a, b, n in zip(p[:-1], p[1:], each, strict=True)
    ]
    return trimesh.creation.revolve(np.concatenate([*line, p[-1:]]), sections=sections)


def write(folder: Path) -> list[Path]:
    """The files, made in `folder`."""
    paths = []
    for name, made in (("drawn_mug", mug()), ("drawn_bottle", bottle())):
        if not made.is_watertight:
            raise SystemExit(f"{name} is not watertight")
        paths.append(folder / f"{name}.obj")
        made.export(paths[-1])
    return paths
