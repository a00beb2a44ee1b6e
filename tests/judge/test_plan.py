"""Paths judged by MuJoCo C on dense samples of the timed motion; completeness against OMPL; options and reasons."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from oracle import mujoco_scene
from planning_twins import (
    HAND_MARGIN_M,
    checker_of,
    dense,
    jacobian_ik,
    motion_samples,
    ompl_solve,
    recheck,
    staged,
)  # fmt: skip
from problems import Problems, default_evaluator, make_batch, solve
from rounds import each

from r2h_batch.config import CLEARANCE_CAP_M, HOME_Q, PlanConfig
from r2h_batch.judge.ik import one_branch
from r2h_batch.judge.motion.time_law import time_path
from r2h_batch.judge.plan import GOAL_ROOM_M, WAYPOINTS, plan_paths, random_key
from r2h_batch.scene.robot import ee_pose
from r2h_batch.types import CollidingPair, PlanReason

HOME = np.array(HOME_Q)
CONTACT_M = 2e-5
"""MuJoCo's contact distances are this exact."""
PAIRS = {"hand": 1, "table": 2, "self": 3, "object_hand": 4, "object_table": 5, "object_robot": 6}
N = 256


@cache
def problems(n: int) -> Problems:
    """The first n trials, seven in ten with sensible predictions."""
    scene = default_evaluator().scene
    return solve(scene, make_batch(scene, n, random_share=0.3))


def waypoints(p: Problems, row: int) -> np.ndarray:
    return p.plan.path[row, : int(p.plan.length[row])].double().numpy()


def motion_of(p: Problems, row: int) -> np.ndarray:
    """Dense samples of a row's timed motion."""
    config = default_evaluator().config.execute
    times = time_path(p.plan.path[row : row + 1], p.plan.length[row : row + 1], config).time_s[0]
    path = waypoints(p, row)
    return motion_samples(path, times[: len(path)].double().numpy(), config)


def judge_paths(p: Problems, *, every: int = 1, start: torch.Tensor | None = None) -> int:
    """The number of paths looked at, each `every`-th of those returned, after asserting everything that a path promises."""
    begin = np.tile(np.float32(HOME), (len(p.batch), 1)) if start is None else start.numpy()
    scene = default_evaluator().scene
    robot = scene.robot
    rows = np.flatnonzero(p.plan.length.numpy() > 0)[::every]
    penetrating, too_near = [], []
    for row in rows:
        path = waypoints(p, row)
        assert 2 <= len(path) <= WAYPOINTS
        assert np.array_equal(path[0], begin[row].astype(np.float64))
        assert ((path >= robot.lower) & (path <= robot.upper)).all()
        target = p.batch.T_world_ee[row].double().numpy()
        reached = ee_pose(robot, path[-1])
        assert np.linalg.norm(reached[:3, 3] - target[:3, 3]) < 1e-5
        assert np.abs(reached[:3, :3] - target[:3, :3]).max() < 3e-5
        branches = p.ik.q[row][p.ik.valid[row]]
        assert (branches == p.plan.path[row, len(path) - 1]).all(1).any(), "the path ends at no joint solution"

        checker = checker_of(scene, p, row)
        samples = motion_of(p, row)
        assert np.linalg.norm(np.diff(samples, axis=0), axis=1).max() <= 1 / 320 * 1.0001
        assert np.abs(samples[-1] - path[-1]).max() < 1e-6
        seen = recheck(checker, samples)
        goal_hand = checker.hand_clearance(path[-1])[1]
        if seen.penetrating:
            penetrating.append((row, seen.penetrating, checker.classes(seen.where)))
        if seen.hand_m < min(0.003, goal_hand - GOAL_ROOM_M) - CONTACT_M:
            too_near.append((row, seen.hand_m, goal_hand))
    assert not penetrating, penetrating
    assert not too_near, too_near
    return len(rows)


@pytest.mark.parametrize(("n", "every", "least"), [(N, 5, 20), pytest.param(4096, 1, 2000, marks=pytest.mark.slow)])
def test_every_timed_path_is_free_in_mujoco_keeps_its_distance_and_leads_from_home_to_the_target(n, every, least):
    assert judge_paths(problems(n), every=every) >= least


def test_paths_lead_from_any_start_as_they_do_from_home():
    scene, p = default_evaluator().scene, problems(N)
    last = (p.plan.length.long() - 1).clamp(min=0)
    goal = p.plan.path[torch.arange(len(last)), last]
    start = torch.where((p.plan.length > 0)[:, None], goal, torch.tensor(HOME_Q)).roll(1, 0)
    plan = plan_paths(
        scene, p.body_poses, p.ik.q, p.ik.valid, p.ik.reachable, random_key(p.batch.trials.trial_id),
        PlanConfig(rounds=(50,)), start=start,
    )  # fmt: skip
    assert judge_paths(replace(p, plan=plan), every=8, start=start) >= 10
    assert (plan.length > 2).sum() >= 3
    blocked = np.flatnonzero(plan.reason.numpy() == int(PlanReason.START_IN_COLLISION))
    assert len(blocked) and all(checker_of(scene, p, r).classes(start[r].double().numpy()) for r in blocked[:20])


