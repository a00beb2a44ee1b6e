"""Other thresholds without simulating again: `python -m r2h_batch.rescore RUN --reach-radius .08:.12:.01`

Exact, trial by trial, for the poses that were scored (a method that asks the evaluator might choose others):
- reach radius: any value, the margin is r_h - distance;
- w_max: up to the run's own. A wider aperture is another gripper: what it would hold was not measured;
- safe margin: from 0 to 4.99 cm, beyond which clearances are only a lower bound.
Not possible: the ball's offset, the pads' squeeze, hand clearance of the path: they change the geometry.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from r2h_batch.aggregate import FAILED, PASSED, pattern_outcomes
from r2h_batch.config import BORDERLINE_M, CLEARANCE_CAP_M
from r2h_batch.results import Run, load_run
from r2h_batch.rows import MISSING, OUTCOME_NAMES, SPLITS
from r2h_batch.types import CRITERIA, Outcome

ROUNDING_M = 1e-8
"""A stored margin gives the distance back to within this (float32): nearer to a threshold, a trial is undecided."""

MAX_POINTS = 10_000


@dataclass(frozen=True)
class Point:
    """Thresholds in metres, and for every method the (2, 9) counts of outcomes per split and the undecided trials."""

    reach_radius_m: float
    w_max_m: float
    safe_margin_m: float
    counts: dict[str, np.ndarray]
    undecided: dict[str, int]

    def rate(self, method: str) -> float:
        """SR in percent, the mean over the planned splits as in the paper's Avg."""
        counts = self.counts[method]
        planned = [row for row in counts if row.sum()]
        return float(np.mean([100 * row[Outcome.SUCCESS] / row.sum() for row in planned]))


def values(text: str, name: str) -> tuple[float, ...]:
    """Numbers of `.08`, `.08,.10` or `LOW:HIGH:STEP` (both ends included)."""
    try:
        if ":" in text:
            low, high, step = map(float, text.split(":"))
            if not (step > 0 and high >= low and (high - low) / step < MAX_POINTS):
                raise ValueError
            return tuple(round(low + i * step, 12) for i in range(int((high - low) / step + 1e-9) + 1))
        numbers = tuple(float(part) for part in text.split(","))
        if not np.isfinite(numbers).all():
            raise ValueError
        return numbers
    except ValueError:
        raise ValueError(f"--{name} is {text!r}; it must be METRES, A,B,... or LOW:HIGH:STEP") from None


def rescore(
    run: Run,
    *,
    reach_radius_m: Sequence[float] = (),
    w_max_m: Sequence[float] = (),
    safe_margin_m: Sequence[float] = (),
) -> tuple[Point, ...]:
    """Counts for every combination of the thresholds; what is not given stays as it was run."""
    base = run.header["configuration"]["thresholds"]
    radii = tuple(reach_radius_m) or (base["reach_radius_m"],)
    widths = tuple(w_max_m) or (base["w_max_m"],)
    safe = tuple(safe_margin_m) or (base["safe_margin_m"],)
    for name, given, low, high in (
        ("reach-radius", radii, 0.0, np.inf),
        ("w-max", widths, 0.0, base["w_max_m"]),
        ("safe-margin", safe, 0.0, CLEARANCE_CAP_M - BORDERLINE_M),
    ):
        if bad := [v for v in given if not low <= v <= high]:
            raise ValueError(
                f"--{name} {bad[0]:g} cannot be rescored exactly; allowed is {low:g} to {high:g}: sweep again"
            )
    grid = list(product(radii, widths, safe))
    if len(grid) > MAX_POINTS:
        raise ValueError(f"{len(grid)} combinations of thresholds; at most {MAX_POINTS} are allowed")
    points = [Point(*key, {}, {}) for key in grid]
    for method in run.methods:
        for point in points:
            point.counts[method], point.undecided[method] = np.zeros((len(SPLITS), MISSING + 1), np.int64), 0
        for table in run.shards("trials", method):
            shard = _Margins(table, base)
            for point in points:
                counts, undecided = shard.outcomes(point)
                point.counts[method] += counts
                point.undecided[method] += undecided
    return tuple(points)


