"""Seconds of a first call whose kernels have to be compiled, on one core and on all.

python bench/first_call.py [--rounds N] [--json FILE]

Each call is a process of its own with an empty cache of kernels and one row; `pose` asks for `stages="pose"`, `all` for a whole
trial. One core and all cores take turns, and the side that goes first changes from round to round. Wall time, without the
imports and the Evaluator. An idle machine is needed: work beside it takes a core from one side only.
"""

import argparse
import multiprocessing
import os
import statistics
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from typing import Literal

import numpy as np
from _report import ROOT, Report
from run import Bench

MEASURES = ("bench/first_call.py", "kernels", "r2h_batch/base/launch", "r2h_batch/judge/compile.py")
STAGES: tuple[Literal["pose", "all"], ...] = ("pose", "all")


def first_call_s(stages: Literal["pose", "all"], cores: tuple[int, ...], cache: str) -> float:
    """Seconds of the first call of a new process on these cores, with its kernels in this empty folder."""
    os.sched_setaffinity(0, cores)
    os.environ["WARP_CACHE_PATH"] = cache
    import torch

    from r2h_batch import load_benchmark
    from r2h_batch.config import EvalConfig, ExecConfig
    from r2h_batch.evaluate import Evaluator

    with np.load(ROOT / "bench" / "mix.npz") as mix:
        T_obj_ee, T_world_ee = (torch.from_numpy(mix[k])[:1] for k in ("T_obj_ee", "T_world_ee"))
    trials = load_benchmark().trials(1, splits="S0")
    evaluator = Evaluator(load_benchmark(), EvalConfig(execute=ExecConfig(sim="none")))
    begin = time.perf_counter()
    evaluator.score(T_obj_ee, T_world_ee, trials, stages=stages)
    return time.perf_counter() - begin


def run(given: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    everything = tuple(sorted(os.sched_getaffinity(0)))
    times: dict[tuple[str, int], list[float]] = {}
    for turn in range(given.rounds):
        for stages in STAGES:
            sides = (everything[:1], everything)
            for cores in sides if turn % 2 == 0 else sides[::-1]:
                with (
                    tempfile.TemporaryDirectory() as cache,
                    ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool,
                ):
                    seconds = pool.submit(first_call_s, stages, cores, cache).result()
                times.setdefault((stages, len(cores)), []).append(seconds)
                print(f"round {turn + 1}, {stages}, {len(cores)} cores: {seconds:.1f} s", flush=True)
    for (asked, cores_n), seconds_n in times.items():
        report.add(f"first_call.{asked}.{cores_n}_cores_s", statistics.median(seconds_n))
    for stages in STAGES:
        one, more = (times[stages, n] for n in (1, len(everything)))
        report.add(f"first_call.{stages}.ratio", statistics.median(a / b for a, b in zip(one, more, strict=True)))


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--rounds": {"default": 3},
    },
    peer="one core",
)

if __name__ == "__main__":
    BENCH.main()
