"""Files beside the shards, one for each method: RUN/picked, reception and viewed/METHOD.parquet.

`r2h-batch results` makes them of stored rows. Their size is bounded by the rows of the run before they are read. Their columns
must be those that were written: the footer has a digest of them. Their trials and successes must be those of the shards.
What they say beyond that is believed.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.parquet import check_decoded_size
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.tables import MAX_WORD
from r2h_batch.base.io.write import atomic_path
from r2h_batch.runs.files import RunError, in_the_way
from r2h_batch.runs.header import SIDE_FOLDERS
from r2h_batch.runs.methods import Entry
from r2h_batch.runs.shard import unreadable


class Kind(NamedTuple):
    """The columns that tables read of the files of one folder.

    Attributes:
        columns: name -> type, `trial_id` and `success` among them.
        gaps: columns that may have gaps.
        of_rows: whether the file says of which rows it was made, so that its successes must be theirs.
    """

    columns: Mapping[str, pa.DataType]
    gaps: tuple[str, ...] = ()
    of_rows: bool = True


_TRIAL = {"trial_id": pa.int64(), "success": pa.bool_()}
_YES, _WORD = pa.bool_(), pa.string()
KINDS = {
    "picked": Kind(
        {**_TRIAL, "object": _WORD, "split": _WORD, "picked": _YES, "pick_reason": _WORD, "pick_pair": _WORD},
        gaps=("pick_pair",),
    ),
    "reception": Kind({**_TRIAL, "evaluated": _YES, "received": _YES}, of_rows=False),
    "viewed": Kind({**_TRIAL, "split": _WORD, "viewed": pa.float32()}),
}  # fmt: skip

FREE_BYTES, ROW_BYTES, MOST_BYTES = 16 << 20, 512, 1 << 30
"""Memory that a file may take: some, more for each row that it may have, and never more than the last."""
DIGEST = b"r2h_batch columns"
"""Key in the footer: the digest of all columns."""
HOW = "take the file away; `r2h-batch results {}` makes it anew"


class SideWriter:
    """Writes the rows of a file in parts, and then the digest of its columns."""

    def __init__(self, writer: pq.ParquetWriter, schema: pa.Schema) -> None:
        """Begins without rows.

        Args:
            writer: of the file.
            schema: of its rows.
        """
        self._writer, self._schema, self._columns = writer, schema, _Columns(schema)

    def write(self, rows: pa.Table) -> None:
        """Adds rows.

        Args:
            rows: of the schema; its metadata is not written.
        """
        rows = rows.replace_schema_metadata(self._schema.metadata)
        self._writer.write_table(rows)
        self._columns.add(rows)

    def seal(self) -> None:
        """Writes the digest."""
        self._writer.add_key_value_metadata({DIGEST.decode(): self._columns.digest})


@contextmanager
def side_writer(
    path: Path, schema: pa.Schema, about: Mapping[bytes, Any] | None = None
) -> Iterator[SideWriter]:
    """A writer of a file that `read_side` reads; the file is there at the end, whole.

    Args:
        path: of the file.
        schema: of its rows.
        about: key -> what the file was made of, as JSON has it.
    """
    own = schema.with_metadata({k: json.dumps(v).encode() for k, v in (about or {}).items()})
    path.parent.mkdir(exist_ok=True)
    with atomic_path(path) as new, pq.ParquetWriter(new, own) as writer:
        side = SideWriter(writer, own)
        yield side
        side.seal()


class _Columns:
    """A digest of a table's columns: names, types and values, in their order, however many rows come at once."""

    def __init__(self, schema: pa.Schema) -> None:
        self._of = {
            field.name: (hashlib.sha256(str(_plain_type(field.type)).encode()), hashlib.sha256())
            for field in schema
        }

    def add(self, rows: pa.Table) -> None:
        for name, (values, there) in self._of.items():
            for chunk in rows[name].chunks:
                values.update(_bytes_of(chunk))
                there.update(chunk.is_valid().to_numpy(zero_copy_only=False).tobytes())

    @property
    def digest(self) -> str:
        every = [(name, *(h.hexdigest() for h in both)) for name, both in self._of.items()]
        return hashlib.sha256(json.dumps(every).encode()).hexdigest()


def _plain_type(of: pa.DataType) -> pa.DataType:
    return of.value_type if pa.types.is_dictionary(of) else of


