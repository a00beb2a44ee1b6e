"""The planner level by level (a GPU's form) against one thread a trial (a CPU's): the same goals, paths, verdicts."""

from contextlib import ExitStack
from dataclasses import fields
from functools import cache
from unittest import mock

import numpy as np
import pytest
import torch
from problems import Problems, assert_same, default_evaluator, make_batch, solve

from r2h_batch import load_benchmark
from r2h_batch.config import CLEARANCE_TOLERANCE_M, EvalConfig, ExecConfig, PlanConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.distance import SAFE_TOLERANCE_M
from r2h_batch.judge.frontier import levels, safe
from r2h_batch.judge.frontier.form import planning_form
from r2h_batch.judge.plan import Plan
from r2h_batch.methods import oracle, random
from r2h_batch.scene.robot import load_robot
from r2h_batch.scene.scene import Scene
from r2h_batch.types import CRITERIA, Scores

PLANS = {"exact": PlanConfig(), "moveit": PlanConfig(goals="one", edge_check="moveit")}


@cache
def one_thread(scene: Scene, plan: str, n: int) -> Problems:
    return solve(scene, make_batch(scene, n, random_share=0.5), PLANS[plan])


def by_frontier(scene: Scene, plan: str, n: int) -> Plan:
    with planning_form("frontier"):
        return solve(scene, make_batch(scene, n, random_share=0.5), PLANS[plan]).plan


def compare(scene: Scene, plan: str, n: int) -> Plan:
    """Both forms find in n trials, half of them sensible, the same reasons and the same paths to the bit.

    Clearances are within the tolerance of both.
    """
    here, there = one_thread(scene, plan, n).plan, by_frontier(scene, plan, n)
    for name in ("reason", "straight", "length"):
        assert torch.equal(getattr(here, name), getattr(there, name)), name
    found = here.length > 0
    assert torch.equal(here.pair[~found], there.pair[~found])  # what rules a start or all goals out
    assert (found & ~here.straight).sum() >= n // 50
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


PLAN, SAFE = CRITERIA.index("plan"), CRITERIA.index("safe")
SEARCHED_MINIMA = ("margin", "witness_point", "witness_time_s")
"""The fields that hold a smallest clearance, or its place or time. Each form searches it until nothing nearer by more
than a tolerance is left."""
DIFFERS_SHARE = 0.005
"""In few rows the forms end at other ones of the minima that the tolerance does not tell apart."""
FULL = [pytest.param(robot, 2000, marks=pytest.mark.slow, id=robot) for robot in ("ur5e_2f85", "panda_hand")]


