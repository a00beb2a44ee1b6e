"""Reads run folders of format 3, which nothing writes any more: a receipt and a file of each kind for
a shard.

    manifest/METHOD/000017.json        the receipt: range, outcomes, files, sha256
    trials/METHOD/000017-SHA.parquet   its rows; details/, poses/, paths/, failures/ beside it if stored

Delete this file, and where `FORMAT_3` is named, when no such folder is left.
"""

import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import Field

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.parquet import check_decoded_size
from r2h_batch.runs.columns import TABLES
from r2h_batch.runs.files import RunError, sha256_of
from r2h_batch.runs.header import (
    Count,
    Hash,
    Kind,
    Name,
    OutcomeName,
    Record,
    Shard,
    Split,
    Text,
    checked,
    read_json,
    schema_of,
    shard_at,
)
from r2h_batch.runs.shard import (
    check_columns,
    check_present,
    check_receipt,
    most_bytes,
    unreadable,
)

FORMAT_3 = 3


class _File(Record):
    path: Text
    sha256: Hash
    bytes: Annotated[int, Field(ge=1, le=1 << 42)]


class _Receipt(Record):
    run: Hash
    method: Name
    first: Count
    last: Count
    outcomes: dict[Split, dict[OutcomeName, Count]]
    files: dict[Kind, _File]


@dataclass(frozen=True)
class Format3Shard:
    """A shard of a method of a run folder; `path` is its receipt."""

    path: Path
    folder: Path
    slug: str
    header: dict[str, Any]
    method: str
    shard: Shard

    @cached_property
    def _receipt(self) -> dict[str, Any]:
        receipt = checked(_Receipt, read_json(self.path), self.path)
        check_receipt(receipt, self.header, self.method, self.shard, self.path)
        found, kinds = sorted(receipt["files"]), {"trials", *self.header["stored"]}
        if set(found) - {"failures"} != kinds:
            raise RunError(f"{self.path}: names files of {found}, stored are {sorted(kinds)}")
        for kind, file in receipt["files"].items():
            own = f"{kind}/{self.slug}/{self.shard.name}-{file['sha256'][:16]}.parquet"
            if file["path"] != own:
                named = f"names the file {file['path'][:200]!r}"
                raise RunError(f"{self.path}: {named}; the only one it may name is {own}")
        return receipt

    def receipt(self) -> dict[str, Any]:
        """The stored rows of a shard; `RunError` if it belongs to another run, method or shard."""
        return self._receipt

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of tables that the shard holds."""
        return tuple(k for k in TABLES if k in self._receipt["files"])

    @property
    def tables(self) -> dict[str, Path]:
        """Kind -> its file."""
        return {k: self.folder / f["path"] for k, f in self._receipt["files"].items()}

    @property
    def files(self) -> tuple[Path, ...]:
        """All files of the shard."""
        return (self.path, *self.tables.values())

    def damage(self) -> str:
        """The first file that differs from what the receipt says, and how; empty: none does."""
        for kind, said in self._receipt["files"].items():
            if what := _difference(self.tables[kind], said):
                return f"{self.tables[kind]}: {what}"
        return ""

    def table(self, kind: str, columns: Sequence[str]) -> pa.Table:
        """Those columns of a kind that its file has; `RunError` if it is not as its schema says."""
        if kind not in self.kinds:
            raise RunError(f"{self.path}: names no {kind}; it names {', '.join(self.kinds)}")
        path, trials = self.tables[kind], self.shard.last - self.shard.first
        try:
            with pq.ParquetFile(path) as file:
                rows, names = file.metadata.num_rows, set(file.schema_arrow.names)
                if rows > trials or (kind == "trials" and rows != trials):
                    raise RunError(f"{path}: holds {rows} rows, its receipt says {trials} trials")
                check_present(kind, columns, names, path)
                there = [c for c in columns if c in names]
                check_decoded_size(file, most_bytes(kind, trials), str(path), there)
                table = file.read(columns=there)
        except FileError as error:
            raise RunError(str(error)) from None
        except (OSError, pa.ArrowException) as error:
            raise unreadable(path, error) from error
        check_columns(table, schema_of(self.header, kind), path)
        return table.select(there)


def _difference(file: Path, said: Mapping[str, Any]) -> str:
    try:
        found = file.lstat()
    except OSError:
        return "missing"
    if not stat.S_ISREG(found.st_mode):
        return "no regular file"
    if (size := found.st_size) != said["bytes"]:
        what = "truncated" if size < said["bytes"] else "too long"
        return f"{what}: {size} bytes, written were {said['bytes']}"
    return "" if sha256_of(file) == said["sha256"] else "flipped bits: differs from its sha256"


def receipts_of(folder: Path, header: dict[str, Any], slug: str) -> dict[int, Path]:
    """Number -> receipt of every stored shard of a method, in order."""
    place = folder / "manifest" / slug
    try:
        names = [n for n in os.listdir(place) if re.fullmatch(r"[0-9]{6}\.json", n, re.ASCII)]
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise RunError(f"{place}: cannot be read ({error.strerror or error})") from None
    return {int(n[:6]): place / n for n in sorted(names) if shard_at(header, int(n[:6]))}
