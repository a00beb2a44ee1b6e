"""Handover-VA's own grasps: top-down on the functional part, a gripper of three boxes, points
inside are collisions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.launch import launch_trials
from r2h_batch.judge.grasp import gripper_poses
from r2h_batch.kernels.methods import box_grasps as kernels
from r2h_batch.methods.part_roles import GRASP
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.robot import Robot, ShapeKind
from r2h_batch.scene.scene import Scene

FINGER_PARTS = ("pad", "inner_finger")
"""Bodies that count as a finger; the rest of the gripper is the third box."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BoxGrasps:
    """Own grasps of B trials, S seeds each: pose, score (m, summed finger room; -1 where not
    feasible)."""

    T_obj_ee: Float32[Tensor, "b s 4 4"]
    score: Float32[Tensor, "b s"]
    seed: Float32[Tensor, "b s 3"]
    used: Bool[Tensor, "b s"]


def half_sides(robot: Robot) -> Array:
    """(G, 3) half sides of the boxes that hold the gripper's shapes, in their frames, m."""
    kind, size = robot.gripper.kind, robot.gripper.size
    return np.where((kind == ShapeKind.BOX)[:, None], size, size[:, [0, 0, 1]])


@lru_cache(maxsize=4)
def three_boxes(robot: Robot) -> tuple[Array, Array, Array, Array]:
    """Low and high corner (3,) of the finger at +y and of the rest, m, frame ee, gripper open at 85
    mm.

    The finger's inner face is the pad's; where its root would reach into the rest, the rest ends
    it.
    """
    opened = torch.tensor([robot.open_gap_m], dtype=torch.float32, device="cpu")
    R, p = (x[0].double().numpy() for x in gripper_poses(robot, opened))
    half = np.einsum("gij,gj->gi", np.abs(R), half_sides(robot))
    finger = np.isin(robot.gripper_part, FINGER_PARTS)
    positive = finger & (robot.gripper_side > 0)
    finger_low, finger_high = (p - half)[positive].min(0), (p + half)[positive].max(0)
    chassis_low, chassis_high = (p - half)[~finger].min(0), (p + half)[~finger].max(0)
    finger_low[1], finger_low[2] = robot.open_gap_m / 2, chassis_high[2]
    return finger_low, finger_high, chassis_low, chassis_high


def depth_steps(low_m: float, high_m: float, step_m: float) -> Array:
    """Depths from `low_m` to `high_m`, ends included."""
    return np.asarray(low_m + step_m * np.arange(round((high_m - low_m) / step_m) + 1), np.float64)


def box_grasps(
    scene: Scene,
    object_index: Int32[Tensor, " b"],
    role: UInt8[Tensor, "b p"],
    *,
    voxel_m: float,
    azimuth_step: float,
    depths_m: Sequence[float] | Array,
    crop_m: float,
) -> BoxGrasps:
    """Grasps seeded at the voxel means of the points whose role is not GRASP; every point of the
    cloud is an obstacle.

    `azimuth_step` in rad; azimuths cover half a turn, the gripper being symmetric.
    """
    cloud, device, index = _clouds(scene, voxel_m), scene.device, object_index.contiguous()
    turns, depth = _turns(azimuth_step), np.asarray(depths_m, np.float32)
    seed, used = _seeds(cloud, index, role, device)
    score = torch.full(used.shape, -1.0, dtype=torch.float32, device=device)
    turn, step = (torch.zeros(used.shape, dtype=torch.int32, device=device) for _ in range(2))
    if len(index):
        launch_trials(
            kernels.top_down_grasps,
            len(index),
            inputs={
                "boxes": _boxes(scene.robot),
                "points": cloud.points,
                "turns": wp.array(turns, dtype=wp.vec2, device=device),
                "depths": wp.array(depth, dtype=wp.float32, device=device),
                "crop": crop_m,
                "object": index,
                "seed": seed,
                "used": used,
            },
            outputs={"score": score, "turn": turn, "depth": step},
            device=device,
            chunk=1,
            width=used.shape[1],
        )
    if scene.config.candidates == "narrow":
        # (O, A) how wide each object is along the closing axis of each azimuth
        wide = np.stack([np.ptp(o.vertices[:, :2] @ turns.T, axis=0) for o in scene.objects])
        fits = torch.from_numpy(wide <= scene.robot.open_gap_m).to(device)
        score = torch.where(fits[index.long()].gather(1, turn.long()), score, -1.0)
    chosen = torch.from_numpy(turns).to(device)[turn.long()]
    down = torch.from_numpy(depth).to(device)[step.long()]
    return BoxGrasps(_poses(seed, chosen, down), score, seed, used.bool())


