"""The files of a run's benchmark in its folder: a sweep copies them there, whoever opens the run finds them.

RUN/benchmark/benchmark.yaml        the benchmark file, with what it names beside it
RUN/benchmark/FLAG/FILE             what another flag names: a file, or a folder

A hand model is not copied (MANO's licence forbids to pass on what is made of it), nor is what is too large. Those are read where
the sweep found them, or where somebody has put them in the run folder.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import path_within, printable, read_json
from r2h_batch.base.io.write import atomic_path
from r2h_batch.data.grasp_files import GRASP_FILES, without_gripper
from r2h_batch.data.people import WORDS
from r2h_batch.runs.files import drop_remains, sha256_of, sync_file
from r2h_batch.runs.header import BENCHMARK_FILES
from r2h_batch.scene.objects import call_of
from r2h_batch.scene.robot_file import ROBOTS
from r2h_batch.trials.choice import BenchmarkChoice
from r2h_batch.trials.edit import MESHES, file_in, files_in, mesh_entry
from r2h_batch.trials.family_objects import PREFIX, code_of
from r2h_batch.trials.file_fields import read_benchmark_file
from r2h_batch.trials.load import names_function
from r2h_batch.trials.registry import BENCHMARK
from r2h_batch.trials.yaml_file import OF_OBJECT, file_of, named_files

MOST_FILE_BYTES = 64 << 20
MOST_BYTES = 256 << 20
"""Of one file, and of all: a run folder stays one that can be handed over."""
MOST_GLTF_BYTES = 64 << 20
NOT_PASSED_ON = "a hand model, whose licence may forbid to pass it on"
HAND_MODEL = "hand_model"

Place = Callable[[str, str, str], str]
"""(flag's name, file, its place in a run folder) -> what stands for the file."""


@dataclass(frozen=True)
class RunFiles:
    """The files of a benchmark.

    Attributes:
        copied: place in the run folder -> file.
        left_out: what stays where it is, as run.json has it: file, place, bytes, sha256 and why.
    """

    copied: Mapping[str, Path]
    left_out: tuple[Mapping[str, Any], ...]

    def copy_into(self, run: Path) -> None:
        """Copies the files, each whole or not at all; one that is there with the same content stays.

        Args:
            run: the run folder.
        """
        for place, file in self.copied.items():
            to = run / place
            drop_remains(to.parent)
            if to.is_file() and sha256_of(to) == sha256_of(file):
                continue
            with atomic_path(to) as temporary:
                shutil.copyfile(file, temporary)
                sync_file(temporary)

    def changed(self, run: Path) -> list[str]:
        """The files that are in a run folder with another content.

        Args:
            run: the run folder.
        """
        return [
            str(file)
            for place, file in self.copied.items()
            if (run / place).is_file() and sha256_of(run / place) != sha256_of(file)
        ]

    def lines(self) -> list[str]:
        """A line for each file that is left out."""
        return [
            f"{printable(left['file'])}: not copied into the run folder ({left['why']}); keep it where it is, or put it"
            f" at RUN/{printable(left['place'])}"
            for left in self.left_out
        ]


def files_of(choice: BenchmarkChoice, run: Path) -> RunFiles:
    """The files that a choice names, and all that those name.

    Args:
        choice: the words of the command line.
        run: the run folder; what lies in it is there already.
    """
    found: dict[str, tuple[str, Path]] = {}

    def take(name: str, value: str, place: str) -> str:
        for field, to, file in _below(name, Path(os.path.abspath(value)), place):
            if file.is_file() and not file.resolve().is_relative_to(run.resolve()):
                found.setdefault(to, (field, file))
        return value

    _with_files(choice, take)
    copied: dict[str, Path] = {}
    left_out: list[Mapping[str, Any]] = []
    total = 0
    for place, (field, file) in found.items():
        size, why = file.stat().st_size, NOT_PASSED_ON if field == HAND_MODEL else ""
        if not why and (size > MOST_FILE_BYTES or total + size > MOST_BYTES):
            limits = (
                f"one file may have {MOST_FILE_BYTES >> 20} MB, all together {MOST_BYTES >> 20} MB"
            )
            why = f"it has {size / (1 << 20):.0f} MB; {limits}"
        if why:
            about = {"file": str(file), "place": place, "bytes": size, "sha256": sha256_of(file)}
            left_out.append({**about, "why": why})
        else:
            copied[place], total = file, total + size
    return RunFiles(copied, tuple(left_out))


def placed(said: BenchmarkChoice, run: Path, code: Collection[str]) -> BenchmarkChoice:
    """The choice with each file where it is now: in the run folder, or where its sweep found it.

    Args:
        said: the flags of the run's sweep.
        run: the run folder.
        code: functions that may run, as the user says them.

    Raises:
        FileError: a file is in neither place, or the run names code that the user does not; it says what to do.
    """
    spelled = _allowed(said, run, code)
    bases = (Path(), *run.resolve().parents)

    def find(name: str, file: str, place: str) -> str:
        last = Path(file).parts[-2:]
        own = [run / place]
        if len(last) == 2 and ".." not in last:
            own.append(run.joinpath(*last))  # what a sweep imported
        there = [at for at in (*own, *(base / file for base in bases)) if at.exists()]
        whole = [at for at in there if not _lacking(name, at)]
        if whole and not names_function(str(whole[0])):
            return str(whole[0])
        flag = f"--{name.replace('_', '-')} {file}"
        what, to = "it is not there any more", place
        if there and (lack := _lacking(name, there[0])):
            what, to = (
                f"{there[0]} names {lack}, which is not there",
                f"{Path(place).parent}/{lack}",
            )
        raise FileError(
            f"{printable(run)}: its sweep was given {printable(flag)}; {printable(what)}: put it at {printable(run / to)}"
        )

    return _with_files(spelled, find)


def _with_files(choice: BenchmarkChoice, place: Place) -> BenchmarkChoice:
    """The choice with what `place` answers in the place of each file."""
    values: dict[str, Any] = {}
    for name in (f.name for f in fields(choice)):
        value, taken = getattr(choice, name), Counter[str]()

        def of_file(file: str, name: str = name, taken: Counter[str] = taken) -> str:
            own = Path(file).name or "files"
            taken[own] += 1
            return place(name, file, _place(name, own, taken[own]))

        several = isinstance(value, tuple)
        new = [_with_file(name, v, of_file) for v in (value if several else [value])]
        values[name] = tuple(new) if several else new[0]
    return BenchmarkChoice(**values)


def _with_file(name: str, value: str, place: Callable[[str], str]) -> str:
    """A flag's value with another file in it; the same value where it names none."""
    if (
        not value
        or name in ("persons", "receiver", "until", "turn")
        or (name == "benchmark" and (value in BENCHMARK or names_function(value)))
        or (name == "people" and value in WORDS)
        or (name == "robot" and value in ROBOTS)
        or value.startswith(PREFIX)
    ):
        return value
    if name == "object_mesh":  # FILE[:SPLIT[:REGION]]
        call = call_of(value)
        mesh, region = str(call["mesh"]), str(call["receiver"] or "")
        rest = value[len(mesh) :]
        if region.endswith(".npy"):
            rest = rest.removesuffix(region) + place(region)
        return place(mesh) + rest
    if name == "grasps":  # [NAME=]FILE[:GRIPPER]
        before, sign, rest = value.partition("=")
        named = bool(sign) and "/" not in before
        file, gripper = without_gripper(rest if named else value)
        text = place(str(file)) + (f":{gripper}" if gripper else "")
        return before + sign + text if named else text
    return place(value)


def _place(name: str, own: str, number: int) -> str:
    """The place of a flag's file: the second of one name gets a folder of its own."""
    if name == "benchmark":
        is_file = own.lower().endswith((".yaml", ".yml"))
        return f"{BENCHMARK_FILES}/{own if is_file else 'benchmark.yaml'}"
    again = "" if number == 1 else f"{number}/"
    return f"{BENCHMARK_FILES}/{name.replace('_', '-')}/{again}{own}"


def _below(name: str, path: Path, place: str) -> Iterator[tuple[str, str, Path]]:
    """(field, place, file) of all that a flag's file or folder names, with itself."""
    yaml_file = file_in(path) if name in ("benchmark", "objects") else None
    if yaml_file is not None:
        to = place if path == yaml_file or name == "benchmark" else f"{place}/{yaml_file.name}"
        yield name, to, yaml_file
        for field, text in _named_in(yaml_file):
            file = path_within(yaml_file.parent, text)
            yield from _with_buffers(field, str(Path(to).parent / text), file)
    elif not path.is_dir():
        yield from _with_buffers(name, place, path)
    elif name == "objects":
        for mesh in files_in(path, MESHES):
            yield from _with_buffers(name, f"{place}/{mesh.name}", mesh)
            about = mesh.with_suffix(".yaml")
            yield name, f"{place}/{about.name}", about
            named = (file_of(mesh_entry(mesh), field) for field in OF_OBJECT)
            yield from (
                (name, f"{place}/{text}", path / text) for text in named if text is not None
            )
    elif name == "grasps":
        yield from ((name, f"{place}/{f.name}", f) for f in files_in(path, GRASP_FILES))
    else:
        yield from ((name, f"{place}/{f}", path / f) for f in OF_ROBOT)


OF_ROBOT = ("robot.yaml", "robot.npz")
"""Files of a robot's folder."""


def _named_in(path: Path) -> list[tuple[str, str]]:
    """(field, name) of the files that a benchmark file names."""
    file = read_benchmark_file(path)
    robot = [] if file.robot in ROBOTS else [("robot", f"{file.robot}/{name}") for name in OF_ROBOT]
    return [*named_files(file), *robot]


def _with_buffers(field: str, place: str, file: Path) -> Iterator[tuple[str, str, Path]]:
    """The file, and the buffers beside a glTF."""
    yield field, place, file
    if file.suffix.lower() != ".gltf" or not file.is_file():
        return
    for buffer in read_json(file, most=MOST_GLTF_BYTES).get("buffers", ()):
        uri = unquote(str(buffer.get("uri", "data:")))
        if not uri.startswith("data:"):
            yield field, str(Path(place).parent / uri), path_within(file.parent, uri)


def _lacking(name: str, path: Path) -> str:
    """The first file that a benchmark file names and that is not beside it; empty where all are there."""
    file = file_in(path) if name in ("benchmark", "objects") else None
    if file is None or not file.is_file():
        return ""
    named = (text for _, text in _named_in(file))
    return next((text for text in named if not path_within(file.parent, text).exists()), "")


def _allowed(said: BenchmarkChoice, run: Path, code: Collection[str]) -> BenchmarkChoice:
    """The choice with its code as the user spells it, where he says that it may run."""
    of_run = {"objects": code_of(said.objects)}
    if said.benchmark and names_function(said.benchmark):
        of_run["benchmark"] = [said.benchmark]
    values = {"objects": said.objects, "benchmark": said.benchmark}
    named = [(flag, spec) for flag, specs in of_run.items() for spec in specs]
    for flag, spec in named:
        own = next((c for c in code if Path(c).name == Path(spec).name), None)
        if own is None:
            what = f"its sweep was given --{flag} {values[flag]}"
            how = f"a run folder starts no code by itself; say that this may run: --code {spec}"
            raise FileError(f"{printable(run)}: {printable(what)}; {printable(how)}")
        values[flag] = values[flag].replace(spec, own)
    if other := [c for c in code if Path(c).name not in {Path(spec).name for _, spec in named}]:
        has = ", ".join(spec for _, spec in named) or "no code"
        raise FileError(
            f"{printable(run)}: --code {printable(other[0])}: the run names {printable(has)}"
        )
    return BenchmarkChoice(**{**{f.name: getattr(said, f.name) for f in fields(said)}, **values})
