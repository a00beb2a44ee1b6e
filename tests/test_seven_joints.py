"""An arm of seven joints has its own instance of the kernels (base/launch/instances.py), and goes through the evaluator."""

import numpy as np
import oracle
import pytest
import torch
from seven import seven_joints

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.judge.ik import solve_ik
from r2h_batch.judge.planner import Planner
from r2h_batch.kernels.plan.lines import check_postures
from r2h_batch.kernels.robot.world import World
from r2h_batch.scene.robot import ee_pose
from r2h_batch.types import PlanReason

KINEMATIC = EvalConfig(execute=ExecConfig(sim="none"))
SEVEN = seven_joints()


@pytest.fixture(scope="module")
def evaluator():
    return Evaluator(load_benchmark("r2h-v1").on(SEVEN, "as-for-ur5e"), KINEMATIC)


@pytest.mark.check
def test_a_second_number_of_joints_is_a_second_instance_of_the_same_files():
    other = of_joints(check_postures, 7)
    assert of_joints(check_postures, 6) is check_postures is not other is of_joints(check_postures, 7)
    assert other.module.name == "r2h_batch.kernels_7.plan.lines" and other.key == check_postures.key
    assert of_joints(World, 7) is not World


def test_with_its_extra_joint_at_0_it_is_checked_as_the_ur5e_bit_for_bit_but_for_rounding(scene, evaluator):
    stages, base = oracle.random_stages(scene, np.random.default_rng(6), 8)
    q = np.random.default_rng(7).normal(base[:, None], 0.3, (8, 100, 6))
    wide = np.insert(q, 3, 0.0, axis=2)
    found = []
    for arm, postures in ((scene, q), (evaluator.scene, wide)):
        flat = torch.tensor(postures.reshape(800, -1), dtype=torch.float32)
        every = torch.ones(800, dtype=torch.bool)
        found.append(Planner(arm, oracle.place(arm, stages)).check(flat, every, 100))
    (clear, pair, room), (clear7, pair7, room7) = found
    borderline = (room - room7).abs() > 1e-5
    assert 100 < int(clear.sum()) < 700 and torch.equal(clear, clear7)
    assert (pair == pair7).float().mean() > 0.99 and not borderline.any()


def test_it_reaches_what_it_can_reach_and_says_only_what_is_proven(evaluator):
    q = np.random.default_rng(3).uniform(np.maximum(SEVEN.lower, -np.pi), np.minimum(SEVEN.upper, np.pi), (2000, 7))
    target = torch.from_numpy(ee_pose(SEVEN, q).astype(np.float32))
    shoulder = torch.tensor([0.0, 0.0, SEVEN.T_parent_joint[0, 2, 3]])
    longest = np.linalg.norm([*SEVEN.T_parent_joint[1:, :3, 3], SEVEN.T_wrist3_ee[:3, 3]], axis=1).sum()
    away = torch.nn.functional.normalize(target[1980:, :3, 3] - shoulder)
    away[:10] *= longest + 0.01  # the stretched links do not come so far
    away[10:] *= longest - 0.01  # they cannot be stretched so far, but nothing here says so
    target[1980:, :3, 3] = shoulder + away
    found = solve_ik(target, robot=SEVEN)
    assert found.reachable[:1980].all() and not found.reachable[1980:].any() and found.unproven[:1980].all()
    assert found.unreachable_proven.nonzero().flatten().tolist() == list(range(1980, 1990))
    rows, slots = found.valid.nonzero(as_tuple=True)
    postures = found.q[rows, slots].double().numpy()
    assert np.abs(ee_pose(SEVEN, postures) - target[rows].double().numpy()).max() < 1.5e-5
    assert ((SEVEN.lower <= postures) & (postures <= SEVEN.upper)).all()
    assert found.valid.sum(1)[:1980].float().mean() > 6.0
    apart = found.q[:, :, None] - found.q[:, None]
    apart = (
        (apart - 2 * torch.pi * (apart / (2 * torch.pi)).round()).abs().amax(3)
    )  # a whole turn more is no other posture
    apart = apart[:, *np.triu_indices(apart.shape[1], 1)]
    assert float(apart[apart.isfinite()].min()) > 0.24
    assert found.nearest[found.reachable].isnan().all() and found.miss_m[found.reachable].isinf().all()
    missed = found.nearest[~found.reachable].double().numpy()
    off = np.linalg.norm(ee_pose(SEVEN, missed)[:, :3, 3] - target[~found.reachable, :3, 3].double().numpy(), axis=1)
    assert (off > 0.005).all() and (found.miss_m[~found.reachable].numpy() >= off - 1e-4).all()


def test_oracle_answers_for_the_ur5e_are_reached_on_free_paths(scene, evaluator):
    from r2h_batch.methods.oracle import predict

    trials = load_benchmark("r2h-v1").trials(4)
    answer = predict(trials, scene, seed=0, evaluator=Evaluator(load_benchmark("r2h-v1"), KINEMATIC))
    trials = trials.named(evaluator.scene.objects)  # on another robot: poses alone are the same
    scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials)
    assert scores.success.sum() >= len(trials) - 1
    unproven = {PlanReason.IK_UNREACHABLE, PlanReason.IK_IN_COLLISION}
    assert not unproven & {PlanReason(int(r)) for r in scores.plan_reason}
    posed = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials, stages="pose")
    assert (posed.success | ~scores.success).all()
    for k in torch.nonzero(scores.success).flatten().tolist():
        path = scores.path[k, : int(scores.path_len[k])].double().numpy()
        assert path.shape[1] == 7 and np.allclose(path[0], SEVEN.home_q, atol=1e-6)
        assert np.abs(ee_pose(SEVEN, path[-1])[:3, 3] - answer.T_world_ee[k, :3, 3].numpy()).max() < 1.5e-5
