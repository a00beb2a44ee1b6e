"""Write a run folder: shard by shard, whole or not at all, by any number of processes at once."""

import hashlib
import json
import os
import re
import socket
import stat
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from r2h_batch.files import printable
from r2h_batch.files.output import run_folder_of
from r2h_batch.results.consistent import inconsistent
from r2h_batch.results.manifest import (
    FORMAT,
    SCHEMAS,
    SHARD_TRIALS,
    RunError,
    Shard,
    checked_header,
    differing,
    planned_in,
    quarantine_path,
    read_header,
    read_json,
    read_methods,
    receipt_path,
    run_hash,
    shards_of,
    stored_in,
)
from r2h_batch.results.planned import not_as_planned
from r2h_batch.results.records import Method, checked, printable_words
from r2h_batch.results.storage import (
    claim,
    drop_second_names,
    link_once,
    open_own,
    replace_json,
    sha256_of,
    sync_file,
    temporary_name,
    write_json_once,
)

OTHER = "choose another --out"

TRIES = 3
"""Deaths or errors of a shard after which it is quarantined."""

_FLOATS = {k: [f.name for f in s if f.type == pa.float32()] for k, s in SCHEMAS.items()}
_AMORTISED = (
    "t_plan_s",
    "t_method_s",
)  # one value a chunk: a dictionary takes less than a bit a trial


class ShardWriter:
    """Takes a shard's rows in any number of pieces; they are written when the shard is whole."""

    def __init__(self) -> None:
        self.tables: dict[str, list[pa.Table]] = {kind: [] for kind in SCHEMAS}

    def append(self, **tables: pa.Table) -> None:
        """Add rows: `trials`, `details`, `poses` and `paths` where they are stored, `failures`
        where there are any."""
        for kind, table in tables.items():
            for field in SCHEMAS[kind]:
                if not field.nullable and table[field.name].null_count:
                    raise ValueError(
                        f"{kind}: column {field.name!r} has {table[field.name].null_count} empty rows"
                    )
            self.tables[kind].append(table)

    def table(self, kind: str) -> pa.Table:
        """All rows of a kind so far."""
        return pa.concat_tables(
            [SCHEMAS[kind].empty_table(), *self.tables[kind]]
        ).unify_dictionaries()


