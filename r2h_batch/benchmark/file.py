"""What a benchmark file may say: every field with its type and bounds. `r2h-batch benchmark show`
prints it as a schema."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, create_model

from r2h_batch.benchmark.words import VERB_WORDS
from r2h_batch.bodies.objects import OBJECT_NAMES
from r2h_batch.command_line import nearest
from r2h_batch.config import HOME_Q, TABLE_CENTER, TABLE_HALF, Thresholds
from r2h_batch.io.read import FileError, printable, read_yaml
from r2h_batch.validate import rule_of

__all__ = [
    "BUILT_IN",
    "BenchmarkFile",
    "ObjectEntry",
    "WordsEntry",
    "read_entry",
    "read_file_model",
]

BUILT_IN = "built-in"
DEEPEST = 6
MAX_OBJECTS = 1000

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}$")]
Word = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[a-zA-Z0-9][a-zA-Z0-9 _-]*$")]
Words = Annotated[list[Word], Field(min_length=1, max_length=64)]
Sentence = Annotated[str, Field(min_length=1, max_length=300)]
FilePath = Annotated[str, Field(min_length=1, max_length=400)]
_BOUNDS = {"reach_radius_m": (1e-3, 2.0), "reach_offset_m": (1e-3, 1.0)}
"""Of thresholds, m: beyond these a unit is meant that is none here. What no gripper has,
`Thresholds` itself refuses."""


def _verb(name: str) -> str:
    if name not in VERB_WORDS:
        raise ValueError(
            f"no purpose that is understood{nearest(name, list(VERB_WORDS))}; allowed are {', '.join(VERB_WORDS)}"
        )
    return name


Verb = Annotated[str, AfterValidator(_verb), Field(json_schema_extra={"enum": list(VERB_WORDS)})]


class _Entry(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")


class WordsEntry(_Entry):
    """How people ask for an object; case and plural do not matter."""

    names: Words = Field(description="what it is called, the usual name first")
    parts: dict[Word, Words] = Field(
        description="a part as people call it -> the object's part labels that belong to it"
    )
    verbs: dict[Verb, Word] = Field(
        default={}, description="purpose -> the part (as people call it) to take for it"
    )
    part_words: dict[Word, Words] = Field(default={}, description="part -> other words for it")


class ObjectEntry(_Entry):
    """One object: a built-in one by name, or a mesh file with what is to be known of it."""

    built_in: Literal[OBJECT_NAMES] | None = Field(  # type: ignore[valid-type]
        default=None, description="name of a built-in object"
    )
    file: FilePath | None = Field(
        default=None, description="a mesh beside this file: OBJ, STL, PLY, OFF, GLB"
    )
    name: Name | None = Field(default=None, description="its name; the file's unless given")
    split: Literal["S0", "S1"] | None = Field(
        default=None, description="S0 free handover, S1 functional"
    )
    instruction: Sentence | None = Field(default=None, description="what the robot is told")
    mass: Annotated[float, Field(ge=1e-4, le=100)] | None = Field(default=None, description="kg")
    scale: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        default=None, description="0.001 for millimetres"
    )
    receiver: FilePath | None = Field(
        default=None,
        description="the receiver's region (S1): a part's name, z<0.3, or a .npy beside this file",
    )
    parts: FilePath | None = Field(
        default=None,
        description=".npy beside this file: a part label for every face; else the groups of an OBJ or GLB are its parts",
    )
    part_names: Annotated[list[Name], Field(min_length=1, max_length=64)] | None = None
    roles: dict[Name, Literal["function", "grasp", "wrap"]] | None = Field(
        default=None,
        description="part -> what it is for; else grasp in the receiver's region, function elsewhere",
    )
    words: WordsEntry | None = None
    grasps: FilePath | None = Field(
        default=None, description="candidates, .npz or .safetensors beside this file"
    )


class TableEntry(_Entry):
    """The table as a box along the world's axes, metres."""

    center: Annotated[
        list[Annotated[float, Field(ge=-10, le=10)]], Field(min_length=3, max_length=3)
    ] = list(TABLE_CENTER)
    half: Annotated[
        list[Annotated[float, Field(ge=1e-3, le=10)]], Field(min_length=3, max_length=3)
    ] = list(TABLE_HALF)


def _metres(name: str) -> Any:
    low, high = _BOUNDS.get(name, (0.0, 10.0))
    return Annotated[float, Field(ge=low, le=high, description="metres")]


