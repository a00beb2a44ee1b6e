"""How long does the longest problem take, and what does the search miss that plain RRT-Connect finds in 5,000 iterations?

python bench/tail.py [--trials N] [--first ID] [--json FILE]

Trials: the first N of r2h-v0 with the predictions of the method `random`, whose goals are anywhere: one search in a thousand
of these is hard. longest_ms: process time of all searches and shortcuts of one problem, the largest; seconds that a GPU or
the last core waits for it. searched: problems without a free straight line. lost, gained: trials that have a path with
plain RRT-Connect (`rounds=(5000,)`: steps of one length, all goals) and not by default, and the other way round; their ids
are the trials whose reason differs. detour_*, over_bound_*: see bench/plan.py.
"""

import time
from collections import defaultdict
from typing import Any
from unittest import mock

import torch
from _detours import detours, report_detours
from _report import Report, arguments
from _twins import Batch, Problems, solve

from r2h_batch.config import EvalConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import plan
from r2h_batch.launch import launch_trials
from r2h_batch.methods import random
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.protocol import trials_with_ids
from r2h_batch.types import PlanReason

NO_PATH = int(PlanReason.NO_PATH_IN_BUDGET)
PART = 20_000
"""Trials that are planned at a time."""


def timed(scene: Scene, batch: Batch) -> tuple[Problems, dict[int, float]]:
    """The batch planned on one thread, and the seconds that each searched problem took by trial id."""
    spent: dict[int, float] = defaultdict(float)

    def one_by_one(*job: Any, **kwargs: Any) -> None:
        rows = kwargs["inputs"].get("trial")
        if rows is None:
            launch_trials(*job, **kwargs)
            return
        kernel, n = job
        one = (kernel, 1)
        for i in range(n):
            start = time.process_time()
            launch_trials(*one, **{**kwargs, "first": i})
            spent[int(batch.trials.trial_id[int(rows[i])])] += time.process_time() - start

    with mock.patch.object(plan, "launch_trials", one_by_one):
        return solve(scene, batch, threads=1), spent


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=2048)
    parser.add_argument("--first", type=int, default=0, help="id of the first trial")
    options = parser.parse_args()
    report = Report()
    scene = Evaluator(EvalConfig(), threads=1).scene
    spent: dict[int, float] = {}
    lost, gained, ratios, none = [], [], [], []
    for first in range(options.first, options.first + options.trials, PART):
        ids = torch.arange(first, min(first + PART, options.first + options.trials))
        trials = trials_with_ids(ids, objects=scene.objects, hand_set=scene.hands.set, protocol="r2h-v0")
        answer = random.predict(trials, scene, seed=0)
        batch = Batch(trials, answer.T_obj_ee, answer.T_world_ee)
        if first == options.first:
            solve(scene, batch.rows(slice(0, 64)), threads=1)  # kernels are compiled or loaded here
        ours, seconds = timed(scene, batch)
        spent |= seconds
        found = ours.plan.length > 0
        hard = torch.nonzero(torch.isin(ids, torch.tensor(sorted(seconds)))).flatten()  # no straight line
        plain = solve(scene, batch.rows(hard), PlanConfig(rounds=(5000,)), threads=1).plan.length > 0
        lost += ids[hard[plain & ~found[hard]]].tolist()
        gained += ids[hard[~plain & found[hard]]].tolist()
        none += ids[ours.plan.reason == NO_PATH].tolist()
        ratios.append(torch.from_numpy(detours(scene, ours)))
    report.add("tail.trials", options.trials)
    report.add("tail.searched", len(spent))
    longest = max(spent, key=lambda i: spent[i])
    report.add("tail.longest_ms", 1e3 * spent[longest])
    report.add("tail.longest_trial_id", longest)
    report.add("tail.search_ms_mean", 1e3 * sum(spent.values()) / len(spent))
    report.add("tail.no_path_in_budget", len(none))
    report.add("tail.no_path_trial_ids", " ".join(map(str, none)) or "none")
    report.add("tail.lost", len(lost))
    report.add("tail.lost_trial_ids", " ".join(map(str, lost)) or "none")
    report.add("tail.gained", len(gained))
    report.add("tail.gained_trial_ids", " ".join(map(str, gained)) or "none")
    report_detours(report, "tail", torch.cat(ratios).numpy())
    report.write(options.json)


if __name__ == "__main__":
    main()
