"""A shard is one Parquet file: the columns of its trials, a struct of columns for each kind that is
stored beside them (details, poses, paths, ...), and its receipt in the footer.

    shards/METHOD/000017-SHA.parquet

The file's sha256 is in its name and is compared before anything opens the file: one flipped bit in a
footer can abort the process that opens it. Page checksums are compared when columns are read.
"""

import json
import os
import re
import socket
import stat
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import Field

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.parquet import check_decoded_size
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import naming
from r2h_batch.runs.columns import TABLES, earlier, later
from r2h_batch.runs.files import (
    RunError,
    in_the_way,
    sha256_of,
    sync_file,
    sync_folder,
    temporary_name,
)
from r2h_batch.runs.header import (
    FORMAT,
    TIMING,
    Count,
    Hash,
    Name,
    Record,
    Shard,
    Split,
    Text,
    checked,
    planned_in,
    schema_of,
    shard_at,
)
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.verdicts import ELSEWHERE, EVERY

RECEIPT = b"r2h_batch"
"""Key of the receipt among the file's metadata."""

KINDS = tuple(kind for kind in TABLES if kind != "trials")
"""Kinds that are stored as a struct: null where a trial has no row of the kind."""

ANSWERED = ("details", "poses", "episodes", "sees")
"""Kinds with a row for each trial that was answered."""

PASSED = "passed_"
"""Begins the column of a criterion's verdicts."""

MAX_WORDS = 100_000  # different words in one column of a shard

_NAME = re.compile(r"([0-9]{6})-([0-9a-f]{16})\.parquet", re.ASCII)


class Receipt(Record):
    """The receipt of a shard, as its footer holds it."""

    run: Hash
    method: Name
    first: Count
    last: Count
    outcomes: dict[Split, dict[Name, Count]]
    seconds: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    host: Text = ""
    written: Text = ""


