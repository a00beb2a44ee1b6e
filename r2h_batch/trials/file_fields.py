"""The benchmark file: every field with its type and bounds, its reader, and the built-in benchmark
as such a file. `r2h-batch ls benchmark --schema` prints the schema."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import printable, read_yaml
from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.base.schedule import SEED
from r2h_batch.base.validate import rule_of
from r2h_batch.config import HOME_Q, MOST_HEAD_CLEARANCE_M, TABLE_CENTER, TABLE_HALF, Thresholds
from r2h_batch.scene.objects import (
    BUILT_IN_NAMES,
    INSTANCE_NAMES,
    OBJECT_NAMES,
    ObjectModel,
)
from r2h_batch.scene.robot_file import DEFAULT_ROBOT
from r2h_batch.scene.vocabulary import S0_ROLES, THINGS, VERB_WORDS
from r2h_batch.verdicts import ASKED_NAMES

BUILT_IN = "built-in"
DEEPEST = 6
MAX_OBJECTS = 1000

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}$")]
Word = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[a-zA-Z0-9][a-zA-Z0-9 _-]*$")]
Words = Annotated[list[Word], Field(min_length=1, max_length=64)]
Sentence = Annotated[str, Field(min_length=1, max_length=300)]
FilePath = Annotated[str, Field(min_length=1, max_length=400)]


def _verb(name: str) -> str:
    if name not in VERB_WORDS:
        hint = nearest(name, list(VERB_WORDS))
        raise ValueError(f"this purpose is unknown{hint}; allowed are {', '.join(VERB_WORDS)}")
    return name


Verb = Annotated[str, AfterValidator(_verb), Field(json_schema_extra={"enum": list(VERB_WORDS)})]


class _Entry(BaseModel):
    # most processes read no benchmark file: pydantic builds its schemas at the first one
    model_config = ConfigDict(strict=True, extra="forbid", defer_build=True)


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

    built_in: Literal[(*BUILT_IN_NAMES, *INSTANCE_NAMES)] | None = Field(  # type: ignore[valid-type]
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
        description="the receiver's region (S1): a part's name, z<0.3, or a .npy of faces or boxes beside this file",
    )
    parts: FilePath | None = Field(
        default=None,
        description=".npy beside this file: a part label for every face; else the groups of an OBJ or GLB are its parts",
    )
    part_names: Annotated[list[Name], Field(min_length=1, max_length=64)] | None = None
    roles: dict[Name, Literal["function", "grasp", "wrap", "sharp"]] | None = Field(
        default=None,
        description="part -> what it is for, or sharp: nothing that a hand should come to first; else grasp in the receiver's"
        " region, function elsewhere",
    )
    up: (
        Annotated[list[Annotated[float, Field(ge=-1e3, le=1e3)]], Field(min_length=3, max_length=3)]
        | None
    ) = Field(
        default=None,
        description="of an open vessel: the direction out of its opening, in the mesh's frame",
    )
    words: WordsEntry | None = None
    category: Literal[OBJECT_NAMES] | None = Field(  # type: ignore[valid-type]
        default=None,
        description="the family whose things it is like; contact,contacts=other-categories asks what never saw that one",
    )
    grasps: FilePath | None = Field(default=None, description="candidates, .npz beside this file")


class HandsEntry(_Entry):
    """Hands of a set, and which of them; what is left out chooses nothing."""

    file: FilePath = Field(description="a hands.npz (r2h-batch import hands)")
    side: Literal["right", "left"] | None = None
    count: Annotated[int, Field(ge=1, le=100_000)] | None = Field(
        default=None, description="so many of each side, at even steps through the file"
    )
    object: Annotated[list[Sentence], Field(min_length=1)] | None = Field(
        default=None, description="names of the objects that they were recorded with"
    )
    contact: bool | None = Field(default=None, description="whether they carry the object")
    mover: bool | None = Field(
        default=None, description="whether they carry it longest of the hands of their sequence"
    )


class TableEntry(_Entry):
    """The table as a box along the world's axes, metres."""

    center: Annotated[
        list[Annotated[float, Field(ge=-10, le=10)]], Field(min_length=3, max_length=3)
    ] = list(TABLE_CENTER)
    half: Annotated[
        list[Annotated[float, Field(ge=1e-3, le=10)]], Field(min_length=3, max_length=3)
    ] = list(TABLE_HALF)


