"""A benchmark with what a command line changes: other objects, hands, people, trials, another robot, turned frames."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import path_within, printable
from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.base.validate import parse_number
from r2h_batch.data.grasp_files import GRASP_FILES, grasps_from, without_gripper
from r2h_batch.data.people import people_hand, people_hand_set
from r2h_batch.scene.build_ahead import build_ahead
from r2h_batch.scene.hand import HandModel, HandSet, load_hand_set, make_hand_set
from r2h_batch.scene.hand_file import HandChoice
from r2h_batch.scene.objects import (
    ObjectModel,
    call_of,
    check_call,
    load_objects,
    object_from_argument,
    turned,
)
from r2h_batch.trials.benchmark import WITH_PEOPLE, Benchmark
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.family_objects import PREFIX, family_objects, family_splits
from r2h_batch.trials.file_fields import ObjectEntry, read_benchmark_file, read_object_file
from r2h_batch.trials.load import load_benchmark
from r2h_batch.trials.registry import BENCHMARK
from r2h_batch.trials.trials_file import read_trials_file
from r2h_batch.trials.yaml_file import (
    hand_of,
    hand_set_of,
    objects_of,
    people_of_word,
    read_benchmark,
    robot_of,
)

MESHES = (".obj", ".stl", ".ply", ".off", ".glb")
MAX_FILES = 1000


def edited(choice: BenchmarkChoice, *, pieces: bool = False) -> Benchmark:
    """The benchmark that a command line chooses, with its changes.

    Args:
        choice: the words of the command line.
        pieces: as `load_benchmark` takes it.

    Raises:
        ValueError: one line, mostly a `FileError`.
    """
    robot = robot_of(choice.robot) if choice.robot else None  # words first: to load takes seconds
    calls = added_calls(choice, pieces=pieces)
    base = load_benchmark(choice.benchmark or DEFAULT_BENCHMARK, pieces=pieces)
    if choice.until:
        base = base.until(choice.until)
    objects = _objects_of(choice.objects, pieces) if choice.objects else base.objects
    for beside in (Path(call["mesh"]).with_suffix(".yaml") for call in calls):
        if beside.is_file():
            LOG.info(
                f"{printable(beside)} is not read: --object-mesh takes a mesh alone; --objects FOLDER takes both"
            )
    build_ahead(calls)
    more = (object_from_argument(mesh, pieces=pieces) for mesh in choice.object_mesh)
    objects = _with_grasps((*objects, *more), choice.grasps)
    receiver, people = choice.receiver or base.receiver, base.people
    if choice.people:
        people = people_of_word(choice.people)
    hand_set = _hand_set(choice, base.hand_set)
    if choice.people and people is not None and not (choice.hands or choice.hand_model):
        hand_set = people_hand_set(people)
    other = objects != base.objects or hand_set is not base.hand_set
    listed, labels = base.listed, base.labels
    if choice.trials_file:
        listed, hand_set, labels = read_trials_file(Path(choice.trials_file), objects, hand_set)
        people = people if choice.people else None
        receiver = choice.receiver or ("hand" if listed.receiver is None else base.receiver)
    elif listed is not None and other:
        how = "lists trials of its own objects and hands; give --trials-file too"
        raise FileError(f"{printable(choice.benchmark)}: {how}")
    bodies = base.rule.bodies if listed is None else listed.receiver is not None
    how = f"take --benchmark {WITH_PEOPLE}"
    if receiver == "body" and not bodies:
        named = "listed trials without receiver" if listed is not None else f"trials of {base.name}"
        raise FileError(f"--receiver body: {named} have no body; {how}, or --receiver hand")
    if people is not None and (listed is not None or not bodies):
        named = "listed trials" if listed is not None else f"trials of {base.name}"
        raise FileError(
            f"people {printable(people.name)}: {named} have no body; {how}, or leave people out"
        )
    if other or listed is not base.listed or (receiver, people) != (base.receiver, base.people):
        base = replace(
            base, objects=objects, hand_set=hand_set, listed=listed, labels=labels, receiver=receiver, people=people,
            head_clearance_m=base.head_clearance_m if receiver == "body" else 0.0,
        )  # fmt: skip
    persons = choice.persons or base.persons
    if robot is not None or persons != base.persons:
        base = base.on(base.robot if robot is None else robot, persons)
    return in_frame(base, choice.turn) if choice.turn else base


def added_calls(choice: BenchmarkChoice, *, pieces: bool = False) -> list[dict[str, Any]]:
    """The arguments of `build_object` of each --object-mesh.

    Raises:
        ValueError: one line, where the text is enough to tell; no mesh is read.
    """
    calls = [call_of(mesh, pieces=pieces) for mesh in choice.object_mesh]
    for call in calls:
        check_call(call)
    return calls


def said_splits(choice: BenchmarkChoice) -> set[str]:
    """The splits of the objects that flags and files name, before any mesh is read; empty where they
    name none, or list trials."""
    named = "" if choice.benchmark in BENCHMARK or ":" in choice.benchmark else choice.benchmark
    path = Path(choice.objects or named)
    if choice.trials_file or not (choice.objects or named):
        return set()
    if choice.objects.startswith(PREFIX):
        return family_splits(choice.objects)
    file = file_in(path)
    if file is None:
        entries = [mesh_entry(mesh) for mesh in files_in(path, MESHES)] if path.is_dir() else []
    else:
        file_data = read_benchmark_file(file)
        listed = file_data.trials and not choice.objects
        if not file_data.objects or listed:
            return set()
        entries = file_data.objects
    own = {e: load_objects([e])[0].split for e in {e.built_in for e in entries} if e}
    there = {e.split or own.get(e.built_in or "", "S0") for e in entries}
    return there | {str(call_of(m)["split"]) for m in choice.object_mesh} if there else there


def _hand_set(choice: BenchmarkChoice, base: HandSet) -> HandSet:
    """The hand set of --hands on the hand of --hand-model, each else as in `base`."""
    if not (choice.hands or choice.hand_model):
        return base
    if base.model is people_hand():  # what shapes of files and of this hand mean differs
        base = load_hand_set()
    model = hand_of(Path(choice.hand_model)) if choice.hand_model else base.model
    if choice.hands:
        return hand_set_of([(Path(choice.hands), HandChoice())], model)
    return _on_hand(base, model)


def _on_hand(base: HandSet, model: HandModel) -> HandSet:
    """The postures of a hand set on another hand."""
    a = {k: getattr(base, k).numpy() for k in ("pose", "shape", "side")}
    turned = None if base.in_body is None else base.in_body.numpy()
    return make_hand_set(model, **a, posture=base.posture, in_body=turned)


def _objects_of(text: str, pieces: bool) -> tuple[ObjectModel, ...]:
    """Objects of a benchmark file, or of a folder (its benchmark.yaml, else every mesh in it), or new instances of
    families."""
    if text.startswith(PREFIX):
        return family_objects(text)
    path = Path(text)
    file, shown = file_in(path), printable(path)
    if file is not None:
        return read_benchmark(file, pieces=pieces).objects
    if not path.is_dir():
        how = "takes a folder of meshes, a benchmark.yaml or families:CATEGORY,...; one mesh: --object-mesh FILE"
        raise FileError(
            f"{shown}: {'' if path.exists() else 'there is no such folder or file; '}--objects {how}"
        )
    meshes = files_in(path, MESHES)
    if not meshes:
        raise FileError(f"{shown}: no mesh ({', '.join(MESHES)}) and no benchmark.yaml here")
    about = {mesh.with_suffix(".yaml").name for mesh in meshes}
    for name in sorted(os.listdir(path)):  # a misspelt name would be ignored otherwise
        if name.lower().endswith((".yaml", ".yml")) and name not in about:
            how = "is about no mesh of this folder; MESH.yaml goes with MESH.obj"
            raise FileError(f"{printable(path / name)}: {how}")
    return objects_of([mesh_entry(mesh) for mesh in meshes], path, pieces)


def file_in(path: Path) -> Path | None:
    """The benchmark file that a path names or has in it; None: a folder of meshes, or neither."""
    file = path / "benchmark.yaml" if path.is_dir() else path
    known = file.suffix.lower() in (".yaml", ".yml") and (file == path or file.exists())
    return file if known else None


def mesh_entry(file: Path) -> ObjectEntry:
    """The entry of a mesh in a folder, with the fields of NAME.yaml beside it."""
    yaml_file = file.with_suffix(".yaml")
    if not os.path.lexists(yaml_file):
        return ObjectEntry(file=file.name)
    return read_object_file(path_within(file.parent, yaml_file.name), file.name)


def files_in(folder: Path, endings: Sequence[str]) -> list[Path]:
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
        files = [(f.stem, f) for f in files_in(path, GRASP_FILES)]
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
        FileError: neither, or the angles turn nothing.
    """
    if turn in FRAMES:
        return FRAMES[turn]
    try:
        angles = np.array([parse_number(angle) for angle in turn.split(",")])
    except ValueError:
        angles = np.array([])
    if len(angles) != 3 or not (np.abs(angles) <= 360).all():
        raise FileError(
            f"{printable(turn)[:100]!r} is no turn: give {', '.join(FRAMES)}, or degrees about x, y and z, from -360 to 360, as"
            " 20,40,60"
        )
    from scipy.spatial.transform import Rotation  # 0.4 s: only angles need it

    R = np.asarray(Rotation.from_euler("xyz", angles, degrees=True).as_matrix())
    if np.allclose(R, np.eye(3), atol=1e-6):
        raise FileError(f"{turn!r} turns nothing; give other degrees")
    return R


def in_frame(benchmark: Benchmark, turn: str) -> Benchmark:
    """The same benchmark with every object in a turned frame: the same trials for a method that does
    not depend on how a mesh lies.

    Args:
        benchmark: any.
        turn: as `frame_of`.
    """
    R = frame_of(turn)
    return replace(benchmark, objects=tuple(turned(o, R) for o in benchmark.objects))