class _Margins:
    """A shard's distances in float64 and what else decides its outcomes."""

    def __init__(self, table: pa.Table, base: dict[str, Any]) -> None:
        def words(name: str, order: Sequence[str]) -> np.ndarray:
            column = table[name].combine_chunks()
            places = np.array([order.index(w) for w in column.dictionary.to_pylist()], np.int64)
            return places[column.indices.to_numpy()]

        def margin(name: str) -> np.ndarray:
            return table[f"margin_{name}_m"].to_numpy().astype(np.float64)

        self.split, self.outcome = words("split", SPLITS), words("outcome", OUTCOME_NAMES)
        self.state = {}
        for c in CRITERIA:
            column = table[f"passed_{c}"].combine_chunks()
            passed = column.fill_null(False).to_numpy(zero_copy_only=False)
            self.state[c] = column.is_valid().to_numpy(zero_copy_only=False).astype(np.int64) + passed
        # float32 of the threshold, because that is what the margin was taken from
        self.distance = np.float32(base["reach_radius_m"]).astype(np.float64) - margin("reach")
        self.width = np.float32(base["w_max_m"]).astype(np.float64) - margin("stability")
        self.clearance = margin("safe") + np.float32(base["safe_margin_m"]).astype(np.float64)
        self.base = base

    def outcomes(self, point: Point) -> tuple[np.ndarray, int]:
        """(2, 9) counts per split and outcome at other thresholds, and how many trials lie too near to one to tell."""
        state, near = dict(self.state), np.zeros(len(self.split), bool)
        for criterion, threshold, before, spare, touching in (
            ("reach", point.reach_radius_m, self.base["reach_radius_m"], lambda t: t - self.distance, True),
            ("stability", point.w_max_m, self.base["w_max_m"], lambda t: t - self.width, True),
            ("safe", point.safe_margin_m, self.base["safe_margin_m"], lambda t: self.clearance - t, False),
        ):
            if threshold == before:
                continue
            margin = spare(float(np.float32(threshold)))
            good = margin >= 0 if touching else margin > 0
            old = self.state[criterion]  # a grasp that failed has a margin below 0, for whatever reason: it still fails
            state[criterion] = np.where(old > 0, np.where(good, PASSED, FAILED), old)
            near |= (old > 0) & (np.abs(margin) < ROUNDING_M)
        pattern = np.zeros(len(self.split), np.int64)
        for c in CRITERIA:
            pattern = 3 * pattern + state[c]
        outcome = pattern_outcomes()[self.split, pattern].astype(np.int64)
        outcome = np.where(self.outcome < Outcome.INVALID_INPUT, outcome, self.outcome)
        if (outcome < 0).any():
            raise ValueError(f"{int((outcome < 0).sum())} rows pass, but a criterion was not evaluated")
        counts = np.bincount(self.split * (MISSING + 1) + outcome, minlength=len(SPLITS) * (MISSING + 1))
        return counts.reshape(len(SPLITS), MISSING + 1), int(near.sum())


def rank_stability(points: Sequence[Point], methods: Sequence[str]) -> np.ndarray:
    """(M, M) share of the points at which method i has rank j + 1 by SR; ties share their ranks evenly."""
    from r2h_batch.compare import rank_probabilities

    return rank_probabilities(np.array([[p.rate(m) for m in methods] for p in points]))


def render(points: Sequence[Point], methods: Sequence[str]) -> str:
    """Tables of rates for every point and method, and the ranks over the points."""
    from r2h_batch.report import NA, aligned

    shown = {"SR": 0, "F_plan": 2, "F_reach": 3, "F_safe": 5, "F_stab": 1, "F_afford": 4}
    lines = []
    for point in points:
        for method in methods:
            for k, counts in enumerate(point.counts[method]):
                if n := counts.sum():
                    skipped = (Outcome.AFFORDANCE,) if SPLITS[k] == "S0" else ()
                    rates = [NA if c in skipped else f"{100 * counts[c] / n:.1f}" for c in shown.values()]
                    key = [f"{v:.4g}" for v in (point.reach_radius_m, point.w_max_m, point.safe_margin_m)]
                    lines.append([method, SPLITS[k], *key, *rates, str(point.undecided[method])])
    parts = [
        "Rates in percent of all planned trials, thresholds in metres, rescored from stored margins.",
        aligned(["Method", "Split", "r_h", "w_max", "safe", *shown, "undecided"], lines, 2),
    ]
    if len(methods) > 1:
        ranks = [[m, *(f"{100 * p:.0f} %" for p in row)] for m, row in zip(methods, rank_stability(points, methods))]
        parts += [
            f"Share of the {len(points)} settings at which a method has a rank (mean SR of the splits).",
            aligned(["Method", *(f"rank {i + 1}" for i in range(len(methods)))], ranks, 1),
        ]
    parts.append(
        "- Poses as they were predicted for the run's own thresholds.\n"
        f"- undecided: within {ROUNDING_M:g} m of a threshold, where float32 does not tell (counted as computed)."
    )
    return "\n\n".join(parts) + "\n"


def main(run: Path, /, *, reach_radius: str = "", w_max: str = "", safe_margin: str = "") -> int:
    """Print the rates of a run folder at other thresholds, and how stable the ranks are.

    Args:
        run: a run folder, as `python -m r2h_batch.sweep --out` writes it.
        reach_radius: r_h in metres, A,B,... or LOW:HIGH:STEP.
        w_max: widest material that the gripper holds, at most the run's own.
        safe_margin: distance that the robot must keep from the hand, at most 0.0499.
    """
    try:
        grid = {
            "reach_radius_m": values(reach_radius, "reach-radius") if reach_radius else (),
            "w_max_m": values(w_max, "w-max") if w_max else (),
            "safe_margin_m": values(safe_margin, "safe-margin") if safe_margin else (),
        }
        stored = load_run(run)
        sys.stdout.write(render(rescore(stored, **grid), stored.methods))
    except (ValueError, OSError) as error:
        print(f"rescore: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    import tyro

    sys.exit(tyro.cli(main))
