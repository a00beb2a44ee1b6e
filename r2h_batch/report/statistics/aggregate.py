"""From counted trials to Table I: rates of all trials, intervals and means. Pure functions."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

from r2h_batch.base.validate import (
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
from r2h_batch.report.statistics.few import FEW
from r2h_batch.report.statistics.intervals import over_clusters
from r2h_batch.report.statistics.rates import (
    ASKED_FAILURES,
    FAILURES,
    OF_ALL,
    PARTIAL,
    TIMES,
)
from r2h_batch.report.statistics.shares import counted_shares
from r2h_batch.report.statistics.tally import SECONDS, Tally
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.verdicts import SPLITS


@dataclass(frozen=True)
class Rate:
    """A rate in percent with its 95 % interval.

    `count` of `total` trials; both are None in the Avg row.
    """

    percent: float
    low: float
    high: float
    count: int | None = None
    total: int | None = None


@dataclass(frozen=True)
class Mean:
    """A mean over `count` trials; None if there are none."""

    value: float | None
    count: int


@dataclass(frozen=True)
class Row:
    """One line of the table: a method on a split, or on one object of it.

    Attributes:
        split: S0, S1 or Avg.
        method: its name.
        n: planned trials.
        counts: outcome -> trials.
        rates: key of `OF_ALL` -> rate of all n trials; None where it is not defined. Also those of `ASKED_FAILURES` that the
            benchmark asks for.
        sr_new_objects: the success rate with its interval for new objects.
        n_objects: different objects.
        sr_new_categories: the success rate with its interval for new categories of objects.
        n_categories: different categories; as many as objects where each is one of its own.
        sr_few: the success rate with its prediction interval: where the mean of `few` new categories
            lies, of each split in the Avg row.
        few: number of these.
        times: one of `TIMES` -> mean in seconds.
        shares: key of `rates.shares` -> rate of the rows that it is of; those that no row is of are left out.
    """

    split: str
    method: str
    n: int
    counts: Mapping[str, int]
    rates: Mapping[str, Rate | None]
    sr_new_objects: Rate | None
    n_objects: int
    times: Mapping[str, Mean]
    shares: Mapping[str, Rate] = field(default_factory=dict)
    sr_new_categories: Rate | None = None
    n_categories: int = 0
    sr_few: Rate | None = None
    few: int = FEW


_SHARE = number(0, 1)
_NOT_NEGATIVE = array("biuf", None, "numbers, 0 or more", low=0)
_COUNTS = array("biuf", 1, "numbers (K,), 0 or more", low=0)


@check_arguments(count=_NOT_NEGATIVE, total=_NOT_NEGATIVE, confidence=_SHARE)
def wilson_interval(
    count: ArrayLike, total: ArrayLike, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """The Wilson score interval of a rate: it speaks about more trials with the same objects.

    Args:
        count: (...) successes.
        total: (...) trials.
        confidence: between 0 and 1.

    Returns:
        Lower and upper end (...) float64 as fractions in [0, 1]; NaN where total is 0.

    Source: Wilson 1927. scipy.stats gives one interval at a time, with a p value (1.4 ms), and takes
    0.8 s and 30 MB to import.
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


@check_arguments(success=_COUNTS, total=_COUNTS, few=optional(integer(1)))
def clustered_rate(success: np.ndarray, total: np.ndarray, few: int | None = None) -> Rate | None:
    """The success rate with an interval over clusters (objects, or categories of them): it speaks
    about the mean of all clusters of this kind, or about that of a few new ones.

    It is a t interval of the log odds (`Clustered.rate_ends`), and never narrower than the Wilson
    interval: with few clusters the variance between them can come out as 0.

    Args:
        success: (K,) successes of each cluster.
        total: (K,) trials of each cluster; empty clusters do not count.
        few: so many new clusters, each with as many trials as these have; None: all clusters.

    Returns:
        The rate, or None with fewer than two clusters.
    """
    x, n = np.asarray(success), np.asarray(total)
    if x.shape != n.shape or (x > n).any():
        found = f"success is {describe_value(success)} and total {describe_value(total)}"
        raise ValueError(f"{found}; they must be successes and trials of each cluster")
    count, trials = int(x.sum()), int(n.sum())
    p = count / trials if trials else 0.0
    if (found_mean := over_clusters([(x, n)], p * (1 - p))) is None:
        return None
    share = found_mean.shrunk(few)
    wilson = wilson_interval(count * share, trials * share)
    ends = found_mean.rate_ends(few)
    low, high = min(ends[0], float(wilson[0])), max(ends[1], float(wilson[1]))
    return Rate(100 * p, 100 * max(low, 0.0), 100 * min(high, 1.0), count, trials)


