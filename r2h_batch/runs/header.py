"""run.json and methods/METHOD.json: what a run is, and which shards it has.

A folder may come from anybody: each JSON file has a size limit and goes through a model with bounds
before a field is used.
"""

import difflib
import hashlib
import itertools
import json
import os
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError, create_model

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable
from r2h_batch.base.io.read import read_json as read_any_json
from r2h_batch.base.registry import QUESTIONS
from r2h_batch.base.validate import rule_of
from r2h_batch.config import MOST_HEAD_CLEARANCE_M
from r2h_batch.runs.columns import schema_of_kind
from r2h_batch.runs.files import RunError, in_the_way
from r2h_batch.runs.plugged import other_plugins
from r2h_batch.verdicts import ASKED_NAMES, NO_LONGER

FORMAT = 4
"""Version of the folder: fields of its JSON files and the form of its shards."""

IDENTITY = (
    *("format", "protocol", "trials", "configuration", "digests"),
    *("seed", "device", "versions", "stored"),
)
"""Fields of run.json that two sweeps must share to use one folder; of `device` only the kind."""

TIMING = ("t_plan_s", "t_method_s", "t_sees_s")
"""Columns of the trials that depend on the machine: no digest covers them. They hold one value a
chunk, so a dictionary stores them in less than a bit a trial."""

BENCHMARK_FILES = "benchmark"
"""The folder of the benchmark's files (`trials.run_files`)."""

FOLDERS = ("shards", "methods", BENCHMARK_FILES, ".claims")
"""Folders of a run; a link in the place of one is refused, and of one that holds answers beside the shards (side.py)."""

MAX_JSON_BYTES = 32 << 20  # a run.json with 100,000 objects fits
MAX_TEXT = 4096
MAX_SHARDS = 10**6  # file names have six digits for them
MAX_SHARD_TRIALS = 10**7  # a shard is in memory as a whole: some GB

_ABSENT: Any = None  # a field may be absent, but a written one is not null

Count = Annotated[int, Field(ge=0, le=10**12)]
Split = Literal["S0", "S1"]
Kind = Literal["trials", "details", "poses", "paths", "failures", "episodes", "sees"]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Hash = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Metres = Annotated[float, Field(ge=0, le=1e3)]
Angle = Annotated[float, Field(ge=-6.2832, le=6.2832)]
Rate = Annotated[float, Field(ge=1e-3, le=1e3)]
Step = Annotated[float, Field(gt=0, le=1e3)]


class Record(BaseModel):
    """Fields that the package reads; other fields are dropped."""

    model_config = ConfigDict(strict=True, extra="ignore")


class _Open(BaseModel):
    """A record with more fields than the package reads."""

    model_config = ConfigDict(strict=True, extra="allow")
    __pydantic_extra__: dict[str, JsonValue]


class _Versions(_Open):
    __pydantic_extra__: dict[str, Text]  # type: ignore[assignment]
    r2h_batch: Text


class _PlugIn(_Open):
    package: Text
    version: Text
    module: Text
    sha256: Hash


class _Object(_Open):
    name: Name
    split: Split
    built_in: bool
    digest: Hash = _ABSENT
    category: Name = _ABSENT


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
_Sees = _record(
    rig=Name,
    rig_digest=Hash,
    noise=Annotated[float, Field(ge=0, le=1e3)],
    labels=Text,
    object=Text,
    seed=Count,
    # only where the receiver's region is told
    region=(Text, _ABSENT),
)
_Misses = Annotated[list[Annotated[int, Field(ge=0, le=10**9)]], Field(min_length=2, max_length=2)]
_Robot = _record(name=Name, digest=Hash, ik_missed=(_Misses, _ABSENT))
Header = _record(
    Record,
    format=int,
    hash=Hash,
    protocol=Text,
    trials=Annotated[dict[Split, Count], Field(min_length=1)],
    configuration=_Configuration,
    digests=_record(trials=Text),
    # what `digests.code` was made of: room of the package -> digest
    code_parts=(dict[Text, Hash], _ABSENT),
    # what other packages added: KIND.NAME -> package, version, module and digest (plugged.py)
    plugins=(dict[Text, _PlugIn], _ABSENT),
    seed=Annotated[int, Field(ge=-(1 << 63), lt=1 << 63)],
    device=_record(kind=Text, name=Text),
    versions=_Versions,
    stored=list[Kind],
    shard_trials=Annotated[int, Field(ge=1, le=MAX_SHARD_TRIALS)],
    predictors=(_record(noise_factor=Annotated[float, Field(ge=0, le=1e12)]), _ABSENT),
    motion=(_Motion, _ABSENT),
    # what the cameras of its methods saw; its digest is among the digests
    sees=(_Sees, _ABSENT),
    objects=(list[_Object], _ABSENT),
    # criteria that its benchmark asks for beside those of all; the benchmark's digest knows them
    asks=(list[Literal[(*ASKED_NAMES, *NO_LONGER)]], _ABSENT),  # type: ignore[valid-type]
    # what robot and object keep from the head, m; the benchmark's digest knows it
    head_clearance_m=(Annotated[float, Field(gt=0, le=MOST_HEAD_CLEARANCE_M)], _ABSENT),
    # what its receivers are made of; runs of before lack it (before.py)
    person=(Annotated[list[Name], Field(max_length=100)], _ABSENT),
    benchmark=(_record(flags=Annotated[list[Text], Field(max_length=100)]), _ABSENT),
    robot=(_Robot, _ABSENT),
    hands=(list[JsonValue], _ABSENT),  # sides of the hand set in order, as (side, number of hands)
    # id of a trial -> why the executed motion of its file is planned anew instead of judged
    motions_left_out=(dict[Text, Text], _ABSENT),
    platform=(Text, ""),
    git_commit=(Text | None, None),
    command=(list[Text], []),
    created=(Text, ""),
)
"""run.json."""