def _in_metres(limits: Thresholds) -> Thresholds:
    """Refuse what is a length in another unit. `Thresholds` itself has the gripper's bounds."""
    for name, low, high in (("reach_radius_m", 1e-3, 2.0), ("reach_offset_m", 1e-3, 1.0)):
        value = getattr(limits, name)
        if not low <= value <= high:
            raise ValueError(f"{name} is {value:g}; it must be {low:g} to {high:g} metres")
    return limits


Limits = Annotated[
    Thresholds,
    AfterValidator(_in_metres),
    Field(description="where a criterion turns from pass to fail, metres"),
]


class BenchmarkFile(_Entry):
    """A benchmark; what is left out is as in the built-in one that `protocol` names. Files are named
    relative to this one, beside or below it."""

    format: Literal[1] = 1
    protocol: Name = Field(
        default=DEFAULT_BENCHMARK,
        description="the benchmark that this file changes, whose rule draws the trials: a name of r2h-batch ls benchmarks",
    )
    receiver: Literal["hand", "body"] | None = Field(
        default=None,
        description="what planning and Safe see of the person: the hand, or arm, torso and head too; null: as the benchmark does",
    )
    head_clearance_m: Annotated[float, Field(ge=0, le=MOST_HEAD_CLEARANCE_M)] | None = Field(
        default=None,
        description="what robot and object keep from the head, m; needs receiver body; null: as the benchmark does",
    )
    hand_model: FilePath = Field(
        default=BUILT_IN, description="built-in, or a hand.npz (r2h-batch import hand)"
    )
    hand_set: (
        FilePath | Annotated[list[HandsEntry | FilePath], Field(min_length=1, max_length=64)]
    ) = Field(
        default=BUILT_IN,
        description="built-in, a hands.npz (r2h-batch import hands), or a list of sets to join",
    )
    objects: Annotated[list[ObjectEntry], Field(max_length=MAX_OBJECTS)] = Field(
        default=[],
        description="in this order: object_index; none: the benchmark's own",
    )
    trials: FilePath | None = Field(
        default=None,
        description="trials of your own, .npz or .parquet; else the benchmark draws them",
    )
    seed: Annotated[str, Field(pattern=f"^{SEED}$")] | None = Field(
        default=None,
        description="32 hexadecimal digits: other trials of the same rule; null: the published ones",
    )
    asks: list[Literal[ASKED_NAMES]] | None = Field(  # type: ignore[valid-type]
        default=None,
        description="criteria beside those of every benchmark; null: as the benchmark does, []: none",
    )
    thresholds: Limits = Thresholds()
    robot: FilePath = Field(
        default=DEFAULT_ROBOT,
        description="a name of ls robots, or a folder of import robot beside this file",
    )
    persons: Literal["for-robot", "as-for-ur5e"] = Field(
        default="for-robot",
        description="where persons stand: for the robot's home and reach, or where they do for the UR5e",
    )
    people: FilePath | None = Field(
        default=None,
        description="receivers with their own bodies and hands: adults, children, elderly, all, wheelchair, or a .csv of"
        " lengths; null: the benchmark's own",
    )
    table: TableEntry = Field(default=TableEntry())
    home: Annotated[
        list[Annotated[float, Field(ge=-6.2832, le=6.2832)]], Field(min_length=6, max_length=12)
    ] = Field(default=list(HOME_Q), description="the arm's posture at the start, rad")


def read_benchmark_file(path: Path) -> BenchmarkFile:
    """The fields of a benchmark file. Raises `FileError`, one line that names the field."""
    return _validated(BenchmarkFile, read_yaml(path, deepest=DEEPEST), printable(path))


def read_object_file(path: Path, mesh: str) -> ObjectEntry:
    """The fields of a file beside a mesh: those of a benchmark's object but for `file` and
    `built_in`."""
    data, shown = read_yaml(path, deepest=DEEPEST), printable(path)
    for name in ("file", "built_in"):
        if name in data:
            about = f"this file is about {printable(mesh)} beside it"
            raise FileError(f"{shown}: {name} is not allowed here: {about}")
    return _validated(ObjectEntry, {**data, "file": mesh}, shown)


Model = TypeVar("Model", bound=BaseModel)


