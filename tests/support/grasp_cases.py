"""Shapes of known width, their tables, and random grasps of them."""

from dataclasses import dataclass
from functools import cache
from typing import Any

import manifold3d
import numpy as np
import torch
import trimesh

from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.robot import Robot, drive_from_gap, pad_center_z
from r2h_batch.scene.robot_file import load_robot


@dataclass(eq=False)
class Body:
    """Fields of an `ObjectModel` that grasp tables read."""

    vertices: np.ndarray
    faces: np.ndarray
    receiver_face: np.ndarray
    receiver_boxes: np.ndarray | None = None


BAND = 1e-4
PAD_X, PAD_Z = 0.011, 0.01875


def material64(
    mesh: trimesh.Trimesh, T_obj_ee: np.ndarray, gap: float, grow: float = 0.0, robot: Robot | None = None
) -> tuple[float, float] | None:
    """From where to where (m, along y) material lies between pads with this gap, the pads `grow` larger; None: nowhere."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            trimesh.transform_points(mesh.vertices, np.linalg.inv(T_obj_ee.astype(np.float64))),
            mesh.faces.astype(np.uint64),
        )
    )
    robot = robot or load_robot()
    z = float(pad_center_z(robot, drive_from_gap(robot, gap))) + float(
        robot.T_flange_gripper[2, 3] - robot.T_flange_ee[2, 3]
    )
    pad_x, _, pad_z = robot.linkage.pad_half_size
    prism = box((2 * (pad_x + grow), 2.0, 2 * (pad_z + grow)), (0, 0, z))
    runs: list[list[float]] = []
    for piece in (solid ^ prism).decompose():
        sides = piece.bounding_box()
        runs.append([sides[1], sides[4]])
    runs.sort()
    merged: list[list[float]] = []
    for low, high in runs:
        if merged and low <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], high)
        else:
            merged.append([low, high])
    held = [r for r in merged if r[1] > -robot.open_gap_m / 2 and r[0] < robot.open_gap_m / 2]
    return (held[0][0], held[-1][1]) if held else None


def width64(mesh, T_obj_ee, gap, grow=0.0) -> float:
    """The width (m) of `material64`; -1: none."""
    held = material64(mesh, T_obj_ee, gap, grow)
    return held[1] - held[0] if held else -1.0


def solid(shape: manifold3d.Manifold) -> trimesh.Trimesh:
    mesh = shape.to_mesh()
    return trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], mesh.tri_verts, process=True)


def box(size, at=(0.0, 0.0, 0.0)) -> manifold3d.Manifold:
    return manifold3d.Manifold.cube(size, True).translate(at)


def rod(length: float, radius: float) -> manifold3d.Manifold:
    return manifold3d.Manifold.cylinder(length, radius, radius, 64, True)


@cache
def shapes() -> dict[str, trimesh.Trimesh]:
    """Shapes that a gripper closes on in different ways, each watertight."""
    outline = [(0.0, 0.0), (0.03, 0.0), (0.075, 0.045), (0.072, 0.047), (0.029, 0.004), (0.0, 0.004)]
    bowl = manifold3d.Manifold.revolve(manifold3d.CrossSection([outline]), 96)
    comb = box((0.02, 0.12, 0.01), (0, 0, -0.02))
    for i in range(-5, 6):
        comb += box((0.02, 0.004, 0.04), (0, 0.011 * i, 0))
    out = {
        "bowl": bowl,
        "l_shape": box((0.03, 0.02, 0.12)) + box((0.03, 0.10, 0.025), (0, 0.04, 0.06)),
        "block": box((0.1, 0.1, 0.1)),
        "sheet_block": box((0.2, 0.05, 0.2)),
        "dumbbell": manifold3d.Manifold.cylinder(0.16, 0.011, 0.016, 64, True)
        + manifold3d.Manifold.sphere(0.04, 64).translate((0, 0, 0.09)),
        "comb": comb,
        "pipe": rod(0.14, 0.03) - rod(0.2, 0.027),
    }  # fmt: skip
    return {name: solid(shape) for name, shape in out.items()}


def model_of(mesh: trimesh.Trimesh, region=None) -> Any:
    faces = np.asarray(mesh.faces, np.int32)
    receiver = np.zeros(len(faces), bool) if region is None else region(mesh)
    return Body(np.asarray(mesh.vertices, np.float32), faces, receiver)


def upper(mesh: trimesh.Trimesh) -> np.ndarray:
    return mesh.triangles_center[:, 2] > 0.02


@cache
def tables_of_shapes():
    """The shapes for the kernels; every other one has its upper half as the receiver region."""
    return grasp_tables(
        [model_of(m, upper if i % 2 == 0 else None) for i, m in enumerate(shapes().values())], load_robot()
    )


def random_grasps(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Random grasps near the surfaces of all shapes; a third of them square with the object's axes."""
    rng = np.random.default_rng(seed)
    meshes = list(shapes().values())
    index = np.arange(count) % len(meshes)
    T = np.tile(np.eye(4), (count, 1, 1))
    for i, k in enumerate(index):
        R = trimesh.transformations.random_rotation_matrix(rng.random(3))
        if i % 3 == 0:
            R = trimesh.transformations.euler_matrix(*(rng.integers(0, 4, 3) * np.pi / 2))
        T[i] = R
        T[i, :3, 3] = meshes[k].triangles_center[rng.integers(len(meshes[k].faces))] + rng.normal(0, 0.012, 3)
    return torch.tensor(T, dtype=torch.float32), torch.tensor(index, dtype=torch.int32)


def pose_at(x=0.0, y=0.0, z=0.0, about=None, angle=0.0) -> np.ndarray:
    """A pose at (x, y, z), turned by `angle` about an axis."""
    T = np.eye(4) if about is None else trimesh.transformations.rotation_matrix(angle, about)
    T[:3, 3] = x, y, z
    return T
