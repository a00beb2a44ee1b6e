"""How methods bear errors of execution: docs/results/questions.md, docs/results/robustness.png.

`python bench/robustness.py --out FOLDER` sweeps all methods on the default benchmark, the motion as planned, without errors and
with four (the same FOLDER goes on).
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from _curves import LEVELS, figure, robustness
from _report import ROOT, Report, markdown_table, swept
from _rows import keep, rate_of
from run import Bench

METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")
PICTURE = ROOT / "docs" / "results" / "robustness.png"
MEASURES = (
    "bench/robustness.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/methods",
    "bench/_curves.py",
)
ROWS = "bench/options/robustness"
"""Its rows, a folder a level."""


def measure(options: argparse.Namespace, _: Report) -> dict[str, Any]:
    """The sweeps."""
    from r2h_batch import load_benchmark
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run

    out, trials = options.out, options.trials
    for level in LEVELS:
        swept(
            out / level, "--method", *METHODS, "--trials", trials, "--execute.sim", "none", "--execution-error", level
        )
    runs = [load_run(out / level) for level in LEVELS]
    found = robustness(runs)
    rates: dict[str, list[str]] = {}
    for run in runs:
        for row in table_of(run).rows:
            if row.split == "Avg":
                rates.setdefault(row.method.partition(" (")[0], []).append(rate_of(record(row)))
    figure(found).savefig(PICTURE, dpi=110)
    for level in LEVELS:
        keep(out / level, ROOT / ROWS / level)
    return {
        "trials": trials,
        "benchmark": load_benchmark().name,
        "rates": rates,
        "curves": asdict(found)["curves"],
    }


def shown(data: dict[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    levels = [level.replace("mm,", " mm, ").replace("deg", " deg") for level in LEVELS]
    curves = {c["method"].partition(" (")[0]: c for c in data["curves"]}
    rates = [
        [
            m,
            *data["rates"][m],
            "{value:.1f} +-{half:.1f}".format(**c["area"]),
        ]
        for m, c in curves.items()
    ]
    return {
        "rates": markdown_table(["Method", *levels, "area"], rates),
    }


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--out": {"default": Path("runs/robustness"), "type": Path},
        "--trials": {"default": 100, "help": "of each split"},
    },
    stored="robustness",
)

if __name__ == "__main__":
    BENCH.main()
