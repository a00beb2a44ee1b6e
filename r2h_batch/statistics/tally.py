"""A method's stored verdicts, counted shard by shard: what is kept grows with what differs, not
with the trials."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import pyarrow as pa

from r2h_batch.runs.columns import PATTERNS, codes, pattern, states
from r2h_batch.runs.rows import MISSING, OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import CRITERIA, SPLITS

__all__ = ["SECONDS", "Sum", "Tally", "Verdicts", "tally", "verdicts"]

SECONDS = ("t_plan_s", "t_exec_s", "t_method_s")
"""Stored times."""

SUMMED = (*SECONDS, "presented", "body_met")
"""What is added up trial by trial: times, who was presented the region, and whose arm or torso was
met."""

BLOCK = 8192


@dataclass(frozen=True)
class Verdicts:
    """Some of a method's trials as (N,) columns: index into `SPLITS`, object and outcome codes, row
    of `PATTERNS` (the five verdicts on their own), seconds (NaN: none)."""

    split: np.ndarray
    object: np.ndarray
    outcome: np.ndarray
    pattern: np.ndarray
    t_plan_s: np.ndarray
    t_exec_s: np.ndarray
    t_method_s: np.ndarray
    trial_id: np.ndarray
    presented: np.ndarray | None = None
    """1 and 0, NaN where it is not asked; None: nowhere"""
    body_met: np.ndarray | None = None
    """the same of motions past a receiver with a body"""

    def __post_init__(self) -> None:
        n = len(self.outcome)
        for name in ("presented", "body_met"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full(n, np.nan, np.float32))
        for column in fields(self):
            if len(found := getattr(self, column.name)) != n:
                raise ValueError(f"Verdicts.{column.name} has {len(found)} rows, outcome has {n}")
        if n and not (self.outcome.min() >= 0 and self.outcome.max() <= MISSING):
            raise ValueError(
                f"Verdicts.outcome must lie in 0..{MISSING} ({', '.join(OUTCOME_NAMES)})"
            )

    def __len__(self) -> int:
        return len(self.outcome)

    def rows(self, first: int, last: int | None = None) -> "Verdicts":
        """Rows first..last-1."""
        return Verdicts(*(getattr(self, column.name)[first:last] for column in fields(self)))

    def where(self, kept: np.ndarray) -> "Verdicts":
        """The rows that the mask (N,) keeps."""
        return Verdicts(*(getattr(self, column.name)[kept] for column in fields(self)))


class Sum:
    """Sum and number of float32 values that come in pieces: for any pieces the bits of one sum over
    all of them.

    NumPy converts a float32 array to float64 in blocks of 8192, sums each and adds the sums up; so
    does this. What has not filled a block yet is kept.
    """

    def __init__(self) -> None:
        self.count, self._total = 0, 0.0
        self._kept: list[np.ndarray] = []

    def add(self, values: np.ndarray) -> None:
        """More values; NaN is none."""
        values = np.asarray(values, np.float32)
        values = values[~np.isnan(values)]
        waiting = self.count % BLOCK
        self.count += len(values)
        if waiting + len(values) < BLOCK:
            if len(values):
                self._kept.append(values)
            return
        whole = np.concatenate([*self._kept, values])
        for first in range(0, len(whole) - BLOCK + 1, BLOCK):
            self._total += float(np.add.reduce(whole[first : first + BLOCK].astype(np.float64)))
        rest = whole[len(whole) - self.count % BLOCK :].copy()
        self._kept = [rest] if len(rest) else []

    @property
    def mean(self) -> float | None:
        """None over none."""
        if not self.count:
            return None
        rest = np.concatenate([*self._kept, np.zeros(0, np.float32)]).astype(np.float64)
        return (self._total + float(np.add.reduce(rest)) if len(rest) else self._total) / self.count


_NO_ROWS = np.zeros(0, np.int64)


@dataclass
class Tally:
    """A method's trials counted: (K,) kinds of trial that were met and how many there were of each,
    and sums of times.

    A kind is one number, made of object, split, outcome and pattern; times are summed for each
    split, and with `by_object` for each object of it too.
    """

    method: str
    splits: tuple[str, ...] = SPLITS  # planned ones
    objects: Sequence[str] = ()  # names behind the codes
    by_object: bool = False
    kinds: np.ndarray = field(default_factory=lambda: _NO_ROWS)
    count: np.ndarray = field(default_factory=lambda: _NO_ROWS)
    sums: dict[tuple[int, int | None, str], Sum] = field(default_factory=dict)

    def add(self, rows: Verdicts) -> None:
        """Count more trials, which follow those counted already in the plan's order."""
        if not len(rows):
            return
        kinds = _kinds(rows.object, rows.split, rows.outcome, rows.pattern)
        kinds, count = np.unique(kinds, return_counts=True)
        self.kinds, place = np.unique(np.concatenate([self.kinds, kinds]), return_inverse=True)
        count, self.count = np.concatenate([self.count, count]), np.zeros(len(self.kinds), np.int64)
        np.add.at(self.count, place, count)
        for k in np.unique(rows.split).tolist():
            inside = rows.split == k
            seconds = {name: getattr(rows, name)[inside] for name in SUMMED}
            for name, values in seconds.items():
                self.sum_of(k, None, name).add(values)
            if self.by_object:
                order = np.argsort(rows.object[inside], kind="stable")
                found, first = np.unique(rows.object[inside][order], return_index=True)
                for name, values in seconds.items():
                    for code, part in zip(found.tolist(), np.split(values[order], first[1:])):
                        self.sum_of(k, code, name).add(part)

    def sum_of(self, split: int, code: int | None, name: str) -> Sum:
        """A time's sum over a split, or over an object (`code`) of it."""
        if code is not None and not self.by_object:
            raise ValueError(f"{self.method}: times were not summed object by object")
        return self.sums.setdefault((split, code, name), Sum())

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(K,) object, split, outcome and pattern of the kinds."""
        rest, pattern_ = np.divmod(self.kinds, len(PATTERNS))
        rest, outcome = np.divmod(rest, MISSING + 1)
        code, split = np.divmod(rest, len(SPLITS))
        return code, split, outcome, pattern_

    def with_outcomes(self, outcome: np.ndarray) -> "Tally":
        """The same trials, other outcomes (K,) of the kinds."""
        code, split, _, pattern_ = self.columns
        return replace(self, kinds=_kinds(code, split, outcome, pattern_))


def _kinds(
    code: np.ndarray, split: np.ndarray, outcome: np.ndarray, pattern_: np.ndarray
) -> np.ndarray:
    place = code.astype(np.int64) * len(SPLITS) + split
    return (place * (MISSING + 1) + outcome) * len(PATTERNS) + pattern_


def tally(run: Run, method: str, *, by_object: bool = False) -> Tally:
    """A stored method's trials counted, checked as `verdicts` does."""
    names: list[str] = []
    counted = Tally(method, tuple(run.header["trials"]), names, by_object)
    for rows in verdicts(run, method, names):
        counted.add(rows)
    return counted


