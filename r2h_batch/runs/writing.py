"""A run folder that takes shards: opened or made, methods added, shards claimed, stored, given up."""

import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pyarrow as pa

from r2h_batch.base.io.read import printable
from r2h_batch.base.io.write import run_folder_of
from r2h_batch.runs.columns import TABLES
from r2h_batch.runs.files import (
    Claim,
    RunError,
    claim,
    died_at,
    owner_of,
    write_json_once,
)
from r2h_batch.runs.header import (
    FORMAT,
    MAX_TEXT,
    Method,
    Shard,
    check_header,
    checked,
    differing,
    planned_in,
    read_header,
    run_hash,
    schema_of,
    shards_of,
)
from r2h_batch.runs.methods import Entry, read_methods
from r2h_batch.runs.shard import (
    count_outcomes,
    drop_set_aside,
    shard_folder,
    stored_files,
    write_shard,
)
from r2h_batch.runs.side import side_files
from r2h_batch.runs.store import IMPORTED
from r2h_batch.runs.verify import not_as_planned

SHARD_TRIALS = 100_000
"""Trials of a shard unless the user sets another number."""
TRIES = 3
"""A sweep goes on without a shard after this many deaths or errors."""

OTHER_OUT = "choose another --out"


class ShardWriter:
    """Takes a shard's rows in any number of pieces; they are stored when the shard is whole."""

    def __init__(self) -> None:
        self.tables: dict[str, list[pa.Table]] = {kind: [] for kind in TABLES}

    def append(self, **tables: pa.Table) -> None:
        """Add rows of `trials`, `details`, `poses`, `paths` or `failures`."""
        for kind, table in tables.items():
            for column in TABLES[kind]:
                if not column.nullable and (n := table[column.name].null_count):
                    raise ValueError(f"{kind}: column {column.name!r} has {n} empty rows")
            self.tables[kind].append(table)

    def table(self, kind: str, schema: pa.Schema) -> pa.Table:
        """All rows of a kind so far; `schema`: of a run without any. Rows that nobody judged by a further criterion lack its
        columns, as older rows do."""
        rows = self.tables[kind]
        there = [name for name in schema.names if not rows or name in rows[0].column_names]
        tables = [schema.empty_table().select(there), *rows]
        return pa.concat_tables(tables).unify_dictionaries()