@check_arguments(rates=sequence_of(Rate))
def mean_rate(rates: Sequence[Rate]) -> Rate:
    """Unweighted mean of independent rates, with an interval made of theirs (MOVER, Zou and Donner
    2008).

    Args:
        rates: in percent; one or more.
    """
    c = 1 / len(rates)
    percent = c * sum(r.percent for r in rates)
    below = c * np.sqrt(sum((r.percent - r.low) ** 2 for r in rates))
    above = c * np.sqrt(sum((r.high - r.percent) ** 2 for r in rates))
    return Rate(percent, max(percent - float(below), 0.0), min(percent + float(above), 100.0))


_TALLY = instance_of(Tally, "what tally(RUN, METHOD) gives")


_FEW = integer(1)


@check_arguments(counted=_TALLY, split=one_of(*SPLITS), few=_FEW)
def split_row(counted: Tally, split: str, few: int = FEW) -> Row:
    """The table line of a split. The rate of a criterion that the split does not require, that concerns none of its
    objects, or that came after these rows, is None.

    Args:
        counted: a method's trials.
        split: S0 or S1.
        few: new categories whose mean the prediction interval speaks about.

    Raises:
        ValueError: if a trial fails a criterion that its split does not require.
    """
    return _row(counted, split, counted.of_split(split).by("object", "outcome"), few)


@check_arguments(counted=_TALLY, split=one_of(*SPLITS))
def object_rows(counted: Tally, split: str) -> dict[str, Row]:
    """Object -> the table line of its trials in a split, as `split_row`; in the order of `Tally.objects`.

    Args:
        counted: outcomes of one method (`tally`).
        split: S0 or S1.
    """
    cells: dict[str, list[dict[str, Any]]] = {name: [] for name in counted.objects}
    for cell in counted.of_split(split).by("object", "outcome"):
        cells[cell["object"]].append(cell)
    return {name: _row(counted, split, own) for name, own in cells.items() if own}


def _row(counted: Tally, split: str, cells: Sequence[Mapping[str, Any]], few: int = FEW) -> Row:
    """The table line of the trials in these cells, each of one object and outcome."""
    counts = dict.fromkeys(OUTCOME_NAMES, 0)
    trials, successes = Counter[str](), Counter[str]()
    for cell in cells:
        counts[cell["outcome"]] += cell["n"]
        trials[cell["object"]] += cell["n"]
        successes[cell["object"]] += cell["successes"]
    n = trials.total()
    rates = {rate: _rate(sum(counts[o] for o in of_it), n) for rate, of_it in OF_ALL.items()}
    asked = {rate: e for rate, e in ASKED_FAILURES.items() if e.name in counted.judged}
    rates |= {rate: _rate(counts[entry.name], n) for rate, entry in asked.items()}
    for rate, entry in FAILURES.items():
        if split not in entry.splits and (failed := counts[entry.name]):
            what = f"trials failed {entry.name.capitalize()}, which {split} skips"
            raise ValueError(f"{counted.method}: {failed} {split} {what}")
        if split not in entry.splits or entry.name not in counted.judged:
            rates[rate] = None
        elif entry.applies is not None:
            own = counted.concerned.get(entry.name, frozenset())
            others = (c for c in cells if c["object"] not in own and c["outcome"] == entry.name)
            if other := next(others, None):
                what = f"failed {entry.name.capitalize()}, which does not concern {other['object']}"
                raise ValueError(f"{counted.method}: {other['n']} {split} trials {what}")
            rates[rate] = _rate(counts[entry.name], sum(k for o, k in trials.items() if o in own))

    def added(name: str) -> tuple[float, int]:
        return sum(c[f"{name}_sum"] for c in cells), sum(c[f"{name}_count"] for c in cells)

    means = {}
    for name in SECONDS:
        seconds, known = added(name)
        means[name] = Mean(seconds / known if known else None, known)
    plan, execution = means["t_plan_s"], means["t_exec_s"]
    total = None if plan.value is None or execution.value is None else plan.value + execution.value
    means["t_tot_s"] = Mean(total, execution.count)
    by_object = np.array([(successes[o], trials[o]) for o in trials], np.int64).reshape(-1, 2)
    categories = [counted.category.get(o, o) for o in trials]
    by_category = np.zeros((len(set(categories)), 2), np.int64)
    np.add.at(by_category, np.unique(categories, return_inverse=True)[1], by_object)
    shares = {name: added(name) for name in counted_shares()}
    return Row(
        split=split,
        method=counted.method,
        n=n,
        counts=counts,
        rates=rates,
        sr_new_objects=clustered_rate(*by_object.T),
        n_objects=len(trials),
        sr_new_categories=clustered_rate(*by_category.T),
        n_categories=len(by_category),
        sr_few=clustered_rate(by_category[:, 0], by_category[:, 1], few),
        few=few,
        times={k: means[k] for k in TIMES},
        shares={k: rate_of(round(hits), known) for k, (hits, known) in shares.items() if known},
    )


