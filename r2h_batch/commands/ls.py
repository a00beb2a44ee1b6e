"""The command `ls`: what can be named on a command line, and what a benchmark holds. Light until there is work."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from r2h_batch.base.errors import UsageError

if TYPE_CHECKING:
    from r2h_batch.scene.families.family import Family

Line = tuple[str, ...]


def ls(
    what: Literal["methods", "objects", "families", "robots", "benchmarks", "runs", "benchmark"],
    name: str = "",
    /,
    *,
    schema: bool = False,
    yaml: bool = False,
) -> int:
    """List methods, objects, families, robots, benchmarks or runs, one a line; or show and check one benchmark.

    Args:
        what: methods, objects, families (shipped instances, and families that are only drawn), robots, benchmarks or runs; or
            benchmark: reads one with all files that it names, and says what it holds.
        name: with `runs`, the folder to search, by default runs; with `benchmark`, a name of ls benchmarks or your
            benchmark.yaml, by default the default one.
        schema: with `benchmark`, print the schema of a benchmark file instead (JSON Schema).
        yaml: with `benchmark`, print the default benchmark as a file (YAML) that you can edit.
    """
    if name and what not in ("runs", "benchmark"):
        raise UsageError(
            f"ls {what} takes nothing more, and {name!r} is given; only ls runs FOLDER and ls benchmark NAME have a second word"
        )
    if (schema or yaml) and (what != "benchmark" or name or (schema and yaml)):
        raise UsageError("write ls benchmark --schema, or ls benchmark --yaml, and nothing more")
    if what == "benchmark":
        return _schema() if schema else _yaml() if yaml else _benchmark(name)
    lines = list({
        "methods": _methods, "objects": _objects, "families": _families, "robots": _robots, "benchmarks": _benchmarks,
        "runs": lambda: _runs(Path(name or "runs")),
    }[what]())  # fmt: skip
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))] if lines else []
    for line in lines:
        sys.stdout.write("  ".join(map(str.ljust, line, widths)).rstrip() + "\n")
    return 0


def _methods() -> Iterator[Line]:
    from importlib import import_module

    from r2h_batch.base.registry import METHOD_NAMES, METHODS

    for name in METHOD_NAMES:
        words = import_module(f"r2h_batch.methods.{name.replace('-', '_')}").__doc__ or ""
        yield name, " ".join(words.partition(".\n")[0].partition(";")[0].split()).rstrip(".")
    for name in METHODS:
        if name not in METHOD_NAMES:
            yield name, METHODS.outside(name)


def _objects() -> Iterator[Line]:
    from r2h_batch.scene.objects import load_objects

    for o in load_objects():
        size = " x ".join(f"{1000 * x:.0f}" for x in o.vertices.max(0) - o.vertices.min(0))
        yield o.split, o.name, f"{size} mm", f"{1000 * o.mass:.0f} g", ", ".join(o.part_names)


def _families() -> Iterator[Line]:
    from r2h_batch.scene.objects import INSTANCE_NAMES, load_objects

    for o in load_objects(INSTANCE_NAMES):
        size = " x ".join(f"{1000 * x:.0f}" for x in o.vertices.max(0) - o.vertices.min(0))
        region = [n for k, n in enumerate(o.part_names) if o.receiver_face[o.face_part == k].any()]
        taken = f"receiver takes {', '.join(region)}" if region else ""
        yield (
            o.split,
            o.name.rpartition("_")[0],
            o.name,
            f"{size} mm",
            f"{1000 * o.mass:.0f} g",
            taken,
        )
    for family in _not_shipped():
        taken = f"receiver takes {', '.join(family.receiver)}" if family.receiver else ""
        how = f'--objects "families:{family.category} x 5"'
        yield family.split, family.category, how, "", "", taken


def _not_shipped() -> "list[Family]":
    """Families that are drawn alone; none where what draws them is not installed."""
    from r2h_batch.scene.families.family import FAMILIES
    from r2h_batch.scene.objects import OBJECT_NAMES

    try:
        return [FAMILIES[name] for name in FAMILIES if name not in OBJECT_NAMES]
    except ModuleNotFoundError:
        return []


def _robots() -> Iterator[Line]:
    from r2h_batch.scene.robot_file import ROBOTS, load_robot

    for name in ROBOTS:
        robot = load_robot(name)
        sizes = {"reach": robot.reach_m, "open gap": robot.open_gap_m}
        yield name, *(f"{word} {1e3 * size:.0f} mm" for word, size in sizes.items())


def _benchmarks() -> Iterator[Line]:
    from r2h_batch.base.registry import BENCHMARKS, DEFAULT_BENCHMARK
    from r2h_batch.trials.registry import BENCHMARK

    about = {entry.name: entry.about for entry in BENCHMARKS}
    for name in BENCHMARK:
        default = "default" if name == DEFAULT_BENCHMARK else ""
        yield name, about.get(name, "of another package"), default


def _schema() -> int:
    import json

    from r2h_batch.trials.file_fields import BenchmarkFile

    print(json.dumps(BenchmarkFile.model_json_schema(), indent=1))
    return 0


def _yaml() -> int:
    from r2h_batch.trials.file_fields import text_of
    from r2h_batch.trials.load import load_benchmark

    found = load_benchmark()
    sys.stdout.write(text_of(found.name, found.objects, found.receiver))
    return 0


def _benchmark(name: str) -> int:
    """Reads a benchmark and all files that it names, and says what it holds."""
    from r2h_batch.base.registry import DEFAULT_BENCHMARK, benchmark_in_words
    from r2h_batch.trials.load import load_benchmark

    found = load_benchmark(name or DEFAULT_BENCHMARK)
    same = " (the default benchmark)" if found.digest == load_benchmark().digest else ""
    shown = name or found.name
    rule = "" if shown == found.protocol else f"{benchmark_in_words(found.protocol)}, "
    print(f"{shown}: {rule}digest {found.digest}{same}")
    for split in ("S0", "S1"):
        names = ", ".join(o.name for o in found.objects if o.split == split)
        print(f"{split}: {names or 'no object'}")
    sides = found.hand_set.side.tolist()
    vertices = len(found.hand_set.model.vertices)
    print(f"hands: {sides.count(0)} right, {sides.count(1)} left, {vertices} vertices")
    grasps = [f"{o.name} {len(o.grasps)}" for o in found.objects if o.grasps is not None]
    print(f"grasps of its own: {', '.join(grasps) or 'none'}")
    return 0


def _runs(folder: Path) -> Iterator[Line]:
    from r2h_batch.runs.files import RunError
    from r2h_batch.runs.store import load_run

    places = sorted(p.parent for p in folder.glob("*/run.json")) if folder.is_dir() else []
    for place in places:
        try:
            run = load_run(place, verify=False)
        except RunError as error:
            yield str(place), "cannot be read", str(error).rpartition(": ")[2], ""
            continue
        trials = ", ".join(f"{n} {split}" for split, n in run.header["trials"].items())
        methods = [*run.methods, *(f"{m} (not complete)" for m in run.unfinished)]
        yield str(place), str(run.header["protocol"]), trials, "; ".join(methods)
