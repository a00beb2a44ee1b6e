"""Meshes with wrong faces and openings through the import: `python bench/meshes.py [DIR] [--json OUT]`.

Drawn here, so that anybody can measure them again: a mug, a wrench, a knife and a clamp with two slivers glued on, a bottle
as it is (mug and bottle of some 20,000 faces), and wrench and knife without the faces that look down. Then every mesh of DIR.

Measured: the distance from the drawn mesh as it was, or from a file's own faces, within which 99 % of the imported surface lies.
"""

import argparse
import os
import warnings
from pathlib import Path
from typing import Any

import igl
import manifold3d
import numpy as np
import trimesh
from _report import Report
from run import Bench

os.environ["R2H_BATCH_CACHE"] = "off"

from r2h_batch.scene.mesh_import.file import load_mesh_file
from r2h_batch.scene.objects import ObjectMeshError, build_object

MEASURES = (
    "bench/meshes.py",
    "r2h_batch/scene/mesh_import",
    "r2h_batch/scene/objects.py",
)
SUFFIXES = (".obj", ".stl", ".ply", ".off", ".glb")


def drawn() -> dict[str, trimesh.Trimesh]:
    """Closed meshes of five things, in metres."""
    solid, flat = manifold3d.Manifold, manifold3d.CrossSection

    def block(size: tuple[float, float, float], at: tuple[float, float, float]) -> Any:
        return solid.cube(size, True).translate(at)

    cup = [(0, -0.045), (0.04, -0.045), (0.04, 0.045), (0.037, 0.045), (0.037, -0.042), (0, -0.042)]
    outer = [(0, 0), (0.03, 0), (0.0325, 0.004), (0.0325, 0.13), (0.028, 0.15), (0.014, 0.175), (0.0135, 0.22)]
    inner = [(0.0115, 0.22), (0.012, 0.175), (0.026, 0.15), (0.0305, 0.13), (0.0305, 0.006), (0, 0.002)]
    ring = solid.revolve(flat([[(0.02, -0.005), (0.028, -0.005), (0.028, 0.005), (0.02, 0.005)]]), 48)
    handle = ring.rotate((90, 0, 0)).translate((0.05, 0, 0)) - solid.cylinder(0.2, 0.0385, 0.0385, 64, True)
    jaw = solid.cylinder(0.01, 0.022, 0.022, 48, True).translate((0.09, 0, 0))
    blade = solid.extrude(flat([[(0.0, -0.014), (0.14, -0.01), (0.16, 0.012), (0.0, 0.014)]]), 0.0018)
    things = {
        "mug": (solid.revolve(flat([cup]), 64) + handle, 0.01),
        "bottle": (solid.revolve(flat([[*outer, *inner]]), 40), 0.0125),
        "wrench": (block((0.17, 0.02, 0.008), (0, 0, 0)) + jaw - block((0.04, 0.016, 0.02), (0.105, 0, 0)), 0.008),
        "knife": (blade.translate((0.04, 0, -0.0009)) + block((0.11, 0.022, 0.016), (-0.01, 0, 0)), 0.008),
        "clamp": (
            block((0.02, 0.016, 0.11), (0, 0, 0))
            + block((0.07, 0.016, 0.014), (0.035, 0, 0.048))
            + block((0.05, 0.016, 0.014), (0.025, 0, -0.048))
            + solid.cylinder(0.05, 0.005, 0.005, 32, True).translate((0.06, 0, 0.02)),
            0.008,
        ),
    }
    out: dict[str, Any] = {}
    for name, (thing, longest_m) in things.items():
        mesh = thing.to_mesh()
        vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
        made = trimesh.Trimesh(vertices, np.asarray(mesh.tri_verts, np.int64), process=True)
        out[f"drawn_{name}"] = made.subdivide_to_size(longest_m)
    return out


def spoiled(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with two slivers of two faces each, on edges that four faces then share."""
    n = len(mesh.vertices)
    (a, b), (c, d) = mesh.edges[len(mesh.edges) // 5], mesh.edges[4 * len(mesh.edges) // 5]
    points = mesh.vertices[[a, c]] + [[0, 0, 4e-4], [3e-4, 0, 0]]
    faces = [[a, b, n], [b, a, n], [c, d, n + 1], [d, c, n + 1]]
    return trimesh.Trimesh(np.vstack([mesh.vertices, points]), np.vstack([mesh.faces, faces]), process=False)


def without_underside(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh without the faces that look down, as a scanner from above leaves it."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces[mesh.face_normals[:, 2] > -0.9], process=False)


def within_99_m(mesh: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    """The distance (m) from `other` within which 99 % of 5,000 samples of `mesh` lie."""
    points = np.asarray(trimesh.sample.sample_surface(mesh, 5000, seed=7)[0])
    squared, _, _ = igl.point_mesh_squared_distance(points, np.array(other.vertices), np.array(other.faces, np.int64))
    return float(np.quantile(squared**0.5, 0.99))


def run(asked: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    warnings.simplefilter("ignore")
    things, kept = drawn(), 0
    todo: list[tuple[str, Any, Any]] = [(n, m if n == "drawn_bottle" else spoiled(m), m) for n, m in things.items()]
    todo += [(f"open_{n}", without_underside(things[f"drawn_{n}"]), things[f"drawn_{n}"]) for n in ("wrench", "knife")]
    if asked.folder is not None:
        files = (p for p in sorted(asked.folder.iterdir()) if p.suffix.lower() in SUFFIXES)
        todo += [(p.stem, p, load_mesh_file(p, p.stem)) for p in files]
    for name, source, clean in todo:
        try:
            off = within_99_m(build_object(source, name, pieces=False).mesh, clean)
        except ObjectMeshError as error:
            report.add(f"meshes.{name}.refused", str(error))
            continue
        report.add(f"meshes.{name}.within_99_mm", round(1e3 * off, 4))
        kept += off <= 1e-6
    report.add("meshes.meshes", len(todo))
    report.add("meshes.kept_within_1_um", kept)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {"folder": {"type": Path, "nargs": "?"}},
    peer="the meshes before they were spoiled",
)

if __name__ == "__main__":
    BENCH.main()
