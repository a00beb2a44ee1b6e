"""Paths planned against the hand that the methods see, judged on the true one (`PlanConfig.hand`)."""

import copy
from dataclasses import replace

import pytest
import torch
from problems import default_evaluator

from r2h_batch import load_benchmark
from r2h_batch.config import EstimateConfig, EvalConfig, ExecConfig, PlanConfig
from r2h_batch.judge.motion import execute as motion
from r2h_batch.methods import fc
from r2h_batch.methods.predictors import PredictorNoise, predict_target

PLAN, SAFE = 1, 4
SEEN = EstimateConfig(errors="tails", factor=2.0, seed=5)


def evaluator(config=None):
    """The shared evaluator's scene with another configuration."""
    twin = copy.copy(default_evaluator("r2h-v1"))
    twin.config = replace(config or EvalConfig(), execute=ExecConfig(sim="none"))
    return twin


@pytest.fixture(scope="module")
def asked():
    trials = load_benchmark("r2h-v1").trials(24)
    answer = fc.predict(trials, default_evaluator("r2h-v1").scene)
    return answer.T_obj_ee, answer.T_world_ee, trials


@pytest.fixture(scope="module")
def estimated(asked):
    return evaluator(EvalConfig(plan=PlanConfig(hand="estimated"), estimate=SEEN)).score(*asked)


@pytest.mark.check
def test_the_plan_is_that_of_a_trial_whose_hand_stands_where_it_is_seen(asked, estimated):
    T_obj_ee, T_world_ee, trials = asked
    noise = PredictorNoise(target_errors="tails").scaled(2.0)
    seen = predict_target(trials, default_evaluator("r2h-v1").scene, seed=5, noise=noise).T_world_hand
    moved = evaluator().score(T_obj_ee, T_world_ee, replace(trials, T_world_hand=seen))
    true = evaluator().score(*asked)
    for name in ("path", "path_len", "plan_reason", "plan_pair", "q_goal", "t_exec_s"):
        assert torch.equal(torch.nan_to_num(getattr(estimated, name)), torch.nan_to_num(getattr(moved, name)))
    assert torch.equal(estimated.margin[:, PLAN], moved.margin[:, PLAN])
    for k in (0, 2, 3):  # what no path decides is judged on the true hand
        assert torch.equal(estimated.margin[:, k].nan_to_num(), true.margin[:, k].nan_to_num())
    # Safe is that of the same motion past the true hand: an hand elsewhere is met where the seen one was not
    found = estimated.path_len > 0
    assert (estimated.margin[found, PLAN] > 0).all() and not torch.equal(estimated.margin, moved.margin)
    assert (~estimated.passed[found, SAFE]).sum() > (~true.passed[true.path_len > 0, SAFE]).sum()


def test_without_error_the_rows_are_those_of_the_true_hand_bit_for_bit(asked):
    exact = evaluator(EvalConfig(plan=PlanConfig(hand="estimated"), estimate=replace(SEEN, factor=0.0))).score(*asked)
    true = evaluator().score(*asked)
    for name in ("outcome", "margin", "path", "witness_point"):
        assert torch.equal(getattr(exact, name).nan_to_num(), getattr(true, name).nan_to_num())


def test_a_row_alone_has_the_bits_of_its_batch(asked, estimated):
    T_obj_ee, T_world_ee, trials = asked
    judge = evaluator(EvalConfig(plan=PlanConfig(hand="estimated"), estimate=SEEN))
    alone = judge.score(T_obj_ee[7:8], T_world_ee[7:8], trials[7:8])
    assert torch.equal(alone.margin.nan_to_num(), estimated.margin[7:8].nan_to_num())


def test_the_goal_of_the_pose_stage_is_free_where_the_plan_says_so(asked, estimated):
    judge = evaluator(EvalConfig(plan=PlanConfig(hand="estimated"), estimate=SEEN))
    pose = judge.score(*asked, stages="pose")
    assert pose.passed[estimated.passed[:, PLAN], PLAN].all()
    assert not estimated.passed[~pose.passed[:, PLAN], PLAN].any()


@pytest.mark.parametrize(("hand", "certain"), [("true", True), ("estimated", False)])
def test_a_path_clear_of_the_estimated_hand_does_not_rule_a_contact_with_the_true_one_out(
    asked, hand, certain, monkeypatch
):
    """A motion that `execute` takes for certified moves the arm alone: nothing pushes it."""
    seen = []

    def execute(*args, clearance_m, **more):
        seen.append(clearance_m)
        return moved(*args, clearance_m=clearance_m, **more)

    moved = motion.execute
    monkeypatch.setattr(motion, "execute", execute)
    evaluator(EvalConfig(plan=PlanConfig(hand=hand), estimate=SEEN)).score(*(x[:4] for x in asked))
    assert len(seen) == 1 and (seen[0] is not None) == certain
