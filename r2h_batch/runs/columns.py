"""Stored columns as numbers: words to codes, a criterion's verdict to one of three states."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from r2h_batch.verdicts import CRITERIA, REGISTRY, SPLITS, Outcome

UNEVALUATED, FAILED, PASSED = 0, 1, 2
"""What a criterion says about a trial: a digit of its pattern."""

REQUIRED = np.array([entry.splits == SPLITS for entry in REGISTRY])
"""(C,) criteria that every success in either split must have been judged by."""

PATTERNS = np.array(np.unravel_index(np.arange(3 ** len(CRITERIA)), (3,) * len(CRITERIA))).T
"""(243, 5) the criteria's words of every pattern; a trial's pattern is the row, invalid and missing
trials have row 0."""


def codes(table: pa.Table, name: str, order: Sequence[str], *, grow: bool = False) -> np.ndarray:
    """(N,) int64 places in `order` of a column's words; new words extend `order` (a list) if it may
    `grow`."""
    column = table[name].combine_chunks()
    words = column.dictionary.to_pylist()
    place = {w: i for i, w in enumerate(order)}
    if grow and isinstance(order, list):
        new = [w for w in dict.fromkeys(words) if w not in place]
        place |= {w: len(order) + i for i, w in enumerate(new)}
        order.extend(new)
    if unknown := [w for w in words if w not in place]:
        raise ValueError(f"{name} holds {unknown[0]!r}; known are {', '.join(order)}")
    return np.array([place[w] for w in words], np.int64)[
        column.indices.to_numpy(zero_copy_only=False)
    ]


def verdicts(table: pa.Table) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Criterion -> (N,) bool: evaluated, and passed (False where it was not evaluated), from the
    columns `passed_*`."""
    found = {}
    for c in CRITERIA:
        column = table[f"passed_{c}"].combine_chunks()
        given, value = (_bits(buffer, column) for buffer in column.buffers())
        found[c] = given, value & given
    return found


def _bits(buffer: pa.Buffer | None, column: pa.BooleanArray) -> np.ndarray:
    """(N,) bool of a bitmap; no bitmap: all of them."""
    if buffer is None:
        return np.ones(len(column), bool)
    whole = np.unpackbits(
        np.frombuffer(buffer, np.uint8), count=column.offset + len(column), bitorder="little"
    )
    return whole[column.offset :].view(bool)


def states(table: pa.Table) -> dict[str, np.ndarray]:
    """Criterion -> (N,) uint8 `UNEVALUATED`, `FAILED` or `PASSED`, from the columns `passed_*`."""
    return {
        c: given.view(np.uint8) + passed.view(np.uint8)
        for c, (given, passed) in verdicts(table).items()
    }


def pattern(state: dict[str, np.ndarray]) -> np.ndarray:
    """(N,) the states as one number, base 3 in the order of `CRITERIA`: a row of `PATTERNS`."""
    kind = np.min_scalar_type(len(PATTERNS))  # uint8 holds the 243 patterns of five criteria
    number = np.zeros(len(state[CRITERIA[0]]), kind)
    for c in CRITERIA:
        number = kind.type(3) * number + state[c].astype(kind, copy=False)
    return number


def pattern_outcomes(order: Sequence[str] = CRITERIA) -> np.ndarray:
    """(2, 243) outcome of every pattern on S0 and on S1 for an order of the criteria; -1: a needed
    one was not looked at."""
    if sorted(order) != sorted(CRITERIA):
        raise ValueError(
            f"an order of criteria is {', '.join(order)}; it must hold each of {', '.join(CRITERIA)} once"
        )
    columns = [CRITERIA.index(c) for c in order]
    failed = PATTERNS[:, columns] == FAILED
    codes_ = np.array([Outcome[c.upper()] for c in order], np.int8)
    first = np.where(failed.any(1), codes_[failed.argmax(1)], np.int8(Outcome.SUCCESS)).astype(
        np.int8
    )
    table = np.tile(first, (2, 1))
    for k, required in enumerate((REQUIRED, np.ones(len(CRITERIA), bool))):
        unseen = ((PATTERNS == UNEVALUATED) & required).any(1)
        table[k, (first == Outcome.SUCCESS) & unseen] = -1
    return table
