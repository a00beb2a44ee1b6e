"""The planner level by level (a GPU's form) against one thread a trial (a CPU's): the same goals, lines, verdicts."""

from contextlib import ExitStack
from functools import cache
from types import ModuleType
from unittest import mock

import numpy as np
import pytest
import torch
from problems import Problems, assert_same, default_evaluator, make_batch, solve

from r2h_batch.config import CLEARANCE_TOLERANCE_M, HOME_Q, EvalConfig, ExecConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.frontier import levels, safe, shortcuts
from r2h_batch.judge.plan import Plan
from r2h_batch.judge.planner import Planner  # of one thread, on paths that are given
from r2h_batch.methods import oracle, random
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.protocol import make_trials, trials_with_ids
from r2h_batch.types import Scores

PLANS = {"exact": PlanConfig(), "moveit": PlanConfig(goals="one", edge_check="moveit")}


@cache
def one_thread(scene: Scene, plan: str, n: int) -> Problems:
    return solve(scene, make_batch(scene, n, random_share=0.5), PLANS[plan])


def by_frontier(scene: Scene, plan: str, n: int) -> Plan:
    with levels.planning_form("frontier"):
        return solve(scene, make_batch(scene, n, random_share=0.5), PLANS[plan]).plan


def free_paths_to_goals(scene: Scene, problems: Problems, plan: Plan, rows: torch.Tensor) -> None:
    """Paths of those rows begin at home, end in a joint solution, and keep clear of everything, as one thread sees it."""
    least, _, _ = Planner(scene, problems.body_poses, None).clearance(plan.path, plan.length)
    assert (least[rows] > 0).all() and (least - plan.clearance_m)[rows].abs().max() <= CLEARANCE_TOLERANCE_M
    assert torch.equal(plan.path[rows, 0], torch.tensor(HOME_Q, dtype=torch.float32).expand(int(rows.sum()), 6))
    ends = plan.path[torch.arange(len(rows)), plan.length.long() - 1]
    assert ((problems.ik.q == ends[:, None]).all(-1) & problems.ik.valid).any(1)[rows].all()
    bounds = [torch.from_numpy(x).float() for x in (scene.robot.lower, scene.robot.upper)]
    assert ((plan.path >= bounds[0]) & (plan.path <= bounds[1]))[rows].all(-1)[:, 0].all()


def compare(scene: Scene, plan: str, n: int) -> Plan:
    """Of n trials, half of them sensible, what one thread finds: reasons, and paths, other ones only where they were searched.

    Clearances of the same path are within the tolerance of both. Sampled edges (moveit) are searched by one thread in both forms.
    """
    problems, there = one_thread(scene, plan, n), by_frontier(scene, plan, n)
    here = problems.plan
    for name in ("reason", "straight"):
        assert torch.equal(getattr(here, name), getattr(there, name)), name
    assert torch.equal(here.pair[here.length == 0], there.pair[here.length == 0])  # what rules a start or all goals out
    searched = (here.length > 0) & ~here.straight
    assert searched.sum() >= n // 50
    if plan == "exact":
        free_paths_to_goals(scene, problems, there, searched)
    found = (here.length > 0) & (here.straight if plan == "exact" else True)
    assert torch.equal(here.length[found], there.length[found])
    assert torch.equal(here.path[found], there.path[found])
    assert (here.clearance_m - there.clearance_m)[found].abs().max() <= CLEARANCE_TOLERANCE_M
    assert torch.equal(here.clearance_m[found] < 0, there.clearance_m[found] < 0)
    nearest = found & (there.clearance_m == here.clearance_m)
    assert torch.equal(here.body[nearest], there.body[nearest])
    return there


@pytest.mark.parametrize("n", [pytest.param(96, marks=pytest.mark.check), pytest.param(1024, marks=pytest.mark.slow)])
@pytest.mark.parametrize("plan", PLANS)
def test_the_frontier_finds_what_one_thread_finds(scene: Scene, plan: str, n: int) -> None:
    found = compare(scene, plan, n)
    assert found.straight.sum() >= 20 and (found.length == 0).sum() >= 20


@pytest.mark.slow
@pytest.mark.parametrize("method", [random, oracle], ids=["random", "oracle"])
def test_a_problem_that_one_form_solves_the_other_solves_too(scene: Scene, method: ModuleType) -> None:
    """Random answers, whose searches are the hardest; an oracle's, which are the most crowded. Whoever finds no path spends
    all rounds."""
    trials = trials_with_ids(torch.arange(2048), objects=scene.objects, protocol="r2h-v0")
    poses = method.predict(trials, scene, seed=0)
    evaluator = Evaluator(EvalConfig(execute=ExecConfig(sim="none"), chunk=2048))
    here = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)
    with levels.planning_form("frontier"):
        there = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)
    differ = (here.outcome != there.outcome) & ~here.borderline & ~there.borderline
    assert torch.equal(here.path_len > 0, there.path_len > 0) and not differ.any()
    assert (here.path != there.path).flatten(1).any(1).sum() >= 100


