"""Benchmarks of files: a benchmark.yaml with all files that it names, which lie in its own folder."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import path_within, printable, read_file, read_npy
from r2h_batch.base.registry import (
    RELEASE,
)
from r2h_batch.config import Workplace
from r2h_batch.data.grasp_files import grasps_from, without_gripper
from r2h_batch.data.mano import hand_from
from r2h_batch.data.people import (
    WORDS,
    People,
    built_in_people,
    people_hand_set,
    read_people,
)
from r2h_batch.scene.build_ahead import build_ahead
from r2h_batch.scene.grasp_set import GraspSet
from r2h_batch.scene.hand import (
    HandModel,
    HandSet,
    load_hand,
    load_hand_set,
    make_hand_set,
    neutral_hand_set,
)
from r2h_batch.scene.hand_file import HandChoice, read_hand_set
from r2h_batch.scene.objects import (
    ObjectModel,
    build_object,
    is_built,
    load_objects,
)
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.robot_file import ROBOTS, load_robot, read_robot
from r2h_batch.scene.vocabulary import S0_ROLES, THINGS, Thing, split_roles
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.file_fields import (
    BUILT_IN,
    BenchmarkFile,
    HandsEntry,
    ObjectEntry,
    read_benchmark_file,
)
from r2h_batch.trials.registry import named_benchmark
from r2h_batch.trials.trials_file import read_trials_file

MAX_FILE_BYTES = 1 << 30
MAX_LABELS_BYTES = 64 << 20
OF_OBJECT = ("file", "parts", "grasps", "receiver")
"""Fields of an object that name files."""


def read_benchmark(path: str | Path, *, pieces: bool = False) -> Benchmark:
    """Read a benchmark file with all files that it names.

    The result is remembered until this file or a file that it names changes.

    Args:
        path: a benchmark.yaml.
        pieces: whether meshes get their convex decomposition (up to a minute each).

    Raises:
        FileError, ObjectMeshError: one line.
    """
    path = Path(path)
    file = read_benchmark_file(path)
    digest = hashlib.sha256(read_file(path, MAX_FILE_BYTES))
    for field, name in named_files(file):
        try:
            if "\\" in name and ":" not in name:
                raise FileError(f"{printable(name)!r}: has a backslash; write / between folders")
            digest.update(bytes.fromhex(_digest(path_within(path.parent, name))))
        except FileError as error:
            raise FileError(f"{printable(path)}: {field}: {error}") from None
    return _read(str(path.resolve()), digest.hexdigest(), pieces)


def _digest(path: Path) -> str:
    return hashlib.sha256(read_file(path, MAX_FILE_BYTES)).hexdigest()


@lru_cache(maxsize=8)
def _read(path: str, _: str, pieces: bool) -> Benchmark:
    file, folder, shown = read_benchmark_file(Path(path)), Path(path).parent, printable(path)
    try:
        own = named_benchmark(file.protocol)
        if "robot" in file.model_fields_set or "persons" in file.model_fields_set:
            own = own.on(robot_of(file.robot, Path(path)), file.persons)
        people = own.people if file.trials is None else None  # those of a trials file have no body
        if file.people is not None:
            people = people_of_word(file.people, Path(path))
        hand_set, listed, labels = _hands(file, folder, own, people), None, None
        objects = own.objects  # take longer to read than hands: what is wrong there is said first
        if file.objects:
            objects = objects_of(file.objects, folder, pieces)
        names = [o.name for o in objects]
        if twice := [n for n in names if names.count(n) > 1]:
            raise FileError(f"{shown}: two objects are called {twice[0]!r}; rename one of them")
        if file.trials is not None:
            path_of_trials = path_within(folder, file.trials)
            listed, hand_set, labels = read_trials_file(path_of_trials, objects, hand_set)
        receiver = file.receiver or own.receiver
        if file.receiver is None and listed is not None and listed.receiver is None:
            receiver = "hand"
        head_m = file.head_clearance_m
        if head_m is None:
            head_m = own.head_clearance_m if receiver == "body" else 0.0
        _check_home(file.home, own.robot, shown)
        return replace(
            own, name=_name_of(Path(path)), objects=objects, hand_set=hand_set, thresholds=file.thresholds,
            workplace=_workplace(file, own.workplace), listed=listed, labels=labels, receiver=receiver, people=people,
            seed=file.seed or "", asks=own.asks if file.asks is None else tuple(file.asks), head_clearance_m=head_m,
        )  # fmt: skip
    except FileError:
        raise
    except ValueError as error:
        raise FileError(f"{shown}: {printable(error)}") from None


def _name_of(path: Path) -> str:
    """The name of a file's benchmark: the file's, or its folder's where the file is called benchmark.yaml."""
    return path.parent.name if path.stem == "benchmark" and path.parent.name else path.stem


