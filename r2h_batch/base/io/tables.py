"""Bounded reading of tables: arrays as CSV, JSON, Parquet."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from r2h_batch.base.io.read import FileError, open_file, printable, read_json

if TYPE_CHECKING:
    import pyarrow.parquet as pq

MAX_WORD = 200
MAX_CSV_BYTES = 512 << 20


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
        options = pc.ConvertOptions(column_types=kinds, null_values=[""])
        try:
            table = pc.read_csv(stream, convert_options=options)
        except (pa.ArrowException, UnicodeDecodeError) as error:
            why = printable(error)[:200]
            how = "save it as CSV UTF-8, with commas"
            raise FileError(f"{where}: no readable CSV ({why}); {how}") from None
    names = table.column_names
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
    return found


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
