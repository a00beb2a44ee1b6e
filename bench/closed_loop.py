"""Which methods keep their rank when the hand moves: docs/results/questions.md.

`python bench/closed_loop.py` plays the shipped baselines of the default benchmark in closed loop. `--growth N` plays N episodes
in one process, for memory, and writes closed_loop_growth.json.
"""

import argparse
from functools import partial
from typing import Any

import numpy as np
import torch
from _report import ROOT, Report, markdown_table, memory_over
from _rows import rate_over_categories
from run import Bench

MEASURES = (
    "bench/closed_loop.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/closed_loop",
)
CASES = (("still", "planned"), ("moves", "planned"), ("moves", "stop"), ("moves", "servo"), ("moves", "replan"))
GROWN = ROOT / "bench" / "results" / "closed_loop_growth.json"


def answers(trials: int, *only: str) -> tuple[list[str], int, Any]:
    """The shipped baselines, or some of them, how many trials each has, and the scores of all: method by method."""
    from r2h_batch import load_benchmark
    from r2h_batch.report import load_baselines
    from r2h_batch.sweep.results.judge import Judge

    run = load_baselines(load_benchmark()).only(only)
    judge = Judge(run)
    grasps: list[torch.Tensor] = []
    places: list[torch.Tensor] = []
    for name in run.methods:
        poses = run.poses(name)
        poses = poses.filter(poses["trial_id"].to_numpy() < 2 * trials)
        for into, k in ((grasps, "T_obj_ee"), (places, "T_world_ee")):
            into.append(torch.tensor(poses[k].to_pylist(), dtype=torch.float32).reshape(-1, 4, 4))
        ids = poses["trial_id"].to_numpy()
    asked = judge.trials(ids)
    asked = asked[torch.arange(len(asked)).repeat(len(run.methods))]
    scores = judge.evaluator.kinematic.score(torch.cat(grasps), torch.cat(places), asked)
    assert all(torch.equal(t, asked.trial_id[: len(ids)]) for t in asked.trial_id.split(len(ids)))
    return list(run.methods), len(ids), scores


def played(scores: Any, motion: str, policy: str) -> Any:
    """Episodes of all rows."""
    from r2h_batch.closed_loop.env import LoopConfig
    from r2h_batch.closed_loop.episodes import Loop
    from r2h_batch.closed_loop.moving import ReceiverMotion

    return Loop(ReceiverMotion.parse(motion), policy, LoopConfig())(scores)


def bits(flags: np.ndarray) -> str:
    """A flag of each trial, "0" or "1": one line of the JSON."""
    return "".join("01"[int(flag)] for flag in flags)


def growth(trials: int) -> dict[str, Any]:
    """Resident memory over so many episodes, played by `Loop` as a sweep plays its shards."""
    from r2h_batch.closed_loop.env import LoopConfig
    from r2h_batch.closed_loop.episodes import AT_ONCE, Loop
    from r2h_batch.closed_loop.moving import ReceiverMotion

    torch.set_num_threads(1)
    _, n, scores = answers(AT_ONCE // 2, "oracle")

    def again(done: int) -> int:
        seed = done // n
        Loop(ReceiverMotion("moves", seed=seed), "servo", LoopConfig(seed=seed))(scores)
        return n

    return memory_over(trials, again)


def measure(options: argparse.Namespace, report: Report) -> dict[str, Any]:
    """All figures of the page; or memory, and nothing else."""
    if options.growth:
        options.json, grown = GROWN, growth(options.growth)
        report.add("closed_loop_growth.episodes", grown["trials"])
        report.add("closed_loop_growth.memory_mib_first", grown["mib"][0])
        report.add("closed_loop_growth.memory_mib_most", max(grown["mib"]))
        return {}
    from r2h_batch import load_benchmark
    from r2h_batch.closed_loop.env import End

    trials = options.trials
    names, n, scores = answers(trials)
    rows = {name: slice(k * n, (k + 1) * n) for k, name in enumerate(names)}
    methods: dict[str, Any] = {name: {"sr": bits(scores.success[r].numpy()), "cases": {}} for name, r in rows.items()}
    for motion, policy in CASES:
        episodes = played(scores, motion, policy)
        for name, r in rows.items():
            won = episodes.end[r].numpy() == End.SUCCESS
            methods[name]["cases"][f"{motion}, {policy}"] = {"won": bits(won)}
            print(name, motion, policy, int(won.sum()), flush=True)
    benchmark, asked = load_benchmark(), scores.inputs.trials[:n]
    own = [benchmark.objects[i].category for i in asked.object_index.tolist()]
    return {
        "trials": trials,
        "benchmark": benchmark.name,
        "asked": {"split": asked.splits, "category": own},
        "methods": methods,
    }


def shown(data: dict[str, Any]) -> dict[str, Any]:
    """Tables and words of the page."""
    from r2h_batch.report.text import short_names

    methods, short = data["methods"], short_names(list(data["methods"]))
    cases = [f"{m}, {p}" for m, p in CASES]
    rate = partial(rate_over_categories, trials=data["asked"])
    rows = [[short[name], rate(m["sr"]), *(rate(m["cases"][c]["won"]) for c in cases)] for name, m in methods.items()]
    return {
        "table": markdown_table(["Method", "SR", *cases], rows),
    }


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {
        "--trials": {"default": 50, "help": "of each split"},
        "--growth": {"type": int, "metavar": "N", "help": "memory over N episodes, and nothing else"},
    },
    stored="closed_loop",
)

if __name__ == "__main__":
    BENCH.main()
