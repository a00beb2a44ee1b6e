"""Hints about poses and motions in another convention, on the oracle's answers written in each of them."""

import copy
import math
import re
import warnings

import numpy as np
import pytest
import torch
from problems import default_evaluator, kinematic_evaluator
from rounds import each
from scipy.spatial.transform import Rotation

from r2h_batch.base import se3
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.conventions import failing, other_poses, pose_hint
from r2h_batch.methods import oracle, random
from r2h_batch.methods.predictors import predict_target
from r2h_batch.observe import moments
from r2h_batch.trials.load import load_benchmark

MIRROR = torch.diag(torch.tensor([1.0, -1.0, 1.0, 1.0]))
HALF = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))


@pytest.fixture(scope="module")
def fresh():
    """Makes an evaluator that was not asked before."""
    return never_asked


def never_asked(name="r2h-v0"):
    """An evaluator that has its scene from others, and that nobody asked before."""
    found = copy.copy(kinematic_evaluator(name))
    found.called = found.moved = False
    return found


@pytest.fixture(scope="module")
def answered():
    """Trials, and the oracle's answers."""
    evaluator = default_evaluator().kinematic
    trials = evaluator.benchmark.trials(8)
    return trials, oracle.predict(trials, evaluator.scene, seed=0)


@pytest.fixture(scope="module")
def solved(answered):
    """Trials that the oracle solves, its poses, and the scores of its motions."""
    evaluator, (trials, answer) = default_evaluator().kinematic, answered
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


def in_millimetres(T, of_metre=1000):
    out = T.clone()
    out[:, :3, 3] *= of_metre
    return out


def turn(axis, degrees):
    T = torch.eye(4)
    T[:3, :3] = torch.from_numpy(Rotation.from_euler(axis, degrees, degrees=True).as_matrix().astype(np.float32))
    return T


FLANGE = torch.eye(4)
FLANGE[2, 3] = -0.1532  # from the TCP back to the flange (assets/robot)


def inverted(T):
    return torch.from_numpy(np.linalg.inv(T.double().numpy())).float()


WRITTEN = {
    "T_obj_ee inverted": lambda a, b, hand: (inverted(a), b),
    "T_world_ee inverted": lambda a, b, hand: (a, inverted(b)),
    "both poses inverted": lambda a, b, hand: (inverted(a), inverted(b)),
    "T_obj_ee and T_world_ee exchanged": lambda a, b, hand: (b, a),
    "T_world_ee mirrored in y": lambda a, b, hand: (a, MIRROR @ b @ MIRROR),
    "T_world_ee times T_obj_ee": lambda a, b, hand: (a, b @ inverted(a)),
    "turned by 180 degrees": lambda a, b, hand: (a, HALF @ b),
    "turned by 90 degrees": lambda a, b, hand: (a, turn("z", -90) @ b),
    "turned by 90 degrees about x": lambda a, b, hand: (a, turn("x", -90) @ b),
    "turned by -90 degrees": lambda a, b, hand: (a, turn("z", 90) @ b),
    "from the hand's frame": lambda a, b, hand: (a, inverted(hand) @ b),
    "T_world_ee times T_flange_ee": lambda a, b, hand: (a, b @ FLANGE),
    "T_obj_ee times T_flange_ee": lambda a, b, hand: (a @ FLANGE, b),
    "both poses times T_flange_ee": lambda a, b, hand: (a @ FLANGE, b @ FLANGE),
    "gripper's x read as z": lambda a, b, hand: (a @ turn("y", -90), b @ turn("y", -90)),
    "gripper's -z read as z": lambda a, b, hand: (a @ turn("x", 180), b @ turn("x", 180)),
    "gripper's x read as y": lambda a, b, hand: (a @ turn("z", 90), b @ turn("z", 90)),
    "lengths read as millimetres": lambda a, b, hand: (in_millimetres(a), in_millimetres(b)),
    "T_world_ee read in millimetres": lambda a, b, hand: (a, in_millimetres(b)),
    "T_obj_ee read in millimetres": lambda a, b, hand: (in_millimetres(a), b),
    "lengths read as centimetres": lambda a, b, hand: (in_millimetres(a, 100), in_millimetres(b, 100)),
    "T_world_ee read in centimetres": lambda a, b, hand: (a, in_millimetres(b, 100)),
    "T_obj_ee read in centimetres": lambda a, b, hand: (in_millimetres(a, 100), b),
    "read as x, y, z, w": lambda a, b, hand: tuple(as_quaternion_in_another_order(T, "xyzw") for T in (a, b)),
    "read as w, x, y, z": lambda a, b, hand: tuple(as_quaternion_in_another_order(T, "wxyz") for T in (a, b)),
}


