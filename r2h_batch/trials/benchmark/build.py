"""Benchmarks built from files and flags: a benchmark file with all files that it names, overrides by
flags, and the benchmark of a stored run. Files that a benchmark file names lie in its own folder."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.command_line import nearest
from r2h_batch.base.io.read import FileError, path_within, printable, read_file, read_npy
from r2h_batch.base.registry import (
    DEFAULT_PROTOCOL,
    PROTOCOL_NAMES,
    RELEASE,
    WITH_BODIES,
)
from r2h_batch.config import Workplace
from r2h_batch.data.grasp_files import GRASP_FILES, grasps_from, without_gripper
from r2h_batch.data.mano import hand_from
from r2h_batch.data.people import (
    WORDS,
    People,
    built_in_people,
    people_hand,
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
    call_of,
    load_objects,
    object_digest,
    object_from_argument,
    turned,
)
from r2h_batch.scene.robot import ROBOTS, Robot, load_robot, read_robot
from r2h_batch.scene.vocabulary import S0_ROLES, THINGS, Thing
from r2h_batch.trials.benchmark.benchmark import Benchmark, built_in
from r2h_batch.trials.benchmark.family_objects import (
    PREFIX,
    family_objects,
    family_splits,
    names_code,
)
from r2h_batch.trials.benchmark.flags import BenchmarkFlags, words_of
from r2h_batch.trials.benchmark.model import (
    BUILT_IN,
    BenchmarkFile,
    HandsEntry,
    ObjectEntry,
    read_benchmark_file,
    read_object_file,
)
from r2h_batch.trials.benchmark.trials_file import LISTED, read_trials_file

MAX_FILE_BYTES = 1 << 30
MAX_LABELS_BYTES = 64 << 20


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
    for field, name in _named(file):
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
        own = built_in(file.protocol)
        if "robot" in file.model_fields_set or "persons" in file.model_fields_set:
            built = file.robot in ROBOTS
            robot = robot_of(file.robot if built else str(path_within(folder, file.robot)))
            own = own.on(robot, file.persons)
        people = own.people if file.trials is None else None  # those of a trials file have no body
        if file.people is not None:
            people = _people(file.people, folder)
        hand_set, listed, labels = _hands(file, folder, own, people), None, None
        objects = own.objects  # take longer to read than hands: what is wrong there is said first
        if "objects" in file.model_fields_set:
            objects = objects_of(file.objects, folder, pieces)
        names = [o.name for o in objects]
        if twice := [n for n in names if names.count(n) > 1]:
            raise FileError(f"{shown}: two objects are called {twice[0]!r}; rename one of them")
        if file.trials is not None:
            path_of_trials = path_within(folder, file.trials)
            listed, hand_set, labels = read_trials_file(path_of_trials, objects, hand_set)
        return Benchmark(
            objects, hand_set, file.thresholds, _workplace(file, path, own), listed, labels,
            file.protocol, own.robot, own.persons, file.receiver, people,
        )  # fmt: skip
    except FileError:
        raise
    except ValueError as error:
        raise FileError(f"{shown}: {printable(error)}") from None


def _named(file: BenchmarkFile) -> list[tuple[str, str]]:
    """(field, name) of the files that it reads, as it says them."""
    own = [
        (f"objects.{i}.{field}", name)
        for i, o in enumerate(file.objects)
        for field in ("file", "parts", "grasps", "receiver")
        if (name := _file_of(o, field)) is not None
    ]
    own += [("trials", file.trials)] if file.trials is not None else []
    own += [("people", file.people)] if file.people is not None and file.people not in WORDS else []
    hands = [("hand_model", file.hand_model), *(("hand_set", e.file) for e in _hand_entries(file))]
    return own + [(field, name) for field, name in hands if name != BUILT_IN]


def _hand_entries(file: BenchmarkFile) -> list[HandsEntry]:
    """The hand sets that are joined."""
    entries = [file.hand_set] if isinstance(file.hand_set, str) else file.hand_set
    return [HandsEntry(file=e) if isinstance(e, str) else e for e in entries]


def _file_of(entry: ObjectEntry, field: str) -> str | None:
    """File that an object's field names; None where it names none."""
    name: str | None = getattr(entry, field)
    if name is None or (field == "receiver" and not name.endswith(".npy")):
        return None
    return str(without_gripper(name)[0]) if field == "grasps" else name


