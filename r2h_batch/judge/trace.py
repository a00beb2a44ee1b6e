"""A motion that the caller planned: joint angles over time, judged as a planned path is.

Between two samples every joint moves at a constant rate. The motion is thus a path of straight lines
in joint space, and Plan and Safe walk these lines, certified between the samples, as they walk the
paths of our planner.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base.validate import describe_value
from r2h_batch.base.validate_tensors import as_numbers, check_tensor
from r2h_batch.judge.motion.execute import Executed
from r2h_batch.judge.motion.time_law import Motion
from r2h_batch.judge.plan import Plan, path_clearances
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.types import PlanReason
from r2h_batch.verdicts import MOST_SECONDS

LIMIT_TOLERANCE_RAD = 1e-5
"""A joint may stand this far beyond its limit, or turn this much farther between two samples:
float32 rounding."""
SPEED_TOLERANCE = 1e-3
"""Tolerance as a share of a joint's largest speed: the rounding of times in float32."""
Q_WORDS = "a torch tensor (N, W, joints) of angles in rad"
START_RAD = 0.1
"""A plan of a motion begins this near to it, joint by joint."""


@dataclass(frozen=True)
class Trace:
    """B joint motions. Samples beyond `length` repeat the last one."""

    q: Float32[Tensor, "b w j"]  # rad
    time_s: Float32[Tensor, "b w"]
    length: Int32[Tensor, " b"]
    usable: Bool[
        Tensor, " b"
    ]  # finite, MOST_SECONDS at most, no time goes back or moves a joint in 0 s

    def __getitem__(self, rows: Any) -> "Trace":
        return Trace(self.q[rows], self.time_s[rows], self.length[rows], self.usable[rows])


def checked_plan(planned_q: Any, length: Tensor | None, trace: Trace, scene: Scene) -> Trace:
    """The plans of executed motions: as `checked_trace`, with times spread over MOST_SECONDS,
    because a plan has no times. Usable where the plan begins at the motion's first sample."""
    planned_q = as_numbers("planned_q", planned_q, Q_WORDS, scene.device)
    samples = planned_q.shape[-2] if planned_q.ndim > 1 else 0
    times = torch.linspace(0, MOST_SECONDS, samples, dtype=torch.float32, device=planned_q.device)
    plan = checked_trace(planned_q, times, length, len(trace.q), scene, prefix="planned_")
    near = ((plan.q[:, 0] - trace.q[:, 0]).abs() <= START_RAD).all(1)
    return replace(plan, usable=plan.usable & near)


def checked_trace(
    q: Any, time_s: Any, length: Tensor | None, n: int, scene: Scene, *, prefix: str = ""
) -> Trace:
    """The motions of `n` trials.

    Args:
        q: (n, W, joints) angles, rad (`as_numbers`).
        time_s: (n, W) or (W,) times of the samples, s.
        length: (n,) number of samples of each motion, 2 to W; None: W.
        n: number of trials.
        scene: the robot, and where the evaluator is.
        prefix: of `q` and `length` in messages.

    Raises:
        TypeError, ValueError: shape, dtype or device do not fit; the line names the argument.
    """
    device, joints = scene.device, len(scene.robot.joints)
    q = as_numbers(f"{prefix}q", q, Q_WORDS, device)
    if q.ndim != 3 or q.shape[0] != n or q.shape[1] < 2 or q.shape[2] != joints:
        raise ValueError(
            f"{prefix}q is {describe_value(q)}; with {n} trials it must be ({n}, W, {joints}), W at least 2 samples"
        )
    w = q.shape[1]
    time_s = as_numbers("time_s", time_s, "a torch tensor (N, W) or (W,) of seconds", device)
    if time_s.shape not in ((n, w), (w,)):
        raise ValueError(f"time_s is {describe_value(time_s)}; it must be ({n}, {w}) or ({w},)")
    if length is None:
        length = torch.full((n,), w, dtype=torch.int32, device=q.device)
    check_tensor(f"{prefix}length", length, f"None or a torch tensor ({n},) of whole numbers")
    if length.shape != (n,) or length.dtype not in (torch.int32, torch.int64):
        raise ValueError(
            f"{prefix}length is {describe_value(length)}; it must be int32 or int64 ({n},), or None"
        )
    for name, value in ((f"{prefix}q", q), ("time_s", time_s), (f"{prefix}length", length)):
        if value.device.type != torch.device(device).type:
            raise ValueError(
                f"{name} is on {value.device}, the evaluator on {device}: move one of them"
            )
    if n and not 2 <= int(length.min()) <= int(length.max()) <= w:
        raise ValueError(
            f"{prefix}length goes from {int(length.min())} to {int(length.max())}; allowed is 2 to {w}, the "
            f"samples that {prefix}q has"
        )
    last = (length.long() - 1)[:, None]
    slot = torch.arange(w, dtype=torch.int64, device=q.device)[None].minimum(last)
    q = q.detach().gather(1, slot[..., None].expand(-1, -1, joints))
    time_s = time_s.detach().expand(n, w).gather(1, slot)
    q, time_s = q.float(), (time_s - time_s[:, :1]).float()  # float64 may be too large for it
    takes = time_s[:, 1:] - time_s[:, :-1]
    stays = (q[:, 1:] == q[:, :-1]).all(2)
    usable = q.isfinite().flatten(1).all(1) & (time_s <= MOST_SECONDS).all(1)  # False for NaN
    usable = usable & ((takes > 0) | ((takes == 0) & stays)).all(1)
    return Trace(q, time_s, length.to(torch.int32), usable)


