"""Postures, straight lines and clearances level by level: the planner's form for a GPU
(docs/gpu.md). It runs on a CPU too.

A level is one level of the bisection of all edges at once, in nine launches (kernels/frontier/). A
bisection has a fixed number of levels, so the host launches all of them and never waits for the
device; launches with empty queues do nothing. The results are those of plan/lines.py, one thread a
trial: the same goals and lines, clearances within the tolerance of both.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32, Int64
from torch import Tensor

from r2h_batch.base.launch import launch_trials
from r2h_batch.base.launch.arguments import new_struct, parameters, struct_of
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.config import CLEARANCE_CAP_M, CLEARANCE_TOLERANCE_M
from r2h_batch.kernels.frontier import queues
from r2h_batch.kernels.frontier.bodies import (
    clear_links,
    near_bodies,
    near_hand,
    near_pieces,
    near_table,
)
from r2h_batch.kernels.frontier.intervals import halve, interval_frames, queue_edges, queue_paths
from r2h_batch.kernels.frontier.pairs import pair_distances
from r2h_batch.kernels.frontier.settle import settle_pairs
from r2h_batch.kernels.geometry.bisection import MAX_LEVEL
from r2h_batch.kernels.plan.codes import BRANCHES, CERTIFY, PAIR_OF_OBJECT, POSTURE, SAMPLES
from r2h_batch.kernels.plan.lines import CLEARANCE_CAP

LANES, CUDA_LANES = 1, 1 << 16
"""Threads of a launch on a CPU and on CUDA; thread i takes entries i, i + threads, ... of a queue."""
PER_ROW, LEAST = 16, 1 << 16
"""Intervals that the queue has room for: a number for each row of the batch, and a least number.
Where that is too little half the rows have twice as much each (r2h_batch.base.launch.memory). The
hardest single rows need more than 4,096."""
BODIES_PER_INTERVAL, PAIRS_PER_INTERVAL = 8, 6
SEGMENTS_PER_ROW, LEAST_SEGMENTS, SEGMENTS_AT_ONCE = 4, 1 << 10, 32
NO_PAIR = 0x7FFFFFFF
NONE = (NO_PAIR << 32) | NO_PAIR
"""Key of an edge that nothing blocks (kernels/frontier/queues.py)."""

TOO_SHORT = "cannot allocate a longer queue of intervals: fewer rows at once have more room each"


@dataclass(frozen=True)
class Lines:
    """Straight lines from `a` to `b` (rad) of `trial`s; `owner`: the row of the result that each
    belongs to."""

    trial: Int32[Tensor, " e"]
    owner: Int32[Tensor, " e"]
    a: Float32[Tensor, "e 6"]
    b: Float32[Tensor, "e 6"]
    hand_margin: Float32[Tensor, " e"]


class Levels:
    """Kernels that take what they need of `tables`, and the queues that they fill on a device.

    `full` is 1 once a queue was too short: then nothing that came out counts (`refuse_if_full`).
    """

    def __init__(self, tables: dict[str, Any], device: str) -> None:
        self.device, self.joints = device, tables["world"].joint_R.shape[0]
        self.lanes = LANES if device == "cpu" else CUDA_LANES
        self.full = torch.zeros(1, dtype=torch.int32, device=device)
        self.counts = torch.zeros(int(queues.COUNTS), dtype=torch.int32, device=device)
        self.tables = tables | {"counts": struct_of(self._sized(queues.Counts), {"n": self.counts})}

    def launch(
        self,
        kernel: Any,
        n: int,
        inputs: dict[str, Any] | None = None,
        outputs: dict[str, Any] | None = None,
    ) -> None:
        """With what the kernel takes of `tables`; on a CPU one thread, as its additions are not
        atomic. Thread i of n `lanes` takes entries i, i+n, i+2n of the kernel's queue."""
        kernel = self._sized(kernel)
        taken = {k: v for k, v in self.tables.items() if k in _taken(kernel)} | (inputs or {})
        ways: dict[str, Any] = {"device": self.device, "threads": 1, "uneven": True}
        launch_trials(kernel, n, inputs=taken, outputs=outputs or {}, **ways)

    def new(self, kind: Any, n: int, tensors: dict[str, Tensor] | None = None, **sizes: int) -> Any:
        """A struct of the kernels, with room for `n` entries (`new_struct`)."""
        return new_struct(kind, n, self.device, tensors, **sizes)

    def new_frames(self, n: int) -> Any:
        """Room for the link frames of n intervals."""
        joints, frames = self.joints, self.joints + 1
        sizes = {"d": joints, "open": 3, "R": frames, "p": frames, "w": 2 * frames, "v": 2 * frames}
        return self.new(self._sized(queues.Frames), n, **sizes)

    def _sized(self, thing: Any) -> Any:
        """A kernel or struct that depends on the number of joints (all of queues.py, none of
        safe_queues.py), for this arm."""
        return of_joints(thing, self.joints)

    def clear(self) -> None:
        """Empties all queues."""
        self.counts.zero_()

    def note_full(self) -> None:
        """Keeps in mind that a queue was too short."""
        self.full |= self.counts[queues.FULL : queues.FULL + 1]

    def refuse_if_full(self) -> None:
        """Raises MemoryError when a queue was too short since these levels were made; on a GPU the
        host waits for that."""
        if int(self.full):
            raise MemoryError(TOO_SHORT)

    def rows_where(self, mask: Bool[Tensor, " b"]) -> Int32[Tensor, " r"]:
        """Numbers of the rows that `mask` has, and `refuse_if_full`, for one wait."""
        found = torch.nonzero(torch.cat([mask, self.full.bool().expand(len(mask) + 1)])).flatten()
        if len(found) > len(mask):
            raise MemoryError(TOO_SHORT)
        return found.to(torch.int32)


