"""The goal posture of a handover pose, judged without a path: the branch the planner would go to, its clearance, Safe there."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M, HOME_Q, Thresholds
from r2h_batch.ik import IkResult, default_ur
from r2h_batch.kernels import goal as goal_kernels
from r2h_batch.kernels import ik_nearest
from r2h_batch.launch import launch_trials
from r2h_batch.metrics import Criterion
from r2h_batch.scene import Placed, Scene
from r2h_batch.types import PlanReason

ROTATION_LEVER_M = 0.1
"""How many metres a radian counts in the residual of an unreachable target [choice]: about the fingers' length."""


@dataclass(frozen=True)
class Goal:
    """Where B handover poses would end, and how clear that is.

    `reason`, `pair`: as in `Plan`, as far as they are known without a path. `q` is the free branch that the planner tries
    first; else the valid branch with the largest clearance; else, for an unreachable target, the posture that comes
    nearest to it with the hand turned as asked; NaN for inactive rows. `clearance_m` is above 0 exactly where `reason` is
    OK: the smallest over all pairs, exact below 5 cm and a lower bound above; where bodies meet, minus a lower bound of
    the overlap (kernels/posture.py); minus the residual where unreachable; that of home where the start collides.
    `push`: when the two bodies move rigidly, the clearance changes by push . (motion of `body` - motion of `other`) at
    `point` (world frame; zero where there is no pair below the cap).
    """

    reason: Int32[Tensor, " b"]
    pair: Int32[Tensor, " b"]
    slot: Int32[Tensor, " b"]  # of the branch (IkResult), -1: none
    q: Float32[Tensor, "b 6"]
    clearance_m: Float32[Tensor, " b"]
    nearest: Int32[Tensor, " b"]  # CollidingPair of the nearest pair, whatever `pair` says
    body: Int32[Tensor, " b"]  # Scene.part_names; -1: none
    other: Int32[Tensor, " b"]  # hand piece or robot body it is nearest to; -1: none, or the table
    push: Float32[Tensor, "b 3"]
    point: Float32[Tensor, "b 3"]

    @property
    def free(self) -> Bool[Tensor, " b"]:
        """Some branch is free, and home is."""
        return self.reason == int(PlanReason.OK)


def judge_goals(
    scene: Scene,
    placed: Placed,
    T_world_ee: Float32[Tensor, "b 4 4"],
    ik: IkResult,
    branches: Bool[Tensor, "b 8"],
    active: Bool[Tensor, " b"],
    *,
    threads: int | None = None,
) -> Goal:
    """The goals of B handover poses whose IK is solved; `branches` are those that may be used (`goals="one"`: one)."""
    b, device = len(active), active.device
    home = _home(str(device))
    reason, pair, slot, nearest, body, other = (torch.empty(b, dtype=torch.int32, device=device) for _ in range(6))
    q = torch.full((b, 6), torch.nan, dtype=torch.float32, device=device)
    residual = torch.zeros(b, dtype=torch.float32, device=device)
    clearance = torch.full((b,), torch.nan, dtype=torch.float32, device=device)
    push, point = (torch.zeros((b, 3), dtype=torch.float32, device=device) for _ in range(2))
    branches, active, T_world_ee = branches.contiguous(), active.contiguous(), T_world_ee.contiguous()
    every = wp.from_torch(ik.q.view(-1, 6))
    on = {"device": scene.device, "threads": threads}

    start = [scene.world, placed.bodies, wp.from_torch(home), wp.from_torch(active), wp.from_torch(branches), every]
    chosen = [wp.from_torch(x) for x in (reason, pair, slot)]
    launch_trials(goal_kernels.choose_goal, b, [*start, *chosen], chunk=64, **on)  # type: ignore[arg-type]

    inputs = [
        default_ur(), wp.float64(ROTATION_LEVER_M), wp.from_torch(active & ~branches.any(1)),
        wp.from_torch(T_world_ee, dtype=wp.mat44), wp.from_torch(q), wp.from_torch(residual),
    ]  # fmt: skip
    launch_trials(ik_nearest.nearest_posture, b, inputs, chunk=256, **on)  # type: ignore[arg-type]

    inputs = [
        CLEARANCE_CAP_M, scene.world, scene.hull_balls, placed.bodies, wp.from_torch(home), wp.from_torch(reason),
        wp.from_torch(branches), every, wp.from_torch(residual), wp.from_torch(pair), wp.from_torch(slot),
        wp.from_torch(q), wp.from_torch(clearance), wp.from_torch(nearest), wp.from_torch(body), wp.from_torch(other),
        wp.from_torch(push, dtype=wp.vec3), wp.from_torch(point, dtype=wp.vec3),
    ]  # fmt: skip
    launch_trials(goal_kernels.goal_clearance, b, inputs, chunk=64, **on)  # type: ignore[arg-type]
    return Goal(reason, pair, slot, q, clearance, nearest, body, other, push, point)


def safe_at(
    scene: Scene,
    placed: Placed,
    q: Float32[Tensor, "b 6"],
    active: Bool[Tensor, " b"],
    thresholds: Thresholds,
    *,
    threads: int | None = None,
) -> tuple[Criterion, Int32[Tensor, " b"], Float32[Tensor, "b 3"]]:
    """Safe of the posture `q` alone, the robot body nearest to the hand (-1: beyond 5 cm), the hand's nearest point (world).

    Margin: distance of the hand's exact mesh to the robot's primitives, exact below 5 cm, an overlap bound below 0.
    """
    b, device = len(active), active.device
    distance = torch.empty(b, dtype=torch.float32, device=device)
    body = torch.empty(b, dtype=torch.int32, device=device)
    point = torch.full((b, 3), torch.nan, dtype=torch.float32, device=device)
    inputs = [
        CLEARANCE_CAP_M, scene.world, scene.hand_mesh, placed.bodies, wp.from_torch(active.contiguous()),
        wp.from_torch(q), wp.from_torch(distance), wp.from_torch(body), wp.from_torch(point, dtype=wp.vec3),
    ]  # fmt: skip
    launch_trials(goal_kernels.goal_safe_distance, b, inputs, device=scene.device, threads=threads, chunk=64)
    criterion = Criterion.of(distance - thresholds.safe_margin_m, active, touching_passes=False)
    return criterion, body, point


@lru_cache(maxsize=4)
def _home(device: str) -> Tensor:
    return torch.from_numpy(np.array([HOME_Q], np.float32)).to(device)
