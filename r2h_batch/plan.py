"""From joint branches to a collision-free path: which goals are free, straight lines, RRT-Connect, shortcuts, clearance."""

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M, HOME_Q, ExecConfig, PlanConfig
from r2h_batch.kernels import rrt
from r2h_batch.launch import launch_trials
from r2h_batch.scene import Placed, Scene
from r2h_batch.types import PlanReason

WAYPOINTS = 32
"""Longest path that is stored; RRT-Connect's raw paths have 3 to 12."""

CLEARANCE_TOLERANCE_M = 1e-4
"""How exactly the smallest clearance along a path is located."""

GOAL_ROOM_M = 2e-4
"""A path may come this much nearer to the hand than its goal does: the stretch next to the goal must be certifiable."""

_SCRATCH_NODES = 4_000_000  # of all trees of one launch: 96 MB


@dataclass(frozen=True)
class Plan:
    """What planning found for B trials. `path` rows beyond `length` are meaningless; `length` 0 means no path."""

    reason: Int32[Tensor, " b"]  # PlanReason
    pair: Int32[Tensor, " b"]  # CollidingPair that ruled a start or goal out, or that is nearest along the path
    body: Int32[Tensor, " b"]  # robot body of the nearest pair (Scene.part_names), -1: none below the cap
    clearance_m: Float32[Tensor, " b"]  # smallest along the path over all pairs, exact below 5 cm; -inf without a path
    straight: Bool[Tensor, " b"]  # the path is one straight joint-space line
    path: Float32[Tensor, "b w 6"]
    length: Int32[Tensor, " b"]