@cache
def _taken(kernel: Any) -> frozenset[str]:
    """Names of a kernel's inputs."""
    return frozenset(p.name for p in parameters(kernel) if not p.written)


class Frontier(Levels):
    """Levels over `rows` trials; `world` and `bodies` (`scene`) as the planning kernels take them."""

    def __init__(self, world: Any, bodies: Any, device: str, rows: int) -> None:
        super().__init__({"world": world, "bodies": bodies}, device)
        self._room = max(PER_ROW * rows, LEAST)
        self.tables |= self._queues(self._room)

    def _queues(self, n: int) -> dict[str, Any]:
        """Room for n intervals."""
        self.intervals = [self.new(self._sized(queues.Intervals), n, look=3) for _ in range(2)]
        bodies = int(queues.KINDS) * BODIES_PER_INTERVAL * n
        return {
            "frames": self.new_frames(n),
            "body_queue": self.new(self._sized(queues.BodyQueue), bodies),
            "pairs": self.new(self._sized(queues.Pairs), PAIRS_PER_INTERVAL * n),
            "lanes": self.lanes,
        }

    def check(
        self, q: Float32[Tensor, "n 6"], active: Bool[Tensor, " n"], per_trial: int
    ) -> tuple[Bool[Tensor, " n"], Int32[Tensor, " n"], Float32[Tensor, " n"]]:
        """As plan/lines.py `check_postures`: free or not, the pair that collides, the hand
        clearance up to CLEARANCE_CAP."""
        room, trial = self._room // 2, self._arange(len(q)) // per_trial
        chunks = [
            self._check(*(x[i : i + room] for x in (q, active, trial)))
            for i in range(0, len(q), room)
        ]
        clear, pair, least = (
            torch.cat(x) if len(chunks) > 1 else x[0] for x in zip(*chunks, strict=True)
        )
        self._refuse_at_once()
        return clear, pair, least

    def _check(self, q: Tensor, active: Tensor, trial: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lines = Lines(trial, self._arange(len(q)), q, q, torch.zeros_like(q[:, 0]))
        blocked = self._blocked(lines, active, POSTURE)
        clear = active & (blocked == NONE)
        found = torch.full_like(blocked, cap_key(float(CLEARANCE_CAP)))
        self.ask(1, 0.0)
        self._run(self.edges(lines, found), clear, POSTURE, hand_only=1)
        least, _, _ = self._read(found)
        _, pair, _ = self._read(blocked)
        return clear, pair, torch.where(clear, least, 0.0)

    def straight(
        self, start: Float32[Tensor, "b 6"], goals: Float32[Tensor, "g 6"], n_goals: Int32[Tensor, " b"],
        margin: Float32[Tensor, "b 8"], mode: int,
    ) -> Int32[Tensor, " b"]:  # fmt: skip
        """As plan/lines.py `straight_lines`: the first goal whose straight line from the start is free,
        or -1.

        The nearest goals first, then all others of those trials whose nearest one is no straight
        line away.
        """
        b = len(n_goals)
        rows = self._arange(b * BRANCHES)
        starts = start.repeat_interleave(BRANCHES, 0)
        lines = Lines(rows // BRANCHES, rows, starts, goals, margin.reshape(-1))
        slot = self._arange(BRANCHES)[None]
        there = slot < n_goals[:, None]
        nearest = there & (slot == 0)
        free = nearest & (self._blocked(lines, nearest.reshape(-1), mode).view(b, BRANCHES) == NONE)
        others = there & ~nearest & ~free[:, :1]
        free |= others & (self._blocked(lines, others.reshape(-1), mode).view(b, BRANCHES) == NONE)
        self._refuse_at_once()
        return torch.where(free, slot, BRANCHES).amin(1).where(free.any(1), -1).to(torch.int32)

    def clearance(
        self,
        path: Float32[Tensor, "b w 6"],
        length: Int32[Tensor, " b"],
        tolerance: float = CLEARANCE_TOLERANCE_M,
        without: float = -math.inf,
        cap_m: float = CLEARANCE_CAP_M,
    ) -> tuple[Float32[Tensor, " b"], Int32[Tensor, " b"], Int32[Tensor, " b"]]:
        """As plan/lines.py `path_clearance`: `without` a path that, and -1; the pair, and the robot's body.

        The goals' postures first: they are mostly the tightest, so few others need a check.
        Then the segments, of long paths (motions, sample by sample) so many at a time from the end
        on.
        """
        b, segments = path.shape[0], path.shape[1] - 1
        at_once = min(max(segments, 1), SEGMENTS_AT_ONCE)
        rows = self._arange(b)
        found = torch.full((b,), cap_key(cap_m), dtype=torch.int64, device=self.device)
        goal = path[rows.long(), (length - 1).clamp(min=0).long()]
        room = max((SEGMENTS_PER_ROW if segments == at_once else at_once) * b, LEAST_SEGMENTS)
        lines = Lines(rows, rows, goal, goal, torch.zeros_like(goal[:, 0]))
        edges = self.edges(lines, found, more=room)
        self.ask(1, tolerance)
        self._run(edges, length > 0, POSTURE)
        for first in reversed(range(0, segments, at_once)):
            some = {"path": path, "length": length}
            if segments > at_once:
                chunk = path[:, first : first + at_once + 1].contiguous()
                some = {"path": chunk, "length": (length - first).clamp(min=0, max=chunk.shape[1])}
            self.clear()
            self.tables |= {"parity": 0, "edges": edges, "queue": self.intervals[0]}
            self.launch(queue_paths, b, {"row": b, **some})
            self._all_frontier(edges, MAX_LEVEL, certify=0)
        least, pair, body = self._read(found)
        self._refuse_at_once()
        found = length > 0
        return torch.where(found, least, without), pair, torch.where(found, body, -1)

    def ask(self, aim: int, tolerance: float) -> None:
        """Aim of the next levels: the smallest clearance (1), to `tolerance`, or whether margins
        are kept (0)."""
        self.tables |= {"aim": aim, "tolerance": tolerance}

    def _refuse_at_once(self) -> None:
        """On a CPU, where asking costs nothing; on a GPU planning asks at its end."""
        if self.device == "cpu":
            self.refuse_if_full()

    def _blocked(self, lines: Lines, used: Bool[Tensor, " e"], mode: int) -> Int64[Tensor, " e"]:
        """For each line of its own owner the key of the first pair that blocks it, NONE where it is
        free."""
        found = torch.full((len(lines.trial),), NONE, dtype=torch.int64, device=self.device)
        self.ask(0, 0.0)
        self._run(self.edges(lines, found), used, mode)
        return found

    def edges(self, lines: Lines, found: Tensor, *, more: int = 0) -> Any:
        """The lines as kernels take them, with room for more of them."""
        tensors = {x: getattr(lines, x) for x in ("trial", "owner", "a", "b", "hand_margin")}
        if more:
            tensors = {
                k: torch.cat([x, x.new_empty((more, *x.shape[1:]))]) for k, x in tensors.items()
            }
        columns = {k: x.contiguous() for k, x in tensors.items()} | {"found": found}
        return self.new(self._sized(queues.Edges), len(columns["trial"]), columns)

    def _run(self, edges: Any, used: Tensor, mode: int, *, hand_only: int = 0) -> None:
        """Queues the edges in use, and runs all levels that they may need."""
        self.clear()
        self.tables |= {"parity": 0, "edges": edges, "queue": self.intervals[0]}
        inputs = {"mode": mode, "hand_only": hand_only, "used": used.contiguous()}
        self.launch(queue_edges, len(used), inputs)
        single = mode in (POSTURE, SAMPLES)
        self._all_frontier(edges, 1 if single else MAX_LEVEL, certify=int(mode == CERTIFY))

    def _all_frontier(self, edges: Any, n: int, *, certify: int) -> None:
        for level in range(n):
            self.level(edges, level & 1, certify=certify)
        self.note_full()

    def level(self, edges: Any, parity: int, *, certify: int) -> None:
        """One level of all intervals that are queued in `intervals[parity]`."""
        now, later = self.intervals[parity], self.intervals[1 - parity]
        self.tables |= {"edges": edges, "queue": now, "later": later}
        self.tables |= {"parity": parity, "certify": certify}
        for kernel in (
            interval_frames, clear_links, near_hand, near_pieces, near_table, near_bodies,
            pair_distances, settle_pairs, halve,
        ):  # fmt: skip
            self.launch(kernel, self.lanes)

    def _read(self, found: Int64[Tensor, " o"]) -> tuple[Tensor, Tensor, Tensor]:
        """Value, CollidingPair and body of keys."""
        value = (found >> 32).to(torch.int32)
        value = torch.where(value < 0, -value | -(1 << 31), value).view(torch.float32)
        order = found & NO_PAIR
        body = torch.where(order >= NO_PAIR - 1, -1, order // 1024)
        pair = order % 1024 // 256 + 1
        hull = body >= self.tables["world"].n_robot
        pair = torch.where(hull, pair + int(PAIR_OF_OBJECT), pair)
        return value, torch.where(body < 0, 0, pair).to(torch.int32), body.to(torch.int32)

    def _arange(self, n: int) -> Int32[Tensor, " n"]:
        return torch.arange(n, dtype=torch.int32, device=self.device)


def cap_key(cap: float) -> int:
    """Key of a clearance that no pair is nearer than; `cap` above 0."""
    return (int(np.float32(cap).view(np.int32)) << 32) | NO_PAIR
