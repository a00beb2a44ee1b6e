"""A method's stored trials, counted: what is kept grows with what differs, not with the trials."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.config import BORDERLINE_M
from r2h_batch.runs.columns import codes, pattern, pattern_outcomes, states
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import CRITERIA, SPLITS, Outcome

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
        pattern: (K,) int, row of `runs.columns.PATTERNS`: the verdict of each criterion.
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