class RunFolder:
    """A run folder that takes shards; `open_run` makes it."""

    def __init__(self, folder: Path, header: dict[str, Any], command: Sequence[str]) -> None:
        self.folder, self.header, self.command = folder, header, _printable_words(command)
        self.entries = {e.name: e for e in read_methods(folder, header)}

    def register(self, method: str, source: Mapping[str, Any], *, overwrite: bool = False) -> bool:
        """Add a method.

        Args:
            method: its name.
            source: where its answers come from.
            overwrite: whether rows of one of this name from another source make way for the new ones.

        Returns:
            Whether there were such rows, and they are gone.

        Raises:
            RunError: the folder has one of this name from another source, which stays.
        """
        readable = re.sub(r"[^A-Za-z0-9._-]+", "_", method).strip("._")[:60] or "method"
        taken = {e.slug.lower(): e for e in read_methods(self.folder, self.header)}
        for slug in (readable, f"{readable}-{hashlib.sha256(method.encode()).hexdigest()[:8]}"):
            path = self.folder / "methods" / f"{slug}.json"
            new = {"name": method, "source": dict(source), "command": self.command}
            new = checked(Method, {**new, "order": len(taken)}, path)
            entry = taken.get(slug.lower())
            if entry is None and not write_json_once(path, new):  # another process was faster
                found = read_methods(self.folder, self.header)
                entry = next(e for e in found if e.slug == slug)
            entry = entry or Entry(self.folder, self.header, slug, **new)
            if entry.name == method:
                old = entry.source
                # what it reads decides no row, and 0.3 did not say it
                keys = (k for k in {**old, **source} if k != "reads")
                if other := [k for k in keys if old.get(k) != source.get(k)]:
                    if overwrite:
                        self._drop(entry)
                        self.register(method, source)
                        return True
                    raise _from_another(entry, other, source)
                self.entries[method] = entry
                return False
        raise AssertionError("one of two names of a file is free or the method's own")

    def _drop(self, entry: Entry) -> None:
        """Removes all that the folder has of a method, its file last: a kill on the way leaves a method that can be dropped."""
        for path in entry.claims().values():
            with claim(path) as own:
                if own is None:
                    who = owner_of(path) or "another process"
                    raise RunError(f"{self.folder}: {who} scores {entry.name!r} now; wait for it")
        for path in (*side_files(entry), *entry.claims().values()):
            path.unlink(missing_ok=True)
        shutil.rmtree(shard_folder(self.folder, entry.slug), ignore_errors=True)
        (self.folder / "methods" / f"{entry.slug}.json").unlink(missing_ok=True)

    def stored(self, method: str) -> set[int]:
        """Numbers of the shards that are complete now."""
        entry = self.entries[method]
        return set(stored_files(self.header, self.folder, entry.slug))

    def todo(self, method: str, part: tuple[int, int] = (1, 1)) -> list[Shard]:
        """Shards still to score, of part I of N (every N-th shard): those at which processes died come last.

        A shard that an earlier sweep went on without is tried again.
        """
        entry, done = self.entries[method], self.stored(method)
        own = [s for s in shards_of(self.header)[part[0] - 1 :: part[1]] if s.index not in done]
        claims, died = entry.claims(), {}
        for number in claims.keys() & done:  # their processes died right after they had stored them
            with suppress(OSError), claim(claims[number]):
                pass
        for shard in own if claims else ():
            if path := claims.get(shard.index):
                died[shard.index] = len(died_at(path))
                if died[shard.index] > TRIES:
                    path.unlink(missing_ok=True)
        return sorted(own, key=lambda s: died.get(s.index, 0))

    @contextmanager
    def claim(self, method: str, shard: Shard) -> Iterator[Claim | None]:
        """The claim of a shard, None if another process has it; remains of a killed one are removed."""
        entry = self.entries[method]
        with claim(entry.claim_path(shard.index)) as own:
            if own is not None:
                place = shard_folder(self.folder, entry.slug)
                for stale in place.glob(f".{shard.name}*.tmp"):
                    stale.unlink(missing_ok=True)
            yield own

    def claimed_by(self, method: str, shard: Shard) -> str:
        """Who works on the shard, or did last: `process 7 on HOST`; empty if that is not known."""
        return owner_of(self.entries[method].claim_path(shard.index))

    @contextmanager
    def write(self, method: str, shard: Shard) -> Iterator[ShardWriter]:
        """A writer for a shard; its rows appear when the block ends without an error."""
        start = time.perf_counter()
        writer = ShardWriter()
        yield writer
        self.commit(method, shard, writer, time.perf_counter() - start)

    def commit(self, method: str, shard: Shard, writer: ShardWriter, seconds: float) -> bool:
        """Store a whole shard.

        Returns:
            False, with nothing written, if another process stored it first.

        Raises:
            RunError: the rows are not the planned ones.
        """
        entry, where = self.entries[method], f"{self.folder}: shard {shard.index} of {method!r}"
        tables = {kind: writer.table(kind, schema_of(self.header, kind)) for kind in TABLES}
        outcomes = count_outcomes(tables["trials"])
        planned = planned_in(self.header, shard)
        found = {s: sum(c.values()) for s, c in outcomes.items()}
        if found != planned:
            raise RunError(f"{where} has {found} rows, planned were {planned}")
        for kind, table in tables.items():
            first, last, every = shard.first, shard.last, kind == "trials"
            if what := not_as_planned(self.header, first, last, table, every=every):
                raise RunError(f"{where}, {kind}: {what}; nothing was stored")
        place = shard_folder(self.folder, entry.slug)
        won = write_shard(place, self.header, method, shard, tables, seconds)
        drop_set_aside(place, shard.index)
        return won


