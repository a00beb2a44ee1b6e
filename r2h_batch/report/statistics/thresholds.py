"""The same rows at other thresholds, exactly and without another simulation.

r2h_batch.sweep.results.rethreshold says which thresholds can change, and how far.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
import pyarrow as pa

from r2h_batch.base.validate import array, check_arguments, instance_of, sequence_of
from r2h_batch.config import BORDERLINE_M, CLEARANCE_CAP_M, FARTHEST_M
from r2h_batch.report.statistics.codes import (
    FAILED,
    PASSED,
    codes,
    first_failures,
    judged_by,
    states,
)
from r2h_batch.report.statistics.paired import rank_probabilities
from r2h_batch.runs.rows import MISSING, OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import REGISTRY, SPLITS, Outcome

ROUNDING_M = 1e-8
"""A stored float32 margin gives the distance to within this. Nearer to a threshold, a trial is
undecided."""

WIDTH_ROUNDING_M = 1e-6

TOUCHING = {entry.name for entry in REGISTRY if entry.touching_passes}
"""Criteria that a margin of exactly 0 passes."""

MAX_POINTS = 10_000
"""Combinations of thresholds that one call takes."""


@dataclass(frozen=True)
class Point:
    """Outcomes at one combination of thresholds.

    Attributes:
        reach_radius_m: r_h.
        w_max_m: widest material that the gripper holds.
        safe_margin_m: distance that the robot must keep from the hand.
        counts: method -> (2, n) trials by split and outcome, in the order of `OUTCOME_NAMES`.
        undecided: method -> trials too near to a threshold.
        concerned: method -> criterion that is not for all objects -> (2,) trials that it concerns.
    """

    reach_radius_m: float
    w_max_m: float
    safe_margin_m: float
    counts: dict[str, np.ndarray]
    undecided: dict[str, int]
    concerned: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    def rate(self, method: str) -> float:
        """Success rate in percent, the mean over the planned splits as in the paper's Avg.

        Args:
            method: its name in the run.
        """
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
def rethreshold(
    run: Run,
    *,
    reach_radius_m: Sequence[float] = (),
    w_max_m: Sequence[float] = (),
    safe_margin_m: Sequence[float] = (),
) -> tuple[Point, ...]:
    """Count the outcomes at every combination of the thresholds.

    Args:
        run: what `load_run` gives.
        reach_radius_m: values in metres; none: the run's own.
        w_max_m: values up to the run's own, in metres; none: the run's own.
        safe_margin_m: values from 0 to 0.0499, in metres; none: the run's own.

    Raises:
        ValueError: if a value cannot be rescored exactly, or there are more than `MAX_POINTS`
            combinations.
    """
    base = run.header["configuration"].get("thresholds")
    if base is None:
        raise ValueError(f"{run.folder}: run.json names no thresholds; it was not made by a sweep")
    if unknown := [words for words in run.lacking if words.startswith("criterion ")]:
        raise ValueError(
            f"{run.folder}: {unknown[0]} judged these rows and is not installed: a row that passes at other thresholds may"
            " fail it; install its package"
        )
    axes = []
    for key, values, high in (
        ("reach_radius_m", reach_radius_m, FARTHEST_M),
        ("w_max_m", w_max_m, base["w_max_m"]),
        ("safe_margin_m", safe_margin_m, CLEARANCE_CAP_M - BORDERLINE_M),
    ):
        axes.append(tuple(map(float, values)) or (base[key],))
        if bad := [v for v in axes[-1] if not 0 <= v <= high]:
            flag = f"--{key.removesuffix('_m').replace('_', '-')} {bad[0]:g}"
            allowed = f"allowed is 0 to {high:g}: sweep again"
            raise ValueError(f"{flag} cannot be rescored exactly; {allowed}")
    if "presented" in run.asks and (other := [v for v in axes[0] if v != base["reach_radius_m"]]):
        raise ValueError(
            f"--reach-radius {other[0]:g} cannot be rescored exactly: Presented has it too, and these rows do not store how far"
            " the receiver's part is in the ball; sweep again, or change the other thresholds"
        )
    grid = list(product(*axes))
    if len(grid) > MAX_POINTS:
        words = f"at most {MAX_POINTS} are allowed"
        raise ValueError(f"{len(grid)} combinations of thresholds; {words}")
    points = [Point(r_h, w_max, safe, {}, {}) for r_h, w_max, safe in grid]
    for method in run.methods:
        for point in points:
            point.counts[method] = np.zeros((len(SPLITS), len(OUTCOME_NAMES)), np.int64)
            point.undecided[method] = 0
        judged = judged_by(run, method)
        of = {c: np.zeros(len(SPLITS), np.int64) for c in run.concerned}
        for point in points:
            point.concerned[method] = of
        for table in run.shards("trials", method):
            shard = _Margins(table, base, judged, run.concerned)
            for c, mask in shard.concerned.items():
                of[c] += np.bincount(shard.split[mask], minlength=len(SPLITS))
            for point in points:
                counts, undecided = shard.outcomes(point)
                point.counts[method] += counts
                point.undecided[method] += undecided
    return tuple(points)


class _Margins:
    """A shard's distances in float64, and the verdicts of its other criteria."""

    def __init__(
        self,
        table: pa.Table,
        base: dict[str, Any],
        judged: Sequence[str],
        concerned: Mapping[str, frozenset[str]],
    ) -> None:
        def margin(name: str) -> np.ndarray:
            return table[f"margin_{name}_m"].to_numpy().astype(np.float64)

        self.split = codes(table, "split", SPLITS)
        self.outcome = codes(table, "outcome", OUTCOME_NAMES)
        self.state = states(table)
        # the margin was taken from the float32 of the threshold
        self.distance = np.float32(base["reach_radius_m"]).astype(np.float64) - margin("reach")
        width = table["width_m"].to_numpy().astype(np.float64)
        # older runs have no such column; where a grasp passes, its margin is w_max - width
        older = np.float32(base["w_max_m"]).astype(np.float64) - margin("stability")
        self.width = np.where(np.isnan(width), older, width)
        agree = (self.width >= 0) & (self.width <= older + WIDTH_ROUNDING_M)
        odd = (self.state["stability"] == PASSED) & ~agree
        if odd.any():
            row = int(odd.argmax())
            where = f"trial {table['trial_id'][row].as_py()}: width_m is {width[row]:g}"
            what = f"its margin of Stability says at most {older[row]:g}"
            raise ValueError(f"{where}, {what}; `r2h-batch results reevaluate` scores it again")
        self.clearance = margin("safe") + np.float32(base["safe_margin_m"]).astype(np.float64)
        self.base, self.judged = base, judged
        objects = table["object"].to_pylist() if concerned else ()
        self.concerned = {c: np.array([o in own for o in objects]) for c, own in concerned.items()}

    def outcomes(self, point: Point) -> tuple[np.ndarray, int]:
        """(2, n) trials by split and outcome at other thresholds, and how many are undecided."""
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
            if criterion == "stability":
                good = good & (old == PASSED)  # w_max only falls: what failed still fails
            state[criterion] = np.where(old > 0, np.where(good, PASSED, FAILED), old)
            near |= (old > 0) & (np.abs(margin) < ROUNDING_M)
        outcome = first_failures(state, self.split, self.judged, self.concerned)
        judged = self.outcome < Outcome.INVALID_INPUT
        older = (
            self.outcome > MISSING
        )  # failed by what nobody judges by any more, after all the others
        kept = ~judged & ~(older & (outcome != Outcome.SUCCESS))
        outcome = np.where(kept, self.outcome, outcome)
        if (outcome < 0).any():
            count = int((outcome < 0).sum())
            words = f"{count} rows pass, but a criterion was not evaluated"
            if "received" in self.judged:  # asked of what passes all else alone
                words += (
                    "; these rows allow stricter thresholds only, or sweep with --until present"
                )
            raise ValueError(words)
        counts = np.zeros((len(SPLITS), len(OUTCOME_NAMES)), np.int64)
        np.add.at(counts, (self.split, outcome), 1)
        return counts, int(near.sum())


@check_arguments(
    points=sequence_of(Point, "what rethreshold(RUN) gives"),
    methods=sequence_of(str, "names of methods"),
)
def rank_stability(points: Sequence[Point], methods: Sequence[str]) -> np.ndarray:
    """How often each method has each rank by its success rate.

    Args:
        points: what `rethreshold` gives.
        methods: M names.

    Returns:
        (M, M) share of the points at which method i has rank j + 1. Ties share their ranks evenly.
    """
    return rank_probabilities(np.array([[p.rate(m) for m in methods] for p in points]))
