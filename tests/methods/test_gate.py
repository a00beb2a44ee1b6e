"""The gate: one right for all methods. What each may choose with it is looked for again, pose by pose."""

import baseline_twins as twins
import numpy as np
import pytest
import torch
from baseline_twins import (
    NOISE,
    above,
    answer,
    candidates,
    chosen_candidate,
    clear_of,
    evaluator,
    middle,
    predict,
    trials,
)
from needs import needs
from rounds import each

from r2h_batch.judge.ik import solve_ik
from r2h_batch.methods import contact, fc, intent, least_cost_pose
from r2h_batch.methods import gate as gates
from r2h_batch.methods.gate import let_through
from r2h_batch.methods.least_cost_pose import approach_fan
from r2h_batch.methods.predictors import predict_target, retrieve_receiving


def arm(T: torch.Tensor) -> torch.Tensor:
    """Which of (n, 4, 4) poses the arm reaches."""
    return solve_ik(T.reshape(-1, 4, 4).contiguous()).reachable.reshape(T.shape[:-2])


def third(T: torch.Tensor) -> torch.Tensor:
    """A worse arm: it reaches slices of space of 5 mm, every third one."""
    return (T[..., 0, 3] * 200).floor() % 3 == 0


@pytest.fixture
def worse(monkeypatch):
    """Methods ask the worse arm."""
    monkeypatch.setattr(gates, "reachable", lambda robot, T: third(T))


def in_reach(poses) -> np.ndarray:
    """Whether the worse arm reaches each pose."""
    return third(torch.from_numpy(np.asarray(poses)).float()).numpy()


@pytest.mark.parametrize("gate", ["none", "ik"])
def test_fcs_roll_is_the_first_or_the_first_that_the_arm_reaches(gate, worse):
    target = predict_target(trials(), evaluator().scene, noise=NOISE)
    found, late = predict(fc, trials(), gate=gate), 0
    assert torch.equal(found.T_obj_ee, predict(fc, trials(), gate="hand").T_obj_ee)  # the gate is for poses alone
    for i in each(range(len(trials()))):
        R = twins.rolls_from(found.T_world_ee[i], -target.wrist_to_middle[i].double().numpy())
        tries = twins.pose(R, above(target, i) - R @ middle(found, i)[1])
        reached = in_reach(tries)
        turn = int(reached.argmax()) if gate == "ik" and reached.any() else 0
        late += turn > 0
        assert np.abs(tries[turn] - found.T_world_ee[i].double().numpy()).max() < 2e-5
    assert (late > 0) == (gate == "ik")


@needs("rtree")
@pytest.mark.parametrize(("gate", "at"), [("ik", "object"), ("hand", "object"), ("ik", "ergonomic")])
def test_intents_gate_chooses_among_grasps_as_each_has_one_pose(gate, at, worse):
    own = predict(intent, trials(), at=at)
    found = predict(intent, trials(), at=at, gate=gate)
    scene = evaluator().scene
    target, taking = predict_target(trials(), scene, noise=NOISE), retrieve_receiving(trials(), scene, noise=NOISE)
    other = same = 0
    for i in each(range(len(trials()))):
        T_obj_ee, opening, _ = candidates(i)
        # hand, object and gripper move as one: the object stands where it stands without a gate
        T_world_obj = own.T_world_ee[i].double().numpy() @ np.linalg.inv(own.T_obj_ee[i].double().numpy())
        T = T_world_obj @ T_obj_ee.double().numpy()
        passes = in_reach(T)
        if gate == "hand":
            both = passes & clear_of(target.vertices[i], torch.from_numpy(T).float(), opening)
            passes = both if both.any() else passes
        v_h = taking.wrist_to_middle[i].double().numpy()
        grip = T_obj_ee.double().numpy()
        score = grip[:, :3, 2] @ v_h - np.linalg.norm(grip[:, :3, 3] - taking.palm_point[i].double().numpy(), axis=1)
        before, got = (chosen_candidate(i, x.T_obj_ee[i]) for x in (own, found))
        assert np.abs(T[got] - found.T_world_ee[i].double().numpy()).max() < 2e-5
        if not passes.any() or passes[before]:
            same += 1
            assert got == before
            continue
        assert score[got] >= score[before] - 1e-6
        # others that pass, better ones or all, are on the region that the instruction names: they are out with any gate
        better = np.flatnonzero(passes & (score < score[got] - 1e-6) if passes[got] else passes)
        other += passes[got]
        model = scene.objects[int(trials().object_index[i])]
        for k in better:
            ray = grip[k, :3, 3] - 0.1 * grip[k, :3, 2], grip[k, :3, 2]
            hit = model.mesh.ray.intersects_first(*(x[None] for x in ray))[0]
            assert hit >= 0 and model.receiver_face[hit]
    assert other >= 2 and same >= 1


def test_contacts_gate_leaves_out_poses_whose_gripper_meets_the_estimated_hand(worse, monkeypatch):
    monkeypatch.setattr(least_cost_pose, "collision_cost", lambda *given, **_: torch.zeros(given[4].shape[:2]))
    target = predict_target(trials(), evaluator().scene, noise=NOISE)
    fan = approach_fan(target.palm_normal, 32, 8).numpy()
    found, near, met = predict(contact, trials(), gate="hand", height_m=0.02), target.palm_point, 0
    for i in each(range(len(trials()))):
        k = chosen_candidate(i, found.T_obj_ee[i])
        place = (near[i].double() + 0.02 * target.palm_normal[i].double()).numpy()
        T = twins.pose(fan[i], place - fan[i] @ middle(found, i)[1])
        clear = clear_of(target.vertices[i], torch.from_numpy(T).float(), candidates(i)[1][k : k + 1].expand(len(T)))
        reached = in_reach(T)
        passes = reached & clear if (reached & clear).any() else reached
        assert np.abs(T[passes.argmax()] - found.T_world_ee[i].double().numpy()).max() < 2e-5
        met += passes.argmax() != reached.argmax()
    assert met >= 2


def test_a_gate_that_nothing_passes_gives_way_to_what_the_arm_reaches_and_then_to_all():
    passes = torch.tensor([[0, 1, 0], [0, 0, 0], [0, 0, 0], [0, 1, 0]], dtype=torch.bool)
    reached = torch.tensor([[1, 1, 0], [0, 1, 1], [0, 0, 0], [1, 1, 0]], dtype=torch.bool)
    usable = torch.tensor([[1, 1, 1], [1, 1, 1], [0, 1, 1], [1, 0, 1]], dtype=torch.bool)
    wanted = [[0, 1, 0], [0, 1, 1], [0, 1, 1], [1, 0, 0]]
    assert let_through(passes, reached, usable).int().tolist() == wanted


@pytest.mark.parametrize("name", twins.METHODS)
def test_every_rule_based_method_takes_the_same_three_gates_and_refuses_others(name):
    answers = {
        gate: predict(twins.METHODS[name], trials()[:6], gate=gate).T_world_ee for gate in ("none", "ik", "hand")
    }
    own = {"fc": "hand", "handover_va": "ik", "contact": "none", "intent": "none"}[name]
    assert torch.equal(answer(name).T_world_ee[:6], answers[own])
    reached = {gate: int(arm(T).sum()) for gate, T in answers.items()}
    assert reached["none"] <= reached["hand"] == reached["ik"]
    with pytest.raises(ValueError, match="gate is 'reach'; allowed are"):
        predict(twins.METHODS[name], trials()[:1], gate="reach")
