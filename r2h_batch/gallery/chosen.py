"""Which trials of a run stand for the others in pictures. Reads stored rows, shard by shard; draws
nothing."""

from collections.abc import Sequence

import numpy as np

from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run

__all__ = ["LOOKED_AT", "SHOWN", "first_of_each_outcome", "shared_trial"]

SHOWN = OUTCOME_NAMES[:6]
"""Outcomes of which there is something to see: success and the five failures."""

LOOKED_AT = 200_000
"""Rows of a method that are looked through."""


def first_of_each_outcome(run: Run, method: str, n: int) -> dict[str, list[int]]:
    """Outcome -> at most `n` trial ids, of different objects where there are some."""
    found: dict[str, dict[str, list[int]]] = {o: {} for o in SHOWN}
    seen = 0
    for table in run.shards("trials", method, ["trial_id", "object", "outcome"]):
        ids = table["trial_id"].to_pylist()
        for trial, name, outcome in zip(
            ids, table["object"].to_pylist(), table["outcome"].to_pylist(), strict=True
        ):
            if outcome in found and len(found[outcome].setdefault(name, [])) < n:
                found[outcome][name].append(trial)
        seen += len(ids)
        if seen >= LOOKED_AT:
            break
    return {o: _in_turn(list(by.values()), n) for o, by in found.items() if by}


def _in_turn(lists: Sequence[Sequence[int]], n: int) -> list[int]:
    """The first of each list, then the second of each, and so on: `n` in all."""
    longest = max(map(len, lists), default=0)
    return [one[k] for k in range(longest) for one in lists if k < len(one)][:n]


def shared_trial(run: Run, methods: Sequence[str]) -> int:
    """The first trial in which as many methods as possible move and not all come to the same
    end."""
    ids, outcomes, count = None, [], None
    for method in methods:
        table = next(iter(run.shards("trials", method, ["trial_id", "outcome", "t_exec_s"])))
        here = table["trial_id"].to_numpy()
        ids = here if ids is None else ids
        if not np.array_equal(ids, here):
            raise ValueError(f"{run.folder}: {method!r} has other trial ids than {methods[0]!r}")
        moves = table["t_exec_s"].is_valid().to_numpy(zero_copy_only=False).astype(int)
        count = moves if count is None else count + moves
        outcomes.append(np.array(table["outcome"].to_pylist(), object))
    if ids is None or count is None or not len(ids):
        raise ValueError(f"{run.folder}: no trial is stored")
    differ = np.array([len(set(words)) > 1 for words in zip(*outcomes, strict=True)])
    return int(ids[np.argmax(2 * count + differ)])
