"""Paths where no straight line is free: rounds of RRT-Connect, shortcuts, and other searches where
the first path is long."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import ExecConfig, PlanConfig
from r2h_batch.judge.motion.time_law import pace, path_time
from r2h_batch.judge.planner import Planner
from r2h_batch.kernels.plan.codes import BRANCHES, CERTIFY, CLOSELY, SAMPLES
from r2h_batch.kernels.plan.rrt import rrt_connect
from r2h_batch.kernels.plan.shortcut import shortcut

_SCRATCH_NODES, _NODE_BYTES = 4_000_000, 32  # of all trees of one launch: 128 MB
RANGE_SHRINK = 0.9
"""Factor on a node's range when a step from it is blocked, in all rounds but the last."""
GOOD_ENOUGH_RATIO = 1.1
"""A path that takes at most this times the straight line between its ends is not shortened
further."""
DETOUR_RATIO = 2.0
"""A path is a detour if it takes more than this times the straight line to the goal nearest in
time."""
DETOUR_RETRIES = 2
"""How many more searches a detour gets, with other random numbers."""
DETOUR_ITERATIONS = 500
"""Budget of each of them, in random postures."""
LAST_SHARES = (1.0, 0.5, *(0.0,) * 8)
"""Where every round has found nothing: further searches, each with the largest round's budget, other random numbers and
edges certified as closely as they can be. They keep this share of the hand clearance that the rounds have asked for."""


