"""Motions that the caller planned, against the paths of our own planner and against MuJoCo C between the samples."""

import numpy as np
import pytest
import torch
from planning_twins import checker_of, dense, recheck
from problems import default_evaluator, make_batch, solve

from r2h_batch import EvalConfig, Evaluator, load_benchmark
from r2h_batch.methods import random
from r2h_batch.types import Outcome, PlanReason, Scores
from r2h_batch.verdicts import CRITERIA

PLAN, SAFE = CRITERIA.index("plan"), CRITERIA.index("safe")
CONTACT_M = 2e-4
"""Between two samples of a sampled motion a body moves at most this far."""


@pytest.fixture(scope="module")
def evaluator() -> Evaluator:
    return default_evaluator().kinematic


@pytest.fixture(scope="module")
def planned(evaluator):
    """Rows for which our planner found a path, and what it says of them."""
    batch = make_batch(evaluator.scene, 96)
    scores = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
    rows = scores.path_len >= 2
    assert rows.sum() >= 24
    return batch.T_obj_ee[rows], batch.trials[rows], scores[rows]


def moved(evaluator: Evaluator, planned, **changes) -> Scores:
    T_obj_ee, trials, scores = planned
    given = {"q": scores.path, "time_s": scores.path_time_s, "length": scores.path_len} | changes
    return evaluator.score_motion(T_obj_ee, given.pop("q"), given.pop("time_s"), trials, **given)


def test_a_path_of_our_planner_gets_the_verdict_that_it_had(evaluator, planned):
    _, _, own = planned
    given = moved(evaluator, planned)
    plan_free = own.passed[:, PLAN]
    assert torch.equal(given.outcome, own.outcome) and plan_free.all()
    for name in ("passed", "plan_reason", "plan_pair", "witness_part", "t_exec_s", "path_len"):
        assert torch.equal(getattr(given, name), getattr(own, name)), name
    # the handover pose comes from the joints: 1e-6 m beside the one that was asked for
    assert torch.allclose(given.margin, own.margin, atol=2e-5, equal_nan=True)
    assert torch.equal(given.margin[:, PLAN], own.margin[:, PLAN])
    assert given.t_plan_s.isnan().all() and torch.equal(given.q_goal, own.q_goal)


def test_more_samples_on_the_same_lines_change_no_verdict(evaluator, planned):
    _, _, own = planned
    between = 9
    steps = torch.arange(between) / between
    q = own.path[:, :-1, None] + steps[:, None] * (own.path[:, 1:] - own.path[:, :-1])[:, :, None]
    t = own.path_time_s[:, :-1, None] + steps * (own.path_time_s[:, 1:] - own.path_time_s[:, :-1])[:, :, None]
    fine = moved(
        evaluator, planned, q=torch.cat([q.flatten(1, 2), own.path[:, -1:]], 1),
        time_s=torch.cat([t.flatten(1), own.path_time_s[:, -1:]], 1), length=(own.path_len - 1) * between + 1,
    )  # fmt: skip
    assert torch.equal(fine.outcome, own.outcome)
    near = own.margin[:, [PLAN, SAFE]] < 0.049  # above, both are lower bounds
    wrong = (fine.margin - own.margin)[:, [PLAN, SAFE]].abs()
    assert wrong[near].max() < 5e-5
    assert torch.allclose(fine.t_exec_s, own.t_exec_s)


def test_any_motion_passes_plan_where_mujoco_sees_no_contact_along_it(evaluator):
    """Motions from home over a drawn posture to the goal: about half collide on the way."""
    p = solve(evaluator.scene, make_batch(evaluator.scene, 64, random_share=0.0))
    rows = torch.nonzero(p.plan.length >= 2).flatten()[:24]
    robot, rng = evaluator.scene.robot, np.random.default_rng(5)
    over = torch.from_numpy(rng.uniform(np.maximum(robot.lower, -2.5), np.minimum(robot.upper, 2.5), (len(rows), 6)))
    goal = p.plan.path[rows, (p.plan.length[rows] - 1).long()]
    q = torch.stack([p.plan.path[rows, 0], over.float(), goal], 1)
    times = torch.tensor([0.0, 9.0, 18.0])
    scores = evaluator.score_motion(p.batch.T_obj_ee[rows], q, times, p.batch.trials[rows])
    # No plan makes more of them, be it one that stays at home or a free one to the same goal.
    for plan, length in ((q[:, :1].repeat(1, 2, 1), None), (p.plan.path[rows], p.plan.length[rows])):
        forged = evaluator.score_motion(
            p.batch.T_obj_ee[rows], q, times, p.batch.trials[rows], planned_q=plan, planned_length=length
        )  # fmt: skip
        assert torch.equal(forged.success, scores.success)
        assert torch.equal(forged.passed[:, PLAN], scores.passed[:, PLAN] | ~forged.passed[:, SAFE])
    judged = 0
    for i, row in enumerate(rows.tolist()):
        seen = recheck(checker_of(evaluator.scene, p, row), dense(q[i].double().numpy(), 1 / 160))
        margin = float(scores.margin[i, PLAN])
        if abs(margin) < CONTACT_M:
            continue  # samples and contacts do not decide it
        judged += 1
        if margin > 0:
            assert scores.passed[i, PLAN] and not seen.penetrating, (row, margin)
        else:
            assert not scores.passed[i, PLAN] and seen.penetrating, (row, margin)
            assert scores.plan_reason[i] == int(PlanReason.MOTION_IN_COLLISION)
    failed = int((~scores.passed[:, PLAN]).sum())
    assert judged >= 20 and 4 <= failed <= len(rows) - 4


