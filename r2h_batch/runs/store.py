"""The run folder: what a sweep writes and every other command reads.

    run.json                           the run: protocol, digests, configuration, versions
    ids.csv                            what the owner of listed trials calls them: trial_id, id, variant
    imported-SHA/                      trials that were read from somebody's files, as a benchmark
    methods/METHOD.json                a method, and where its answers come from
    manifest/METHOD/000017.json        the receipt of a shard: range, outcomes, files, sha256
    trials/METHOD/000017-SHA.parquet   its rows; details/, poses/, paths/ beside it if stored
    failures/METHOD/000017-SHA.parquet the trials whose simulation failed
    quarantine/METHOD/000017.json      a shard that failed three times, and its errors

A shard is stored when its receipt exists. Every file appears whole or not at all: a temporary
name, fsync, a hard link (the first writer wins), fsync of the folder. No stored file changes, so
any number of processes can share a folder. A folder may come from anybody: each JSON file has a
size limit and goes through a model with bounds before a field is used.
"""

import csv
import difflib
import errno
import fcntl
import hashlib
import itertools
import json
import os
import re
import shlex
import socket
import stat
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, NamedTuple
from uuid import uuid4

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, create_model

from r2h_batch.base.command_line import nearest
from r2h_batch.base.io.read import FileError, kind_of, open_file, printable, read_file
from r2h_batch.base.io.read import read_json as read_any_json
from r2h_batch.base.io.tables import check_decoded_size
from r2h_batch.base.io.write import atomic_path, csv_cell, packed_json, run_folder_of
from r2h_batch.base.registry import PROTOCOL_NAMES
from r2h_batch.base.schedule import trial_ids
from r2h_batch.base.validate import boolean, check_arguments, rule_of, sequence_of, text
from r2h_batch.base.validate import path as path_of
from r2h_batch.runs.rows import (
    DETAIL_SCHEMA,
    EPISODE_SCHEMA,
    FAILURE_SCHEMA,
    LATER_COLUMNS,
    OUTCOME_NAMES,
    PATH_SCHEMA,
    POSE_SCHEMA,
    TRIAL_SCHEMA,
    of_joints,
)

FORMAT = 3
"""Version of the folder: fields of its JSON files and schemas of its tables."""

SCHEMAS = {
    "trials": TRIAL_SCHEMA,
    "details": DETAIL_SCHEMA,
    "poses": POSE_SCHEMA,
    "paths": PATH_SCHEMA,
    "failures": FAILURE_SCHEMA,
    "episodes": EPISODE_SCHEMA,
}
"""Kind of table (and folder) -> its columns, for an arm of six joints."""

IDENTITY = (
    *("format", "protocol", "trials", "configuration", "digests"),
    *("seed", "device", "versions", "stored"),
)
"""Fields of run.json that two sweeps must share to use one folder; of `device` only the kind."""

TIMING = ("t_plan_s", "t_method_s")
"""Columns of the trials that depend on the machine: no digest covers them. They hold one value a
chunk, so a dictionary stores them in less than a bit a trial."""

SHARD_TRIALS = 100_000
"""Trials of a shard unless the user sets another number."""
TRIES = 3
"""A shard is quarantined after this many deaths or errors."""

MAX_JSON_BYTES = 32 << 20  # a run.json with 100,000 objects fits
MAX_LABELS_BYTES = 256 << 20
LABELS = "ids.csv"
FOREIGN = "r2handoversim"
"""Protocol of runs that hold somebody else's verdicts (`import results`): without margins."""
IMPORTED = "imported-"
"""Begins the name of a folder that holds the trials of a sweep in our form."""
MAX_TEXT = 4096
MAX_SHARDS = 10**6  # file names have six digits for them
MAX_SHARD_TRIALS = 10**7  # a shard is in memory as a whole: some GB
MAX_WORDS = 100_000  # different words in one column of a shard

OTHER_OUT = "choose another --out"
GO_ON = "shards that were complete are stored, run the same command to go on"


class RunError(ValueError):
    """A run folder cannot be written or read: the message names the file and what to do."""


# Files: whole or not at all.


def sha256_of(path: Path) -> str:
    """sha256 (hex) of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def temporary_name(path: Path) -> Path:
    """A unique hidden name beside `path` that no reader takes for a finished file."""
    return path.with_name(f".{path.name}.{uuid4().hex}.tmp")


def sync_file(path: Path) -> None:
    """Put a file's bytes on the disk; a full disk or quota raises here at the latest."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def link_once(temporary: Path, final: Path) -> bool:
    """Give a finished temporary file its name; False if the name is taken."""
    try:
        os.link(temporary, final)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
            words = "this file system has no hard links; put the run folder on one that has"
            raise OSError(error.errno, words, str(final)) from error
        raise
    folder = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return True


def write_json_once(path: Path, data: Mapping[str, Any]) -> bool:
    """Write a JSON file unless it exists; False if it does."""
    return bool(_write_json(path, data, link_once))


def replace_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write or replace a JSON file; a reader sees the old or the new one."""
    _write_json(path, data, os.replace)


def _write_json(
    path: Path, data: Mapping[str, Any], give_name: Callable[[Path, Path], bool | None]
) -> bool | None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        with temporary.open("w", encoding="utf-8") as file:
            file.write(packed_json(data) + "\n")
            file.flush()
            os.fsync(file.fileno())
        return give_name(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _drop_second_names(folder: Path) -> None:
    """Remove temporary names of finished files: their writer was killed between the two names."""
    for temporary in folder.glob(".*.tmp") if folder.is_dir() else ():
        try:
            if temporary.lstat().st_nlink > 1:
                temporary.unlink()
        except OSError:  # its writer lives and was faster, or the folder is read-only
            continue


def _open_own(path: Path, flags: int) -> int:
    """A descriptor of a plain file of the folder, created if missing; links and pipes raise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    flags |= os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        return os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO):
            raise
        words = "no plain file but a link or a pipe; take it away"
        raise OSError(error.errno, words, str(path)) from None


_claims: set[BinaryIO] = set()  # open files of this process that may hold a lock


# A fork shares its parent's locks, and would hold them after the parent's death.
os.register_at_fork(after_in_child=lambda: [_claims.pop().close() for _ in list(_claims)])


