"""Stored words as numbers: codes of words, states of criteria, and the outcome that follows."""

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.runs.store import Run
from r2h_batch.verdicts import CRITERIA, EVERY, IN_ORDER, REGISTRY, SPLITS, Outcome

UNEVALUATED, FAILED, PASSED = 0, 1, 2
"""States of a criterion in a trial."""


def codes(table: pa.Table, name: str, order: Sequence[str]) -> np.ndarray:
    """(N,) int64 places in `order` of a dictionary column's words.

    Raises:
        ValueError: if `order` lacks a word.
    """
    column = table[name].combine_chunks()
    words = column.dictionary.to_pylist()
    place = {w: i for i, w in enumerate(order)}
    if unknown := [w for w in words if w not in place]:
        raise ValueError(f"{name} holds {unknown[0]!r}; known are {', '.join(order)}")
    found = np.array([place[w] for w in words], np.int64)
    return found[column.indices.to_numpy(zero_copy_only=False)]


def states(table: pa.Table) -> dict[str, np.ndarray]:
    """Criterion -> (N,) uint8 `UNEVALUATED`, `FAILED` or `PASSED`, from the columns `passed_*`."""
    names = (entry.name for entry in EVERY)
    there = (c for c in names if f"passed_{c}" in table.column_names)
    columns = {c: table[f"passed_{c}"].cast(pa.uint8()) for c in there}
    return {
        c: pc.add(v, np.uint8(FAILED)).fill_null(UNEVALUATED).to_numpy() for c, v in columns.items()
    }


def judged_by(run: Run, method: str) -> tuple[str, ...]:
    """The criteria that a method's rows were judged by, in the order of `EVERY`: all but those that
    came after its rows, and those that the benchmark of its own run asks for."""
    asks = run.run_of(method).asks
    if not any(entry.since for entry in REGISTRY) or not sum(run.planned(method).values()):
        return (*CRITERIA, *asks)
    columns = run.shard("trials", method, 0).column_names
    return (*(name for name in CRITERIA if f"passed_{name}" in columns), *asks)


def never_judged(run: Run) -> list[str]:
    """A sentence for each criterion that is known here and that did not judge rows of a run: how many, and what SR makes of them.

    Args:
        run: what `load_run` or `join` gives.
    """
    judged = {method: judged_by(run, method) for method in run.methods}
    found = []
    for entry in (e for e in REGISTRY if e.name in CRITERIA):
        methods = [method for method, own in judged.items() if entry.name not in own]
        if n := sum(sum(run.planned(method).values()) for method in methods):
            found.append(
                f"{entry.name} (since {entry.since}) never judged {n} rows of {', '.join(methods)}: SR counts as successes some"
                " that may fail it."
            )
    return found


def first_failures(
    state: Mapping[str, np.ndarray],
    split: np.ndarray,
    judged: Sequence[str] = CRITERIA,
    concerned: Mapping[str, np.ndarray] | None = None,
) -> np.ndarray:
    """The outcome that the criteria of each trial give.

    Args:
        state: criterion -> (N,) `UNEVALUATED`, `FAILED` or `PASSED`.
        split: (N,) int, place in `SPLITS`.
        judged: criteria that the rows were judged by (`judged_by`).
        concerned: criterion that is not for all objects -> (N,) bool, whether it concerns the trial's.

    Returns:
        (N,) int8 code of `Outcome`: the first failed criterion (`IN_ORDER`), or success; -1 if no criterion
        failed and one that the split requires was not evaluated.
    """
    found = np.full(len(split), Outcome.SUCCESS, np.int8)
    unseen = np.zeros(len(split), bool)
    for entry in (e for e in reversed(IN_ORDER) if e.name in state):
        found[state[entry.name] == FAILED] = Outcome[entry.name.upper()]
        required = np.array([s in entry.splits and entry.name in judged for s in SPLITS])
        asked = required[split] & (concerned or {}).get(entry.name, True)
        unseen |= (state[entry.name] == UNEVALUATED) & asked
    found[unseen & (found == Outcome.SUCCESS)] = -1
    return found
