"""Errors that a robot adds to the poses that it is asked for (`EvalConfig.execution_error`)."""

import copy
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from problems import default_evaluator
from scipy.spatial.transform import Rotation

from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig, ExecutionError
from r2h_batch.judge.execution_error import executed_poses
from r2h_batch.judge.reception import reception
from r2h_batch.methods import fc, oracle
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.types import Predictions
from r2h_batch.view.stored import judged_again

BOTH = ExecutionError(camera_m=0.010, camera_deg=2.0, object_m=0.005, object_deg=4.0)


def evaluator(error):
    """The shared evaluator's scene with these errors, the motion as planned."""
    twin = copy.copy(default_evaluator("r2h-v1"))
    twin.config = EvalConfig(execution_error=error, execute=ExecConfig(sim="none"))
    return twin


def poses_with(error, T_obj_ee, T_world_ee, trials):
    """The poses that a robot with these errors carries out."""
    objects = default_evaluator("r2h-v1").scene.objects
    return executed_poses(EvalConfig(execution_error=error), objects, T_obj_ee, T_world_ee, trials)


@pytest.fixture(scope="module")
def asked():
    trials = load_benchmark("r2h-v1").trials(24)
    answer = fc.predict(trials, default_evaluator("r2h-v1").scene)
    return answer.T_obj_ee, answer.T_world_ee, trials


def drawn(error, trials):
    """Rotation vectors (rad) and shifts (m) of the camera's and of the object's error, measured in float64."""
    hand = trials.T_world_hand.double().numpy()
    hand[:, :3, :3] = np.eye(3)
    eye = torch.eye(4).expand(len(trials), 4, 4)
    held, camera = (T.double().numpy() for T in poses_with(error, eye, torch.from_numpy(hand).float(), trials))
    camera = np.linalg.inv(hand) @ camera
    return [(Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), T[:, :3, 3]) for T in (camera, held)]


@pytest.mark.check
def test_a_run_with_errors_is_one_of_the_poses_that_the_robot_carries_out(asked):
    T_obj_ee, T_world_ee, trials = asked
    off = evaluator(BOTH).score(*asked)
    moved = evaluator(ExecutionError()).score(*poses_with(BOTH, T_obj_ee, T_world_ee, trials), trials)
    for name in ("outcome", "margin", "path", "q_goal"):
        assert torch.equal(getattr(off, name).nan_to_num(), getattr(moved, name).nan_to_num())
    assert not torch.equal(off.margin.nan_to_num(), evaluator(ExecutionError()).score(*asked).margin.nan_to_num())
    assert torch.equal(off.inputs.T_world_ee, T_world_ee)  # what is stored is the answer


def test_reception_is_asked_where_the_robot_brings_the_object(asked):
    T_obj_ee, T_world_ee, trials = asked
    off = reception(evaluator(BOTH).score(*asked))
    moved = reception(evaluator(ExecutionError()).score(*poses_with(BOTH, T_obj_ee, T_world_ee, trials), trials))
    meant = reception(evaluator(ExecutionError()).score(*asked))
    for f in fields(off):
        assert torch.equal(getattr(off, f.name).nan_to_num(), getattr(moved, f.name).nan_to_num()), f.name
    both = off.received & meant.received
    assert both.sum() >= 2 and (off.T_world_hand - meant.T_world_hand)[both].abs().amax((1, 2)).min() > 1e-4


def test_errors_have_the_sizes_that_were_asked_and_are_independent():
    trials = load_benchmark("r2h-v1").trials(2000)
    (turn, shift), (held_turn, held_shift) = drawn(BOTH, trials)
    for found, sd in ((np.degrees(turn), 2.0), (shift, 0.010), (np.degrees(held_turn), 4.0), (held_shift, 0.005)):
        # 4,000 draws: the deviation is within 5 %, the mean within 4 standard errors
        assert np.allclose(found.std(0), sd, rtol=0.05) and (abs(found.mean(0)) < 4 * sd / 4000**0.5).all()
    every = np.hstack([turn, shift, held_turn, held_shift])
    assert abs(np.corrcoef(every.T) - np.eye(12)).max() < 0.08


def test_the_camera_turns_the_gripper_about_the_hand_and_the_object_moves_in_the_gripper(asked):
    T_obj_ee, T_world_ee, trials = asked
    (turn, shift), (held_turn, held_shift) = drawn(BOTH, trials)
    held, pose = (T.double().numpy() for T in poses_with(BOTH, T_obj_ee, T_world_ee, trials))
    hand, before = trials.T_world_hand[:, :3, 3].double().numpy(), T_world_ee.double().numpy()
    R = Rotation.from_rotvec(turn)
    assert np.allclose(pose[:, :3, 3], hand + shift + R.apply(before[:, :3, 3] - hand), atol=1e-6)
    assert np.allclose(pose[:, :3, :3], R.as_matrix() @ before[:, :3, :3], atol=1e-6)
    E = np.tile(np.eye(4), (len(trials), 1, 1))
    E[:, :3, :3], E[:, :3, 3] = Rotation.from_rotvec(held_turn).as_matrix(), held_shift
    assert np.allclose(held, T_obj_ee.double().numpy() @ E, atol=1e-6)


def test_a_trial_meets_the_same_errors_in_any_batch_and_a_bias_is_that_of_all(asked):
    rows = torch.tensor([7, 3])
    whole = poses_with(BOTH, *asked)
    few = poses_with(BOTH, *(x[rows] for x in asked))
    assert all(torch.equal(a[rows], b) for a, b in zip(whole, few, strict=True))
    bias = drawn(replace(BOTH, camera_drawn="run"), asked[2])[0]
    assert np.ptp(bias[0], 0).max() < 1e-5 and np.ptp(bias[1], 0).max() < 1e-6 and abs(bias[1]).max() > 1e-3


def test_a_method_that_searches_with_the_evaluator_does_not_know_the_errors():
    trials, answers = load_benchmark("r2h-v1").trials(4), []
    for error in (ExecutionError(), BOTH):
        judge = evaluator(error)
        answers.append(oracle.predict(trials, judge.scene, evaluator=judge).T_world_ee)
    assert torch.equal(*answers)


def test_a_trial_is_shown_as_it_was_carried_out(asked):
    T_obj_ee, T_world_ee, trials = asked
    judge = evaluator(BOTH)
    row = int((judge.score(*asked).path_len > 0).nonzero()[0])
    trial = trials[row : row + 1].named(judge.scene.objects)
    answer = Predictions(trial.trial_id, T_obj_ee[row : row + 1], T_world_ee[row : row + 1])
    shown = judged_again(judge, trial, answer, "fc")
    assert np.allclose(ee_pose(load_robot(), shown.q[-1]), shown.T_world_ee, atol=1e-4)
    assert abs(shown.T_world_ee - T_world_ee[row].numpy()).max() > 1e-3
