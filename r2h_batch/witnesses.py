"""Finds the points that decide each margin: one kernel launch per kind of margin, after the evaluator has judged."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch import se3
from r2h_batch.config import CLEARANCE_CAP_M, EvalConfig
from r2h_batch.grasp import OPEN_GAP_M, attach
from r2h_batch.gradients import Closing, Contact
from r2h_batch.kernels import reach as reach_kernels
from r2h_batch.kernels import witness as kernels
from r2h_batch.launch import launch_trials
from r2h_batch.scene import Scene

__all__ = ["closing", "fingers", "nearest_to_palm"]

SLACK_M = 3e-5
"""A witness may be this much nearer or farther than the evaluator's number, which is a certified bound of it."""


def closing(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    width_m: Float32[Tensor, " b"],
    *,
    threads: int | None = None,
) -> Closing:
    """What the pads met, where the evaluator found `width_m` (NaN: nothing); `T_obj_ee` before the object moved."""
    b, device = len(T_obj_ee), T_obj_ee.device
    points = torch.zeros((b, 4, 3), device=device)
    slope_x, slope_z, lift = torch.zeros((b, 4), device=device), torch.zeros((b, 4), device=device), torch.zeros(b, device=device)
    state = torch.zeros(b, dtype=torch.int32, device=device)
    tables = scene.grasp_tables
    launch_trials(
        kernels.closing_witness,
        b,
        [tables.gripper, tables.surfaces, OPEN_GAP_M, int(scene.config.width == "whole"), _mat44(T_obj_ee)]
        + [wp.from_torch(object_index), wp.from_torch(points, dtype=wp.vec3)]
        + [wp.from_torch(x) for x in (slope_x, slope_z, lift, state)],
        device=scene.device,
        threads=threads,
    )
    return Closing(T_obj_ee, points, slope_x, slope_z, lift, state, (state > 0) & (width_m <= OPEN_GAP_M))


def fingers(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    distance_m: Float32[Tensor, " b"],
    wanted: Bool[Tensor, " b"],
    *,
    region: bool,
    threads: int | None = None,
) -> Contact:
    """The point of the object (or of its receiver's region) nearest to or deepest in the gripper, where `wanted`.

    `distance_m`: the evaluator's distance. The fingers count for the region, the whole gripper for the object.
    """
    b, device, tables = len(T_obj_ee), T_obj_ee.device, scene.grasp_tables
    bound = torch.where(wanted, distance_m + SLACK_M, -torch.inf)
    part = torch.full((b,), -1, dtype=torch.int32, device=device)
    distance = torch.zeros(b, device=device)
    point, normal, finger = (torch.zeros((b, 3), device=device) for _ in range(3))
    launch_trials(
        kernels.surface_witness,
        b,
        [tables.gripper, tables.surfaces, tables.objects if region else 0, tables.moving if region else tables.every]
        + [_mat44(T_obj_ee), wp.from_torch(object_index), wp.from_torch(opening_m.contiguous()), wp.from_torch(bound)]
        + [wp.from_torch(part), wp.from_torch(distance)]
        + [wp.from_torch(x, dtype=wp.vec3) for x in (point, normal, finger)],
        device=scene.device,
        threads=threads,
    )
    return Contact(point, normal, finger, part >= 0)


def _mat44(T: Tensor) -> Any:
    if len(T) == 0:  # Warp refuses the strides that torch gives some empty tensors
        T = torch.empty((0, 4, 4), dtype=torch.float32, device=T.device)
    return wp.from_torch(T.contiguous(), dtype=wp.mat44)