def _bytes_of(chunk: pa.Array) -> bytes:
    """The values of a column, gaps as zeros or empty words."""
    plain = chunk.cast(_plain_type(chunk.type))
    if pa.types.is_string(plain.type):
        return "".join(f"{json.dumps(word)}\n" for word in plain.fill_null("").to_pylist()).encode()
    numbers: NDArray[Any] = plain.fill_null(
        False if pa.types.is_boolean(plain.type) else 0
    ).to_numpy(zero_copy_only=False)
    return numbers.tobytes()


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
            for name in _words_of(file.schema_arrow):
                chunks = file.read(columns=[name])[name].chunks
                sizes = [pc.max(pc.utf8_length(c.dictionary)).as_py() or 0 for c in chunks]
                if (longest := max(sizes, default=0)) > MAX_WORD:
                    return f"column {name!r} has a word of {longest} characters; at most {MAX_WORD} are allowed"
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


def _words_of(schema: pa.Schema) -> list[str]:
    return [field.name for field in schema if pa.types.is_dictionary(field.type)]


def _most_bytes(trials: int) -> int:
    return min(MOST_BYTES, FREE_BYTES + ROW_BYTES * trials)


def about_side(path: Path, made_of: bytes) -> dict[str, Any]:
    """The rows and code that a file says it was made of; empty: it is missing or no such file.

    Args:
        path: of the file.
        made_of: key of its metadata.
    """
    if not path.is_file():
        return {}
    try:
        about = json.loads((pq.read_schema(path).metadata or {})[made_of])
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError, RecursionError):
        return {}
    return about if isinstance(about, dict) else {}


def rows_of(path: Path, made_of: bytes) -> str | None:
    """Digest of the rows that a file was made of, None: it is no such file.

    Args:
        path: of the file; it may be missing.
        made_of: key of its metadata.
    """
    rows = about_side(path, made_of).get("rows")
    return None if rows is None else str(rows)


def is_kept(path: Path, schema: pa.Schema, trials: int) -> bool:
    """Whether a file is as `side_writer` wrote it, with these columns, and no larger than its run allows.

    Args:
        path: of the file; it may be missing.
        schema: of its rows.
        trials: of the run.
    """
    if not path.is_file() or unbounded(path, trials) or pq.read_schema(path) != schema:
        return False
    with _opened(path) as file:
        return not _not_as_written(file, file.read())


def read_side(path: Path, trial_id: NDArray[np.int64], success: NDArray[np.bool_]) -> pa.Table:
    """The columns of `KINDS` of a file, after its size is bounded and its trials are compared with the run's.

    Args:
        path: of the file, in one of `SIDE_FOLDERS`; it exists.
        trial_id: (n,) the method's trials, in any order.
        success: (n,) of these.

    Raises:
        RunError: it is too large, lacks a column, or says something about other trials.
    """
    kind, how = KINDS[path.parent.name], HOW.format(path.parent.name)
    columns = kind.columns
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
            every = file.read()
            if what := _not_as_written(file, every):
                raise FileError(what)
            table = every.select(list(columns)).cast(pa.schema(list(columns.items())))
    except FileError as error:
        raise RunError(f"{printable(path)}: {error}; {how}") from None
    except (OSError, ValueError, pa.ArrowException) as error:
        raise RunError(f"{unreadable(path, error)}; {how}") from None
    if what := _not_of_run(table, trial_id, success, kind):
        raise RunError(f"{printable(path)}: {what}; {how}")
    return table


def _not_as_written(file: pq.ParquetFile, every: pa.Table) -> str:
    """How a file's columns are not those that were written; empty where they are."""
    told = (file.metadata.metadata or {}).get(DIGEST)
    if told is None:
        return "has no digest of its columns: an older version or another program wrote it"
    columns = _Columns(every.schema)
    columns.add(every)
    return "" if told == columns.digest.encode() else "its columns are not those that were written"


def _not_of_run(
    table: pa.Table, trial_id: NDArray[np.int64], success: NDArray[np.bool_], kind: Kind
) -> str:
    """How a file's rows are not of the run; empty where they are."""
    for name in table.column_names:
        if name not in kind.gaps and (gaps := table[name].null_count):
            return f"column {name!r} has {gaps} empty rows"
    ids = table["trial_id"].to_numpy()
    if len(strange := ids[~np.isin(ids, trial_id)]):
        return f"trial {strange[0]} is not in this run"
    each = table.group_by("trial_id").aggregate([([], "count_all")])
    if len(each) < len(table):
        twice = each.filter(pc.greater(each["count_all"], 1))["trial_id"][0]
        return f"trial {twice} stands there twice"
    if kind.of_rows and len(ids):
        order = np.argsort(trial_id)
        own = success[order][np.searchsorted(trial_id[order], ids)]
        if len(other := ids[own != table["success"].to_numpy(zero_copy_only=False)]):
            return f"trial {other[0]} has another success than in the shards"
    return ""
