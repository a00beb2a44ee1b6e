"""A method's stored trials, counted: what is kept grows with what differs, not with the trials."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.report.statistics.codes import first_failures, judged_by, states
from r2h_batch.report.statistics.shares import counted_shares, with_shares
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import CRITERIA, EVERY, SPLITS, Outcome

SECONDS = ("t_plan_s", "t_exec_s", "t_method_s")
"""Stored times."""

_WORDS = ("object", "split", "outcome")
_KEYS = [*_WORDS, *(f"passed_{entry.name}" for entry in EVERY)]
_PIECES = 64
"""Number of shards' counts that are added up together."""


@dataclass(frozen=True)
class Tally:
    """A method's trials in groups that agree in object, split, outcome and every criterion's verdict.

    Attributes:
        method: its name.
        splits: the planned ones.
        objects: names in the order in which they were met. Arrow's groups have no order.
        groups: a row for each group. Columns: object, split, outcome, passed_CRITERION (null: not
            evaluated), the number n of trials, its successes, and for each of `SECONDS` and `counted_shares`
            the NAME_sum of its values (seconds, or 0 and 1) and the NAME_count of trials that have
            one.
        judged: criteria that the rows were judged by.
        category: object -> its family; an object that is not here is its own category.
        concerned: criterion that is not for all objects -> those that it concerns.
    """

    method: str
    splits: tuple[str, ...]
    objects: tuple[str, ...]
    groups: pa.Table
    judged: tuple[str, ...] = CRITERIA
    category: Mapping[str, str] = field(default_factory=dict)
    concerned: Mapping[str, frozenset[str]] = field(default_factory=dict)

    @staticmethod
    def of(method: str, splits: Sequence[str], tables: Iterable[pa.Table]) -> "Tally":
        """Count tables of stored rows; they need the columns of a run's trials that are read here.

        The sums do not depend on the order of the rows: a float32 has 24 bits, so float64 adds a
        hundred million of a similar size exactly.

        Raises:
            ValueError: if a split or an outcome is unknown.
        """
        objects: dict[str, None] = {}
        groups: list[pa.Table] = []
        for table in tables:
            objects |= dict.fromkeys(pc.unique(table["object"]).to_pylist())
            groups.append(_counted(table))
            if len(groups) == _PIECES:
                groups = [_summed_alike(groups)]
        whole = _summed_alike(groups)
        for name, known in (("split", SPLITS), ("outcome", OUTCOME_NAMES)):
            if unknown := [w for w in pc.unique(whole[name]).to_pylist() if w not in known]:
                raise ValueError(f"{name} holds {unknown[0]!r}; known are {', '.join(known)}")
        return Tally(method, tuple(splits), tuple(objects), whole)

    def of_split(self, split: str) -> "Tally":
        """The trials of a split alone."""
        return replace(self, groups=self.groups.filter(pc.equal(self.groups["split"], split)))

    def by(self, *keys: str) -> list[dict[str, Any]]:
        """The counts of `groups` added up over those that agree in these columns, a dict for each."""
        return _summed(self.groups, keys).to_pylist()


def tally(run: Run, method: str) -> Tally:
    """A stored method's trials, counted shard by shard.

    Args:
        run: what `load_run` or `join` gives; objects and criteria are those of the method's own run.
        method: its name in the run.

    Raises:
        ValueError: if a split has not as many rows as planned, or an outcome is unknown or not the
            first failure.
    """
    trials, own = run.planned(method), run.run_of(method)
    counted = Tally.of(method, tuple(trials), run.shards("trials", method, _stored(own)))
    counted = replace(
        counted, judged=judged_by(run, method), category=own.categories, concerned=own.concerned
    )
    n = {found["split"]: found["n"] for found in counted.by("split")}
    check_planned(method, trials, n)
    groups = counted.groups
    split, outcome = (
        np.array([order.index(word) for word in groups[name].to_pylist()], np.int64)
        for name, order in (("split", SPLITS), ("outcome", OUTCOME_NAMES))
    )
    objects = groups["object"].to_pylist()
    concerned = {
        c: np.array([o in names for o in objects], bool) for c, names in counted.concerned.items()
    }
    says = first_failures(states(groups), split, counted.judged, concerned)
    other = (outcome < Outcome.INVALID_INPUT) & (outcome != says)
    if odd := int(groups["n"].to_numpy()[other].sum()):
        words = "rows have another outcome than their criteria say"
        raise ValueError(
            f"{method}: {odd} {words}; `r2h-batch results reevaluate` judges them again"
        )
    return counted


def check_planned(method: str, trials: Mapping[str, int], found: Mapping[str, int]) -> None:
    """Raise `ValueError` unless the rows that were found in each split are those planned."""
    for split, planned in trials.items():
        if (count := found.get(split, 0)) != planned:
            raise ValueError(f"{method}: {count} rows in {split}, {planned} were planned")


def _stored(run: Run) -> list[str]:
    """The columns that are read."""
    needs = (column for share in counted_shares().values() for column in share.needs)
    keys = (*_WORDS, *(f"passed_{entry.name}" for entry in run.criteria))
    return list(dict.fromkeys((*keys, *SECONDS, *needs)))


def _keys(table: pa.Table) -> list[str]:
    """Those of `_KEYS` that a table has: not all benchmarks ask for every criterion."""
    return [name for name in _KEYS if name in table.column_names]


def _summed_alike(groups: list[pa.Table]) -> pa.Table:
    """The counts added up over the groups that agree in all that tells groups apart."""
    whole = pa.concat_tables(groups)
    return _summed(whole, _keys(whole))


def _summed_up() -> list[str]:
    """The columns that are added up, beside the number of rows and of successes."""
    return [*SECONDS, *counted_shares()]


def _counts() -> list[str]:
    sums = (f"{name}_{how}" for name in _summed_up() for how in ("sum", "count"))
    return ["n", "successes", *sums]


def _counted(table: pa.Table) -> pa.Table:
    """The groups of stored rows."""
    success = pc.equal(table["outcome"].cast(pa.string()), Outcome.SUCCESS.name.lower())
    table = with_shares(table).append_column("successes", success)
    added = [(name, how) for name in _summed_up() for how in ("sum", "count")]
    keys = _keys(table)
    groups = table.group_by(keys, use_threads=False)
    groups = groups.aggregate([([], "count_all"), ("successes", "sum"), *added])
    groups = groups.rename_columns([*keys, *_counts()])
    types = dict.fromkeys(_WORDS, pa.string())
    types |= {f"{name}_sum": pa.float64() for name in counted_shares()}
    for name, kind in types.items():
        groups = groups.set_column(groups.column_names.index(name), name, groups[name].cast(kind))
    return groups


def _summed(groups: pa.Table, keys: Sequence[str]) -> pa.Table:
    """The counts added up over the groups that agree in `keys`; 0 where no trial has a value."""
    found = groups.group_by(list(keys), use_threads=False)
    found = found.aggregate(
        [(name, "sum", pc.ScalarAggregateOptions(min_count=0)) for name in _counts()]
    )
    return found.rename_columns([*keys, *_counts()])