def named_files(file: BenchmarkFile) -> list[tuple[str, str]]:
    """(field, name) of the files that it reads, as it says them."""
    own = [
        (f"objects.{i}.{field}", name)
        for i, o in enumerate(file.objects)
        for field in OF_OBJECT
        if (name := file_of(o, field)) is not None
    ]
    own += [("trials", file.trials)] if file.trials is not None else []
    own += [("people", file.people)] if file.people is not None and _is_table(file.people) else []
    hands = [("hand_model", file.hand_model), *(("hand_set", e.file) for e in _hand_entries(file))]
    return own + [(field, name) for field, name in hands if name != BUILT_IN]


def _hand_entries(file: BenchmarkFile) -> list[HandsEntry]:
    """The hand sets that are joined."""
    entries = [file.hand_set] if isinstance(file.hand_set, str) else file.hand_set
    return [HandsEntry(file=e) if isinstance(e, str) else e for e in entries]


def file_of(entry: ObjectEntry, field: str) -> str | None:
    """File that an object's field names; None where it names none."""
    name: str | None = getattr(entry, field)
    if name is None or (field == "receiver" and not name.endswith(".npy")):
        return None
    return str(without_gripper(name)[0]) if field == "grasps" else name


def _grasps(folder: Path, argument: str) -> GraspSet:
    path, gripper = without_gripper(argument)
    inside = path_within(folder, str(path))
    return grasps_from(f"{inside}:{gripper}" if gripper else inside)


def _check_home(home: Sequence[float], robot: Robot, shown: str) -> None:
    """Refuses a home posture outside the robot's joint limits."""
    for i, (q, low, high) in enumerate(zip(home, robot.lower, robot.upper, strict=True)):
        if not low <= q <= high:
            raise FileError(
                f"{shown}: home.{i} is {q}; the robot's joint goes from {low:.4f} to {high:.4f} rad"
            )


def _workplace(file: BenchmarkFile, own: Workplace) -> Workplace:
    """The workplace of a file: what it does not say is as in `own`."""
    home = tuple(file.home) if "home" in file.model_fields_set else own.home_q
    if "table" not in file.model_fields_set:
        return replace(own, home_q=home)
    return Workplace(home, tuple(file.table.center), tuple(file.table.half))


def robot_of(name: str, file: Path | None = None) -> Robot:
    """A built-in robot by its name, or the robot of a folder: of one beside the benchmark's file, if that names it."""
    if name in ROBOTS:
        return load_robot(name)
    path = Path(name) if file is None else path_within(file.parent, name)
    if not path.is_dir():
        how = f"allowed are {', '.join(ROBOTS)} and folders of r2h-batch import robot"
        what = f"no robot is called {printable(name)!r}{nearest(name.lower(), ROBOTS)}; {how}"
        raise FileError(_said_in(file) + what)
    return read_robot(path)


def people_of_word(name: str, file: Path | None = None) -> People:
    """The built-in people of a word, or those of a table: of one beside the benchmark's file, if that names it."""
    if name in WORDS:
        return built_in_people(name)
    if not _is_table(name):
        how = f"allowed are {', '.join(WORDS)}, or a .csv of lengths"
        what = f"people is {printable(name)}{nearest(name, WORDS)}; {how}"
        raise FileError(_said_in(file) + what)
    return people_of(Path(name) if file is None else path_within(file.parent, name))


def _is_table(people: str) -> bool:
    """Whether people are those of a file, not of a word."""
    return people.lower().endswith(".csv")


def _said_in(file: Path | None) -> str:
    """The benchmark's file in front of a message."""
    return "" if file is None else f"{printable(file)}: "


def people_of(path: Path) -> People:
    """The people of a file; the same ones as long as it does not change."""
    return _people_file(str(path), _digest(path))


@lru_cache(maxsize=4)
def _people_file(path: str, _: str) -> People:
    return read_people(path)