@dataclass(frozen=True)
class StoredShard:
    """A shard of a method of a run folder.

    Attributes:
        path: the file.
        header: run.json.
        method: the method's name in this folder.
        shard: the range of trials.
    """

    path: Path
    header: dict[str, Any]
    method: str
    shard: Shard

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of tables that the shard holds, as `TABLES` names them."""
        return self._footer[1]

    def receipt(self) -> dict[str, Any]:
        """Reads the receipt from the footer; `RunError` if it belongs to another run, method or shard."""
        return self._footer[0]

    @cached_property
    def _footer(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        try:
            with pq.ParquetFile(self.path) as file:
                return self._checked_footer(file)
        except (OSError, pa.ArrowException) as error:
            raise unreadable(self.path, error) from error

    def _checked_footer(self, file: pq.ParquetFile) -> tuple[dict[str, Any], tuple[str, ...]]:
        rows, schema = file.metadata.num_rows, file.schema_arrow
        try:
            said = json.loads((schema.metadata or {})[RECEIPT])
        except (KeyError, ValueError, RecursionError):
            raise RunError(f"{self.path}: foreign, its footer holds no receipt") from None
        receipt = checked(Receipt, said, self.path)
        check_receipt(receipt, self.header, self.method, self.shard, self.path)
        outcomes = {name for counts in receipt["outcomes"].values() for name in counts}
        if what := _unknown_outcome(outcomes, unknown_criteria(schema)):
            raise RunError(f"{self.path}: its receipt {what}")
        if rows != (trials := self.shard.last - self.shard.first):
            raise RunError(f"{self.path}: holds {rows} rows, its range has {trials} trials")
        kinds = tuple(kind for kind in KINDS if kind in schema.names)
        if (found := set(kinds) - {"failures"}) != (stored := set(self.header["stored"])):
            words = f"holds {sorted(found)}, stored are {sorted(stored)}"
            raise RunError(f"{self.path}: {words}")
        return receipt, ("trials", *kinds)

    def table(self, kind: str, columns: Sequence[str]) -> pa.Table:
        """Those columns of a kind that the file has; `RunError` if it is not as its schema says."""
        try:
            with pq.ParquetFile(self.path, page_checksum_verification=True) as file:
                _, kinds = self._checked_footer(file)
                if kind not in kinds:
                    raise RunError(f"{self.path}: holds no {kind}; it holds {', '.join(kinds)}")
                there = _present(file.schema_arrow, kind, columns, self.path)
                asked = [n if kind == "trials" or n == "trial_id" else f"{kind}.{n}" for n in there]
                if kind != "trials" and not set(asked) - {"trial_id"}:
                    asked.append(_smallest_leaf(file, kind))  # says which trials have a row
                most = most_bytes(kind, self.shard.last - self.shard.first)
                check_decoded_size(file, most, str(self.path), asked)
                table = file.read(columns=asked)
                unknown = unknown_criteria(file.schema_arrow)
        except FileError as error:
            raise RunError(str(error)) from None
        except (OSError, pa.ArrowException) as error:
            raise unreadable(self.path, error) from error
        if kind != "trials":
            rows = table.filter(pc.is_valid(table[kind]))
            columns_ = [
                rows[n] if n == "trial_id" else pc.struct_field(rows[kind], n) for n in there
            ]
            table = pa.table(columns_, names=there)
        schema = schema_of(self.header, kind, unread=True)
        check_columns(table, schema, self.path, unknown)
        table = table.select(there).cast(pa.schema([schema.field(n) for n in there]))
        return _known_outcomes(table, unknown) if unknown and "outcome" in there else table


def _present(schema: pa.Schema, kind: str, columns: Sequence[str], path: Path) -> list[str]:
    """Those of the columns of a kind that a file has."""
    names = set(schema.names)
    if kind != "trials":
        struct = schema.field(kind).type
        if not pa.types.is_struct(struct):
            raise RunError(f"{path}: column {kind!r} is of another type than format {FORMAT} says")
        names = {"trial_id", *(field.name for field in struct)}
    check_present(kind, columns, names, path)
    return [name for name in columns if name in names]


def _smallest_leaf(file: pq.ParquetFile, kind: str) -> str:
    """The column of a struct that takes the fewest bytes."""
    group = file.metadata.row_group(0)
    chunks = [group.column(c) for c in range(file.metadata.num_columns)]
    own = [c for c in chunks if c.path_in_schema.startswith(f"{kind}.")]
    smallest = min(own, key=lambda c: c.total_compressed_size)
    return ".".join(smallest.path_in_schema.split(".")[:2])


# What every format asks of a table.


def most_bytes(kind: str, trials: int) -> int:
    """Memory that a table of a kind may take."""
    return (16 << 20) + (1 << 17 if kind == "paths" else 1 << 13) * trials


def unreadable(path: Path, error: Exception) -> RunError:
    """The error of a file that is no readable Parquet file."""
    return RunError(f"{path}: cannot be read ({' '.join(printable(error).split())[:300]})")


def check_receipt(
    receipt: Mapping[str, Any], header: Mapping[str, Any], method: str, shard: Shard, path: Path
) -> None:
    """`RunError` if a receipt is of another run, method or shard."""
    expected = {"run": header["hash"], "method": method, "first": shard.first, "last": shard.last}
    for key, value in expected.items():
        if receipt[key] != value:
            raise RunError(f"{path}: foreign, its {key} is {receipt[key]!r} and not {value!r}")
    counts = {s: sum(c.values()) for s, c in receipt["outcomes"].items()}
    if counts != (planned := planned_in(header, shard)):
        raise RunError(f"{path}: holds {counts} trials, planned were {planned}")


def check_present(kind: str, columns: Sequence[str], names: set[str], path: Path) -> None:
    """`RunError` if a column is missing that every version stored."""
    if lacking := set(columns) - names - set(later(kind)) - set(earlier(kind)):
        raise RunError(f"{path}: column {min(lacking)!r} is missing")


def check_columns(
    table: pa.Table, schema: pa.Schema, path: Path, unknown: Collection[str] = ()
) -> None:
    """`RunError` if a column is there twice, is of another type, has gaps or holds words that are no names. `unknown`: as
    `unknown_criteria` found them in the file."""
    for name in table.column_names:
        if table.column_names.count(name) > 1:
            raise RunError(f"{path}: column {name!r} is there twice; a run folder has it once")
        if what := _wrong_column(table[name], schema.field(name), unknown):
            raise RunError(f"{path}: column {name!r} {what}")


def unknown_criteria(schema: pa.Schema) -> frozenset[str]:
    """Criteria by which rows were judged and that are not known here: their package is not installed, or they came later.
    Their columns are not read.

    Args:
        schema: of the file.
    """
    judged = {name.removeprefix(PASSED) for name in schema.names if name.startswith(PASSED)}
    return frozenset(judged - {entry.name for entry in EVERY} - {*OUTCOME_NAMES})


def _unknown_outcome(words: Iterable[str | None], unknown: Collection[str]) -> str:
    """The fault of outcomes; empty where there is none."""
    odd = {w for w in words if w is not None} - {*OUTCOME_NAMES, *unknown}
    return f"holds {min(odd)!r}; known are {', '.join(OUTCOME_NAMES)}" if odd else ""


def _known_outcomes(table: pa.Table, unknown: Collection[str]) -> pa.Table:
    """The trials with `ELSEWHERE` as the outcome of those that failed an unknown criterion first."""
    place = table.column_names.index("outcome")
    words = table["outcome"].cast(pa.string())
    failed = pc.is_in(words, pa.array(sorted(unknown)))
    known = pc.if_else(failed, ELSEWHERE, words).cast(table["outcome"].type)
    return table.set_column(place, table.schema.field(place), known)


def _wrong_column(column: pa.ChunkedArray, field: pa.Field, unknown: Collection[str]) -> str:
    if column.type != field.type:
        return "is of another type than run folders have"
    if not field.nullable and column.null_count:
        return f"has {column.null_count} empty rows; it must have none"
    inside = column
    while pa.types.is_list(inside.type) or pa.types.is_fixed_size_list(inside.type):
        inside = pc.list_flatten(inside)
        if inside.null_count:
            return f"has {inside.null_count} empty numbers in its rows; it must have none"
    if pa.types.is_dictionary(field.type):
        for chunk in column.chunks:
            words = chunk.dictionary.to_pylist()[: MAX_WORDS + 1]
            names = all(w and len(w) <= 200 and w.isprintable() for w in words)
            if len(words) > MAX_WORDS or not names:
                return "holds an entry that is not a name; sweep again"
            if field.name == "outcome" and (what := _unknown_outcome(words, unknown)):
                return what
    return ""


# Names of files.


def shard_folder(folder: Path, slug: str) -> Path:
    """Where the shards of a method are."""
    return folder / "shards" / slug


def shard_files(folder: Path, slug: str) -> list[Path]:
    """All files among the shards of a method, in order: hidden ones and those set aside are none."""
    place = shard_folder(folder, slug)
    try:
        names = os.listdir(place)
    except FileNotFoundError:
        return []
    except OSError as error:
        words = f"{place}: cannot be read ({error.strerror or error})"
        whats = (in_the_way(p, folder=True) for p in (place.parent, place))
        raise RunError(next(filter(None, whats), words)) from None
    return [place / n for n in sorted(names) if n[0] != "." and not n.endswith(".bad")]


def drop_set_aside(place: Path, index: int) -> None:
    """Removes files of a shard that were set aside, now that the shard is stored again."""
    for path in place.glob(f"{index:06d}-*.bad"):
        with suppress(OSError):  # a folder, or another sweep was quicker
            path.unlink()


def number_of(path: Path) -> int | None:
    """The number of a shard from its file's name; None if it is no name of a shard."""
    found = _NAME.fullmatch(path.name)
    return int(found[1]) if found else None