def _grasps(folder: Path, argument: str) -> GraspSet:
    path, gripper = without_gripper(argument)
    inside = path_within(folder, str(path))
    return grasps_from(f"{inside}:{gripper}" if gripper else inside)


def _workplace(file: BenchmarkFile, path: str, base: Benchmark) -> Workplace:
    robot, own = base.robot, base.workplace
    for i, (q, low, high) in enumerate(zip(file.home, robot.lower, robot.upper, strict=True)):
        if not low <= q <= high:
            raise FileError(
                f"{printable(path)}: home.{i} is {q}; the robot's joint goes from {low:.4f} to {high:.4f} rad"
            )
    home = tuple(file.home) if "home" in file.model_fields_set else own.home_q
    if "table" not in file.model_fields_set:
        return replace(own, home_q=home)
    return Workplace(home, tuple(file.table.center), tuple(file.table.half))


def robot_of(name: str) -> Robot:
    """A built-in robot by its name, or the robot of a folder."""
    if name in ROBOTS:
        return load_robot(name)
    if not Path(name).is_dir():
        how = f"allowed are {', '.join(ROBOTS)} and folders of r2h-batch import robot"
        raise FileError(f"no robot is called {printable(name)!r}; {how}")
    return read_robot(name)


def _people(name: str, folder: Path = Path()) -> People:
    """The built-in people of a word, or those of a file in the folder."""
    if name in WORDS:
        return built_in_people(name)
    if not name.lower().endswith(".csv"):
        how = f"allowed are {', '.join(WORDS)}, or a .csv of lengths"
        raise FileError(f"people is {printable(name)}{nearest(name, WORDS)}; {how}")
    return people_of(path_within(folder, name) if folder != Path() else Path(name))


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
        return neutral_hand_set(model) if own.drawn == RELEASE else hand_set_of(None, model)
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


MESHES = (".obj", ".stl", ".ply", ".off", ".glb")
MAX_FILES = 1000


