"""What a run folder says about itself: run.json, its methods, and one receipt with sha256 per
stored shard.

runs/NAME/run.json                              what is run: protocol, digests, configuration,
versions, shard size runs/NAME/methods/METHOD.json                   a method or predictions file,
and where its answers come from runs/NAME/manifest/METHOD/000017.json           receipt of a shard:
its range, outcomes, and each file with its sha256 runs/NAME/trials/METHOD/000017-SHA.parquet
its rows; details/, poses/ and paths/ beside it where they were asked for
runs/NAME/failures/METHOD/000017-SHA.parquet    the trials of it whose simulation failed, if there
are any runs/NAME/quarantine/METHOD/000017.json         a shard that failed three times, and how

A shard is stored when its receipt is there. Nothing else is ever changed, so any number of
processes may share a folder.
"""

import difflib
import errno
import fcntl
import hashlib
import json
import math
import os
import re
import socket
import stat
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal
from uuid import uuid4

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from r2h_batch.checks import flag, many, takes, text
from r2h_batch.checks import path as path_of
from r2h_batch.io.read import FileError, kind_of, printable, read_file
from r2h_batch.io.write import run_folder_of
from r2h_batch.runs.row_checks import inconsistent, not_as_planned, stored_wrong
from r2h_batch.runs.rows import (
    DETAIL_SCHEMA,
    FAILURE_SCHEMA,
    LATER_COLUMNS,
    OUTCOME_NAMES,
    PATH_SCHEMA,
    POSE_SCHEMA,
    TRIAL_SCHEMA,
)
from r2h_batch.validate import rule_of


def sha256_of(path: Path) -> str:
    """sha256 (hex) of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def temporary_name(path: Path) -> Path:
    """A unique hidden name beside `path` that no reader of `*.parquet` or `*.json` takes for a
    finished file."""
    return path.with_name(f".{path.name}.{uuid4().hex}.tmp")


def sync_file(path: Path) -> None:
    """The file's bytes are on the disk when this returns; an error of a full disk or a quota comes
    out here at last."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """The names in a folder are on the disk when this returns."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def link_once(temporary: Path, final: Path) -> bool:
    """Give a finished temporary file its name; False if the name is taken: the first writer
    wins."""
    try:
        os.link(temporary, final)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
            raise OSError(
                error.errno,
                "this file system has no hard links; put the run folder on one that has",
                str(final),
            ) from error
        raise
    sync_folder(final.parent)
    return True


def write_json_once(path: Path, data: Mapping[str, Any]) -> bool:
    """Write a JSON file unless there is one; False if there was."""
    temporary = _json_file(path, data)
    try:
        return link_once(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def drop_second_names(folder: Path) -> None:
    """Remove temporary names of files that have their final name as well: their writer was killed
    between the two."""
    for temporary in folder.glob(".*.tmp") if folder.is_dir() else ():
        try:
            if temporary.lstat().st_nlink > 1:
                temporary.unlink()
        except OSError:  # its writer lives and was faster, or the folder is only for reading
            continue


def replace_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a JSON file in place of the one that may be there; readers see the old or the new
    one."""
    temporary = _json_file(path, data)
    try:
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _json_file(path: Path, data: Mapping[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(data, file, indent=1, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary


def open_own(path: Path, flags: int) -> int:
    """A descriptor of a plain file of the folder, made where there is none; links and pipes are
    refused in one line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return os.open(
            path, flags | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666
        )
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO):
            raise
        raise OSError(
            error.errno, "no plain file but a link or a pipe; take it away", str(path)
        ) from None


def trouble_in(folder: Path, error: OSError) -> str:
    """What an error while a run folder was written says: the folder, what in it (by its final
    name), what to do."""
    for name in (error.filename2, error.filename):
        place = (
            Path(os.path.abspath(os.fsdecode(name)))
            if isinstance(name, (str, bytes, os.PathLike))
            else None
        )
        if place is None or not place.is_relative_to(folder):
            continue
        place = place.with_name(re.sub(r"^\.(.+)\.[0-9a-f]{32}\.tmp$", r"\1", place.name))
        inside = place.relative_to(folder).parts
        for k in range(1, len(inside) + 1):
            is_folder = k < len(inside) or error.errno in (errno.EEXIST, errno.ENOTDIR)
            if what := in_the_way(folder.joinpath(*inside[:k]), folder=is_folder):
                return f"run folder {printable(folder)}: {what}"
        why = error.strerror or error
        return f"run folder {printable(folder)}: {printable(place.relative_to(folder))}: {why}; {GO_ON}"
    return ""