def _validated(model: type[Model], data: dict[str, Any], shown: str) -> Model:
    """The model of these fields; a `FileError` that names the first wrong one."""
    try:
        return model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        first, place = _first_fault(error.errors(include_url=False), data)
    where = ".".join(printable(p)[:60] for p in place)
    names = [p for p in place if isinstance(p, str)]
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        allowed = list(_schema_at(model, names[:-1]))
        hint = nearest(names[-1], allowed)
        raise FileError(f"{shown}: unknown field {where}{hint}; allowed are {', '.join(allowed)}")
    if first["type"] == "missing":
        found = "is missing"
    elif first["type"] == "value_error" and names[:1] == ["thresholds"]:
        raise FileError(f"{shown}: {rule_of(first)}")
    else:
        found = f"is {printable(repr(first['input']))[:80]}"
    words = _schema_at(model, names[:-1]).get(names[-1] if names else "", {}).get("description")
    raise FileError(f"{shown}: {where} {found}; {rule_of(first)}{f': {words}' if words else ''}")


def _first_fault(errors: Sequence[Any], data: Any) -> tuple[Any, list[str | int]]:
    """The fault of the first wrong field, and its place in the data. Where a field may be one of several things, pydantic
    has faults of each: the one counts that what is there comes nearest to."""
    own = [e for e in errors if e["loc"][:1] == errors[0]["loc"][:1]]
    places = [_place_in(data, e["loc"], e["type"] == "missing") for e in own]
    of_kind = [e["type"] not in _OTHER_KIND for e in own]
    unknown = [e["type"] == "extra_forbidden" for e in own]
    best = max(range(len(own)), key=lambda i: (of_kind[i], unknown[i], len(places[i]), -i))
    return own[best], places[best]


_OTHER_KIND = ("string_type", "list_type", "model_type", "model_attributes_type")


def _place_in(data: Any, loc: Sequence[str | int], missing: bool) -> list[str | int]:
    """The keys and numbers of a fault's place that are there; pydantic also names the kinds that it tried."""
    place: list[str | int] = []
    for k, p in enumerate(loc):
        in_list = isinstance(p, int) and isinstance(data, list) and p < len(data)
        if in_list or (isinstance(data, dict) and p in data):
            data = data[p]
        elif not missing or k + 1 < len(loc):
            continue
        place.append(p)
    return place


def _schema_at(model: type[BaseModel], names: Sequence[str]) -> dict[str, Any]:
    """name -> JSON Schema of the fields at a place; empty where there are none."""
    schema = model.model_json_schema()
    place, definitions = schema, schema.get("$defs", {})
    for name in names:
        place = place.get("properties", {}).get(name, {})
        while nested := [
            *place.get("anyOf", []),
            *([place["items"]] if isinstance(place.get("items"), dict) else []),
        ]:
            place = next((n for n in nested if n.keys() & {"$ref", "items"}), nested[0])
        if "$ref" in place:
            place = definitions[place["$ref"].rpartition("/")[2]]
    return dict(place.get("properties", {}))


ABOUT = """\
# The default benchmark. `r2h-batch ls benchmark --schema` prints what every field may hold, `r2h-batch ls benchmark FILE`
# reads a file, `r2h-batch sweep --benchmark FILE` scores on it. Fields that are left out have these values. The robot is a UR5e
# with a 2F-85.
"""


def text_of(name: str, objects: Sequence[ObjectModel], receiver: Literal["hand", "body"]) -> str:
    """YAML that `read_benchmark` reads as a named benchmark.

    Args:
        name: of the benchmark.
        objects: its stored objects.
        receiver: what it sees of the person.
    """
    import yaml

    class Plain(yaml.SafeDumper):
        """Writes no anchors: `read_yaml` refuses them."""

        def ignore_aliases(self, data: Any) -> bool:
            return True

    entries = [_entry_of(o) for o in objects]
    file = BenchmarkFile(protocol=name, objects=entries, receiver=receiver)
    data = file.model_dump(exclude_none=True)
    return ABOUT + yaml.dump(
        data, Dumper=Plain, sort_keys=False, default_flow_style=None, width=118
    )


def _entry_of(model: ObjectModel) -> ObjectEntry:
    entry = {k: getattr(model, k) for k in ("split", "instruction", "mass", "part_names")}
    if model.name in INSTANCE_NAMES:  # its category has roles and words
        return ObjectEntry.model_validate_json(json.dumps({"built_in": model.name, **entry}))
    about = {"roles": S0_ROLES.get(model.name), "words": asdict(THINGS[model.name])}
    return ObjectEntry.model_validate_json(json.dumps({"built_in": model.name, **entry, **about}))