@contextmanager
def claim(path: Path) -> Iterator[bool]:
    """Whether this process alone holds `path`, until the block ends or the process dies.

    A claim saves double work; `link_once` decides who wins. So a file system without locks says
    yes to every process.
    """
    with open(_open_own(path, os.O_RDWR), "r+b", buffering=0) as lock:
        _claims.add(lock)
        try:
            own = True
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                own = error.errno in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)
                if not own and not isinstance(error, BlockingIOError):
                    raise
            if own:
                with suppress(OSError):  # a full disk, or a pipe: only the name is missing
                    os.ftruncate(lock.fileno(), 0)
                    lock.write(f"process {os.getpid()} on {socket.gethostname()}".encode())
            yield own
        finally:
            _claims.discard(lock)


def in_the_way(path: Path, *, folder: bool = False) -> str:
    """What stands in the place of a file (or folder) of the run; empty if nothing is wrong."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return ""
    if (stat.S_ISDIR if folder else stat.S_ISREG)(mode):
        return ""
    what = f"is {kind_of(mode)}, where the run has a {'folder' if folder else 'file'} of its own"
    return f"{printable(path)} {what}; move it away and run the same command again"


def trouble_in(folder: Path, error: OSError) -> str:
    """One line about an error while the folder was written: the file and what to do; or empty."""
    names = [
        n for n in (error.filename2, error.filename) if isinstance(n, (str, bytes, os.PathLike))
    ]
    for place in (Path(os.path.abspath(os.fsdecode(name))) for name in names):
        if not place.is_relative_to(folder):
            continue
        place = place.with_name(re.sub(r"^\.(.+)\.[0-9a-f]{32}\.tmp$", r"\1", place.name))
        inside = place.relative_to(folder)
        for k in range(1, len(inside.parts) + 1):
            is_folder = k < len(inside.parts) or error.errno in (errno.EEXIST, errno.ENOTDIR)
            if what := in_the_way(folder.joinpath(*inside.parts[:k]), folder=is_folder):
                return f"run folder {printable(folder)}: {what}"
        why = error.strerror or error
        return f"run folder {printable(folder)}: {printable(inside)}: {why}; {GO_ON}"
    return ""


# What the JSON files may say.

_ABSENT: Any = None  # a field may be absent, but a written one is not null

Count = Annotated[int, Field(ge=0, le=10**12)]
Split = Literal["S0", "S1"]
Kind = Literal["trials", "details", "poses", "paths", "failures", "episodes"]
OutcomeName = Literal[OUTCOME_NAMES]  # type: ignore[valid-type]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Metres = Annotated[float, Field(ge=0, le=1e3)]
Angle = Annotated[float, Field(ge=-6.2832, le=6.2832)]
Rate = Annotated[float, Field(ge=1e-3, le=1e3)]
Step = Annotated[float, Field(gt=0, le=1e3)]


class _Record(BaseModel):
    """Fields that the package reads; other fields are dropped."""

    model_config = ConfigDict(strict=True, extra="ignore")


class _Open(BaseModel):
    """A record with more fields than the package reads."""

    model_config = ConfigDict(strict=True, extra="allow")
    __pydantic_extra__: dict[str, JsonValue]


class _Versions(_Open):
    __pydantic_extra__: dict[str, Text]  # type: ignore[assignment]
    r2h_batch: Text


class _Object(_Open):
    name: Name
    split: Split
    built_in: bool
    digest: Hash = _ABSENT


def _record(base: type[BaseModel] = _Open, **fields: Any) -> Any:
    """A record with these fields: types, or (type, value where it is absent)."""
    typed: dict[str, Any] = {k: v if isinstance(v, tuple) else (v, ...) for k, v in fields.items()}
    return create_model("Record", __base__=base, **typed)


_Configuration = _record(
    # a run that no sweep made may lack parts; who needs one checks for it
    name=(Text, ""),
    workplace=(
        _record(home_q=Annotated[list[Angle], Field(min_length=6, max_length=12)]),
        _ABSENT,
    ),
    thresholds=(
        _record(reach_radius_m=Metres, w_max_m=Metres, safe_margin_m=Metres),
        _ABSENT,
    ),
    plan=(_record(object_collision=Literal["hull", "pieces"]), _ABSENT),
    execute=(
        _record(scale=Rate, max_velocity_rad_s=Rate, max_acceleration_rad_s2=Rate),
        _ABSENT,
    ),
)
_Motion = _record(
    engine=Text, model=(Text | None, None), step_s=(Step | None, None), sample_s=(Step | None, None)
)
_Misses = Annotated[list[Annotated[int, Field(ge=0, le=10**9)]], Field(min_length=2, max_length=2)]
_Robot = _record(name=Name, digest=Hash, ik_missed=(_Misses, _ABSENT))
Header = _record(
    _Record,
    format=int,
    hash=Hash,
    protocol=Text,
    trials=Annotated[dict[Split, Count], Field(min_length=1)],
    configuration=_Configuration,
    digests=_record(trials=Text),
    seed=Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)],
    device=_record(kind=Text, name=Text),
    versions=_Versions,
    stored=list[Kind],
    shard_trials=Annotated[int, Field(ge=1, le=MAX_SHARD_TRIALS)],
    predictors=(_record(noise_factor=Annotated[float, Field(ge=0, le=1e12)]), _ABSENT),
    motion=(_Motion, _ABSENT),
    objects=(list[_Object], _ABSENT),
    benchmark=(_record(flags=Annotated[list[Text], Field(max_length=100)]), _ABSENT),
    robot=(_Robot, _ABSENT),
    hands=(list[JsonValue], _ABSENT),  # sides of the hand set in order, as (side, number of hands)
    platform=(Text, ""),
    git_commit=(Text | None, None),
    command=(list[Text], []),
    created=(Text, ""),
)
"""run.json."""


class Method(_Record):
    """methods/METHOD.json."""

    name: Name
    source: dict[Text, Text]
    command: list[Text]
    order: Annotated[int, Field(ge=0, le=10**6)]


class _File(_Record):
    path: Text
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
    seconds: Annotated[float, Field(ge=0, le=1e12)] = 0.0
    host: Text = ""
    written: Text = ""


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a regular file of the folder, which is no link.

    Raises:
        RunError: the file holds something else or is too large.
    """
    if what := in_the_way(path):
        raise RunError(what)
    try:
        data = read_any_json(path, most=MAX_JSON_BYTES)
    except FileError as error:
        raise RunError(str(error)) from None
    if not isinstance(data, dict):
        raise RunError(f"{printable(path)}: must hold a JSON object, not a {type(data).__name__}")
    return data


