"""Stored columns as numbers: words to codes, a criterion's verdict to one of three states."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from r2h_batch.verdicts import CRITERIA

UNEVALUATED, FAILED, PASSED = 0, 1, 2
"""What a criterion says about a trial: a digit of its pattern."""


def codes(table: pa.Table, name: str, order: Sequence[str], *, grow: bool = False) -> np.ndarray:
    """(N,) int64 places in `order` of a column's words; new words extend `order` (a list) if it may `grow`."""
    column = table[name].combine_chunks()
    words = column.dictionary.to_pylist()
    place = {w: i for i, w in enumerate(order)}
    if grow and isinstance(order, list):
        new = [w for w in dict.fromkeys(words) if w not in place]
        place |= {w: len(order) + i for i, w in enumerate(new)}
        order.extend(new)
    if unknown := [w for w in words if w not in place]:
        raise ValueError(f"{name} holds {unknown[0]!r}; known are {', '.join(order)}")
    return np.array([place[w] for w in words], np.int64)[column.indices.to_numpy(zero_copy_only=False)]


def states(table: pa.Table) -> dict[str, np.ndarray]:
    """Criterion -> (N,) `UNEVALUATED`, `FAILED` or `PASSED`, from the columns `passed_*`."""
    found = {}
    for c in CRITERIA:
        column = table[f"passed_{c}"].combine_chunks()
        passed = column.fill_null(False).to_numpy(zero_copy_only=False)
        found[c] = column.is_valid().to_numpy(zero_copy_only=False).astype(np.int64) + passed
    return found


def pattern(state: dict[str, np.ndarray]) -> np.ndarray:
    """(N,) the five states as one number, base 3 in the order of `CRITERIA`: a row of `aggregate.PATTERNS`."""
    number = np.zeros(len(state[CRITERIA[0]]), np.int64)
    for c in CRITERIA:
        number = 3 * number + state[c]
    return number
