"""A method's stored trials, counted: what is kept grows with what differs, not with the trials.

Words of stored columns become codes, and a criterion's verdict one of three states.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.config import BORDERLINE_M
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run
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


SECONDS = ("t_plan_s", "t_exec_s", "t_method_s")
"""Stored times."""

SUMMED = (*SECONDS, "presented", "body_met", "through")
"""What is added up over trials: times; whether the region was presented; whether the motion met the
receiver's arm or torso; whether a success passed through something (by more than float32's
doubt)."""

_KEYS = ["object", "split", "outcome", *(f"passed_{c}" for c in CRITERIA)]
_STORED = [*_KEYS, *SECONDS, "presented", "body_m", "margin_plan_m"]
_PIECES = 64
"""Counts of shards are merged when so many wait."""


@dataclass(frozen=True)
class Tally:
    """Trials of a method in K groups: those of one group agree in object, split, outcome and the
    verdict of each criterion.

    Attributes:
        method: its name.
        splits: the planned ones.
        objects: names in the order in which they were met.
        object: (K,) int, place in `objects`.
        split: (K,) int, place in `SPLITS`.
        outcome: (K,) int, place in `OUTCOME_NAMES`.
        pattern: (K,) int, row of `PATTERNS`: the verdict of each criterion.
        n: (K,) int, trials of the group.
        sums: name of `SUMMED` -> (K,) float64, sum of its values (seconds, or 0 and 1).
        counts: name of `SUMMED` -> (K,) int, trials that have a value.
    """

    method: str
    splits: tuple[str, ...]
    objects: tuple[str, ...]
    object: np.ndarray
    split: np.ndarray
    outcome: np.ndarray
    pattern: np.ndarray
    n: np.ndarray
    sums: Mapping[str, np.ndarray]
    counts: Mapping[str, np.ndarray]

    @staticmethod
    def of(method: str, splits: Sequence[str], tables: Iterable[pa.Table]) -> "Tally":
        """Count tables of stored rows; they need the columns of a run's trials that are read here.

        The sums do not depend on the order of the rows: a float32 has 24 bits, so float64 adds a
        hundred million of a similar size exactly.
        """
        objects: dict[str, None] = {}
        groups: list[pa.Table] = []
        for table in tables:
            objects |= dict.fromkeys(pc.unique(table["object"]).to_pylist())
            groups.append(_counted(table))
            if len(groups) == _PIECES:
                groups = [_merged(groups)]
        whole = _merged(groups)
        words = pa.table({k: whole[k].dictionary_encode() for k in ("object", "split", "outcome")})
        return Tally(
            method,
            tuple(splits),
            tuple(objects),
            object=codes(words, "object", tuple(objects)),
            split=codes(words, "split", SPLITS),
            outcome=codes(words, "outcome", OUTCOME_NAMES),
            pattern=pattern(states(whole)),
            n=whole["count_all"].to_numpy(),
            sums={name: whole[f"{name}_sum"].to_numpy() for name in SUMMED},
            counts={name: whole[f"{name}_count"].to_numpy() for name in SUMMED},
        )


def tally(run: Run, method: str) -> Tally:
    """A stored method's trials, counted shard by shard.

    Args:
        run: what `load_run` gives.
        method: its name in the run.

    Raises:
        ValueError: if a split has not as many rows as planned, or an outcome is unknown or not the
            first failure.
    """
    trials = run.planned(method)
    counted = Tally.of(method, tuple(trials), run.shards("trials", method, _STORED))
    check_planned(method, trials, np.bincount(counted.split, counted.n, len(SPLITS)))
    says = pattern_outcomes()[counted.split, counted.pattern]
    judged = counted.outcome < Outcome.INVALID_INPUT
    if odd := int(counted.n[judged & (counted.outcome != says)].sum()):
        words = "rows have another outcome than their criteria say"
        raise ValueError(
            f"{method}: {odd} {words}; `r2h-batch results reevaluate` judges them again"
        )
    return counted


def check_planned(method: str, trials: Mapping[str, int], found: np.ndarray) -> None:
    """Raise `ValueError` unless the rows (2,) that were found by split are those planned."""
    for split, planned in trials.items():
        if (count := int(found[SPLITS.index(split)])) != planned:
            raise ValueError(f"{method}: {count} rows in {split}, {planned} were planned")


def _counted(table: pa.Table) -> pa.Table:
    """A shard's groups: their keys as words, trials, sums and numbers of values."""
    table = table.append_column("body_met", pc.less(table["body_m"], 0))
    succeeds = pc.equal(table["outcome"].cast(pa.string()), Outcome.SUCCESS.name.lower())
    through = pc.less(table["margin_plan_m"], -BORDERLINE_M)
    table = table.append_column("through", pc.if_else(succeeds, through, None))
    found = [(name, how) for name in SUMMED for how in ("sum", "count")]
    groups = table.group_by(_KEYS, use_threads=False).aggregate([([], "count_all"), *found])
    columns = {name: groups[name] for name in groups.column_names}
    columns |= {name: groups[name].cast(pa.string()) for name in ("object", "split", "outcome")}
    for name in SUMMED:
        columns[f"{name}_sum"] = groups[f"{name}_sum"].cast(pa.float64()).fill_null(0.0)
    return pa.table(columns)


def _merged(groups: Sequence[pa.Table]) -> pa.Table:
    """The groups of several shards as those of one."""
    names = groups[0].column_names
    added = [(name, "sum") for name in names[len(_KEYS) :]]
    whole = pa.concat_tables(groups).group_by(_KEYS, use_threads=False).aggregate(added)
    return whole.rename_columns(names)
