"""The IK on pytorch-kinematics against the fused kernel: the same branches, the same bits in any batch, the same verdicts."""

import dataclasses

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig, IkConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.judge import ik as fused
from r2h_batch.judge import ik_jacobian
from r2h_batch.kernels.ik import step as ik_step
from r2h_batch.methods.random import predict
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.robot_file import load_robot


@pytest.fixture(scope="module")
def targets():
    """Reachable ones from joint angles (one at a wrist singularity), one out of reach, one invalid transform."""
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, (80, 6))
    q[7, 4] = 0.0
    T = torch.from_numpy(ee_pose(load_robot(), q).astype(np.float32))
    T[3, :3, 3] = torch.tensor([1.3, 0.0, 0.4])
    T[5, 0, 0] = torch.nan
    return T


@pytest.fixture(scope="module")
def both(targets):
    return fused.solve_ik(targets), ik_jacobian.solve_ik(targets)


def test_it_finds_the_branches_of_the_fused_kernel(both):
    kernel, jacobian = both
    assert torch.equal(kernel.valid, jacobian.valid) and kernel.valid.sum() > 450
    difference = (kernel.q - jacobian.q)[kernel.valid].double().numpy()
    assert np.abs(np.sin(difference / 2)).max() < 2e-4  # near singularities; the residuals below are what counts
    assert np.median(np.abs(difference)) < 1e-6
    assert jacobian.position_error_m[jacobian.valid].max() < 1e-6
    assert jacobian.rotation_error_rad[jacobian.valid].max() < 2e-6
    assert jacobian.q[~jacobian.valid].isnan().all()


def test_it_does_the_work_itself_and_says_where_not(both, targets):
    kernel, jacobian = both
    converged, found = int(ik_step.STATUS_CONVERGED), int(ik_step.STATUS_FOUND)
    tried = kernel.status == found
    assert (jacobian.status[tried] == converged).float().mean() > 0.98
    assert (jacobian.status == found).sum() == (jacobian.status[tried] != converged).sum()
    assert torch.equal(
        jacobian.status[~tried], kernel.status[~tried]
    )  # proofs and lines of solutions are the closed form's
    assert not torch.equal(jacobian.q[kernel.valid], kernel.q[kernel.valid])  # other bits: not the kernel's answer
    none = ik_jacobian.solve_ik(targets[:3], iterations=1)
    assert (none.status == found).any() and not (none.status == converged).any()


def test_rows_do_not_depend_on_their_batch(both, targets, monkeypatch):
    _, jacobian = both
    order = torch.from_numpy(np.random.default_rng(2).permutation(len(targets)))
    part = order[:9]
    again = ik_jacobian.solve_ik(targets[part])
    for field in each(dataclasses.fields(again)):
        mine, whole = getattr(again, field.name), getattr(jacobian, field.name)[part]
        assert mine.numpy().tobytes() == whole.numpy().tobytes(), field.name


@pytest.mark.parametrize("n", [24, pytest.param(1000, marks=pytest.mark.slow)])
def test_verdicts_are_those_of_the_fused_kernel(n):
    trials = load_benchmark("r2h-v1").trials(n, splits=("S0", "S1"))
    still = ExecConfig(sim="none")
    scores = []
    for solver in ("fused", "pytorch-kinematics"):
        evaluator = Evaluator(load_benchmark("r2h-v1"), EvalConfig(ik=IkConfig(solver), execute=still))
        predicted = predict(trials, evaluator.scene, seed=0)
        scores.append(evaluator.score(predicted.T_obj_ee, predicted.T_world_ee, trials))
    kernel, jacobian = scores
    differ = (kernel.outcome != jacobian.outcome) | (kernel.plan_reason != jacobian.plan_reason)
    assert not differ.any(), f"trials {trials.trial_id[differ].tolist()}"
    assert kernel.success.any() and (~kernel.success).any()