def verdicts(run: Run, method: str, names: list[str]) -> Iterator[Verdicts]:
    """A stored method's verdicts shard by shard; `names` collects the objects' names behind the
    codes.

    Checked at the end: that there were as many as planned. That each row can be a verdict was
    checked when the run was loaded.
    """
    columns = [
        "trial_id",
        "object",
        "split",
        "outcome",
        "presented",
        "body_m",
        *SECONDS,
        *(f"passed_{c}" for c in CRITERIA),
    ]
    found = np.zeros(len(SPLITS), np.int64)
    for table in run.shards("trials", method, columns):
        rows = _rows(table, method, names)
        found += np.bincount(rows.split, minlength=len(SPLITS))
        yield rows
    for name, planned in run.header["trials"].items():
        if (count := int(found[SPLITS.index(name)])) != planned:
            raise ValueError(f"{method}: {count} rows in {name}, {planned} were planned")


def _rows(table: pa.Table, method: str, names: list[str]) -> Verdicts:
    try:
        return Verdicts(
            split=codes(table, "split", SPLITS).astype(np.int8),
            object=codes(table, "object", names, grow=True).astype(np.int32),
            outcome=codes(table, "outcome", OUTCOME_NAMES).astype(np.int8),
            pattern=pattern(states(table)).astype(np.min_scalar_type(len(PATTERNS))),
            trial_id=table["trial_id"].to_numpy(),
            presented=table["presented"].cast("float32").to_numpy(),
            body_met=_below_zero(table["body_m"].to_numpy()),
            **{k: table[k].to_numpy().astype(np.float32) for k in SECONDS},
        )
    except ValueError as error:
        raise ValueError(f"{method}: {error}") from None


def _below_zero(values: np.ndarray) -> np.ndarray:
    """1 and 0, NaN where nothing is known."""
    return np.where(np.isnan(values), np.nan, values < 0).astype(np.float32)