def _checked(model: type[_Record], data: Any, path: Path) -> dict[str, Any]:
    """The fields that the model names, unchanged; `RunError` names file, field, value and rule."""
    where = printable(path)
    left = [data]
    while left:  # no control characters, endless texts, NaN or numbers beyond 64 bits
        value = left.pop()
        if isinstance(value, dict):
            left += [*value.keys(), *value.values()]
        elif isinstance(value, list):
            left += value
        elif isinstance(value, str):
            if len(value) > MAX_TEXT or not value.isprintable():
                words = f"at most {MAX_TEXT} printable characters are allowed"
                raise RunError(f"{where}: holds {printable(value)[:60]!r}; {words}")
        elif isinstance(value, (int, float)) and not abs(value) < 1 << 64:  # NaN is not
            words = "a field is missing, of another type or no number"
            raise RunError(f"{where}: {words} ({str(value)[:40]})")
    try:
        model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        missing = first["type"] == "missing"
        field = ".".join(printable(p)[:60] for p in first["loc"]) or "the file"
        found = "" if missing else f" is {printable(repr(first['input']))[:80]};"
        raise RunError(
            f"{where}: a field is missing, of another type or out of bounds: {field}{found}"
            f" {'it is needed' if missing else rule_of(first)[:200]}"
        ) from None
    return {key: data[key] for key in model.model_fields if key in data}


# run.json, methods, shards and receipts.


def _identity(header: Mapping[str, Any]) -> dict[str, Any]:
    """What decides the rows of a run; older folders have no `predictors` or no `hands`."""
    found = {k: header.get(k) for k in IDENTITY}
    found |= {k: header[k] for k in ("predictors", "hands") if k in header}
    return {**found, "device": (header.get("device") or {}).get("kind")}


def run_hash(header: Mapping[str, Any]) -> str:
    """sha256 (hex) over what decides the rows, and the shard size."""
    data = {**_identity(header), "shard_trials": header["shard_trials"]}
    return hashlib.sha256(json.dumps(data, sort_keys=True, allow_nan=False).encode()).hexdigest()


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names of the identity's fields in which two headers differ, with the parts that differ."""
    a, b, names = _identity(old), _identity(new), []
    for key in (*IDENTITY, "predictors"):
        x, y = a.get(key), b.get(key)
        if x != y:
            inner: list[str] = []
            if isinstance(x, Mapping) and isinstance(y, Mapping):
                inner = sorted(k for k in {**x, **y} if x.get(k) != y.get(k))
            names.append(f"{key} ({', '.join(inner)})" if inner else key)
    return names


def _check_header(data: Mapping[str, Any], path: Path) -> dict[str, Any]:
    header = _checked(Header, dict(data), path)
    planned, size = sum(header["trials"].values()), header["shard_trials"]
    if planned > MAX_SHARDS * size:
        raise RunError(
            f"{printable(path)}: {planned} trials in shards of {size} are more than {MAX_SHARDS}"
            f" shards; larger shards are needed (--shard-trials, up to {MAX_SHARD_TRIALS})"
        )
    return header


MOST_NEAR = 1000
"""Entries of a folder among which a misspelt run is looked for."""


def _near(folder: Path) -> str:
    """The run that a path that is none may mean: the newest one inside it, or one of nearly its
    name beside it; empty where there is none."""
    runs: list[list[Path]] = []
    for place in (folder, folder.parent):
        names: list[str] = []
        with suppress(OSError):
            names = [e.name for e in itertools.islice(os.scandir(place), MOST_NEAR)]
        runs.append([place / n for n in names if (place / n / "run.json").is_file()])
    inside, beside = runs
    if inside:
        return str(max(inside, key=lambda p: (p / "run.json").stat().st_mtime))
    close = difflib.get_close_matches(folder.name, [p.name for p in beside], n=1)
    return str(folder.parent / close[0]) if close else ""


def read_header(folder: Path) -> dict[str, Any]:
    """run.json: of this format, with its own hash, in a folder without links."""
    path = folder / "run.json"
    if not os.path.lexists(path):
        near = f"; did you mean {printable(found)}?" if (found := _near(folder)) else ""
        raise RunError(f"{printable(folder)}: no run.json, so it is not a run folder{near}")
    data = read_json(path)
    if data.get("format") != FORMAT:
        shown = f"{printable(data.get('format'))!r:.40}"
        raise RunError(f"{path}: format {shown}; this version reads format {FORMAT}")
    header = _check_header(data, path)
    if header["hash"] != run_hash(header):
        words = "restore it, or sweep into another --out"
        raise RunError(f"{path}: its fields do not agree with its own hash; {words}")
    for kind in (*SCHEMAS, "manifest", "methods", "quarantine", ".claims"):
        inside = [folder / kind]  # through a link, files elsewhere would be read and renamed
        if kind != ".claims" and inside[0].is_dir() and not inside[0].is_symlink():
            inside += [Path(entry.path) for entry in os.scandir(inside[0])]
        for place in inside:
            if place.is_symlink():
                words = "a symbolic link; a run folder holds its own files"
                raise RunError(f"{printable(place)}: {words}")
    return header


@dataclass(frozen=True)
class Shard:
    """Positions `first` to `last` - 1 of the trial list, number `index`."""

    index: int
    first: int
    last: int

    @property
    def name(self) -> str:
        """The number in file names."""
        return f"{self.index:06d}"


def shards_of(header: Mapping[str, Any]) -> list[Shard]:
    """All shards in order: the same for every process that reads the same run.json."""
    return [shard for i in range(shard_count(header)) if (shard := shard_at(header, i))]


