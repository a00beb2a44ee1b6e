"""How many lanes of a GPU's warps would work in planning and Safe, and how long the slowest is waited for: counted on a CPU.

Each entry of a launch (an interval, a body, a pair, a trial) runs alone, and its time is its cost. A warp takes 32 entries
that follow each other and is busy until its slowest ends, so its useful lanes are sum(cost) / (32 max(cost)). That is an upper
bound where lanes branch differently. It is a lower bound in GJK of the frontier, whose lanes take the next pair when their own is
done. The longest chain of a stage is the sum of its launches' slowest entries.

An entry of the frontier takes less than a launch does: it is run COPIES times in one launch, less an empty one, the least of
REPEATS. Of long launches WARPS warps are looked at, spread over all of it. Everything that the copies wrote is put back.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np
import torch
from _report import Report

from r2h_batch import load_benchmark
from r2h_batch.base import launch
from r2h_batch.base.launch import launch_trials
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import search
from r2h_batch.judge.frontier import levels, safe
from r2h_batch.judge.frontier.form import planning_form
from r2h_batch.kernels.frontier import queues, safe_queues
from r2h_batch.kernels.plan import codes
from r2h_batch.kernels.robot.joints import OBJECT
from r2h_batch.methods import random

WARP, COPIES, REPEATS, WARPS = 32, 32, 3, 64
STAGES = {
    "postures": (levels.Frontier, "check"),
    "straight_edges": (levels.Frontier, "straight"),
    "search": (search.Search, "_connect"),
    "shortcuts": (search.Search, "_shorten"),
    "clearances": (levels.Frontier, "clearance"),
    "safe": (safe.SafeFrontier, "__call__"),
}
BY_INTERVAL = {
    "interval_frames": 1,
    "clear_links": OBJECT + 1,
    "halve": 1,
    "safe_frames": 1,
    "safe_links": OBJECT,
    "safe_halves": 1,
}
"""Kernels with so many entries for each interval."""
BY_COUNT = {
    "near_hand": queues.BODIES + codes.HAND,
    "near_pieces": queues.BODIES + queues.PIECES,
    "near_table": queues.BODIES + codes.TABLE,
    "near_bodies": queues.BODIES + codes.SELF,
    "settle_pairs": queues.PAIRS,
    "safe_first_points": safe_queues.BODIES,
    "safe_pieces": safe_queues.BODIES,
    "safe_insides": safe_queues.BODIES,
    "safe_hulls": safe_queues.PIECES,
    "safe_corners": safe_queues.SETS,
    "safe_faces": safe_queues.SETS,
    "settle_faces": safe_queues.FACES,
}
"""Kernels with an entry for each of a queue's, by its place in the counts."""
GJK = {
    "pair_distances": ("pairs", queues.PAIRS, queues.TAKEN),
    "hull_distances": ("pieces", safe_queues.PIECES, safe_queues.TAKEN),
    "face_distances": ("faces", safe_queues.FACES, safe_queues.TAKEN),
}
"""Kernels whose lanes take the next pair: queue, its place in the counts, and that of the pairs taken."""
ADDED_TO = {
    "edges": ("found",),
    "frames": ("open",),
    "nearest": ("distance", "place", "above"),
    "body_queue": ("nearest", "meets"),
    "counts": ("n",),
}
"""Outputs that entries add to: sets of bits, minima, counts. All else that they write belongs to the entry, and is
written again."""
ONE_THREAD = ("rrt_connect", "shortcut")


