"""Every verdict and every Plan reason from a scene built to give exactly that."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import Staged as Twin
from oracle import mujoco_scene
from planning_twins import Checker, dense, recheck
from problems import default_evaluator, make_batch
from staging import (
    AHEAD,
    BACK,
    CUBE,
    GOAL,
    GOOD,
    HOME_TCP,
    OUT_OF_THE_WAY,
    START,
    TOOL,
    UP,
    Staged,
    Y,
    batch_of,
    frame,
    hand_at,
    hold_across,
    judge,
    moved,
    open_hand,
    staged_evaluator,
    tilted_pole,
)

from r2h_batch.config import HOME_Q, EvalConfig, ExecConfig, PlanConfig
from r2h_batch.judge.grasp import attach, close_gripper
from r2h_batch.judge.ik import solve_ik
from r2h_batch.types import CRITERIA, CollidingPair, Outcome, PlanReason, Scores

STABILITY, PLAN, REACH, AFFORDANCE, SAFE = range(5)


def verdict(scores: Scores, row: int = 0) -> tuple[str, str, str]:
    return (
        Outcome(int(scores.outcome[row])).name,
        PlanReason(int(scores.plan_reason[row])).name,
        CollidingPair(int(scores.plan_pair[row])).name,
    )


def twin_of(staged: Staged) -> Checker:
    """MuJoCo C's view of a staged trial."""
    scene = staged_evaluator().scene
    T_obj_ee, _, trials = batch_of([staged])
    grasp = close_gripper(scene.grasp_tables, T_obj_ee, trials.object_index)
    return Checker(
        mujoco_scene(
            scene,
            Twin(
                staged.object_index,
                open_hand()[0],
                attach(T_obj_ee, grasp.shift_m)[0].double().numpy(),
                trials.T_world_hand[0].double().numpy(),
                float(grasp.opening_m[0]),
            ),
        )
    )


# --- success -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("item", [GOOD, GOOD.but(object_index=TOOL)], ids=["S0", "S1"])
def test_a_stick_held_low_before_an_open_palm_is_a_success(item):
    s = judge(item)
    assert verdict(s)[:2] == ("SUCCESS", "OK") and bool(s.success[0])
    s1 = item.object_index == TOOL
    assert s.evaluated[0].tolist() == [True, True, True, s1, True]
    assert s.passed[0].tolist() == [True, True, True, s1, True]
    assert (s.margin[0][s.evaluated[0]] > 0).all() and torch.isnan(s.margin[0][~s.evaluated[0]]).all()
    assert float(s.width_m[0]) == pytest.approx(0.02, abs=1e-5) and float(s.opening_m[0]) == pytest.approx(
        0.02, abs=1e-5
    )
    assert float(s.margin[0, STABILITY]) == pytest.approx(0.01, abs=1e-5)  # 65 mm narrower, 1 cm free
    # the stick's axis passes through c_h: the whole ball's radius is left
    assert float(s.margin[0, REACH]) == pytest.approx(0.10, abs=1e-5)
    assert not s.borderline[0]
    n = int(s.path_len[0])
    assert torch.equal(s.q_goal[0], s.path[0, n - 1]) and float(s.t_exec_s[0]) > 5
    # the last millimetre of the reference is within the tolerance already
    assert float(s.path_time_s[0, n - 1]) - 0.2 < float(s.t_exec_s[0]) < float(s.path_time_s[0, n - 1]) + 0.1
    assert float(s.t_plan_s[0]) > 0


# --- stability -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("item", "width", "margin"),
    [
        (GOOD.but(object_index=CUBE, T_obj_ee=hold_across(0.0)), 0.10, -0.015),
        (GOOD.but(T_obj_ee=hold_across(-0.2)), np.nan, -0.085),
        (GOOD.but(T_obj_ee=moved(hold_across(-0.07), y=0.045)), 0.02, -0.0042),
    ],
    ids=["too wide", "nothing between the pads", "open finger cuts"],
)
def test_unstable_grasps_are_dropped(item, width, margin):
    s = judge(item)
    assert verdict(s)[0] == "STABILITY" and not s.success[0]
    assert float(s.width_m[0]) == pytest.approx(width, abs=1e-5, nan_ok=True)
    assert float(s.margin[0, STABILITY]) == pytest.approx(margin, abs=1e-4)


