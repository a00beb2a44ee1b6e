"""Hints about poses and motions in another convention, on the oracle's answers written in each of them."""

import math
import warnings

import numpy as np
import pytest
import torch
from problems import default_evaluator
from rounds import each
from scipy.spatial.transform import Rotation

from r2h_batch.base import se3
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.conventions import failing, other_poses
from r2h_batch.methods import oracle, random
from r2h_batch.methods.predictors import predict_target
from r2h_batch.observe import moments
from r2h_batch.protocols.load import load_benchmark

HALF = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))


@pytest.fixture(scope="module")
def fresh():
    """Makes an evaluator that was not asked before."""
    return lambda: Evaluator(load_benchmark("r2h-v0"), EvalConfig(execute=ExecConfig(sim="none")))


@pytest.fixture(scope="module")
def solved():
    """Trials that the oracle solves, its poses, and the scores of its motions."""
    evaluator = default_evaluator().kinematic
    trials = evaluator.benchmark.trials(8)
    answer = oracle.predict(trials, evaluator.scene, seed=0)
    poses = [answer.T_obj_ee, answer.T_world_ee]
    scores = evaluator.score(*poses, trials)
    assert scores.success.sum() >= 12
    keep = scores.success
    return trials[keep], [T[keep] for T in poses], scores[keep]


def as_quaternion_in_another_order(T, order):
    """The poses whose quaternions were written in one order and read in the other, by SciPy's orders."""
    R = Rotation.from_matrix(T[:, :3, :3].double().numpy())
    written = R.as_quat(scalar_first=order == "wxyz")
    wrong = Rotation.from_quat(written, scalar_first=order != "wxyz").as_matrix()
    out = T.clone()
    out[:, :3, :3] = torch.from_numpy(wrong.astype(np.float32))
    return out


def in_millimetres(T):
    out = T.clone()
    out[:, :3, 3] *= 1000
    return out


def inverted(T):
    return torch.from_numpy(np.linalg.inv(T.double().numpy())).float()


WRITTEN = {
    "T_obj_ee inverted": lambda a, b: (inverted(a), b),
    "T_world_ee inverted": lambda a, b: (a, inverted(b)),
    "both poses inverted": lambda a, b: (inverted(a), inverted(b)),
    "T_world_ee times T_obj_ee": lambda a, b: (a, b @ inverted(a)),
    "turned by 180 degrees": lambda a, b: (a, HALF @ b),
    "lengths read as millimetres": lambda a, b: (in_millimetres(a), in_millimetres(b)),
    "T_world_ee read in millimetres": lambda a, b: (a, in_millimetres(b)),
    "T_obj_ee read in millimetres": lambda a, b: (in_millimetres(a), b),
    "read as x, y, z, w": lambda a, b: tuple(as_quaternion_in_another_order(T, "xyzw") for T in (a, b)),
    "read as w, x, y, z": lambda a, b: tuple(as_quaternion_in_another_order(T, "wxyz") for T in (a, b)),
}


@pytest.mark.check
@pytest.mark.parametrize("name", WRITTEN)
def test_each_other_convention_leads_back_to_the_poses(solved, name):
    _, poses, _ = solved
    found = next(v for k, v in other_poses(*WRITTEN[name](*poses)).items() if name in k)
    for back, pose in each(zip(found, poses, strict=True)):
        torch.testing.assert_close(back, pose, atol=2e-6, rtol=0)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_first_call_names_the_convention_in_which_poses_pass(solved, fresh, name):
    trials, poses, _ = solved
    evaluator, wrong = fresh(), WRITTEN[name](*poses)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scores = evaluator.score(*wrong, trials)
        evaluator.score(*wrong, trials)  # said once
    lines = [str(w.message) for w in said if "rows fail" in str(w.message)]
    # a mistake that leaves some rows alone needs no line
    assert len(lines) == int(bool(failing(scores).any())), lines
    assert all(name in line and line.isprintable() for line in lines), lines
    assert all(line.startswith(f"all {len(trials)} rows fail ") for line in lines)


def test_right_poses_and_poses_that_no_convention_mends_get_no_hint(solved, fresh):
    trials, poses, _ = solved
    nowhere = poses[1].clone()
    nowhere[:, 2, 3] = 3.0  # above the robot's reach in every frame
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for T_world_ee in (poses[1], nowhere):
            fresh().score(poses[0], T_world_ee, trials)
        few = slice(0, 7)
        fresh().score(inverted(poses[0])[few], poses[1][few], trials[few])
    assert [str(w.message) for w in said] == []


def test_a_hint_changes_no_verdict(solved, fresh):
    trials, poses, _ = solved
    wrong = WRITTEN["T_world_ee inverted"](*poses)
    evaluator = fresh()
    with pytest.warns(UserWarning, match="rows fail"):
        first = evaluator.score(*wrong, trials)
    second = evaluator.score(*wrong, trials)
    for name in ("outcome", "passed", "margin", "plan_reason"):
        a, b = getattr(first, name), getattr(second, name)
        assert a.numpy().tobytes() == b.numpy().tobytes(), name


