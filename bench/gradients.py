"""Cost of a gradient, and what it is good for.

python bench/gradients.py [--trials N] [--json FILE]

cost: median seconds of a pose call with its backward pass, less those of the call alone, by turns, for each candidate; random
candidates of the default benchmark. page: the first block of docs/training_loop.md, as printed. refine:
examples/refine_poses.py on N trials of each split.
"""

import argparse
import re
import runpy
import statistics
import sys
import tempfile
import time
from pathlib import Path

import torch
from _report import ROOT, Report
from run import Bench

from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import random

MEASURES = (
    *("bench/gradients.py", "examples/refine_poses.py", "kernels", "r2h_batch/judge", "r2h_batch/scene"),
    *(
        "r2h_batch/base/launch",
        "r2h_batch/evaluate.py",
        "r2h_batch/launching.py",
        "r2h_batch/stages.py",
        "r2h_batch/work.py",
    ),
)
SIZES = {1: 200, 2048: 7}
"""Candidates of a call -> pairs of calls."""


def cost(report: Report) -> None:
    """Calls with and without the backward pass, by turns."""
    benchmark = load_benchmark()
    evaluator = Evaluator(benchmark, EvalConfig(execute=ExecConfig(sim="none")))
    trials = benchmark.trials(max(SIZES) // 2)
    start = random.predict(trials, evaluator.scene, seed=0)
    for b, pairs in SIZES.items():
        asked, plain = trials[:b], (start.T_obj_ee[:b], start.T_world_ee[:b])
        moved = tuple(T.clone().requires_grad_(True) for T in plain)
        times: dict[str, list[float]] = {"without": [], "with": []}
        for turn in range(pairs + 2):
            begin = time.perf_counter()
            evaluator.score(plain[0], plain[1], asked, stages="pose")
            middle = time.perf_counter()
            soft = evaluator.score(moved[0], moved[1], asked, stages="pose").soft(temperature_m=0.005, log=True)
            torch.autograd.grad(soft.sum(), moved)
            if turn >= 2:  # the first calls read kernels
                times["without"].append(middle - begin)
                times["with"].append(time.perf_counter() - middle)
        without, with_ = (statistics.median(t) for t in times.values())
        report.add(f"gradients.b{b}.call_us_per_candidate", 1e6 * without / b)
        report.add(f"gradients.b{b}.more_us_per_candidate", 1e6 * (with_ - without) / b)


def page(report: Report) -> None:
    """The page's own program: how many candidates pass before and after."""
    page = (ROOT / "docs" / "training_loop.md").read_text("utf-8").partition("## Gradients")[2]
    (code, *_) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "page.py"
        file.write_text(code)
        made = runpy.run_path(str(file))
    start = made["start"]
    before = made["evaluator"].score(start.T_obj_ee, start.T_world_ee, made["trials"]).success
    report.add("gradients.page.candidates", len(before))
    report.add("gradients.page.pass_before", int(before.sum()))
    report.add("gradients.page.pass_after", int(made["after"].success.sum()))


def refine(report: Report, trials: int) -> None:
    """The example, on random candidates that fail."""
    sys.path.insert(0, str(ROOT / "examples"))
    from refine_poses import main as refine_poses

    before, after = refine_poses(["--trials", str(trials)])
    n = 2 * trials
    failing = n - round(before * n)
    report.add("gradients.refine.failing", failing)
    report.add("gradients.refine.pass_after", round(after * failing))


def run(options: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    cost(report)
    page(report)
    refine(report, options.trials)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--trials": {"default": 200, "help": "of each split, for examples/refine_poses.py"},
    },
    peer="calls without gradients",
)

if __name__ == "__main__":
    BENCH.main()
