"""How many whole trials per second does Evaluator.score judge?

python bench/throughput.py [--trials N] [--device cpu|cuda:0] [--json FILE]
python bench/throughput.py --freeze

The mix is frozen in bench/mix.npz: the first 1,024 trials of the default benchmark, S0 and S1 by turns, half of them (drawn by
chance) with the predictions of the method `oracle`, half with those of `random`. --freeze makes it again with today's methods.
Warm: the median of several calls after a first one. core_s_per_trial is process time, so other work on the machine counts little.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from _mix import MIX, load_mix
from _report import Report
from run import DEVICE, Bench

import r2h_batch.base.launch as launch
from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.trials.benchmark import trials_digest
from r2h_batch.types import Scores

MEASURES = (
    "bench/throughput.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
)
REPEATS = 5
MIX_TRIALS = 1024


def freeze(evaluator: Evaluator) -> None:
    """Writes the mix: trial ids, predictions, which of them are the oracle's, and the digest of the trials."""
    from r2h_batch.methods import oracle, random

    scene = evaluator.scene
    trials = load_benchmark().trials_with_ids(torch.arange(MIX_TRIALS))
    by_oracle = torch.zeros(MIX_TRIALS, dtype=torch.bool)
    by_oracle[torch.from_numpy(np.random.default_rng(0).permutation(MIX_TRIALS)[: MIX_TRIALS // 2])] = True
    best = oracle.predict(trials[by_oracle], scene, seed=0, evaluator=evaluator)
    any_ = random.predict(trials, scene, seed=0)
    T_obj_ee, T_world_ee = any_.T_obj_ee.cpu().clone(), any_.T_world_ee.cpu().clone()
    T_obj_ee[by_oracle], T_world_ee[by_oracle] = best.T_obj_ee.cpu(), best.T_world_ee.cpu()
    np.savez_compressed(
        MIX,
        trial_id=trials.trial_id,
        T_obj_ee=T_obj_ee,
        T_world_ee=T_world_ee,
        by_oracle=by_oracle,
        digest=trials_digest(trials),
    )


def score_time(run: Callable[[], Scores]) -> tuple[float, float]:
    """Wall and process seconds of one call."""
    wall, process = time.perf_counter(), time.process_time()
    scores = run()
    if scores.outcome.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - wall, time.process_time() - process


def run(options: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    config = EvalConfig(execute=ExecConfig(sim=options.sim))
    evaluator = Evaluator(load_benchmark(), config, device=options.device, threads=options.threads)
    if options.freeze:
        freeze(evaluator)
        return
    (T_obj_ee, T_world_ee, trials), _ = load_mix(options.device, options.trials)
    with np.load(MIX, allow_pickle=False) as mix:
        assert trials_digest(load_mix()[0][2]) == str(mix["digest"]), "the mix is of other trials; give --freeze"
    report.add("throughput.threads", launch.cpu_threads(options.threads))

    def run() -> Scores:
        return evaluator.score(T_obj_ee, T_world_ee, trials)

    score_time(run)
    times = [score_time(run) for _ in range(REPEATS)]
    report.add("throughput.trials_per_s_warm", options.trials / statistics.median(t[0] for t in times))
    report.add("throughput.core_s_per_trial", min(t[1] for t in times) / options.trials)


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        **DEVICE,
        "--trials": {"type": int, "default": MIX_TRIALS, "help": "more than the mix has: the mix again"},
        "--sim": {"default": "none", "choices": ("none", "mujoco", "mjwarp"), "help": "see bench/execute.py"},
        "--freeze": {"action": "store_true", "help": "make the mix again and stop"},
        "--threads": {"type": int, "help": "CPU threads (default: one per core)"},
    },
)

if __name__ == "__main__":
    BENCH.main()