def test_rows_that_are_no_motion_are_invalid_and_limits_are_a_reason(evaluator, planned):
    _, _, own = planned
    q, t = own.path.clone(), own.path_time_s.clone()
    q[0, 1, 3] = torch.nan
    t[1, 0] = 5.0
    t[1, 1:] = 1.0
    q[2, 0, 2] = 4.0  # the elbow turns by at most pi
    q[3, 0, 2] = 1e30  # refused unwalked
    t[4, :] = 1.0  # a leap
    t[5, 1:] += 2e9  # 63 years: no export would take it
    scores = moved(evaluator, planned, q=q, time_s=t)
    wrong, beyond = [0, 1, 4, 5], [2, 3]
    assert (scores.outcome[wrong] == int(Outcome.INVALID_INPUT)).all() and scores.margin[wrong].isnan().all()
    assert (scores.plan_reason[beyond] == int(PlanReason.BEYOND_JOINT_LIMITS)).all()
    assert not scores.passed[beyond][:, [PLAN, SAFE]].any()
    assert torch.equal(scores.outcome[6:], own.outcome[6:])
    large = moved(evaluator, planned, q=own.path.double().index_fill(0, torch.tensor([0]), 1e300))
    assert large.outcome[0] == int(Outcome.INVALID_INPUT)


def test_a_joint_that_turns_faster_than_it_can_fails_plan(evaluator, planned):
    """The limit is 180 degrees a second, of each joint and between any two samples."""
    _, _, own = planned
    turns = (own.path[:, 1:] - own.path[:, :-1]).abs().amax(2)
    turns = torch.where(torch.arange(1, own.path.shape[1]) < own.path_len[:, None], turns, 0.0).amax(1)
    slow = torch.arange(own.path.shape[1]) * (turns[:, None] / torch.pi)
    scores = moved(evaluator, planned, time_s=slow)
    assert torch.equal(scores.outcome, own.outcome)
    scores = moved(evaluator, planned, time_s=0.99 * slow)
    assert (scores.plan_reason == int(PlanReason.BEYOND_SPEED_LIMITS)).all() and not scores.passed[:, PLAN].any()


def test_a_plan_begins_where_its_motion_does(evaluator, planned):
    _, _, own = planned
    for off, outcome in ((0.09, own.outcome), (0.11, torch.full_like(own.outcome, int(Outcome.INVALID_INPUT)))):
        plan = own.path.numpy().copy()
        plan[:, 0, 5] += off
        assert torch.equal(moved(evaluator, planned, planned_q=plan, planned_length=own.path_len).outcome, outcome)


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"planned_q": torch.zeros(6)}, r"^planned_q is .*; with \d+ trials it must be \(\d+, W, 6\)"),
        ({"time_s": torch.zeros(5)}, r"^time_s is .*; it must be \(\d+, \d+\) or \(\d+,\)$"),
        ({"q": [[0.0] * 6]}, "^q is"),
    ],
)
def test_what_fits_no_motion_is_refused_by_name(evaluator, planned, changes, line):
    with pytest.raises((TypeError, ValueError), match=line):
        moved(evaluator, planned, **changes)


def test_a_receivers_body_counts_along_a_given_motion(planned):
    evaluator = Evaluator(load_benchmark("r2h-v1"), EvalConfig(receiver="body")).kinematic
    trials = load_benchmark("r2h-v1").trials(24, splits=["S0"])
    poses = random.predict(trials, evaluator.scene, seed=3)
    own = evaluator.score(poses.T_obj_ee, poses.T_world_ee, trials)
    rows = own.path_len >= 2
    own = own[rows]
    given = evaluator.score_motion(
        poses.T_obj_ee[rows], own.path, own.path_time_s, trials[rows], length=own.path_len
    )  # fmt: skip
    assert rows.sum() >= 4, "too few paths to compare"
    assert torch.equal(given.outcome, own.outcome), "a given motion has another outcome than the plan that it is"
    assert torch.equal(given.margin[:, PLAN], own.margin[:, PLAN]), "a given motion has another margin of Plan"
    assert torch.equal(given.body_m, own.body_m), "a given motion is at another distance of the person's body"
