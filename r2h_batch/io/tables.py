"""Bounded reading of tables: CSV, JSON rows, Parquet. Each value is checked before it is stored."""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Collection, Iterator, Mapping, Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Any

from r2h_batch.io.read import FileError, open_file, printable, read_json

if TYPE_CHECKING:
    import pyarrow.parquet as pq

__all__ = ["check_decoded_size", "read_csv_arrays", "read_json_arrays", "read_parquet_arrays"]

MAX_CSV_BYTES = 1 << 30
MAX_LINE, MAX_ROWS = 10_000, 10_000_000

Widths = Mapping[str, int]
Rows = Iterator[tuple[str, dict[str, Any]]]
"""For each row: its place in the file, and name -> its values."""

MAX_WORD = 200
_ID = "a whole number, 0 or more, of at most 18 digits"
_NUMBER = re.compile(
    r"[-+]?([0-9]{1,30}(\.[0-9]{0,30})?|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?|[-+]?(nan|inf)", re.I
)


def read_csv_arrays(
    path: Path, widths: Widths, optional: Sequence[str] = (), *, names: Sequence[str] = ()
) -> dict[str, Any]:
    """The columns of a CSV file in UTF-8 as arrays.

    The first line names the columns, in any order: NAME for a width of 1, else NAME_0 to
    NAME_(width - 1).

    Args:
        path: the file.
        widths: name -> count of numbers in a row. The first name is an id: 0 or more.
        optional: names that may be missing. Their empty cells become NaN.
        names: names of columns that hold a word.

    Returns:
        name -> (N,) or (N, width) float64; the id (N,) int64; words (N,) text.

    Raises:
        FileError: the message names line and column.
    """
    where = printable(path)
    with open_file(path, MAX_CSV_BYTES) as stream:
        try:
            text = TextIOWrapper(stream, encoding="utf-8-sig", newline="")
            lines = csv.reader(_bounded(text, where), strict=True)
            header = [n.strip() for n in next(lines, [])]
            places = _places(header, widths, optional, where)
            known = {name: n for name, n in widths.items() if name in places}
            rows = _csv_rows(lines, len(header), places, where)
            return _arrays(rows, known, optional, where, names)
        except (csv.Error, UnicodeDecodeError) as error:
            why = printable(error)[:200]
            raise FileError(f"{where}: no readable CSV ({why}); save it as CSV UTF-8") from None


def _bounded(text: TextIOWrapper, where: str) -> Iterator[str]:
    """The lines, none longer than a row can be."""
    number = 0
    while line := text.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise FileError(f"{where}: line {number} is longer than {MAX_LINE} characters")
        yield line


def _places(
    names: list[str], widths: Widths, optional: Sequence[str], where: str
) -> dict[str, list[int]]:
    """The column numbers of each array."""
    columns = {n: [n] if w == 1 else [f"{n}_{i}" for i in range(w)] for n, w in widths.items()}
    known = [c for group in columns.values() for c in group]
    shown = ", ".join(n if w == 1 else f"{n}_0 to {n}_{w - 1}" for n, w in widths.items())
    for n in names:
        if n not in known:
            how = f"needed are {shown}; write commas between columns, and points in numbers"
            raise FileError(f"{where}: line 1: unknown column {printable(n)[:60]!r}; {how}")
        if names.count(n) > 1:
            raise FileError(f"{where}: line 1: column {n} is given twice")
    for name in optional:
        if not set(columns[name]) & set(names):
            del columns[name]
    if missing := [c for group in columns.values() for c in group if c not in names]:
        raise FileError(f"{where}: line 1: column {missing[0]} is missing; needed are {shown}")
    return {name: [names.index(c) for c in group] for name, group in columns.items()}


def _csv_rows(lines: Any, count: int, places: Mapping[str, list[int]], where: str) -> Rows:
    for row in lines:
        place = f"line {lines.line_num}"
        if row and len(row) != count:
            raise FileError(f"{where}: {place} has {len(row)} cells; the first line has {count}")
        if row:
            yield f"{place}: ", {name: [_cell(row[k]) for k in at] for name, at in places.items()}


def _cell(text: str) -> Any:
    """The number in a cell; None for an empty cell, the text itself where it is no number."""
    text = text.strip()
    if text.isdecimal() and text.isascii() and len(text) <= 18:
        return int(text)
    return float(text) if _NUMBER.fullmatch(text) else text or None


