"""Contact-Handover chooses what its rules say: blocked contact, clusters, least cost; made again by brute force."""

import baseline_twins as twins
import numpy as np
import pytest
import torch
import trimesh
from baseline_twins import NOISE, above, answer, candidates, chosen_candidate, evaluator, middle, predict, trials
from convex_twin import primitive_distance
from numpy.typing import NDArray
from rounds import each

from r2h_batch.judge.grasp import gripper_poses
from r2h_batch.judge.ik import solve_ik
from r2h_batch.methods import contact
from r2h_batch.methods.least_cost_pose import approach_fan, collision_cost, gripper_capsule, hand_sample
from r2h_batch.methods.placing import in_order
from r2h_batch.methods.predictors import predict_contacts, predict_receiving, predict_target
from r2h_batch.scene.robot_file import load_robot


def near_gripper(i: int) -> NDArray[np.bool_]:
    """(K, P) cloud points nearer than 2 cm to each candidate's gripper."""
    model, robot = evaluator().scene.objects[int(trials().object_index[i])], load_robot()
    T, opening, _ = candidates(i)
    R, p = (x.double().numpy() for x in gripper_poses(load_robot(), opening))
    out = np.zeros((len(T), len(model.points)), bool)
    for k, T_obj_ee in enumerate(T.double().numpy()):
        in_ee = (model.points - T_obj_ee[:3, 3]) @ T_obj_ee[:3, :3]
        for g, (kind, size) in enumerate(zip(robot.gripper.kind, robot.gripper.size, strict=True)):
            near = np.flatnonzero(((in_ee - p[k, g]) ** 2).sum(1) < (np.linalg.norm(size) + contact.BLOCKED_M) ** 2)
            x = (in_ee[near] - p[k, g]) @ R[k, g]
            out[k, near] |= primitive_distance(int(kind), size, x) < contact.BLOCKED_M
    return out


def clusters(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """DBSCAN by its definition: cores have enough neighbours, members are within eps of a core."""
    close = np.linalg.norm(points[:, None] - points, axis=2) <= contact.EPS_M
    core = close.sum(1) >= contact.MIN_SAMPLES
    return (close & core).any(1)


def test_contact_takes_the_grasp_that_blocks_least_contact_of_clustered_clear_ones():
    scene = evaluator().scene
    taking = predict_receiving(trials(), scene, noise=NOISE)
    found = predict_contacts(trials(), scene, predictor=twins.ends).double().numpy()
    kept = np.where(found >= 0.4, found, 0.0)
    assert ((found > 0) & (found < 0.4)).any() and (kept > 0).any(1).all()
    unlike = 0
    for i in range(0, len(trials()), 3):
        T, opening, score = candidates(i)
        member = clusters(T[:, :3, 3].double().numpy())
        blocked = near_gripper(i) @ kept[i]
        pool = twins.clear_of(taking.vertices[i], T, opening) & member
        got = chosen_candidate(i, answer("contact").T_obj_ee[i])
        if not pool.any():
            continue
        assert pool[got] and blocked[got] <= blocked[pool].min() * (1 + 1e-5) + 1.5  # one point within rounding of 2 cm
        equal = pool & (blocked <= 0)
        assert not equal[got] or score[got] >= score[equal].max() - 1e-7
        unlike += int(blocked.max() > blocked[got])
    assert unlike >= 4


def test_of_equally_blocked_grasps_the_best_scored_wins_and_filters_give_way_one_by_one():
    blocked = torch.tensor([[2.0, 1.0, 1.0, 0.0, 0.0]] * 4)
    score = torch.tensor([[0.9, 0.2, 0.3, 0.8, 0.9]] * 4)
    clear = torch.tensor([[1, 1, 1, 1, 0], [1, 1, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 0]], dtype=torch.bool)
    clustered = torch.tensor([[1, 1, 1, 0, 1]] * 4, dtype=torch.bool)
    everything = torch.ones_like(clear)

    def first(exists):
        order, _ = in_order(contact.clustered_else_clear(clear, clustered, exists), blocked, -score)
        return order[:, 0].tolist()

    assert first(everything) == [2, 2, 3, 4]
    four = everything.clone()
    four[:, 4] = False
    assert first(four) == [2, 2, 3, 3]


@pytest.mark.parametrize("gate", ["none", "ik"])
def test_contacts_orientation_has_the_least_cost_of_all_or_of_those_that_pass_the_gate(gate):
    scene = evaluator().scene
    target = predict_target(trials(), scene, noise=NOISE)
    fan = approach_fan(target.palm_normal, 32, 8).numpy()
    robot = load_robot()
    some = [1, 10] if gate == "none" else [10]
    answered = predict(contact, trials()[torch.tensor(some)], gate=gate)
    for row, i in each(enumerate(some)):
        k = chosen_candidate(i, answered.T_obj_ee[row])
        T_obj_ee, opening, _ = candidates(i)
        T = twins.pose(fan[i], above(target, i) - fan[i] @ middle(answered, row, i)[1])
        got = answered.T_world_ee[row].double().numpy()
        poses = torch.from_numpy(T).float()
        reached = np.ones(len(T), bool) if gate == "none" else solve_ik(poses.contiguous()).reachable.numpy()
        hand = target.vertices[i, hand_sample(scene, 128)]
        o = trials().object_index[i : i + 1]
        cost = collision_cost(scene, o, T_obj_ee[k : k + 1], opening[k : k + 1], poses[None], hand[None])[0].numpy()
        mine = int(np.abs(T - got).max((1, 2)).argmin())
        assert np.abs(T[mine] - got).max() < 1e-5
        assert reached[mine] and cost[mine] <= cost[reached].min() + 1e-9
        assert mine == np.flatnonzero(reached & (cost == cost[mine]))[0]  # of equals the first of the fan
        R, q = (x[0].double().numpy() for x in gripper_poses(load_robot(), opening[k : k + 1]))
        mesh = scene.objects[int(o)].mesh
        for m in (0, 60, 111, 200):
            x = (hand.double().numpy() - T[m, :3, 3]) @ T[m, :3, :3]
            in_obj = x @ T_obj_ee[k, :3, :3].double().numpy().T + T_obj_ee[k, :3, 3].double().numpy()
            d = -trimesh.proximity.signed_distance(mesh, in_obj)
            for g in range(len(q)):
                d = np.minimum(
                    d, primitive_distance(int(robot.gripper.kind[g]), robot.gripper.size[g], (x - q[g]) @ R[g])
                )
            assert cost[m] == pytest.approx(np.maximum(0.03 - d, 0).mean(), abs=2e-6)


def test_the_grippers_capsule_holds_it_at_any_opening():
    robot = load_robot()
    low, high, radius = gripper_capsule(robot)
    R, p = (x.double().numpy() for x in gripper_poses(robot, torch.tensor([0.0, 0.0411, 0.085])))
    axis = np.array([[0.0, 0.0, z] for z in np.linspace(low, high, 100)])
    d = np.random.default_rng(0).normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    outside = axis[:, None] + (radius + 1e-3) * d  # a millimetre off the capsule, or inside of it
    gap = np.linalg.norm(outside[:, :, None] - axis[None, None, ::4], axis=3).min(2)
    outside = outside[gap > radius + 5e-4]
    for n in range(len(p)):
        for g, (kind, size) in enumerate(zip(robot.gripper.kind, robot.gripper.size, strict=True)):
            assert primitive_distance(int(kind), size, (outside - p[n, g]) @ R[n, g]).min() > 0
    assert radius < 0.1 and high < 0.03