def _hands(file: BenchmarkFile, folder: Path, own: Benchmark, people: People | None) -> HandSet:
    """The file's postures, by default those of its protocol, on the file's hand; of people on their own."""
    if people is not None and file.hand_set == BUILT_IN == file.hand_model:
        return people_hand_set(people)
    model = None if file.hand_model == BUILT_IN else hand_of(path_within(folder, file.hand_model))
    if file.hand_set == BUILT_IN:
        return neutral_hand_set(model) if own.rule.name == RELEASE else hand_set_of(None, model)
    parts = []
    for entry in _hand_entries(file):
        if entry.file == BUILT_IN:
            how = "r2h-batch import hands --from built-in writes its hands as a file"
            raise FileError(f"hand_set: built-in cannot be joined; {how}")
        choice = entry.model_dump(exclude={"file"})
        choice["object"] = tuple(entry.object) if entry.object else None
        parts.append((path_within(folder, entry.file), HandChoice(**choice)))
    return hand_set_of(parts, model)


def hand_of(path: Path) -> HandModel:
    """The hand model of a file (`hand.npz`, or one of MANO's own); the same one as long as the file
    does not change."""
    return _hand(str(path), _digest(path))


@lru_cache(maxsize=4)
def _hand(path: str, _: str) -> HandModel:
    return hand_from(Path(path))


def hand_set_of(
    parts: Sequence[tuple[Path, HandChoice]] | None, model: HandModel | None
) -> HandSet:
    """The chosen hands of files, joined (None: the built-in ones), on a hand (None: the built-in
    one)."""
    if parts is None:
        return load_hand_set(None, model) if model is not None else load_hand_set()
    known = tuple((str(path), _digest(path), choice) for path, choice in parts)
    return _hand_set(known, load_hand() if model is None else model)


@lru_cache(maxsize=4)
def _hand_set(parts: tuple[tuple[str, str, HandChoice], ...], model: HandModel) -> HandSet:
    read = [read_hand_set(path, choice) for path, _, choice in parts]
    a = {name: np.concatenate([r[name] for r in read]) for name in read[0]}
    try:
        posture = a["posture"].tolist()
        return make_hand_set(model, a["pose"], a["shape"], a["side"], posture, a["in_body"])
    except ValueError as error:
        raise FileError(f"{printable(parts[0][0])}: {printable(error)}") from None


def objects_of(
    entries: Sequence[ObjectEntry], folder: Path, pieces: bool
) -> tuple[ObjectModel, ...]:
    """The objects of entries whose files lie in the folder or below; several meshes are built at a
    time."""
    meshes = [e for e in entries if e.file is not None and e.built_in is None]
    for entry in meshes:
        _check_parts(entry, folder, pieces)
    build_ahead([_own_call(e, folder, pieces) for e in meshes])
    return tuple(_object(e, folder, pieces) for e in entries)


def _object(entry: ObjectEntry, folder: Path, pieces: bool) -> ObjectModel:
    if (entry.built_in is None) == (entry.file is None):
        raise FileError(
            f"object {entry.name or entry.file or entry.built_in!r}: give either built_in or file"
        )
    model = (
        build_object(**_own_call(entry, folder, pieces))
        if entry.built_in is None
        else _built_in_object(entry)
    )
    more: dict[str, Any] = {}
    if entry.grasps is not None:
        more["grasps"] = _grasps(folder, entry.grasps)
    known_roles = S0_ROLES.get(model.name) if entry.built_in else None
    _check_names(model.name, "roles", entry.roles or (), model.part_names)
    roles, sharp = split_roles(entry.roles)
    if roles is not None and roles != known_roles:
        more["roles"] = dict(sorted(roles.items()))
    if sharp:
        more["sharp"] = tuple(sorted({*model.sharp, *sharp}))
    if entry.up is not None:
        more["up"] = _direction(model.name, entry.up)
    if entry.words is not None:
        words = Thing(**{k: _tuples(v) for k, v in entry.words.model_dump().items()})
        if not entry.built_in or words != THINGS.get(model.name):
            _check_words(model.name, words, model.part_names)
            more["words"] = words
    if entry.category is not None:
        if entry.built_in is not None:
            raise FileError(
                f"object {model.name}: a built-in object has its own category; leave category out"
            )
        more["category"] = entry.category
    return replace(model, **more) if more else model


def _direction(label: str, given: Sequence[float]) -> NDArray[np.float64]:
    """The unit vector (3,) along a direction."""
    length = float(np.linalg.norm(given))
    if not length > 1e-6:
        raise FileError(
            f"object {printable(label)}: up is {list(given)}; it must point out of the opening, as [0, 0, 1] does"
        )
    return _frozen(np.array(given, np.float64) / length)


def _tuples(value: Any) -> Any:
    """Lists made tuples, however deep, as `Thing` holds them."""
    if isinstance(value, dict):
        return {k: _tuples(v) for k, v in value.items()}
    return tuple(value) if isinstance(value, list) else value


