"""Parquet files that other people wrote, each read or looked at in a process of its own: one flipped
bit in a footer aborts the process that opens it.

`python -m r2h_batch.base.io.parquet` is the child.
"""

from __future__ import annotations

import io
import json
import os
import re
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pyarrow.types as types

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.child import answer_parent, read_in_child, temporary_file
from r2h_batch.base.io.read import open_file, printable
from r2h_batch.base.io.tables import MAX_WORD

SECONDS, BYTES_A_SECOND = 60, 10_000_000
"""CPU time of the child: some for the start, and some for the bytes of the files."""

_MODULE = "r2h_batch.base.io.parquet"
_COPY, _MAGIC = "copy it again", b"PAR1"


INDEX = re.compile(r"__index_level_\d+__")
"""The index of a pandas frame, which it stores as a column without saying so."""


def read_parquet_arrays(
    path: Path, *, most: int, rows: int, text: Collection[str] = (), row_bytes: int | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The columns of a Parquet file as flat arrays, after its decoded size is bounded.

    A child process reads the file. The footer says how many values each column has. A column of text
    with few different words takes little space in the file, and much in memory: such columns are
    read as dictionaries. Page checksums are compared where the file has them.

    Args:
        path: the file.
        most: largest decoded size of all columns, bytes.
        rows: largest number of rows.
        text: names of the columns of text or of lists of texts, read as dictionaries.
        row_bytes: largest decoded size of a row, beside 1 MiB for all; None: `most` alone.

    Returns:
        name -> the numbers or texts of all rows one after another, and, of columns of lists, name ->
        how many entries each row has. Lists inside lists have one length in all rows.

    Raises:
        FileError: it is damaged, a link leads nowhere, it is too large, or a value is missing.
    """
    where = printable(path)
    with open_file(path, most) as file:
        _check_ends(file, where)
        try:
            about, *arrays = read_in_child(
                _MODULE,
                file,
                {"most": most, "rows": rows, "text": list(text), "row_bytes": row_bytes},
                count=None,
                seconds=SECONDS + os.fstat(file.fileno()).st_size // BYTES_A_SECOND,
                doing=f"reading {where}",
            )
        except FileError as error:
            how = "" if ";" in str(error) else f"; {_COPY}"
            raise FileError(f"{where}: {error}{how}") from None
    names = json.loads(str(about))
    found = dict(zip(names["columns"], arrays))
    return found, dict(zip(names["lists"], arrays[len(found) :]))


def _check_ends(file: BinaryIO, where: str) -> None:
    """Refuse a file without a Parquet file's first and last bytes, before all of it is read."""
    first = file.read(len(_MAGIC))
    file.seek(-min(len(_MAGIC), os.fstat(file.fileno()).st_size), os.SEEK_END)
    last = file.read()
    file.seek(0)
    if {first, last} != {_MAGIC}:
        raise FileError(
            f"{where}: no Parquet file, or cut off: it must begin and end with PAR1; {_COPY}"
        )


def refused_parquet(paths: Sequence[Path]) -> dict[Path, str]:
    """The files that nobody should open in this process, and what is wrong with each.

    A child process opens their footers one after the other; one that ends it is found by a child for each.

    Args:
        paths: Parquet files.
    """
    if not paths:
        return {}
    try:
        answers = _looked_at(paths)
    except FileError as error:
        if len(paths) > 1:
            return {k: what for path in paths for k, what in refused_parquet([path]).items()}
        answers = [str(error)]
    return {path: what for path, what in zip(paths, answers, strict=True) if what}


def _looked_at(paths: Sequence[Path]) -> list[str]:
    """The fault of each file as one child process sees them, empty if it has none; `FileError` if the child does not live."""
    with temporary_file() as names:
        names.write(json.dumps([str(p) for p in paths]).encode())
        names.seek(0)
        (answers,) = read_in_child(
            _MODULE,
            names,
            {"look": True},
            count=1,
            seconds=SECONDS,
            doing=f"looking at {len(paths)} Parquet files",
        )
    return [str(a) for a in answers]


# In the child.


def _child(data: bytes, options: dict[str, Any]) -> list[Any]:
    """Looks at the files of a list, or reads a file."""
    return _looks(data) if "look" in options else _reads(data, options)


def _looks(data: bytes) -> list[Any]:
    return [np.array([_wrong(Path(p)) for p in json.loads(data)], np.str_)]


def _reads(data: bytes, options: dict[str, Any]) -> list[Any]:
    try:
        found, counts = _arrays(io.BytesIO(data), **options)
    except (OSError, pa.ArrowException) as error:
        raise FileError(f"no readable Parquet file ({printable(error)[:200]}); {_COPY}") from None
    except UnicodeDecodeError:
        raise FileError(
            "a column of text has bytes that are not UTF-8; write it as UTF-8"
        ) from None
    about = json.dumps({"columns": list(found), "lists": list(counts)})
    return [np.array(about), *found.values(), *counts.values()]


def _wrong(path: Path) -> str:
    """The reason to refuse a file; empty where there is none."""
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            check_decoded_size(file, sys.maxsize, "")
    except (OSError, pa.ArrowException, MemoryError) as error:
        return f"cannot be read ({' '.join(printable(error).split())[:200]})"
    return ""


def _arrays(
    stream: io.BytesIO, most: int, rows: int, text: Collection[str], row_bytes: int | None, **_: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    found: dict[str, Any] = {}
    counts: dict[str, Any] = {}
    schema = pq.read_schema(stream)
    stream.seek(0)
    words = [name for name in text if name in schema.names]
    alone = [name for name in words if not _is_list(schema.field(name).type)]
    with pq.ParquetFile(stream, read_dictionary=alone, page_checksum_verification=True) as file:
        if (n := file.metadata.num_rows) > rows:
            raise FileError(f"{n} rows; at most {rows} are allowed")
        check_decoded_size(
            file, most if row_bytes is None else min(most, (1 << 20) + row_bytes * n), ""
        )
        table = file.read().unify_dictionaries()
    for name in table.column_names:
        if INDEX.fullmatch(name):
            continue
        column, shown = table[name].combine_chunks(), printable(name)[:60]
        if column.null_count:
            raise FileError(f"{shown!r} is empty in {column.null_count} rows")
        if _is_list(column.type):
            counts[name] = pc.list_value_length(column).to_numpy(zero_copy_only=False)
            column = column.flatten()
        while _is_list(column.type):
            widths = pc.min_max(pc.list_value_length(column)).as_py()
            if widths["min"] != widths["max"]:
                some = f"lists of {widths['min']} to {widths['max']} entries"
                raise FileError(f"{shown!r} holds {some}; all must have one length")
            column = column.flatten()
        if column.null_count:
            raise FileError(f"{shown!r} has {column.null_count} empty entries; none may be")
        if name in words:
            if name in counts and types.is_string(column.type):
                column = column.dictionary_encode()
            found[name] = _texts(column, name)
        else:
            found[name] = column.to_numpy(zero_copy_only=False)
            if found[name].dtype.hasobject:
                words_ = f"{shown!r} is {column.type}; numbers are allowed"
                raise FileError(words_)
    return found, counts


def _is_list(kind: Any) -> bool:
    return types.is_list(kind) or types.is_fixed_size_list(kind) or types.is_large_list(kind)


def _texts(column: Any, what: str) -> Any:
    """Texts out of a dictionary. A long one is refused before many rows repeat it in memory."""
    words = [str(w) for w in column.dictionary.to_pylist()] if hasattr(column, "dictionary") else []
    if any(len(w) > MAX_WORD for w in words) or len(words) < min(1, len(column)):
        raise FileError(f"{what} is no text of at most {MAX_WORD} characters")
    return np.array(words or [""], np.str_)[column.indices.to_numpy(zero_copy_only=False)]


# On an open file, in any process.

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
        columns: the columns that will be read, `NAME` or `STRUCT.NAME`; None means all.
    """
    size = 0
    dictionaries = set(_dictionaries(file.schema_arrow))
    for g in range(file.metadata.num_row_groups):
        group = file.metadata.row_group(g)
        for c in range(file.metadata.num_columns):
            chunk = group.column(c)
            name, stored = chunk.path_in_schema, chunk.total_uncompressed_size
            parts = name.split(".")
            if columns is not None and not {parts[0], ".".join(parts[:2])} & set(columns):
                continue
            width = _VALUE_BYTES.get(chunk.physical_type)
            if width is None:
                repeats = chunk.has_dictionary_page and name not in dictionaries
                width = stored if repeats else 4
            size += stored + chunk.num_values * width
    if size > most:
        words = f"unpacks to {size} bytes; at most {most} are allowed"
        raise FileError(f"{where}: {words}" if where else words)


def _dictionaries(fields: Any, before: str = "") -> list[str]:
    """Paths of the columns that stay dictionaries in memory, those inside structs too."""
    names = []
    for field in fields:
        if types.is_dictionary(field.type):
            names.append(before + field.name)
        elif types.is_struct(field.type):
            names += _dictionaries(field.type, f"{before}{field.name}.")
    return names


if __name__ == "__main__":
    sys.exit(answer_parent(_child))
