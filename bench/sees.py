"""Success of a method that sees, by what it is shown: docs/results/sees.md.

`python bench/sees.py` sweeps examples/grasp_seen.py on r2h-v2 with exact images, with cell-v1's errors, with errors of masks and
with one camera. `--render` writes the page again from the JSON.
"""

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _report import ROOT, made_by, markdown_table, page_from, swept

PAGE = ROOT / "docs" / "results" / "sees.md"
MEASURES = (
    "bench/sees.py", "examples/grasp_seen.py", "kernels/observe", "r2h_batch/observe", "r2h_batch/sweep/seeing.py",
    "r2h_batch/protocols/r2h_v2.py",
)  # fmt: skip
ONE_POST = """name = "left-post"
[[cameras]]
name = "left"
position = [-0.10, 0.75, 0.80]
target = [0.42, -0.02, 0.15]
"""
SEES = {
    "exact images, exact hand": "cell-v1,noise=0",
    "cell-v1": "cell-v1",
    "cell-v1, masks grown by 2 pixels": "cell-v1,labels=grown",
    "cell-v1, 5 % of masks missed": "cell-v1,labels=missed",
    "the left post alone": "left-post.toml",
}
CAUSES = ("stability", "plan", "reach", "affordance", "safe")

HEAD = """# A method that sees

`python bench/sees.py` swept `examples/grasp_seen.py` on r2h-v2, motion as planned, {trials} trials a split, by what it
was [shown](../observe.md#methods-that-see) (bench/results/sees.json; commit {commit}, load {load:g} at the start). All rows
are of the same trials.

{table}

SR in percent with the 95 % interval of these trials (Wilson). Causes: trials of both splits, by their first failure. Pick: of
all trials, some posture takes the object up where it lay. Seen: median share of the object's surface. CPU: process seconds
of a trial, looking and judging included, the method's own process not; in the first row with the start of the program.

The method has no model and does not know the receiver's region. It believes that what no camera saw reaches down to the
table.
"""


def measure(options: argparse.Namespace) -> dict[str, Any]:
    from r2h_batch.report.statistics.aggregate import wilson_interval
    from r2h_batch.runs.store import load_run

    out: dict[str, Any] = {"trials": options.trials, "shown": {}}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        (home / "left-post.toml").write_text(ONE_POST)
        for words, sees in SEES.items():
            shown, begin = str(home / sees) if sees.endswith(".toml") else sees, time.process_time()
            run_folder = swept(
                home / str(len(out["shown"])), "--method", f"seen={ROOT / 'examples' / 'grasp_seen.py'}:predict",
                "--sees", shown, "--sim", "none", "--trials", options.trials, "--threads", 1, "--quiet",
            )  # fmt: skip
            seconds = time.process_time() - begin
            run = load_run(run_folder)
            rows, seen = run.trials("seen"), run.sees("seen")
            outcome, split = rows["outcome"].to_pylist(), rows["split"].to_pylist()
            found: dict[str, Any] = {"causes": {c: Counter(outcome)[c] for c in CAUSES}}
            for name in ("S0", "S1"):
                own = [o for o, s in zip(outcome, split, strict=True) if s == name]
                k = own.count("success")
                found[name] = {"sr": k / len(own), "interval": [float(x) for x in wilson_interval(k, len(own))]}
            found["pick"] = float(np.mean(seen["pick"].to_pylist()))
            found["seen_share"] = float(np.median(seen["seen_share"].to_numpy()))
            found["t_method_s"] = float(np.mean(rows["t_method_s"].to_numpy()))
            found["cpu_s"] = seconds / len(rows)
            out["shown"][words] = found
            print(words, found, flush=True)
    return {**out, **made_by(MEASURES)}


def markdown(data: Mapping[str, Any]) -> str:
    """The page."""

    def rate(one: Mapping[str, Any]) -> str:
        low, high = one["interval"]
        return f"{100 * one['sr']:.1f} ({100 * low:.0f}-{100 * high:.0f})"

    lines = [
        [
            words, rate(d["S0"]), rate(d["S1"]), "/".join(str(d["causes"][c]) for c in CAUSES), f"{100 * d['pick']:.0f}",
            f"{100 * d['seen_share']:.0f} %", f"{d['cpu_s']:.2f} s",
        ]
        for words, d in data["shown"].items()
    ]  # fmt: skip
    head = ["shown", "SR S0", "SR S1", f"causes: {'/'.join(CAUSES)}", "pick, %", "seen", "CPU"]
    return HEAD.format(
        trials=data["trials"], commit=str(data["commit"])[:12],
        load=data["hardware"]["load_at_start"], table=markdown_table(head, lines),
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=40, help="of each split")
    page_from(parser, ROOT / "bench" / "results" / "sees.json", PAGE, measure, markdown)


if __name__ == "__main__":
    main()
