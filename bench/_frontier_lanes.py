"""Lanes and chains of the planner's levels (r2h_batch/judge/frontier/levels.py), counted on a CPU, entry by entry of every queue.

What an entry of a queue costs is the time that COPIES of it take together, less that of an empty launch, the least of REPEATS.
A warp takes 32 entries that follow each other and is busy until its slowest ends, as in _lanes.py. In the kernel of GJK a lane
takes the next pair when its own is done: its warp's costs are iterations (counted) and, while any lane changes its pair, what
that takes (fitted), for all of its lanes. A stage's chain is the sum of its launches' slowest entries. Of long launches every
so-manieth warp is looked at.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np

from r2h_batch.judge import search
from r2h_batch.judge.frontier import levels, safe
from r2h_batch.kernels.frontier import queues, safe_queues, trees
from r2h_batch.kernels.plan import codes
from r2h_batch.launch import launch_trials

WARP, COPIES, REPEATS = 32, 32, 3
REPEATS_ALONE = 12
"""Of what runs alone, and so costs less than the call: the least of more."""
PAIRS_A_LANE = 8
"""Pairs that a lane takes one after the other, in the model: a full GPU's lanes have as many with some hundred thousand pairs."""
WARPS = 64
"""Warps of one launch that are looked at, spread over all of it."""
ONCE = ("enter_edges", "take_arcs")
"""Kernels that change what they read: all entries run in their order, from the same state each time."""
BY_ASKER = {"draw_targets": 1, "nearest_nodes": int(trees.SLICES), "next_edges": 1, "draw_arcs": 1}
"""Kernels with so many entries for each lane that asks for an edge."""
CHANGE = 0.5
"""What the change to another pair takes at least, in iterations of GJK: a fit of so little says nothing."""
BY_INTERVAL = {"interval_frames": 1, "halve": 1, "clear_links": 9, "safe_frames": 1, "safe_halves": 1, "safe_links": 8}
"""Kernels with so many entries an interval."""
PART_BY_PART = ("clear_links",)
"""Of those the kernels whose queue holds the first entries of all intervals, then the second ones; the others go by interval."""
STAGES = (
    (levels.Frontier, "check", "check_postures"),
    (levels.Frontier, "straight", "straight_lines"),
    (levels.Frontier, "clearance", "path_clearance"),
    (search, "connect_by_frontier", "rrt_connect"),
    (search, "shorten_by_frontier", "shortcut"),
    (safe.SafeFrontier, "__call__", "safe_distance"),
)
GJK = ("pair_distances", "hull_distances", "face_distances")
BY_QUEUE = {
    "settle_pairs": ("pairs", queues.PAIRS),
    "pair_distances": ("pairs", queues.PAIRS),
    "safe_first_points": ("queue_bodies", safe_queues.BODIES),
    "safe_pieces": ("queue_bodies", safe_queues.BODIES),
    "safe_insides": ("queue_bodies", safe_queues.BODIES),
    "hull_distances": ("pieces", safe_queues.PIECES),
    "safe_hulls": ("pieces", safe_queues.PIECES),
    "safe_corners": ("sets", safe_queues.SETS),
    "safe_faces": ("sets", safe_queues.SETS),
    "face_distances": ("faces", safe_queues.FACES),
    "settle_faces": ("faces", safe_queues.FACES),
}
"""Which queue a kernel's entries are of, and its place in the counts."""
CHANGED = (
    ("frames", "open"),
    ("edges", "found"),
    ("edges", "left"),
    *(("growers", x) for x in ("near", "origin", "nearest", "reached", "target")),
    *(("arcs", x) for x in ("kind", "lo", "hi", "n", "time", "point")),
    ("counts", "n"),
    ("nearest", "distance"),
    ("nearest", "place"),
)
"""What an entry changes outside of its own rows."""
BY_BODY = {
    "near_hand": codes.HAND,
    "near_pieces": queues.PIECES,
    "near_table": codes.TABLE,
    "near_bodies": codes.SELF,
}


