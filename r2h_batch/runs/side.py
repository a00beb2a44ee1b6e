"""Files beside the shards, one for each method: RUN/QUESTION/METHOD.parquet, as RUN/reception/METHOD.parquet.

`r2h-batch results` makes them of stored rows, one for each of `QUESTIONS`. Their size is bounded by the rows of the run before
they are read. Their pages have checksums, the columns that tables read must be there, and their trials must be those of the run.
"""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.parquet import check_decoded_size
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import atomic_path
from r2h_batch.base.registry import QUESTIONS
from r2h_batch.runs.files import RunError, in_the_way
from r2h_batch.runs.methods import Entry
from r2h_batch.runs.shard import unreadable

TRIAL = pa.field("trial_id", pa.int64(), nullable=False)
READ = {
    "reception": pa.schema(
        [
            TRIAL,
            *(
                pa.field(name, pa.bool_(), nullable=False)
                for name in ("success", "evaluated", "received")
            ),
        ]
    ),
}
"""Question -> the columns that tables read of its files; of others they read none."""
MADE_OF = b"r2h_batch made of"
"""Key of a file's metadata: what its answers were made of, as JSON."""

FREE_BYTES, ROW_BYTES, MOST_BYTES = 16 << 20, 512, 1 << 30
"""Memory that a file may take: some, more for each row that it may have, and never more than the last."""
HOW = "take the file away; `r2h-batch results {}` makes it anew"


def write_side(path: Path, table: pa.Table, about: Mapping[str, Any] | None = None) -> None:
    """Writes a file that `read_side` reads: whole or not at all.

    Args:
        path: of the file.
        table: its rows.
        about: what they were made of, for `made_of`.
    """
    path.parent.mkdir(exist_ok=True)
    metadata = None if about is None else {MADE_OF: json.dumps(about)}
    with atomic_path(path) as new:
        pq.write_table(table.replace_schema_metadata(metadata), new, write_page_checksum=True)
        if what := unbounded(new, len(table)):
            raise RunError(f"{printable(path)}: cannot be read again ({what}); nothing was stored")


def made_of(path: Path) -> dict[str, Any]:
    """What a file says that it was made of; empty where it does not, or there is none.

    Args:
        path: of the file, after `side_problems` found no fault in it.
    """
    if not os.path.lexists(path) or in_the_way(path):
        return {}
    try:
        about = json.loads((pq.read_schema(path).metadata or {})[MADE_OF])
    except (OSError, pa.ArrowException, KeyError, ValueError, RecursionError):
        return {}
    return about if isinstance(about, dict) else {}


def side_path(entry: Entry, question: str) -> Path:
    """The file of a method's answers.

    Args:
        entry: the method.
        question: one of `QUESTIONS`.
    """
    return entry.folder / question / f"{entry.slug}.parquet"


def side_files(entry: Entry) -> list[Path]:
    """The files that a method has beside its shards."""
    own = [side_path(entry, question) for question in QUESTIONS]
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


def read_side(path: Path, trial_id: NDArray[np.int64], schema: pa.Schema | None = None) -> pa.Table:
    """Columns of a file, after its size is bounded and its trials are compared with the run's.

    Args:
        path: of the file, in a folder of `QUESTIONS`; it exists.
        trial_id: (n,) the method's trials, in any order.
        schema: of the columns, `trial_id` among them; None: those that tables read (`READ`).

    Raises:
        RunError: it is damaged, too large, lacks a column, or says something about other trials.
    """
    how = HOW.format(path.parent.name)
    if schema is None:
        schema = READ.get(path.parent.name, pa.schema([TRIAL]))
    try:
        if what := unbounded(path, len(trial_id)):
            raise FileError(what)
        stored = pq.read_schema(path)
        with _opened(path) as file:
            for field in schema:
                found = stored.field(field.name).type if field.name in stored.names else None
                if found != field.type:
                    has = "is missing" if found is None else f"is {found}; it must be {field.type}"
                    raise FileError(f"column {field.name!r} {has}")
            table = file.read().select(schema.names)  # all pages: damage is told wherever it is
        if what := _not_of_run(table, schema, trial_id):
            raise FileError(what)
        return table.cast(schema)
    except FileError as error:
        raise RunError(f"{printable(path)}: {error}; {how}") from None
    except (OSError, ValueError, pa.ArrowException) as error:
        raise RunError(f"{unreadable(path, error)}; {how}") from None


def _not_of_run(table: pa.Table, schema: pa.Schema, trial_id: NDArray[np.int64]) -> str:
    """How a file's rows are not of the run; empty where they are."""
    for field in schema:
        if not field.nullable and (gaps := table[field.name].null_count):
            return f"column {field.name!r} has {gaps} empty rows"
    ids = table["trial_id"].to_numpy()
    if len(strange := ids[~np.isin(ids, trial_id)]):
        return f"trial {strange[0]} is not in this run"
    each = table.group_by("trial_id").aggregate([([], "count_all")])
    if len(each) < len(table):
        twice = each.filter(pc.greater(each["count_all"], 1))["trial_id"][0]
        return f"trial {twice} stands there twice"
    return ""