ThresholdsEntry: Any = create_model(
    "ThresholdsEntry",
    __config__=ConfigDict(strict=True, extra="forbid"),
    __doc__="Where a criterion turns from pass to fail, metres; the trials' hands stand by reach_offset_m too.",
    **{f.name: (_metres(f.name), f.default) for f in fields(Thresholds)},  # type: ignore[call-overload]
)


class BenchmarkFile(_Entry):
    """A benchmark; what is left out is as in the built-in one. Files are named relative to this
    one, beside or below it."""

    format: Literal[1] = 1
    protocol: Literal["r2h-v0", "r2h-v1"] = Field(
        default="r2h-v0", description="the rule that draws the trials"
    )
    receiver: Literal["hand", "body"] = Field(
        default="hand",
        description="what planning and Safe see of the person: the hand, or arm and torso too (r2h-v1)",
    )
    hand_model: FilePath = Field(
        default=BUILT_IN, description="built-in, or a hand.npz (r2h-batch import hand)"
    )
    hand_set: FilePath = Field(
        default=BUILT_IN, description="built-in, or a hands.npz (r2h-batch import hands)"
    )
    objects: Annotated[list[ObjectEntry], Field(min_length=1, max_length=MAX_OBJECTS)] = Field(
        default=[ObjectEntry(built_in=name) for name in OBJECT_NAMES],
        description="in this order: object_index",
    )
    trials: FilePath | None = Field(
        default=None,
        description="trials of your own, .npz or .parquet; else the protocol draws them",
    )
    thresholds: ThresholdsEntry = Field(default=ThresholdsEntry())
    table: TableEntry = Field(default=TableEntry())
    home: Annotated[
        list[Annotated[float, Field(ge=-6.2832, le=6.2832)]], Field(min_length=6, max_length=6)
    ] = Field(default=list(HOME_Q), description="the arm's posture at the start, rad")


def read_file_model(path: Path) -> BenchmarkFile:
    """The fields of a benchmark file, each within its bounds. Raises `FileError`, one line that
    names the field."""
    data, shown = read_yaml(path, deepest=DEEPEST), printable(path)
    return _checked(BenchmarkFile, data, shown, "")


def read_entry(path: Path, mesh: str) -> ObjectEntry:
    """What a file beside a mesh says of it: the fields of a benchmark's object but for `file` and
    `built_in`."""
    data, shown = read_yaml(path, deepest=DEEPEST), printable(path)
    for name in ("file", "built_in"):
        if name in data:
            raise FileError(
                f"{shown}: {name} has no place here: this file is about {printable(mesh)} beside it"
            )
    return _checked(ObjectEntry, {**data, "file": mesh}, shown, "objects")


_KINDS: dict[str, type[BaseModel]] = {
    "": BenchmarkFile, "objects": ObjectEntry, "words": WordsEntry, "thresholds": ThresholdsEntry, "table": TableEntry,
}  # fmt: skip
"""Field -> what its entries are."""

Kind = TypeVar("Kind", bound=BaseModel)


def _checked(model: type[Kind], data: dict[str, Any], shown: str, top: str) -> Kind:
    """The model of these fields; `top`: what `_fields_at` calls it."""
    try:
        return model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(printable(p)[:60] for p in first["loc"])
        if first["type"] == "extra_forbidden":
            allowed = _fields_at((top, *first["loc"][:-1]))
            hint = nearest(str(first["loc"][-1]), allowed)
            listed = f"; allowed are {', '.join(allowed)}" if allowed else ""
            raise FileError(f"{shown}: unknown field {where}{hint}{listed}") from None
        what = (
            "is missing"
            if first["type"] == "missing"
            else f"is {printable(repr(first['input']))[:80]}"
        )
        said = _said_of((top, *first["loc"]))
        raise FileError(
            f"{shown}: {where} {what}; {rule_of(first)}{f': {said}' if said else ''}"
        ) from None


def _said_of(place: tuple[int | str, ...]) -> str:
    """What the schema says of a field; empty where it says nothing."""
    *above, name = [p for p in place if isinstance(p, str)]
    kind = _KINDS.get(above[-1] if above else "")
    field = kind.model_fields.get(name) if kind is not None else None
    return field.description or "" if field is not None else ""


def _fields_at(place: tuple[int | str, ...]) -> list[str]:
    """Names that the schema allows at a place; none where anything goes."""
    names = [p for p in place if isinstance(p, str)]
    kind = _KINDS.get(names[-1] if names else "")
    return [] if kind is None else list(kind.model_fields)
