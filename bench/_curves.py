"""How SR falls as the executed handover is off by more: curves, their area, and the methods paired at each level."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from r2h_batch.base.table import NA, Table, document, notes_list, of_lines, plain
from r2h_batch.report.figures import make_figure, style
from r2h_batch.report.statistics.aggregate import Rate, wilson_interval
from r2h_batch.report.statistics.intervals import over_clusters, paired_score_interval
from r2h_batch.report.statistics.paired import Pair, compare, pair_up
from r2h_batch.report.statistics.rates import FAILURES
from r2h_batch.report.statistics.tally import Tally, tally
from r2h_batch.report.table import HEADINGS, table_of
from r2h_batch.report.text import legend, short_names
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import Outcome

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = ("0mm,0deg", "3mm,0.5deg", "5mm,1deg", "10mm,2deg", "20mm,3deg")
"""Values of `execution_error`; each has a run folder of this name. The first is the reference."""

NOTES = (
    "SR: percent of all trials, mean of the splits; brackets: 95 %, MOVER of the splits' Wilson intervals. Area: mean height of"
    " the line through the SRs over 0 to the largest error in mm. +-: 95 % t interval over objects (families:"
    " over categories), of the mean of all of them; never narrower than the interval for more trials.",
    "First failures: percent of all trials, as in Table I.",
    "A-B: difference of SR in points. ** decided for new objects (families: categories; t test over them), * for these objects"
    " alone (McNemar), without a mark: not decided. Both tests: Holm over the pairs of a level.",
)


@dataclass(frozen=True)
class Estimate:
    """A value in points, and half of its 95 % t interval over categories of objects; None with one."""

    value: float
    half: float | None


@dataclass(frozen=True)
class Curve:
    """A method at every level.

    Attributes:
        method: its name.
        sr: success rate.
        lost: success rate of the first level less that of each.
        failures: rates of first failures, by key of `FAILURES`; None where nothing requires it.
        area: mean of the success rate over the error in mm.
    """

    method: str
    sr: tuple[Rate, ...]
    lost: tuple[Estimate, ...]
    failures: tuple[Mapping[str, Rate | None], ...]
    area: Estimate


@dataclass(frozen=True)
class Robustness:
    """Curves of all methods, and the pairs of methods at each level."""

    levels: tuple[str, ...]
    millimetres: tuple[float, ...]
    curves: tuple[Curve, ...]
    pairs: tuple[tuple[Pair, ...], ...]


def robustness(runs: Sequence[Run]) -> Robustness:
    """The curves of the methods that all runs hold.

    Args:
        runs: one for each level, the reference first; they differ in `execution_error` only.
    """
    errors = [run.header["configuration"]["execution_error"] for run in runs]
    mm = [1000 * max(e["camera_m"], e["object_m"]) for e in errors]
    degrees = [max(e["camera_deg"], e["object_deg"]) for e in errors]
    weight = np.zeros(len(mm))  # of the trapezoids
    for i, gap in enumerate(np.diff(mm)):
        weight[i : i + 2] += gap / 2
    counted = [{name: tally(run, name) for name in run.methods} for run in runs]
    names = [name for name in runs[0].methods if all(name in level for level in counted)]
    # the last row of a method: Avg, or its only split
    lines = [
        {row.method: row for row in table_of(run, counted=[level[name] for name in names]).rows}
        for run, level in zip(runs, counted, strict=True)
    ]
    curves = []
    for name in names:
        own = [level[name] for level in lines]
        cells = [_by_category(level[name]) for level in counted]
        # (levels, C) successes and (C,) trials of each split
        splits = [(np.array([level[k][0] for level in cells]), n) for k, (_, n) in enumerate(cells[0])]
        sr = tuple(rate for row in own if (rate := row.rates["sr"]))  # a run has trials
        won = [_won(run, name) for run in runs]
        lost = [
            _lost(
                [(h[0] - h[i], n) for h, n in splits],
                [_discordant(a, b) for a, b in zip(won[0], now)],
            )
            for i, now in enumerate(won)
        ]
        failures = tuple({key: row.rates[key] for key in FAILURES} for row in own)
        area = _area([(weight @ h / weight.sum(), n) for h, n in splits])
        curves.append(Curve(name, sr, tuple(lost), failures, area))
    pairs: tuple[tuple[Pair, ...], ...] = ((),) * len(runs)
    if len(names) > 1:
        pairs = tuple(compare(pair_up([run.only(names)]))[-1].pairs for run in runs)
    labels = tuple(f"{a:g} mm, {b:g} deg" for a, b in zip(mm, degrees, strict=True))
    return Robustness(labels, tuple(mm), tuple(curves), pairs)


def _by_category(counted: Tally) -> list[tuple[np.ndarray, np.ndarray]]:
    """Successes and trials (C,) of each category of objects, split by split; categories by name."""
    found = []
    for split in counted.splits:
        cells = counted.of_split(split).by("object")
        names = [counted.category.get(cell["object"], cell["object"]) for cell in cells]
        kinds, place = np.unique(names, return_inverse=True)
        belongs = (place[:, None] == np.arange(len(kinds))).astype(np.int64)
        successes, n = (np.array([c[k] for c in cells], np.int64) @ belongs for k in ("successes", "n"))
        found.append((successes, n))
    return found


def _won(run: Run, method: str) -> list[np.ndarray]:
    """Whether each trial succeeds, split by split, in the order of their ids."""
    table = run.trials(method, ["trial_id", "split", "outcome"]).sort_by("trial_id")
    success = np.array(table["outcome"].to_pylist()) == Outcome.SUCCESS.name.lower()
    split = np.array(table["split"].to_pylist())
    return [success[split == s] for s in run.planned(method)]


def _discordant(first: np.ndarray, now: np.ndarray) -> tuple[int, int]:
    """Trials that only the first solves, and that only the other does."""
    return int((first & ~now).sum()), int((now & ~first).sum())


def _lost(splits: Sequence[tuple[np.ndarray, np.ndarray]], only: Sequence[tuple[int, int]]) -> Estimate:
    """The mean of the splits' differences, in points; no interval is narrower than the one for more trials."""
    parts: list[tuple[float, float | None]] = []
    for (x, n), (a, b) in zip(splits, only, strict=True):
        total = n.sum()
        low, high = paired_score_interval(a, b, total)
        value = (a - b) / total
        over = over_clusters([(x, n)], (a + b) / total - value**2)
        widest = max(high - value, value - low)
        parts.append((value, None if over is None else max(over.half(), widest)))
    return _mean(parts)


