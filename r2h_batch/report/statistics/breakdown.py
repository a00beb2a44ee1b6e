"""Other views of a run's rows: by object, criteria that fail together, histograms, examples."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from r2h_batch.report.statistics.aggregate import Row, object_rows
from r2h_batch.report.statistics.codes import FAILED, UNEVALUATED, codes, states
from r2h_batch.report.statistics.tally import Tally
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import UNITS


@dataclass(frozen=True)
class CoFailures:
    """Counts (C, C) in the order of `Tally.judged`: trials in which both criteria fail, and trials in
    which both were evaluated.

    The diagonal counts each criterion wherever it was evaluated, not only where it was the first
    failure.
    """

    failed: np.ndarray
    evaluated: np.ndarray


def co_failures(counted: Tally, split: str | None = None) -> CoFailures:
    """Which criteria fail together among the trials of a split, or among all."""
    groups = (counted if split is None else counted.of_split(split)).groups
    found = states(groups)
    state = np.column_stack([found[name] for name in counted.judged])
    n = groups["n"].to_numpy()
    both = [np.einsum("k,ki,kj->ij", n, x, x) for x in (state == FAILED, state != UNEVALUATED)]
    return CoFailures(*both)


def by_object(counted: Tally) -> tuple[tuple[str, Row], ...]:
    """(object, its line of the table) split by split; objects in alphabetical order."""
    rows = {split: object_rows(counted, split) for split in counted.splits}
    return tuple((name, by_name[name]) for by_name in rows.values() for name in sorted(by_name))


BINS = 60


@dataclass(frozen=True)
class Histogram:
    """Counts (BINS,) between `low` and `high`; values outside count in the first and last bin."""

    low: float
    high: float
    counts: np.ndarray

    @property
    def edges(self) -> np.ndarray:
        return np.linspace(self.low, self.high, len(self.counts) + 1)


def _histogram(values: np.ndarray, low: float, high: float) -> np.ndarray:
    values = values[np.isfinite(values)]
    # before the conversion: int64 cannot hold a margin of 1e38 m
    place = ((values - low) * (BINS / (high - low))).clip(0, BINS - 1)
    return np.bincount(place.astype(np.int64), minlength=BINS)


def margin_histograms(run: Run, method: str) -> dict[str, Histogram]:
    """Criterion -> histogram of its finite margins, in its unit."""
    entries = run.criteria
    ends = {e.name: (UNITS[e.unit].low, UNITS[e.unit].high) for e in entries}
    counts = {e.name: np.zeros(BINS, np.int64) for e in entries}
    for table in run.shards("trials", method, [e.margin_column for e in entries]):
        for e in entries:
            values = table[e.margin_column].to_numpy().astype(np.float64)
            counts[e.name] += _histogram(values, *ends[e.name])
    return {c: Histogram(*ends[c], n) for c, n in counts.items()}


def time_histograms(run: Run, name: str) -> dict[str, Histogram]:
    """Method -> histogram of a stored time. All have one range, from 0 to the largest time; a method
    without times is left out."""

    def seconds(method: str) -> Iterator[np.ndarray]:
        for table in run.shards("trials", method, [name]):
            values = table[name].to_numpy().astype(np.float32)
            yield values[np.isfinite(values)]

    largest = {
        m: max((float(x.max()) for x in seconds(m) if len(x)), default=None) for m in run.methods
    }
    high = max((x for x in largest.values() if x is not None), default=0.0)
    counts = {m: np.zeros(BINS, np.int64) for m, x in largest.items() if x is not None and high > 0}
    for method, count in counts.items():
        for values in seconds(method):
            count += _histogram(values, 0.0, high)
    return {m: Histogram(0.0, high, count) for m, count in counts.items()}


def shown(run: Run) -> tuple[str, ...]:
    """Columns of the trials on a page."""
    first = ("trial_id", "object", "split", "side", "outcome")
    last = ("plan_reason", "plan_pair", "borderline", "t_exec_s")
    return (*first, *(e.margin_column for e in run.criteria), *last)


def examples(run: Run, method: str, limit: int) -> tuple[pa.Table, int]:
    """About `limit` trials of a method at most, the first ones of each outcome, and the number of
    all its trials."""
    total, kept = 0, []
    each = max(1, limit // len(OUTCOME_NAMES))
    counts = np.zeros(len(OUTCOME_NAMES), np.int64)
    whole = sum(run.planned(method).values()) <= limit
    for table in run.shards("trials", method, shown(run)):
        total += len(table)
        if whole:
            kept.append(table)
            continue
        outcome = codes(table, "outcome", OUTCOME_NAMES)
        room = np.maximum(each - counts, 0)
        rows = np.concatenate([np.flatnonzero(outcome == k)[:n] for k, n in enumerate(room)])
        counts += np.bincount(outcome[rows], minlength=len(OUTCOME_NAMES))
        kept.append(table.take(pa.array(np.sort(rows))))
    return pa.concat_tables(kept).unify_dictionaries(), total