class Counted:
    """Costs (us) of each kernel's entries (whole warps, one after the other), launch by launch; of GJK iterations."""

    def __init__(self) -> None:
        self.stage = ""
        # each launch counts by its entries, of which some are looked at
        self.costs: dict[str, dict[str, list[tuple[float, np.ndarray]]]] = defaultdict(lambda: defaultdict(list))
        self.pairs: dict[str, list[tuple[str, np.ndarray, np.ndarray]]] = defaultdict(list)  # iterations, and whose
        self._timed: dict[str, list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
        self._queue: dict[str, Any] = {}

    def launch(
        self, kernel: Any, n: int, *, inputs: Mapping[str, Any], outputs: Mapping[str, Any], **ways: Any
    ) -> None:
        """As `launch_trials`; counts first, then runs."""
        if "queue" in inputs:
            self._queue = _tensors(inputs["queue"])
        if kernel.key in ONCE:
            self.costs[self.stage][kernel.key].append((1.0, _once(kernel, n, inputs, outputs)))
            return
        rows = _rows(kernel.key, inputs)
        if rows is not None and rows.entries:
            queue = _Copied(kernel, inputs, outputs, rows)
            every = max(1, rows.entries // (WARP * WARPS))
            looked = [i for i in range(rows.entries) if i // WARP % every == 0]
            if kernel.key in GJK:
                some = np.array(looked[:: max(1, len(looked) // 200)])
                us = np.array([queue.cost(i) for i in some])
                queue.restore()
                launch_trials(kernel, n, inputs=inputs, outputs=outputs, **ways)
                (pairs,) = rows.tables
                steps = pairs["steps"][: rows.entries].numpy().astype(float)
                self.pairs[self.stage].append((kernel.key, steps, self._owners(inputs, pairs, rows.entries)))
                self._timed[kernel.key].append((steps[some], us))
                return
            costs = np.array([queue.cost(i) for i in looked])
            self.costs[self.stage][kernel.key].append((rows.entries / len(looked), costs))
            queue.restore()
        launch_trials(kernel, n, inputs=inputs, outputs=outputs, **ways)

    def _owners(self, inputs: Mapping[str, Any], pairs: Mapping[str, Any], n: int) -> np.ndarray:
        """Whose each pair is: the path's or the edge's, the trial's."""
        if "of" in pairs:
            interval = _tensors(inputs["queue_bodies"])["interval"][pairs["of"][:n].long()]
            owner = self._queue["trial"][interval.long()]
        else:
            owner = _tensors(inputs["edges"])["owner"][self._queue["edge"][pairs["interval"][:n].long()].long()]
        owners: np.ndarray = owner.numpy().copy()
        return owners

    def labelled(self, stage: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """`call`, with what it launches counted as that stage's."""

        def labelled(*args: Any, **kwargs: Any) -> Any:
            before, self.stage = self.stage, stage
            try:
                return call(*args, **kwargs)
            finally:
                self.stage = before

        return labelled

    def pair_costs(self, kernel: str) -> tuple[float, float]:
        """us of one iteration, and of the change to another pair (fitted)."""
        steps, us = (np.concatenate(x) for x in zip(*self._timed[kernel], strict=True))
        slope, rest = np.polyfit(steps, us, 1)
        return float(slope), max(float(rest), CHANGE * float(slope))

    def stages(self) -> list[str]:
        return list(self.costs)

    def of_stage(self, stage: str) -> tuple[float, float]:
        """Share of the lanes' time in which they work, in all kernels of a stage; its longest chain, us."""
        work = waited = chain = 0.0
        for launches in self.costs[stage].values():
            for weight, cost in launches:
                work += weight * cost.sum()
                waited += weight * WARP * np.pad(cost, (0, -len(cost) % WARP)).reshape(-1, WARP).max(1).sum()
                chain += cost.max(initial=0.0)
        for kernel, steps, _ in self.pairs[stage]:
            step_us, change_us = self.pair_costs(kernel)
            done, took, _ = persistent(steps, step_us, change_us, -(-len(steps) // (WARP * PAIRS_A_LANE)))
            work, waited, chain = work + done, waited + took, chain + steps.max() * step_us + change_us
        return work / waited, chain

    def of_gjk(self) -> tuple[float, float, float]:
        """The same share in GJK alone: as it is; with a thread for each pair; with a warp for the pairs of each problem."""
        shares = np.zeros((3, 2))
        for kernel, steps, owner in (x for stage in self.pairs.values() for x in stage):
            step_us, change_us = self.pair_costs(kernel)
            shares[0] += persistent(steps, step_us, change_us, -(-len(steps) // (WARP * PAIRS_A_LANE)))[:2]
            alone = np.pad(steps, (0, -len(steps) % WARP)).reshape(-1, WARP)
            shares[1] += step_us * steps.sum(), step_us * WARP * alone.max(1).sum()
            for one in np.unique(owner):
                shares[2] += persistent(steps[owner == one], step_us, change_us, 1)[:2]
        whole, thread, warp = shares[:, 0] / shares[:, 1]
        return float(whole), float(thread), float(warp)


def _once(kernel: Any, n: int, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> np.ndarray:
    """Costs of entries that run one after the other; what the call itself takes is the least of all."""
    structs = (
        [_tensors(x).values() for x in inputs.values() if hasattr(x, "_cls") and "tensors" in vars(x)] if n else []
    )
    written = [*outputs.values(), *(x for tensors in structs for x in tensors)]
    before = [x.clone() for x in written]
    cost = np.full(n, np.inf)
    for _ in range(REPEATS_ALONE):
        for x, saved in zip(written, before, strict=True):
            x.copy_(saved)
        for i in range(n):
            start = time.thread_time_ns()
            launch_trials(kernel, 1, inputs=inputs, outputs=outputs, device="cpu", threads=1, first=i)
            cost[i] = min(cost[i], (time.thread_time_ns() - start) / 1e3)
    least: np.ndarray = cost - cost.min(initial=np.inf)
    return least


class _Rows:
    """Entries of a launch, and the tensors that have a row for each."""

    def __init__(
        self, entries: int, tables: list[dict[str, Any]], counter: int, start: int = 0, per_row: int = 1,
        part_by_part: bool = False,
    ) -> None:  # fmt: skip
        self.entries, self.tables, self.counter, self.start, self.per_row = entries, tables, counter, start, per_row
        self.part_by_part = part_by_part


def _tensors(struct: Any) -> dict[str, Any]:
    found: dict[str, Any] = vars(struct)["tensors"]
    return found


def _rows(name: str, inputs: Mapping[str, Any]) -> _Rows | None:
    if name not in (*BY_INTERVAL, *BY_BODY, *BY_QUEUE, *BY_ASKER):
        return None
    counts = _tensors(inputs["counts"])["n"]
    if name in BY_ASKER:
        asking = _tensors(inputs["arcs" if "arcs" in inputs else "growers"])["asking"]
        per_row = BY_ASKER[name]
        return _Rows(int(counts[queues.ASKED]) * per_row, [{"asking": asking}], queues.ASKED, 0, per_row)
    if name in BY_INTERVAL:
        which, per_row = queues.NOW + inputs["parity"], BY_INTERVAL[name]
        tables = [_tensors(inputs["queue"]), _tensors(inputs["frames"])]
        return _Rows(int(counts[which]) * per_row, tables, which, 0, per_row, name in PART_BY_PART)
    if name in BY_BODY:
        which = queues.BODIES + BY_BODY[name]
        table = _tensors(inputs["queue_bodies"])
        return _Rows(int(counts[which]), [table], which, BY_BODY[name] * (len(table["interval"]) // int(queues.KINDS)))
    queue, which = BY_QUEUE[name]
    return _Rows(int(counts[which]), [_tensors(inputs[queue])], which)


class _Copied:
    """A launch whose queue begins with COPIES of one entry; `restore` puts everything back as it was."""

    def __init__(self, kernel: Any, inputs: Mapping[str, Any], outputs: Mapping[str, Any], rows: _Rows) -> None:
        self._rows, self._counts = rows, _tensors(inputs["counts"])["n"]
        self._counts_before = self._counts.clone()
        self._changed = [_tensors(inputs[x])[name] for x, name in CHANGED if x in inputs]
        self._before = [x.clone() for x in self._changed]
        self._arrays = [x.numpy() for table in rows.tables for x in table.values()]
        lo = rows.start
        self._saved = [x[lo : lo + COPIES].copy() for x in self._arrays]
        self._copies = min(len(x) for x in self._saved)  # a queue for fewer has no room for more
        # part by part one launch has COPIES threads that take one entry each, interval by interval one that takes a part of each
        n = COPIES if rows.part_by_part else 1
        lanes = {"lanes": n * rows.per_row} if "lanes" in inputs else {}
        self._launch: Callable[[int], None] = lambda part: launch_trials(
            kernel, n, inputs={**inputs, **lanes}, outputs=outputs, device="cpu", threads=1, first=n * part
        )
        self._empty = min(self._time(0, 0) for _ in range(20))

    def _time(self, part: int, copies: int) -> float:
        self._counts.copy_(self._counts_before)
        self._counts[queues.TAKEN] = 0
        self._counts[self._rows.counter] = copies
        start = time.thread_time_ns()
        self._launch(part)
        return (time.thread_time_ns() - start) / 1e3

    def cost(self, i: int) -> float:
        """us of entry i."""
        rows, each = self._rows.entries // self._rows.per_row, self._rows.per_row
        part, at = (i // rows, i % rows) if self._rows.part_by_part else (i % each, i // each)
        row = self._rows.start + at
        for x, saved in zip(self._arrays, self._saved, strict=True):
            x[self._rows.start : self._rows.start + COPIES] = saved[at] if at < COPIES else x[row]
        return max(min(self._time(part, self._copies) for _ in range(REPEATS)) - self._empty, 0.0) / self._copies

    def restore(self) -> None:
        for x, saved in zip(self._arrays, self._saved, strict=True):
            x[self._rows.start : self._rows.start + COPIES] = saved
        for x, before in zip(self._changed, self._before, strict=True):
            x.copy_(before)


def persistent(steps: np.ndarray, step_us: float, change_us: float, warps: int) -> tuple[float, float, float]:
    """Lanes' work, their time together, and the longest warp's, when each lane takes the next entry once it is free (us)."""
    work = steps.sum() * step_us + len(steps) * change_us
    lanes = np.zeros((warps, WARP))  # iterations left of each lane's pair
    at, took = 0, np.zeros(warps)
    while at < len(steps) or lanes.any():
        for w in range(warps):
            free = np.flatnonzero(lanes[w] == 0)
            fresh = free[: len(steps) - at]
            lanes[w, fresh] = steps[at : at + len(fresh)]
            at += len(fresh)
            if len(fresh):
                took[w] += change_us
            if lanes[w].any():
                took[w] += step_us
        lanes = np.maximum(lanes - 1, 0)
    return work, WARP * took.sum(), took.max()


@contextmanager
def counting() -> Iterator[Counted]:
    """Levels run inside are counted."""
    seen = Counted()
    with ExitStack() as stack:
        for module in (levels, safe):
            stack.enter_context(mock.patch.object(module, "launch_trials", seen.launch))
        for owner, name, stage in STAGES:
            stack.enter_context(mock.patch.object(owner, name, seen.labelled(stage, getattr(owner, name))))
        yield seen
