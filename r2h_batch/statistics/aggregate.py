"""From counted verdicts to Table I: first failures, rates of all trials, intervals, means. Pure
functions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from r2h_batch.runs.columns import REQUIRED
from r2h_batch.runs.rows import MISSING, OUTCOME_NAMES
from r2h_batch.statistics.tally import SECONDS, Tally
from r2h_batch.validate import (
    array,
    check_arguments,
    describe_value,
    instance_of,
    integer,
    number,
    one_of,
    optional,
    sequence_of,
)
from r2h_batch.verdicts import CRITERIA, REGISTRY, SPLITS, Outcome

FAILURES = {entry.rate: entry for entry in sorted(REGISTRY, key=lambda entry: entry.column)}
"""Rate of first failures -> its criterion, in the order of Table I's columns."""

RATES = {
    "sr": (Outcome.SUCCESS,),
    **{rate: (Outcome[entry.name.upper()],) for rate, entry in FAILURES.items()},
    "invalid": (Outcome.INVALID_INPUT, Outcome.INVALID_SIM),
    "missing": (MISSING,),
}
"""Reported rate -> the outcomes that it counts; every outcome is counted exactly once, so the rates
sum to 100."""

TIMES = ("t_plan_s", "t_exec_s", "t_tot_s", "t_method_s")


@dataclass(frozen=True)
class Rate:
    """A rate in percent with its 95 % interval; `count` of `total` trials, both None in the Avg
    row."""

    percent: float
    low: float
    high: float
    count: int | None = None
    total: int | None = None


@dataclass(frozen=True)
class Mean:
    """A mean over `count` trials; None over none."""

    value: float | None
    count: int


@dataclass(frozen=True)
class Row:
    """One line of the table: a method on a split (or any other group of trials), None wherever
    nothing is defined."""

    split: str
    method: str
    n: int
    counts: Mapping[str, int]
    rates: Mapping[str, Rate | None]
    sr_new_objects: Rate | None
    n_objects: int
    times: Mapping[str, Mean]
    presented: Rate | None = None
    """trials whose region faced the palm within reach, of those that were asked"""
    body_met: Rate | None = None
    """motions that met the receiver's arm or torso, of those past a receiver who has them"""


@check_arguments(
    passed=array("biu", 2, "booleans (N, 5)"), evaluated=array("biu", 2, "booleans (N, 5)")
)
def first_failure(
    passed: np.ndarray, evaluated: np.ndarray, required: np.ndarray = REQUIRED
) -> np.ndarray:
    """Outcome codes (N,) int8: the first evaluated criterion that failed, in the order of
    `CRITERIA`.

    A row without a failure is a success only if every `required` criterion ((5,) or (N, 5), all but
    Affordance unless told) was evaluated; anything else would turn "not looked at" into "passed"
    and is an error.
    """
    passed, evaluated = np.asarray(passed, bool), np.asarray(evaluated, bool)
    if passed.ndim != 2 or passed.shape[1] != len(CRITERIA) or passed.shape != evaluated.shape:
        raise ValueError(
            f"passed {passed.shape} and evaluated {evaluated.shape} must both be (N, {len(CRITERIA)})"
        )
    failed = evaluated & ~passed
    any_failed = failed.any(axis=1)
    unseen = ~any_failed & (~evaluated & required).any(axis=1)
    if unseen.any():
        rows = ", ".join(map(str, np.flatnonzero(unseen)[:10]))
        raise ValueError(
            f"{unseen.sum()} rows have no failure but a criterion that was not evaluated: rows {rows}"
        )
    codes = np.array([Outcome[c.upper()] for c in CRITERIA], np.int8)
    return np.where(any_failed, codes[failed.argmax(axis=1)], np.int8(Outcome.SUCCESS)).astype(
        np.int8
    )


_SHARE = number(0, 1)
_NOT_NEGATIVE = array("biuf", None, "numbers, 0 or more", low=0)
_COUNTS = array("biuf", 1, "numbers (K,), 0 or more", low=0)