def read_json_arrays(
    path: Path, widths: Widths, optional: Sequence[str] = (), *,
    rows: str = "predictions", words: Sequence[str] = (), names: Sequence[str] = (),
) -> tuple[dict[str, Any], dict[str, str]]:  # fmt: skip
    """The rows of a JSON file as arrays, as `read_csv_arrays` does.

    The file holds `{WORD: text, rows: [{NAME: number or list, ...}, ...]}`. A list may be flat or
    nested once.

    Args:
        path: the file.
        widths: name -> count of numbers in a row. The first name is an id: 0 or more.
        optional: names that may be missing.
        rows: name of the field that holds the rows.
        words: names of fields that hold text.
        names: names of a row's fields that hold a word.

    Returns:
        The arrays, and the texts.

    Raises:
        FileError: the message names row and field.
    """
    where, data = printable(path), read_json(path)
    if not isinstance(data, dict) or not isinstance(data.get(rows), list):
        raise FileError(f"{where}: must hold an object with a list {rows!r}")
    texts = {k: v for k, v in data.items() if k != rows}
    for name, value in texts.items():
        if name not in words:
            allowed = ", ".join((rows, *words))
            shown = repr(printable(name)[:60])
            raise FileError(f"{where}: unknown field {shown}; allowed are {allowed}")
        if not isinstance(value, str):
            raise FileError(f"{where}: {name} must be text")
    found = _json_rows(data[rows], rows, widths, where)
    return _arrays(found, widths, optional, where, names), texts


def _json_rows(found: list[Any], field: str, widths: Widths, where: str) -> Rows:
    for i, row in enumerate(found):
        allowed = ", ".join(widths)
        if not isinstance(row, dict):
            raise FileError(f"{where}: {field}.{i} must be an object of {allowed}")
        if unknown := [k for k in row if k not in widths]:
            shown = repr(printable(unknown[0])[:60])
            raise FileError(f"{where}: {field}.{i}: unknown field {shown}; allowed are {allowed}")
        yield f"{field}.{i}.", {name: _flat(value) for name, value in row.items()}


def _flat(value: Any) -> list[Any]:
    items = value if isinstance(value, list) else [value]
    return [x for part in items for x in (part if isinstance(part, list) else [part])]


def _arrays(
    rows: Rows, widths: Widths, optional: Sequence[str], where: str, names: Sequence[str] = ()
) -> dict[str, Any]:
    """Arrays of the rows, each value checked before it is stored."""
    import numpy as np

    key = next(iter(widths))
    values: dict[str, Any] = {name: array("q" if name == key else "d") for name in widths}
    values |= {name: [] for name in names}
    for place, row in rows:
        for name, width in widths.items():
            found = row.get(name, [None])
            if name in names:
                if len(found) != 1 or found[0] is None or len(str(found[0])) > MAX_WORD:
                    problem = f"no word of 1 to {MAX_WORD} characters"
                    raise FileError(f"{where}: {place}{name} is {problem}")
                values[name].append(str(found[0]))
                continue
            if name in optional and found == [None]:
                found = [math.nan] * width
            if problem := _problem(found, width, is_id=name == key):
                raise FileError(f"{where}: {place}{name} is {problem}")
            values[name].extend(found)
        if len(values[key]) > MAX_ROWS:
            raise FileError(f"{where}: more than {MAX_ROWS} rows; split it")
    return {
        n: np.array(v).reshape((-1, widths[n]) if widths[n] > 1 else -1) for n, v in values.items()
    }


def _problem(found: list[Any], width: int, *, is_id: bool) -> str:
    """What is wrong with the values of one row; empty where nothing is."""
    need = _ID if is_id else "a number" if width == 1 else f"{width} numbers"
    if len(found) != width and found != [None]:
        return f"{len(found)} numbers; it must be {need}"
    for x in found:
        right = 0 <= x < 10**18 if is_id and type(x) is int else not is_id and type(x) is float
        if not right and (is_id or type(x) is not int or abs(x) > 10**300):
            shown = "empty" if x is None else printable(repr(x))[:40]
            return f"{shown}; it must be {need}"
    return ""


