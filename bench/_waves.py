"""Lanes and chains of the planner's waves (r2h_batch/judge/waves.py), counted on a CPU, entry by entry of every queue.

What an entry of a queue costs is the time that COPIES of it take together, less that of an empty launch, the least of REPEATS.
A warp takes 32 entries that follow each other and is busy until its slowest ends, as in _lanes.py. In the kernel of GJK a lane
takes the next pair when its own is done: its warp's costs are iterations (counted) and, while any lane changes its pair, what
that takes (fitted), for all of its lanes. A stage's chain is the sum of its launches' slowest entries. Of long launches every
so-manieth warp is looked at.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np

from r2h_batch.judge import waves
from r2h_batch.kernels.wave import queues
from r2h_batch.launch import launch_trials

WARP, COPIES, REPEATS = 32, 32, 3
WARPS = 40
"""Warps of one launch that are looked at, spread over all of it."""
BY_STRETCH = ("stretch_frames", "halve", "clear_links")
BY_BODY = {"near_pieces": queues.HAND, "near_table": queues.TABLE, "near_bodies": queues.SELF}


class Waved:
    """Costs (us) of each kernel's entries (whole warps, one after the other), launch by launch; of GJK iterations."""

    def __init__(self) -> None:
        self.costs: dict[str, list[np.ndarray]] = defaultdict(list)
        self.pairs: list[tuple[np.ndarray, np.ndarray]] = []  # iterations, and whose edges
        self._timed: list[tuple[np.ndarray, np.ndarray]] = []

    def launch(
        self, kernel: Any, n: int, *, inputs: Mapping[str, Any], outputs: Mapping[str, Any], **ways: Any
    ) -> None:
        """As `launch_trials`; counts first, then runs."""
        rows = _rows(kernel.key, inputs)
        if rows is not None and rows.entries:
            queue = _Copied(kernel, inputs, outputs, rows)
            every = max(1, rows.entries // (WARP * WARPS))
            looked = [i for i in range(rows.entries) if i // WARP % every == 0]
            if kernel.key == "pair_distances":
                some = np.array(looked[:: max(1, len(looked) // 200)])
                us = np.array([queue.cost(i) for i in some])
                queue.restore()
                launch_trials(kernel, n, inputs=inputs, outputs=outputs, **ways)
                (pairs,) = rows.tables
                steps = pairs["steps"][: rows.entries].numpy().astype(float)
                self.pairs.append((steps, _owners(inputs, pairs, rows.entries)))
                self._timed.append((steps[some], us))
                return
            self.costs[kernel.key].append(np.array([queue.cost(i) for i in looked]))
            queue.restore()
        launch_trials(kernel, n, inputs=inputs, outputs=outputs, **ways)

    def pair_costs(self) -> tuple[float, float]:
        """us of one iteration, and of the change to another pair (fitted)."""
        steps, us = (np.concatenate(x) for x in zip(*self._timed, strict=True))
        slope, rest = np.polyfit(steps, us, 1)
        return float(slope), max(float(rest), 0.0)


class _Rows:
    """Entries of a launch, and the tensors that have a row for each."""

    def __init__(
        self, entries: int, tables: list[dict[str, Any]], counter: int, start: int = 0, per_row: int = 1
    ) -> None:
        self.entries, self.tables, self.counter, self.start, self.per_row = entries, tables, counter, start, per_row


def _tensors(struct: Any) -> dict[str, Any]:
    found: dict[str, Any] = vars(struct)["tensors"]
    return found


def _rows(name: str, inputs: Mapping[str, Any]) -> _Rows | None:
    if name not in (*BY_STRETCH, *BY_BODY, "pair_distances", "settle_pairs"):
        return None
    counts = _tensors(inputs["counts"])["n"]
    if name in BY_STRETCH:
        per_row = 9 if name == "clear_links" else 1
        which = queues.NOW + inputs["parity"]
        return _Rows(
            int(counts[which]) * per_row, [_tensors(inputs["queue"]), _tensors(inputs["frames"])], which, 0, per_row
        )
    if name in BY_BODY:
        which = queues.BODIES + BY_BODY[name]
        table = _tensors(inputs["queue_bodies"])
        return _Rows(int(counts[which]), [table], which, BY_BODY[name] * (len(table["stretch"]) // 3))
    return _Rows(int(counts[queues.PAIRS]), [_tensors(inputs["pairs"])], queues.PAIRS)


def _owners(inputs: Mapping[str, Any], pairs: Mapping[str, Any], n: int) -> np.ndarray:
    edge = _tensors(inputs["queue"])["edge"][pairs["stretch"][:n].long()]
    owners: np.ndarray = _tensors(inputs["edges"])["owner"][edge.long()].numpy()
    return owners.copy()


class _Copied:
    """A launch whose queue begins with COPIES of one entry; `restore` puts everything back as it was."""

    def __init__(self, kernel: Any, inputs: Mapping[str, Any], outputs: Mapping[str, Any], rows: _Rows) -> None:
        self._rows, self._stretch_open = rows, _tensors(inputs["frames"])["open"]
        self._found = _tensors(inputs["edges"])["found"]
        self._left = _tensors(inputs["edges"])["left"]
        self._counts = _tensors(inputs["counts"])["n"]
        self._before = [x.clone() for x in (self._stretch_open, self._found, self._left, self._counts)]
        self._arrays = [x.numpy() for table in rows.tables for x in table.values()]
        lo = rows.start
        self._saved = [x[lo : lo + COPIES].copy() for x in self._arrays]
        lanes = {"lanes": rows.per_row} if "lanes" in inputs else {}
        self._launch: Callable[[int], None] = lambda first: launch_trials(
            kernel, 1, inputs={**inputs, **lanes}, outputs=outputs, device="cpu", threads=1, first=first
        )
        self._empty = min(self._time(0, 0) for _ in range(20))

    def _time(self, first: int, copies: int) -> float:
        self._counts.copy_(self._before[3])
        self._counts[queues.TAKEN] = 0
        self._counts[self._rows.counter] = copies
        start = time.thread_time_ns()
        self._launch(first)
        return (time.thread_time_ns() - start) / 1e3

    def cost(self, i: int) -> float:
        """us of entry i."""
        row = self._rows.start + i // self._rows.per_row
        at = i // self._rows.per_row
        for x, saved in zip(self._arrays, self._saved, strict=True):
            x[self._rows.start : self._rows.start + COPIES] = saved[at] if at < COPIES else x[row]
        return max(min(self._time(i % self._rows.per_row, COPIES) for _ in range(REPEATS)) - self._empty, 0.0) / COPIES

    def restore(self) -> None:
        for x, saved in zip(self._arrays, self._saved, strict=True):
            x[self._rows.start : self._rows.start + COPIES] = saved
        for x, before in zip((self._stretch_open, self._found, self._left, self._counts), self._before, strict=True):
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
def counting() -> Iterator[Waved]:
    """Waves run inside are counted."""
    seen = Waved()
    with mock.patch.object(waves, "launch_trials", seen.launch):
        yield seen