def test_the_checker_agrees_with_distance_queries_in_colliding_and_free_postures():
    """The judge itself: contacts and mj_geomDistance name the same kinds of pairs."""
    p = problems(N)
    rng = np.random.default_rng(0)
    seen: set[str] = set()
    for row in range(0, N, 64):
        checker = checker_of(default_evaluator().scene, p, row)
        goal = waypoints(p, row)[-1] if p.plan.length[row] else HOME
        for _ in range(40):
            q = goal + rng.normal(size=6) * rng.choice([0.05, 0.3, 1.5])
            c = checker.twin.clearances(q)
            meeting = {k for k, x in c.distance.items() if x < 0}
            assert checker.classes(q) == meeting
            near = min(c.distance["hand"], c.distance["object_hand"], HAND_MARGIN_M)
            if near >= 0:
                assert checker.hand_clearance(q)[1] == pytest.approx(near, abs=CONTACT_M)
            seen |= meeting
    assert seen == set(PAIRS)


def test_the_reported_clearance_is_the_smallest_of_the_motion():
    p = problems(N)
    rows, near = np.flatnonzero(p.plan.length.numpy() > 0)[::8], 0
    for row in rows:
        sampled, kind, _ = mujoco_scene(default_evaluator().scene, staged(p, row)).least_along(
            waypoints(p, row), step_rad=1 / 100, cap=CLEARANCE_CAP_M
        )
        reported = float(p.plan.clearance_m[row])
        if reported >= CLEARANCE_CAP_M:
            assert sampled >= CLEARANCE_CAP_M - 1e-4
            continue
        near += 1
        # samples see at least the true smallest; between two of them a point moves at most 1/200 rad times a metre
        assert reported - 2e-4 <= sampled <= reported + 5e-3, (row, reported, sampled)
        if sampled - reported < 1e-4 and kind:
            assert int(p.plan.pair[row]) == PAIRS[kind], (row, kind)
    assert near >= 5


# --- reasons -------------------------------------------------------------------------------------------------------


def test_goals_called_colliding_collide_in_mujoco_and_the_pair_named_is_one_that_meets():
    """IK_IN_COLLISION is called proven: every branch overlaps something (or comes within 0.1 mm of it)."""
    p = problems(N)
    rows = np.flatnonzero(p.plan.reason.numpy() == PlanReason.IK_IN_COLLISION)
    assert len(rows) > 25
    for row in rows[:25]:
        twin = mujoco_scene(default_evaluator().scene, staged(p, row))
        for k, q in enumerate(p.ik.q[row][p.ik.valid[row]].numpy()):
            c = twin.clearances(q)
            assert c.least < 1e-4
            if k == 0:
                named = CollidingPair(int(p.plan.pair[row])).name.lower()
                assert c.distance[named] < 1e-4, (row, named, c.distance)


def test_rows_without_a_path_say_so_everywhere_and_unreachable_targets_have_no_solution_and_no_pair():
    p = problems(N)
    rows = p.plan.reason == int(PlanReason.IK_UNREACHABLE)
    assert rows.any() and not p.ik.valid[rows].any() and p.ik.unreachable_proven[rows].all()
    assert (p.plan.pair[rows] == int(CollidingPair.NONE)).all()
    p = p.plan
    none = p.reason != int(PlanReason.OK)
    assert ((p.length == 0) == none).all()
    assert (p.clearance_m[none] == -torch.inf).all() and (p.body[none] == -1).all() and not p.straight[none].any()
    assert torch.isfinite(p.path).all()
    assert ((p.length == 2) | ~p.straight).all()


# --- completeness --------------------------------------------------------------------------------------------------


def only_ompl(p: Problems, *, budget_s: float) -> list[tuple[int, float]]:
    """Problems without a path of ours (start free) that OMPL solves with a path that survives the dense re-check."""
    scene = default_evaluator().scene
    missed = []
    reasons = p.plan.reason.numpy()
    for row in np.flatnonzero((reasons == PlanReason.NO_PATH_IN_BUDGET) | (reasons == PlanReason.IK_IN_COLLISION)):
        checker = checker_of(scene, p, row)
        goals = [q for q in p.ik.q[row][p.ik.valid[row]].double().numpy() if checker.valid(q)]
        if not goals or not checker.valid(HOME):
            continue
        found = ompl_solve(checker, np.array(goals), scene.robot.lower, scene.robot.upper, budget_s=budget_s)
        if found.path is not None and not recheck(checker, dense(found.path)).penetrating:
            goal_m = min(abs(checker.hand_clearance(found.path[-1])[1]), checker.twin.clearances(found.path[-1]).least)
            missed.append((int(row), goal_m))
    return missed


