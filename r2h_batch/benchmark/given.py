"""A benchmark out of flags: a file, or the built-in one, with other hands, objects or grasps."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from r2h_batch.benchmark.benchmark import WITH_BODIES, Benchmark, built_in
from r2h_batch.benchmark.file import ObjectEntry, read_entry
from r2h_batch.benchmark.flags import BenchmarkFlags
from r2h_batch.benchmark.reading import Only, hand_of, hand_set_of, objects_of, read_benchmark
from r2h_batch.benchmark.trials_file import read_trials_file
from r2h_batch.benchmark.unbuilt import is_unbuilt, unbuilt
from r2h_batch.bodies.hand import make_hand_set
from r2h_batch.bodies.mesh_import.build_ahead import build_ahead
from r2h_batch.bodies.objects import ObjectModel, call_of, object_from_argument
from r2h_batch.command_line import nearest
from r2h_batch.importers.any_file import GRASP_FILES, grasps_from, without_gripper
from r2h_batch.io.read import FileError, path_within, printable

__all__ = ["Given"]

MESHES = (".obj", ".stl", ".ply", ".off", ".glb")
MAX_FILES = 1000


@dataclass(frozen=True)
class Given(BenchmarkFlags):
    """What flags say of the benchmark; empty: the built-in one."""

    protocol: str = ""
    receiver: Literal["", "hand", "body"] = ""

    @classmethod
    def of(cls, flags: BenchmarkFlags, *, protocol: str = "") -> Given:
        """The same flags, ready to be read; `protocol` instead of the benchmark's."""
        return cls(**asdict(flags), protocol=protocol)

    def read(self, *, pieces: bool = False, only: Only = None) -> Benchmark:
        """The benchmark. `pieces`: meshes get their convex decomposition. `only`: names of the
        meshes that are built; of the others name and split are known (`benchmark.unbuilt`). Raises
        ValueError (`FileError`), one line."""
        base = (
            read_benchmark(self.benchmark, pieces=pieces, only=only)
            if self.benchmark
            else built_in()
        )
        objects = _objects_of(Path(self.objects), pieces, only) if self.objects else base.objects
        objects = (*objects, *_own_meshes(self.object_mesh, pieces, only))
        objects = _with_grasps(objects, self.grasps)
        hand_set = base.hand_set
        model = hand_of(Path(self.hand_model)) if self.hand_model else None
        if self.hands:
            hand_set = hand_set_of(Path(self.hands), hand_set.model if model is None else model)
        elif model is not None:
            a = {k: getattr(hand_set, k).numpy() for k in ("pose", "shape", "side")}
            turned = None if hand_set.in_body is None else hand_set.in_body.numpy()
            hand_set = make_hand_set(model, **a, posture=hand_set.posture, in_body=turned)
        other = objects != base.objects or hand_set is not base.hand_set
        listed = base.listed
        if self.trials_file:
            listed, hand_set = read_trials_file(Path(self.trials_file), objects, hand_set)
        elif listed is not None and other:
            raise FileError(
                f"{printable(self.benchmark)}: lists trials of its own objects and hands; give --trials-file too"
            )
        if self.protocol and listed is not None:
            raise FileError(
                f"--protocol {self.protocol} draws trials, and these are listed; give one of the two"
            )
        drawn, seen = self.protocol or base.drawn, self.receiver or base.receiver
        if seen == "body" and (listed is not None or drawn != WITH_BODIES):
            named = "listed trials" if listed is not None else f"trials of {drawn}"
            raise FileError(
                f"--receiver body: {named} have no body; take --protocol {WITH_BODIES}, or --receiver hand"
            )
        if not other and listed is base.listed and (drawn, seen) == (base.drawn, base.receiver):
            return base
        return replace(
            base, objects=objects, hand_set=hand_set, listed=listed, drawn=drawn, receiver=seen
        )


def _own_meshes(arguments: Sequence[str], pieces: bool, only: Only) -> list[ObjectModel]:
    """The objects of --object-mesh, several built at a time."""
    calls = [call_of(mesh, pieces=pieces) for mesh in arguments]
    names = [printable(Path(call["mesh"]).stem) for call in calls]
    wanted = [only is None or name in only for name in names]
    build_ahead([call for call, built in zip(calls, wanted, strict=True) if built])
    return [
        object_from_argument(argument, pieces=pieces) if built else unbuilt(name, call["split"])
        for argument, call, name, built in zip(arguments, calls, names, wanted, strict=True)
    ]


