"""How long a simulated trial takes, and what engine and model of the arm change: docs/choices.md.

python bench/execute.py [--trials N] [--json FILE]

Trials and predictions are those of bench/mix.npz (half oracle, half random; S0 and S1 by turns). Speed counts process time of
the whole Evaluator.score, so other work on the machine counts little. `auto` takes more trials than the rest (--auto-trials),
with the answers of the method `contact`. A trial is in the band when one of its margins is within 0.1 mm of 0 in either run.
"""

import argparse
import time
from typing import Any
from unittest import mock

import torch
from _mix import Poses, load_mix, on
from _report import Report
from run import DEVICE, Bench

import r2h_batch.judge.motion.execute as execution
from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.motion.execute import Executed, execute
from r2h_batch.methods import contact
from r2h_batch.types import Scores

MEASURES = (
    "bench/execute.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
)


def scored(evaluator: Evaluator, batch: Poses) -> tuple[Scores, torch.Tensor, float]:
    """Scores, by how much fingers swayed (m; of each motion, in the evaluator's order), and process seconds."""
    slack: list[torch.Tensor] = []

    def watched(*given: Any, **more: Any) -> Executed:
        done = execute(*given, **more)
        slack.append(done.slack_m)
        return done

    T_obj_ee, T_world_ee, trials = batch
    evaluator.score(T_obj_ee[:8], T_world_ee[:8], trials[:8])
    if evaluator.config.execute.model != "arm":  # compiled once in a process (docs/choices.md)
        evaluator.scene.model(trials.hand_index.tolist())
    with mock.patch.object(execution, "execute", watched):
        start = time.process_time()
        scores = evaluator.score(T_obj_ee, T_world_ee, trials)
        seconds = time.process_time() - start
    return scores, torch.cat(slack), seconds


def report_changes(report: Report, name: str, a: Scores, b: Scores) -> None:
    """Motions, and trials whose verdict differs: all, and those outside the 0.1 mm band."""
    differ = a.outcome != b.outcome
    outside = differ & ~(a.borderline | b.borderline)
    report.add(f"execute.{name}.moved_trials", int((a.path_len > 0).sum()))
    report.add(f"execute.{name}.verdicts_that_differ", int(differ.sum()))
    report.add(f"execute.{name}.outside_the_band", f"{int(outside.sum())} {a.trial_id[outside].tolist()}")


def run(options: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    mix = on(load_mix(n=options.trials)[0], options.device)

    def judge(**config: Any) -> Evaluator:
        configured = EvalConfig(execute=ExecConfig(**config))
        return Evaluator(load_benchmark(), configured, device=options.device, threads=options.threads)

    auto, scene = judge(sim="mujoco", model="auto"), judge(sim="mujoco", model="scene")
    _, _, seconds = scored(auto, mix)
    report.add("execute.speed.mujoco.auto.whole_trial_core_ms", 1e3 * seconds / len(mix[2]))
    of_scene, whole, _ = scored(scene, mix)
    of_arm, alone, _ = scored(judge(sim="mujoco", model="arm"), mix)
    report_changes(report, "models", of_arm, of_scene)
    report.add("execute.models.finger_sway_max_um", 1e6 * float((whole - alone).nan_to_num().max()))
    report_changes(report, "parity", of_scene, scored(judge(sim="mjwarp", model="scene"), mix)[0])
    trials = load_benchmark().trials_with_ids(torch.arange(options.auto_trials)).to(options.device)
    answers = contact.predict(trials, auto.scene, seed=0)
    more = on((answers.T_obj_ee, answers.T_world_ee, trials), options.device)
    report_changes(report, "auto", scored(auto, more)[0], scored(scene, more)[0])


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        **DEVICE,
        "--trials": {"default": 256},
        "--threads": {"type": int, "help": "CPU threads (default: one per core)"},
        "--auto-trials": {"default": 2000, "help": "of `auto` against `scene`"},
    },
    peer="MuJoCo C and MuJoCo-Warp, each with arm alone and whole scene",
)

if __name__ == "__main__":
    BENCH.main()
