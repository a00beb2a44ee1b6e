"""How many candidates per second does Evaluator.score(stages="pose") judge inside a training loop, and at what cost?

python bench/training_loop.py [--device cpu|cuda:0] [--json FILE]

`pose`: the frozen mix of bench/throughput.py (bench/mix.npz: 1,024 trials of r2h-v2, half with the oracle's poses, half with
random ones), repeated. `random`: random poses of the default and of each other built-in benchmark, 1,024 trials repeated.
Figures of a size come from one call after another, the median of several; core_us is process time (other work on the machine
counts little), its smallest.
On CUDA there is one kind of time: wall, synchronised.
"""

import argparse
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from _mix import Poses, load_mix, repeated
from _report import Report, markdown_table
from run import DEVICE, Bench

from r2h_batch import load_benchmark
from r2h_batch.base.registry import BENCHMARK_NAMES, DEFAULT_BENCHMARK, RELEASE
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import random

MEASURES = (
    "bench/training_loop.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
)
OF_EACH = (1, 16, 64, 256, 1024, 4096, 16384)
"""Sizes at which every built-in benchmark is measured."""
KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))


class Clock:
    """Wall and core time; on CUDA the device is waited for."""

    def __init__(self, device: str) -> None:
        self.cuda = device != "cpu"

    def now(self) -> tuple[float, float]:
        if self.cuda:
            torch.cuda.synchronize()
        return time.perf_counter(), time.perf_counter() if self.cuda else time.process_time()

    def of(self, run: Callable[[], Any], repeats: int) -> tuple[float, float]:
        """Median wall and least core seconds of a call, after one to warm up."""
        run()
        times = []
        for _ in range(repeats):
            a = self.now()
            run()
            b = self.now()
            times.append((b[0] - a[0], b[1] - a[1]))
        wall, core = zip(*times, strict=True)
        return statistics.median(wall), min(core)


def sizes(
    report: Report,
    evaluator: Evaluator,
    mix: Poses,
    clock: Clock,
    of: Iterable[int],
    figure: str,
) -> None:
    for b in of:
        c = repeated(mix, b)
        repeats = 30 if b < 1000 else 5 if b < 10000 else 2
        median, core = clock.of(lambda c=c: evaluator.score(*c, stages="pose"), repeats)  # type: ignore[misc]
        name = f"{figure}.b{b}"
        report.add(f"{name}.candidates_per_s", b / median)
        report.add(f"{name}.core_us_per_candidate", 1e6 * core / b)


def every_benchmark(report: Report, clock: Clock, device: str, threads: int | None) -> None:
    """Random poses of each built-in benchmark, the default first."""
    others = (name for name in BENCHMARK_NAMES if name not in (DEFAULT_BENCHMARK, RELEASE))
    for name in (DEFAULT_BENCHMARK, *others):
        figure = f"training_loop.random.{name}"
        evaluator, poses = random_poses(name, device, threads)
        sizes(report, evaluator, poses, clock, OF_EACH, figure)
        if device == "cpu":
            # in a process of its own, because memory that was used once is kept
            with ProcessPoolExecutor(1, get_context("spawn")) as alone:
                for b, mib in alone.submit(memory_mib, name, threads).result().items():
                    report.add(f"{figure}.b{b}.memory_mib", mib)


def random_poses(name: str, device: str, threads: int | None) -> tuple[Evaluator, Poses]:
    """Random poses of a benchmark's first 1,024 trials, S0 and S1 by turns."""
    benchmark = load_benchmark(name)
    evaluator = Evaluator(benchmark, KINEMATIC, device=device, threads=threads)
    trials = benchmark.trials(512)
    trials = trials[trials.trial_id.argsort()].to(device)
    made = random.predict(trials, evaluator.scene, seed=0)
    return evaluator, (made.T_obj_ee, made.T_world_ee, trials)


def memory_mib(name: str, threads: int | None) -> dict[int, float]:
    """The most memory that this process holds during a call of each size, the smallest first."""
    evaluator, poses = random_poses(name, "cpu", threads)
    return {b: highest_mib(partial(evaluator.score, *repeated(poses, b), stages="pose")) for b in OF_EACH}


def highest_mib(call: Callable[[], object]) -> float:
    """The most memory that this process holds during a call, MiB; all that it held before is a part of it."""
    Path("/proc/self/clear_refs").write_text("5")  # proc(5): the high-water mark starts again
    call()
    (line,) = (x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def run(options: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    clock = Clock(options.device)
    evaluator = Evaluator(load_benchmark(), KINEMATIC, device=options.device, threads=options.threads)
    sizes(report, evaluator, load_mix(options.device)[0], clock, (4096,), "training_loop.pose")
    every_benchmark(report, clock, options.device, options.threads)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        **DEVICE,
        "--threads": {"type": int, "help": "CPU threads (default: one per core)"},
    },
)


def shown(data: Mapping[str, Any]) -> dict[str, str]:
    """What the page says of each benchmark: a table of the time of a candidate, and the most memory of a call."""
    names, values = dict.fromkeys((DEFAULT_BENCHMARK, *BENCHMARK_NAMES)), data["values"]

    own = {name: f"training_loop.random.{name}" for name in names}

    def table(figure: str) -> str:
        of = [b for b in OF_EACH if f"{own[DEFAULT_BENCHMARK]}.b{b}.{figure}" in values]
        rows = [
            [name, *(f"{values[f'{stem}.b{b}.{figure}']:,.0f}" for b in of)]
            for name, stem in own.items()
            if of and f"{stem}.b{of[0]}.{figure}" in values
        ]
        return markdown_table(["benchmark", *(f"B = {b:,}" for b in of)], rows)

    most = {name: [values.get(f"{stem}.b{b}.memory_mib") for b in OF_EACH] for name, stem in own.items()}
    held = {name: max(filter(None, of), default=None) for name, of in most.items()}
    memory = ", ".join(f"{mib:,.0f} ({name})" for name, mib in held.items() if mib)
    return {"benchmarks": table("core_us_per_candidate"), "memory": memory}


if __name__ == "__main__":
    BENCH.main()
