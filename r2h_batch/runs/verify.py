"""Finds the files of a run folder that cannot be trusted: damaged and foreign ones.

Digests are compared first: nobody opens a shard that is not as its name says, because a flipped bit in a footer can end the
process that opens it.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from r2h_batch.base.io.parquet import refused_parquet
from r2h_batch.base.io.read import printable
from r2h_batch.base.registry import QUESTIONS, is_drawn
from r2h_batch.base.schedule import trial_ids
from r2h_batch.runs.files import RunError, claim, drop_remains, in_the_way
from r2h_batch.runs.header import Shard, shard_at
from r2h_batch.runs.methods import Entry, read_methods
from r2h_batch.runs.shard import (
    ANSWERED,
    StoredShard,
    damage,
    number_of,
    shard_files,
    shard_folder,
)
from r2h_batch.runs.side import HOW, side_files, unbounded


class Problem(NamedTuple):
    """A file that cannot be trusted; `shard` None: it has no shard's name, or lies beside the shards (side.py)."""

    method: str
    shard: Shard | None
    file: Path
    what: str


def problems_of(entries: Collection[Entry], *, number: int | None = None) -> list[Problem]:
    """The files of methods that cannot be trusted.

    Args:
        entries: the methods.
        number: look at this shard only.
    """
    found: list[Problem] = []
    for stored in [stored for entry in entries for stored in _named(entry, number, found)]:
        if what := _wrong_rows(stored):
            found.append(Problem(stored.method, stored.shard, stored.path, what))
    return found if number is not None else [*found, *side_problems(entries)]


def side_problems(entries: Iterable[Entry]) -> list[Problem]:
    """The files beside the shards that nobody should read. No digest in their names tells damage, and a flipped bit in a
    footer can end the process that opens it: so another process opens them first."""
    each = [(entry, path) for entry in entries for path in side_files(entry)]
    refused = refused_parquet([path for _, path in each if not in_the_way(path)])
    return [
        Problem(entry.name, None, path, what)
        for entry, path in each
        if (what := refused.get(path) or unbounded(path, sum(entry.header["trials"].values())))
    ]


def _named(entry: Entry, number: int | None, found: list[Problem]) -> Iterable[StoredShard]:
    """The shards whose digest is in their name; the other files are added to what was found."""
    taken: set[int] = set()
    for path in shard_files(entry.folder, entry.slug):
        own = number_of(path)
        if number is not None and own != number:
            continue
        shard = None if own is None else shard_at(entry.header, own)
        if own is None or shard is None:
            found.append(Problem(entry.name, None, path, "foreign: no shard has this name"))
        elif own in taken:
            found.append(Problem(entry.name, None, path, "foreign: another file holds its shard"))
        elif what := damage(path):
            found.append(Problem(entry.name, shard, path, what))
        else:
            taken.add(own)
            yield StoredShard(path, entry.header, entry.name, shard)


def _wrong_rows(stored: StoredShard) -> str:
    """The fault of a shard's receipt or trials; empty if it has none.

    A digest finds damage; this finds rows of other trials. `results reevaluate` finds other verdicts.
    """
    first, last = stored.shard.first, stored.shard.last
    try:
        outcomes = stored.receipt()["outcomes"].values()
        answered = last - first - sum(counts.get("missing", 0) for counts in outcomes)
        for kind in stored.kinds:
            table = stored.table(kind, ["trial_id"])
            exact = answered if kind in ANSWERED else last - first
            if len(table) > exact or (kind not in ("paths", "failures") and len(table) != exact):
                return f"holds {len(table)} rows of {kind}, planned were {exact}"
            every = kind == "trials"
            if what := not_as_planned(stored.header, first, last, table, every=every):
                return f"{kind}: {what}"
    except RunError as error:
        return str(error).removeprefix(f"{stored.path}: ")
    return ""


def not_as_planned(
    header: Mapping[str, Any], first: int, last: int, table: pa.Table, *, every: bool
) -> str:
    """How rows differ from positions `first` to `last` - 1 of the trial list; empty: they do not.

    Args:
        header: run.json. Nothing is known of trials that no rule drew.
        first: first position.
        last: position after the last one.
        table: rows with `trial_id`.
        every: whether every planned trial must have a row.
    """
    if not is_drawn(header):
        return ""
    planned, ids = trial_ids(header["trials"], first, last), table["trial_id"].to_numpy()
    if len(strange := ids[~np.isin(ids, planned)]):
        return f"trial_id {strange[0]} is not planned here"
    if not np.array_equal(planned[np.isin(planned, ids)], ids):
        return "its trial_id are not in the order of the plan, each once"
    missing = len(planned) - len(ids)
    return f"{missing} planned trials are missing" if every and missing else ""


def first_problem(folder: Path, entries: Sequence[Entry]) -> str:
    """The first shard that cannot be trusted, as one line with what to do; empty: there is none."""
    for problem in problems_of(entries):
        beside = problem.file.parent.name in QUESTIONS
        if problem.shard is not None or beside:
            then = HOW.format(problem.file.parent.name).partition("`")[2]
            redone = f"sets it aside, `{then}" if beside else "marks it, the sweep redoes it"
            how = f"`r2h-batch results verify {folder}` {redone}"
            return f"{printable(problem.file)}: {problem.what}; {how}"
    return ""


def remains(folder: Path, header: dict[str, Any]) -> list[str]:
    """Removes what writers that were killed have left half-written; one line for each file.

    Args:
        folder: the run folder.
        header: run.json.
    """
    places = [shard_folder(folder, e.slug) for e in read_methods(folder, header)]
    beside = [folder / name for name in QUESTIONS]
    return drop_remains(folder, folder / "methods", folder / "benchmark", *places, *beside)


def mark_for_rerun(folder: Path, header: dict[str, Any]) -> list[str]:
    """Rename everything that cannot be trusted to FILE.bad, so that the sweep scores it again. What writers that were killed
    left half-written is removed.

    A shard that looks wrong is looked at again under its claim: meanwhile another part of the
    sweep may have stored it.

    Returns:
        One line for each file.
    """
    entries = {e.name: e for e in read_methods(folder, header)}
    remains(folder, header)
    seen = problems_of(entries.values())
    lines = [set_aside(p) for p in seen if p.shard is None]
    for method, shard in dict.fromkeys((p.method, p.shard) for p in seen if p.shard is not None):
        with claim(entries[method].claim_path(shard.index)) as own:
            if own is not None:  # else another sweep is at work on it
                again = problems_of([entries[method]], number=shard.index)
                lines += [set_aside(problem) for problem in again]
    return lines


def set_aside(problem: Problem) -> str:
    """Renames the file to FILE.bad; one line about it."""
    again = "set aside"
    if problem.shard is not None:
        again = f"shard {problem.shard.index} of {problem.method!r} will be scored again"
    problem.file.replace(problem.file.with_name(f"{problem.file.name}.bad"))
    return f"{printable(problem.file)}: {problem.what}; {again}"
