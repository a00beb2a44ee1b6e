"""A benchmark file with all files that it names, as a `Benchmark`. Nothing outside the file's own
folder is opened."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.benchmark.benchmark import Benchmark
from r2h_batch.benchmark.file import BUILT_IN, BenchmarkFile, ObjectEntry, read_file_model
from r2h_batch.benchmark.trials_file import read_trials_file
from r2h_batch.benchmark.unbuilt import unbuilt
from r2h_batch.benchmark.words import S0_ROLES, THINGS, Thing
from r2h_batch.bodies.grasp_set import GraspSet
from r2h_batch.bodies.hand import HandModel, HandSet, load_hand, load_hand_set, make_hand_set
from r2h_batch.bodies.hand_file import read_hand_set
from r2h_batch.bodies.mesh_import.build_ahead import build_ahead
from r2h_batch.bodies.objects import ObjectModel, build_object, load_objects
from r2h_batch.bodies.robot import load_robot
from r2h_batch.config import Thresholds, Workplace
from r2h_batch.importers.any_file import grasps_from, hand_from, without_gripper
from r2h_batch.io.read import FileError, path_within, printable, read_file, read_npy

__all__ = ["Only", "hand_of", "hand_set_of", "objects_of", "read_benchmark"]

MAX_FILE_BYTES = 1 << 30
MAX_LABELS_BYTES = 64 << 20

Only = frozenset[str] | None
"""Names of the meshes that are built; None: all."""


def read_benchmark(path: str | Path, *, pieces: bool = False, only: Only = None) -> Benchmark:
    """The benchmark of a file. `pieces`: its meshes get their convex decomposition (up to a minute
    each). `only`: names of the meshes that are built; of the others name and split are known
    (`benchmark.unbuilt`).

    Read once as long as neither it nor a file that it names changes. Raises `FileError` and
    `ObjectMeshError`, one line.
    """
    path = Path(path)
    file = read_file_model(path)
    digest = hashlib.sha256(read_file(path, MAX_FILE_BYTES))
    for field, name in _named(file):
        try:
            if "\\" in name and ":" not in name:
                raise FileError(f"{printable(name)!r}: has a backslash; write / between folders")
            digest.update(
                hashlib.sha256(read_file(path_within(path.parent, name), MAX_FILE_BYTES)).digest()
            )
        except FileError as error:
            raise FileError(f"{printable(path)}: {field}: {error}") from None
    return _read(str(path.resolve()), digest.hexdigest(), pieces, only)


@lru_cache(maxsize=8)
def _read(path: str, _: str, pieces: bool, only: Only) -> Benchmark:
    file, folder = read_file_model(Path(path)), Path(path).parent
    try:
        objects = objects_of(file.objects, folder, pieces, only)
        names = [o.name for o in objects]
        if twice := [n for n in names if names.count(n) > 1]:
            raise FileError(
                f"{printable(path)}: two objects are called {twice[0]!r}; give one of them another name"
            )
        hand_set, listed = _hands(file, folder), None
        if file.trials is not None:
            listed, hand_set = read_trials_file(path_within(folder, file.trials), objects, hand_set)
        limits = Thresholds(**file.thresholds.model_dump())
        return Benchmark(
            objects, hand_set, limits, _workplace(file, path), listed, file.protocol, file.receiver
        )
    except FileError:
        raise
    except ValueError as error:
        raise FileError(f"{printable(path)}: {printable(error)}") from None


def _named(file: BenchmarkFile) -> list[tuple[str, str]]:
    """(field, name) of the files that it reads, as it says them."""
    own = [
        (f"objects.{i}.{field}", name)
        for i, o in enumerate(file.objects)
        for field in ("file", "parts", "grasps", "receiver")
        if (name := _file_of(o, field)) is not None
    ]
    own += [("trials", file.trials)] if file.trials is not None else []
    hands = [(field, getattr(file, field)) for field in ("hand_model", "hand_set")]
    return own + [(field, name) for field, name in hands if name != BUILT_IN]


def _file_of(entry: ObjectEntry, field: str) -> str | None:
    """What an object's field names as a file; None where it names none."""
    said: str | None = getattr(entry, field)
    if said is None or (field == "receiver" and not said.endswith(".npy")):
        return None
    return str(without_gripper(said)[0]) if field == "grasps" else said