def over_objects(counted: Tally, split: str, few: int = FEW) -> Row:
    """As `split_row`, but every object of the split counts the same, whatever its trials: rates
    and times are means over the objects' own. Counts and intervals are those of the trials.

    Args:
        counted: outcomes of one method (`tally`).
        split: S0 or S1.
        few: as of `split_row`.
    """
    whole = split_row(counted, split, few)
    rows = list(object_rows(counted, split).values())

    def rate(of: Callable[[Row], Rate | None]) -> Rate | None:
        known = [found.percent for found in map(of, rows) if found is not None]
        own = of(whole)
        return replace(own, percent=sum(known) / len(known)) if known and own else own

    def mean(name: str) -> Mean:
        values = [v for v in (r.times[name].value for r in rows) if v is not None]
        own = whole.times[name]
        return replace(own, value=sum(values) / len(values)) if values else own

    return replace(
        whole,
        rates={name: rate(lambda r, k=name: r.rates[k]) for name in whole.rates},  # type: ignore[misc]
        times={name: mean(name) for name in TIMES},
        shares={
            name: found
            for name in whole.shares
            if (found := rate(lambda r, k=name: r.shares.get(k)))  # type: ignore[misc]
        },
    )


def _rate(count: int, total: int) -> Rate | None:
    return rate_of(count, total) if total else None


def rate_of(count: int, total: int) -> Rate:
    """The share with its Wilson interval.

    Args:
        count: trials that have it.
        total: trials, 1 or more.
    """
    low, high = (100 * float(end) for end in wilson_interval(count, total))
    return Rate(100 * count / total, low, high, count, total)


@check_arguments(rows=sequence_of(Row, "lines of one method"))
def average_row(rows: Sequence[Row]) -> Row:
    """The paper's Avg: the mean of a method's splits.

    A criterion that a split skips counts as 0 there. A rate is None if a split has no trials; that of a criterion
    for some objects is the mean of the splits that have such objects.

    Args:
        rows: a method's lines, one for each split.
    """

    def rate(name: str) -> Rate | None:
        zero = Rate(0.0, 0.0, 0.0)
        judged_in = FAILURES[name].splits if name in FAILURES else SPLITS
        parts = [r.rates[name] if r.split in judged_in or not r.n else zero for r in rows]
        known = [p for p in parts if p is not None]
        if name in PARTIAL and known:  # a split may have none of its objects
            return mean_rate(known)
        return mean_rate(known) if len(known) == len(parts) else None

    def mean(name: str) -> Mean:
        parts = [r.times[name] for r in rows]
        known = [p.value for p in parts if p.value is not None]
        value = sum(known) / len(known) if len(known) == len(parts) else None
        return Mean(value, sum(p.count for p in parts))

    def over(clustered: Sequence[Rate | None]) -> Rate | None:
        known = [rate for rate in clustered if rate is not None]
        return mean_rate(known) if len(known) == len(rows) else None

    return Row(
        split="Avg",
        method=rows[0].method,
        n=sum(r.n for r in rows),
        counts={name: sum(r.counts[name] for r in rows) for name in OUTCOME_NAMES},
        rates={name: rate(name) for name in rows[0].rates},
        sr_new_objects=over([r.sr_new_objects for r in rows]),
        n_objects=sum(r.n_objects for r in rows),
        sr_new_categories=over([r.sr_new_categories for r in rows]),
        n_categories=sum(r.n_categories for r in rows),
        sr_few=over([r.sr_few for r in rows]),
        few=rows[0].few,
        times={name: mean(name) for name in TIMES},
    )


@check_arguments(
    methods=sequence_of(Tally, "what tally(RUN, METHOD) gives", least=0),
    averages=one_of("trials", "objects"),
    few=_FEW,
)
def summarise(
    methods: Sequence[Tally], averages: str = "trials", few: int = FEW
) -> tuple[Row, ...]:
    """The lines of Table I: every method on S0, then on S1, then Avg if both splits were planned.

    Args:
        methods: counted trials; their names differ.
        averages: what counts the same within a split, as `EvalConfig.averages` says.
        few: new categories whose mean the prediction intervals speak about.
    """
    table: list[Row] = []
    by_method: dict[str, list[Row]] = {m.method: [] for m in methods}
    if len(by_method) != len(methods):
        raise ValueError(f"method names must differ, got {', '.join(m.method for m in methods)}")
    for split in SPLITS:
        for counted in methods:
            if split in counted.splits:
                row = (split_row if averages == "trials" else over_objects)(counted, split, few)
                table.append(row)
                by_method[counted.method].append(row)
    table.extend(average_row(rows) for rows in by_method.values() if len(rows) == len(SPLITS))
    return tuple(table)