@pytest.mark.alone
@pytest.mark.parametrize(("n", "budget_s"), [(N, 5.0), pytest.param(4096, 10.0, marks=pytest.mark.slow)])
def test_almost_nothing_that_ompl_solves_is_missed(n, budget_s):
    p = problems(n)
    missed = only_ompl(p, budget_s=budget_s)
    solved = int((p.plan.length > 0).sum())
    print("solved by OMPL only (row, least clearance at the goal in m):", missed)
    assert solved >= 0.4 * n and len(missed) <= 0.005 * (solved + len(missed)), missed


def test_ompl_itself_solves_what_we_solve():
    """The comparison is not empty: OMPL with this checker finds paths on our problems too."""
    scene, p = default_evaluator().scene, problems(N)
    rows = np.flatnonzero(p.plan.length.numpy() > 0)[:8]
    for row in each(rows, 8):
        checker = checker_of(scene, p, row)
        goals = np.array([q for q in p.ik.q[row][p.ik.valid[row]].double().numpy() if checker.valid(q)])
        found = ompl_solve(checker, goals, scene.robot.lower, scene.robot.upper, budget_s=10.0)
        assert found.path is not None
        assert np.allclose(found.path[0], HOME) and np.abs(goals - found.path[-1]).max(1).min() < 1e-6


# --- options -------------------------------------------------------------------------------------------------------


def test_one_goal_is_the_branch_a_jacobian_solver_reaches_from_home():
    scene = default_evaluator().scene
    batch = problems(N).batch
    p = solve(scene, batch, PlanConfig(goals="one"))
    one = one_branch(p.ik, batch.T_world_ee)
    assert (one.sum(1) == p.ik.reachable.int()).all() and not (one & ~p.ik.valid).any()
    goal_of = p.ik.q[torch.arange(N), one.to(torch.int8).argmax(1)]
    for row in np.flatnonzero(p.plan.length.numpy() > 0):
        assert torch.equal(p.plan.path[row, int(p.plan.length[row]) - 1], goal_of[row])
    assert int((p.plan.length > 0).sum()) < int((problems(N).plan.length > 0).sum())

    # the same branch as float64 NumPy damped least squares from home, where that converges
    same = checked = 0
    for row in range(0, N, 6):
        q = jacobian_ik(scene.robot, batch.T_world_ee[row].double().numpy())
        if q is None or not p.ik.reachable[row]:
            continue
        apart = np.abs((p.ik.q[row].numpy() - q + np.pi) % (2 * np.pi) - np.pi).max(1)
        checked += 1
        same += bool(
            np.nanargmin(np.where(p.ik.valid[row].numpy(), apart, np.nan)) == int(one[row].to(torch.int8).argmax())
        )
    assert checked > 25 and same >= 0.95 * checked


def test_moveits_edge_resolution_lets_paths_through_the_hand_and_the_exact_check_does_not():
    """Samples 0.691 rad apart (L1): only they are free. Some of these paths pass through what lies between."""
    scene = default_evaluator().scene
    exact = problems(N)
    p = solve(scene, exact.batch, PlanConfig(edge_check="moveit", hand_clearance_m=0.0, shortcuts=0))
    differ = np.flatnonzero((p.plan.length > 0).numpy() & (p.plan.straight & ~exact.plan.straight).numpy())
    assert len(differ) >= 3, "no straight line passes at MoveIt's resolution only: nothing was compared"
    penetrating = 0
    for row in differ[:8]:
        checker = checker_of(scene, p, row)
        path = waypoints(p, row)
        n = int(np.ceil(np.abs(path[-1] - path[0]).sum() / 0.691))
        for k in range(1, n + 1):
            assert checker.valid(path[0] + (path[-1] - path[0]) * (k / n)), "a sample MoveIt looks at is not free"
        penetrating += recheck(checker, dense(path)).penetrating > 0
    assert penetrating >= 1


def test_a_larger_budget_only_adds_paths_and_the_reason_for_the_lack_of_one_is_not_proven():
    scene, full = default_evaluator().scene, problems(N)
    hard = torch.nonzero((full.plan.length > 0) & ~full.plan.straight).flatten()
    assert len(hard) >= 5
    batch = full.batch.rows(hard)
    small = solve(scene, batch, PlanConfig(rounds=(1,))).plan
    assert (small.reason == int(PlanReason.NO_PATH_IN_BUDGET)).any()
    assert set(small.reason.tolist()) <= {int(PlanReason.OK), int(PlanReason.NO_PATH_IN_BUDGET)}
    assert (solve(scene, batch).plan.length > 0).all()


def test_inactive_rows_are_not_evaluated_and_leave_the_others_alone():
    scene, p = default_evaluator().scene, problems(N)
    n = len(p.batch)
    active = torch.arange(n) % 3 > 0
    some = plan_paths(
        scene, p.body_poses, p.ik.q, p.ik.valid, active, random_key(p.batch.trials.trial_id), PlanConfig()
    )
    assert (some.reason[~active] == int(PlanReason.NOT_EVALUATED)).all() and (some.length[~active] == 0).all()
    for name in ("reason", "pair", "body", "clearance_m", "length"):
        assert torch.equal(getattr(some, name)[active], getattr(p.plan, name)[active]), name
    found = active & (some.length > 0)
    assert torch.equal(some.path[found], p.plan.path[found])