class Method(Record):
    """methods/METHOD.json."""

    name: Name
    source: dict[Text, Text]
    command: list[Text]
    order: Annotated[int, Field(ge=0, le=10**6)]


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


def checked(model: type[Record], data: Any, path: Path) -> dict[str, Any]:
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


def _identity(header: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of the header that decide the rows of a run; older folders have no `predictors` or no `hands`."""
    found = {k: header.get(k) for k in IDENTITY}
    found |= {k: header[k] for k in ("predictors", "hands", "asks", "plugins") if k in header}
    return {**found, "device": (header.get("device") or {}).get("kind")}


def run_hash(header: Mapping[str, Any]) -> str:
    """sha256 (hex) over what decides the rows, and the shard size."""
    data = {**_identity(header), "shard_trials": header["shard_trials"]}
    return hashlib.sha256(json.dumps(data, sort_keys=True, allow_nan=False).encode()).hexdigest()


def differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Names of the identity's fields in which two headers differ, with the parts that differ, and of what other packages
    add (`other_plugins`)."""
    a, b, names = _identity(old), _identity(new), []
    for key in (*IDENTITY, "predictors"):
        x, y = a.get(key), b.get(key)
        if x != y:
            inner: list[str] = []
            if isinstance(x, Mapping) and isinstance(y, Mapping):
                inner = sorted(k for k in {**x, **y} if x.get(k) != y.get(k))
                inner = [_code_of(old, new) if k == "code" else k for k in inner]
            elif isinstance(x, int) and isinstance(y, int):
                inner = [f"{x}, now {y}"]
            names.append(f"{key} ({', '.join(inner)})" if inner else key)
    return names + other_plugins(old, new)


def _code_of(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """The digest of the code in words, with the rooms of the package in which two headers differ."""
    a, b = (header.get("code_parts") or {} for header in (old, new))
    rooms = [k for k in sorted({**a, **b}) if a and b and a.get(k) != b.get(k)]
    return f"code in {' and '.join(rooms)}" if rooms else "code"


def check_header(data: Mapping[str, Any], path: Path) -> dict[str, Any]:
    header = checked(Header, dict(data), path)
    names = Counter(o["name"] for o in header.get("objects", ()))
    if several := [name for name, n in names.items() if n > 1]:
        raise RunError(
            f"{printable(path)}: objects names {printable(repr(several[0]))[:80]} {names[several[0]]} times;"
            " each is there once"
        )
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
    """The run that a wrong path may mean: the newest one inside it, or one of nearly its
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
        if (folder / "shards").is_dir():  # a run beside it would be another one
            raise RunError(f"{printable(folder)}: run.json is missing; copy it again")
        near = f"; did you mean {printable(found)}?" if (found := _near(folder)) else ""
        there = "is a file; give a run folder" if os.path.lexists(folder) else "no such folder"
        what = "no run.json, so it is not a run folder" if folder.is_dir() else there
        raise RunError(f"{printable(folder)}: {what}{near}")
    data = read_json(path)
    if data.get("format") != FORMAT:
        shown = f"{printable(data.get('format'))!r:.40}"
        words = f"this version reads format {FORMAT}"
        raise RunError(f"{path}: format {shown}; {words}")
    header = check_header(data, path)
    if header["hash"] != run_hash(header):
        words = "restore it, or sweep into another --out"
        raise RunError(f"{path}: its fields do not agree with its own hash; {words}")
    for kind in (*FOLDERS, *QUESTIONS):
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


def schema_of(header: Mapping[str, Any], kind: str, *, unread: bool = False) -> pa.Schema:
    """The columns of a kind of table in this run, whose postures are as long as its home posture. `unread`: as of
    `schema_of_kind`."""
    home = header["configuration"].get("workplace", {}).get("home_q")
    joints = 6 if home is None else len(home)
    return schema_of_kind(kind, joints, header.get("asks", ()), unread=unread)


def motions_left_out(left_out: Mapping[str, str]) -> list[str]:
    """A line for each reason, with the ids that it concerns."""
    by: dict[str, list[str]] = {}
    for trial, why in left_out.items():
        by.setdefault(why, []).append(trial)
    return [
        f"{len(ids)} executed motions are left out and planned anew: {why} ({', '.join(ids)})"
        for why, ids in by.items()
    ]
