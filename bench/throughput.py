"""How many whole trials per second does Evaluator.score judge, and where does the time go?

python bench/throughput.py [--trials N] [--device cpu|cuda:0] [--json FILE]
python bench/throughput.py --freeze

The mix is frozen in bench/mix.npz: the first 1,024 trials of the default benchmark, S0 and S1 by turns, half of them (drawn by
chance) with the predictions of the method `oracle`, half with those of `random`. --freeze makes it again with today's methods.
mix_is_current says whether today's trials are still those the mix was made for. Cold: one process' first call, kernels
compiled or loaded from Warp's cache, whichever it is. Warm: the median of several further calls.
core_s_per_trial is process time, so other work on the machine counts little. stage.*_share are shares of the process
time of one more warm call, taken around the stages of evaluate.py; other = what is left (tensors, checks).
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
from r2h_batch.types import Outcome, PlanReason, Scores

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


def score_time(run: Callable[[], Scores]) -> tuple[float, float, Scores]:
    """Wall and process seconds of one call, and what it returned."""
    wall, process = time.perf_counter(), time.process_time()
    scores = run()
    if scores.outcome.is_cuda:
        torch.cuda.synchronize()
    return time.perf_counter() - wall, time.process_time() - process, scores


def run(options: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    start = time.perf_counter()
    config = EvalConfig(execute=ExecConfig(sim=options.sim))
    evaluator = Evaluator(load_benchmark(), config, device=options.device, threads=options.threads)
    if options.freeze:
        freeze(evaluator)
        return
    (T_obj_ee, T_world_ee, trials), by_oracle = load_mix(options.device, options.trials)
    with np.load(MIX, allow_pickle=False) as mix:
        whole, _ = load_mix()
        current = trials_digest(whole[2]) == str(mix["digest"])
    report.add("throughput.setup_s", time.perf_counter() - start)
    report.add("throughput.trials", options.trials)
    report.add("throughput.sim", options.sim)
    report.add("throughput.mix_is_current", current)
    report.add("throughput.threads", launch.cpu_threads(options.threads))

    def run() -> Scores:
        return evaluator.score(T_obj_ee, T_world_ee, trials)

    cold, _, _ = score_time(run)
    report.add("throughput.trials_per_s_cold", options.trials / cold)
    times = [score_time(run)[:2] for _ in range(REPEATS)]
    report.add("throughput.trials_per_s_warm", options.trials / statistics.median(t[0] for t in times))
    report.add("throughput.trials_per_s_warm_best", options.trials / min(t[0] for t in times))
    report.add("throughput.core_s_per_trial", min(t[1] for t in times) / options.trials)
    report.add("throughput.trials_per_core_s", options.trials / min(t[1] for t in times))
    scores = run()
    path = scores.path_len > 0
    report.add("throughput.straight_line_share", float((scores.path_len[path] == 2).double().mean()))
    report.add("throughput.success_of_oracle_half", float(scores.success.cpu()[by_oracle].double().mean()))
    for outcome in Outcome:
        report.add(f"throughput.outcome.{outcome.name.lower()}", int((scores.outcome == int(outcome)).sum()))
    for reason in PlanReason:
        report.add(f"throughput.plan_reason.{reason.name.lower()}", int((scores.plan_reason == int(reason)).sum()))


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
