"""Read a run folder back, checked. `python -m r2h_batch.results verify DIR` finds damaged and
foreign shards."""

import difflib
import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from r2h_batch.checks import flag, many, path, takes, text
from r2h_batch.files import printable
from r2h_batch.results.manifest import (
    FORMAT,
    SCHEMAS,
    RunError,
    Shard,
    checked_shard,
    problems,
    quarantine_path,
    read_header,
    read_methods,
    read_receipt,
    receipt_path,
    shard_at,
    shards_of,
    stored_in,
)
from r2h_batch.results.rows import LATER_COLUMNS
from r2h_batch.results.storage import claim

TIMING = ("t_plan_s", "t_method_s")
"""Columns of the trials that depend on the machine and the hour: not part of a digest."""


@dataclass(frozen=True)
class Run:
    """A stored run: `header` is run.json, `entries` its methods with their receipts, tables are
    read on demand."""

    folder: Path
    header: dict[str, Any]
    entries: tuple[dict[str, Any], ...]

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods whose rows are all there, in the order in which they were added."""
        return tuple(e["name"] for e in self.entries if not self.missing(e["name"]))

    @property
    def unfinished(self) -> tuple[str, ...]:
        """Names of the methods of which shards are still to be scored."""
        return tuple(e["name"] for e in self.entries if self.missing(e["name"]))

    def named(self, word: str) -> str:
        """The full name of a method, from that or from the word that the sweep was given for it
        (fc).

        The word is looked for in each method's stored source, not in titles: that names the
        function which answered.
        """
        text("word", word)
        names = [e["name"] for e in self.entries]
        if word in names:
            return word
        function = f"r2h_batch.methods.{word.replace('-', '_')}:predict"
        found = [e["name"] for e in self.entries if e["source"].get("function") == function]
        if len(found) == 1:
            return str(found[0])
        if found:
            raise RunError(
                f"{self.folder}: {word!r} answered several times: {', '.join(found)}; give one of these names"
            )
        close = difflib.get_close_matches(word, names, n=1)
        hint = f", did you mean {close[0]}?" if close else ""
        raise RunError(
            f"{self.folder}: no method {word!r}{hint}; it has {', '.join(names) or 'none'}"
        )

    def only(self, words: Sequence[str]) -> "Run":
        """The same run with these methods alone (`named`), in their stored order; all of them where
        none is given."""
        if not many(str, "names of methods", least=0)("words", words):
            return self
        kept = {self.named(w) for w in words}
        return replace(self, entries=tuple(e for e in self.entries if e["name"] in kept))

    def missing(self, method: str) -> list[Shard]:
        """Shards of a method that are planned and not stored."""
        stored = self.entry(method)["receipts"]
        return [s for s in shards_of(self.header) if s.index not in stored]

    def quarantined(self, method: str) -> list[Shard]:
        """Missing shards of a method that failed three times in the last attempt."""
        slug = self.entry(method)["slug"]
        return [s for s in self.missing(method) if quarantine_path(self.folder, slug, s).exists()]

    def entry(self, method: str) -> dict[str, Any]:
        """What is known about a method: source, command, slug, and `receipts` by number of
        shard."""
        text("method", method)
        for entry in self.entries:
            if entry["name"] == method:
                return entry
        names = ", ".join(e["name"] for e in self.entries) or "none"
        raise RunError(f"{self.folder}: no method {method!r}; it has {names}")

    def trials(self, method: str, columns: Sequence[str] | None = None) -> pa.Table:
        """One row per trial, `rows.TRIAL_SCHEMA` or some of its columns, in the plan's order."""
        return self._read("trials", method, columns)

    def details(self, method: str) -> pa.Table:
        """Goal, grasp and witness of the scored trials, `rows.DETAIL_SCHEMA`."""
        return self._read("details", method, None)

    def poses(self, method: str) -> pa.Table:
        """The scored poses, `rows.POSE_SCHEMA`: no rows for missing trials."""
        return self._read("poses", method, None)

    def paths(self, method: str) -> pa.Table:
        """Waypoints and times of the trials that have a path, `rows.PATH_SCHEMA`."""
        return self._read("paths", method, None)

    def failures(self, method: str) -> pa.Table:
        """The trials whose simulation failed, with what is needed to run them again,
        `rows.FAILURE_SCHEMA`."""
        receipts = [r for r in self.entry(method)["receipts"].values() if "failures" in r["files"]]
        tables = [self._stored("failures", r, None) for r in receipts]
        return pa.concat_tables([SCHEMAS["failures"].empty_table(), *tables]).unify_dictionaries()

    def shards(
        self, kind: str, method: str, columns: Sequence[str] | None = None
    ) -> Iterator[pa.Table]:
        """The stored tables of a kind, shard by shard: what does not fit into memory at once."""
        for receipt in self.entry(method)["receipts"].values():
            if kind not in receipt["files"]:
                raise RunError(
                    f"{self.folder}: method {method!r} has no {kind}; sweep again with --save-{kind}"
                )
            yield self._stored(kind, receipt, columns)

    def shard(self, kind: str, method: str, index: int) -> pa.Table:
        """The stored table of a kind of one shard alone; `RunError` where there is none."""
        receipt = self.entry(method)["receipts"].get(index)
        if receipt is None or kind not in receipt["files"]:
            raise RunError(f"{self.folder}: shard {index} of {method!r} has no {kind}")
        return self._stored(kind, receipt, None)

    def verify(self) -> None:
        """Raise unless every file of every receipt is there with its sha256."""
        for _, shard, file, what in problems(self.folder, self.header):
            if shard is not None:
                raise RunError(
                    f"{file}: {what}; `r2h-batch results verify {self.folder}` marks it, the sweep redoes it"
                )

    def digest(self, method: str) -> str:
        """sha256 (hex) over all rows of a method without `TIMING`: the same for any shards, chunks
        and workers."""
        columns = [c for c in SCHEMAS["trials"].names if c not in TIMING]
        hashes = {(c, part): hashlib.sha256() for c in columns for part in ("given", "value")}
        for table in self.shards("trials", method, columns):
            for name in columns:
                column = table[name].combine_chunks()
                hashes[name, "given"].update(
                    column.is_valid().to_numpy(zero_copy_only=False).tobytes()
                )
                hashes[name, "value"].update(_plain(column).tobytes())
        return hashlib.sha256(b"".join(h.digest() for h in hashes.values())).hexdigest()

    def _read(self, kind: str, method: str, columns: Sequence[str] | None) -> pa.Table:
        tables = list(self.shards(kind, method, columns))
        if not tables:
            names = SCHEMAS[kind].names if columns is None else columns
            return pa.schema([SCHEMAS[kind].field(n) for n in names]).empty_table()
        return pa.concat_tables(tables).unify_dictionaries()

    def _stored(
        self, kind: str, receipt: dict[str, Any], columns: Sequence[str] | None
    ) -> pa.Table:
        path = self.folder / receipt["files"][kind]["path"]
        return self._table(kind, path, columns, receipt["last"] - receipt["first"])

    def _table(self, kind: str, path: Path, columns: Sequence[str] | None, trials: int) -> pa.Table:
        """Columns of a stored file that holds at most the `trials` of its shard: the size is known
        before it is read."""
        schema = SCHEMAS[kind]
        names = schema.names if columns is None else list(columns)
        try:
            with pq.ParquetFile(path) as file:
                rows = file.metadata.num_rows
                if rows > trials or (kind == "trials" and rows != trials):
                    raise RunError(f"{path}: holds {rows} rows, its receipt says {trials} trials")
                there = [n for n in names if n in file.schema_arrow.names]
                for name in names:
                    if name not in there and name not in LATER_COLUMNS:
                        raise RunError(
                            f"{path}: column {name!r} is missing; format {FORMAT} has it"
                        )
                table = file.read(columns=there)
            for name in (n for n in names if n not in there):  # of LATER_COLUMNS: an older run
                table = table.append_column(
                    schema.field(name), pa.nulls(rows, schema.field(name).type)
                )
            table = table.select(names)
        except (OSError, pa.ArrowException) as error:
            raise RunError(f"{path}: cannot be read ({printable(error)[:300]})") from error
        _check_columns(table, [schema.field(n) for n in names], path)
        return table