@dataclass(frozen=True)
class BenchmarkOverrides(BenchmarkFlags):
    """Fields of a benchmark that flags change; empty for the built-in one."""

    protocol: str = ""
    receiver: Literal["", "hand", "body"] = ""

    @classmethod
    def of(cls, flags: BenchmarkFlags, *, protocol: str = "") -> BenchmarkOverrides:
        """The same flags, with `protocol` instead of the benchmark's."""
        return cls(**asdict(flags), protocol=protocol)

    def read(self, *, pieces: bool = False) -> Benchmark:
        """The benchmark; `pieces` as `read_benchmark` takes it.

        Raises:
            ValueError: one line, mostly a `FileError`.
        """
        base = built_in(self.protocol or DEFAULT_PROTOCOL)
        if self.benchmark:
            base = read_benchmark(self.benchmark, pieces=pieces)
        objects = _objects_of(self.objects, pieces) if self.objects else base.objects
        build_ahead([call_of(mesh, pieces=pieces) for mesh in self.object_mesh])
        more = (object_from_argument(mesh, pieces=pieces) for mesh in self.object_mesh)
        objects = (*objects, *more)
        objects = _with_grasps(objects, self.grasps)
        drawn, seen = self.protocol or base.drawn, self.receiver or base.receiver
        people, hands = _receivers(base, drawn)
        people = _people(self.people) if self.people else people
        hand_set = self._hand_set(hands)
        if self.people and people is not None and not (self.hands or self.hand_model):
            hand_set = people_hand_set(people)
        other = objects != base.objects or hand_set is not base.hand_set
        listed, labels = base.listed, base.labels
        if self.trials_file:
            listed, hand_set, labels = read_trials_file(Path(self.trials_file), objects, hand_set)
            people = people if self.people else None
        elif listed is not None and other:
            how = "lists trials of its own objects and hands; give --trials-file too"
            raise FileError(f"{printable(self.benchmark)}: {how}")
        if self.protocol and listed is not None:
            how = "draws trials, and these are listed; give one of the two"
            raise FileError(f"--protocol {self.protocol} {how}")
        bodies = drawn in WITH_BODIES if listed is None else listed.receiver is not None
        if seen == "body" and not bodies:
            named = "listed trials without receiver" if listed is not None else f"trials of {drawn}"
            how = f"take --protocol {' or '.join(WITH_BODIES)}, or --receiver hand"
            raise FileError(f"--receiver body: {named} have no body; {how}")
        if people is not None and (listed is not None or drawn not in WITH_BODIES):
            named = "listed trials" if listed is not None else f"trials of {drawn}"
            how = f"take --protocol {' or '.join(WITH_BODIES)}, or leave people out"
            raise FileError(f"people {printable(people.name)}: {named} have no body; {how}")
        changed = (drawn, seen, people) != (base.drawn, base.receiver, base.people)
        if other or listed is not base.listed or changed:
            base = replace(
                base, objects=objects, hand_set=hand_set, listed=listed, labels=labels, drawn=drawn,
                receiver=seen, people=people,
            )  # fmt: skip
        persons = self.persons or base.persons
        if self.robot or persons != base.persons:
            base = base.on(robot_of(self.robot) if self.robot else base.robot, persons)
        return in_frame(base, self.turn) if self.turn else base

    def said_splits(self) -> set[str]:
        """The splits of the objects that flags and files name, before any mesh is read; empty where they
        name none, or list trials."""
        path = Path(self.objects or self.benchmark)
        if self.trials_file or not (self.objects or self.benchmark):
            return set()
        if self.objects.startswith(PREFIX):
            return family_splits(self.objects)
        file = _file_in(path)
        if file is None:
            entries = [_entry(mesh) for mesh in _files(path, MESHES)] if path.is_dir() else []
        else:
            file_data = read_benchmark_file(file)
            listed = file_data.trials and not self.objects
            if "objects" not in file_data.model_fields_set or listed:
                return set()
            entries = file_data.objects
        own = {e: load_objects([e])[0].split for e in {e.built_in for e in entries} if e}
        there = {e.split or own.get(e.built_in or "", "S0") for e in entries}
        return there | {str(call_of(m)["split"]) for m in self.object_mesh} if there else there

    def _hand_set(self, base: HandSet) -> HandSet:
        """The hand set of --hands on the hand of --hand-model, each else as in `base`."""
        if not (self.hands or self.hand_model):
            return base
        if base.model is people_hand():  # what shapes of files and of this hand mean differs
            base = load_hand_set()
        model = hand_of(Path(self.hand_model)) if self.hand_model else base.model
        if self.hands:
            return hand_set_of([(Path(self.hands), HandChoice())], model)
        a = {k: getattr(base, k).numpy() for k in ("pose", "shape", "side")}
        turned = None if base.in_body is None else base.in_body.numpy()
        return make_hand_set(model, **a, posture=base.posture, in_body=turned)


def _receivers(base: Benchmark, drawn: str) -> tuple[People | None, HandSet]:
    """People and hands of a benchmark whose trials another protocol may draw: that one's, where they were its own's."""
    own, new = built_in(base.drawn), built_in(drawn)
    if base.people is not own.people or own.people is new.people:
        return base.people, base.hand_set
    return new.people, new.hand_set if base.hand_set is own.hand_set else base.hand_set