SHORT = {
    "planning": {(levels, "LEAST"): 256, (levels, "PER_ROW"): 1},
    "Safe": {(safe, "PER_INTERVAL"): {**safe.PER_INTERVAL, "bodies": 1}, (levels, "LEAST"): 1 << 12},
}


def test_rows_do_not_depend_on_their_batch_their_place_or_the_number_of_lanes(scene: Scene) -> None:
    """Goals, lines, searches, shortcuts, clearances and Safe; then motions that nobody certified, some through the hand."""
    wide = make_batch(scene, 640, random_share=0.5)
    found = solve(scene, wide).plan
    searched, others = (torch.nonzero(x).flatten() for x in ((found.length > 2), found.length <= 2))
    batch = wide.rows(torch.cat([searched[:24], others[:24]]))
    evaluator = Evaluator(EvalConfig(execute=ExecConfig(sim="none")))
    noise = 0.1 * torch.randn((48, 1, 6), generator=torch.Generator().manual_seed(5))

    def judged(rows: slice | torch.Tensor) -> tuple[Scores, Scores]:
        b = batch.rows(rows)
        scores = evaluator.score(b.T_obj_ee, b.T_world_ee, b.trials)
        at, moved = torch.arange(48)[rows] < 24, scores.path + noise[rows]
        paths = b.T_obj_ee[at], moved[at], scores.path_time_s[at], b.trials[at]
        return scores, evaluator.score_motion(*paths, length=scores.path_len[at])

    with levels.planning_form("frontier"):
        scores, moved = judged(slice(None))
        assert (scores.path_len > 2).sum() >= 20 and (moved.margin[:, 4] < 0).sum() >= 2
        order = torch.from_numpy(np.random.default_rng(1).permutation(48))
        for rows in (order, slice(20, 27)):
            part, part_moved = judged(rows)
            assert_same(part, scores[rows])
            assert_same(part_moved, moved[torch.arange(48)[rows][torch.arange(48)[rows] < 24]])
        for module, name, few in ((levels, "LANES", 7), (shortcuts, "LANES_AT_ONCE", 24)):  # 24: three paths at once
            with mock.patch.object(module, name, few):
                part, part_moved = judged(slice(None))
            assert_same(part, scores)
            assert_same(part_moved, moved)


@pytest.mark.parametrize("what", SHORT)
def test_where_queues_are_too_short_fewer_rows_go_at_once_and_come_out_the_same(
    scene: Scene, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    evaluator = Evaluator(EvalConfig(execute=ExecConfig(sim="none"), chunk=48))
    trials = trials_with_ids(torch.arange(48), objects=scene.objects, protocol="r2h-v0")
    poses = oracle.predict(trials, scene, seed=0)
    with levels.planning_form("frontier"), ExitStack() as patched:
        whole = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)
        for (module, name), value in SHORT[what].items():
            patched.enter_context(mock.patch.object(module, name, value))
        assert_same(evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials), whole)
    assert "out of memory with 48 rows" in caplog.text


def test_a_single_row_has_room_for_its_whole_path() -> None:
    """Trial 79 of the method `random`: its clearance needs more than 4,096 intervals at once."""
    evaluator, trials = default_evaluator().kinematic, make_trials(trials=100)
    asked = random.predict(trials, evaluator.scene, seed=0)
    row = trials.trial_id == 79
    with levels.planning_form("frontier"):
        scores = evaluator.score(asked.T_obj_ee[row], asked.T_world_ee[row], trials[row])
    assert scores.path_len[0] > 2


def test_a_queue_that_is_too_short_ends_the_batch_and_says_so(scene: Scene) -> None:
    few = mock.patch.multiple(levels, LEAST=256, PER_ROW=1)
    with levels.planning_form("frontier"), few:
        with pytest.raises(MemoryError, match="cannot allocate"):
            solve(scene, make_batch(scene, 96, random_share=0.0))
        full = levels.Frontier(scene.world, None, "cpu", 1)
        assert full.rows_where(torch.tensor([False, True])).tolist() == [1]
        full.full.fill_(1)  # as a GPU's queues say it: with the rows that are asked for anyway
        with pytest.raises(MemoryError, match="fewer rows at once"):
            full.rows_where(torch.tensor([False, True]))