class Lanes:
    """Costs (us) of entries, whole warps one after the other, launch by launch, with the share of the launch that they are."""

    def __init__(self) -> None:
        self.stage = ""
        self.costs: dict[str, list[tuple[float, np.ndarray]]] = defaultdict(list)

    def launch(
        self, kernel: Any, n: int, *, inputs: Mapping[str, Any], outputs: Mapping[str, Any], **ways: Any
    ) -> None:
        """As `launch_trials`; counts first, then runs."""
        name = kernel.key
        if name in ONE_THREAD:
            cost = np.zeros(n)
            for i in range(n):
                start = time.thread_time_ns()
                launch_trials(kernel, 1, inputs=inputs, outputs=outputs, device="cpu", threads=1, first=i)
                cost[i] = (time.thread_time_ns() - start) / 1e3
            if n:  # a row that has its path takes what the call takes; of few rows none may have one
                self.costs[self.stage].append((1.0, cost - cost.min() if n >= WARP else cost))
            return
        entries = entries_of(name, inputs)
        if entries:
            every = max(1, entries // (WARP * WARPS))
            looked = [i for i in range(entries) if i // WARP % every == 0]
            with put_back(inputs):
                cost = np.array(costs_of(kernel, inputs, outputs, looked))
            self.costs[self.stage].append((len(looked) / entries, cost))
        launch_trials(kernel, n, inputs=inputs, outputs=outputs, **ways)

    def labelled(self, stage: str, call: Callable[..., Any]) -> Callable[..., Any]:
        """`call`; what it launches is that stage's."""

        def labelled(*args: Any, **kwargs: Any) -> Any:
            before, self.stage = self.stage, stage
            try:
                return call(*args, **kwargs)
            finally:
                self.stage = before

        return labelled


def useful(launches: list[tuple[float, np.ndarray]]) -> float:
    """Share of the lanes' time in which they work, of all launches."""
    work = waited = 0.0
    for looked, cost in launches:
        slowest = np.pad(cost, (0, -len(cost) % WARP)).reshape(-1, WARP).max(1)
        work += cost.sum() / looked
        waited += WARP * slowest.sum() / looked
    return work / waited if waited else 1.0


def entries_of(name: str, inputs: Mapping[str, Any]) -> int:
    """Entries of a launch; 0 where they are not counted (making queues, witnesses: a few instructions a row)."""
    if name in BY_INTERVAL:
        return int(inputs["counts"].tensors["n"][int(queues.NOW) + inputs["parity"]]) * int(BY_INTERVAL[name])
    if name in BY_COUNT or name in GJK:
        return int(inputs["counts"].tensors["n"][int(GJK[name][1] if name in GJK else BY_COUNT[name])])
    return 0


@contextmanager
def put_back(inputs: Mapping[str, Any]) -> Iterator[None]:
    """Gives what entries add to its contents back at the end."""
    tensors = {name: inputs[name].tensors for name in ADDED_TO if name in inputs}
    changed = [x for name, of in tensors.items() for key, x in of.items() if key in ADDED_TO[name]]
    before = [x.clone() for x in changed]
    yield
    for x, saved in zip(changed, before, strict=True):
        x.copy_(saved)


def costs_of(kernel: Any, inputs: Mapping[str, Any], outputs: Mapping[str, Any], looked: list[int]) -> list[float]:
    """us of each entry."""
    counts = inputs["counts"].tensors["n"]
    before = counts.clone()
    alone = {**inputs, "lanes": 1 << 30} if "lanes" in inputs else inputs
    copied = dict(inputs[GJK[kernel.key][0]].tensors) if kernel.key in GJK else {}
    saved = {k: x[:COPIES].clone() for k, x in copied.items()}

    def us(i: int, copies: int) -> float:
        counts.copy_(before)
        first, width = i, copies
        if copied:  # the copies lie in the queue
            _queue, pairs, taken = GJK[kernel.key]
            counts[int(pairs)], counts[int(taken)] = copies, 0
            first, width = 0, 1
        start = time.thread_time_ns()
        launch_trials(kernel, 1, inputs=alone, outputs=outputs, device="cpu", threads=1, first=first, width=width)
        return (time.thread_time_ns() - start) / 1e3

    found = []
    beyond = 1 << 29  # no entry is there
    empty = min(us(beyond, 0 if copied else COPIES) for _ in range(20))
    for i in looked:
        copies = COPIES
        for k, x in copied.items():
            copies = min(COPIES, len(x))
            x[:copies] = saved[k][i] if i < COPIES else x[i].clone()
        found.append(max(min(us(i, copies) for _ in range(REPEATS)) - empty, 0.0) / copies)
    for k, x in copied.items():
        x[:COPIES] = saved[k]
    return found


def report_lanes(report: Report, trials: int) -> None:
    """Useful lanes and the longest chain of each stage, in the GPU's form, of one chunk of the method `random`."""
    evaluator, lanes = (
        Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=ExecConfig(sim="none"), chunk=trials), threads=1),
        Lanes(),
    )
    batch = load_benchmark("r2h-v1").with_objects(evaluator.scene.objects).trials_with_ids(torch.arange(trials))
    poses = random.predict(batch, evaluator.scene, seed=0)
    asked = poses.T_obj_ee, poses.T_world_ee, batch
    with planning_form("frontier"), ExitStack() as stack:
        whole = evaluator.score(*asked)
        for module in (levels, launch):  # `over_trials` of the planner launches in the latter
            stack.enter_context(mock.patch.object(module, "launch_trials", lanes.launch))
        for stage, (owner, name) in STAGES.items():
            stack.enter_context(mock.patch.object(owner, name, lanes.labelled(stage, getattr(owner, name))))
        counted = evaluator.score(*asked)
    if counted.margin.numpy().tobytes() != whole.margin.numpy().tobytes():
        raise RuntimeError("counting changed the rows: something that an entry wrote was not put back")
    report.add("gpu_lanes.trials", trials)
    report.add("gpu_lanes.searched", int((whole.path_len > 2).sum()))
    for stage, launches in lanes.costs.items():
        report.add(f"gpu_lanes.{stage}.useful", useful(launches))
        report.add(f"gpu_lanes.{stage}.cpu_ms", sum(float(cost.sum()) / looked for looked, cost in launches) / 1e3)
        report.add(f"gpu_lanes.{stage}.longest_chain_ms", sum(float(cost.max()) for _, cost in launches) / 1e3)