def _objects_of(text: str, pieces: bool) -> tuple[ObjectModel, ...]:
    """Objects of a benchmark file, or of a folder (its benchmark.yaml, else every mesh in it), or new instances of
    families."""
    if text.startswith(PREFIX):
        return family_objects(text)
    path = Path(text)
    file, shown = _file_in(path), printable(path)
    if file is not None:
        return read_benchmark(file, pieces=pieces).objects
    if not path.is_dir():
        how = "takes a folder of meshes, a benchmark.yaml or families:CATEGORY,...; one mesh: --object-mesh FILE"
        raise FileError(
            f"{shown}: {'' if path.exists() else 'there is no such folder or file; '}--objects {how}"
        )
    meshes = _files(path, MESHES)
    if not meshes:
        raise FileError(f"{shown}: no mesh ({', '.join(MESHES)}) and no benchmark.yaml here")
    about = {mesh.with_suffix(".yaml").name for mesh in meshes}
    for name in sorted(os.listdir(path)):  # a misspelt name would be ignored otherwise
        if name.lower().endswith((".yaml", ".yml")) and name not in about:
            how = "is about no mesh of this folder; MESH.yaml goes with MESH.obj"
            raise FileError(f"{printable(path / name)}: {how}")
    return objects_of([_entry(mesh) for mesh in meshes], path, pieces)


def _file_in(path: Path) -> Path | None:
    """The benchmark file that a path names or has in it; None: a folder of meshes, or neither."""
    file = path / "benchmark.yaml" if path.is_dir() else path
    known = file.suffix.lower() in (".yaml", ".yml") and (file == path or file.exists())
    return file if known else None


def _entry(file: Path) -> ObjectEntry:
    """The entry of a mesh in a folder, with the fields of NAME.yaml beside it."""
    yaml_file = file.with_suffix(".yaml")
    if not os.path.lexists(yaml_file):
        return ObjectEntry(file=file.name)
    return read_object_file(path_within(file.parent, yaml_file.name), file.name)


def _files(folder: Path, endings: Sequence[str]) -> list[Path]:
    """Files with these endings in a folder, by name, without links."""
    found = [f for f in sorted(folder.iterdir()) if f.suffix.lower() in endings]
    found = [f for f in found if f.is_file() and not f.is_symlink()]
    if len(found) > MAX_FILES:
        raise FileError(f"{printable(folder)}: {len(found)} files; at most {MAX_FILES} are allowed")
    return found


def _with_grasps(
    objects: Sequence[ObjectModel], arguments: Sequence[str]
) -> tuple[ObjectModel, ...]:
    """The objects, with the candidates of the files of --grasps: one file for an object."""
    files: dict[str, str | Path] = {}
    for argument in arguments:
        for name, file in _grasp_files([o.name for o in objects], argument):
            if name in files:
                both = f"{printable(files[name])} and {printable(file)}"
                raise FileError(
                    f"--grasps gives {printable(name)} two files, {both}; leave one out"
                )
            files[name] = file
    found = {name: grasps_from(file) for name, file in files.items()}
    return tuple(replace(o, grasps=found[o.name]) if o.name in found else o for o in objects)


def _grasp_files(names: Sequence[str], argument: str) -> list[tuple[str, str | Path]]:
    """(object, file) of `NAME=FILE`, of a file called after its object, or of a folder of these."""
    shown, path = f"--grasps {printable(argument)}", Path(argument)
    name, equals, rest = argument.partition("=")
    named = bool(equals) and name in names
    if not argument or (named and not rest):
        raise FileError(f"--grasps {printable(argument)!r} names no file; say NAME=FILE")
    files: list[tuple[str, str | Path]] = [(without_gripper(argument)[0].stem, argument)]
    if named:
        files = [(name, rest)]
    elif path.is_dir():
        files = [(f.stem, f) for f in _files(path, GRASP_FILES)]
        if not files:
            raise FileError(
                f"{printable(path)}: no grasps ({', '.join(GRASP_FILES)}) in this folder"
            )
    if unknown := [n for n, _ in files if n not in names]:
        wrong = name if equals else unknown[0]
        same = [n for n in names if n.lower() == wrong.lower()]
        hint = f", did you mean {same[0]}?" if same else nearest(wrong, names)
        how = f"say NAME=FILE, the objects are {', '.join(names[:40])}"
        raise FileError(f"{shown}: no object is called {printable(wrong)!r}{hint}; {how}")
    return files


