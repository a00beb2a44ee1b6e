"""How SR falls as the executed handover is off by more: curves and their area."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from r2h_batch.report.figures import make_figure, style
from r2h_batch.report.statistics.aggregate import Rate, wilson_interval
from r2h_batch.report.statistics.intervals import over_clusters
from r2h_batch.report.statistics.tally import Tally, tally
from r2h_batch.report.table import table_of
from r2h_batch.report.text import short_names
from r2h_batch.runs.store import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LEVELS = ("0mm,0deg", "3mm,0.5deg", "5mm,1deg", "10mm,2deg", "20mm,3deg")
"""Values of `execution_error`; each has a run folder of this name. The first is the reference."""


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
        area: mean of the success rate over the error in mm.
    """

    method: str
    sr: tuple[Rate, ...]
    area: Estimate


@dataclass(frozen=True)
class Robustness:
    """Curves of all methods."""

    levels: tuple[str, ...]
    millimetres: tuple[float, ...]
    curves: tuple[Curve, ...]


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
        area = _area([(weight @ h / weight.sum(), n) for h, n in splits])
        curves.append(Curve(name, sr, area))
    labels = tuple(f"{a:g} mm, {b:g} deg" for a, b in zip(mm, degrees, strict=True))
    return Robustness(labels, tuple(mm), tuple(curves))


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