MAX_WORDS = 100_000
"""Different words in one column of a shard."""


def _check_columns(table: pa.Table, fields: Sequence[pa.Field], path: Path) -> None:
    for field in fields:
        column = table[field.name]
        if column.type != field.type:
            raise RunError(
                f"{path}: column {field.name!r} is missing or of another type than format {FORMAT} says"
            )
        if not field.nullable and column.null_count:
            raise RunError(
                f"{path}: column {field.name!r} has {column.null_count} empty rows; it must have none"
            )
        if pa.types.is_dictionary(field.type):
            for chunk in column.chunks:
                words = chunk.dictionary
                if len(words) > MAX_WORDS or not all(
                    w and len(w) <= 200 and w.isprintable() for w in words.to_pylist()
                ):
                    raise RunError(
                        f"{path}: column {field.name!r} holds what is no name; sweep again"
                    )


def _plain(column: pa.Array) -> np.ndarray:
    """Values as numbers of fixed size: words by their hash, empty ones as 0, so that equal rows
    give equal bytes."""
    if pa.types.is_dictionary(column.type):
        words = [hashlib.sha256(w.encode()).digest()[:8] for w in column.dictionary.to_pylist()]
        codes = np.frombuffer(b"".join([*words, bytes(8)]), "<u8")
        return codes[column.indices.fill_null(len(words)).to_numpy()]
    return np.asarray(column.fill_null(False if pa.types.is_boolean(column.type) else 0))