@pytest.mark.check
@pytest.mark.parametrize("name", WRITTEN)
def test_each_other_convention_leads_back_to_the_poses(solved, name):
    trials, poses, _ = solved
    wrong = WRITTEN[name](*poses, trials.T_world_hand)
    every = other_poses(*wrong, trials.T_world_hand, torch.linalg.inv(FLANGE))
    found = next(v for k, v in every.items() if name in k)
    for back, pose in each(zip(found, poses, strict=True)):
        torch.testing.assert_close(back, pose, atol=2e-6, rtol=0)


@pytest.mark.parametrize("name", WRITTEN)
def test_the_first_call_names_the_convention_in_which_poses_pass(solved, fresh, name):
    trials, poses, _ = solved
    evaluator, wrong = fresh(), WRITTEN[name](*poses, trials.T_world_hand)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        scores = evaluator.score(*wrong, trials)
        evaluator.score(*wrong, trials)  # said once
    lines = [str(w.message) for w in said if "rows fail" in str(w.message)]
    # a mistake after which some rows succeed needs no line
    assert len(lines) == int(not scores.success.any()), lines
    assert all(name in line and line.isprintable() for line in lines), lines
    which = " and ".join(c for c, alike in zip(scores.criteria, failing(scores).tolist(), strict=True) if alike)
    start = f"all {len(trials)} rows fail{f' {which}' if which else ''}; "
    assert all(line.startswith(start) for line in lines), lines


def test_right_poses_and_poses_that_no_convention_mends_get_no_hint(solved, fresh):
    trials, poses, _ = solved
    nowhere = poses[1].clone()
    nowhere[:, 2, 3] = torch.linspace(3, 9, len(nowhere))  # above the robot's reach in every frame
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for T_world_ee in (poses[1], nowhere):
            fresh().score(poses[0], T_world_ee, trials)
        few = slice(0, 7)
        fresh().score(inverted(poses[0])[few], poses[1][few], trials[few])
    assert [str(w.message) for w in said] == []


def test_poses_from_another_origin_are_told_by_how_much(solved, fresh):
    trials, (T_obj_ee, T_world_ee), _ = solved
    from_the_floor = T_world_ee.clone()
    from_the_floor[:, 2, 3] += 0.75
    with pytest.warns(
        UserWarning, match=r"pass with T_world_ee moved by about \(-?0(.1)?, -?0(.1)?, -0.[678]\) m: the world's"
    ):
        fresh().score(T_obj_ee, from_the_floor, trials)