def plan_paths(
    scene: Scene,
    placed: Placed,
    q: Float32[Tensor, "b 8 6"],
    valid: Bool[Tensor, "b 8"],
    active: Bool[Tensor, " b"],
    key: Int32[Tensor, " b"],
    config: PlanConfig,
    *,
    execute: ExecConfig | None = None,
    threads: int | None = None,
) -> Plan:
    """Paths from home to the free branches `q` (rad), and why there is none where there is none.

    `key` seeds a trial's random numbers. Reasons and margins as in benchmark.md; RRT-Connect (Kuffner and LaValle 2000)
    with certified edges. Rows that are not `active` get NOT_EVALUATED.
    """
    b, device = len(active), q.device
    execute = execute or ExecConfig()
    run = _Launcher(scene, placed, threads)
    home = torch.tensor([HOME_Q], dtype=torch.float32, device=device)
    moveit = int(config.edge_check == "moveit")

    start_clear, start_pair, _ = run.check(home.expand(b, 6).contiguous(), active, 1)
    goal_clear, goal_pair, clearance = run.check(
        q.reshape(-1, 6), (valid & active[:, None] & start_clear[:, None]).reshape(-1), 8
    )
    goal_clear, goal_pair, clearance = (x.view(b, 8) for x in (goal_clear, goal_pair, clearance))

    goals, n_goals, margin = _sort_goals(q, goal_clear, clearance, home, config)
    chosen = torch.full((b,), -1, dtype=torch.int32, device=device)
    run(rrt.straight_lines, b, moveit, *run.tables, home, goals, n_goals, margin.view(-1), chosen, chunk=8)
    path = torch.zeros((b, WAYPOINTS, 6), dtype=torch.float32, device=device)
    length = torch.where(chosen >= 0, 2, 0).to(torch.int32)
    path[:, 0] = home
    straight = chosen >= 0
    nearest = goals.view(b, 8, 6)[torch.arange(b, device=device), chosen.clamp(min=0).long()]
    path[:, 1] = torch.where(straight[:, None], nearest, 0.0)

    todo = torch.nonzero((n_goals > 0) & ~straight).flatten().to(torch.int32)
    for i, iterations in enumerate(config.rounds):
        last = i == len(config.rounds) - 1
        kept, n_kept, path_margin = _goals_for_search(goals.view(b, 8, 6), n_goals, margin, everything=last)
        capacity = 4 * iterations + 16
        for part in todo.split(max(1, _SCRATCH_NODES // (2 * capacity))):
            nodes = torch.empty((len(part) * 2 * capacity, 6), dtype=torch.float32, device=device)
            parents = torch.empty(len(part) * 2 * capacity, dtype=torch.int32, device=device)
            run(
                rrt.rrt_connect, len(part), iterations, capacity, config.range_rad, config.seed, moveit, *run.tables,
                home, part, key, kept.view(-1, 6), n_kept, path_margin, nodes, parents, path, length, chunk=1,
            )  # fmt: skip
            found = part[length[part.long()] > 0]
            run(
                rrt.shortcut,
                len(found),
                config.shortcuts,
                execute.scale * execute.max_velocity_rad_s,
                execute.scale * execute.max_acceleration_rad_s2,
                config.seed,
                moveit,
                *run.tables,
                found,
                key,
                path_margin,
                path,
                length,
                chunk=1,
            )
        todo = todo[length[todo.long()] == 0]
        if not len(todo):
            break

    least = torch.full((b,), -torch.inf, dtype=torch.float32, device=device)
    pair = torch.zeros(b, dtype=torch.int32, device=device)
    body = torch.full((b,), -1, dtype=torch.int32, device=device)
    run(
        rrt.path_clearance,
        b,
        CLEARANCE_CAP_M,
        CLEARANCE_TOLERANCE_M,
        *run.tables,
        path,
        length,
        least,
        pair,
        body,
        chunk=8,
    )

    reason = torch.full((b,), int(PlanReason.NO_PATH_IN_BUDGET), dtype=torch.int32, device=device)
    reason[length > 0] = int(PlanReason.OK)
    reason[(n_goals == 0) & valid.any(1)] = int(PlanReason.IK_IN_COLLISION)
    reason[~valid.any(1)] = int(PlanReason.IK_UNREACHABLE)
    reason[~start_clear] = int(PlanReason.START_IN_COLLISION)
    reason[~active] = int(PlanReason.NOT_EVALUATED)
    first_valid = valid.to(torch.int8).argmax(1)
    blocked_by = goal_pair[torch.arange(b, device=device), first_valid]
    pair = torch.where(reason == int(PlanReason.IK_IN_COLLISION), blocked_by, pair)
    pair = torch.where(reason == int(PlanReason.START_IN_COLLISION), start_pair, pair)
    return Plan(reason, pair, body, least, straight, path, length)


class _Launcher:
    """Launches planning kernels with the scene's tables; tensors become Warp arrays on the way (zero copy)."""

    def __init__(self, scene: Scene, placed: Placed, threads: int | None) -> None:
        self.tables = (scene.world, placed.bodies)
        self._device = scene.device
        self._threads = threads

    def __call__(self, kernel: Any, n: int, *args: Any, chunk: int) -> None:
        arrays = [wp.from_torch(a) if isinstance(a, Tensor) else a for a in args]
        launch_trials(kernel, n, arrays, device=self._device, threads=self._threads, chunk=chunk)

    def check(self, q: Tensor, active: Tensor, per_trial: int) -> tuple[Tensor, Tensor, Tensor]:
        """Free or not, the pair that collides, the hand clearance up to 6.5 mm; one row per posture."""
        n = len(q)
        clear = torch.zeros(n, dtype=torch.bool, device=q.device)
        pair = torch.zeros(n, dtype=torch.int32, device=q.device)
        clearance = torch.zeros(n, dtype=torch.float32, device=q.device)
        self(
            rrt.check_postures,
            n,
            per_trial,
            *self.tables,
            active.contiguous(),
            q.contiguous(),
            clear,
            pair,
            clearance,
            chunk=64,
        )
        return clear, pair, clearance


def _sort_goals(
    q: Tensor, clear: Tensor, clearance: Tensor, home: Tensor, config: PlanConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """Free goals, nearest to home first: (b * 8, 6), their number (b,), the hand clearance a path to each must keep (b, 8)."""
    b = len(q)
    distance = torch.zeros(q.shape[:2], dtype=torch.float64, device=q.device)
    for j in range(6):  # summed in a fixed order: the same bits at any batch size
        distance = distance + (q[..., j] - home[0, j]).double().square()
    order = torch.where(clear, distance, torch.inf).argsort(dim=1, stable=True)
    rows = torch.arange(b, device=q.device)[:, None]
    goals = q[rows, order].contiguous().view(-1, 6)
    room = clearance[rows, order]
    keep = torch.maximum(room - GOAL_ROOM_M, 0.5 * room).clamp(max=config.hand_clearance_m)
    n_goals = clear.sum(1).to(torch.int32)
    return goals, n_goals, keep.contiguous()


def _goals_for_search(
    goals: Tensor, n_goals: Tensor, margin: Tensor, *, everything: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """The goals that one search may end at, and the hand clearance that all of it keeps.

    A tree has one margin. First only goals that allow (nearly) the widest one; in the last round all of them.
    """
    slot = torch.arange(8, device=goals.device)[None]
    there = slot < n_goals[:, None]
    widest = torch.where(there, margin, 0.0).amax(1, keepdim=True)
    use = there & ((margin >= 0.9 * widest) | torch.tensor(everything, device=goals.device))
    order = torch.where(use, slot, 8 + slot).argsort(dim=1)
    rows = torch.arange(len(goals), device=goals.device)[:, None]
    kept_margin = torch.where(use, margin, torch.inf).amin(1)
    return (
        goals[rows, order].contiguous(),
        use.sum(1).to(torch.int32),
        torch.where(there.any(1), kept_margin, 0.0).contiguous(),
    )