def final_pose(scene: Scene, trace: Trace) -> Float32[Tensor, "b 4 4"]:
    """T_world_ee at the end of each motion by forward kinematics in float64; NaN where the motion
    is not usable."""
    pose = ee_pose(scene.robot, np.nan_to_num(trace.q[:, -1].double().cpu().numpy()))
    T = torch.from_numpy(pose.astype(np.float32)).to(trace.q.device)
    return torch.where(trace.usable[:, None, None], T, torch.nan)


def walked(
    scene: Scene, trace: Trace, active: Bool[Tensor, " b"]
) -> tuple[Float32[Tensor, "b w j"], Int32[Tensor, " b"]]:
    """The lines of active motions, and how many samples they have: 0 for motions beyond the joint
    limits, whose lines could be arbitrarily long."""
    lower, upper = (
        torch.tensor(np.array(x), dtype=torch.float64, device=trace.q.device)
        for x in (scene.robot.lower, scene.robot.upper)
    )
    beyond = torch.maximum(lower - trace.q.double(), trace.q.double() - upper).amax((1, 2))
    keep = active & (beyond <= LIMIT_TOLERANCE_RAD)
    q = torch.where(keep[:, None, None], trace.q, 0.0).contiguous()
    return q, torch.where(keep, trace.length, 0)


def plan_of_trace(
    scene: Scene,
    body_poses: BodyPoses,
    trace: Trace,
    active: Bool[Tensor, " b"],
) -> Plan:
    """Plan's verdict on the motions: free of collisions from the first to the last sample, and
    within the robot's limits of angles and speeds.

    `body_poses`: what the motion must keep clear of. Where bodies meet, the clearance is minus the
    overlap, as on a sampled path; -inf beyond the limits, and length 0 beyond those of angles.
    """
    q, length = walked(scene, trace, active)
    within = ~active | (length > 0)
    speed = (1 + SPEED_TOLERANCE) * np.array(scene.robot.max_velocity)
    most = torch.tensor(speed, dtype=torch.float32, device=q.device)
    takes = (trace.time_s[:, 1:] - trace.time_s[:, :-1])[..., None]
    turns = (q[:, 1:] - q[:, :-1]).abs()
    slow = ~active | (turns <= most * takes + LIMIT_TOLERANCE_RAD).flatten(1).all(1)
    clearance, pair, body = path_clearances(scene, body_poses, q, length)
    clearance = torch.where(within & slow, clearance, -torch.inf)
    reason = torch.where(clearance > 0, int(PlanReason.OK), int(PlanReason.MOTION_IN_COLLISION))
    reason = torch.where(slow, reason, int(PlanReason.BEYOND_SPEED_LIMITS))
    reason = torch.where(within, reason, int(PlanReason.BEYOND_JOINT_LIMITS))
    reason = torch.where(active, reason, int(PlanReason.NOT_EVALUATED)).to(torch.int32)
    return Plan(reason, pair, body, clearance, trace.length == 2, q, length)


def worse_plan(plan: Plan, followed: Plan, touches: Bool[Tensor, " b"]) -> Plan:
    """Plan's verdict on plans that a robot or a simulator executed: the plan must be free, and
    so must be the executed motion, whose path this returns. `touches`: rows in which the robot
    touches the hand and that fail by Safe; there Plan judges the plan alone, as the authors'
    release does."""
    worse = (followed.clearance_m < plan.clearance_m) & ~touches
    columns = {
        name: torch.where(worse, getattr(followed, name), getattr(plan, name))
        for name in ("reason", "pair", "body", "clearance_m")
    }
    return replace(followed, **columns)


def executed_trace(trace: Trace, planned: Plan) -> tuple[Executed, Motion]:
    """The motions as they are: exact lines between the samples, at rest at the last one.

    `planned`: has the lines that are walked in `path` and `length`.
    """
    zero = torch.zeros_like(planned.clearance_m)
    true = torch.ones_like(trace.usable)
    t_exec_s = torch.where(planned.length > 0, trace.time_s[:, -1], torch.nan)
    none = torch.zeros_like(planned.length)
    executed = Executed(
        planned.path, planned.length, t_exec_s, true, true, zero, zero, zero, none, None
    )
    return executed, Motion(trace.time_s, t_exec_s)
