"""The same verdicts looked at in other ways: per object, which criteria fail together, other orders of the criteria."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from r2h_batch.aggregate import FAILED, PATTERNS, UNEVALUATED, Row, Verdicts, group_row, pattern_outcomes
from r2h_batch.rows import SPLITS
from r2h_batch.types import CRITERIA, Outcome


@dataclass(frozen=True)
class CoFailures:
    """(5, 5) counts in the order of `CRITERIA`: trials in which both fail, and trials in which both were evaluated.

    The diagonal is each criterion on its own, wherever it was evaluated: not only where it was the first failure.
    """

    failed: np.ndarray
    evaluated: np.ndarray


def _patterns(verdicts: Verdicts) -> np.ndarray:
    if verdicts.pattern is None:
        raise ValueError(f"{verdicts.method}: the five verdicts are needed, aggregate.verdicts reads them")
    return verdicts.pattern


def co_failures(verdicts: Verdicts, rows: np.ndarray) -> CoFailures:
    """Which criteria fail together among the trials that the mask `rows` selects."""
    count = np.bincount(_patterns(verdicts)[rows], minlength=len(PATTERNS))
    failed, evaluated = PATTERNS == FAILED, PATTERNS != UNEVALUATED
    return CoFailures(
        np.einsum("p,pi,pj->ij", count, failed, failed), np.einsum("p,pi,pj->ij", count, evaluated, evaluated)
    )


def in_order(verdicts: Verdicts, order: Sequence[str]) -> Verdicts:
    """The verdicts with the first failure looked for in another order of the criteria; SR does not depend on it."""
    outcome = pattern_outcomes(order)[verdicts.split, _patterns(verdicts)]
    judged = verdicts.outcome < Outcome.INVALID_INPUT
    if (unseen := int((outcome[judged] < 0).sum())) > 0:
        raise ValueError(f"{verdicts.method}: {unseen} rows have no failure but a criterion that was not evaluated")
    return replace(verdicts, outcome=np.where(judged, outcome, verdicts.outcome).astype(np.int8))


def by_object(verdicts: Verdicts) -> tuple[tuple[str, Row], ...]:
    """(object, its line of the table) split by split; objects in alphabetical order."""
    lines = []
    for split in verdicts.splits:
        inside = verdicts.split == SPLITS.index(split)
        present = np.bincount(verdicts.object[inside], minlength=len(verdicts.objects)) > 0
        for code in sorted(np.flatnonzero(present), key=lambda c: verdicts.objects[c]):
            lines.append((verdicts.objects[code], group_row(verdicts, inside & (verdicts.object == code), split)))
    return tuple(lines)


def parse_order(text: str) -> tuple[str, ...]:
    """An order of criteria from `plan,reach,...`; those left out follow in the paper's order."""
    first = [name.strip().lower() for name in text.split(",") if name.strip()]
    if unknown := [n for n in first if n not in CRITERIA]:
        raise ValueError(f"unknown criterion {unknown[0]!r}; allowed are {', '.join(CRITERIA)}")
    if len(set(first)) != len(first):
        raise ValueError(f"the order {text!r} names a criterion twice")
    return (*first, *(c for c in CRITERIA if c not in first))
