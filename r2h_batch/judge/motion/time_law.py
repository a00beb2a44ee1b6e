"""The time law of a planned path: a trapezoid of speed per segment, stopping at every waypoint.

Each joint-space segment is timed by the joint that has farthest to go, d rad, by its weight: a radian
of a joint that is k times as fast as the slowest counts 1 / k. It speeds up at a, holds v, slows down at
a. These are the limits of the slowest joint; another one's are 1 / weight times as high. It reaches v
only if d >= v^2 / a, and takes d / v + v / a then; a shorter one is a triangle and takes 2 sqrt(d / a)
(Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots, 2008, Sec. 3.2).
"""

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Float64, Int32
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.launch.instances import of_joints
from r2h_batch.config import ExecConfig
from r2h_batch.kernels.motion.time_law import Law
from r2h_batch.kernels.robot.posture import Pace

Weights = NDArray[np.float64] | None


@dataclass(frozen=True)
class Motion:
    """When each waypoint is reached (s, rows beyond the path repeat the end), and T_exec (NaN
    without a path)."""

    time_s: Float32[Tensor, "b w"]
    t_exec_s: Float32[Tensor, " b"]
    weight: Weights = None
    """that of `time_path`"""


def time_path(
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    config: ExecConfig,
    weight: Weights = None,
) -> Motion:
    """A trapezoid of speed per segment, all joints together, stopping at every waypoint.

    The joint with the farthest to go sets the pace at `scale` times the limits; the path itself is
    not left. For two waypoints this is the time of the paper's T_exec: 8.4-9.0 s at MoveIt 2's
    default scale of 0.1. `weight`: `Robot.joint_weight` (None: all joints alike).
    """
    duration = _duration(_segment_lengths(path, length, weight), config)
    time = torch.zeros(path.shape[:2], dtype=torch.float64, device=path.device)
    for k in range(path.shape[1] - 1):
        time[:, k + 1] = time[:, k] + duration[:, k]
    t_exec = torch.where(length > 0, time[:, -1], torch.nan)
    return Motion(time.float(), t_exec.float(), weight)


def path_time(
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    config: ExecConfig,
    weight: Weights = None,
) -> Float64[Tensor, " b"]:
    """Seconds that `time_path` gives each path, in fewer steps: for comparisons of paths.

    Args:
        path: (B, W, J) float32 waypoints, rad.
        length: (B,) int32, number of waypoints; 0: no path.
        config: limits.
        weight: `Robot.joint_weight`; None: all joints alike.

    Returns:
        (B,) float64; 0 without a path.
    """
    return _duration(_segment_lengths(path, length, weight), config).sum(1)


def time_at(
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    motion: Motion,
    segment: Int32[Tensor, " b"],
    fraction: Float32[Tensor, " b"],
    config: ExecConfig | None,
) -> Float32[Tensor, " b"]:
    """When each path passes `fraction` (0 to 1) of its `segment`, s; NaN without a path. `config`
    None: each segment is passed at a constant rate."""
    rows = torch.arange(len(path), dtype=torch.int64, device=path.device)
    at = segment.long().clamp(0, path.shape[1] - 2)
    if config is None:
        start, end = motion.time_s[rows, at], motion.time_s[rows, at + 1]
        return torch.where(length > 0, start + fraction * (end - start), torch.nan)
    whole = _segment_lengths(path, length, motion.weight)[rows, at]
    total = _duration(whole, config)
    v, a = limits(config)
    s = fraction.double() * whole
    # the trapezoid is symmetric: count from the nearer end
    near = torch.minimum(s, whole - s).clamp(min=0)
    ramp = torch.minimum(torch.full_like(whole, v * v / (2 * a)), whole / 2)
    t = torch.where(near <= ramp, (2 * near / a).sqrt(), (2 * ramp / a).sqrt() + (near - ramp) / v)
    t = torch.where(s <= whole / 2, t, total - t)
    # never after its own end
    passed = torch.minimum((motion.time_s[rows, at] + t).float(), motion.time_s[rows, at + 1])
    return torch.where(length > 0, passed, torch.nan)


def limits(config: ExecConfig) -> tuple[float, float]:
    """Speed (rad/s) and acceleration (rad/s^2) that the time law may use of the slowest joint."""
    return config.scale * config.max_velocity_rad_s, config.scale * config.max_acceleration_rad_s2


def pace(config: ExecConfig, weight: NDArray[np.float64]) -> Pace:
    """The law as shortcuts read it."""
    found = of_joints(Pace, len(weight))()
    found.speed, found.acceleration = limits(config)
    found.weight = type(found.weight)(*weight)
    return found


def servo_law(
    config: ExecConfig, weight: NDArray[np.float64], *, lead_s: float, step_s: float
) -> Law:
    """The law as servos read it: one command every `step_s`, ahead of the plan by `lead_s` (what
    the servos lag)."""
    law = of_joints(Law, len(weight))()
    law.speed, law.acceleration = (wp.float64(limit) for limit in limits(config))
    law.weight = type(law.weight)(*weight)
    law.lead, law.step = wp.float64(lead_s), wp.float64(step_s)
    return law


def _segment_lengths(path: Tensor, length: Tensor, weight: Weights) -> Float64[Tensor, "b w"]:
    """Largest joint motion of each segment by its weight (rad); 0 beyond the path's end."""
    d = (path[:, 1:].double() - path[:, :-1].double()).abs()
    if weight is not None:
        d = d * torch.tensor(weight, dtype=torch.float64, device=d.device)
    d = d.amax(-1)
    slot = torch.arange(path.shape[1] - 1, dtype=torch.int64, device=path.device)
    return torch.where(slot < length[:, None] - 1, d, 0.0)


def _duration(d: Tensor, config: ExecConfig) -> Tensor:
    """How long segments of d rad take, s: trapezoid or triangle."""
    v, a = limits(config)
    return torch.where(d >= v * v / a, d / v + v / a, 2 * (d / a).sqrt())