def _objects_of(path: Path, pieces: bool, only: Only) -> tuple[ObjectModel, ...]:
    """Objects of a benchmark file, or of a folder: its benchmark.yaml, else every mesh in it, by
    name."""
    if path.is_dir():
        if (path / "benchmark.yaml").exists():
            return read_benchmark(path / "benchmark.yaml", pieces=pieces, only=only).objects
        files = _files(path, MESHES)
        if not files:
            raise FileError(
                f"{printable(path)}: no mesh ({', '.join(MESHES)}) and no benchmark.yaml in this folder"
            )
        _no_stray_words(path, files)
        return objects_of([_entry(file) for file in files], path, pieces, only)
    if path.suffix.lower() in (".yaml", ".yml"):
        return read_benchmark(path, pieces=pieces, only=only).objects
    raise FileError(
        f"{printable(path)}: --objects takes a folder of meshes or a benchmark.yaml; one mesh: --object-mesh FILE"
    )


def _no_stray_words(folder: Path, meshes: Sequence[Path]) -> None:
    """A file of words that is about no mesh is a slip: what it says would be passed over without a
    word."""
    about = {mesh.with_suffix(".yaml").name for mesh in meshes}
    for name in sorted(os.listdir(folder)):
        if name.lower().endswith((".yaml", ".yml")) and name not in about:
            raise FileError(
                f"{printable(folder / name)}: is about no mesh of this folder; MESH.yaml goes with MESH.obj"
            )


def _entry(file: Path) -> ObjectEntry:
    """What a folder says of a mesh in it: NAME.yaml beside it holds the fields of a benchmark's
    object, if it is there."""
    beside = file.with_suffix(".yaml")
    if not os.path.lexists(beside):
        return ObjectEntry(file=file.name)
    return read_entry(path_within(file.parent, beside.name), file.name)


def _files(folder: Path, endings: Sequence[str]) -> list[Path]:
    """Files of these kinds in a folder, by name; links are left alone."""
    found = sorted(
        p
        for p in folder.iterdir()
        if p.suffix.lower() in endings and p.is_file() and not p.is_symlink()
    )
    if len(found) > MAX_FILES:
        raise FileError(f"{printable(folder)}: {len(found)} files; at most {MAX_FILES} are allowed")
    return found


def _with_grasps(
    objects: Sequence[ObjectModel], arguments: Sequence[str]
) -> tuple[ObjectModel, ...]:
    """The objects, with the candidates of the files that are given for them: one file for an
    object."""
    files: dict[str, str | Path] = {}
    for argument in arguments:
        for name, file in _grasp_files([o.name for o in objects], argument):
            if name in files:
                raise FileError(
                    f"--grasps gives {printable(name)} two files, {printable(files[name])} and {printable(file)}; leave one out"
                )
            files[name] = file
    return tuple(
        replace(o, grasps=grasps_from(files[o.name]))
        if o.name in files and not is_unbuilt(o)
        else o
        for o in objects
    )


def _grasp_files(names: Sequence[str], argument: str) -> list[tuple[str, str | Path]]:
    """(object, file) of `NAME=FILE`, of a file called after its object, or of a folder of these."""
    path, (name, equals, rest) = Path(argument), argument.partition("=")
    files: list[tuple[str, str | Path]]
    if not argument or (equals and name in names and not rest):
        raise FileError(f"--grasps {printable(argument)!r} names no file; say NAME=FILE")
    if equals and name in names:
        files = [(name, rest)]
    elif path.is_dir():
        files = [(f.stem, f) for f in _files(path, GRASP_FILES)]
        if not files:
            raise FileError(
                f"{printable(path)}: no grasps ({', '.join(GRASP_FILES)}) in this folder"
            )
    else:
        files = [(without_gripper(argument)[0].stem, argument)]
    if unknown := [n for n, _ in files if n not in names]:
        known, said = f"the objects are {', '.join(names[:40])}", name if equals else unknown[0]
        close = next(
            (f", did you mean {n}?" for n in names if n.lower() == said.lower()),
            nearest(said, names),
        )
        raise FileError(
            f"--grasps {printable(argument)}: no object is called {printable(said)!r}{close}; say NAME=FILE, {known}"
        )
    return files