GO_ON = "shards that were complete are stored, run the same command to go on"


def in_the_way(path: Path, *, folder: bool = False) -> str:
    """What stands where a run has a file (or a folder) of its own and is none, and what to do;
    empty where nothing is wrong."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return ""
    if (stat.S_ISDIR if folder else stat.S_ISREG)(mode):
        return ""
    what = f"is {kind_of(mode)}, where the run has a {'folder' if folder else 'file'} of its own"
    return f"{printable(path)} {what}; move it away and run the same command again"


@contextmanager
def claim(path: Path) -> Iterator[bool]:
    """Whether this process alone works on what `path` stands for, until the block ends or the
    process dies.

    A claim only saves double work; `link_once` decides who wins. So a file system without locks
    says yes to everybody.
    """
    with open(open_own(path, os.O_RDWR), "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError as error:
            if error.errno not in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK):
                raise
        yield True


MAX_BYTES = 32 << 20
"""Of a JSON file: a run.json with 100,000 objects of one's own still fits."""
MAX_WORD = 4096
MAX_SHARDS = 10**6
"""Their numbers have six digits in file names."""
MAX_SHARD_TRIALS = 10**7
"""A shard is written and read as a whole: some GB."""

KINDS = ("trials", "details", "poses", "paths", "failures")
"""Folders of Parquet files."""

SLUG = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,79}")
"""A method's part of the file names."""


class RunError(ValueError):
    """A run folder that cannot be written or read: the message names the file and what to do."""


_ABSENT: Any = None
"""A field may be absent, but where it is written it is no null."""

Count = Annotated[int, Field(ge=0, le=10**12)]
Split = Literal["S0", "S1"]
Kind = Literal["trials", "details", "poses", "paths", "failures"]
OutcomeName = Literal[OUTCOME_NAMES]  # type: ignore[valid-type]
Word = Annotated[str, Field(max_length=MAX_WORD)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Metres = Annotated[float, Field(ge=0, le=1e3)]
Seconds = Annotated[float, Field(ge=0, le=1e12)]


class _Record(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class _Open(BaseModel):
    """A record that may hold more than the fields which the package reads."""

    model_config = ConfigDict(strict=True, extra="allow")
    __pydantic_extra__: dict[str, JsonValue]


class _Digests(_Open):
    trials: Word


class _Device(_Open):
    kind: Word
    name: Word


class _Versions(BaseModel):
    model_config = ConfigDict(strict=True, extra="allow")
    __pydantic_extra__: dict[str, Word]
    r2h_batch: Word


class _Thresholds(_Open):
    reach_radius_m: Metres
    w_max_m: Metres
    safe_margin_m: Metres


class _Plan(_Open):
    object_collision: Literal["hull", "pieces"]


class _Execute(_Open):
    scale: Annotated[float, Field(ge=1e-3, le=1e3)]
    max_velocity_rad_s: Annotated[float, Field(ge=1e-3, le=1e3)]
    max_acceleration_rad_s2: Annotated[float, Field(ge=1e-3, le=1e3)]


class _Configuration(_Open):
    """Runs that were not made by a sweep may lack parts; who needs one asks for it."""

    name: Word = ""
    thresholds: _Thresholds = _ABSENT
    plan: _Plan = _ABSENT
    execute: _Execute = _ABSENT


class _Motion(_Open):
    engine: Word
    model: Word | None = None
    step_s: Annotated[float, Field(gt=0, le=1e3)] | None = None
    sample_s: Annotated[float, Field(gt=0, le=1e3)] | None = None


class _Object(_Open):
    name: Name
    split: Split
    built_in: bool
    digest: Hash = _ABSENT


MAX_HANDS = 10**6
Side = Literal["right", "left"]


class _Benchmark(_Open):
    flags: Annotated[list[Word], Field(max_length=100)]


class _Predictors(_Open):
    noise_factor: Annotated[float, Field(ge=0, le=1e12)]


class Header(_Record):
    """run.json."""

    format: int
    hash: Hash
    protocol: Word
    trials: Annotated[dict[Split, Count], Field(min_length=1)]
    configuration: _Configuration
    digests: _Digests
    seed: Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)]
    device: _Device
    versions: _Versions
    stored: list[Kind]
    shard_trials: Annotated[int, Field(ge=1, le=MAX_SHARD_TRIALS)]
    predictors: _Predictors = _ABSENT
    motion: _Motion = _ABSENT
    objects: list[_Object] = _ABSENT
    benchmark: _Benchmark = _ABSENT
    hands: Annotated[list[Side], Field(min_length=1, max_length=MAX_HANDS)] = _ABSENT
    platform: Word = ""
    git_commit: Word | None = None
    command: list[Word] = []
    created: Word = ""