def shard_count(header: Mapping[str, Any]) -> int:
    """Number of shards of a method."""
    return int(-(-sum(header["trials"].values()) // header["shard_trials"]))


def shard_at(header: Mapping[str, Any], index: int) -> Shard | None:
    """The shard of a number; None outside the trial list."""
    planned, size = sum(header["trials"].values()), header["shard_trials"]
    first = index * size
    return Shard(index, first, min(first + size, planned)) if 0 <= first < planned else None


def planned_in(header: Mapping[str, Any], shard: Shard) -> dict[str, int]:
    """Split -> trials of it in a shard; the trial list has one split after the other."""
    counts, start = {}, 0
    for split, n in header["trials"].items():
        if (overlap := min(shard.last, start + n) - max(shard.first, start)) > 0:
            counts[split] = overlap
        start += n
    return counts


_SLUG = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,79}")


@dataclass(frozen=True)
class Entry:
    """A method of a run folder.

    Attributes:
        folder: the run folder.
        header: its run.json.
        slug: the method's part of file names.
        name: the method's name. In a joined run its robot or run may stand in front.
        source: where its answers come from.
        command: the command line that added it.
        order: its place among the methods.
        receipts: number of a stored shard -> its receipt; `load_run` reads them.
    """

    folder: Path
    header: dict[str, Any]
    slug: str
    name: str
    source: dict[str, str]
    command: list[str]
    order: int
    receipts: dict[int, dict[str, Any]] = field(default_factory=dict)

    def receipt_path(self, shard: Shard) -> Path:
        """The receipt of a shard."""
        return self.folder / "manifest" / self.slug / f"{shard.name}.json"

    def quarantine_path(self, shard: Shard) -> Path:
        """The note about a shard that failed for good."""
        return self.folder / "quarantine" / self.slug / f"{shard.name}.json"

    def claim_path(self, number: int) -> Path:
        """The file that a process locks while it works on a shard."""
        return self.folder / ".claims" / f"{self.slug}-{number:06d}"

    def stored_shards(self) -> list[Shard]:
        """Shards that have a receipt, in order."""
        place = self.folder / "manifest" / self.slug
        try:
            names = [n for n in os.listdir(place) if re.fullmatch(r"[0-9]{6}\.json", n, re.ASCII)]
        except FileNotFoundError:
            return []
        except OSError as error:
            words = f"{place}: cannot be read ({error.strerror or error})"
            whats = (in_the_way(p, folder=True) for p in (place.parent, place))
            raise RunError(next(filter(None, whats), words)) from None
        found = (shard_at(self.header, int(n[:6])) for n in sorted(names))
        return [shard for shard in found if shard is not None]

    @property
    def complete(self) -> bool:
        """Whether every shard is stored; run.json may claim a million, so none is listed."""
        return len(self.receipts) == shard_count(self.header)

    def read_receipt(self, shard: Shard) -> dict[str, Any]:
        """A shard's receipt; `RunError` if it belongs to another run, method or shard."""
        path = self.receipt_path(shard)
        receipt = _checked(Receipt, read_json(path), path)
        expected = {"run": self.header["hash"], "method": self.name}
        for key, value in {**expected, "first": shard.first, "last": shard.last}.items():
            if receipt[key] != value:
                raise RunError(f"{path}: foreign, its {key} is {receipt[key]!r} and not {value!r}")
        counts = {s: sum(c.values()) for s, c in receipt["outcomes"].items()}
        if counts != (planned := planned_in(self.header, shard)):
            raise RunError(f"{path}: holds {counts} trials, planned were {planned}")
        found, kinds = sorted(receipt["files"]), {"trials", *self.header["stored"]}
        if set(found) - {"failures"} != kinds:
            raise RunError(f"{path}: names files of {found}, stored are {sorted(kinds)}")
        for kind, file in receipt["files"].items():
            own = f"{kind}/{self.slug}/{shard.name}-{file['sha256'][:16]}.parquet"
            if file["path"] != own:
                named = f"names the file {file['path'][:200]!r}"
                raise RunError(f"{path}: {named}; the only one it may name is {own}")
        return receipt

    def files(self) -> dict[int, list[Path]]:
        """Number of a shard -> the table files of it; -1: files without a number."""
        found: dict[int, list[Path]] = {}
        for kind in SCHEMAS:
            for file in sorted((self.folder / kind / self.slug).glob("[!.]*.parquet")):
                numbered = re.match(r"[0-9]{6}(-|$)", file.stem, re.ASCII)
                found.setdefault(int(file.stem[:6]) if numbered else -1, []).append(file)
        return found

    def table(self, kind: str, receipt: Mapping[str, Any], columns: Sequence[str]) -> pa.Table:
        """Those columns that a stored file has; `RunError` if the file is not as its schema says."""
        path = self.folder / receipt["files"][kind]["path"]
        trials = receipt["last"] - receipt["first"]
        try:
            with pq.ParquetFile(path) as file:
                rows, names = file.metadata.num_rows, file.schema_arrow.names
                if rows > trials or (kind == "trials" and rows != trials):
                    raise RunError(f"{path}: holds {rows} rows, its receipt says {trials} trials")
                if lacking := set(columns) - set(names) - set(LATER_COLUMNS):
                    words = f"column {min(lacking)!r} is missing; format {FORMAT} has it"
                    raise RunError(f"{path}: {words}")
                there = [c for c in columns if c in names]
                most = (16 << 20) + (1 << 17 if kind == "paths" else 1 << 13) * trials  # of memory
                check_decoded_size(file, most, str(path), there)
                table = file.read(columns=there)
        except FileError as error:
            raise RunError(str(error)) from None
        except (OSError, pa.ArrowException) as error:
            raise RunError(f"{path}: cannot be read ({printable(error)[:300]})") from error
        for name in there:
            if what := _wrong_column(table[name], schema_of(self.header, kind).field(name)):
                raise RunError(f"{path}: column {name!r} {what}")
        return table.select(there)


def _wrong_column(column: pa.ChunkedArray, field: pa.Field) -> str:
    if column.type != field.type:
        return f"is of another type than format {FORMAT} says"
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
            if field.name == "outcome" and (odd := set(words) - set(OUTCOME_NAMES)):
                return f"holds {min(odd)!r}; known are {', '.join(OUTCOME_NAMES)}"
    return ""


def schema_of(header: Mapping[str, Any], kind: str) -> pa.Schema:
    """The columns of a kind of table in this run, whose postures are as long as its home posture."""
    home = header["configuration"].get("workplace", {}).get("home_q")
    return SCHEMAS[kind] if home is None else of_joints(SCHEMAS[kind], len(home))


def read_methods(folder: Path, header: dict[str, Any]) -> list[Entry]:
    """The methods in the order in which they were added, without receipts."""
    entries = []
    for path in sorted((folder / "methods").glob("[!.]*.json")):
        if not _SLUG.fullmatch(path.stem):
            words = "foreign, no method's file has such a name; take it away"
            raise RunError(f"{printable(path)}: {words}")
        entries.append(Entry(folder, header, path.stem, **_checked(Method, read_json(path), path)))
    names = [e.name for e in entries]
    if len(set(names)) != len(names):
        twice = max(names, key=names.count)
        words = f"two files name the method {twice!r}; take one away"
        raise RunError(f"{folder / 'methods'}: {words}")
    return sorted(entries, key=lambda e: (e.order, e.name))


def write_labels(folder: Path, labels: Mapping[int, tuple[str, str]]) -> None:
    """What the owner of listed trials calls them, as a table in a run folder."""
    with (
        atomic_path(folder / LABELS) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        rows = csv.writer(file)
        rows.writerow(["trial_id", "id", "variant"])
        rows.writerows([i, *map(csv_cell, pair)] for i, pair in labels.items())


# Reading.


@dataclass(frozen=True)
class Run:
    """A stored run, or several as one (`join`).

    Attributes:
        folder: the run folder; of several runs the first one's.
        header: run.json; of several runs the first one's.
        entries: the methods.
        runs: the runs that were joined, or this one.
    """

    folder: Path
    header: dict[str, Any]
    entries: tuple[Entry, ...]
    joined: tuple["Run", ...] = ()

    @property
    def runs(self) -> tuple["Run", ...]:
        """The runs that were joined, or this one."""
        return self.joined or (self,)

    @property
    def robot(self) -> str:
        """The robot's name; runs that name none are older than the choice."""
        return str((self.header.get("robot") or {}).get("name", "ur5e_2f85"))

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the complete methods, in the order in which they were added."""
        return tuple(e.name for e in self.entries if e.complete)

    @property
    def unfinished(self) -> tuple[str, ...]:
        """Names of the methods with shards still to score."""
        return tuple(e.name for e in self.entries if not e.complete)

    @cached_property
    def labels(self) -> dict[int, tuple[str, str]]:
        """Trial id -> what the trial's owner calls it, and the method behind it; empty where trials
        have numbers only."""
        path = self.folder / LABELS
        if not path.exists():
            return {}

        def cell(text: str) -> str:
            return text[1:] if csv_cell(text[1:]) == text else text  # safe for spreadsheets

        with open_file(path, MAX_LABELS_BYTES) as stream:
            rows = csv.DictReader(TextIOWrapper(stream, encoding="utf-8", newline=""), strict=True)
            try:
                return {int(r["trial_id"]): (cell(r["id"]), cell(r["variant"])) for r in rows}
            except (KeyError, TypeError, ValueError, csv.Error):
                words = "needs the columns trial_id, id, variant; run the sweep again to write it"
                raise RunError(f"{path}: {words}") from None

    def trial_id(self, word: str) -> int:
        """The number of a trial from its number or its owner's text."""
        if word.isascii() and word.isdigit():
            return int(word)
        for number, (text_of_owner, _) in self.labels.items():
            if text_of_owner == word:
                return number
        raise RunError(f"{self.folder}: no trial has the id {printable(word)[:80]!r}")

    def entry(self, method: str) -> Entry:
        """The method of this name."""
        text("method", method)
        for entry in self.entries:
            if entry.name == method:
                return entry
        names = ", ".join(e.name for e in self.entries) or "none"
        raise RunError(f"{self.folder}: no method {method!r}; it has {names}")

    def named(self, word: str) -> str:
        """The full name of a method from that name or from the sweep's word (fc)."""
        text("word", word)
        names = [e.name for e in self.entries]
        if word in names:
            return word
        function = f"r2h_batch.methods.{word.replace('-', '_')}:predict"
        found = [e.name for e in self.entries if e.source.get("function") == function]
        if len(found) == 1:
            return found[0]
        if found:
            words = f"{word!r} answered several times: {', '.join(found)}; give one of these names"
            raise RunError(f"{self.folder}: {words}")
        has = ", ".join(names) or "none"
        raise RunError(f"{self.folder}: no method {word!r}{nearest(word, names)}; it has {has}")

    def only(self, words: Sequence[str]) -> "Run":
        """The same run with these methods alone (see `named`), in stored order; empty: all."""
        if not sequence_of(str, "names of methods", least=0)("words", words):
            return self
        names = {self.named(w) for w in words}
        return replace(self, entries=tuple(e for e in self.entries if e.name in names))

    def view_command(self, method: str) -> str:
        """The command that shows trials of a method: `r2h-batch view RUN --method WORD --trial`, with
        the files that the sweep was given."""
        entry = self.entry(method)
        run = next(r for r in self.runs if r.folder == entry.folder)
        name = next(e.name for e in run.entries if e.slug == entry.slug)
        module = entry.source.get("function", "").partition(":")[0]
        word = module.removeprefix("r2h_batch.methods.").replace("_", "-")
        with suppress(RunError):
            name = word if run.named(word) == name else name
        flags = (entry.header.get("benchmark") or {}).get("flags") or []
        own_flags = [f.split() for f in flags if not f.startswith(("--protocol", "--receiver"))]
        words = ["r2h-batch", "view", str(entry.folder), "--method", name]
        return shlex.join([*words, *itertools.chain(*own_flags), "--trial"])

    def planned(self, method: str) -> dict[str, int]:
        """Split -> trials that a method was asked."""
        return dict(self.entry(method).header["trials"])

    def missing(self, method: str) -> list[Shard]:
        """Shards of a method that are planned and not stored."""
        entry = self.entry(method)
        return [s for s in shards_of(entry.header) if s.index not in entry.receipts]

    def quarantined(self, method: str) -> list[Shard]:
        """Missing shards of a method that failed three times in the last attempt."""
        entry = self.entry(method)
        return [s for s in self.missing(method) if entry.quarantine_path(s).exists()]

    def trials(self, method: str, columns: Sequence[str] | None = None) -> pa.Table:
        """One row per trial in planned order: all or some columns of `TRIAL_SCHEMA`."""
        return self._read("trials", method, columns)

    def details(self, method: str) -> pa.Table:
        """Goal, grasp and witness of the scored trials, `DETAIL_SCHEMA`."""
        return self._read("details", method)

    def poses(self, method: str) -> pa.Table:
        """The scored poses, `POSE_SCHEMA`; missing trials have no row."""
        return self._read("poses", method)

    def paths(self, method: str) -> pa.Table:
        """Waypoints and times of the trials with a path, `PATH_SCHEMA`."""
        return self._read("paths", method)

    def episodes(self, method: str) -> pa.Table:
        """How closed loops ended, `EPISODE_SCHEMA`."""
        return self._read("episodes", method)

    def failures(self, method: str) -> pa.Table:
        """What is needed to repeat a failed simulation, `FAILURE_SCHEMA`."""
        return self._read("failures", method)

    def _read(self, kind: str, method: str, columns: Sequence[str] | None = None) -> pa.Table:
        schema = schema_of(self.entry(method).header, kind)
        if columns is not None:
            schema = pa.schema([schema.field(n) for n in columns])
        tables = [schema.empty_table(), *self.shards(kind, method, columns)]
        return pa.concat_tables(tables).unify_dictionaries()

    def shards(
        self, kind: str, method: str, columns: Sequence[str] | None = None
    ) -> Iterator[pa.Table]:
        """The tables of a kind, one shard at a time, for runs that do not fit into memory. Later
        columns that an older run lacks are null."""
        entry, names = self.entry(method), list(columns or SCHEMAS[kind].names)
        for receipt in entry.receipts.values():
            if kind not in receipt["files"]:
                if kind == "failures":  # no simulation of this shard failed
                    continue
                words = f"method {method!r} has no {kind}; sweep again with --save-paths"
                raise RunError(f"{entry.folder}: {words}")
            table = entry.table(kind, receipt, names)
            for name in set(names) - set(table.column_names):
                field = schema_of(entry.header, kind).field(name)
                table = table.append_column(field, pa.nulls(len(table), field.type))
            yield table.select(names)

    def shard(self, kind: str, method: str, index: int) -> pa.Table:
        """The table of a kind of one shard, without later columns that an older run lacks."""
        entry = self.entry(method)
        receipt = entry.receipts.get(index)
        if receipt is None or kind not in receipt["files"]:
            raise RunError(f"{self.folder}: shard {index} of {method!r} has no {kind}")
        return entry.table(kind, receipt, SCHEMAS[kind].names)

    def verify(self) -> None:
        """Raise `RunError` unless every stored file is as it was written."""
        for entry in (e for run in self.runs for e in run.entries):
            for problem in itertools.chain(*(found for _, found in _problems(entry))):
                if problem.shard is not None:
                    command = f"`r2h-batch results verify {entry.folder}`"
                    words = f"{command} marks it, the sweep redoes it"
                    raise RunError(f"{problem.file}: {problem.what}; {words}")

    def digest(self, method: str) -> str:
        """sha256 (hex) over all rows of a method without `TIMING`: equal for any shards and
        workers. Later columns that an older run lacks are not part of its digest."""
        columns = [c for c in TRIAL_SCHEMA.names if c not in TIMING]
        hashes: dict[tuple[str, str], Any] = defaultdict(hashlib.sha256)
        entry = self.entry(method)
        for receipt in entry.receipts.values():
            table = entry.table("trials", receipt, columns)
            for name in table.column_names:
                column = table[name].combine_chunks()
                valid = column.is_valid().to_numpy(zero_copy_only=False)
                hashes[name, "valid"].update(valid.tobytes())
                hashes[name, "value"].update(_plain(column).tobytes())
        return hashlib.sha256(b"".join(h.digest() for h in hashes.values())).hexdigest()


def _plain(column: pa.Array) -> np.ndarray:
    """Values as numbers of fixed size (a word as its hash, null as 0): equal rows, equal bytes."""
    if pa.types.is_dictionary(column.type):
        words = [hashlib.sha256(w.encode()).digest()[:8] for w in column.dictionary.to_pylist()]
        codes = np.frombuffer(b"".join([*words, bytes(8)]), "<u8")
        return codes[column.indices.fill_null(len(words)).to_numpy()]
    return np.asarray(column.fill_null(False if pa.types.is_boolean(column.type) else 0))


def robot_words(runs: Sequence[Run]) -> dict[str, str]:
    """Robot -> what stands before its methods' names: nothing where all have the same robot, else
    `ur5e/`, or the whole name where several start so."""
    names = list(dict.fromkeys(run.robot for run in runs))
    short = [name.partition("_")[0] for name in names]
    words = short if len(set(short)) == len(names) else names
    return {name: f"{word}/" if len(names) > 1 else "" for name, word in zip(names, words)}


def join(runs: Sequence[Run]) -> Run:
    """Several runs as one, for tables and pages.

    A method has its robot's name in front if the runs have several, and its run's name if there is
    another method of that name.

    Raises:
        RunError: two folders of one name hold a method of one name.
    """
    if len(runs) == 1:
        return runs[0]
    robots = robot_words(runs)
    names = Counter(robots[run.robot] + e.name for run in runs for e in run.entries)
    entries: dict[str, Entry] = {}
    for run in runs:
        for entry in run.entries:
            name = robots[run.robot] + entry.name
            if names[name] > 1:
                name = f"{run.folder.absolute().name}/{entry.name}"
            if name in entries:
                raise RunError(f"two run folders of one name hold {name!r}; rename one of them")
            entries[name] = replace(entry, name=name)
    return Run(runs[0].folder, runs[0].header, tuple(entries.values()), tuple(runs))


@check_arguments(verify=boolean)
def load_run(folder: str | Path, *, verify: bool = True) -> Run:
    """Open a stored run.

    Args:
        folder: the run folder.
        verify: compare every file with its sha256 first.

    Returns:
        The run; its tables are read when they are asked for.

    Raises:
        RunError: the folder is no run folder, or a file is not as it was written.
    """
    folder = path_of("folder", folder)
    header = read_header(folder)
    entries = tuple(
        replace(e, receipts={s.index: e.read_receipt(s) for s in e.stored_shards()})
        for e in read_methods(folder, header)
    )
    run = Run(folder, header, entries)
    if verify:
        run.verify()
    return run


# Verifying.


class Problem(NamedTuple):
    """A file that cannot be trusted; `shard` None: no receipt names it."""

    method: str
    shard: Shard | None
    file: Path
    what: str


def problems_of(entry: Entry, number: int, files: Sequence[Path]) -> list[Problem]:
    """What is wrong with one shard: its receipt, what that names, other `files` of its number."""
    found, known, shard = [], set(), shard_at(entry.header, number)
    if shard is not None and os.path.lexists(path := entry.receipt_path(shard)):
        try:
            receipt = entry.read_receipt(shard)
        except RunError as error:
            what = str(error).removeprefix(f"{path}: ")
            found.append(Problem(entry.name, shard, path, what))
        else:
            for kind, stored in receipt["files"].items():
                file = entry.folder / stored["path"]
                known.add(file)
                if what := _damage(file, stored) or _wrong_rows(entry, receipt, kind, file):
                    found.append(Problem(entry.name, shard, file, what))
    foreign = [f for f in files if f not in known]
    return found + [Problem(entry.name, None, f, "foreign: no receipt names it") for f in foreign]


def _problems(entry: Entry) -> Iterator[tuple[int, list[Problem]]]:
    """Each shard of a method that cannot be trusted, by number, and what is wrong with it."""
    files = entry.files()
    for number in sorted({s.index for s in entry.stored_shards()} | set(files)):
        if found := problems_of(entry, number, files.get(number, [])):
            yield number, found


def _damage(file: Path, stored: Mapping[str, Any]) -> str:
    """How a file differs from what its receipt says; empty: it does not."""
    try:
        found = file.lstat()
    except OSError:
        return "missing"
    if not stat.S_ISREG(found.st_mode):
        return "no regular file"
    if (size := found.st_size) != stored["bytes"]:
        what = "truncated" if size < stored["bytes"] else "too long"
        return f"{what}: {size} bytes, written were {stored['bytes']}"
    return "" if sha256_of(file) == stored["sha256"] else "flipped bits: differs from its sha256"


def _wrong_rows(entry: Entry, receipt: Mapping[str, Any], kind: str, file: Path) -> str:
    """What is wrong with the trials of a stored file; empty: nothing.

    sha256 finds damage; this finds rows of other trials that somebody stored with a sha256 to
    match. `results reevaluate` finds a forged verdict.
    """
    try:
        table = entry.table(kind, receipt, ["trial_id"])
    except RunError as error:
        return str(error).removeprefix(f"{file}: ")
    first, last = receipt["first"], receipt["last"]
    exact = last - first
    if kind in ("details", "poses", "episodes"):  # a row of each trial that was answered
        exact -= sum(counts.get("missing", 0) for counts in receipt["outcomes"].values())
    if len(table) > exact or (kind not in ("paths", "failures") and len(table) != exact):
        return f"holds {len(table)} rows, planned were {exact}"
    return _not_as_planned(entry.header, first, last, table, every=kind == "trials")


def _not_as_planned(
    header: Mapping[str, Any], first: int, last: int, table: pa.Table, *, every: bool
) -> str:
    """How rows differ from positions `first` to `last` - 1 of the trial list; empty: they do not.

    Args:
        header: run.json. Nothing is known of runs of other protocols.
        first: first position.
        last: position after the last one.
        table: rows with `trial_id`.
        every: whether every planned trial must have a row.
    """
    if header["protocol"] not in PROTOCOL_NAMES:
        return ""
    planned, ids = trial_ids(header["trials"], first, last), table["trial_id"].to_numpy()
    if len(strange := ids[~np.isin(ids, planned)]):
        return f"trial_id {strange[0]} is not planned here"
    if not np.array_equal(planned[np.isin(planned, ids)], ids):
        return "its trial_id are not in the order of the plan, each once"
    missing = len(planned) - len(ids)
    return f"{missing} planned trials are missing" if every and missing else ""


def mark_for_rerun(folder: Path, header: dict[str, Any]) -> list[str]:
    """Rename everything that cannot be trusted to FILE.bad, so that the sweep scores it again.

    A shard that looks wrong is looked at again under its claim: meanwhile another part of the
    sweep may have stored it.

    Returns:
        One line for each file.
    """
    lines = []
    for entry in read_methods(folder, header):
        for number, _ in _problems(entry):
            with claim(entry.claim_path(number)) as own:
                if own:  # else another sweep is between a file and its receipt
                    found = problems_of(entry, number, entry.files().get(number, []))
                    lines += [_set_aside(entry, problem) for problem in found]
    return lines


def _set_aside(entry: Entry, problem: Problem) -> str:
    again = "set aside"
    if problem.shard is not None:
        receipt = entry.receipt_path(problem.shard)
        if receipt.exists():
            receipt.replace(receipt.with_suffix(".json.bad"))
        again = f"shard {problem.shard.index} of {problem.method!r} will be scored again"
    if problem.file.exists():
        problem.file.replace(problem.file.with_name(f"{problem.file.name}.bad"))
    return f"{printable(problem.file)}: {problem.what}; {again}"


# Writing.


class ShardWriter:
    """Takes a shard's rows in any number of pieces; they are stored when the shard is whole."""

    def __init__(self) -> None:
        self.tables: dict[str, list[pa.Table]] = {kind: [] for kind in SCHEMAS}

    def append(self, **tables: pa.Table) -> None:
        """Add rows of `trials`, `details`, `poses`, `paths` or `failures`."""
        for kind, table in tables.items():
            for column in SCHEMAS[kind]:
                if not column.nullable and (n := table[column.name].null_count):
                    raise ValueError(f"{kind}: column {column.name!r} has {n} empty rows")
            self.tables[kind].append(table)

    def table(self, kind: str, schema: pa.Schema) -> pa.Table:
        """All rows of a kind so far; `schema`: of a run without any."""
        tables = [schema.empty_table(), *self.tables[kind]]
        return pa.concat_tables(tables).unify_dictionaries()


class RunFolder:
    """A run folder that takes shards; `open_run` makes it."""

    def __init__(self, folder: Path, header: dict[str, Any], command: Sequence[str]) -> None:
        self.folder, self.header, self.command = folder, header, _printable_words(command)
        self.entries = {e.name: e for e in read_methods(folder, header)}
        for part in (folder, folder / "methods"):
            _drop_second_names(part)

    def register(self, method: str, source: Mapping[str, Any]) -> None:
        """Add a method; `RunError` if the folder has one of this name from another source."""
        readable = re.sub(r"[^A-Za-z0-9._-]+", "_", method).strip("._")[:60] or "method"
        taken = {e.slug.lower(): e for e in read_methods(self.folder, self.header)}
        for slug in (readable, f"{readable}-{hashlib.sha256(method.encode()).hexdigest()[:8]}"):
            path = self.folder / "methods" / f"{slug}.json"
            new = {"name": method, "source": dict(source), "command": self.command}
            new = _checked(Method, {**new, "order": len(taken)}, path)
            entry = taken.get(slug.lower())
            if entry is None and not write_json_once(path, new):  # another process was faster
                found = read_methods(self.folder, self.header)
                entry = next(e for e in found if e.slug == slug)
            entry = entry or Entry(self.folder, self.header, slug, **new)
            if entry.name == method:
                old = entry.source
                if other := [k for k in {**old, **source} if old.get(k) != source.get(k)]:
                    words = f"already holds {method!r}, made with another {', '.join(other)}"
                    raise RunError(f"{self.folder}: {words}; {OTHER_OUT}")
                self.entries[method] = entry
                return
        raise RunError(f"{self.folder}: no free file name for method {method!r}; {OTHER_OUT}")

    def stored(self, method: str, shard: Shard) -> bool:
        """Whether the shard is complete."""
        return self.entries[method].receipt_path(shard).exists()

    def todo(self, method: str, part: tuple[int, int] = (1, 1)) -> list[Shard]:
        """Shards still to score, of part I of N (every N-th shard)."""
        entry = self.entries[method]
        done = set(entry.stored_shards())
        _drop_second_names(self.folder / "manifest" / entry.slug)
        return [s for s in shards_of(self.header)[part[0] - 1 :: part[1]] if s not in done]

    @contextmanager
    def claim(self, method: str, shard: Shard) -> Iterator[bool]:
        """Whether this process alone works on the shard; remains of a killed one are removed."""
        entry = self.entries[method]
        with claim(entry.claim_path(shard.index)) as own:
            if own:
                for kind in (*SCHEMAS, "manifest"):
                    for stale in (self.folder / kind / entry.slug).glob(f".{shard.name}*.tmp"):
                        stale.unlink(missing_ok=True)
            yield own

    def claimed_by(self, method: str, shard: Shard) -> str:
        """Who works on the shard, or did last: `process 7 on HOST`; empty if that is not known."""
        with suppress(OSError, FileError):
            path = self.entries[method].claim_path(shard.index)
            return printable(read_file(path, 1000).decode(errors="replace"))
        return ""

    def deaths(self, method: str, shard: Shard) -> int:
        """How many processes died while they scored the shard; a shard that is stored has no count."""
        try:
            found = self._begun(method, shard).lstat()
        except FileNotFoundError:
            return 0
        return found.st_size if stat.S_ISREG(found.st_mode) else 0

    @contextmanager
    def attempt(self, method: str, shard: Shard) -> Iterator[None]:
        """Around the scoring of a claimed shard: a process that dies inside leaves a mark."""
        path, before = self._begun(method, shard), self.deaths(method, shard)
        handle = _open_own(path, os.O_WRONLY | os.O_APPEND)
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
        return self.entries[method].quarantine_path(shard).exists()

    def give_another_try(self, method: str, shard: Shard) -> None:
        """Take back a quarantine: one more death brings it back."""
        self.entries[method].quarantine_path(shard).unlink(missing_ok=True)
        if (deaths := self.deaths(method, shard)) > 1:
            os.truncate(self._begun(method, shard), min(deaths, TRIES) - 1)

    def quarantine(self, method: str, shard: Shard, errors: Sequence[str]) -> None:
        """Note that a shard failed for good; the next run of the same command tries it again."""
        data = {"method": method, "first": shard.first, "last": shard.last}
        path = self.entries[method].quarantine_path(shard)
        replace_json(path, {**data, "errors": [printable(e) for e in errors]})

    def _begun(self, method: str, shard: Shard) -> Path:
        """The mark of an attempt: one byte for each death."""
        path = self.entries[method].claim_path(shard.index)
        return path.with_name(f"{path.name}.begun")

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
        tables = {kind: writer.table(kind, schema_of(self.header, kind)) for kind in SCHEMAS}
        outcomes = _count_outcomes(tables["trials"])
        planned = planned_in(self.header, shard)
        found = {s: sum(c.values()) for s, c in outcomes.items()}
        if found != planned:
            raise RunError(f"{where} has {found} rows, planned were {planned}")
        for kind, table in tables.items():
            first, last, every = shard.first, shard.last, kind == "trials"
            if what := _not_as_planned(self.header, first, last, table, every=every):
                raise RunError(f"{where}, {kind}: {what}; nothing was stored")
        failed = ["failures"] if len(tables["failures"]) else []
        files: dict[str, dict[str, Any]] = {}
        try:
            for kind in ("trials", *self.header["stored"], *failed):
                files[kind] = self._file(kind, entry.slug, shard, tables[kind], method)
            receipt = {
                "run": self.header["hash"], "method": method,
                "first": shard.first, "last": shard.last,
                "outcomes": outcomes, "files": files,
                "seconds": round(seconds, 3), "host": socket.gethostname(),
                "written": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            }  # fmt: skip
            won = write_json_once(entry.receipt_path(shard), receipt)
        except BaseException:
            self._remove(files)
            raise
        if not won:
            winner = read_json(entry.receipt_path(shard))["files"]
            kept = [f["path"] for f in winner.values()]
            self._remove({k: f for k, f in files.items() if f["path"] not in kept})
        for path in (entry.quarantine_path(shard), self._begun(method, shard)):
            path.unlink(missing_ok=True)
        return won

    def _remove(self, files: Mapping[str, Mapping[str, Any]]) -> None:
        for file in files.values():
            (self.folder / file["path"]).unlink(missing_ok=True)

    def _file(
        self, kind: str, slug: str, shard: Shard, table: pa.Table, method: str
    ) -> dict[str, Any]:
        """Write a table; what the receipt says of it.

        The name holds the sha256, so two writers of one shard never meet in one file.
        """
        base = self.folder / kind / slug / shard.name
        base.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(base)
        metadata = {"format": str(FORMAT), "method": method, "run": self.header["hash"]}
        metadata = {f"r2h_batch.{name}": value for name, value in metadata.items()}
        fields = list(SCHEMAS[kind])
        floats = [f.name for f in fields if f.type == pa.float32() and f.name not in TIMING]
        words = [f.name for f in fields if pa.types.is_dictionary(f.type) or f.name in TIMING]
        encoding = {"trial_id": "DELTA_BINARY_PACKED"} | dict.fromkeys(floats, "BYTE_STREAM_SPLIT")
        try:
            pq.write_table(
                table.replace_schema_metadata(metadata), temporary,
                row_group_size=max(len(table), 1), compression="zstd", compression_level=6,
                use_dictionary=words, column_encoding=encoding,
            )  # fmt: skip
            sync_file(temporary)
            sha256, size = sha256_of(temporary), temporary.stat().st_size
            name = f"{kind}/{slug}/{shard.name}-{sha256[:16]}.parquet"
            link_once(temporary, self.folder / name)
        finally:
            temporary.unlink(missing_ok=True)
        return {"path": name, "sha256": sha256, "bytes": size}


def _count_outcomes(table: pa.Table) -> dict[str, dict[str, int]]:
    """Split -> outcome -> trials, both in alphabetical order."""
    keys = pa.table({k: table[k].cast(pa.string()) for k in ("split", "outcome")})
    counts: dict[str, dict[str, int]] = {}
    groups = keys.group_by(["split", "outcome"]).aggregate([([], "count_all")])
    for row in groups.sort_by([("split", "ascending"), ("outcome", "ascending")]).to_pylist():
        counts.setdefault(row["split"], {})[row["outcome"]] = row["count_all"]
    return counts


def _printable_words(command: Any) -> Any:
    """A command line as it can be stored."""
    if not isinstance(command, (list, tuple)):
        return command
    return [printable(c)[:MAX_TEXT] for c in command]


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
    _check_header(new, path)
    if outer := run_folder_of(folder):
        words = f"lies in the run folder {outer}, which holds its own files alone; {OTHER_OUT}"
        raise RunError(f"{folder}: {words}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.path.lexists(path):
            own = (".", IMPORTED)
            names = [p.name for p in folder.iterdir() if not p.name.startswith(own)]
            if names and not os.path.lexists(path):  # another sweep may have begun meanwhile
                words = f"not empty and not a run folder (it has {min(names)!r}); {OTHER_OUT}"
                raise RunError(f"{folder}: {words}")
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