@pytest.mark.parametrize(
    ("of_q", "of_time", "words"),
    [
        (180 / math.pi, 1.0, "q read as degrees: angles"),
        (180 / math.pi, 1000.0, "q read as degrees and time_s as milliseconds"),
        (1.0, 1000.0, "with time_s read as milliseconds it lasts"),
        (1.0, 1e6, "with time_s read as microseconds it lasts"),
        (1.0, 1.0, None),
    ],
)
def test_motions_in_degrees_or_milliseconds_are_told(solved, fresh, of_q, of_time, words):
    trials, poses, scores = solved
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fresh().score_motion(poses[0], scores.path * of_q, scores.path_time_s * of_time, trials, length=scores.path_len)
    lines = [str(w.message) for w in said if "rows" in str(w.message)]
    assert len(lines) == (words is not None) and all(words in line for line in lines), lines


@pytest.mark.parametrize("name", ["r2h-v0", "r2h-release"])
@pytest.mark.parametrize("hand", ["true", "estimated"])
def test_the_hands_pose_in_place_of_the_ees_is_named(name, hand):
    evaluator = load_benchmark(name).evaluator(threads=1)
    trials = evaluator.benchmark.trials(6)
    T = trials.T_world_hand if hand == "true" else predict_target(trials, evaluator.scene, seed=0).T.float()
    assert (hand == "true") == torch.equal(T, trials.T_world_hand)
    T_obj_ee = random.predict(trials, evaluator.scene, seed=0).T_obj_ee
    words = r"T_world_ee lies at the hand's pose \(trials.T_world_hand, true or estimated\) in all 12 rows"
    with pytest.warns(UserWarning, match=words):
        evaluator.score(T_obj_ee, T, trials, stages="pose")


def test_one_gripper_that_is_not_in_the_hand_is_enough(fresh, solved):
    trials, (T_obj_ee, T_world_ee), _ = solved
    some = trials.T_world_hand.clone()
    some[0] = T_world_ee[0]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fresh().score(T_obj_ee, some, trials)
    assert not any("hand's pose" in str(w.message) for w in told)


def test_a_benchmark_with_more_criteria_has_hints_too():
    evaluator = Evaluator(load_benchmark("r2h-v3-draft").until("present"), EvalConfig(execute=ExecConfig(sim="none")))
    trials = evaluator.benchmark.trials(6)
    answer = oracle.predict(trials, evaluator.scene, seed=0, evaluator=evaluator)
    with pytest.warns(UserWarning, match=r"all 12 rows fail .*; [678] of 8 pass more with T_world_ee inverted"):
        evaluator.score(answer.T_obj_ee, inverted(answer.T_world_ee), trials)


def test_a_grasp_given_where_the_object_rests_is_told_on_a_benchmark_that_begins_at_the_table():
    draft = load_benchmark("r2h-v3-draft").until("present")
    evaluator, trials = draft.evaluator(), draft.trials(4)
    known = load_benchmark("r2h-v3-draft").certificates(trials.trial_id.numpy())
    grasp, pose = (torch.from_numpy(np.array(x)) for x in (known.T_obj_ee, known.T_world_ee))
    on_table = se3.matmul(moments(evaluator.scene, trials), grasp)
    evaluator.called = True  # no warning: the hint is asked for
    scores = evaluator.score(on_table, pose, trials, stages="pose")
    words = evaluator.hint(scores, on_table, pose, trials)
    assert words is not None and "T_obj_ee taken from the world into the object's frame: inverse(T_world_obj)" in words
    right = evaluator.score(grasp, pose, trials, stages="pose")
    assert evaluator.hint(right, grasp, pose, trials) is None


def test_rows_that_fail_at_different_criteria_get_a_hint_where_none_of_them_succeeds(fresh, solved):
    """Chance passes single criteria: eight rows in millimetres, and eight whose grasps miss the object."""
    trials, (T_obj_ee, T_world_ee), _ = solved
    rows = torch.arange(16) % len(trials)
    grasps, handovers, asked = T_obj_ee[rows].clone(), T_world_ee[rows].clone(), trials[rows]
    handovers[:8, :3, 3] *= 1000
    grasps[8:] = grasps[8:] @ torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.12], [0, 0, 0, 1.0]])
    with pytest.warns(UserWarning, match="all 16 rows fail; 8 of 8 pass more with T_world_ee read in millimetres"):
        scores = fresh().score(grasps, handovers, asked)
    assert not scores.success.any() and not failing(scores).any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        handovers[15], grasps[15] = T_world_ee[rows[15]], T_obj_ee[rows[15]]  # one that succeeds
        evaluator = fresh()
        evaluator.called = True
        found = evaluator.score(grasps, handovers, asked)
        assert found.success.sum() == 1 and evaluator.hint(found, grasps, handovers, asked) is None
