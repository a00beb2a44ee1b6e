"""Bounded reading of tables: arrays as CSV and JSON."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import open_file, printable, read_json

MAX_WORD = 200
MAX_CSV_BYTES, MAX_HEAD_BYTES = 512 << 20, 1 << 16


INDEX = ("", "Unnamed: 0")
"""The column of a pandas frame's index, written once and twice."""


def read_csv_arrays(path: Path, columns: Mapping[str, tuple[str, int]]) -> dict[str, Any]:
    """The arrays of a CSV file in UTF-8 whose first line names the columns, in any order.

    Args:
        path: the file.
        columns: name -> kind (int64, float64 or string) and count in a row: the column NAME, or NAME_0 to
            NAME_(count - 1).

    Returns:
        name -> (N,) or (N, count), of the names that the file has.

    Raises:
        FileError: a column is unknown, given twice, empty in a row, or holds something else.
    """
    import numpy as np
    import pyarrow as pa
    import pyarrow.csv as pc

    where = printable(path)
    parts = {
        name: [name] if n == 1 else [f"{name}_{k}" for k in range(n)]
        for name, (_, n) in columns.items()
    }
    kinds = {part: columns[name][0] for name, own in parts.items() for part in own}
    with open_file(path, MAX_CSV_BYTES) as stream:
        head = stream.readline(MAX_HEAD_BYTES)
        stream.seek(0)
        if wrong := _wrong_head(head, kinds):
            raise FileError(f"{where}: {wrong}")
        options = pc.ConvertOptions(column_types=kinds, null_values=[""])
        try:
            table = pc.read_csv(stream, convert_options=options)
            names = table.column_names  # decoded here
        except (pa.ArrowException, UnicodeDecodeError) as error:
            why = printable(error)[:200]
            how = "save it as CSV UTF-8, with commas"
            if "conversion error" in why:
                how = "write whole numbers as 7, other ones as 0.7, texts in UTF-8"
            raise FileError(f"{where}: no readable CSV ({why}); {how}") from None
    names = [n for n in names if n not in INDEX]
    # the first one only: counting each of a million names would take hours
    odd = next((n for n in names if n not in kinds or names.count(n) > 1), None)
    if odd is not None:
        how = "given twice" if odd in kinds else f"unknown; allowed are {', '.join(columns)}"
        raise FileError(f"{where}: column {printable(odd)[:60]!r} is {how}")
    found = {}
    for name, own in parts.items():
        there = [part for part in own if part in names]
        if not there:
            continue
        if missing := [part for part in own if part not in names]:
            raise FileError(f"{where}: column {missing[0]!r} is missing")
        if empty := [part for part in own if table[part].null_count]:
            raise FileError(f"{where}: {empty[0]} is empty in {table[empty[0]].null_count} rows")
        values = [table[part].to_numpy() for part in own]
        if columns[name][0] == "string":
            if any(len(x) > MAX_WORD for x in values[0]):
                raise FileError(f"{where}: {name} is no text of at most {MAX_WORD} characters")
            values = [values[0].astype(np.str_)]
        found[name] = values[0] if len(own) == 1 else np.stack(values, 1)
    return found


def _wrong_head(head: bytes, names: Collection[str]) -> str:
    """Why a first line cannot name the columns, where it is known what it is; else empty."""
    if head.startswith(b"\x1f\x8b"):
        return "is compressed (gzip); unpack it"
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "is in UTF-16; save it as CSV UTF-8, with commas"
    if head.startswith(b"PK"):
        return "is an archive, such as a spreadsheet's file; save it as CSV UTF-8, with commas"
    text = head.decode("utf-8-sig", "replace").strip("\r\n")
    for separator, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
        found = [name.strip().strip('"') for name in text.split(separator)]
        if len(found) > 1 and set(found) & set(names):
            return f"its columns are apart by {word}; save it with commas, and numbers with a point"
    cells = text.split(",")
    spaced = [c for c in cells if c != c.strip() and c.strip().strip('"') in names]
    if spaced:
        return (
            f"column {printable(spaced[0])[:60]!r} has spaces around its name; write names without"
        )
    if text.startswith("#"):
        return "begins with a comment; the first line must name the columns"
    if cells and all(_is_number(c) for c in cells):
        return "its first line holds numbers; it must name the columns"
    return ""


def _is_number(text: str) -> bool:
    try:
        float(text.strip().strip('"'))
    except ValueError:
        return False
    return True


def read_json_arrays(path: Path) -> dict[str, Any]:
    """The arrays of a JSON file, `{NAME: number, text or nested list, ...}`, by name.

    Raises:
        FileError: a list is ragged, or holds something else than numbers or texts.
    """
    import numpy as np

    where, data = printable(path), read_json(path)
    if not isinstance(data, dict):
        raise FileError(f"{where}: must hold an object of lists, one for each array")
    found = {}
    for name, value in data.items():
        try:
            found[name] = np.array(value)
        except (ValueError, OverflowError):
            found[name] = np.array(None)
        if found[name].dtype.kind not in "biufU":
            shown = repr(printable(name)[:60])
            raise FileError(f"{where}: {shown} is not a list of numbers or texts of one shape")
        if found[name].dtype.kind != "b" and _has_truth(value):  # NumPy reads it as 1 or 0
            shown = repr(printable(name)[:60])
            raise FileError(
                f"{where}: {shown} has true or false among numbers or texts; write numbers"
            )
    return found


def _has_truth(value: Any) -> bool:
    """Whether true or false is among nested lists."""
    return isinstance(value, bool) or (isinstance(value, list) and any(map(_has_truth, value)))