def stored_files(header: Mapping[str, Any], folder: Path, slug: str) -> dict[int, Path]:
    """Number -> file of every stored shard of a method, in order."""
    found: dict[int, Path] = {}
    for path in shard_files(folder, slug):
        number = number_of(path)
        if number is not None and shard_at(header, number) is not None:
            found.setdefault(number, path)
    return found


def damage(path: Path) -> str:
    """The difference between a file and the digest in its name; empty: there is none."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return "missing"
    if not stat.S_ISREG(mode):
        return "no regular file"
    named = _NAME.fullmatch(path.name)
    found = sha256_of(path)[:16]
    if named is not None and found == named[2]:
        return ""
    return f"cut or flipped bits: its sha256 begins with {found}, not as its name says"


# Writing.


def write_shard(
    place: Path,
    header: Mapping[str, Any],
    method: str,
    shard: Shard,
    tables: Mapping[str, pa.Table],
    seconds: float,
) -> bool:
    """Store a shard: its trials, and the tables of the kinds in `stored`.

    Args:
        place: the folder of the method's shards.
        header: run.json.
        method: the method's name.
        shard: the range of trials.
        tables: kind -> rows, in the order of the trials.
        seconds: how long the shard took.

    Returns:
        False if another process stored the shard first; its file stays.
    """
    trials = tables["trials"]
    receipt = {
        "format": FORMAT, "run": header["hash"], "method": method,
        "first": shard.first, "last": shard.last, "outcomes": count_outcomes(trials),
        "seconds": round(seconds, 3), "host": socket.gethostname(),
        "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }  # fmt: skip
    names = [*header["stored"], *(["failures"] if len(tables["failures"]) else [])]
    fields, columns = list(trials.schema), list(trials.columns)
    for kind in names:
        structs = _struct(tables[kind], trials["trial_id"])
        fields.append(pa.field(kind, structs.type))
        columns.append(structs)
    metadata = {RECEIPT: json.dumps(receipt)}
    whole = pa.table(columns, schema=pa.schema(fields, metadata=metadata))
    leaves = [(f.name, f) for f in trials.schema]
    leaves += [(f"{kind}.{f.name}", f) for kind in names for f in tables[kind].schema]
    words = [n for n, f in leaves if pa.types.is_dictionary(f.type) or n in TIMING]
    floats = [n for n, f in leaves if f.type == pa.float32() and n not in TIMING]
    encoding = {"trial_id": "DELTA_BINARY_PACKED"} | dict.fromkeys(floats, "BYTE_STREAM_SPLIT")
    place.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(place / shard.name)
    try:
        with naming(place / f"{shard.name}.parquet", temporary):
            pq.write_table(
                whole, temporary, row_group_size=max(len(whole), 1), compression="zstd",
                compression_level=6, use_dictionary=words, column_encoding=encoding,
                write_page_checksum=True,
            )  # fmt: skip
            sync_file(temporary)
        if what := _unreadable(StoredShard(temporary, dict(header), method, shard)):
            raise RunError(
                f"{place}: shard {shard.index} of {method!r} cannot be read again ({what}); nothing was stored"
            )
        if any(place.glob(f"{shard.name}-*.parquet")):
            return False
        final = place / f"{shard.name}-{sha256_of(temporary)[:16]}.parquet"
        os.replace(temporary, final)
        # of two writers at the same moment, whose rows are equal, the first name stays: readers take it
        first, *others = sorted(place.glob(f"{shard.name}-*.parquet"))
        for other in others:
            other.unlink(missing_ok=True)
        sync_folder(place)
        return first == final
    finally:
        temporary.unlink(missing_ok=True)


def _unreadable(stored: StoredShard) -> str:
    """What a reader will say of a shard; empty where it takes all of it."""
    try:
        stored.receipt()
        for kind in stored.kinds:
            stored.table(kind, schema_of(stored.header, kind).names)
    except RunError as error:
        return str(error).removeprefix(f"{stored.path}: ")
    return ""


def _struct(table: pa.Table, trial_id: pa.ChunkedArray) -> pa.Array:
    """A row of the table for each of the trials, null where the table has none."""
    columns = table.drop_columns(["trial_id"])
    place = pc.index_in(trial_id, table["trial_id"]).combine_chunks()
    if len(trial_id) - place.null_count != len(table):
        raise RunError("rows of trials that the shard does not have; nothing was stored")
    if place.null_count or len(table) != len(trial_id):
        columns = columns.take(place)
    arrays = [c.combine_chunks() for c in columns.columns]
    fields = [field.with_nullable(True) for field in columns.schema]
    return pa.StructArray.from_arrays(arrays, fields=fields, mask=place.is_null())


def count_outcomes(table: pa.Table) -> dict[str, dict[str, int]]:
    """Split -> outcome -> trials, both in alphabetical order."""
    keys = pa.table({k: table[k].cast(pa.string()) for k in ("split", "outcome")})
    counts: dict[str, dict[str, int]] = {}
    groups = keys.group_by(["split", "outcome"]).aggregate([([], "count_all")])
    for row in groups.sort_by([("split", "ascending"), ("outcome", "ascending")]).to_pylist():
        counts.setdefault(row["split"], {})[row["outcome"]] = row["count_all"]
    return counts
