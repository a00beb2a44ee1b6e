"""The robot at home with its gripper open, as one mesh in the world: what a camera sees of it."""

from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32
from numpy.typing import NDArray

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
    T, parts = forward_kinematics(robot, home_q), list[tuple[Part, Array]]()
    if robot.visuals:
        for k, link in enumerate(robot.links[:-1]):
            parts.append((visual_mesh(robot.visuals, link), T[k]))
    else:
        for i, link_index in enumerate(robot.arm.link):
            parts.append((_solid(robot.arm, i), T[link_index] @ robot.arm.T_link_prim[i]))
    if robot.linkage.table is None:
        parts += [(part, T[-1] @ at) for part, at in _fingers(robot)]
    else:
        at = ee_pose(robot, home_q) @ gripper_primitives_at(robot, robot.open_gap_m)
        parts += [(_solid(robot.gripper, i), at[i]) for i in range(len(at))]
    vertices, faces, before = [], [], 0
    for (v, f), at in parts:
        vertices.append(v @ at[:3, :3].T + at[:3, 3])
        faces.append(f + before)
        before += len(v)
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32)


def _fingers(robot: Robot) -> list[tuple[Part, Array]]:
    """The 2F-85's meshes with the pads apart, in the gripper's frame."""
    import trimesh  # 0.3 s

    drive = drive_from_gap(robot, robot.open_gap_m)
    found: list[tuple[Part, Array]] = [(visual_mesh(robot.visuals, "body"), np.eye(4))]
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
        own = turned @ at if side < 0 else at
        found.append((mesh, finger_motion(robot, motion, side, drive) @ own))
    return found


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