# --- plan ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pair", START)
def test_a_start_in_collision_names_the_pair(pair):
    s = judge(START[pair])
    assert verdict(s) == ("PLAN", "START_IN_COLLISION", pair)
    assert_known_without_a_path(START[pair], s)
    assert twin_of(START[pair]).classes(HOME_Q) == {pair.lower()}
    assert_no_path(s)


@pytest.mark.parametrize("pair", GOAL)
def test_goals_in_collision_name_the_pair_and_every_branch_collides_in_mujoco(pair):
    s = judge(GOAL[pair])
    assert verdict(s) == ("PLAN", "IK_IN_COLLISION", pair)
    assert_known_without_a_path(GOAL[pair], s)
    twin = twin_of(GOAL[pair])
    assert twin.valid(HOME_Q)
    ik = solve_ik(batch_of([GOAL[pair]])[1])
    branches = ik.q[0][ik.valid[0]].numpy()
    assert len(branches) and all(not twin.valid(q) for q in branches)
    assert pair.lower() in twin.classes(branches[0])
    assert_no_path(s)


@pytest.mark.check
def test_a_target_out_of_reach_is_unreachable():
    s = judge(GOOD.but(T_world_ee=frame(AHEAD, Y, np.array([1.5, 0, 0.33])), T_world_hand=OUT_OF_THE_WAY))
    assert verdict(s) == ("PLAN", "IK_UNREACHABLE", "NONE")
    assert_no_path(s)


def test_a_small_budget_gives_up_where_the_default_one_finds_a_path():
    item = replace(tilted_pole(-10, 0.3), T_world_ee=frame(AHEAD, Y, np.array([0.4, 0.4, 0.4])))
    s = judge(item, config=EvalConfig(plan=PlanConfig(rounds=(1,))))
    assert verdict(s) == ("PLAN", "NO_PATH_IN_BUDGET", "NONE")
    assert_no_path(s)
    s = judge(item)
    assert verdict(s)[:2] == ("REACH", "OK") and int(s.path_len[0]) > 2


def assert_known_without_a_path(item: Staged, s: Scores) -> None:
    """The pose stage says the same, how deep, and between which parts."""
    p = staged_evaluator().score(*batch_of([item]), "pose")
    assert verdict(p)[1:] == verdict(s)[1:] and torch.equal(p.margin[:, PLAN], s.margin[:, PLAN])
    assert p.margin[0, PLAN] < 0 and torch.isfinite(p.q_goal).all()
    if verdict(p)[1] == "IK_IN_COLLISION":
        assert p.margin[0, PLAN] < -1e-4 and int(p.witness_part[0, 0]) >= 0


def assert_no_path(s: Scores) -> None:
    assert float(s.margin[0, PLAN]) < 0 and not s.passed[0, PLAN]
    assert not s.evaluated[0, SAFE] and torch.isnan(s.margin[0, SAFE])
    assert int(s.path_len[0]) == 0 and torch.isnan(s.q_goal[0]).all() and torch.isnan(s.t_exec_s[0])
    assert (
        s.witness_part[0].tolist() == [-1, -1]
        and torch.isnan(s.witness_time_s[0])
        and torch.isnan(s.witness_point[0]).all()
    )


# --- reach, affordance ---------------------------------------------------------------------------------------------


def test_a_hand_beside_the_object_is_not_reached():
    s = judge(GOOD.but(T_world_hand=hand_at(np.array([0.62, 0.35, 0.40]), BACK, UP)))
    assert verdict(s)[:2] == ("REACH", "OK")
    # c_h is 0.35 m beside a stick of 20 mm
    assert float(s.margin[0, REACH]) == pytest.approx(0.10 - (0.35 - 0.01), abs=1e-5)


def test_holding_the_receivers_part_fails_affordance_in_s1_and_is_not_asked_in_s0():
    upper = hold_across(0.05)
    s = judge(GOOD.but(object_index=TOOL, T_obj_ee=upper), GOOD.but(T_obj_ee=upper))
    assert verdict(s, 0)[0] == "AFFORDANCE" and float(s.margin[0, AFFORDANCE]) <= 0
    assert verdict(s, 1)[0] == "SUCCESS" and not s.evaluated[1, AFFORDANCE] and torch.isnan(s.margin[1, AFFORDANCE])


