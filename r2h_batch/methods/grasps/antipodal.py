"""Grasp proposals at antipodal points of the surface, several approach directions about each
closing axis."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from r2h_batch.bodies.objects import ObjectModel
from r2h_batch.bodies.robot import Robot, drive_from_gap, pad_center_z
from r2h_batch.kernels.methods import antipodal
from r2h_batch.launch import launch_trials
from r2h_batch.methods.grasps.candidate_set import widest_m

FRICTION = 0.5
SEEDS, APPROACHES = 3000, 6
DEPTH_M = 0.012  # how far the contact may lie from the pads' centre along the approach

F32 = NDArray[np.float32]


def proposals(
    model: ObjectModel, mesh: wp.Mesh, rng: np.random.Generator, robot: Robot
) -> tuple[F32, F32]:
    """(M, 4, 4) T_obj_ee, pads on opposite surface points, several approaches about each closing
    axis; (M,) how far these points are from each other."""
    corner = model.vertices[model.faces].astype(np.float64)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    double_area = np.linalg.norm(normal, axis=1)
    share = np.cumsum(double_area) / double_area.sum()
    face = np.minimum(
        np.searchsorted(share, (np.arange(SEEDS) + rng.random(SEEDS)) / SEEDS), len(share) - 1
    )
    a, b = rng.random((2, SEEDS, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    point = (
        corner[face, 0]
        + a * (corner[face, 1] - corner[face, 0])
        + b * (corner[face, 2] - corner[face, 0])
    )
    tilt = rng.random((SEEDS, 3))
    center, axis = np.zeros((2, SEEDS, 3), np.float32)
    thickness = np.zeros(SEEDS, np.float32)
    launch_trials(
        antipodal.opposite_points,
        SEEDS,
        inputs={
            "mesh": mesh.id,
            "friction_cosine": 1 / np.hypot(1, FRICTION),
            "widest": widest_m(robot),
            "point": point.astype(np.float32),
            "normal": (normal[face] / np.maximum(double_area[face, None], 1e-30)).astype(
                np.float32
            ),
            "random": tilt.astype(np.float32),
        },
        outputs={"center": center, "axis": axis, "thickness": thickness},
        device="cpu",
    )
    angle = 2 * np.pi * (np.arange(APPROACHES) + rng.random((SEEDS, 1))) / APPROACHES
    sign = np.where(rng.random((SEEDS, APPROACHES)) < 0.5, -1.0, 1.0)
    depth = DEPTH_M * (2 * rng.random((SEEDS, APPROACHES)) - 1)
    keep = thickness > 0
    center64, axis64 = center[keep].astype(np.float64), axis[keep].astype(np.float64)
    e = np.cross(
        axis64, np.where(np.abs(axis64[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    )
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    f = np.cross(axis64, e)
    z = np.cos(angle[keep])[..., None] * e[:, None] + np.sin(angle[keep])[..., None] * f[:, None]
    y = sign[keep][..., None] * axis64[:, None]
    T = np.zeros((*z.shape[:2], 4, 4))
    T[..., :3, 0], T[..., :3, 1], T[..., :3, 2], T[..., 3, 3] = np.cross(y, z), y, z, 1
    height = pad_height(robot, thickness[keep].astype(np.float64))[:, None] + depth[keep]
    T[..., :3, 3] = center64[:, None] - height[..., None] * z
    return T.reshape(-1, 4, 4).astype(np.float32), np.repeat(thickness[keep], APPROACHES)


def pad_height(robot: Robot, gap: NDArray[Any]) -> NDArray[np.float64]:
    """Height of the pads' centres in the ee frame at a gap."""
    z, middle = (pad_center_z(robot, drive_from_gap(robot, g)) for g in (gap, robot.open_gap_m / 2))
    return z - middle
