"""How methods bear errors of execution: docs/results/robustness.{md,png}.

`python bench/robustness.py --out FOLDER` sweeps all methods on the default benchmark, the motion as planned, without errors and
with four (the same FOLDER goes on). `--render` writes the page again from the JSON.
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from _curves import LEVELS, figure, render, robustness
from _report import ROOT, made_by, markdown_table, page_from, swept
from _rows import keep, rate_of

METHODS = ("fc", "handover-va", "contact", "intent", "oracle", "random")
PAGE = ROOT / "docs" / "results" / "robustness.md"
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

HEAD = """# Robustness: errors of execution

Compare methods under [errors of execution](../choices.md#errors-estimates-candidates). `python bench/robustness.py`
measured {trials} trials of each split of {benchmark}, `--sim none` (bench/results/robustness.json; commit {commit}). For
your method:

```
for error in 0mm,0deg 3mm,0.5deg 5mm,1deg 10mm,2deg 20mm,3deg; do
  r2h-batch sweep --method mine.py:predict --execution-error $error --out runs/robust/$error
  r2h-batch report runs/robust/$error --format csv
done
```

![SR over the execution error](robustness.png)

## Success rates

Percent of all trials, mean of the splits, with 95 % intervals for the mean of all categories of objects. Bars of the picture
are for more trials with these objects. Area: mean SR over the errors from 0 to 20 mm, with its 95 % t interval over
categories.

{rates}
"""


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """The sweeps."""
    from r2h_batch import load_benchmark
    from r2h_batch.report.table import record, table_of
    from r2h_batch.runs.store import load_run

    out, trials = options.out, options.trials
    for level in LEVELS:
        swept(out / level, "--method", *METHODS, "--trials", trials, "--sim", "none", "--execution-error", level)
    runs = [load_run(out / level) for level in LEVELS]
    found = robustness(runs)
    rates: dict[str, list[str]] = {}
    for run in runs:
        for row in table_of(run).rows:
            if row.split == "Avg":
                rates.setdefault(row.method.partition(" (")[0], []).append(rate_of(record(row)))
    figure(found).savefig(PAGE.with_suffix(".png"), dpi=110)
    for level in LEVELS:
        keep(out / level, ROOT / ROWS / level)
    return {
        "trials": trials,
        "benchmark": load_benchmark().name,
        "rates": rates,
        "curves": asdict(found)["curves"],
        "tables": render(found),
        **made_by(MEASURES),
    }


def markdown(data: dict[str, Any]) -> str:
    """The page."""
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
    return HEAD.format(
        trials=data["trials"],
        benchmark=data["benchmark"],
        commit=str(data["commit"])[:12],
        rates=markdown_table(["Method", *levels, "area"], rates),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "robustness")
    parser.add_argument("--trials", type=int, default=100, help="of each split")
    page_from(parser, ROOT / "bench" / "results" / "robustness.json", PAGE, measure, markdown)


if __name__ == "__main__":
    main()