def check_files(folder: Path, method: str, source: Mapping[str, str]) -> None:
    """Refuse a method whose files are not those of its rows in a folder, as `RunFolder.register` does once all is prepared.

    Args:
        folder: a run folder, or where one will be.
        method: its name.
        source: its files, and what else is known of its source before a scene is prepared.

    Raises:
        RunError: a file has changed, come or gone.
    """
    if not (folder / "run.json").exists():
        return
    header = read_header(folder)
    for entry in (e for e in read_methods(folder, header) if e.name == method):
        keys = {k: None for k in entry.source if k.startswith("file ")} | dict.fromkeys(source)
        if other := [k for k in keys if entry.source.get(k) != source.get(k)]:
            raise _from_another(entry, other, source)


def _from_another(entry: Entry, keys: Sequence[str], source: Mapping[str, Any]) -> RunError:
    words = f"already holds {entry.name!r}, {_changed(keys, source)}"
    how = f"add --overwrite to judge it anew in their place, or {OTHER_OUT}"
    return RunError(f"{entry.folder}: {words}; {how}")


def _changed(keys: Sequence[str], source: Mapping[str, Any]) -> str:
    """What differs between a method's source and that of its rows, in words: files by their names."""
    files = [k.removeprefix("file ") for k in keys if k.startswith("file ")]
    if not files and "sha256" in keys and "file" in source:
        files = [str(source["file"])]
    others = [k for k in keys if k != "sha256" and not k.startswith("file ")]
    if not files:
        return f"made with another {', '.join(others or keys)}"
    more = f", and so did {', '.join(others)}" if others else ""
    return f"and {printable(', '.join(files))} changed since{more}"


def _printable_words(command: Any) -> Any:
    """A command line as it can be stored."""
    if not isinstance(command, (list, tuple)):
        return command
    return [printable(c)[:MAX_TEXT] for c in command]


def check_place(folder: Path) -> None:
    """Refuse what `open_run` cannot write into, whatever the run; makes nothing.

    Args:
        folder: a run folder, or one that may be missing.

    Raises:
        RunError: it lies in a run folder, is a file, or holds something else.
    """
    if outer := run_folder_of(folder):
        words = f"lies in the run folder {outer}, which holds its own files alone; {OTHER_OUT}"
        raise RunError(f"{folder}: {words}")
    path = folder / "run.json"
    try:
        if os.path.lexists(path) or not folder.exists():
            return
        names = [p.name for p in folder.iterdir() if not p.name.startswith((".", IMPORTED))]
    except OSError as error:
        words = f"cannot be written ({error.strerror or error}); {OTHER_OUT}"
        raise RunError(f"{folder}: {words}") from error
    if names and not os.path.lexists(path):  # another sweep may have begun meanwhile
        words = f"not empty and not a run folder (it has {min(names)!r}); {OTHER_OUT}"
        raise RunError(f"{folder}: {words}")


def open_run(folder: str | Path, header: Mapping[str, Any], *, exact: bool = True) -> RunFolder:
    """Open a folder for writing: a new one, or one of the same configuration.

    Args:
        folder: the run folder; it is made if missing.
        header: run.json; `shard_trials` 0 takes the size of the folder, or `SHARD_TRIALS`.
        exact: whether a folder with another shard size is refused.

    Raises:
        RunError: the folder holds something else or another run.
    """
    folder = Path(folder)
    new = {"stored": [], **json.loads(json.dumps(header, allow_nan=False)), "format": FORMAT}
    wanted = new.get("shard_trials") or 0
    new["shard_trials"] = wanted or SHARD_TRIALS
    new["command"] = _printable_words(new.get("command", []))
    new["hash"] = run_hash(new)
    path = folder / "run.json"
    check_header(new, path)
    check_place(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.path.lexists(path):
            write_json_once(path, new)
    except OSError as error:
        words = f"cannot be written ({error.strerror or error}); {OTHER_OUT}"
        raise RunError(f"{folder}: {words}") from error
    old = read_header(folder)
    if fields := differing(old, new):
        words = f"another run, which differs in {', '.join(fields)}"
        raise RunError(f"{folder}: {words}; {OTHER_OUT}")
    if exact and wanted and wanted != old["shard_trials"]:
        words = f"has shards of {old['shard_trials']} trials; the command wants {wanted}"
        raise RunError(f"{folder}: {words}; {OTHER_OUT}")
    return RunFolder(folder, old, header.get("command", ()))