def read_parquet_arrays(
    path: Path, *, most: int, rows: int, text: Collection[str] = (), row_bytes: int | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The columns of a Parquet file as flat arrays, after its decoded size is bounded.

    The footer says how many values each column has. A column of text with few different words takes
    little space in the file, and much in memory: such columns are read as dictionaries.

    Args:
        path: the file.
        most: largest decoded size of all columns, bytes.
        rows: largest number of rows.
        text: names of the columns of text, read as dictionaries.
        row_bytes: largest decoded size of a row, beside 1 MiB for all; None: `most` alone.

    Returns:
        name -> the numbers or texts of all rows one after another, and, of columns of lists, name ->
        how many each row has.

    Raises:
        FileError: it is damaged, a link leads nowhere, it is too large, or a value is missing.
    """
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    where = printable(path)
    found: dict[str, Any] = {}
    counts: dict[str, Any] = {}
    with open_file(path, most) as stream:
        try:
            there = pq.read_schema(stream).names
            stream.seek(0)
            words = [name for name in text if name in there]
            with pq.ParquetFile(stream, read_dictionary=words) as file:
                if (n := file.metadata.num_rows) > rows:
                    raise FileError(f"{where}: {n} rows; at most {rows} are allowed")
                most = most if row_bytes is None else min(most, (1 << 20) + row_bytes * n)
                check_decoded_size(file, most, where)
                table = file.read().unify_dictionaries()
            for name in table.column_names:
                column = table[name].combine_chunks()
                if column.null_count:
                    shown = printable(name)[:60]
                    raise FileError(f"{where}: {shown!r} is empty in {column.null_count} rows")
                if _is_list(column.type):
                    counts[name] = pc.list_value_length(column).to_numpy(zero_copy_only=False)
                while _is_list(column.type):
                    column = column.flatten()
                if name in words:
                    found[name] = _texts(column, f"{where}: {name}")
                else:
                    found[name] = column.to_numpy(zero_copy_only=False)
        except (OSError, pa.ArrowException) as error:
            why = printable(error)[:300]
            raise FileError(f"{where}: no readable Parquet file ({why}); copy it again") from error
    return found, counts


def _is_list(kind: Any) -> bool:
    import pyarrow.types as types

    return types.is_list(kind) or types.is_fixed_size_list(kind) or types.is_large_list(kind)


def _texts(column: Any, what: str) -> Any:
    """Texts out of a dictionary. A long one is refused before many rows repeat it in memory."""
    import numpy as np

    words = [str(w) for w in column.dictionary.to_pylist()] if hasattr(column, "dictionary") else []
    if any(len(w) > MAX_WORD for w in words) or len(words) < min(1, len(column)):
        raise FileError(f"{what} is no text of at most {MAX_WORD} characters")
    return np.array(words or [""], np.str_)[column.indices.to_numpy(zero_copy_only=False)]


_VALUE_BYTES = {"BOOLEAN": 1, "INT32": 4, "FLOAT": 4, "INT64": 8, "DOUBLE": 8, "INT96": 12}


def check_decoded_size(
    file: pq.ParquetFile, most: int, where: str, columns: Collection[str] | None = None
) -> None:
    """Refuse a Parquet file whose columns may take more than `most` bytes of memory.

    The bound comes from the footer, before anything is decoded. A column of text with a dictionary
    counts as if every value were the dictionary's longest word, unless it stays a dictionary.

    Args:
        file: the open file.
        most: largest size, bytes.
        where: the file's name, for the message.
        columns: the columns that will be read; None means all.
    """
    import pyarrow as pa

    size = 0
    dictionaries = {f.name for f in file.schema_arrow if pa.types.is_dictionary(f.type)}
    for g in range(file.metadata.num_row_groups):
        group = file.metadata.row_group(g)
        for c in range(file.metadata.num_columns):
            chunk, stored = group.column(c), group.column(c).total_uncompressed_size
            name = chunk.path_in_schema
            if columns is not None and name.partition(".")[0] not in columns:
                continue
            width = _VALUE_BYTES.get(chunk.physical_type)
            if width is None:
                repeats = chunk.has_dictionary_page and name not in dictionaries
                width = stored if repeats else 4
            size += stored + chunk.num_values * width
    if size > most:
        raise FileError(f"{where}: unpacks to {size} bytes; at most {most} are allowed")