def _area(splits: Sequence[tuple[np.ndarray, np.ndarray]]) -> Estimate:
    """The mean of the splits' mean rates, in points; no interval is narrower than the one for more trials."""
    parts: list[tuple[float, float | None]] = []
    for x, n in splits:
        p = float(x.sum() / n.sum())
        low, high = (float(end) for end in wilson_interval(x.sum(), n.sum()))
        over = over_clusters([(x, n)], p * (1 - p))
        widest = max(high - p, p - low)
        parts.append((p, None if over is None else max(over.half(), widest)))
    return _mean(parts)


def _mean(parts: Sequence[tuple[float, float | None]]) -> Estimate:
    halves = [half for _, half in parts if half is not None]
    half = float(np.linalg.norm(halves)) / len(parts) if len(halves) == len(parts) else None
    value = float(np.mean([value for value, _ in parts]))
    return Estimate(100 * value, None if half is None else 100 * half)


def render(found: Robustness) -> str:
    """The curves as text that ends in a newline.

    Args:
        found: what `robustness` gives.
    """
    short = short_names([c.method for c in found.curves])
    names = [short[c.method] for c in found.curves]
    rows = [
        [name, *(f"{r.percent:.1f} [{r.low:.0f}, {r.high:.0f}]" for r in c.sr), _points(c.area)]
        for name, c in zip(names, found.curves, strict=True)
    ]
    lost = [[name, *map(_points, c.lost[1:])] for name, c in zip(names, found.curves, strict=True)]
    failures = [
        [name, level, *(f"{rate.percent:.1f}" if rate else NA for rate in c.failures[i].values())]
        for name, c in zip(names, found.curves, strict=True)
        for i, level in enumerate(found.levels)
    ]
    head = ["Method", "error", *(HEADINGS[key] for key in FAILURES)]
    parts: list[Table | str] = [
        of_lines(["Method", *found.levels, "area"], rows, title="SR", own=True),
        of_lines(["Method", *found.levels[1:]], lost, title="Points of SR lost"),
        of_lines(head, failures, left=2, title="First failures"),
    ]
    if found.pairs[0]:
        marks = {"better": "**", "worse": "**", "better here": "*", "worse here": "*"}
        pairs = [
            [
                *(short[name] for name in (level[0].a, level[0].b)),
                *(f"{p.difference:+.1f}{marks.get(p.verdict, '')}" for p in level),
            ]
            for level in zip(*found.pairs, strict=True)
        ]
        head = ["A", "B", *found.levels]
        parts.append(of_lines(head, pairs, left=2, title="Pairs: A-B", own=True))
    parts.append(notes_list([*map(plain, legend(short)), *NOTES]))
    return document(parts)


def _points(estimate: Estimate) -> str:
    half = "" if estimate.half is None else f" +-{estimate.half:.1f}"
    return f"{estimate.value:.1f}{half}"


def figure(found: Robustness) -> "Figure":
    """SR over the error, for print."""
    short = short_names([c.method for c in found.curves])
    with style(page=False):
        drawn = make_figure(6.0, 3.4)
        axes = drawn.add_subplot()
        for c, marker in zip(found.curves, "osD^v<>ph*" * len(found.curves), strict=False):
            y = np.array([r.percent for r in c.sr])
            ends = np.array([[r.percent - r.low, r.high - r.percent] for r in c.sr]).T
            label = f"{short[c.method]} ({c.area.value:.0f})"
            look: Any = {"marker": marker, "ms": 4, "lw": 1.2, "capsize": 2, "label": label}
            axes.errorbar(found.millimetres, y, ends, **look)
        ticks = [level.replace(" mm, ", "\n").removesuffix(" deg") for level in found.levels]
        axes.set_xticks(found.millimetres, ticks)
        axes.set_ylim(0, 102)
        axes.set_ylabel("SR, %")
        axes.set_xlabel("execution error: mm, degrees (deviation per axis)")
        axes.grid(axis="y")
        drawn.legend(loc="outside right upper", frameon=False, title="method (area)")
    return drawn