class RunFolder:
    """A run folder that takes shards; made by `open_run`."""

    def __init__(self, folder: Path, header: dict[str, Any], command: Sequence[str]) -> None:
        self.folder, self.header, self.command = folder, header, printable_words(command)
        self.slugs = {e["name"]: e["slug"] for e in read_methods(folder)}
        for part in (folder, folder / "methods"):
            drop_second_names(part)

    def register(self, method: str, source: Mapping[str, Any]) -> None:
        """Add a method; an error if the folder has one of this name from another source."""
        readable = re.sub(r"[^A-Za-z0-9._-]+", "_", method).strip("._")[:60] or "method"
        taken = {e["slug"].lower(): e for e in read_methods(self.folder)}
        for slug in (readable, f"{readable}-{hashlib.sha256(method.encode()).hexdigest()[:8]}"):
            path = self.folder / "methods" / f"{slug}.json"
            entry = {
                "name": method,
                "source": dict(source),
                "command": self.command,
                "order": len(taken),
            }
            checked(Method, entry, path)
            stored = taken.get(slug.lower())
            if stored is None and write_json_once(path, entry):
                stored = entry
            stored = stored or next(e for e in read_methods(self.folder) if e["slug"] == slug)
            if stored["name"] == method:
                if stored["source"] != dict(source):
                    raise RunError(
                        f"{self.folder}: already holds {method!r} from another source; {OTHER}"
                    )
                self.slugs[method] = slug
                return
        raise RunError(f"{self.folder}: no free file name for method {method!r}; {OTHER}")

    def stored(self, method: str, shard: Shard) -> bool:
        """Whether the shard's rows are complete."""
        return receipt_path(self.folder, self.slugs[method], shard).exists()

    def todo(self, method: str, part: tuple[int, int] = (1, 1)) -> list[Shard]:
        """Shards still to be scored, of part I of N of all (every N-th one)."""
        done = set(stored_in(self.folder, self.header, self.slugs[method]))
        drop_second_names(self.folder / "manifest" / self.slugs[method])
        return [s for s in shards_of(self.header)[part[0] - 1 :: part[1]] if s not in done]

    @contextmanager
    def claim(self, method: str, shard: Shard) -> Iterator[bool]:
        """Whether this process alone works on the shard now; what a killed one left of it is
        removed first."""
        slug = self.slugs[method]
        with claim(self.folder / ".claims" / f"{slug}-{shard.name}") as mine:
            if mine:
                for kind in (*SCHEMAS, "manifest"):
                    for stale in (self.folder / kind / slug).glob(f".{shard.name}*.tmp"):
                        stale.unlink(missing_ok=True)
            yield mine

    def deaths(self, method: str, shard: Shard) -> int:
        """How many processes ended while they were at the shard, killed or crashed, since it was
        last tried without."""
        try:
            found = self._begun(method, shard).lstat()
        except FileNotFoundError:
            return 0
        return found.st_size if stat.S_ISREG(found.st_mode) else 0

    @contextmanager
    def attempt(self, method: str, shard: Shard) -> Iterator[None]:
        """Around the scoring of a claimed shard: a process that dies inside leaves a mark, whatever
        killed it."""
        path, before = self._begun(method, shard), self.deaths(method, shard)
        handle = open_own(path, os.O_WRONLY | os.O_APPEND)
        try:
            os.write(handle, b".")
            yield
        finally:
            os.ftruncate(handle, before)  # stored, stopped, refused or a full disk: no death
            os.close(handle)
            if not before:
                path.unlink(missing_ok=True)

    def quarantined(self, method: str, shard: Shard) -> bool:
        """Whether the shard was given up."""
        return quarantine_path(self.folder, self.slugs[method], shard).exists()

    def give_another_try(self, method: str, shard: Shard) -> None:
        """Take back a quarantine: one more death brings it back."""
        slug = self.slugs[method]
        quarantine_path(self.folder, slug, shard).unlink(missing_ok=True)
        if (deaths := self.deaths(method, shard)) > 1:
            os.truncate(self._begun(method, shard), min(deaths, TRIES) - 1)

    def _begun(self, method: str, shard: Shard) -> Path:
        return self.folder / ".claims" / f"{self.slugs[method]}-{shard.name}.begun"

    @contextmanager
    def write(self, method: str, shard: Shard) -> Iterator[ShardWriter]:
        """A writer for a shard's rows; when the block ends well they appear at once, else nothing
        does."""
        start = time.perf_counter()
        writer = ShardWriter()
        yield writer
        self.commit(method, shard, writer, time.perf_counter() - start)

    def commit(self, method: str, shard: Shard, writer: ShardWriter, seconds: float) -> bool:
        """Store a whole shard; False, and nothing written, if another process has stored it
        first."""
        slug = self.slugs[method]
        outcomes = _outcomes(writer.table("trials"))
        planned, found = (
            planned_in(self.header, shard),
            {s: sum(c.values()) for s, c in outcomes.items()},
        )
        if found != planned:
            raise RunError(
                f"{self.folder}: shard {shard.index} of {method!r} has {found} rows, planned were {planned}"
            )
        for kind in SCHEMAS:
            rows, every = writer.table(kind), kind == "trials"
            what = not_as_planned(self.header, shard.first, shard.last, rows, every=every)
            if what := what or (inconsistent(self.header, rows) if every else None):
                raise RunError(
                    f"{self.folder}: shard {shard.index} of {method!r}, {kind}: {what}; nothing was stored"
                )
        mine: list[Path] = []
        try:
            files = {}
            failed = ["failures"] if len(writer.table("failures")) else []
            for kind in ("trials", *self.header["stored"], *failed):
                base = self.folder / kind / slug / shard.name
                path, sha256, size = self._file(kind, base, writer.table(kind), method)
                mine.append(path)
                files[kind] = {
                    "path": str(path.relative_to(self.folder)),
                    "sha256": sha256,
                    "bytes": size,
                }
            receipt = {
                "run": self.header["hash"],
                "method": method,
                "first": shard.first,
                "last": shard.last,
                "outcomes": outcomes,
                "files": files,
                "seconds": round(seconds, 3),
                "host": socket.gethostname(),
                "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            }
            won = write_json_once(receipt_path(self.folder, slug, shard), receipt)
        except BaseException:
            _remove(mine)
            raise
        if not won:
            kept = read_json(receipt_path(self.folder, slug, shard))["files"]
            _remove(
                [
                    p
                    for p in mine
                    if str(p.relative_to(self.folder)) not in {f["path"] for f in kept.values()}
                ]
            )
        for path in (quarantine_path(self.folder, slug, shard), self._begun(method, shard)):
            path.unlink(missing_ok=True)
        return won

    def quarantine(self, method: str, shard: Shard, errors: Sequence[str]) -> None:
        """Note that a shard failed for good; the next run of the same command tries it again."""
        data = {
            "method": method,
            "first": shard.first,
            "last": shard.last,
            "errors": [printable(e) for e in errors],
        }
        replace_json(quarantine_path(self.folder, self.slugs[method], shard), data)

    def _file(self, kind: str, base: Path, table: pa.Table, method: str) -> tuple[Path, str, int]:
        """Write a table under a name that holds its sha256 (two writers of one shard never meet in
        one file).

        Its path, sha256 and size."""
        base.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(base)
        metadata = {
            "r2h_batch.format": str(FORMAT),
            "r2h_batch.method": method,
            "r2h_batch.run": self.header["hash"],
        }
        floats = [c for c in _FLOATS[kind] if c not in _AMORTISED]
        words = [f.name for f in SCHEMAS[kind] if pa.types.is_dictionary(f.type)]
        try:
            pq.write_table(
                table.replace_schema_metadata(metadata),
                temporary,
                row_group_size=max(len(table), 1),
                compression="zstd",
                compression_level=6,
                use_dictionary=[*words, *(c for c in _AMORTISED if c in table.column_names)],
                column_encoding={
                    "trial_id": "DELTA_BINARY_PACKED",
                    **dict.fromkeys(floats, "BYTE_STREAM_SPLIT"),
                },
            )
            sync_file(temporary)
            sha256, size = sha256_of(temporary), temporary.stat().st_size
            final = base.with_name(f"{base.name}-{sha256[:16]}.parquet")
            link_once(temporary, final)
        finally:
            temporary.unlink(missing_ok=True)
        return final, sha256, size


def _remove(paths: Sequence[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)


def _outcomes(table: pa.Table) -> dict[str, dict[str, int]]:
    """Trials of each split and outcome."""
    keys = pa.table({k: table[k].cast(pa.string()) for k in ("split", "outcome")})
    counts: dict[str, Counter[str]] = {}
    for row in keys.group_by(["split", "outcome"]).aggregate([([], "count_all")]).to_pylist():
        counts.setdefault(row["split"], Counter())[row["outcome"]] += row["count_all"]
    return {s: dict(sorted(c.items())) for s, c in sorted(counts.items())}


def open_run(folder: str | Path, header: Mapping[str, Any], *, exact: bool = True) -> RunFolder:
    """The folder, ready to take shards: new, or of the same configuration; anything else is
    refused.

    `header["shard_trials"]` 0: as the folder has it, `SHARD_TRIALS` in a new one; not `exact`: only
    for a new one.
    """
    folder = Path(folder)
    new = {"stored": [], **json.loads(json.dumps(header, allow_nan=False)), "format": FORMAT}
    asked = new.get("shard_trials") or 0
    new["shard_trials"] = asked or SHARD_TRIALS
    new["command"] = printable_words(new.get("command", []))
    new["hash"] = run_hash(new)
    checked_header(new, folder / "run.json")
    if outer := run_folder_of(folder):
        raise RunError(
            f"{folder}: lies in the run folder {outer}, which holds its own files alone; {OTHER}"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.path.lexists(folder / "run.json"):
            foreign = [
                p.name
                for p in folder.iterdir()
                if not p.name.startswith(".") and p.name != "run.json"
            ]
            if foreign and not os.path.lexists(folder / "run.json"):
                raise RunError(
                    f"{folder}: not empty and not a run folder (it has {min(foreign)!r}); {OTHER}"
                )
            write_json_once(folder / "run.json", new)
    except OSError as error:
        raise RunError(
            f"{folder}: cannot be written ({error.strerror or error}); {OTHER}"
        ) from error
    old = read_header(folder)
    if fields := differing(old, new):
        raise RunError(
            f"{folder}: another run, which differs in {', '.join(fields)}; {OTHER}, or --force-new: a new folder beside this one"
        )
    if exact and asked and asked != old["shard_trials"]:
        raise RunError(
            f"{folder}: has shards of {old['shard_trials']} trials, asked were {asked}; {OTHER}"
        )
    return RunFolder(folder, old, header.get("command", ()))
