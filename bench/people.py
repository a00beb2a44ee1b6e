"""Receivers of every size: docs/results/questions.md.

Success of the built-in methods by group of people, on the trials of r2h-v1, motion as planned.
"""

import argparse
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
from _report import Report, markdown_table, swept
from run import Bench

from r2h_batch.data.people import GROUPS, WHEELCHAIR
from r2h_batch.runs.store import Run, load_run

MEASURES = (
    "assets/people",
    "r2h_batch/data/people.py",
    "r2h_batch/trials/draw/people.py",
    "r2h_batch/trials/draw/receivers.py",
    "r2h_batch/trials/draw/wheelchair.py",
    "r2h_batch/trials/holding",
    "r2h_batch/judge/plan.py",
    "r2h_batch/methods",
)
V1 = "r2h-v1"
RECEIVERS = (V1, *GROUPS, WHEELCHAIR)
METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")


def counts(run: Run) -> dict[str, Any]:
    """Trials, outcomes and trials whose person was drawn again, by method."""
    found = {}
    for method in run.methods:
        rows = pa.concat_tables([*run.shards("trials", method, ("outcome", "redrawn"))]).to_pylist()
        found[method.split(" ")[0]] = {
            "n": len(rows),
            "outcomes": dict(Counter(r["outcome"] for r in rows)),
            "redrawn_trials": sum((r["redrawn"] or 0) > 0 for r in rows),
        }
    return found


def of_group(group: str, trials: int) -> dict[str, Any]:
    """Counts of the methods on a group's trials, or on those of r2h-v1."""
    words = [] if group == V1 else ["--people", group]
    line = ["--benchmark", V1, "--method", *METHODS, *words, "--trials", trials, "--execute.sim", "none"]
    with TemporaryDirectory() as folder:
        return counts(load_run(swept(Path(folder) / "run", *line)))


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """The figures of the page."""
    return {"groups": {g: of_group(g, options.trials) for g in RECEIVERS}, "trials": options.trials}


def shown(data: Mapping[str, Any]) -> dict[str, str]:
    """The table of the page."""
    names = list(data["groups"][V1])
    success = []
    for group in RECEIVERS:
        found = data["groups"][group]
        rates = (f"{100 * found[m]['outcomes'].get('success', 0) / found[m]['n']:.1f}" for m in names)
        success.append([group, *rates, found[names[0]]["redrawn_trials"]])
    return {"success": markdown_table(["Receivers", *names, "Redrawn"], success)}


BENCH = Bench(__doc__, measure, MEASURES, {"--trials": {"default": 100, "help": "of each split"}}, stored="people")

if __name__ == "__main__":
    BENCH.main()