class Method(_Record):
    """methods/METHOD.json."""

    name: Name
    source: dict[Word, Word]
    command: list[Word]
    order: Annotated[int, Field(ge=0, le=10**6)]


class _File(_Record):
    path: Word
    sha256: Hash
    bytes: Annotated[int, Field(ge=1, le=1 << 42)]


class Receipt(_Record):
    """manifest/METHOD/NNNNNN.json."""

    run: Hash
    method: Name
    first: Count
    last: Count
    outcomes: dict[Split, dict[OutcomeName, Count]]
    files: dict[Kind, _File]
    seconds: Seconds = 0.0
    host: Word = ""
    written: Word = ""


def checked(model: type[_Record], data: Any, path: Path) -> dict[str, Any]:
    """The fields of a JSON object that the model names, unchanged; `RunError` names file, field,
    value and rule."""
    _check_words(data, path)
    try:
        model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(printable(p)[:60] for p in first["loc"]) or "the file"
        found = "" if first["type"] == "missing" else f" is {printable(repr(first['input']))[:80]};"
        raise RunError(
            f"{printable(path)}: a field is missing, of another type or out of bounds: {where}{found}"
            f" {'it is needed' if first['type'] == 'missing' else rule_of(first)[:200]}"
        ) from None
    return {key: data[key] for key in model.model_fields if key in data}


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a regular file of the folder, no link; `RunError` names the file when it
    is none."""
    if what := in_the_way(path):
        raise RunError(what)
    try:
        data = json.loads(read_file(path, MAX_BYTES).decode("utf-8"))
    except FileError as error:
        raise RunError(str(error)) from None
    except (ValueError, RecursionError) as error:
        what = printable(error)[:200] or type(error).__name__
        raise RunError(f"{printable(path)}: cannot be read ({what})") from None
    if not isinstance(data, dict):
        raise RunError(f"{printable(path)}: must hold a JSON object, not a {type(data).__name__}")
    return data


def _check_words(data: Any, path: Path) -> None:
    """Refuse what no terminal and no table should meet: control characters, endless words, NaN,
    numbers beyond 64 bits."""
    left = [data]
    while left:
        value = left.pop()
        if isinstance(value, dict):
            left += [*value.keys(), *value.values()]
        elif isinstance(value, list):
            left += value
        elif isinstance(value, str):
            if len(value) > MAX_WORD or not value.isprintable():
                raise RunError(
                    f"{printable(path)}: holds {printable(value)[:60]!r}; at most {MAX_WORD} printable characters are allowed"
                )
        elif isinstance(value, (int, float)) and not (
            math.isfinite(value) and abs(value) < 1 << 64
        ):
            raise RunError(
                f"{printable(path)}: a field is missing, of another type or no number ({str(value)[:40]})"
            )


def printable_words(command: Any) -> Any:
    """A command line as it may be stored."""
    return (
        [printable(c)[:MAX_WORD] for c in command]
        if isinstance(command, (list, tuple))
        else command
    )


def bounded(header: Mapping[str, Any], path: Path) -> None:
    """Refuse a plan of more shards than their numbers have digits for."""
    planned, size = sum(header["trials"].values()), header["shard_trials"]
    if planned > MAX_SHARDS * size:
        raise RunError(
            f"{printable(path)}: {planned} trials in shards of {size} are more than {MAX_SHARDS} shards;"
            f" larger shards are needed (--shard-trials, up to {MAX_SHARD_TRIALS})"
        )


FORMAT = 3
"""Version of the run folder: of the JSON files' fields and of the schemas."""

SCHEMAS = {
    "trials": TRIAL_SCHEMA,
    "details": DETAIL_SCHEMA,
    "poses": POSE_SCHEMA,
    "paths": PATH_SCHEMA,
    "failures": FAILURE_SCHEMA,
}

SHARD_TRIALS = 100_000
"""Largest shard unless the user says otherwise."""

IDENTITY = (
    "format",
    "protocol",
    "trials",
    "configuration",
    "digests",
    "seed",
    "device",
    "versions",
    "stored",
)
"""Fields of run.json that must agree for two sweeps to share a folder; of `device` only its kind
(cpu, cuda)."""


