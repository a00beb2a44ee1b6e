"""Joint ranges of receivers whose hands move: the angles are the judge's, and no goal of a hand is beyond them."""

import pytest
import torch
from problems import kinematic_evaluator

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.closed_loop import moving
from r2h_batch.closed_loop.arm_ranges import lower_arm_angles, within_ranges
from r2h_batch.closed_loop.moving import MovingHands, ReceiverMotion
from r2h_batch.judge.reception import ANGLES, reception
from r2h_batch.methods import oracle
from r2h_batch.scene.hand import palm_frame
from r2h_batch.scene.tables import MIDDLE_ROOT
from r2h_batch.trials.holding.held_out import load_held_out


@pytest.fixture(scope="module")
def evaluator():
    return kinematic_evaluator("r2h-v1")


def test_angles_are_those_of_the_judge_at_the_grasps_that_people_take(evaluator):
    trials = load_benchmark("r2h-v1").trials(12)
    answer = oracle.predict(trials, evaluator.scene, evaluator=evaluator)
    posed = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials, stages="pose")
    found = reception(posed, leans_deg=(0.0,))
    rows = torch.nonzero(found.received).flatten()
    assert len(rows) >= 8
    held_out = load_held_out(evaluator.scene.objects, evaluator.scene.hands.model)
    grasps, which = held_out.grasps, held_out.first[trials.object_index[rows].long()] + found.grasp[rows].long()
    hand, side = se3.inverse(grasps.T_obj_hand[which].double()), grasps.side[which].long()
    joints = se3.apply(hand[:, None], grasps.joints[which].double())  # stored in the object's frame
    _, normal = palm_frame(joints, side)
    along = joints[:, MIDDLE_ROOT] - joints[:, 0]
    along = along - se3.dot(along, normal)[:, None] * normal
    along = along / se3.dot(along, along).sqrt()[:, None]
    T = found.T_world_hand[rows].double()
    shoulder, wrist = trials.receiver[rows, 0, :3].double(), se3.apply(T, joints[:, 0])
    turned = (se3.rotate(T[:, :3, :3], x) for x in (along, normal))
    out = torch.where(side == 0, -1.0, 1.0).double()
    angles = lower_arm_angles(shoulder, found.elbow[rows].double(), wrist, *turned, out)
    named = [ANGLES.index(name) for name in ("elbow", "supination", "wrist_flexion", "ulnar_deviation")]
    assert (angles - found.angles_deg[rows][:, named]).abs().max() < 0.1
    assert within_ranges(angles).all()


def test_no_hand_goes_where_its_wrist_cannot(evaluator, monkeypatch):
    trials, motion = load_benchmark("r2h-v1").trials(60), ReceiverMotion("moves", 0.15, 50.0)

    def beyond(trials):
        hands = MovingHands.of(evaluator.scene, trials, motion)
        return ~hands._comfortable(hands.pose(60.0).double(), evaluator.scene)

    assert not beyond(trials).any()
    monkeypatch.setattr(moving, "SHARES", ())
    assert 0.2 < beyond(trials).float().mean() < 0.9
