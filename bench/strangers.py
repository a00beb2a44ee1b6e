"""Attacks by somebody who had read the pages and none of the code: docs/results/attacks.md, second table.

    python bench/strangers.py [--only WORDS ...]

Each attack writes its files into a folder and gives the command line a user would give. Command after command runs in a process
of its own. Whatever an attack is about, all of this must hold: the command ends within the limits of time and memory, no
traceback, a refusal is one line, nothing beside the working folder is written, no file beside it is told, no text of a stranger
becomes a control character, a tag, a formula, a program or a command of TeX, and no code of a file runs. `must` says
what the exit code must be, `then` what must hold besides.
"""

import argparse
import contextlib
import importlib
import io
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import _attack
import _strange_answers
import _strange_methods
import _strange_names
import _strange_places
import _strange_runs
import _strange_things
import torch
from _attack import MOST_MIB, MOST_SECONDS, Attack, attacked
from _report import arguments, made_by, markdown_table, page_from
from _source import ROOT

from r2h_batch.__main__ import COMMANDS, main

STORED, PAGE = ROOT / "bench" / "results" / "strangers.json", ROOT / "docs" / "results" / "attacks.md"
MEASURES = ("bench/strangers.py", "bench/_attack.py", "r2h_batch/base/io", "r2h_batch/runs", "r2h_batch/sweep")
WORKERS = 4
LISTS = (_strange_names, _strange_answers, _strange_places, _strange_runs, _strange_things, _strange_methods)


SHORT = {
    "a method's name": 3,
    "trials' names": 0,
    "a robot's name": 0,
    "a run's folder": 1,
    "words of a run.json": 3,
    "words of a method's file": 2,
    "numbers of answers": 4,
    "answers as text": 12,
    "archives of answers": 14,
    "types of answers": 20,
    "motions": 3,
    "trials' arrays": 4,
    "links in a run folder": 3,
    "clocks and claims": 2,
    "other writers": 2,
    "forged shards": 8,
    "files of shards": 4,
    "files named by a run": 3,
    "forged files beside the shards": 2,
    "meshes": 6,
    "robots": 8,
    "rigs": 8,
    "weights": 7,
    "what a method leaves behind": 5,
    "what a method patches": 1,
    "how a method ends": 5,
    "what a method says of itself": 4,
    "methods that see": 1,
    "release policies": 0,
    "seeds of an environment": 2,
    "numbers of a run.json": 30,
    "words on the command line": 50,
    "tables of a real robot": 23,
}
"""Attacks of a kind that judge, or build what is judged: so many of them without --all, and those that found a hole."""
TRACE = "a traceback"
FELL = {
    ("trials' names", "a path out of the folder, export"): "a file beside the folder of `export`",
    ("checkpoints", "pickles that call"): f"{TRACE}; the pickle did not run",
    ("checkpoints", "random bytes"): TRACE,
    ("checkpoints", "links to a file beside them"): TRACE,
    ("methods that see", "it writes a pickle into every pipe"): f"{TRACE}; the pickle did not run",
    ("methods that see", "it writes 16 MiB into every pipe"): TRACE,
    ("how a method ends", "its error cannot be printed"): TRACE,
    ("what a method patches", "every Evaluator that gc finds"): TRACE,
    ("what a method says of itself", "it learned from a tag"): "a tag in table.md",
    ("rigs", "10,000 tables deep"): TRACE,
    ("rigs", "10,000 dotted keys"): TRACE,
    ("words on the command line", "--turn: \u0661,\u0662,\u0663"): "read as 1, 2 and 3 degrees",
}
"""(kind, attack) -> what happened when the attack was new, at commit aaea3d19 (a stranger's first run)."""


def every() -> dict[str, dict[str, Attack]]:
    """All attacks: kind -> what -> attack."""
    return {kind: attacks for one in LISTS for kind, attacks in one.KINDS.items()}


def each_of(words: Sequence[str], whole: bool) -> Iterator[tuple[str, str, Attack]]:
    """The attacks whose kind or name has one of these words; without words all, or what `SHORT` leaves."""
    for kind, attacks in every().items():
        for k, (what, attack) in enumerate(attacks.items()):
            if not whole and not words and k >= SHORT.get(kind, len(attacks)) and (kind, what) not in FELL:
                continue
            if not words or any(w in f"{kind}: {what}" for w in words):
                yield kind, what, attack


def warm() -> None:
    """Imports once, before the first fork, what the commands import: each attack is a process of its own."""
    torch.set_num_threads(1)  # no pool of threads that a fork would lose
    for where, _ in COMMANDS.values():
        importlib.import_module(f"r2h_batch.{where.partition(':')[0]}")
    for name in (
        "evaluate",
        "runs.verify",
        "report.table",
        "report.page",
        "sweep.scoring",
        "sweep.answers",
        "scene.mesh_import",
    ):
        importlib.import_module(f"r2h_batch.{name}")
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        path = Path(folder) / "mine.yaml"
        path.write_text("protocol: r2h-v1\nobjects:\n- {built_in: cup}\n- {built_in: hammer}\n")
        main(["benchmark", "check", str(path)])


