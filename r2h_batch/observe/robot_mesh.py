"""The visible parts of the robot, and the robot at home with its gripper open as one mesh: what cameras and eyes see of it."""

from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numpy.typing import ArrayLike, NDArray

from r2h_batch.scene.model_parts import visual_mesh
from r2h_batch.scene.robot import (
    Primitives,
    Robot,
    ShapeKind,
    drive_from_gap,
    ee_pose,
    finger_motion,
    forward_kinematics,
    gripper_primitives_at,
)
from r2h_batch.scene.robot_visuals import part_origin

Array = NDArray[np.float64]
Part = tuple[Array, NDArray[Any]]
"""Vertices and faces."""


@lru_cache(maxsize=4)
def robot_at_home(
    robot: Robot, home_q: tuple[float, ...]
) -> tuple[Float32[np.ndarray, "v 3"], Int32[np.ndarray, "f 3"]]:
    """All visible parts of the robot as one surface, vertices (m, world) and faces.

    A robot without visual meshes is seen as its bodies for planning.

    Args:
        robot: any robot of the package or an imported one.
        home_q: joint angles, rad.
    """
    at = part_poses(robot, home_q, robot.open_gap_m)
    vertices, faces, before = [], [], 0
    for (v, f), T in zip(parts_of(robot), at, strict=True):
        vertices.append(v @ T[:3, :3].T + T[:3, 3])
        faces.append(f + before)
        before += len(v)
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32)


@lru_cache(maxsize=4)
def parts_of(robot: Robot) -> tuple[Part, ...]:
    """The visible parts of the robot, each in its own frame, m: links, then gripper and fingers.

    Args:
        robot: any robot of the package or an imported one.
    """
    if robot.visuals:
        links = [visual_mesh(robot.visuals, link) for link in robot.links[:-1]]
    else:
        links = [_solid(robot.arm, i) for i in range(len(robot.arm.link))]
    if robot.linkage.table is None:
        tool = [mesh for mesh, *_ in _fingers(robot)]
    else:
        tool = [_solid(robot.gripper, i) for i in range(len(robot.gripper.names))]
    return (*links, *tool)


def part_poses(robot: Robot, q: ArrayLike, gap_m: ArrayLike) -> Float64[np.ndarray, "... p 4 4"]:
    """T_world_part of the parts of `parts_of`, m.

    Args:
        robot: any robot of the package or an imported one.
        q: (..., joints) the arm's posture, rad.
        gap_m: (...) between the pads, m.
    """
    T = forward_kinematics(robot, q)
    if robot.visuals:
        found = [T[..., k, :, :] for k in range(len(robot.links) - 1)]
    else:
        found = [
            T[..., link, :, :] @ robot.arm.T_link_prim[i] for i, link in enumerate(robot.arm.link)
        ]
    if robot.linkage.table is None:
        drive = drive_from_gap(robot, gap_m)
        found += [
            T[..., -1, :, :] @ (finger_motion(robot, motion, side, drive) @ own)
            for _, motion, side, own in _fingers(robot)
        ]
    else:
        at = ee_pose(robot, q)[..., None, :, :] @ gripper_primitives_at(robot, gap_m)
        found += [at[..., i, :, :] for i in range(at.shape[-3])]
    return np.stack(found, -3)


@lru_cache(maxsize=4)
def _fingers(robot: Robot) -> tuple[tuple[Part, str, int, Array], ...]:
    """The 2F-85's meshes: how each moves, on which side, and where it is in the gripper's frame at drive 0."""
    import trimesh  # 0.3 s

    found: list[tuple[Part, str, int, Array]] = [
        (visual_mesh(robot.visuals, "body"), "fixed", 0, np.eye(4))
    ]
    rows = zip(robot.gripper_part, robot.gripper_motion, robot.gripper_side, strict=True)
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])  # the left finger is the right one turned
    for part, motion, side in dict.fromkeys((p, m, int(s)) for p, m, s in rows if s):
        at = np.eye(4)
        at[:3, 3] = part_origin(part)
        if part == "pad":  # a box in the model that it comes from
            box = trimesh.creation.box(2 * robot.linkage.pad_half_size)
            mesh: Part = (np.asarray(box.vertices), np.asarray(box.faces))
        else:
            mesh = visual_mesh(robot.visuals, part)
        found.append((mesh, motion, side, turned @ at if side < 0 else at))
    return tuple(found)


def _solid(shapes: Primitives, i: int) -> Part:
    """A body for planning as a mesh, in its own frame; sizes as in MuJoCo."""
    from trimesh import creation
    from trimesh.convex import convex_hull

    kind, size = ShapeKind(int(shapes.kind[i])), shapes.size[i]
    if kind == ShapeKind.HULL:
        made = convex_hull(shapes.corners[i])
    elif kind == ShapeKind.BOX:
        made = creation.box(2 * size)
    elif kind == ShapeKind.SPHERE:
        made = creation.icosphere(subdivisions=3, radius=size[0])
    elif kind == ShapeKind.CYLINDER:
        made = creation.cylinder(radius=size[0], height=2 * size[1], sections=48)
    else:
        made = creation.capsule(radius=size[0], height=2 * size[1], count=[24, 24])
        made.apply_translation(-made.bounds.mean(0))  # versions differ in where its origin is
    return np.asarray(made.vertices, np.float64), np.asarray(made.faces)
