"""From per-trial verdicts to Table I: first failures, rates of all trials, intervals, means. Pure functions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from r2h_batch.results.columns import FAILED, UNEVALUATED, codes, pattern, states
from r2h_batch.results.reading import Run
from r2h_batch.results.rows import MISSING, OUTCOME_NAMES
from r2h_batch.verdicts import CRITERIA, SPLITS, Outcome

RATES = {
    "sr": (Outcome.SUCCESS,),
    "f_plan": (Outcome.PLAN,),
    "f_reach": (Outcome.REACH,),
    "f_safe": (Outcome.SAFE,),
    "f_stab": (Outcome.STABILITY,),
    "f_afford": (Outcome.AFFORDANCE,),
    "invalid": (Outcome.INVALID_INPUT, Outcome.INVALID_SIM),
    "missing": (MISSING,),
}
"""Reported rate -> the outcomes that it counts; every outcome is counted exactly once, so the rates sum to 100."""

TIMES = ("t_plan_s", "t_exec_s", "t_tot_s", "t_method_s")

_REQUIRED = np.array([c != "affordance" for c in CRITERIA])

PATTERNS = np.array(np.unravel_index(np.arange(3 ** len(CRITERIA)), (3,) * len(CRITERIA))).T
"""(243, 5) the criteria's words of every pattern; a trial's pattern is the row, invalid and missing trials have row 0."""


@dataclass(frozen=True)
class Rate:
    """A rate in percent with its 95 % interval; `count` of `total` trials, both None in the Avg row."""

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
    """One line of the table: a method on a split (or any other group of trials), None wherever nothing is defined."""

    split: str
    method: str
    n: int
    counts: Mapping[str, int]
    rates: Mapping[str, Rate | None]
    sr_new_objects: Rate | None
    n_objects: int
    times: Mapping[str, Mean]


@dataclass(frozen=True)
class Verdicts:
    """One method's trials as (N,) columns: index into `SPLITS`, object and outcome codes, seconds (NaN: none)."""

    method: str
    split: np.ndarray
    object: np.ndarray
    outcome: np.ndarray
    t_plan_s: np.ndarray
    t_exec_s: np.ndarray
    t_method_s: np.ndarray
    splits: tuple[str, ...] = SPLITS  # planned ones
    objects: tuple[str, ...] = ()  # names behind the codes
    pattern: np.ndarray | None = None  # row of `PATTERNS`: the five verdicts on their own

    def __post_init__(self) -> None:
        n = len(self.outcome)
        for name in ("split", "object", "t_plan_s", "t_exec_s", "t_method_s"):
            if len(getattr(self, name)) != n:
                raise ValueError(f"Verdicts.{name} has {len(getattr(self, name))} rows, outcome has {n}")
        if n and not (self.outcome.min() >= 0 and self.outcome.max() <= MISSING):
            raise ValueError(f"Verdicts.outcome must lie in 0..{MISSING} ({', '.join(OUTCOME_NAMES)})")


def first_failure(passed: np.ndarray, evaluated: np.ndarray, required: np.ndarray = _REQUIRED) -> np.ndarray:
    """Outcome codes (N,) int8: the first evaluated criterion that failed, in the order of `CRITERIA`.

    A row without a failure is a success only if every `required` criterion ((5,) or (N, 5), all but Affordance unless
    told) was evaluated; anything else would turn "not looked at" into "passed" and is an error.
    """
    passed, evaluated = np.asarray(passed, bool), np.asarray(evaluated, bool)
    if passed.ndim != 2 or passed.shape[1] != len(CRITERIA) or passed.shape != evaluated.shape:
        raise ValueError(f"passed {passed.shape} and evaluated {evaluated.shape} must both be (N, {len(CRITERIA)})")
    failed = evaluated & ~passed
    any_failed = failed.any(axis=1)
    unseen = ~any_failed & (~evaluated & required).any(axis=1)
    if unseen.any():
        rows = ", ".join(map(str, np.flatnonzero(unseen)[:10]))
        raise ValueError(f"{unseen.sum()} rows have no failure but a criterion that was not evaluated: rows {rows}")
    codes = np.array([Outcome[c.upper()] for c in CRITERIA], np.int8)
    return np.where(any_failed, codes[failed.argmax(axis=1)], np.int8(Outcome.SUCCESS)).astype(np.int8)