def run_hash(header: Mapping[str, Any]) -> str:
    """sha256 (hex) over what decides the rows: the identity of a run and its shard size."""
    data: dict[str, Any] = {k: header.get(k) for k in IDENTITY}
    for key in ("predictors", "hands"):  # folders from before there were any keep their hash
        if key in header:
            data[key] = header[key]
    data["device"] = (header.get("device") or {}).get("kind")
    data["shard_trials"] = header["shard_trials"]
    return hashlib.sha256(json.dumps(data, sort_keys=True, allow_nan=False).encode()).hexdigest()


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names of the identity's fields in which two headers differ, and of what differs in them."""

    def value(header: Mapping[str, Any], key: str) -> Any:
        return (header.get(key) or {}).get("kind") if key == "device" else header.get(key)

    names = []
    for key in (*IDENTITY, "predictors"):
        mine, other = value(old, key), value(new, key)
        if mine != other:
            parts = isinstance(mine, Mapping) and isinstance(other, Mapping)
            inner = (
                sorted(k for k in {**mine, **other} if mine.get(k) != other.get(k)) if parts else []
            )
            names.append(f"{key} ({', '.join(inner)})" if inner else key)
    return names


def read_header(folder: Path) -> dict[str, Any]:
    """run.json of a folder, checked to be of this format and unchanged, in a folder that holds its
    own files."""
    path = folder / "run.json"
    if not os.path.lexists(path):
        raise RunError(f"{printable(folder)}: no run.json, so it is not a run folder")
    data = read_json(path)
    if data.get("format") != FORMAT:
        raise RunError(
            f"{path}: format {printable(data.get('format'))!r:.40}; this version reads format {FORMAT}"
        )
    header = checked_header(data, path)
    if header["hash"] != run_hash(header):
        raise RunError(
            f"{path}: its fields do not agree with its own hash; restore it, or sweep into another --out"
        )
    _refuse_links(folder)
    return header