def _turns(azimuth_step: float) -> NDArray[np.float32]:
    """Cosine and sine (A, 2) of the azimuths in half a turn."""
    count = round(math.pi / azimuth_step)
    if not 1 <= count <= 30:
        raise ValueError(
            f"azimuth_step is {azimuth_step} rad, {count} azimuths; allowed are 1 to 30: give 0.105 or more"
        )
    angle = azimuth_step * np.arange(count)
    return np.stack([np.cos(angle), np.sin(angle)], 1).astype(np.float32)


def _seeds(
    cloud: "_Clouds", object_index: Int32[Tensor, " b"], role: UInt8[Tensor, "b p"], device: str
) -> tuple[Float32[Tensor, "b s 3"], UInt8[Tensor, "b s"]]:
    """Mean of the points in each voxel whose role is not GRASP, and whether the voxel has any."""
    shape = (len(object_index), cloud.voxel_start.shape[1] - 1)
    seed = torch.zeros((*shape, 3), dtype=torch.float32, device=device)
    used = torch.zeros(shape, dtype=torch.uint8, device=device)
    if shape[0]:
        launch_trials(
            kernels.voxel_means,
            shape[0],
            inputs={
                "points": cloud.points,
                "order": cloud.order,
                "voxel_start": cloud.voxel_start,
                "avoid": GRASP,
                "object": object_index,
                "role": role.contiguous(),
            },
            outputs={"seed": seed, "used": used},
            device=device,
            chunk=16,
            width=shape[1],
        )
    return seed, used


def _poses(seed: Tensor, turn: Tensor, depth: Tensor) -> Tensor:
    """z = -z of the object, y at the azimuth, origin `depth` below the seed."""
    T = torch.zeros((*seed.shape[:-1], 4, 4), dtype=seed.dtype, device=seed.device)
    c, s = turn[..., 0], turn[..., 1]
    T[..., 0, 0], T[..., 1, 0] = -s, c
    T[..., 0, 1], T[..., 1, 1] = c, s
    T[..., 2, 2] = -1.0
    T[..., :3, 3] = seed
    T[..., 2, 3] -= depth
    T[..., 3, 3] = 1.0
    return T


def _boxes(robot: Robot) -> Any:
    boxes = kernels.Boxes()
    names = ("finger_low", "finger_high", "chassis_low", "chassis_high")
    for name, corner in zip(names, three_boxes(robot), strict=True):
        setattr(boxes, name, wp.vec3(*corner.astype(np.float32)))
    return boxes


@dataclass(frozen=True)
class _Clouds:
    points: Float[Tensor, "o p 3"]
    order: Int32[Tensor, "o p"]
    voxel_start: Int32[Tensor, "o s"]


@KeptWith
def _clouds(scene: Scene, voxel_m: float) -> _Clouds:
    """The objects' clouds and which points share a voxel of a grid from half a voxel below the
    cloud's lowest corner."""
    orders, starts = [], []
    for model in scene.objects:
        points = model.points.astype(np.float64)
        cells = np.floor((points - points.min(0)) / voxel_m + 0.5).astype(np.int64)
        _, number, size = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        orders.append(np.argsort(number.ravel(), kind="stable"))
        starts.append(np.concatenate([[0], np.cumsum(size)]))
    most = max(map(len, starts))
    padded = np.stack([np.concatenate([s, np.full(most - len(s), s[-1])]) for s in starts])
    points = np.stack([o.points for o in scene.objects]).astype(np.float32)
    return _Clouds(
        torch.from_numpy(points).to(scene.device),
        torch.from_numpy(np.stack(orders).astype(np.int32)).to(scene.device),
        torch.from_numpy(padded.astype(np.int32)).to(scene.device),
    )