def wilson_interval(count: ArrayLike, total: ArrayLike, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper end of the Wilson score interval of count / total, as fractions in [0, 1]; NaN where total is 0.

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


def clustered_interval(success: np.ndarray, cluster: np.ndarray, confidence: float = 0.95) -> Rate | None:
    """Success rate in percent with a t interval over clusters (objects): it speaks about new objects of this kind.

    The ratio estimator sum(x) / sum(n) with the between-cluster variance of its residuals and k - 1 degrees of freedom.
    Never narrower than the Wilson interval (with few clusters the between-cluster variance can come out as 0).
    None with fewer than two clusters.
    """
    success, cluster = np.asarray(success, bool), np.asarray(cluster)
    index = cluster if cluster.dtype.kind in "iu" else np.unique(cluster, return_inverse=True)[1]
    n = np.bincount(index).astype(np.float64)
    x = np.bincount(index[success], minlength=len(n))[n > 0]
    n = n[n > 0]
    k = len(n)
    if k < 2:
        return None
    p = x.sum() / n.sum()
    error = np.sqrt(k / (k - 1) * np.sum((x - p * n) ** 2)) / n.sum()
    half = stdtrit(k - 1, 0.5 + confidence / 2) * error
    wilson_low, wilson_high = wilson_interval(x.sum(), n.sum(), confidence)
    low, high = max(min(p - half, float(wilson_low)), 0.0), min(max(p + half, float(wilson_high)), 1.0)
    return Rate(100 * p, 100 * low, 100 * high, int(x.sum()), int(n.sum()))


def mean_rate(rates: Sequence[Rate]) -> Rate:
    """Unweighted mean of independent rates; its interval is built from theirs (MOVER, Zou and Donner 2008)."""
    c = 1 / len(rates)
    percent = c * sum(r.percent for r in rates)
    below = c * np.sqrt(sum((r.percent - r.low) ** 2 for r in rates))
    above = c * np.sqrt(sum((r.high - r.percent) ** 2 for r in rates))
    return Rate(percent, max(percent - float(below), 0.0), min(percent + float(above), 100.0))


def _mean(values: np.ndarray) -> Mean:
    ran = ~np.isnan(values)
    return Mean(float(np.mean(values[ran], dtype=np.float64)) if ran.any() else None, int(ran.sum()))


def _times(verdicts: Verdicts, rows: np.ndarray) -> dict[str, Mean]:
    plan, execution = _mean(verdicts.t_plan_s[rows]), _mean(verdicts.t_exec_s[rows])
    total = None if plan.value is None or execution.value is None else plan.value + execution.value
    return {
        "t_plan_s": plan,
        "t_exec_s": execution,
        "t_tot_s": Mean(total, execution.count),
        "t_method_s": _mean(verdicts.t_method_s[rows]),
    }


def group_row(verdicts: Verdicts, rows: np.ndarray, split: str) -> Row:
    """The table line of the trials that the mask `rows` selects; on split S0, F_afford is None (not evaluated)."""
    outcome, objects = verdicts.outcome[rows], verdicts.object[rows]
    counts = np.bincount(outcome, minlength=MISSING + 1)
    n = int(counts.sum())
    if split == "S0" and counts[Outcome.AFFORDANCE]:
        raise ValueError(f"{verdicts.method}: {counts[Outcome.AFFORDANCE]} S0 trials failed Affordance, which S0 skips")
    rates: dict[str, Rate | None] = {}
    for name, outcomes in RATES.items():
        count = int(sum(counts[o] for o in outcomes))
        low, high = (100 * float(end) for end in wilson_interval(count, n))
        rates[name] = Rate(100 * count / n, low, high, count, n) if n else None
    if sum(r.count or 0 for r in rates.values() if r) != n:
        raise ValueError(f"{verdicts.method}, {split}: the outcomes do not add up to {n} trials: {counts.tolist()}")
    if split == "S0":
        rates["f_afford"] = None
    return Row(
        split=split,
        method=verdicts.method,
        n=n,
        counts=dict(zip(OUTCOME_NAMES, counts.tolist(), strict=True)),
        rates=rates,
        sr_new_objects=clustered_interval(outcome == Outcome.SUCCESS, objects),
        n_objects=len(np.unique(objects)),
        times=_times(verdicts, rows),
    )


def average_row(rows: Sequence[Row]) -> Row:
    """The paper's Avg: mean of the splits with S0's F_afford taken as 0; None where a split has nothing to average."""

    def rate(name: str) -> Rate | None:
        zero = Rate(0.0, 0.0, 0.0)
        parts = [zero if name == "f_afford" and r.split == "S0" and r.n else r.rates[name] for r in rows]
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


def verdicts(run: Run, method: str) -> Verdicts:
    """A stored method's verdicts, checked: counts as planned, outcomes equal to the stored criteria's first failure."""
    times = ("t_plan_s", "t_exec_s", "t_method_s")
    columns = ["object", "split", "outcome", *times, *(f"passed_{c}" for c in CRITERIA)]
    names: list[str] = []
    parts: dict[str, list[np.ndarray]] = {k: [] for k in ("split", "object", "outcome", "pattern", *times)}
    for table in run.shards("trials", method, columns):
        try:
            part = {
                "split": codes(table, "split", SPLITS).astype(np.int8),
                "object": codes(table, "object", names, grow=True).astype(np.int32),
                "outcome": codes(table, "outcome", OUTCOME_NAMES).astype(np.int8),
                "pattern": pattern(states(table)).astype(np.uint8),
                **{k: table[k].to_numpy().astype(np.float32) for k in times},
            }
        except ValueError as error:
            raise ValueError(f"{method}: {error}") from None
        _check_outcomes(method, part["outcome"], part["pattern"], part["split"])
        for key, values in part.items():
            parts[key].append(values)
    empty = np.zeros(0, np.int8)
    arrays = {k: np.concatenate(v) if v else empty for k, v in parts.items()}
    planned = run.header["trials"]
    for name, count in planned.items():
        if (found := int((arrays["split"] == SPLITS.index(name)).sum())) != count:
            raise ValueError(f"{method}: {found} rows in {name}, {count} were planned")
    return Verdicts(method=method, splits=tuple(planned), objects=tuple(names), **arrays)


def pattern_outcomes(order: Sequence[str] = CRITERIA) -> np.ndarray:
    """(2, 243) outcome of every pattern on S0 and on S1 for an order of the criteria; -1: a needed one was not looked at."""
    if sorted(order) != sorted(CRITERIA):
        raise ValueError(f"an order of criteria is {', '.join(order)}; it must hold each of {', '.join(CRITERIA)} once")
    columns = [CRITERIA.index(c) for c in order]
    failed = PATTERNS[:, columns] == FAILED
    codes = np.array([Outcome[c.upper()] for c in order], np.int8)
    first = np.where(failed.any(1), codes[failed.argmax(1)], np.int8(Outcome.SUCCESS)).astype(np.int8)
    table = np.tile(first, (2, 1))
    for k, required in enumerate((_REQUIRED, np.ones(len(CRITERIA), bool))):
        unseen = ((PATTERNS == UNEVALUATED) & required).any(1)
        table[k, (first == Outcome.SUCCESS) & unseen] = -1
    return table


def _check_outcomes(method: str, outcome: np.ndarray, pattern: np.ndarray, split: np.ndarray) -> None:
    expected = pattern_outcomes()[split, pattern]
    judged = outcome < Outcome.INVALID_INPUT
    if (unseen := int((judged & (expected < 0)).sum())) > 0:
        raise ValueError(f"{method}: {unseen} rows have no failure but a criterion that was not evaluated")
    if (wrong := int((judged & (expected != outcome)).sum())) > 0:
        raise ValueError(f"{method}: {wrong} stored outcomes are not the first failure of the stored criteria")


def summarise(methods: Sequence[Verdicts]) -> tuple[Row, ...]:
    """Rows in Table I's order: every method on S0, then on S1, then Avg (only when both splits were planned)."""
    table: list[Row] = []
    by_method: dict[str, list[Row]] = {v.method: [] for v in methods}
    if len(by_method) != len(methods):
        raise ValueError(f"method names must differ, got {', '.join(v.method for v in methods)}")
    for split in SPLITS:
        for v in methods:
            if split in v.splits:
                row = group_row(v, v.split == SPLITS.index(split), split)
                table.append(row)
                by_method[v.method].append(row)
    table.extend(average_row(rows) for rows in by_method.values() if len(rows) == len(SPLITS))
    return tuple(table)