def _grasps(folder: Path, said: str) -> GraspSet:
    path, gripper = without_gripper(said)
    inside = path_within(folder, str(path))
    return grasps_from(f"{inside}:{gripper}" if gripper else inside)


def _workplace(file: BenchmarkFile, path: str) -> Workplace:
    robot = load_robot()
    for i, (q, low, high) in enumerate(zip(file.home, robot.lower, robot.upper, strict=True)):
        if not low <= q <= high:
            raise FileError(
                f"{printable(path)}: home.{i} is {q}; the robot's joint goes from {low:.4f} to {high:.4f} rad"
            )
    return Workplace(tuple(file.home), tuple(file.table.center), tuple(file.table.half))


def _hands(file: BenchmarkFile, folder: Path) -> HandSet:
    model = None if file.hand_model == BUILT_IN else hand_of(path_within(folder, file.hand_model))
    own = None if file.hand_set == BUILT_IN else path_within(folder, file.hand_set)
    return hand_set_of(own, model)


def hand_of(path: Path) -> HandModel:
    """The hand model of a file (`hand.npz`, or one of MANO's own); the same one as long as the file
    does not change."""
    return _hand(str(path), hashlib.sha256(read_file(path, MAX_FILE_BYTES)).hexdigest())


@lru_cache(maxsize=4)
def _hand(path: str, _: str) -> HandModel:
    return hand_from(Path(path))


def hand_set_of(path: Path | None, model: HandModel | None) -> HandSet:
    """The postures of a file (None: the built-in ones) on a hand (None: the built-in one)."""
    if path is None:
        return load_hand_set(None, model) if model is not None else load_hand_set()
    digest = hashlib.sha256(read_file(path, MAX_FILE_BYTES)).hexdigest()
    return _hand_set(str(path), digest, load_hand() if model is None else model)


@lru_cache(maxsize=4)
def _hand_set(path: str, _: str, model: HandModel) -> HandSet:
    a = read_hand_set(path)
    try:
        return make_hand_set(
            model, a["pose"], a["shape"], a["side"], a["posture"].tolist(), a["in_body"]
        )
    except ValueError as error:
        raise FileError(f"{printable(path)}: {printable(error)}") from None


def objects_of(
    entries: Sequence[ObjectEntry], folder: Path, pieces: bool, only: Only = None
) -> tuple[ObjectModel, ...]:
    """The objects of entries whose files lie in the folder or below; several meshes are built at a
    time, `only` those of these names unless None."""
    meshes = [e.file is not None and e.built_in is None for e in entries]
    names = [printable(e.name or Path(str(e.file)).stem) for e in entries]
    left = [
        mesh and only is not None and name not in only
        for mesh, name in zip(meshes, names, strict=True)
    ]
    build_ahead(
        [
            _own_call(e, folder, pieces)
            for e, mesh, out in zip(entries, meshes, left)
            if mesh and not out
        ]
    )
    return tuple(
        unbuilt(name, e.split or "S0") if out else _object(e, folder, pieces)
        for e, name, out in zip(entries, names, left, strict=True)
    )


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
    if entry.roles is not None and entry.roles != known_roles:
        _check_names(model, "roles", entry.roles, model.part_names)
        more["roles"] = dict(sorted(entry.roles.items()))
    if entry.words is not None:
        words = Thing(**{k: _tuples(v) for k, v in entry.words.model_dump().items()})
        if not entry.built_in or words != THINGS.get(model.name):
            _check_words(model, words)
            more["words"] = words
    return replace(model, **more) if more else model


def _tuples(value: Any) -> Any:
    """Lists made tuples, however deep, as `Thing` holds them."""
    if isinstance(value, dict):
        return {k: _tuples(v) for k, v in value.items()}
    return tuple(value) if isinstance(value, list) else value


def _check_names(model: ObjectModel, field: str, given: Any, allowed: Any) -> None:
    if unknown := [n for n in given if n not in allowed]:
        raise FileError(
            f"object {model.name}: {field} name {unknown[0]!r}; it has {', '.join(allowed)}"
        )


def _check_words(model: ObjectModel, words: Thing) -> None:
    for labels in words.parts.values():
        _check_names(model, "words.parts", labels, model.part_names)
    _check_names(model, "words.verbs", words.verbs.values(), list(words.parts))
    _check_names(model, "words.part_words", words.part_words, list(words.parts))


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
                f"object {model.name}: has no receiver's region for S1; give its mesh as a file with one"
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
