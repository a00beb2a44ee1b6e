"""Rates at other thresholds, without simulation: `r2h-batch results rethreshold RUN`.

Exact, trial by trial, for the poses that were scored (a method that asks the evaluator might choose
others):
- reach radius: any value, the margin is r_h - distance;
- w_max: up to the run's own. A wider aperture is another gripper: what it would hold was not
  measured;
- safe margin: from 0 to 4.99 cm, beyond which clearances are only a lower bound.
Not possible: the ball's offset, the pads' squeeze, hand clearance of the path: they change the
geometry.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from r2h_batch.base.validate import parse_number
from r2h_batch.verdicts import SPLITS, Outcome

if TYPE_CHECKING:  # what is heavy is imported when there is work
    from r2h_batch.report.statistics.thresholds import Point

MAX_POINTS = 10_000


def values(text: str, name: str) -> tuple[float, ...]:
    """Numbers of `.08`, `.08,.10` or `LOW:HIGH:STEP` (both ends included)."""
    try:
        if ":" in text:
            low, high, step = map(parse_number, text.split(":"))
            if not (step > 0 and high >= low and (high - low) / step < MAX_POINTS):
                raise ValueError
            steps = int((high - low) / step + 1e-9)
            return tuple(round(low + i * step, 12) for i in range(steps + 1))
        return tuple(parse_number(part.strip()) for part in text.split(","))
    except ValueError:
        allowed = "METRES, A,B,... or LOW:HIGH:STEP (HIGH not below LOW, STEP above 0) in plain decimal digits"
        raise ValueError(f"--{name} is {text!r}; it must be {allowed}") from None


def render(points: "Sequence[Point]", methods: Sequence[str]) -> str:
    """Tables of rates for every point and method, and the ranks over the points."""
    from r2h_batch.base.table import NA, Table, document, notes_list, of_lines, plain
    from r2h_batch.report.statistics.rates import ASKED_FAILURES, FAILURES, PARTIAL
    from r2h_batch.report.statistics.thresholds import ROUNDING_M, rank_stability
    from r2h_batch.report.text import legend, short_names

    tables = [counts for point in points for counts in point.counts.values()]
    failures = [
        entry
        for rate, entry in (FAILURES | ASKED_FAILURES).items()
        if rate in FAILURES or any(c[:, Outcome[entry.name.upper()]].any() for c in tables)
    ]
    shown = ["SR", *(entry.heading for entry in failures)]
    short = short_names(methods)
    lines = []
    for point in points:
        for method in methods:
            for k, counts in enumerate(point.counts[method]):
                if n := counts.sum():
                    rates = [f"{100 * counts[Outcome.SUCCESS] / n:.1f}"]
                    for entry in failures:
                        failed, of = 100 * counts[Outcome[entry.name.upper()]], n
                        if entry.applies is not None:
                            of = point.concerned[method][entry.name][k]
                        known = SPLITS[k] in entry.splits and of
                        rates.append(f"{failed / of:.1f}" if known else NA)
                    at = (point.reach_radius_m, point.w_max_m, point.safe_margin_m)
                    cells = [*(f"{v:.4g}" for v in at), *rates, str(point.undecided[method])]
                    lines.append([short[method], SPLITS[k], *cells])
    parts: list[Table | str] = [
        "Rates in percent of all planned trials (of a criterion for some objects: of those that it concerns), thresholds in"
        " metres, computed from stored margins."
        if PARTIAL
        else "Rates in percent of all planned trials, thresholds in metres, computed from stored margins.",
        of_lines(["Method", "Split", "r_h", "w_max", "safe", *shown, "undecided"], lines, left=2),
    ]
    if len(methods) > 1:
        ranks = [
            [short[m], *(f"{100 * p:.0f} %" for p in row)]
            for m, row in zip(methods, rank_stability(points, methods))
        ]
        parts += [
            f"Share of the {len(points)} settings at which a method has a rank, #1 the best (mean SR of the splits).",
            of_lines(["Method", *(f"#{i + 1}" for i in range(len(methods)))], ranks),
        ]
    if legend_text := legend(short):
        parts.append(notes_list(map(plain, legend_text)))
    parts.append(
        "- Poses as they were predicted for the run's own thresholds.\n"
        f"- undecided: within {ROUNDING_M:g} m of a threshold, where float32 does not tell (counted as computed)."
    )
    return document(parts)


def rethreshold(
    run: Path,
    /,
    *,
    reach_radius: str = "",
    w_max: str = "",
    safe_margin: str = "",
    method: tuple[str, ...] = (),
) -> int:
    """Print the rates of a run folder at other thresholds, and how stable the ranks are.

    Args:
        run: a run folder, as `r2h-batch sweep --out` writes it.
        reach_radius: r_h in metres, A,B,... or LOW:HIGH:STEP.
        w_max: widest material that the gripper holds, at most the run's own.
        safe_margin: distance that the robot must keep from the hand, at most 0.0499.
        method: only these methods, by the sweep's word (fc) or the table's name; by default all.
    """
    from r2h_batch.base.table import notes_list, plain
    from r2h_batch.report.statistics import thresholds
    from r2h_batch.report.statistics.codes import never_judged
    from r2h_batch.runs.store import load_run

    grid = {
        "reach_radius_m": values(reach_radius, "reach-radius") if reach_radius else (),
        "w_max_m": values(w_max, "w-max") if w_max else (),
        "safe_margin_m": values(safe_margin, "safe-margin") if safe_margin else (),
    }
    stored = load_run(run).only(method)
    if not stored.methods:
        raise ValueError(f"{run}: {stored.not_complete()}")
    sys.stdout.write(render(thresholds.rethreshold(stored, **grid), stored.methods))
    if words := never_judged(stored):
        print(notes_list(map(plain, words)))
    return 0