FRAMES = {
    "half": np.diag([-1.0, -1.0, 1.0]),
    "cycled": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}
"""Turn -> R_new_old of the objects' frames."""


def frame_of(turn: str) -> NDArray[np.float64]:
    """R_new_old (3, 3) of a turn of the objects' frames.

    Args:
        turn: a word of `registry.TURNS`, or angles about the fixed axes x, y and z, in this order, degrees: `20,40,60`.

    Raises:
        FileError: neither.
    """
    if turn in FRAMES:
        return FRAMES[turn]
    try:
        angles = np.array([float(angle) for angle in turn.split(",")])
    except ValueError:
        angles = np.array([])
    if len(angles) != 3 or not (np.abs(angles) <= 360).all():
        raise FileError(
            f"{printable(turn)[:100]!r} is no turn: give {', '.join(FRAMES)}, or degrees about x, y and z, from -360 to 360, as"
            " 20,40,60"
        )
    from scipy.spatial.transform import Rotation  # 0.4 s: only angles need it

    return np.asarray(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())


def in_frame(benchmark: Benchmark, turn: str) -> Benchmark:
    """The same benchmark with every object in a turned frame: the same trials for a method that does
    not depend on how a mesh lies.

    Args:
        benchmark: any.
        turn: as `frame_of`.
    """
    R = frame_of(turn)
    return replace(benchmark, objects=tuple(turned(o, R) for o in benchmark.objects))


def benchmark_of_run(header: Mapping[str, Any], given: BenchmarkOverrides, where: str) -> Benchmark:
    """The benchmark of a stored run.

    Its files are those that the user gives, or else those that run.json names, where they still are: in the
    run folder, or as the sweep was given them. A run folder may come from anybody, so digests decide: other
    files are refused, and no code is imported.

    Args:
        header: run.json.
        given: the flags; none: those of the sweep.
        where: the run folder.

    Raises:
        FileError: the flags give another benchmark; the message says what to give.
    """
    protocol, digests = header["protocol"], header["digests"]
    if protocol not in (*PROTOCOL_NAMES, LISTED):
        known = f"this version makes the trials of {', '.join(PROTOCOL_NAMES)}"
        raise FileError(f"{where}: protocol {protocol!r}; {known}")
    said = _said(header)
    if not replace(given, protocol="", receiver="", turn="").flags():
        given = _found(said, Path(where)) or given
    if said.robot in ROBOTS and not given.robot:  # a built-in robot is no file
        given = replace(given, robot=said.robot)
    if said.turn:  # nor is a turn
        given = replace(given, turn=said.turn)
    flags = _check_flags(header, given, where)
    if protocol != LISTED:
        given = replace(given, protocol=protocol)
    if header["configuration"].get("receiver") == "body":
        given = replace(given, receiver="body")
    pieces = header["configuration"]["plan"]["object_collision"] == "pieces"
    benchmark = given.read(pieces=pieces)
    found = {"objects": object_digest(benchmark.objects), "hand_set": benchmark.hand_set.digest}
    if "benchmark" in digests:  # older runs lack it
        found["benchmark"] = benchmark.digest
    differing = [k for k, v in found.items() if digests.get(k) != v]
    pairs = zip(header.get("objects", ()), benchmark.objects, strict=False)
    if other := [o.name for entry, o in pairs if entry.get("digest", "") != object_digest(o)]:
        differing = [
            f"objects ({', '.join(other[:10])})" if k == "objects" else k for k in differing
        ]
    if differing:
        files = f"; its sweep was given {flags}" if flags else ""
        version = f"{header['versions'].get('r2h_batch')} at commit {header.get('git_commit')}"
        how = f"take the same files, and r2h_batch {version}"
        raise FileError(f"{where}: was made with other {', '.join(differing)}{files}; {how}")
    return benchmark