def checked_header(data: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The fields of a run.json, to be read or written, within their bounds; else `RunError`."""
    header = checked(Header, dict(data), path)
    bounded(header, path)
    return header


def _refuse_links(folder: Path) -> None:
    """A link inside a run folder would have files elsewhere read, renamed and written."""
    for kind in (*SCHEMAS, "manifest", "methods", "quarantine", ".claims"):
        inside = [folder / kind]
        if kind != ".claims" and inside[0].is_dir() and not inside[0].is_symlink():
            inside += [Path(entry.path) for entry in os.scandir(inside[0]) if entry.is_symlink()]
        for path in inside:
            if path.is_symlink():
                raise RunError(
                    f"{printable(path)}: a symbolic link; a run folder holds its own files"
                )


@dataclass(frozen=True)
class Shard:
    """A fixed range of the plan: positions `first` to `last` - 1, number `index`."""

    index: int
    first: int
    last: int

    @property
    def name(self) -> str:
        """Its number as it stands in file names."""
        return f"{self.index:06d}"


def shards_of(header: Mapping[str, Any]) -> list[Shard]:
    """All shards of a plan, in order: the same for every process that reads the same run.json."""
    planned, size = sum(header["trials"].values()), header["shard_trials"]
    return [
        Shard(i, first, min(first + size, planned))
        for i, first in enumerate(range(0, planned, size))
    ]


def planned_in(header: Mapping[str, Any], shard: Shard) -> dict[str, int]:
    """Trials of each split in a shard; the plan goes through the splits one after the other."""
    counts, start = {}, 0
    for split, n in header["trials"].items():
        overlap = min(shard.last, start + n) - max(shard.first, start)
        if overlap > 0:
            counts[split] = overlap
        start += n
    return counts


def read_methods(folder: Path) -> list[dict[str, Any]]:
    """Entries of the methods in the order in which they were added; `slug` is their part of the
    file names."""
    entries = []
    for path in sorted((folder / "methods").glob("[!.]*.json")):
        if not SLUG.fullmatch(path.stem):
            raise RunError(
                f"{printable(path)}: foreign, no method's file has such a name; take it away"
            )
        entries.append({**checked(Method, read_json(path), path), "slug": path.stem})
    names = [e["name"] for e in entries]
    if len(set(names)) != len(names):
        raise RunError(
            f"{folder / 'methods'}: two files name the method {max(names, key=names.count)!r}; take one away"
        )
    return sorted(entries, key=lambda e: (e["order"], e["name"]))


def stored_in(folder: Path, header: Mapping[str, Any], slug: str) -> list[Shard]:
    """Shards of a method that have a receipt, in order: what is read grows with what is stored, not
    with the plan."""
    try:
        found = {
            name[:6] for name in os.listdir(folder / "manifest" / slug) if _RECEIPT.fullmatch(name)
        }
    except FileNotFoundError:
        return []
    except OSError as error:
        for place in (folder / "manifest", folder / "manifest" / slug):
            if what := in_the_way(place, folder=True):
                raise RunError(what) from None
        raise RunError(
            f"{folder / 'manifest' / slug}: cannot be read ({error.strerror or error})"
        ) from None
    shards = (shard_at(header, int(number)) for number in sorted(found))
    return [s for s in shards if s is not None]


_RECEIPT = re.compile(r"[0-9]{6}\.json", re.ASCII)


def shard_at(header: Mapping[str, Any], index: int) -> Shard | None:
    """The shard of a number; None beyond the plan."""
    planned, size = sum(header["trials"].values()), header["shard_trials"]
    return (
        Shard(index, index * size, min((index + 1) * size, planned))
        if index * size < planned
        else None
    )


def receipt_path(folder: Path, slug: str, shard: Shard) -> Path:
    return folder / "manifest" / slug / f"{shard.name}.json"


def quarantine_path(folder: Path, slug: str, shard: Shard) -> Path:
    return folder / "quarantine" / slug / f"{shard.name}.json"


def read_receipt(
    folder: Path, header: Mapping[str, Any], entry: Mapping[str, Any], shard: Shard
) -> dict[str, Any]:
    """A shard's receipt, checked against run and method; `RunError` where it belongs to neither."""
    path = receipt_path(folder, entry["slug"], shard)
    receipt = checked(Receipt, read_json(path), path)
    expected = {
        "run": header["hash"],
        "method": entry["name"],
        "first": shard.first,
        "last": shard.last,
    }
    for key, value in expected.items():
        if receipt[key] != value:
            raise RunError(f"{path}: foreign, its {key} is {receipt[key]!r} and not {value!r}")
    counts = {s: sum(c.values()) for s, c in receipt["outcomes"].items()}
    if counts != planned_in(header, shard):
        raise RunError(f"{path}: holds {counts} trials, planned were {planned_in(header, shard)}")
    kinds = {"trials", *header["stored"]}
    if set(receipt["files"]) - {"failures"} != kinds:
        raise RunError(
            f"{path}: names files of {sorted(receipt['files'])}, stored are {sorted(kinds)}"
        )
    for kind, file in receipt["files"].items():
        own = f"{kind}/{entry['slug']}/{shard.name}-{file['sha256'][:16]}.parquet"
        if file["path"] != own:
            raise RunError(
                f"{path}: names the file {file['path'][:200]!r}; the only one it may name is {own}"
            )
    return receipt


def problems(
    folder: Path, header: Mapping[str, Any]
) -> Iterator[tuple[str, Shard | None, Path, str]]:
    """(method, shard, file, what is wrong) of everything stored that cannot be trusted; shard None:
    in no receipt."""
    for entry in read_methods(folder):
        known: set[Path] = set()
        for shard in stored_in(folder, header, entry["slug"]):
            for file, what in checked_shard(folder, header, entry, shard):
                known.add(file)
                if what is not None:
                    yield entry["name"], shard, file, what
        for kind in SCHEMAS:
            for file in sorted((folder / kind / entry["slug"]).glob("[!.]*.parquet")):
                if file not in known:
                    yield entry["name"], None, file, "foreign: no receipt names it"


def checked_shard(
    folder: Path, header: Mapping[str, Any], entry: Mapping[str, Any], shard: Shard
) -> Iterator[tuple[Path, str | None]]:
    """Each file that the receipt of a stored shard names, or the receipt itself, and what is wrong
    with it (None: nothing)."""
    path = receipt_path(folder, entry["slug"], shard)
    try:
        files = read_receipt(folder, header, entry, shard)["files"]
    except RunError as error:
        yield path, str(error).removeprefix(f"{path}: ")
        return
    for stored in files.values():
        file = folder / stored["path"]
        kind = file.parent.parent.name
        yield (
            file,
            _damage(file, stored) or stored_wrong(header, shard.first, shard.last, kind, file),
        )


def _damage(file: Path, stored: Mapping[str, Any]) -> str | None:
    try:
        found = file.lstat()
    except OSError:
        return "missing"
    if not stat.S_ISREG(found.st_mode):
        return "no regular file"
    if (size := found.st_size) != stored["bytes"]:
        return f"{'truncated' if size < stored['bytes'] else 'too long'}: {size} bytes, written were {stored['bytes']}"
    return None if sha256_of(file) == stored["sha256"] else "flipped bits: differs from its sha256"


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
    folder = path_of("folder", folder)
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