@pytest.mark.parametrize(("robot", "n"), [("ur5e_2f85", 300), *FULL])
def test_rows_of_both_forms_have_the_same_bits(robot: str, n: int) -> None:
    """Straight, searched and failed. In 0.5 % of the rows Plan's and Safe's smallest clearance, and where Safe's is, may differ,
    within its tolerance."""
    evaluator = Evaluator(
        load_benchmark("r2h-v1").on(load_robot(robot)), EvalConfig(execute=ExecConfig(sim="none"), chunk=n)
    )
    trials = (
        load_benchmark("r2h-v1").with_objects(evaluator.scene.objects).trials_with_ids(torch.arange(20_000, 20_000 + n))
    )
    poses = random.predict(trials, evaluator.scene, seed=5)
    asked = poses.T_obj_ee, poses.T_world_ee, trials
    here = evaluator.score(*asked)
    with planning_form("frontier"):
        there = evaluator.score(*asked)
    counts = {"straight": here.path_len == 2, "searched": here.path_len > 2, "failed": here.path_len == 0}
    print(robot, {name: int(rows.sum()) for name, rows in counts.items()})
    assert counts["searched"].sum() >= n // 50 and min(counts["straight"].sum(), counts["failed"].sum()) >= n // 4
    off = (here.margin - there.margin).abs().nan_to_num(0.0)
    pairs = [(getattr(here, f).reshape(n, -1), getattr(there, f).reshape(n, -1)) for f in SEARCHED_MINIMA]
    other = torch.stack([(x.nan_to_num(9.0) != y.nan_to_num(9.0)).any(1) for x, y in pairs]).any(0)
    most = {name: float(off[:, CRITERIA.index(name)].max()) for name in ("plan", "safe")}
    print(f"{int(other.sum())} with other bits; margins by {most} m at most")
    assert other.sum() <= DIFFERS_SHARE * n
    assert (off[:, SAFE] <= (0.002 * here.margin[:, SAFE].abs().nan_to_num(0.0)).clamp(min=SAFE_TOLERANCE_M)).all()
    assert off[:, PLAN].max() <= CLEARANCE_TOLERANCE_M
    assert_same(here[~other], there[~other])
    rest = [i for i in range(len(CRITERIA)) if i not in (PLAN, SAFE)]
    assert torch.equal(here.margin[:, rest].nan_to_num(9.0), there.margin[:, rest].nan_to_num(9.0))
    for f in fields(Scores):
        if f.name not in (*SEARCHED_MINIMA, "t_plan_s"):
            assert getattr(here, f.name).numpy().tobytes() == getattr(there, f.name).numpy().tobytes(), f.name


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
    evaluator = Evaluator(load_benchmark("r2h-v1"), EvalConfig(execute=ExecConfig(sim="none")))
    noise = 0.1 * torch.randn((48, 1, 6), generator=torch.Generator().manual_seed(5))

    def judged(rows: slice | torch.Tensor) -> tuple[Scores, Scores]:
        b = batch.rows(rows)
        scores = evaluator.score(b.T_obj_ee, b.T_world_ee, b.trials)
        at, moved = torch.arange(48)[rows] < 24, scores.path + noise[rows]
        paths = b.T_obj_ee[at], moved[at], scores.path_time_s[at], b.trials[at]
        return scores, evaluator.score_motion(*paths, length=scores.path_len[at])

    with planning_form("frontier"):
        scores, moved = judged(slice(None))
        assert (scores.path_len > 2).sum() >= 20 and (moved.margin[:, 4] < 0).sum() >= 2
        order = torch.from_numpy(np.random.default_rng(1).permutation(48))
        for rows in (order, slice(20, 27)):
            part, part_moved = judged(rows)
            assert_same(part, scores[rows])
            assert_same(part_moved, moved[torch.arange(48)[rows][torch.arange(48)[rows] < 24]])
        with mock.patch.object(levels, "LANES", 7):
            part, part_moved = judged(slice(None))
        assert_same(part, scores)
        assert_same(part_moved, moved)


@pytest.mark.parametrize("what", SHORT)
def test_where_queues_are_too_short_fewer_rows_go_at_once_and_come_out_the_same(
    scene: Scene, what: str, caplog: pytest.LogCaptureFixture
) -> None:
    evaluator = Evaluator(load_benchmark("r2h-v0"), EvalConfig(execute=ExecConfig(sim="none"), chunk=48))
    trials = load_benchmark("r2h-v0").with_objects(scene.objects).trials_with_ids(torch.arange(48))
    poses = oracle.predict(trials, scene, seed=0)
    with planning_form("frontier"), ExitStack() as patched:
        whole = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)
        for (module, name), value in SHORT[what].items():
            patched.enter_context(mock.patch.object(module, name, value))
        assert_same(evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials), whole)
    assert "out of memory with 48 rows" in caplog.text


def test_a_single_row_has_room_for_its_whole_path() -> None:
    """Trial 79 of the method `random`: its clearance needs more than 4,096 intervals at once."""
    evaluator, trials = default_evaluator("r2h-v1").kinematic, load_benchmark("r2h-v1").trials(100)
    asked = random.predict(trials, evaluator.scene, seed=0)
    row = trials.trial_id == 79
    with planning_form("frontier"):
        scores = evaluator.score(asked.T_obj_ee[row], asked.T_world_ee[row], trials[row])
    assert scores.path_len[0] > 2


def test_a_queue_that_is_too_short_ends_the_batch_and_says_so(scene: Scene) -> None:
    few = mock.patch.multiple(levels, LEAST=256, PER_ROW=1)
    with planning_form("frontier"), few:
        with pytest.raises(MemoryError, match="cannot allocate"):
            solve(scene, make_batch(scene, 96, random_share=0.0))
        full = levels.Frontier(scene.world, None, "cpu", 1)
        assert full.rows_where(torch.tensor([False, True])).tolist() == [1]
        full.full.fill_(1)  # as a GPU's queues say it: with the rows that are asked for anyway
        with pytest.raises(MemoryError, match="fewer rows at once"):
            full.rows_where(torch.tensor([False, True]))
