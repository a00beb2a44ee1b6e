"""How many lanes of a GPU's warps would work, and how long the slowest is waited for: counted on a CPU, problem by problem.

Every row of every launch runs alone, and its thread time is its cost. A warp takes 32 rows that follow each other and is busy
until its slowest ends, so its useful lanes are sum(cost) / (32 max(cost)): an upper bound, for rows that take different
branches at the same time divide a warp further. The longest chain of a kernel is its slowest row, of
several launches the sum of their slowest. `_packed`: what rows would give that have nothing to do if they stood behind all
others; `_sorted`: if rows were sorted by their true cost, the bound of any order.
"""

import time
from collections import defaultdict
from collections.abc import Mapping
from typing import Any
from unittest import mock

import numpy as np
import torch
from _frontier_lanes import counting
from _report import Report

from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import distance, plan
from r2h_batch.judge.frontier.levels import planning_form
from r2h_batch.launch import launch_trials
from r2h_batch.methods import random
from r2h_batch.trials.protocol import trials_with_ids

WARP, IDLE_US = 32, 5.0
RARE = ("path_overlap", "hand_overlap", "point_to_object")
"""Kernels of a few rows, or of few instructions a row."""


class Lanes:
    """Costs (us) of each kernel's rows, launch by launch."""

    def __init__(self) -> None:
        self.costs: dict[str, list[np.ndarray]] = defaultdict(list)

    def launch(
        self, kernel: Any, n: int, *, inputs: Mapping[str, Any], outputs: Mapping[str, Any], first: int = 0, **ways: Any
    ) -> None:
        """As `launch_trials` on a CPU, one row at a time; what the call itself takes is the least of all rows."""
        if n == 0:
            return
        cost = np.zeros(n)
        for i in range(n):
            start = time.thread_time_ns()
            launch_trials(kernel, 1, inputs=inputs, outputs=outputs, device="cpu", threads=1, first=first + i)
            cost[i] = (time.thread_time_ns() - start) / 1e3
        self.costs[kernel.key].append(np.maximum(cost - cost.min(), 0.0) if n >= WARP else cost)


def useful(launches: list[np.ndarray]) -> float:
    """Share of the lanes' time in which they work, of all launches of a kernel."""
    work = waited = 0.0
    for cost in launches:
        warps = np.pad(cost, (0, -len(cost) % WARP)).reshape(-1, WARP)
        work += warps.sum()
        waited += WARP * warps.max(1).sum()
    return work / waited if waited else 1.0


def packed(cost: np.ndarray) -> np.ndarray:
    """The rows in their order, those with nothing to do behind the others."""
    idle = cost < IDLE_US
    return np.concatenate([cost[~idle], cost[idle]])


def longest_us(launches: list[np.ndarray]) -> float:
    """The slowest row of each launch, one launch after the other."""
    return float(sum(cost.max() for cost in launches))


def report_lanes(report: Report, trials: int) -> None:
    """Lines of one chunk of `random` trials in the GPU's form: each stage, the least useful of them, the longest chain of all.

    What goes level by level is counted by _frontier_lanes.py, kernels of one thread a trial row by row.
    """
    evaluator, lanes = Evaluator(EvalConfig(execute=ExecConfig(sim="none"), chunk=trials), threads=1), Lanes()
    batch = trials_with_ids(torch.arange(trials), objects=evaluator.scene.objects, protocol="r2h-v0")
    poses = random.predict(batch, evaluator.scene, seed=0)
    asked = poses.T_obj_ee, poses.T_world_ee, batch
    evaluator.score(*asked)
    with (
        planning_form("frontier"),
        counting() as counted,
        mock.patch.object(plan, "launch_trials", lanes.launch),
        mock.patch.object(distance, "launch_trials", lanes.launch),
    ):
        evaluator.score(*asked)
    kept = {k: v for k, v in lanes.costs.items() if k not in RARE}
    found = {name: counted.of_stage(name) for name in counted.stages()}
    found |= {name: (useful(launches), longest_us(launches)) for name, launches in kept.items()}
    for name, (share, chain) in found.items():
        report.add(f"gpu_build.useful_lanes.{name}", share)
        report.add(f"gpu_build.longest_chain_us.{name}", chain)
    for name, share in zip(("", "_thread_a_pair", "_warp_a_problem"), counted.of_gjk(), strict=True):
        report.add(f"gpu_build.useful_lanes_gjk{name}", share)
    for name, launches in kept.items():
        report.add(f"gpu_build.useful_lanes_packed.{name}", useful([packed(x) for x in launches]))
        report.add(f"gpu_build.useful_lanes_sorted.{name}", useful([np.sort(x) for x in launches]))
    report.add("gpu_build.useful_lanes_min", min(share for share, _ in found.values()))
    report.add("gpu_build.longest_chain", max(chain for _, chain in found.values()))
