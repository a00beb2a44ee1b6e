"""Shortcuts level by level (a GPU's form), on a CPU: certified, never longer, as good as those of one thread, batch or not."""

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from types import ModuleType
from unittest import mock

import numpy as np
import pytest
import torch
from problems import make_batch, solve

from r2h_batch.base.launch import launch_trials
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.frontier import levels
from r2h_batch.judge.search import GOOD_ENOUGH_RATIO, Search
from r2h_batch.kernels.plan.codes import BRANCHES, CERTIFY
from r2h_batch.kernels.plan.lines import straight_lines
from r2h_batch.methods import oracle, random
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.protocol import trials_with_ids


@dataclass(frozen=True)
class Asked:
    """Paths as a search finds them, before shortcuts and after those of one thread."""

    search: Search
    seed: int
    margin: torch.Tensor
    rows: torch.Tensor
    path: torch.Tensor
    length: torch.Tensor
    path_of_one: torch.Tensor
    length_of_one: torch.Tensor

    def by_frontier(self) -> tuple[torch.Tensor, torch.Tensor]:
        path, length = self.path.clone(), self.length.clone()
        with levels.planning_form("frontier"):
            planner = copy(self.search.planner)
            planner.frontier = levels.Frontier(**planner._tables, device="cpu", rows=len(length))
            search = replace(self.search, planner=planner)
            search._shorten(self.rows, self.seed, self.margin, path, length)
        return path, length

    def times(self, path: torch.Tensor, length: torch.Tensor) -> torch.Tensor:
        return self.search._time(path, length)[self.rows.long()]


def asked_while(call: Callable[[], object]) -> list[Asked]:
    """What one thread is asked to shorten, and what it makes of it."""
    asked, shorten = [], Search._shorten

    def noted(
        self: Search, rows: torch.Tensor, seed: int, margin: torch.Tensor, path: torch.Tensor, length: torch.Tensor
    ) -> None:
        before = path.clone(), length.clone()
        shorten(self, rows, seed, margin, path, length)
        searched = rows[before[1][rows.long()] > 2]
        asked.append(Asked(self, seed, margin.clone(), searched, *before, path.clone(), length.clone()))

    with mock.patch.object(Search, "_shorten", noted):
        call()
    return asked


@pytest.fixture(scope="module")
def first(scene: Scene) -> Asked:
    """Of 640 trials those that are searched: some dozens, before the first shortcuts."""
    found = asked_while(lambda: solve(scene, make_batch(scene, 640, random_share=0.5)))[0]
    assert len(found.rows) >= 24
    return found


def all_certified(asked: Asked, path: torch.Tensor, length: torch.Tensor, less: float = 0.0) -> bool:
    """Whether one thread certifies every segment of those rows with the margin that was asked for, or a little `less`."""
    margin = (asked.margin - less)[:, None].expand(-1, BRANCHES).reshape(-1)
    chosen = torch.full_like(length, -1)
    for row in asked.rows.tolist():
        for k in range(int(length[row]) - 1):
            goals = path[:, k + 1].repeat_interleave(BRANCHES, 0)
            inputs = {"start": path[:, k].contiguous(), "goals": goals, "n_goals": torch.ones_like(length)}
            inputs |= {"edge_mode": CERTIFY, "goal_margin": margin} | asked.search.planner._tables
            launch_trials(straight_lines, 1, inputs=inputs, outputs={"chosen": chosen}, device="cpu", first=row)
            if chosen[row] != 0:
                return False
    return True


@pytest.mark.check
def test_shortcuts_are_certified_and_never_longer_than_what_they_started_from(first: Asked) -> None:
    path, length = first.by_frontier()
    rows = first.rows.long()
    before, after = first.times(first.path, first.length), first.times(path, length)
    assert (after <= before).all() and (after < 0.8 * before).sum() >= len(rows) // 4
    assert all_certified(first, path, length, less=1e-5)
    last = torch.arange(len(rows)), length[rows].long() - 1
    assert torch.equal(path[rows, 0], first.path[rows, 0])
    assert torch.equal(path[rows][last], first.path[rows, first.length[rows].long() - 1])
    others = torch.ones(len(length), dtype=torch.bool)
    others[rows] = False
    assert torch.equal(path[others], first.path[others]) and torch.equal(length[others], first.length[others])
    # that a segment is certified says something: those of the straight lines between the ends are not
    straight = first.path.clone()
    straight[rows, 1] = first.path[rows, first.length[rows].long() - 1]
    assert not all_certified(first, straight, torch.full_like(first.length, 2), less=1e-5)


def as_good(asked: list[Asked]) -> None:
    """About as quick as one thread's, in units of the straight line between the ends: in the middle, at the slow end, each."""
    of_one, of_frontier = [], []
    for one in asked:
        path, length = one.by_frontier()
        line = torch.stack([one.path[:, 0], one.path[torch.arange(len(one.length)), one.length.long() - 1]], 1)
        straight = one.times(line, torch.full_like(one.length, 2))
        of_one.append(one.times(one.path_of_one, one.length_of_one) / straight)
        of_frontier.append(one.times(path, length) / straight)
    here, there = torch.cat(of_one).numpy(), torch.cat(of_frontier).numpy()
    for share in (50, 95):
        assert np.percentile(there, share) <= 1.02 * np.percentile(here, share), share
    assert (there / here).mean() <= 1.0 and (there > GOOD_ENOUGH_RATIO * here).mean() < 0.06


def test_they_are_about_as_good_as_those_of_one_thread(first: Asked) -> None:
    as_good([first])


@pytest.mark.slow
@pytest.mark.parametrize("method", [random, oracle], ids=["random", "oracle"])
def test_they_are_about_as_good_in_two_thousand_trials(scene: Scene, method: ModuleType) -> None:
    trials = trials_with_ids(torch.arange(2048), objects=scene.objects, protocol="r2h-v0")
    poses = method.predict(trials, scene, seed=0)
    evaluator = Evaluator(EvalConfig(execute=ExecConfig(sim="none"), chunk=2048))
    asked = asked_while(lambda: evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials))
    assert sum(len(x.rows) for x in asked) >= 100
    as_good(asked)
    for one in asked:
        assert all_certified(one, *one.by_frontier(), less=1e-5)


def test_a_path_that_is_full_of_waypoints_stays_within_its_array(scene: Scene, first: Asked) -> None:
    """Points on the segments of short paths, as many as there is room for: all of it is shortened, nothing runs over."""
    path, length = first.path.clone(), first.length.clone()
    for row in first.rows.tolist():
        there = first.path[row, : first.length[row]]
        s = torch.linspace(0, len(there) - 1, path.shape[1])
        k = s.long().clamp(max=len(there) - 2)
        path[row] = torch.lerp(there[k], there[k + 1], (s - k)[:, None])
        path[row, -1] = there[-1]
        length[row] = path.shape[1]
    full = replace(first, path=path, length=length)
    found, n = full.by_frontier()
    saved = full.times(found, n) / full.times(path, length)
    assert (n <= path.shape[1]).all() and saved.max() < 1.0 and saved.median() < 0.5
    assert all_certified(full, found, n, less=1e-5)
