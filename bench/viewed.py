"""How much of the part that they want the receivers see at the handover, by method: docs/observe.md.

`python bench/viewed.py --json bench/results/viewed.json` judges the shipped rows of r2h-v2 as `results viewed` does.
"""

import re
from collections import defaultdict

import numpy as np
from _report import ROOT, Report, arguments

RUN = ROOT / "r2h_batch" / "report" / "compare" / "rows" / "r2h-v2"
MEASURES = (
    *("bench/viewed.py", "kernels/observe/eyes.py", "kernels/observe/rays.py", "r2h_batch/observe/eyes.py"),
    *("r2h_batch/observe/rays.py", "r2h_batch/observe/robot_mesh.py", "r2h_batch/sweep/results/viewed.py"),
)


def measure() -> Report:
    """Judges the rows again, and collects the means."""
    from r2h_batch.protocols.choice import BenchmarkChoice
    from r2h_batch.report.table import record, table_of
    from r2h_batch.report.text import short_names
    from r2h_batch.report.viewed import mean_share
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reception import judge_of_bodies, judged_again
    from r2h_batch.sweep.results.viewed import HIDERS, viewed_rows

    report, run = Report(MEASURES), load_run(RUN)
    judge, names = judge_of_bodies(run, BenchmarkChoice(), "cpu")
    short = short_names(names)
    presented = {row.method: record(row)["presented"] for row in table_of(run).rows if row.split == "S1"}
    for name in names:
        found = defaultdict(list)
        for _, scores, _ in judged_again(run, name, judge):
            for word, share in viewed_rows(scores)[1].items():
                found[word].append(share)
        shares = {word: np.concatenate(parts) for word, parts in found.items()}
        word = re.sub(r"\W", "_", short[name]).lower()
        own, seen = f"viewed.{word}", mean_share(shares["viewed"])
        report.add(f"{own}.n", len(shares["viewed"]))
        report.add(f"{own}.seen", seen.percent)
        report.add(f"{own}.low", seen.low)
        report.add(f"{own}.high", seen.high)
        report.add(f"{own}.presented", presented[name])
        for word in HIDERS:
            report.add(f"{own}.{word}", 100 * float(shares[f"hidden_by_{word}"].mean(dtype=np.float64)))
    return report


if __name__ == "__main__":
    options = arguments(__doc__).parse_args()
    target = options.json and options.json.resolve()
    measure().write(target)