def test_a_hint_changes_no_verdict(solved, fresh):
    trials, poses, _ = solved
    wrong = WRITTEN["T_world_ee inverted"](*poses, None)
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
        (1.0, 1e9, "with time_s read as nanoseconds it lasts"),
        (1.0, 1.0, None),
        (1000.0, 1.0, "the median motion has an angle of {most} rad, {turns} turns: angles are in radians"),
    ],
)
def test_motions_in_degrees_or_milliseconds_are_told(solved, fresh, of_q, of_time, words):
    trials, poses, scores = solved
    most = sorted((scores.path * of_q).abs().flatten(1).amax(1).tolist())[(len(trials) - 1) // 2]
    words = words and words.format(most=round(most), turns=round(most / math.tau))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        fresh().score_motion(poses[0], scores.path * of_q, scores.path_time_s * of_time, trials, length=scores.path_len)
    lines = [str(w.message) for w in said if re.search("rows|median", str(w.message))]
    assert len(lines) == (words is not None) and all(re.search(words, line) for line in lines), lines


@pytest.mark.parametrize("name", ["r2h-v0", "r2h-release"])
@pytest.mark.parametrize("hand", ["true", "estimated"])
def test_the_hands_pose_in_place_of_the_ees_is_named(name, hand):
    evaluator = never_asked(name)
    trials = evaluator.benchmark.trials(6)
    T = trials.T_world_hand if hand == "true" else predict_target(trials, evaluator.scene, seed=0).T.float()
    assert (hand == "true") == torch.equal(T, trials.T_world_hand)
    T_obj_ee = random.predict(trials, evaluator.scene, seed=0).T_obj_ee
    words = r"T_world_ee lies at the hand's pose \(trials.T_world_hand, true or estimated\) in all 12 rows"
    with pytest.warns(UserWarning, match=words):
        evaluator.score(T_obj_ee, T, trials, stages="pose")


@pytest.mark.parametrize("name", ["r2h-v0", "r2h-v2", "r2h-release"])
@pytest.mark.parametrize("of_the_hand", ["its turn", "not its turn"])
def test_the_palm_in_place_of_the_ees_position_is_named(name, of_the_hand):
    """Turned about the base, such rows pass Safe since they are nowhere near the hand: that is no evidence."""
    evaluator = never_asked(name)
    trials = evaluator.benchmark.trials(6)
    answer = random.predict(trials, evaluator.scene, seed=0)
    T = (trials.T_world_hand if of_the_hand == "its turn" else answer.T_world_ee).clone()
    joints = evaluator.scene.hands.joints[trials.hand_index.long()]  # wrist and four roots, in the hand's frame
    palm = joints[:, [0, 1, 4, 7, 10]].mean(1)
    T[:, :3, 3] = se3.apply(trials.T_world_hand, palm)
    words = r"T_world_ee lies at the palm \(scene.palm, true or estimated\) in all 12 rows"
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        evaluator.score(answer.T_obj_ee, T, trials, stages="pose")
    lines = [str(w.message) for w in said if "rows" in str(w.message)]
    assert len(lines) == 1 and re.search(words, lines[0]), lines


@pytest.mark.check
def test_a_later_call_in_which_all_rows_fail_is_looked_at_once_after_a_right_one(fresh, solved):
    trials, (T_obj_ee, T_world_ee), _ = solved
    evaluator = fresh()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert evaluator.score(T_obj_ee, T_world_ee, trials, "pose").success.all()
        evaluator.score(T_obj_ee, T_world_ee, trials, "pose")
        evaluator.kinematic.score(T_world_ee, T_obj_ee, trials, "pose")  # a search's
    with pytest.warns(UserWarning, match="exchanged"):
        wrong = evaluator.score(T_world_ee, T_obj_ee, trials, "pose")
    assert not wrong.success.any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        evaluator.score(T_world_ee, T_obj_ee, trials, "pose")


def test_to_pass_more_criteria_is_no_evidence(fresh, solved):
    """A convention is named if rows succeed in it: far from the hand all rows pass Safe, and none Reach."""
    trials, (T_obj_ee, T_world_ee), _ = solved
    palm = fresh().scene.palm(trials.hand_index, trials.T_world_hand)[0]
    near = T_world_ee.clone()
    near[:, :3, 3] = palm + 0.062 * torch.nn.functional.normalize(torch.tensor([0.3, 0.5, 1.0]), dim=0)
    evaluator = fresh()
    evaluator.called = True  # no warning: the hint is asked for
    given = evaluator.score(T_obj_ee, near, trials, stages="pose")
    turned = evaluator.score(T_obj_ee, HALF @ near, trials, stages="pose")
    assert not given.success.any() and len(trials) >= 16, "or no hint is looked for"
    more = turned.passed.sum(1) > given.passed.sum(1)
    assert more[:8].sum() >= 6, "they must pass more, or nothing is shown"
    assert evaluator.hint(given, T_obj_ee, near, trials) is None


def test_two_conventions_that_are_as_good_are_both_named(fresh, solved):
    """A judge that knows the right grasps, whatever it is given: one pose inverted is as good as both."""
    trials, (T_obj_ee, T_world_ee), _ = solved
    evaluator, n = fresh(), len(trials)
    evaluator.called = True

    def judge(a, b, rows):
        return evaluator.score(T_obj_ee.repeat(len(b) // n, 1, 1), b, rows, stages="pose")

    wrong = inverted(T_world_ee)
    scores = evaluator.score(T_obj_ee, wrong, trials, stages="pose")
    words = pose_hint(scores, T_obj_ee, wrong, trials, evaluator.scene, judge)
    first = f"{n} of {n} pass with T_world_ee inverted: it is the ee in the world frame"
    assert words is not None and words.endswith(
        f"; {first}; {n} of {n} pass with both poses inverted: T_a_b is b in the frame of a"
    )
    named = evaluator.hint(scores, T_obj_ee, wrong, trials)
    assert named is not None and named.endswith(f"; {first}")


@pytest.mark.parametrize("right", [3, 4])
def test_less_than_a_quarter_may_succeed_by_chance(fresh, solved, right):
    """The right convention, and answers of which only some are good: the others stand 1 m higher."""
    trials, (T_obj_ee, T_world_ee), _ = solved
    poses = T_world_ee.clone()
    poses[right:, 2, 3] += 1.0
    evaluator, wrong = fresh(), inverted(poses)
    evaluator.called = True
    words = evaluator.hint(evaluator.score(T_obj_ee, wrong, trials), T_obj_ee, wrong, trials)
    assert (words is not None) == (4 * right >= len(trials)), words
    assert words is None or f"; {right} of {len(trials)} pass with T_world_ee inverted" in words


def test_one_gripper_that_is_not_in_the_hand_is_enough(fresh, solved):
    trials, (T_obj_ee, T_world_ee), _ = solved
    some = trials.T_world_hand.clone()
    some[0] = T_world_ee[0]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        fresh().score(T_obj_ee, some, trials)
    assert not any("hand's pose" in str(w.message) for w in told)


def test_poses_in_another_convention_are_told_on_a_benchmark_with_more_criteria_too():
    evaluator = Evaluator(load_benchmark("r2h-v3").until("present"), EvalConfig(execute=ExecConfig(sim="none")))
    trials = evaluator.benchmark.trials(6)
    known = load_benchmark("r2h-v3").certificates(trials.trial_id.numpy())
    grasp, pose = (torch.from_numpy(np.array(x)) for x in (known.T_obj_ee, known.T_world_ee))
    with pytest.warns(UserWarning, match=r"all 12 rows fail .*; 1[012] of 12 pass with T_world_ee inverted"):
        evaluator.score(grasp, inverted(pose), trials)


def test_a_grasp_given_where_the_object_rests_is_told_on_a_benchmark_that_begins_at_the_table():
    v3 = load_benchmark("r2h-v3").until("present")
    evaluator, trials = Evaluator(v3), v3.trials(4)
    known = load_benchmark("r2h-v3").certificates(trials.trial_id.numpy())
    grasp, pose = (torch.from_numpy(np.array(x)) for x in (known.T_obj_ee, known.T_world_ee))
    on_table = se3.matmul(moments(evaluator.scene, trials), grasp)
    evaluator.called = True  # no warning: the hint is asked for
    scores = evaluator.score(on_table, pose, trials, stages="pose")
    words = evaluator.hint(scores, on_table, pose, trials)
    assert words is not None and "T_obj_ee taken from the world into the object's frame: inverse(T_world_obj)" in words
    right = evaluator.score(grasp, pose, trials, stages="pose")
    assert evaluator.hint(right, grasp, pose, trials) is None


def test_rows_that_fail_at_different_criteria_get_a_hint_too(fresh, solved):
    """Chance passes single criteria: eight rows in millimetres, and eight whose grasps miss the object."""
    trials, (T_obj_ee, T_world_ee), _ = solved
    rows = torch.arange(16) % len(trials)
    grasps, handovers, asked = T_obj_ee[rows].clone(), T_world_ee[rows].clone(), trials[rows]
    handovers[:8, :3, 3] *= 1000
    grasps[8:] = grasps[8:] @ torch.tensor([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.12], [0, 0, 0, 1.0]])
    with pytest.warns(UserWarning, match="all 16 rows fail; 8 of 16 pass with T_world_ee read in millimetres"):
        scores = fresh().score(grasps, handovers, asked)
    assert not scores.success.any() and not failing(scores).any()
    handovers[15], grasps[15] = T_world_ee[rows[15]], T_obj_ee[rows[15]]  # one that succeeds
    evaluator = fresh()
    evaluator.called = True
    found = evaluator.score(grasps, handovers, asked)
    words = evaluator.hint(found, grasps, handovers, asked)
    assert found.success.sum() == 1 and words is not None
    assert words.startswith("1 of 16 rows succeed") and "8 of 16 pass with T_world_ee read in millimetres" in words


OF_OTHER_ROWS = {
    "given for the trial after its own": lambda ids: torch.arange(len(ids)).roll(1),
    "given for the trial before its own": lambda ids: torch.arange(len(ids)).roll(-1),
    "answers in the order of trial_id": lambda ids: torch.argsort(ids),
    "trial_id counted through": lambda ids: ids,
}


@pytest.mark.parametrize("name", OF_OTHER_ROWS)
def test_answers_that_stand_in_other_rows_are_told(answered, name):
    """The default benchmark's ids go split by split, so that rows by id are those of other trials."""
    evaluator, (trials, answer) = default_evaluator().kinematic, answered
    rows = OF_OTHER_ROWS[name](trials.trial_id)
    poses = answer.T_obj_ee[rows], answer.T_world_ee[rows]
    words = evaluator.hint(evaluator.score(*poses, trials, stages="pose"), *poses, trials)
    assert words is not None and name in words, words


def test_a_convention_in_which_some_rows_succeed_by_symmetry_is_told(solved, fresh):
    """The object's pose in the gripper's place passes with grasps near the object's origin."""
    trials, (T_obj_ee, T_world_ee), _ = solved
    evaluator = fresh()
    evaluator.called = True
    pose = T_world_ee @ inverted(T_obj_ee)
    scores = evaluator.score(T_obj_ee, pose, trials, stages="pose")
    words = evaluator.hint(scores, T_obj_ee, pose, trials)
    assert scores.success.any() and words is not None and "T_world_ee times T_obj_ee" in words


def test_joints_in_the_order_of_the_alphabet_are_told_where_the_motion_then_begins_at_home(solved, fresh):
    trials, poses, scores = solved
    names = fresh().scene.robot.joints
    order = sorted(range(len(names)), key=lambda k: names[k])
    with pytest.warns(UserWarning, match=r"begin at home with q read in the order elbow_joint, .*/joint_states"):
        fresh().score_motion(poses[0], scores.path[..., order], scores.path_time_s, trials, length=scores.path_len)
    with pytest.warns(UserWarning, match=r"begin at home with q read in the order wrist_3_joint, "):
        fresh().score_motion(poses[0], scores.path.flip(2), scores.path_time_s, trials, length=scores.path_len)


def test_motions_that_end_at_home_are_told(solved, fresh):
    trials, poses, scores = solved
    last = scores.path_len.long()[:, None]
    back = (last - 1 - torch.arange(scores.path.shape[1])).clamp(min=0)[..., None].expand_as(scores.path)
    with pytest.warns(UserWarning, match="motions end at home, and none begins there"):
        fresh().score_motion(poses[0], scores.path.gather(1, back), scores.path_time_s, trials, length=scores.path_len)


def test_motions_in_turns_as_differences_or_shifted_by_half_turns_are_told(solved, fresh):
    trials, poses, scores = solved
    q, time_s, length = scores.path, scores.path_time_s, scores.path_len
    home = torch.tensor(fresh().scene.robot.home_q)
    half = torch.zeros(q.shape[2])
    half[3] = math.pi
    for given, words in (
        (q / (2 * math.pi), f"{len(q)} motions begin at home with q read as turns"),
        (
            torch.diff(q, dim=1, prepend=home.expand(len(q), 1, -1)),
            "8 of 8 pass with q read as differences between samples",
        ),
        (q + half, f"{len(q)} motions begin at home but for whole half turns .wrist_1_joint .180 degrees"),
    ):
        with pytest.warns(UserWarning, match=words):
            fresh().score_motion(poses[0], given.float(), time_s, trials, length=length)
    evaluator = fresh()
    evaluator.moved = True
    odd = q + 0.3 * half  # no half turn, and nothing that fits
    found = evaluator.score_motion(poses[0], odd, time_s, trials, length=length)
    assert evaluator.motion_hint(found, poses[0], trials, odd, time_s, length) is None
