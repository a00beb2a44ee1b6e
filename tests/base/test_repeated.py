"""Small calls that come back: what they keep never shows in a result."""

import copy
import pickle
import threading
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from problems import default_evaluator, make_batch
from rounds import each
from torch import Tensor

from r2h_batch import launching, load_benchmark
from r2h_batch.base.launch.repeated import TRIES, RepeatedCalls
from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge.grasp import gripper_poses
from r2h_batch.launching import SMALL_ROWS
from r2h_batch.methods import random
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.types import Scores

N = 260


def equal(a: Scores, b: Scores) -> bool:
    pairs = [(getattr(a, f.name), getattr(b, f.name)) for f in fields(a)]
    return type(a) is type(b) and all(
        x.dtype == y.dtype and torch.equal(x.nan_to_num(7.0), y.nan_to_num(7.0)) for x, y in pairs
    )


@pytest.fixture(scope="module")
def poses():
    batch = make_batch(default_evaluator().scene, N)
    return batch.T_obj_ee, batch.T_world_ee, batch.trials


@pytest.fixture(scope="module")
def whole(poses) -> Scores:
    assert N > SMALL_ROWS
    return default_evaluator().score(*poses, stages="pose")


@pytest.mark.check
def test_small_calls_of_any_order_and_size_have_the_bits_of_a_large_one(poses, whole):
    evaluator, kept = copy.copy(default_evaluator()), []
    for first, rows in [
        (0, 1),
        (1, 1),
        (2, 1),
        (0, 16),
        (16, 16),
        (5, 1),
        (7, 3),
        (0, SMALL_ROWS),
        (30, 1),
        (40, 8),
    ] * 5:
        some = slice(first, first + rows)
        kept.append((some, evaluator.score(*(x[some] for x in poses), stages="pose")))
    for some, scores in each(kept):  # after all calls: no later one has written into an earlier result
        assert equal(scores, whole[some]), some


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Rows of each call whose code runs; a recorded call is not there."""
    ran, judge = [], launching.fields_of

    def one(work: Any, stages: Any, names: Any, *inputs: Any) -> Any:
        ran.append(len(inputs[0]))
        return judge(work, stages, names, *inputs)

    monkeypatch.setattr(launching, "fields_of", one)
    return ran


@pytest.mark.parametrize("seen", ["hand", "body"])
def test_small_calls_before_a_persons_arm_and_torso_have_the_bits_of_a_large_one(poses, seen, monkeypatch):
    trials = load_benchmark("r2h-v1").trials(N)[:N]
    assert trials.receiver is not None
    receiver = trials.receiver.clone()
    receiver[::2, :4, 0] -= 0.3  # every other arm and torso stands in the robot's way
    trials = replace(trials, receiver=receiver)
    evaluator, ran = copy.copy(default_evaluator()), counted(monkeypatch)
    evaluator.config = replace(evaluator.config, receiver=seen)
    whole = evaluator.score(*poses[:2], trials, stages="pose")
    assert (whole.body_m < 0).sum() > 20 and (whole.body_m == CLEARANCE_CAP_M).sum() > 20
    ran.clear()
    for first, rows in [(0, 1), (1, 1), (4, 1), (7, 1), (0, 16), (32, 16), (8, 16), (0, SMALL_ROWS)] * 4:
        some = slice(first, first + rows)
        assert equal(evaluator.score(*(x[some] for x in (*poses[:2], trials)), stages="pose"), whole[some]), some
    assert ran.count(1) <= TRIES and ran.count(16) <= TRIES  # the other calls were recorded launches


def test_small_calls_with_pick_are_recorded_and_have_the_bits_of_those_that_are_not(monkeypatch):
    benchmark = load_benchmark("r2h-v3")
    evaluator, trials = Evaluator(benchmark), benchmark.trials(12)
    poses = random.predict(trials, evaluator.scene, seed=0)
    T_obj_ee, T_world_ee = poses.T_obj_ee.clone(), poses.T_world_ee.clone()
    T_obj_ee[3], T_world_ee[4] = torch.nan, 2.0  # no poses
    hand = trials.T_world_hand.clone()
    hand[5] = 0.0
    asked = T_obj_ee, T_world_ee, replace(trials, T_world_hand=hand)
    monkeypatch.setattr(launching, "SMALL_ROWS", 0)
    with pytest.warns(UserWarning, match="not rigid poses"):
        whole = evaluator.score(*asked, stages="pose")
    assert len(whole.pick[:, 0].unique()) >= 4  # passes, out of reach, meets something, not asked
    monkeypatch.undo()
    ran = counted(monkeypatch)
    for first, rows in each([(0, 1), (3, 1), (4, 1), (5, 1), (0, 8), (8, 1), (4, 8), (2, 8)] * 4):
        some = slice(first, first + rows)
        assert equal(evaluator.score(*(x[some] for x in asked), stages="pose"), whole[some]), some
    assert 0 < ran.count(1) <= TRIES and 0 < ran.count(8) <= TRIES


def test_what_a_caller_changes_in_a_result_reaches_no_later_call(poses, whole):
    evaluator = copy.copy(default_evaluator())
    for _ in range(3):
        scores = evaluator.score(*(x[:4] for x in poses), stages="pose")
        assert equal(scores, whole[:4])
        for f in fields(Scores):
            if f.name != "trial_id":
                getattr(scores, f.name).zero_()


def test_poses_whose_memory_moves_or_changes_are_judged_as_they_are(poses, whole):
    evaluator = copy.copy(default_evaluator())
    T_obj_ee, T_world_ee = (x[:1].clone() for x in poses[:2])
    for row in range(8):  # the same tensors, other memory or other numbers
        if row % 2:
            T_obj_ee.data, T_world_ee.data = poses[0][row : row + 1].clone(), poses[1][row : row + 1].clone()
        else:
            T_obj_ee.copy_(poses[0][row : row + 1])
            T_world_ee.copy_(poses[1][row : row + 1])
        assert equal(
            evaluator.score(T_obj_ee, T_world_ee, poses[2][row : row + 1], stages="pose"), whole[row : row + 1]
        )


def test_threads_modes_and_pickles_have_calls_of_their_own(poses, whole):
    evaluator = copy.copy(default_evaluator())
    found: list[Scores] = []

    def judge(of: Evaluator, row: int) -> Scores:
        T_obj_ee, T_world_ee, trials = (x[row : row + 1] for x in poses)
        return of.score(T_obj_ee, T_world_ee, trials, stages="pose")

    def work() -> None:
        found.extend(judge(evaluator, row) for row in range(20))

    workers = [threading.Thread(target=work) for _ in range(3)]
    for w in workers:
        w.start()
    for w in workers:
        w.join()
    for scores in found:
        row = int((whole.trial_id == scores.trial_id).nonzero()[0])
        assert equal(scores, whole[row : row + 1])
    assert len(found) == 60
    with torch.inference_mode():
        judge(evaluator, 3)
    assert equal(judge(evaluator, 4), whole[4:5])
    again = pickle.loads(pickle.dumps(judge(evaluator, 5)))
    assert equal(again, whole[5:6])
    for scores in (again, pickle.loads(pickle.dumps(whole[:1]))):  # nothing goes along that lies beside a field
        stored = (getattr(scores, f.name) for f in fields(Scores))
        assert all(x.untyped_storage().nbytes() == x.nbytes for x in stored)


def test_inputs_that_are_wrong_are_refused_after_ones_that_were_right(poses):
    evaluator = copy.copy(default_evaluator())
    T_obj_ee, T_world_ee, trials = (x[:1] for x in poses)
    evaluator.score(T_obj_ee, T_world_ee, trials, stages="pose")
    for wrong in (T_obj_ee[0], T_obj_ee.half(), T_obj_ee[:, :3]):
        with pytest.raises((TypeError, ValueError), match="T_obj_ee"):
            evaluator.score(wrong, T_world_ee, trials, stages="pose")
    gone = T_obj_ee.clone()
    gone.untyped_storage().resize_(0)
    with pytest.raises(TypeError, match="no memory"):
        evaluator.score(gone, T_world_ee, trials, stages="pose")


def calls_of(function: Callable[..., Any], count: int) -> tuple[int, list[Any], list[Any]]:
    """How often `RepeatedCalls` called a function for that many inputs, what it returned, and what the function
    returns."""
    calls, ran, found, direct = RepeatedCalls(1), [], [], []

    def counted(x: Tensor) -> Any:
        ran.append(x)
        return function(x)

    for i in range(count):
        x = torch.linspace(0.004 * i, 0.004 * i + 0.02, 5)
        found.append([y.clone() for y in calls(counted, x)])
        direct.append(list(function(x)))
    return len(ran), found, direct


def same(a: list[Any], b: list[Any]) -> bool:
    return all(torch.equal(x, y) for xs, ys in zip(a, b, strict=True) for x, y in zip(xs, ys, strict=True))


def test_launches_alone_run_without_their_function_and_follow_the_inputs():
    robot = load_robot("ur5e_2f85")
    ran, found, direct = calls_of(lambda x: gripper_poses(robot, x), 12)
    assert same(found, direct) and 2 <= ran <= TRIES
    assert not torch.equal(found[-1][1], found[-2][1])


def test_what_a_recording_would_not_repeat_runs_as_it_is_written():
    robot, count = load_robot("ur5e_2f85"), iter(range(100))
    tables = [torch.full((5,), 0.01 * i) for i in range(100)]
    for function in (
        lambda x: gripper_poses(robot, x + 0.01),  # torch before a launch
        lambda x: [x.mul(2.0), *gripper_poses(robot, x)],  # and beside one
        lambda x: [*gripper_poses(robot, x), *gripper_poses(robot, tables[0][:4])],  # other rows too
        lambda x: gripper_poses(robot, x[1:]),  # a part of an input
    ):
        ran, found, direct = calls_of(function, 8)
        assert same(found, direct) and ran == 8
    calls = RepeatedCalls(1)
    for _ in range(8):  # another object each time
        table = tables[next(count)]
        R, _ = calls(lambda x, of=table: gripper_poses(robot, of), torch.zeros(5))
        assert torch.equal(R, gripper_poses(robot, table)[0])


def test_rows_of_a_recorded_call_are_shared_among_threads(poses, whole):
    evaluator = copy.copy(default_evaluator())
    evaluator.threads = 3
    for rows in (64, 200):
        for _ in range(6):
            assert equal(evaluator.score(*(x[:rows] for x in poses), stages="pose"), whole[:rows])
