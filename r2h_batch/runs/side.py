"""Files beside the shards, one for each method: RUN/reception/METHOD.parquet.

`r2h-batch results` makes them of stored rows. Their size is bounded by the rows of the run before they are read. Their pages have
checksums, the columns that tables read must be there, and their trials must be those of the run.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.parquet import check_decoded_size
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import atomic_path
from r2h_batch.runs.files import RunError, in_the_way
from r2h_batch.runs.header import SIDE_FOLDERS
from r2h_batch.runs.methods import Entry
from r2h_batch.runs.shard import unreadable

COLUMNS = {
    "reception": {
        "trial_id": pa.int64(),
        "success": pa.bool_(),
        "evaluated": pa.bool_(),
        "received": pa.bool_(),
    },
}
"""Folder -> the columns that tables read of its files."""

FREE_BYTES, ROW_BYTES, MOST_BYTES = 16 << 20, 512, 1 << 30
"""Memory that a file may take: some, more for each row that it may have, and never more than the last."""
HOW = "take the file away; `r2h-batch results {}` makes it anew"


@contextmanager
def side_writer(path: Path, schema: pa.Schema) -> Iterator[pq.ParquetWriter]:
    """A writer of a file that `read_side` reads; the file is there at the end, whole.

    Args:
        path: of the file.
        schema: of its rows.
    """
    path.parent.mkdir(exist_ok=True)
    with (
        atomic_path(path) as new,
        pq.ParquetWriter(new, schema, write_page_checksum=True) as writer,
    ):
        yield writer


def side_path(entry: Entry, folder: str) -> Path:
    """The file of a method in one of `SIDE_FOLDERS`.

    Args:
        entry: the method.
        folder: one of `SIDE_FOLDERS`.
    """
    return entry.folder / folder / f"{entry.slug}.parquet"


def side_files(entry: Entry) -> list[Path]:
    """The files that a method has beside its shards."""
    own = [side_path(entry, folder) for folder in SIDE_FOLDERS]
    return [p for p in own if os.path.lexists(p)]


def unbounded(path: Path, trials: int) -> str:
    """The reason not to open a file, or not to read it; empty where there is none. The footer is read.

    Args:
        path: of a file whose footer ends no process (`refused_parquet`).
        trials: of the run.
    """
    if what := in_the_way(path.parent, folder=True) or in_the_way(path):
        return what.partition("; move")[0]
    if (size := path.stat().st_size) > (most := _most_bytes(trials)):
        return f"{size} bytes; at most {most} are allowed for {trials} trials"
    try:
        with _opened(path) as file:
            if (rows := file.metadata.num_rows) > trials:
                return f"{rows} rows; at most one for each of {trials} trials is allowed"
            check_decoded_size(file, _most_bytes(trials), "")
    except FileError as error:
        return str(error)
    except (OSError, ValueError, pa.ArrowException) as error:
        return str(unreadable(path, error)).removeprefix(f"{path}: ")
    return ""


def _opened(path: Path) -> pq.ParquetFile:
    """The file, whose texts stay dictionaries: a few words that many rows repeat take little memory."""
    schema = pq.read_schema(path)
    words = [field.name for field in schema if pa.types.is_string(field.type)]
    return pq.ParquetFile(path, read_dictionary=words, page_checksum_verification=True)


def _most_bytes(trials: int) -> int:
    return min(MOST_BYTES, FREE_BYTES + ROW_BYTES * trials)


def read_side(path: Path, trial_id: NDArray[np.int64]) -> pa.Table:
    """The `COLUMNS` of a file, after its size is bounded and its trials are compared with the run's.

    Args:
        path: of the file, in one of `SIDE_FOLDERS`; it exists.
        trial_id: (n,) the method's trials, in any order.

    Raises:
        RunError: it is damaged, too large, lacks a column, or says something about other trials.
    """
    columns, how = COLUMNS[path.parent.name], HOW.format(path.parent.name)
    try:
        if what := unbounded(path, len(trial_id)):
            raise FileError(what)
        schema = pq.read_schema(path)
        with _opened(path) as file:
            for name, type_ in columns.items():
                found = schema.field(name).type if name in schema.names else None
                if found != type_:
                    has = "is missing" if found is None else f"is {found}; it must be {type_}"
                    raise FileError(f"column {name!r} {has}")
            # all pages, so that damage is told wherever it is
            table = file.read().select(list(columns)).cast(pa.schema(list(columns.items())))
    except FileError as error:
        raise RunError(f"{printable(path)}: {error}; {how}") from None
    except (OSError, ValueError, pa.ArrowException) as error:
        raise RunError(f"{unreadable(path, error)}; {how}") from None
    if what := _not_of_run(table, trial_id):
        raise RunError(f"{printable(path)}: {what}; {how}")
    return table


def _not_of_run(table: pa.Table, trial_id: NDArray[np.int64]) -> str:
    """How a file's rows are not of the run; empty where they are."""
    for name in table.column_names:
        if gaps := table[name].null_count:
            return f"column {name!r} has {gaps} empty rows"
    ids = table["trial_id"].to_numpy()
    if len(strange := ids[~np.isin(ids, trial_id)]):
        return f"trial {strange[0]} is not in this run"
    each = table.group_by("trial_id").aggregate([([], "count_all")])
    if len(each) < len(table):
        twice = each.filter(pc.greater(each["count_all"], 1))["trial_id"][0]
        return f"trial {twice} stands there twice"
    return ""
