"""Stored columns as numbers: words to codes, a criterion's verdict to one of three states."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.verdicts import CRITERIA, REGISTRY, SPLITS, Outcome

UNEVALUATED, FAILED, PASSED = 0, 1, 2
"""What a criterion says about a trial: a digit of its pattern."""

REQUIRED = np.array([entry.splits == SPLITS for entry in REGISTRY])
"""(C,) criteria that every success in either split must have been judged by."""

PATTERNS = np.array(np.unravel_index(np.arange(3 ** len(CRITERIA)), (3,) * len(CRITERIA))).T
"""(243, 5) the criteria's words of every pattern; a trial's pattern is the row, invalid and missing
trials have row 0."""


def codes(table: pa.Table, name: str, order: Sequence[str]) -> np.ndarray:
    """(N,) int64 places in `order` of a column's words."""
    column = table[name].combine_chunks()
    words = column.dictionary.to_pylist()
    place = {w: i for i, w in enumerate(order)}
    if unknown := [w for w in words if w not in place]:
        raise ValueError(f"{name} holds {unknown[0]!r}; known are {', '.join(order)}")
    found = np.array([place[w] for w in words], np.int64)
    return found[column.indices.to_numpy(zero_copy_only=False)]


def states(table: pa.Table) -> dict[str, np.ndarray]:
    """Criterion -> (N,) uint8 `UNEVALUATED`, `FAILED` or `PASSED`, from the columns `passed_*`."""
    columns = {c: table[f"passed_{c}"].cast(pa.uint8()) for c in CRITERIA}
    return {
        c: pc.add(v, np.uint8(FAILED)).fill_null(UNEVALUATED).to_numpy() for c, v in columns.items()
    }


def pattern(state: dict[str, np.ndarray]) -> np.ndarray:
    """(N,) the states as one number, base 3 in the order of `CRITERIA`: a row of `PATTERNS`."""
    kind = np.min_scalar_type(len(PATTERNS))  # uint8 holds the 243 patterns of five criteria
    number = np.zeros(len(state[CRITERIA[0]]), kind)
    for c in CRITERIA:
        number = kind.type(3) * number + state[c].astype(kind, copy=False)
    return number


def pattern_outcomes() -> np.ndarray:
    """(2, 243) outcome of every pattern on S0 and on S1; -1: a needed one was not looked at."""
    failed = PATTERNS == FAILED
    names = np.array([Outcome[c.upper()] for c in CRITERIA], np.int8)
    first = np.where(failed.any(1), names[failed.argmax(1)], np.int8(Outcome.SUCCESS))
    table = np.tile(first, (2, 1)).astype(np.int8)
    for k, required in enumerate((REQUIRED, np.ones(len(CRITERIA), bool))):
        unseen = ((PATTERNS == UNEVALUATED) & required).any(1)
        table[k, (first == Outcome.SUCCESS) & unseen] = -1
    return table
