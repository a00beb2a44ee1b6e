"""Stored rows against the plan: whoever answered, a row is about the trial, object and hand that
the protocol says."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from r2h_batch.files import printable
from r2h_batch.results.consistent import CHECKED, inconsistent
from r2h_batch.turns import PROTOCOLS, hands_in_turn, objects_in_turn, trial_ids
from r2h_batch.verdicts import SIDES, SPLITS

__all__ = ["not_as_planned", "stored_wrong"]

_COMPARED = {
    "trials": ("trial_id", "object", "split", "side"),
    "details": ("trial_id", "hand_index"),
    "failures": ("trial_id", "object", "hand_index"),
}
"""Columns of stored files that the plan decides; of the other kinds the trial's id alone."""


def not_as_planned(
    header: Mapping[str, Any], first: int, last: int, table: pa.Table, *, every: bool
) -> str | None:
    """What differs from positions first..last-1 of the plan, None if nothing; `every`: all of them
    are there.

    Of a run of another protocol nothing is known.
    """
    if header["protocol"] not in PROTOCOLS:
        return None
    if "objects" not in header:
        return "cannot be compared with the plan: run.json names no objects"
    planned = trial_ids(header["trials"], first, last)
    ids = table["trial_id"].to_numpy()
    if np.array_equal(planned, ids):
        return _other_names(header, ids, table)
    order = np.argsort(planned)
    place = (
        order[np.searchsorted(planned[order], ids).clip(max=len(planned) - 1)]
        if len(planned)
        else order
    )
    strange = np.flatnonzero(planned[place] != ids) if len(planned) else np.arange(len(ids))
    if len(strange):
        return f"trial_id {ids[strange[0]]} is not planned here"
    if (np.diff(place) <= 0).any():
        row = int(np.argmax(np.diff(place) <= 0)) + 1
        return f"trial_id {ids[row]} is not where the plan has it"
    if every and len(ids) != len(planned):
        return f"{len(planned) - len(ids)} planned trials are missing"
    return _other_names(header, ids, table)


def _other_names(header: Mapping[str, Any], ids: NDArray[np.int64], table: pa.Table) -> str | None:
    """Object, split, hand and side of the hand, where the table has them; the hand where run.json
    lists the set's sides."""
    names, splits = ([o[k] for o in header["objects"]] for k in ("name", "split"))
    try:
        objects, side = objects_in_turn(ids, splits)
    except ValueError as error:
        return f"cannot be compared with the plan: {error}"
    sides = np.array([SIDES.index(s) for s in header.get("hands", ())], np.int64)
    if (
        len(sides) and (sides == sides[0]).all()
    ):  # a set of one side gives that one whoever's turn it is
        side = np.full_like(side, sides[0])
    for column, words, codes in (
        ("object", names, objects),
        ("split", SPLITS, ids & 1),
        ("side", SIDES, side),
    ):
        if column not in table.column_names:
            continue
        found = _codes(table[column], words)
        if (wrong := np.flatnonzero(found != codes)).size:
            row = int(wrong[0])
            said = printable(table[column][row].as_py())[:80]
            return f"trial {ids[row]}: {column} is {said!r}, planned is {words[codes[row]]!r}"
    if "hand_index" in table.column_names and len(sides):
        if table.schema.field("hand_index").type != pa.int32() or table["hand_index"].null_count:
            return "column 'hand_index' is not of whole numbers"
        hand, planned = (
            table["hand_index"].to_numpy(),
            hands_in_turn(ids, side, sides, header["protocol"]),
        )
        if (wrong := np.flatnonzero(hand != planned)).size:
            row = int(wrong[0])
            return f"trial {ids[row]}: hand_index is {hand[row]}, planned is {planned[row]}"
    return None


def _codes(column: pa.ChunkedArray, words: Sequence[str]) -> NDArray[np.int64]:
    """(N,) places of a column's words in `words`; -1 for other ones and for none."""
    place = {word: i for i, word in enumerate(words)}
    whole = column.combine_chunks()
    encoded = whole if pa.types.is_dictionary(whole.type) else whole.dictionary_encode()
    known = np.array([*(place.get(w, -1) for w in encoded.dictionary.to_pylist()), -1], np.int64)
    return known[encoded.indices.fill_null(len(known) - 1).to_numpy()]


def stored_wrong(
    header: Mapping[str, Any], first: int, last: int, kind: str, file: Path
) -> str | None:
    """What is wrong with the rows of a stored file: not the plan's, or no verdicts. Only the
    columns it takes are read."""
    known = header["protocol"] in PROTOCOLS
    columns = [
        *(_COMPARED.get(kind, ("trial_id",)) if known else ()),
        *(CHECKED if kind == "trials" else ()),
    ]
    try:
        with pq.ParquetFile(file) as stored:
            rows = stored.metadata.num_rows
            if rows > last - first or (kind == "trials" and rows != last - first):
                return f"holds {rows} rows, planned were {last - first}"
            if missing := [c for c in columns if c not in stored.schema_arrow.names]:
                return f"column {missing[0]!r} is missing"
            table = stored.read(columns=list(dict.fromkeys(columns)))
        if columns and (
            table.schema.field("trial_id").type != pa.int64() or table["trial_id"].null_count
        ):
            return "column 'trial_id' is not of whole numbers"
        wrong = (
            not_as_planned(header, first, last, table, every=kind == "trials") if known else None
        )
        return wrong or (inconsistent(header, table) if kind == "trials" else None)
    except (OSError, pa.ArrowException) as error:
        return f"cannot be read ({printable(error)[:300]})"
