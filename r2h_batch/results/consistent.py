"""Whether a stored row can be a verdict at all: outcome, criteria, margins and times agree, whoever
wrote them.

What a forged row can still say is another verdict with the margins that go with it: `results verify
--rejudge` finds that.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa

from r2h_batch.config import BORDERLINE_M, FARTHEST_M
from r2h_batch.files import printable
from r2h_batch.results.columns import PATTERNS, codes, pattern, pattern_outcomes, verdicts
from r2h_batch.results.rows import OUTCOME_NAMES, TRIAL_SCHEMA
from r2h_batch.verdicts import CRITERIA, MOST_SECONDS, SPLITS, Outcome

__all__ = ["CHECKED", "inconsistent"]

SECONDS = ("t_plan_s", "t_exec_s", "t_method_s")
CHECKED = (
    "trial_id", "split", "outcome", *(f"passed_{c}" for c in CRITERIA), *(f"margin_{c}_m" for c in CRITERIA), *SECONDS,
)  # fmt: skip
"""Columns of the trials that are looked at."""

TOUCHING = ("stability", "reach")
"""Criteria that a margin of 0 passes (`judge.metrics`)."""
ENDLESS = ("stability", "plan")
"""Criteria whose failure may have no size, -inf: nothing that the shake left, no path."""
MOST_PASSED_M = 1.0
"""No margin of a pass is larger, but Reach's, which is the ball's radius at most: clearances count
5 cm, Stability 1 cm."""


def inconsistent(header: Mapping[str, Any], table: pa.Table) -> str | None:
    """What is wrong with a row of the trials (`CHECKED`) that can be no verdict; None if all
    can."""
    for name in CHECKED:
        if table.schema.field(name).type != TRIAL_SCHEMA.field(name).type:
            return f"column {name!r} is of another type than the format says"
    ids = table["trial_id"].to_numpy()
    if not len(ids):
        return None
    try:
        outcome, split = (
            codes(table, *c).astype(np.int16)
            for c in (("outcome", OUTCOME_NAMES), ("split", SPLITS))
        )
    except (ValueError, IndexError) as error:
        return printable(error)[:200]
    judged = verdicts(table)
    number = pattern(
        {c: given.view(np.uint8) + passed.view(np.uint8) for c, (given, passed) in judged.items()}
    )
    allowed = _outcomes()
    fits = allowed.reshape(-1)[(outcome * len(SPLITS) + split) * allowed.shape[2] + number]
    if not fits.all():
        row = int(fits.argmin())
        said = [OUTCOME_NAMES[k] for k in np.flatnonzero(allowed[:, split[row], number[row]])]
        means = (
            f"its criteria say {' or '.join(said)}"
            if said
            else "its criteria say nothing that can be"
        )
        return f"trial {ids[row]}: outcome is {OUTCOME_NAMES[outcome[row]]!r}, {means}"
    for criterion, (given, passed) in judged.items():
        margin = table[f"margin_{criterion}_m"].to_numpy()
        odd = _first_odd(header, criterion, given, passed, margin)
        if odd is not None:
            verdict = ("is not evaluated", "fails", "passes")[int(given[odd]) + int(passed[odd])]
            return f"trial {ids[odd]}: {criterion} {verdict} with a margin of {margin[odd]:g} m"
    for name in SECONDS:
        seconds = table[name].to_numpy()
        if np.fmin.reduce(seconds) < 0 or np.fmax.reduce(seconds) > MOST_SECONDS:
            row = int(((seconds < 0) | (seconds > MOST_SECONDS)).argmax())
            return f"trial {ids[row]}: {seconds[row]:g} s in {name}; 0 to {MOST_SECONDS:g} s are allowed"
    return None


@lru_cache(maxsize=1)
def _outcomes() -> np.ndarray:
    """(9, 2, 243) whether an outcome goes with a split and a pattern: the first failure, or nothing
    evaluated."""
    found = np.zeros((len(OUTCOME_NAMES), len(SPLITS), len(PATTERNS)), bool)
    for k in range(len(OUTCOME_NAMES)):
        if k < Outcome.INVALID_INPUT:
            found[k] = pattern_outcomes() == k
        else:
            found[k, :, 0] = True
    return found


def _first_odd(
    header: Mapping[str, Any],
    criterion: str,
    given: np.ndarray,
    passed: np.ndarray,
    margin: np.ndarray,
) -> int | None:
    """The first row whose margin has not the sign or size of its verdict; NaN is none."""
    configuration = header["configuration"]
    most, least = MOST_PASSED_M, -1.01 * FARTHEST_M
    if criterion == "reach":
        most = (configuration.get("thresholds") or {}).get(
            "reach_radius_m", FARTHEST_M
        ) + BORDERLINE_M
    if criterion == "plan":
        # planned paths are clear to within the tolerance that clearances are located with; between
        # samples anything is
        sampled = (configuration.get("plan") or {}).get("edge_check") == "moveit"
        good = margin > np.float32(-MOST_PASSED_M if sampled else -BORDERLINE_M)
    else:
        good = margin >= 0 if criterion in TOUCHING else margin > 0
    smallest, largest = np.fmin.reduce(margin), np.fmax.reduce(margin)
    endless = criterion in ENDLESS and np.isneginf(smallest)
    if (
        np.array_equal(good, passed)
        and np.array_equal(margin == margin, given)
        and not largest > most
        and (endless or not smallest < least)
    ):
        return None
    size = (margin > most) | ((margin < least) & ~(np.isneginf(margin) & (criterion in ENDLESS)))
    wrong = (good != passed) | ((margin == margin) != given) | size
    return int(wrong.argmax()) if wrong.any() else None
