"""The same methods on the built-in robots: docs/results/questions.md.

`python bench/robots.py --out FOLDER` sweeps all methods on the default benchmark with each robot, motion as planned, persons
placed for the robot (the same FOLDER goes on).
"""

import argparse
from pathlib import Path
from typing import Any

from _report import ROOT, Report, markdown_table, swept
from _rows import keep, rate_of
from run import Bench

from r2h_batch import load_benchmark

MEASURES = (
    "bench/robots.py",
    "assets/robot",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/methods",
)
ROBOTS = ("ur5e_2f85", "ur3e_2f85", "ur10e_2f85", "panda_hand")
METHODS = ("fc", "handover-va", "contact", "intent", "random", "oracle")


def table(robot: str, trials: int, folder: Path) -> dict[str, dict[str, Any]]:
    """Method -> the record of its mean row."""
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run

    swept(
        folder,
        "--robot",
        robot,
        "--method",
        *METHODS,
        "--trials",
        trials,
        "--execute.sim",
        "none",
        "--quiet",
    )
    keep(folder, ROOT / "bench" / "options" / "robots" / robot)
    rows = table_of(load_run(folder)).rows
    return {row.method.partition(" (")[0]: record(row) for row in rows if row.split == "Avg"}


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """The table of each robot."""
    robots = {name: {"table": table(name, options.trials, options.out / name)} for name in ROBOTS}
    return {"trials": options.trials, "benchmark": load_benchmark().name, "robots": robots}


def shown(data: dict[str, Any]) -> dict[str, Any]:
    """The table of the page."""
    robots = data["robots"]
    methods = list(next(iter(robots.values()))["table"])
    rates = [[m, *(rate_of(r["table"][m]) for r in robots.values())] for m in methods]
    return {"rates": markdown_table(["Method", *robots], rates)}


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--out": {"default": Path("runs/robots"), "type": Path},
        "--trials": {"default": 100, "help": "of each split"},
    },
    stored="robots",
)

if __name__ == "__main__":
    BENCH.main()
