"""From joint branches to a collision-free path: which goals are free, straight lines, RRT-Connect,
shortcuts, clearance.

Every path keeps the robot's joint limits (`Robot.lower`, `.upper`). Home lies within them
(scene/scene.py), and so do goals (kernels/ik/step.py `within_limits`; other arms: judge/ik_any.py and
kernels/native/arm.h). The search draws postures within them (kernels/plan/rrt.py). All else are straight
lines between such postures, and a box of limits is convex. judge/motion/time_law.py times the path by
speed and acceleration. A motion that a caller gives is tested against angles and speeds in
judge/trace.py (`plan_of_trace`), a posture of a closed loop in closed_loop/env.py. In simulated motion
MuJoCo limits torques (`actfrcrange`) and angles (`range`): scene/dynamics.py.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float32, Int32, Int64
from torch import Tensor

from r2h_batch.base.launch import load
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.config import CLEARANCE_CAP_M, CLEARANCE_TOLERANCE_M, ExecConfig, PlanConfig
from r2h_batch.judge.ik import home_posture
from r2h_batch.judge.planner import Planner
from r2h_batch.judge.search import Search, edge_mode_of
from r2h_batch.kernels import JOINTS
from r2h_batch.kernels.judge.overlap import path_overlap
from r2h_batch.kernels.plan.codes import BRANCHES, SAMPLES, WAYPOINTS
from r2h_batch.kernels.plan.rrt import rrt_connect
from r2h_batch.kernels.plan.shortcut import shortcut
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.types import PlanReason

GOAL_ROOM_M = 2e-4
"""The clearance of a path may be this much smaller than that of its goal: otherwise its last interval
cannot be certified."""


def random_key(trial_id: Int64[Tensor, " b"]) -> Int32[Tensor, " b"]:
    """The planner's seed of each trial: 31 mixed bits of its id.

    The 32-bit integer hash with the multiplier 0x45D9F3B, applied twice.
    """
    x = (trial_id ^ (trial_id >> 32)) & 0xFFFFFFFF
    for shift, factor in ((16, 0x45D9F3B), (16, 0x45D9F3B), (16, 1)):
        x = ((x ^ (x >> shift)) * factor) & 0xFFFFFFFF
    return (x & 0x7FFFFFFF).to(torch.int32)


@dataclass(frozen=True)
class Plan:
    """Result of planning for B trials. `path` rows beyond `length` are meaningless; `length` 0
    means no path."""

    reason: Int32[Tensor, " b"]  # PlanReason
    # CollidingPair that ruled a start or goal out, or that is nearest along the path
    pair: Int32[Tensor, " b"]
    # robot body of the nearest pair (Scene.part_names), -1: none below the cap
    body: Int32[Tensor, " b"]
    # smallest along the path over all pairs, exact below the cap; of a sampled path that passes
    # through something, minus a lower bound of the deepest penetration depth; -inf without a path
    clearance_m: Float32[Tensor, " b"]
    straight: Bool[Tensor, " b"]  # the path is one straight joint-space line
    path: Float32[Tensor, "b w 6"]
    length: Int32[Tensor, " b"]


def plan_paths(
    scene: Scene,
    body_poses: BodyPoses,
    q: Float32[Tensor, "b 8 6"],
    valid: Bool[Tensor, "b 8"],
    active: Bool[Tensor, " b"],
    key: Int32[Tensor, " b"],
    config: PlanConfig,
    *,
    execute: ExecConfig | None = None,
    start: Float32[Tensor, "b 6"] | None = None,
    cap_m: float = CLEARANCE_CAP_M,
) -> Plan:
    """Paths from a start to those branches that are `valid` and free, and why a row has none.

    RRT-Connect (Kuffner and LaValle 2000) with certified edges. Reasons: `PlanReason`; margins:
    docs/choices.md.

    Args:
        scene: robot, objects and hands.
        body_poses: of B trials.
        q: (B, 8, J) float32 branches, rad.
        valid: (B, 8) branches that may be used.
        active: (B,) rows to plan; the others get NOT_EVALUATED.
        key: (B,) int32 seeds of the random numbers (`random_key`).
        config: how to search.
        execute: time law, by which paths are shortened; None: the default.
        start: (B, J) float32, rad; None: home.
        cap_m: clearances of paths count this at most, m.
    """
    with one_torch_thread(q.device):
        b, device = len(active), q.device
        planner = Planner(scene, body_poses)
        if start is None:
            start = home_posture(str(device), scene.config.workplace.home_q).expand(b, -1)
        start = start.contiguous()
        edge_mode = edge_mode_of(config)

        start_clear, start_pair, _ = planner.check(start, active, 1)
        goal_clear, goal_pair, clearance = planner.check(
            q.flatten(0, 1), (valid & active[:, None] & start_clear[:, None]).reshape(-1), BRANCHES
        )
        goal_clear, goal_pair, clearance = (
            x.view(b, BRANCHES) for x in (goal_clear, goal_pair, clearance)
        )

        # (b * 8, 6) free branches first, nearest to the start first; what lies beyond n_goals of a trial is
        # never looked at
        goals, n_goals, margin = _sort_goals(q, goal_clear, clearance, start, config)
        chosen = planner.straight(start, goals, n_goals, margin, edge_mode)
        path = torch.zeros((b, WAYPOINTS, q.shape[2]), dtype=torch.float32, device=device)
        length = torch.where(chosen >= 0, 2, 0).to(torch.int32)
        path[:, 0] = start
        nearest = goals.view(q.shape)[
            torch.arange(b, dtype=torch.int64, device=device), chosen.clamp(min=0).long()
        ]
        path[:, 1] = torch.where((chosen >= 0)[:, None], nearest, 0.0)

        Search(planner, start, goals, n_goals, margin, key, config, execute or ExecConfig())(
            path, length
        )

        least, pair, body = planner.clearance(path, length, cap_m=cap_m)
        if edge_mode == SAMPLES:  # sampled edges may pass through things
            _measure_overlaps(planner, scene, path, length, least, pair, body)
        reason = _reasons(active, start_clear, valid, n_goals, length)
        first_valid = valid.to(torch.int8).argmax(1)
        blocked_by = goal_pair[torch.arange(b, dtype=torch.int64, device=device), first_valid]
        pair = torch.where(reason == int(PlanReason.IK_IN_COLLISION), blocked_by, pair)
        pair = torch.where(reason == int(PlanReason.START_IN_COLLISION), start_pair, pair)
        return Plan(reason, pair, body, least, length == 2, path, length)


def load_searches(device: str, joints: int = JOINTS) -> None:
    """Compiles what only some trials need (searches, shortcuts, how deep bodies meet), or loads it
    from the kernel cache."""
    load([of_joints(kernel, joints) for kernel in (rrt_connect, shortcut, path_overlap)], device)


def path_clearances(
    scene: Scene,
    body_poses: BodyPoses,
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    *,
    tolerance_m: float = CLEARANCE_TOLERANCE_M,
    without: float = -math.inf,
    cap_m: float = CLEARANCE_CAP_M,
    depths: bool = True,
) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"], Int32[Tensor, " b"]]:
    """Smallest clearance along paths that were planned elsewhere, its pair and the robot's body, as
    in `Plan`; minus the overlap where bodies meet. Postures alone (W = 1) take launches over all rows.

    Args:
        scene: robot, objects, hands and table.
        body_poses: where bodies are.
        path: waypoints, rad.
        length: number of waypoints; 0: no path, body -1.
        tolerance_m: of clearances above 0.
        without: the clearance where there is no path, m.
        cap_m: clearances count this at most, m.
        depths: measure how deep bodies meet; False: where they meet, anything below 0.
    """
    planner = Planner(scene, body_poses)
    found = planner.clearance(path, length, tolerance_m, without, cap_m)
    if not depths:
        return found
    _measure_overlaps(planner, scene, path, length, *found)
    return found


def _measure_overlaps(
    planner: Planner,
    scene: Scene,
    path: Float32[Tensor, "b w 6"],
    length: Int32[Tensor, " b"],
    least: Float32[Tensor, " b"],
    pair: Int32[Tensor, " b"],
    body: Int32[Tensor, " b"],
) -> None:
    """Writes how deep the bodies meet on paths whose clearance is below 0, and which they are."""
    if path.shape[1] == 1:
        # the kernel passes over rows that meet nothing: a list of the others would wait for the device
        rows, chunk = _every_row(len(path), path.device), 16
    else:
        meets = (length > 0) & (least < 0)
        rows, chunk = torch.nonzero(meets).flatten().to(torch.int32), 1
    inputs = {"hull_ball": scene.hull_balls, "row": rows, "path": path, "length": length}
    outputs = {"clearance": least, "pair": pair, "body": body}
    planner(path_overlap, len(rows), inputs=inputs, outputs=outputs, chunk=chunk)


@lru_cache(maxsize=16)
def _every_row(b: int, device: torch.device) -> Int32[Tensor, " b"]:
    """The numbers of b rows."""
    return torch.arange(b, dtype=torch.int32, device=device)


def _reasons(
    active: Bool[Tensor, " b"],
    start_clear: Bool[Tensor, " b"],
    valid: Bool[Tensor, "b 8"],
    n_goals: Int32[Tensor, " b"],
    length: Int32[Tensor, " b"],
) -> Int32[Tensor, " b"]:
    """PlanReason of each row; the earliest failed check decides, because later lines replace earlier ones."""
    reason = torch.full_like(length, int(PlanReason.NO_PATH_IN_BUDGET))
    reason[length > 0] = int(PlanReason.OK)
    reason[(n_goals == 0) & valid.any(1)] = int(PlanReason.IK_IN_COLLISION)
    reason[~valid.any(1)] = int(PlanReason.IK_UNREACHABLE)
    reason[~start_clear] = int(PlanReason.START_IN_COLLISION)
    reason[~active] = int(PlanReason.NOT_EVALUATED)
    return reason


def _sort_goals(
    q: Tensor, clear: Tensor, clearance: Tensor, start: Tensor, config: PlanConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Free goals, nearest to the start first: (b * 8, 6), their number (b,), the hand clearance a path
    to each must keep (b, 8)."""
    b = len(q)
    distance = torch.zeros(q.shape[:2], dtype=torch.float64, device=q.device)
    for j in range(q.shape[2]):  # summed in a fixed order: the same bits at any batch size
        distance = distance + (q[..., j] - start[:, None, j]).double().square()
    order = torch.where(clear, distance, torch.inf).argsort(dim=1, stable=True)
    rows = torch.arange(b, dtype=torch.int64, device=q.device)[:, None]
    goals = q[rows, order].flatten(0, 1)
    room = clearance[rows, order]
    # A goal at `room` from the hand cannot be entered on a path that keeps more: a little less than
    # the goal has, at least half of it, and never more than the margin asked for everywhere
    keep = torch.maximum(room - GOAL_ROOM_M, 0.5 * room).clamp(max=config.hand_clearance_m)
    n_goals = clear.sum(1).to(torch.int32)
    return goals, n_goals, keep.contiguous()