@check_arguments(count=_NOT_NEGATIVE, total=_NOT_NEGATIVE, confidence=_SHARE)
def wilson_interval(
    count: ArrayLike, total: ArrayLike, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper end of the Wilson score interval of count / total, as fractions in [0, 1];
    NaN where total is 0.

    It speaks about more trials with the same objects.
    """
    k, n = np.asarray(count, np.float64), np.asarray(total, np.float64)
    z = ndtri(0.5 + confidence / 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        p = k / n
        scale = 1 + z**2 / n
        center = (p + z**2 / (2 * n)) / scale
        half = z / scale * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    low = np.where(k == 0, np.where(n == 0, np.nan, 0.0), np.maximum(center - half, 0.0))
    high = np.where(k == n, np.where(n == 0, np.nan, 1.0), np.minimum(center + half, 1.0))
    return low, high


@check_arguments(
    success=array("biu", 1, "booleans (N,)"),
    cluster=array("iufUST", 1, "numbers or names (N,)"),
    confidence=_SHARE,
)
def clustered_interval(
    success: np.ndarray, cluster: np.ndarray, confidence: float = 0.95
) -> Rate | None:
    """Success rate in percent with a t interval over clusters (objects): it speaks about new
    objects of this kind.

    The ratio estimator sum(x) / sum(n) with the between-cluster variance of its residuals and k - 1
    degrees of freedom. Never narrower than the Wilson interval (with few clusters the
    between-cluster variance can come out as 0). None with fewer than two clusters.
    """
    success = np.asarray(success, bool)
    if success.shape != cluster.shape:
        raise ValueError(
            f"cluster is of {len(cluster)} trials, success of {len(success)}; give one for each trial"
        )
    index = cluster if cluster.dtype.kind in "iu" else np.unique(cluster, return_inverse=True)[1]
    n = np.bincount(index)
    return clustered_rate(np.bincount(index[success], minlength=len(n)), n, confidence)


@check_arguments(success=_COUNTS, total=_COUNTS, confidence=_SHARE)
def clustered_rate(success: np.ndarray, total: np.ndarray, confidence: float = 0.95) -> Rate | None:
    """`clustered_interval` from what it needs of each cluster: (K,) successes and trials, 0 of
    those that are empty."""
    if np.shape(success) != np.shape(total) or (np.asarray(success) > np.asarray(total)).any():
        found = f"success is {describe_value(success)} and total {describe_value(total)}"
        raise ValueError(f"{found}; they must be successes and trials of each cluster")
    n = np.asarray(total, np.float64)
    x = np.asarray(success)[n > 0]
    n = n[n > 0]
    k = len(n)
    if k < 2:
        return None
    p = x.sum() / n.sum()
    error = np.sqrt(k / (k - 1) * np.sum((x - p * n) ** 2)) / n.sum()
    half = stdtrit(k - 1, 0.5 + confidence / 2) * error
    wilson_low, wilson_high = wilson_interval(x.sum(), n.sum(), confidence)
    low, high = (
        max(min(p - half, float(wilson_low)), 0.0),
        min(max(p + half, float(wilson_high)), 1.0),
    )
    return Rate(100 * p, 100 * low, 100 * high, int(x.sum()), int(n.sum()))


@check_arguments(rates=sequence_of(Rate))
def mean_rate(rates: Sequence[Rate]) -> Rate:
    """Unweighted mean of independent rates; its interval is built from theirs (MOVER, Zou and
    Donner 2008)."""
    c = 1 / len(rates)
    percent = c * sum(r.percent for r in rates)
    below = c * np.sqrt(sum((r.percent - r.low) ** 2 for r in rates))
    above = c * np.sqrt(sum((r.high - r.percent) ** 2 for r in rates))
    return Rate(percent, max(percent - float(below), 0.0), min(percent + float(above), 100.0))


def _share(counted: Tally, split: int, code: int | None, name: str) -> Rate | None:
    """How many of the trials that were asked say yes; None without any."""
    asked = counted.sum_of(split, code, name)
    if asked.mean is None:
        return None
    yes = round(asked.mean * asked.count)
    low, high = (100 * float(end) for end in wilson_interval(yes, asked.count))
    return Rate(100 * yes / asked.count, low, high, yes, asked.count)


def _times(counted: Tally, split: int, code: int | None) -> dict[str, Mean]:
    means = {}
    for name in SECONDS:
        seconds = counted.sum_of(split, code, name)
        means[name] = Mean(seconds.mean, seconds.count)
    plan, execution = means["t_plan_s"], means["t_exec_s"]
    total = None if plan.value is None or execution.value is None else plan.value + execution.value
    return {
        "t_plan_s": plan,
        "t_exec_s": execution,
        "t_tot_s": Mean(total, execution.count),
        "t_method_s": means["t_method_s"],
    }


@check_arguments(
    counted=instance_of(Tally, "what tally(RUN, METHOD) gives"),
    split=one_of(*SPLITS),
    code=optional(integer(0)),
)
def group_row(counted: Tally, split: str, code: int | None = None) -> Row:
    """The table line of a split, or of one object (`code`) of it. The rate of a criterion that the
    split does not require is None."""
    objects, splits, outcome, _ = counted.columns
    place = SPLITS.index(split)
    inside = (splits == place) & ((objects == code) if code is not None else True)
    objects, outcome, count = objects[inside], outcome[inside], counted.count[inside]
    counts = _added(outcome, count, MISSING + 1)
    n = int(counts.sum())
    skipped = {rate: entry for rate, entry in FAILURES.items() if split not in entry.splits}
    for rate, entry in skipped.items():
        if failed := sum(counts[o] for o in RATES[rate]):
            raise ValueError(
                f"{counted.method}: {failed} {split} trials failed {entry.name.capitalize()}, which {split} skips"
            )
    rates: dict[str, Rate | None] = {}
    for name, outcomes in RATES.items():
        of_it = int(sum(counts[o] for o in outcomes))
        low, high = (100 * float(end) for end in wilson_interval(of_it, n))
        rates[name] = Rate(100 * of_it / n, low, high, of_it, n) if n else None
    if sum(r.count or 0 for r in rates.values() if r) != n:
        raise ValueError(
            f"{counted.method}, {split}: the outcomes do not add up to {n} trials: {counts.tolist()}"
        )
    rates |= dict.fromkeys(skipped)
    return Row(
        split=split,
        method=counted.method,
        n=n,
        counts=dict(zip(OUTCOME_NAMES, counts.tolist(), strict=True)),
        rates=rates,
        sr_new_objects=clustered_rate(
            _added(objects, count * (outcome == Outcome.SUCCESS)), _added(objects, count)
        ),
        n_objects=len(np.unique(objects)),
        times=_times(counted, place, code),
        presented=_share(counted, place, code, "presented"),
        body_met=_share(counted, place, code, "body_met"),
    )


def _added(place: np.ndarray, count: np.ndarray, length: int = 0) -> np.ndarray:
    """(length or more,) how many there are of each place."""
    sums = np.zeros(max(length, int(place.max(initial=-1)) + 1), np.int64)
    np.add.at(sums, place, count)
    return sums


@check_arguments(rows=sequence_of(Row, "lines of one method"))
def average_row(rows: Sequence[Row]) -> Row:
    """The paper's Avg: the mean of the splits. A criterion that a split skips counts as 0 there;
    a rate is None where a split has no trials."""

    def rate(name: str) -> Rate | None:
        zero = Rate(0.0, 0.0, 0.0)
        judged_in = FAILURES[name].splits if name in FAILURES else SPLITS
        parts = [r.rates[name] if r.split in judged_in or not r.n else zero for r in rows]
        known = [p for p in parts if p is not None]
        return mean_rate(known) if len(known) == len(parts) else None

    def mean(name: str) -> Mean:
        parts = [r.times[name] for r in rows]
        known = [p.value for p in parts if p.value is not None]
        value = sum(known) / len(known) if len(known) == len(parts) else None
        return Mean(value, sum(p.count for p in parts))

    clustered = [r.sr_new_objects for r in rows if r.sr_new_objects is not None]
    return Row(
        split="Avg",
        method=rows[0].method,
        n=sum(r.n for r in rows),
        counts={name: sum(r.counts[name] for r in rows) for name in OUTCOME_NAMES},
        rates={name: rate(name) for name in RATES},
        sr_new_objects=mean_rate(clustered) if len(clustered) == len(rows) else None,
        n_objects=sum(r.n_objects for r in rows),
        times={name: mean(name) for name in TIMES},
    )


@check_arguments(methods=sequence_of(Tally, "what tally(RUN, METHOD) gives", least=0))
def summarise(methods: Sequence[Tally]) -> tuple[Row, ...]:
    """Rows in Table I's order: every method on S0, then on S1, then Avg (only when both splits were
    planned)."""
    table: list[Row] = []
    by_method: dict[str, list[Row]] = {m.method: [] for m in methods}
    if len(by_method) != len(methods):
        raise ValueError(f"method names must differ, got {', '.join(m.method for m in methods)}")
    for split in SPLITS:
        for counted in methods:
            if split in counted.splits:
                row = group_row(counted, split)
                table.append(row)
                by_method[counted.method].append(row)
    table.extend(average_row(rows) for rows in by_method.values() if len(rows) == len(SPLITS))
    return tuple(table)