@takes(verify=flag)
def load_run(folder: str | Path, *, verify: bool = True) -> Run:
    """The run stored in `folder`; with `verify`, every file is compared with its sha256 first."""
    folder = path("folder", folder)
    header = read_header(folder)
    entries = []
    for entry in read_methods(folder):
        here = stored_in(folder, header, entry["slug"])
        entries.append(
            {**entry, "receipts": {s.index: read_receipt(folder, header, entry, s) for s in here}}
        )
    run = Run(folder, header, tuple(entries))
    if verify:
        run.verify()
    return run


def mark_for_rerun(folder: Path, header: dict[str, Any]) -> list[str]:
    """Take everything that cannot be trusted out of the run, keeping it as FILE.bad; one line for
    each."""
    lines = []
    entries = {e["name"]: e for e in read_methods(folder)}
    opened: set[tuple[str, int]] = set()  # shards whose receipt was set aside here
    for method, shard, file, what in list(problems(folder, header)):
        entry = entries[method]
        number = (
            shard.index
            if shard is not None
            else int(file.stem[:6])
            if _NUMBERED.match(file.stem)
            else -1
        )
        with claim(folder / ".claims" / f"{entry['slug']}-{number:06d}") as mine:
            if not mine:  # another sweep is between a file and its receipt
                continue
            if (method, number) not in opened and not _still_wrong(
                folder, header, entry, number, shard, file
            ):
                continue
            if shard is not None:
                opened.add((method, number))
                receipt = receipt_path(folder, entry["slug"], shard)
                if receipt.exists():
                    receipt.replace(receipt.with_suffix(".json.bad"))
            if file.exists():
                file.replace(file.with_name(file.name + ".bad"))
        again = f"shard {shard.index} of {method!r} will be scored again" if shard else "set aside"
        lines.append(f"{printable(file)}: {what}; {again}")
    return lines


_NUMBERED = re.compile(r"[0-9]{6}(-|$)", re.ASCII)


def _still_wrong(
    folder: Path,
    header: dict[str, Any],
    entry: dict[str, Any],
    number: int,
    shard: Shard | None,
    file: Path,
) -> bool:
    """Whether a file is still what it was found to be, now that nobody else can change its shard.

    Between the look and the claim another part of the sweep may have stored the shard whose file no
    receipt named yet, or set aside and scored again the one that was damaged.
    """
    here = shard_at(header, number) if number >= 0 else None
    now: dict[Path, str | None] = {}
    if here is not None and os.path.lexists(receipt_path(folder, entry["slug"], here)):
        now = dict(checked_shard(folder, header, entry, here))
    return file not in now if shard is None else now.get(file) is not None