@dataclass(frozen=True)
class Search:
    """Inputs of B searches: the goals of each, (b * 8, 6), the first `n_goals` of them free, and
    their margins."""

    planner: Planner
    start: Float32[Tensor, "b 6"]
    goals: Float32[Tensor, "g 6"]
    n_goals: Int32[Tensor, " b"]
    margin: Float32[Tensor, "b 8"]
    key: Int32[Tensor, " b"]
    config: PlanConfig
    execute: ExecConfig

    def __call__(self, path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"]) -> None:
        """RRT-Connect and shortcuts where `length` is 0 and there is a goal; writes `path` and
        `length`.

        Budgets grow from round to round: most searches end within 50 iterations, and a launch is as
        large as its budget's trees. Where the path found then is a long detour the quickest of a
        few searches counts. The host asks twice which rows are left, before the first round and
        after it, and no more: asking waits for a GPU. A problem that has its path already costs
        later rounds and the last searches nothing.
        """
        rows = torch.nonzero((self.n_goals > 0) & (length == 0)).flatten().to(torch.int32)
        with_margin = self._round(rows, 0, path, length)
        self._shorten(rows, self.config.seed, with_margin, path, length)
        rounds = range(1, len(self.config.rounds))
        detour = (length > 0) & (self._time(path, length) > DETOUR_RATIO * self._straight_time())
        unsolved = length == 0
        left = detour | (unsolved if len(rounds) else torch.zeros_like(unsolved))
        rows = torch.nonzero((self.n_goals > 0) & left).flatten().to(torch.int32)
        if not len(rows):
            return
        if len(rounds):
            self._remaining_rounds(rows, rounds, unsolved, path, length)
        for attempt in range(1, DETOUR_RETRIES + 1):
            self._retry_detours(rows, detour, self.config.seed + 100 * attempt, path, length)

    def _remaining_rounds(
        self, rows: Int32[Tensor, " r"], rounds: range, unsolved: Bool[Tensor, " b"],
        path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"],
    ) -> None:  # fmt: skip
        """The other rounds of those `rows` that are `unsolved`, and shortcuts on what they find."""
        found_with = torch.zeros_like(self.margin[:, 0])
        for i in rounds:
            empty = length == 0
            found_with = torch.where(empty, self._round(rows, i, path, length), found_with)
        fresh = torch.where(unsolved, length, 0)
        self._shorten(rows, self.config.seed, found_with, path, fresh)
        length.copy_(torch.where(unsolved, fresh, length))
        self._last_searches(rows, length == 0, path, length)

    def _last_searches(
        self, rows: Int32[Tensor, " r"], unsolved: Bool[Tensor, " b"],
        path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"],
    ) -> None:  # fmt: skip
        """Those `rows` that are `unsolved` after all rounds, once more for each of LAST_SHARES; and shortcuts.

        Beside the hand CERTIFY gives up some tenths of a millimetre of a pair that is settled quickly, and a goal that
        has no more than that to spare can then never be entered: CLOSELY gives up nothing. And a way that is narrower
        than the clearance asked for is a way.
        """
        found_with, budget = torch.zeros_like(self.margin[:, 0]), max(self.config.rounds)
        mode = _closely(edge_mode_of(self.config))
        for k, share in enumerate(LAST_SHARES):
            empty = length == 0
            margin = self._connect(
                rows, budget, self.config.seed + 1000 * (k + 1), RANGE_SHRINK, path, length,
                all_goals=True, share=share, mode=mode,
            )  # fmt: skip
            found_with = torch.where(empty, margin, found_with)
        fresh = torch.where(unsolved, length, 0)
        self._shorten(rows, self.config.seed, found_with, path, fresh, mode=mode)
        length.copy_(torch.where(unsolved, fresh, length))

    def _retry_detours(
        self, rows: Int32[Tensor, " r"], detour: Bool[Tensor, " b"], seed: int,
        path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"],
    ) -> None:  # fmt: skip
        """One more search of those `rows` that are a `detour`; what it finds counts where it is
        quicker.

        Some of these are straight lines themselves: to a goal far away, as the line to a nearer one
        is blocked.
        """
        # a length of 1 stands for "has its path": searches pass over such rows
        other, lengths = path.clone(), torch.where(detour, 0, 1).to(torch.int32)
        margin = self._connect(
            rows, DETOUR_ITERATIONS, seed, RANGE_SHRINK, other, lengths, all_goals=False
        )
        lengths = torch.where(detour, lengths, 0)
        self._shorten(rows, seed, margin, other, lengths)
        quicker = (lengths > 0) & (self._time(other, lengths) < self._time(path, length))
        path.copy_(torch.where(quicker[:, None, None], other, path))
        length.copy_(torch.where(quicker, lengths, length))

    def _round(
        self,
        rows: Int32[Tensor, " r"],
        i: int,
        path: Float32[Tensor, "b w 6"],
        length: Int32[Tensor, " b"],
    ) -> Float32[Tensor, " b"]:
        """Round i of the configured ones. The last takes all goals, and steps of one length: plain
        RRT-Connect."""
        last = i == len(self.config.rounds) - 1
        # other numbers in each round: what begins as the round before would end as it did
        seed = self.config.seed + (0 if last else 10 * i)
        shorter = 1.0 if last else RANGE_SHRINK
        return self._connect(
            rows, self.config.rounds[i], seed, shorter, path, length, all_goals=last
        )

    def _connect(
        self, rows: Int32[Tensor, " r"], iterations: int, seed: int, shorter: float,
        path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"], *, all_goals: bool,
        share: float = 1.0, mode: int | None = None,
    ) -> Float32[Tensor, " b"]:  # fmt: skip
        """One search of those `rows` whose `length` is 0; the hand clearance that paths keep: a `share` of the goals'."""
        b, device = len(path), path.device
        kept, n_kept, margin = goals_for_search(
            self.goals.view(b, BRANCHES, self.goals.shape[-1]),
            self.n_goals,
            share * self.margin,
            all_goals=all_goals,
        )
        # An iteration adds one node to one tree and then as many to the other as it takes to meet
        # or to be blocked; how many is not bounded, so a tree that is full ends the search
        # (`rrt_connect`)
        capacity = 4 * iterations + 16
        inputs = {
            "iterations": iterations,
            "capacity": capacity,
            "range_rad": self.config.range_rad,
            "shorter": shorter,
            "seed": seed,
            "edge_mode": edge_mode_of(self.config) if mode is None else mode,
            "start": self.start,
            "key": self.key,
            "goals": kept.flatten(0, 1),
            "n_goals": n_kept,
            "margin": margin,
        }
        for chunk in rows.split(max(1, _scratch_nodes(device) // (2 * capacity))):
            size = len(chunk) * 2 * capacity
            outputs = {
                "nodes": torch.empty((size, path.shape[2] + 1), dtype=torch.float32, device=device),
                "parents": torch.empty(size, dtype=torch.int32, device=device),
                "path": path,
                "length": length,
            }
            self.planner(
                rrt_connect, len(chunk), inputs=inputs | {"trial": chunk}, outputs=outputs, chunk=1
            )
        return margin

    def _shorten(
        self, rows: Int32[Tensor, " r"], seed: int, margin: Float32[Tensor, " b"],
        path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"], *, mode: int | None = None,
    ) -> None:  # fmt: skip
        """Shortcuts on the paths that `rows` have, as long as they save time under the arm's
        limits; in place."""
        inputs = {
            "tries": self.config.shortcuts,
            "enough": GOOD_ENOUGH_RATIO,
            "pace": pace(self.execute, self.planner.joint_weight),
            "seed": seed,
            "edge_mode": edge_mode_of(self.config) if mode is None else mode,
            "key": self.key,
            "margin": margin,
            "trial": rows,
        }
        outputs = {"path": path, "length": length}
        self.planner(shortcut, len(rows), inputs=inputs, outputs=outputs, chunk=1)

    def _time(self, path: Float32[Tensor, "b w 6"], length: Int32[Tensor, " b"]) -> Tensor:
        """Seconds of each path."""
        return path_time(path, length, self.execute, self.planner.joint_weight)

    def _straight_time(self) -> Tensor:
        """Time of the straight line from the start to that free goal which it reaches soonest, s;
        infinite without one."""
        lines = torch.stack([self.start.repeat_interleave(BRANCHES, 0), self.goals], 1)
        two = torch.full((len(lines),), 2, dtype=torch.int32, device=lines.device)
        time = self._time(lines, two).view(-1, BRANCHES)
        slot = torch.arange(BRANCHES, dtype=torch.int64, device=lines.device)[None]
        return torch.where(slot < self.n_goals[:, None], time, torch.inf).amin(1)


def edge_mode_of(config: PlanConfig) -> int:
    """How the kernels check an edge: CERTIFY, or SAMPLES as MoveIt does."""
    return int(SAMPLES if config.edge_check == "moveit" else CERTIFY)


def _closely(mode: int) -> int:
    """The same check as near as it goes; samples stay samples."""
    return int(CLOSELY) if mode == CERTIFY else mode


def _scratch_nodes(device: torch.device) -> int:
    """How many tree nodes one launch may have: on CUDA a quarter of the memory that is free."""
    if device.type == "cpu":
        return _SCRATCH_NODES
    free, _ = torch.cuda.mem_get_info(device)
    return max(_SCRATCH_NODES, free // 4 // _NODE_BYTES)


def goals_for_search(
    goals: Tensor, n_goals: Tensor, margin: Tensor, *, all_goals: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """The goals that one search may end at, and the hand clearance that all of it keeps.

    A tree has one margin. First only goals that allow (nearly) the widest one; in the last round
    all of them.
    """
    slot = torch.arange(BRANCHES, dtype=torch.int64, device=goals.device)[None]
    there = slot < n_goals[:, None]
    widest = torch.where(there, margin, 0.0).amax(1, keepdim=True)
    # One near goal would lower the margin of the whole tree, and with it that of paths to goals
    # with more room
    use = there & (
        (margin >= 0.9 * widest) | torch.tensor(all_goals, dtype=torch.bool, device=goals.device)
    )
    order = torch.where(use, slot, BRANCHES + slot).argsort(dim=1)
    rows = torch.arange(len(goals), dtype=torch.int64, device=goals.device)[:, None]
    kept_margin = torch.where(use, margin, torch.inf).amin(1)
    return (
        goals[rows, order].contiguous(),
        use.sum(1).to(torch.int32),
        torch.where(there.any(1), kept_margin, 0.0).contiguous(),
    )