def _check_parts(entry: ObjectEntry, folder: Path, pieces: bool) -> None:
    """Raise `FileError` where roles or words name a part that the mesh of a file does not have: before it is
    built, which may take minutes."""
    if entry.roles is None and entry.words is None:
        return
    call = _own_call(entry, folder, pieces)
    if is_built(**call):
        return
    from r2h_batch.scene.mesh_import.file import labels_of, load_mesh_file

    names: Sequence[str] = call["part_names"]
    if entry.parts is None and (groups := labels_of(load_mesh_file(call["mesh"], call["name"]))):
        names = groups[1]
    if entry.roles is not None:
        _check_names(call["name"], "roles", entry.roles, names)
    if entry.words is not None:
        words = Thing(**{k: _tuples(v) for k, v in entry.words.model_dump().items()})
        _check_words(call["name"], words, names)


def _check_names(label: str, field: str, given: Any, allowed: Any) -> None:
    if unknown := [n for n in given if n not in allowed]:
        hint = nearest(unknown[0], list(allowed))
        why = (
            ""
            if len(allowed) > 1
            else ": a mesh file has parts where it has two named groups or more"
        )
        raise FileError(
            f"object {printable(label)}: {field} name {unknown[0]!r}{hint}; it has {', '.join(allowed)}{why}"
        )


def _check_words(label: str, words: Thing, part_names: Sequence[str]) -> None:
    for labels in words.parts.values():
        _check_names(label, "words.parts", labels, part_names)
    _check_names(label, "words.verbs", words.verbs.values(), list(words.parts))
    _check_names(label, "words.part_words", words.part_words, list(words.parts))


def _built_in_object(entry: ObjectEntry) -> ObjectModel:
    """A built-in object with what the entry says otherwise."""
    (model,) = load_objects([str(entry.built_in)])
    fixed: Mapping[str, Any] = {
        "name": model.name,
        "scale": 1.0,
        "part_names": list(model.part_names),
    }
    for name, own in fixed.items():
        if getattr(entry, name) not in (None, own):
            raise FileError(
                f"object {model.name}: {name} of a built-in object is {own}; give its mesh as a file to change it"
            )
    if entry.receiver is not None or entry.parts is not None:
        raise FileError(
            f"object {model.name}: a built-in object has its own regions; give its mesh as a file to change them"
        )
    more: dict[str, Any] = {}
    if entry.split is not None and entry.split != model.split:
        if entry.split == "S1":
            raise FileError(
                f"object {model.name}: has no receiver's region for S1; give a mesh with one"
            )
        more |= {"split": "S0", "receiver_face": _frozen(np.zeros_like(model.receiver_face))}
    if entry.mass is not None and entry.mass != model.mass:
        more |= {"mass": entry.mass, "inertia": _frozen(model.inertia * (entry.mass / model.mass))}
    if entry.instruction is not None and entry.instruction != model.instruction:
        more["instruction"] = entry.instruction
    return replace(model, **more) if more else model


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array


def _own_call(entry: ObjectEntry, folder: Path, pieces: bool) -> dict[str, Any]:
    """The arguments of `build_object` that an entry means."""
    mesh = path_within(folder, str(entry.file))
    receiver: str | Path | None = entry.receiver
    if receiver is not None and str(receiver).endswith(".npy"):
        receiver = path_within(folder, str(receiver))
    labels = None
    if (entry.parts is None) != (entry.part_names is None):
        raise FileError(f"object {entry.name or entry.file}: parts and part_names go together")
    if entry.parts is not None:
        labels = read_npy(path_within(folder, entry.parts), most=MAX_LABELS_BYTES)
        count = len(entry.part_names or ())
        if (
            not isinstance(labels, np.ndarray)
            or labels.ndim != 1
            or labels.dtype.kind not in "iu"
            or not len(labels)
        ):
            raise FileError(f"{printable(entry.parts)}: need one whole number for each face")
        if labels.min() < 0 or labels.max() >= count:
            raise FileError(
                f"{printable(entry.parts)}: labels go from {labels.min()} to {labels.max()}; there are {count} names"
            )
    return {
        "mesh": str(mesh), "name": entry.name or Path(str(entry.file)).stem, "split": entry.split or "S0",
        "receiver": None if receiver is None else str(receiver), "scale": entry.scale or 1.0, "mass": entry.mass,
        "instruction": entry.instruction, "face_part": None if labels is None else labels.tolist(),
        "part_names": tuple(entry.part_names or ("body",)), "pieces": pieces,
    }  # fmt: skip