def markdown(data: Mapping[str, Any]) -> str:
    """docs/results/attacks.md with this section in the place of its own."""
    before = PAGE.read_text().partition("## Attacks of a stranger")[0].rstrip()
    return f"{before}\n\n{section(data)}"


def shared(words: Sequence[str], whole: bool) -> dict[str, dict[str, dict[str, Any]]]:
    """Attacks by several processes: kind -> what -> how it ended."""
    warm()
    for make in (_attack.small_run, _attack.solved_run, _strange_answers.solutions):
        make()  # once, before the first fork
    chosen = [*each_of(words, whole)]
    with tempfile.TemporaryDirectory() as folder:
        parts = [Path(folder) / f"{k}.json" for k in range(WORKERS)]
        for child in [_started(chosen[k::WORKERS], part) for k, part in enumerate(parts)]:
            os.waitpid(child, 0)
        found = {(kind, what): row for part in parts for kind, what, row in json.loads(part.read_text())}
    rows: dict[str, dict[str, dict[str, Any]]] = {}
    for kind, what, _ in chosen:
        rows.setdefault(kind, {})[what] = found[kind, what]
    return rows


def _started(chosen: Sequence[tuple[str, str, Attack]], part: Path) -> int:
    """A process that runs these attacks and writes what it found; its number."""
    if child := os.fork():
        return child
    rows = []
    for kind, what, attack in chosen:
        bad, ended = attacked(attack)
        last = (ended.said.strip().splitlines()[-1:] or [""])[0]
        own = {"ended": ended.how, "wrong": bad, "seconds": ended.seconds, "mib": ended.mib, "said": last[:160]}
        rows.append((kind, what, own))
        line = f"{kind}: {what}: {ended.how} {ended.seconds:.1f} s {ended.mib} MiB {last[:230]!r}"
        print(f"*** {bad}: {line}\n{ended.said[-2000:]}" if bad else line, flush=True)
    part.write_text(json.dumps(rows))
    os._exit(0)


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Every attack, and how each ended."""
    rows = shared((), options.all)
    for (kind, what), words in FELL.items():
        rows[kind][what]["fell"] = words
    left = sum(map(len, every().values())) - sum(map(len, rows.values()))
    return {"kinds": rows, "left_out": left, **made_by(MEASURES)}


def section(data: Mapping[str, Any]) -> str:
    """The part of docs/results/attacks.md about these attacks."""
    every = [f for own in data["kinds"].values() for f in own.values()]
    lines = []
    for kind, own in data["kinds"].items():
        found = [*own.values()]
        lines.append(
            [
                kind,
                str(len(found)),
                *(str(sum(f["ended"] == end for f in found)) for end in ("refused", "read")),
                str(sum("fell" in f for f in found)),
                str(sum(bool(f["wrong"]) for f in found)),
                f"{max(f['seconds'] for f in found):.1f}",
                str(max(f["mib"] for f in found)),
            ]
        )
    fell = [[kind, what, words] for (kind, what), words in FELL.items()]
    parts = [
        "## Attacks of a stranger",
        "Somebody who had read the pages and none of the code wrote these. `python bench/strangers.py` makes each of them"
        " and gives the command line of a user (`bench/results/strangers.json`). Whatever an attack is about: a command"
        f" ends within {MOST_SECONDS:g} s of the processor and {MOST_MIB} MiB without a traceback, and a refusal is"
        " one line. Nothing beside the working folder is written or told. No text of a stranger becomes a control character,"
        " a tag, a formula, a"
        " program or a command of TeX. No code of a file runs. Other verdicts stay the same bits. Of"
        f" {len(every)} attacks {sum('fell' in f for f in every)} found a hole, and {sum(bool(f['wrong']) for f in every)}"
        f" do so now. {data['left_out']} more of the same kinds run with `--all`.",
        markdown_table(
            [
                "kind",
                "attacks",
                "refused",
                "read",
                "found a hole",
                "do so now",
                "longest, CPU s",
                "memory, MiB at most",
            ],
            lines,
        ),
        "`read`: what was asked for is done, and all of the above holds. Memory as above.",
        "### Holes that they found",
        markdown_table(["kind", "attack", "what happened"], fell, left=True),
        "A method of a user's own runs in the process of its sweep. There it can replace any function, such as one of torch,"
        " and end its own sweep with a traceback. `results reevaluate` judges its rows in another process.",
    ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    os.environ.setdefault("MUJOCO_GL", "osmesa")
    parser = arguments(__doc__)
    parser.add_argument("--only", nargs="+", help="attacks whose kind and name have one of these words; writes nothing")
    parser.add_argument("--all", action="store_true", help="also the attacks that SHORT leaves out")
    if "--only" in sys.argv:
        shared(parser.parse_args().only, True)
    else:
        page_from(parser, STORED, PAGE, measure, markdown)