# --- safe ----------------------------------------------------------------------------------------------------------


def test_a_path_whose_samples_step_over_the_hand_is_not_safe_and_the_exact_check_finds_another_way():
    """MoveIt's edge resolution: hands strewn between home and goal, some of them between two samples."""
    rng = np.random.default_rng(0)
    goal = frame(AHEAD, Y, np.array([0.5, 0.25, 0.15]))
    rows = []
    for _ in range(384):
        palm = HOME_TCP + rng.uniform(0, 1) * (goal[:3, 3] - HOME_TCP) + rng.normal(size=3) * 0.08
        rows.append(GOOD.but(T_world_ee=goal, T_world_hand=hand_at(palm, rng.normal(size=3), rng.normal(size=3))))
    # what else fails must not hide it: Reach passes anywhere
    planned = ExecConfig(sim="none")
    config = EvalConfig(plan=PlanConfig(edge_check="moveit", hand_clearance_m=0.0, shortcuts=0), execute=planned)
    wide = replace(config, thresholds=replace(config.thresholds, reach_radius_m=5.0))
    s = judge(*rows, config=wide)
    unsafe = torch.nonzero(s.outcome == int(Outcome.SAFE)).flatten().tolist()
    assert len(unsafe) >= 3
    for row in unsafe[:6]:
        assert float(s.margin[row, SAFE]) <= 0 and int(s.plan_reason[row]) == PlanReason.OK
        checker = twin_of(rows[row])
        path = s.path[row, : int(s.path_len[row])].double().numpy()
        assert recheck(checker, dense(path)).penetrating > 0
        assert not s.passed[row, SAFE] and s.witness_part[row, 1] >= 0
        assert 0 <= float(s.witness_time_s[row]) <= float(s.t_exec_s[row])
    exact = judge(*[rows[r] for r in unsafe], config=replace(wide, plan=PlanConfig()))
    assert not (exact.outcome == int(Outcome.SAFE)).any()


def test_a_planned_path_with_exact_edges_is_safe_because_pieces_enclose_the_hand():
    evaluator = default_evaluator()
    batch = make_batch(evaluator.scene, 96, random_share=0.3)
    for config, tolerance in ((evaluator.kinematic, 3e-5), (evaluator, 6e-4)):  # the servos stray by up to 0.5 mm
        s = config.score(batch.T_obj_ee, batch.T_world_ee, batch.trials)
        found = s.path_len > 0
        assert found.sum() > 36
        assert (s.passed[:, SAFE] == found).all()
        clear = found & (s.margin[:, PLAN] < 0.049) & (s.plan_pair == int(CollidingPair.HAND))
        assert clear.any() and (s.margin[clear, SAFE] >= s.margin[clear, PLAN] - tolerance).all()


# --- order ---------------------------------------------------------------------------------------------------------


def test_the_verdict_is_the_first_failure_in_the_papers_order_and_the_others_are_still_judged():
    upper = hold_across(0.05)
    away = hand_at(np.array([0.62, 0.35, 0.40]), BACK, UP)
    far = frame(AHEAD, Y, np.array([1.5, 0, 0.33]))
    rows = [
        GOOD.but(object_index=TOOL, T_obj_ee=upper, T_world_hand=away),  # reach and affordance
        GOOD.but(object_index=TOOL, T_obj_ee=upper, T_world_hand=away, T_world_ee=far),  # and plan
        GOOD.but(object_index=TOOL, T_obj_ee=moved(upper, y=0.045), T_world_hand=away, T_world_ee=far),  # and stability
    ]
    s = judge(*rows)
    assert [verdict(s, i)[0] for i in range(3)] == ["REACH", "PLAN", "STABILITY"]
    assert s.passed[0].tolist() == [True, True, False, False, True]
    assert s.passed[1].tolist() == [True, False, False, False, False]
    assert s.passed[2].tolist()[:3] == [False, False, False]
    assert s.evaluated[:, :4].all()
    assert s.passed.shape == (3, len(CRITERIA))
