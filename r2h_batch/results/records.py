"""What the JSON files of a run folder may say: every field with its type and bounds, whoever wrote
the file.

A folder may come from anybody. A file is read with a size limit, its words must be printable, its
numbers finite; then its fields go through a model. Fields that no model names are dropped, so
nothing unchecked is ever used.
"""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from r2h_batch.files import FileError, printable, read_file
from r2h_batch.files.rules import rule_of
from r2h_batch.results.rows import OUTCOME_NAMES
from r2h_batch.results.storage import in_the_way

__all__ = [
    "KINDS",
    "MAX_SHARDS",
    "SLUG",
    "Header",
    "Method",
    "Receipt",
    "RunError",
    "checked",
    "read_json",
]

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