def _said(header: Mapping[str, Any]) -> BenchmarkOverrides:
    """The flags of the run's sweep as run.json has them, without protocol and receiver."""
    pairs = [f[2:].partition(" ") for f in (header.get("benchmark") or {}).get("flags", ())]
    known = {
        f.name: f for f in fields(BenchmarkOverrides) if f.name not in ("protocol", "receiver")
    }
    lists = {name for name, field in known.items() if field.default == ()}
    said: dict[str, Any] = {k.replace("-", "_"): v for k, _, v in pairs}
    values: dict[str, Any] = {}
    for name, text in said.items():
        words = words_of(text)
        if name in lists:
            values[name] = tuple(words)
        elif name in known:  # older versions wrote one with spaces without quotes
            values[name] = words[0] if len(words) == 1 else text
    return BenchmarkOverrides(**values)


def _found(said: BenchmarkOverrides, run: Path) -> BenchmarkOverrides | None:
    """The same flags with each file where it is now; None where one is not found, or there are none."""
    if not said.flags():
        return None
    bases = (Path(), *run.resolve().parents)

    def place(name: str) -> str | None:
        last = Path(name).parts[-2:]
        if len(last) == 2 and ".." not in last and run.joinpath(*last).exists():
            return str(run.joinpath(*last))  # what a sweep imported lies in its run folder
        return next((str(base / name) for base in bases if (base / name).exists()), None)

    def of(name: str, value: str) -> str | None:
        if (
            name in ("persons", "turn")
            or (name == "people" and value in WORDS)
            or (name == "robot" and value in ROBOTS)
            or (value.startswith(PREFIX) and not names_code(value))
        ):
            return value
        if names_code(value):  # the user says again that it may run
            return None
        if name == "object_mesh":  # FILE[:SPLIT[:REGION]]
            file, sign, rest = value.partition(":")
        elif name == "grasps":  # NAME=FILE
            rest, sign, file = value.rpartition("=")
        else:
            file, sign, rest = value, "", ""
        if (at := place(file)) is None:
            return None
        return rest + sign + at if name == "grasps" else at + sign + rest

    values = {name: value for name, value in asdict(said).items() if value}
    placed: dict[str, Any] = {
        name: tuple(of(name, v) for v in value) if isinstance(value, tuple) else of(name, value)
        for name, value in values.items()
    }
    lost = any(v is None or (isinstance(v, tuple) and None in v) for v in placed.values())
    return None if lost else BenchmarkOverrides(**placed)


def _check_flags(header: Mapping[str, Any], given: BenchmarkOverrides, where: str) -> str:
    """The flags of the run's sweep, without protocol and receiver, which run.json says itself.

    Raises:
        FileError: others are given.
    """
    if "benchmark" not in header:  # an older run
        own = [o["name"] for o in header.get("objects", []) if not o["built_in"]]
        if len(given.object_mesh) != len(own):
            how = f"{', '.join(own) or 'none'}; give their --object-mesh as in the sweep"
            raise FileError(f"{where}: has the user's objects {how}")
        return ""
    flags = header["benchmark"]["flags"]
    flags = [f for f in flags if not f.startswith(("--protocol ", "--receiver "))]
    if {f.split()[0] for f in flags} != {f.split()[0] for f in given.flags()}:
        how = " ".join(flags) or "no flag for objects or hands"
        raise FileError(f"{where}: give what its sweep was given: {how}")
    return " ".join(flags)
