"""The benchmark of a stored run: that of its run.json, from the files that the user gives or that it names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable
from r2h_batch.base.registry import LISTED
from r2h_batch.data.people import WORDS
from r2h_batch.runs.before import tell_changed
from r2h_batch.scene.objects import object_digest
from r2h_batch.scene.robot_file import ROBOTS
from r2h_batch.trials.benchmark import Benchmark
from r2h_batch.trials.choice import BenchmarkChoice, words_of
from r2h_batch.trials.edit import edited
from r2h_batch.trials.family_objects import PREFIX, names_code
from r2h_batch.trials.load import names_function
from r2h_batch.trials.registry import BENCHMARK
from r2h_batch.verdicts import ASKED_NAMES, UNTIL

IN_HEADER = ("receiver", "until")
"""Flags whose words run.json has elsewhere: in its configuration, in what its benchmark asks for."""


def benchmark_of_run(header: Mapping[str, Any], given: BenchmarkChoice, where: str) -> Benchmark:
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
    said = _said(header)
    if not _files(replace(given, receiver="", until="", turn="")):
        given = _found(said, Path(where)) or given
    if said.benchmark in BENCHMARK and not given.benchmark:  # a name is no file
        given = replace(given, benchmark=said.benchmark)
    if said.robot in ROBOTS and not given.robot:  # nor is a built-in robot
        given = replace(given, robot=said.robot)
    if said.turn:  # nor is a turn
        given = replace(given, turn=said.turn)
    flags = _check_flags(header, given, where)
    if not given.benchmark and protocol != LISTED:
        if protocol not in BENCHMARK:
            known = f"this installation has {', '.join(BENCHMARK)}; give its --benchmark"
            raise FileError(f"{where}: benchmark {printable(protocol)!r}; {known}")
        given = replace(given, benchmark=protocol)
    asked = tuple(header.get("asks", ()))
    asks = [name for name in asked if name in ASKED_NAMES]
    given = replace(
        given,
        receiver=header["configuration"].get("receiver", "hand"),
        until=UNTIL[len(asks) - 1] if asks else "",
    )
    pieces = header["configuration"]["plan"]["object_collision"] == "pieces"
    benchmark = edited(given, pieces=pieces)
    found = {"objects": object_digest(benchmark.objects), "hand_set": benchmark.hand_set.digest}
    if "benchmark" in digests:  # older runs lack it
        found["benchmark"] = benchmark.digest
        if changed := benchmark.digests_before(asked).get(digests["benchmark"]):
            found["benchmark"] = digests["benchmark"]
            tell_changed(Path(where), changed)
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


def _said(header: Mapping[str, Any]) -> BenchmarkChoice:
    """The flags of the run's sweep as run.json has them, without those that it says elsewhere."""
    pairs = [f[2:].partition(" ") for f in (header.get("benchmark") or {}).get("flags", ())]
    known = {f.name: f for f in fields(BenchmarkChoice) if f.name not in IN_HEADER}
    lists = {name for name, field in known.items() if field.default == ()}
    said: dict[str, Any] = {k.replace("-", "_"): v for k, _, v in pairs}
    values: dict[str, Any] = {}
    for name, text in said.items():
        words = words_of(text)
        if name in lists:
            values[name] = tuple(words)
        elif name in known:  # older versions wrote one with spaces without quotes
            values[name] = words[0] if len(words) == 1 else text
    return BenchmarkChoice(**values)


def _found(said: BenchmarkChoice, run: Path) -> BenchmarkChoice | None:
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
            or (name == "benchmark" and value in BENCHMARK)
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
        if (at := place(file)) is None or (name == "benchmark" and names_function(at)):
            return None
        return rest + sign + at if name == "grasps" else at + sign + rest

    values = {name: value for name, value in asdict(said).items() if value}
    placed: dict[str, Any] = {
        name: tuple(of(name, v) for v in value) if isinstance(value, tuple) else of(name, value)
        for name, value in values.items()
    }
    lost = any(v is None or (isinstance(v, tuple) and None in v) for v in placed.values())
    return None if lost else BenchmarkChoice(**placed)


def _files(choice: BenchmarkChoice) -> list[str]:
    """The flags without the name of a benchmark, which names no file."""
    return [f for f in choice.flags() if not _is_said(f)]


def _is_said(flag: str) -> bool:
    """Whether run.json says elsewhere what a flag says: the rule that drew the trials, what was seen of the person."""
    name, _, value = flag.partition(" ")
    named = name == "--benchmark" and value in BENCHMARK
    return named or name.removeprefix("--") in ("protocol", *IN_HEADER)


def _check_flags(header: Mapping[str, Any], given: BenchmarkChoice, where: str) -> str:
    """The flags of the run's sweep that name files, robots, people and turns.

    Raises:
        FileError: others are given.
    """
    if "benchmark" not in header:  # an older run
        own = [o["name"] for o in header.get("objects", []) if not o["built_in"]]
        if len(given.object_mesh) != len(own):
            how = f"{', '.join(own) or 'none'}; give their --object-mesh as in the sweep"
            raise FileError(f"{where}: has the user's objects {how}")
        return ""
    flags = [f for f in header["benchmark"]["flags"] if not _is_said(f)]
    if {f.split()[0] for f in flags} != {f.split()[0] for f in _files(given)}:
        how = " ".join(flags) or "no flag for objects or hands"
        raise FileError(f"{where}: give what its sweep was given: {how}")
    return " ".join(flags)
