"""The same rows at other thresholds, exactly, without simulating again. Which can be, and how far:
r2h_batch.rescore."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import pyarrow as pa

from r2h_batch.config import BORDERLINE_M, CLEARANCE_CAP_M, FARTHEST_M
from r2h_batch.runs.columns import FAILED, PASSED, codes, pattern, pattern_outcomes, states
from r2h_batch.runs.rows import MISSING, OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.statistics.paired import rank_probabilities
from r2h_batch.validate import array, check_arguments, instance_of, sequence_of
from r2h_batch.verdicts import REGISTRY, SPLITS, Outcome

ROUNDING_M = 1e-8
"""A stored margin gives the distance back to within this (float32): nearer to a threshold, a trial
is undecided."""

WIDTH_ROUNDING_M = 1e-6

TOUCHING = {entry.name for entry in REGISTRY if entry.touching_passes}
"""Criteria that a margin of exactly 0 passes."""

MAX_POINTS = 10_000
"""Combinations of thresholds that one call takes."""


@dataclass(frozen=True)
class Point:
    """Thresholds in metres, and for every method the (2, 9) counts of outcomes per split and the
    undecided trials."""

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


_METRES = array("iuf", 1, "numbers in metres")


@check_arguments(
    run=instance_of(Run, "what load_run(FOLDER) gives"),
    reach_radius_m=_METRES,
    w_max_m=_METRES,
    safe_margin_m=_METRES,
)
def rescore(
    run: Run,
    *,
    reach_radius_m: Sequence[float] = (),
    w_max_m: Sequence[float] = (),
    safe_margin_m: Sequence[float] = (),
) -> tuple[Point, ...]:
    """Counts for every combination of the thresholds; what is not given stays as it was run."""
    base = run.header["configuration"].get("thresholds")
    if base is None:
        raise ValueError(f"{run.folder}: run.json names no thresholds; it was not made by a sweep")
    radii = tuple(map(float, reach_radius_m)) or (base["reach_radius_m"],)
    widths = tuple(map(float, w_max_m)) or (base["w_max_m"],)
    safe = tuple(map(float, safe_margin_m)) or (base["safe_margin_m"],)
    for name, given, low, high in (
        ("reach-radius", radii, 0.0, FARTHEST_M),
        ("w-max", widths, 0.0, base["w_max_m"]),
        ("safe-margin", safe, 0.0, CLEARANCE_CAP_M - BORDERLINE_M),
    ):
        if bad := [v for v in given if not low <= v <= high]:
            raise ValueError(
                f"--{name} {bad[0]:g} cannot be rescored exactly; allowed is {low:g} to {high:g}: sweep again"
            )
    grid = list(product(radii, widths, safe))
    if len(grid) > MAX_POINTS:
        raise ValueError(
            f"{len(grid)} combinations of thresholds; at most {MAX_POINTS} are allowed"
        )
    points = [Point(*key, {}, {}) for key in grid]
    for method in run.methods:
        for point in points:
            point.counts[method], point.undecided[method] = (
                np.zeros((len(SPLITS), MISSING + 1), np.int64),
                0,
            )
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
        def margin(name: str) -> np.ndarray:
            return table[f"margin_{name}_m"].to_numpy().astype(np.float64)

        self.split, self.outcome = (
            codes(table, "split", SPLITS),
            codes(table, "outcome", OUTCOME_NAMES),
        )
        self.state = states(table)
        # float32 of the threshold, because that is what the margin was taken from
        self.distance = np.float32(base["reach_radius_m"]).astype(np.float64) - margin("reach")
        width = table["width_m"].to_numpy().astype(np.float64)
        # runs from before the column was stored: their margin is w_max - w wherever it passes
        older = np.float32(base["w_max_m"]).astype(np.float64) - margin("stability")
        self.width = np.where(np.isnan(width), older, width)
        odd = (self.state["stability"] == PASSED) & ~(
            (self.width >= 0) & (self.width <= older + WIDTH_ROUNDING_M)
        )
        if odd.any():
            row = int(odd.argmax())
            raise ValueError(
                f"trial {table['trial_id'][row].as_py()}: width_m is {width[row]:g}, its margin of Stability says at most "
                f"{older[row]:g}; `r2h-batch results verify --rejudge` scores it again"
            )
        self.clearance = margin("safe") + np.float32(base["safe_margin_m"]).astype(np.float64)
        self.base = base

    def outcomes(self, point: Point) -> tuple[np.ndarray, int]:
        """(2, 9) counts per split and outcome at other thresholds, and how many trials lie too near
        to one to tell."""
        state, near = dict(self.state), np.zeros(len(self.split), bool)
        for criterion, name, spare in (
            ("reach", "reach_radius_m", lambda t: t - self.distance),
            ("stability", "w_max_m", lambda t: t - self.width),
            ("safe", "safe_margin_m", lambda t: self.clearance - t),
        ):
            threshold = getattr(point, name)
            if threshold == self.base[name]:
                continue
            margin = spare(float(np.float32(threshold)))
            good = margin >= 0 if criterion in TOUCHING else margin > 0
            old = self.state[criterion]
            if (
                criterion == "stability"
            ):  # narrower than before: a grasp that failed, for whatever reason, still fails
                good = good & (old == PASSED)
            state[criterion] = np.where(old > 0, np.where(good, PASSED, FAILED), old)
            near |= (old > 0) & (np.abs(margin) < ROUNDING_M)
        outcome = pattern_outcomes()[self.split, pattern(state)].astype(np.int64)
        outcome = np.where(self.outcome < Outcome.INVALID_INPUT, outcome, self.outcome)
        if (outcome < 0).any():
            raise ValueError(
                f"{int((outcome < 0).sum())} rows pass, but a criterion was not evaluated"
            )
        counts = np.bincount(
            self.split * (MISSING + 1) + outcome, minlength=len(SPLITS) * (MISSING + 1)
        )
        return counts.reshape(len(SPLITS), MISSING + 1), int(near.sum())


@check_arguments(
    points=sequence_of(Point, "what rescore(RUN) gives"),
    methods=sequence_of(str, "names of methods"),
)
def rank_stability(points: Sequence[Point], methods: Sequence[str]) -> np.ndarray:
    """(M, M) share of the points at which method i has rank j + 1 by SR; ties share their ranks
    evenly."""
    return rank_probabilities(np.array([[p.rate(m) for m in methods] for p in points]))
