"""Parts of a row beside its geometry: kernels against `se3` and against the definition, in plain Python."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from problems import default_evaluator, make_batch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base import se3
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.grasp import attach, close_gripper, squeezed
from r2h_batch.judge.metrics import Criterion
from r2h_batch.judge.scores import verdict
from r2h_batch.types import Outcome
from r2h_batch.verdicts import REGISTRY

N = 512


def poses(seed: int) -> torch.Tensor:
    """Rotations near the tolerance of a pose, some of them mirrored, far away, not finite, or with another bottom row."""
    g = torch.Generator().manual_seed(seed)
    R = torch.linalg.qr(torch.randn(N, 3, 3, generator=g))[0]
    R = R * torch.sign(torch.linalg.det(R))[:, None, None]
    T = se3.from_rotation(R, torch.randn(N, 3, generator=g))
    T[::2, :3, :3] += 3e-4 * torch.randn(N // 2, 3, 3, generator=g)
    for i, (row, column, value) in enumerate(
        [(0, 3, 1001.0), (1, 3, -999.0), (3, 0, 2e-6), (3, 3, 1.00001), (2, 1, math.nan), (0, 0, math.inf)]
    ):
        T[seed + 7 * i, row, column] = value
    T[seed + 50 :: 61, :3, 0] *= -1
    return T


@pytest.fixture(scope="module")
def held():
    evaluator = default_evaluator()
    trials = load_benchmark("r2h-v0").trials_with_ids(torch.arange(N))
    given = poses(1), poses(2), poses(3)
    trials = replace(trials, T_world_hand=given[2])
    return given, trials, attach_object(evaluator.scene, given[0], given[1], trials, evaluator.config)


def test_poses_are_those_of_se3_and_rows_that_are_none_have_the_identity(held):
    given, _, held = held
    active = torch.stack([se3.is_pose(T) for T in given]).all(0)
    assert torch.equal(held.active, active)
    assert 0.2 < active.double().mean() < 0.9
    for mine, T in zip((held.T_obj_ee, held.T_world_ee, held.T_world_hand), given, strict=True):
        assert torch.equal(mine[active], se3.orthonormalise(T[active]))
        assert (mine[~active] == torch.eye(4)).all()


def test_the_attachment_and_the_receivers_ball_are_those_of_se3_to_the_bit(held):
    _, trials, held = held
    scene, active = default_evaluator().scene, held.active
    attached = attach(held.T_obj_ee, held.grasp.shift_m)
    assert torch.equal(held.attached[active], attached[active])
    _, _, center = scene.palm(trials.hand_index, held.T_world_hand)
    T_world_obj = se3.matmul(held.T_world_ee, se3.inverse(attached))
    ball = se3.apply(se3.inverse(T_world_obj), center)
    assert torch.equal(held.ball[active], ball[active])


def test_the_grasp_is_that_of_close_gripper_and_squeezed_to_the_bit():
    evaluator = default_evaluator()
    batch, limits = make_batch(evaluator.scene, N), evaluator.config.thresholds
    batch.T_obj_ee[::2, :3, 3] += 0.05 * torch.randn((N // 2, 3), generator=torch.Generator().manual_seed(0))
    held = attach_object(evaluator.scene, batch.T_obj_ee, batch.T_world_ee, batch.trials, evaluator.config)
    grasp = close_gripper(
        evaluator.scene.grasp_tables, held.T_obj_ee, held.objects, w_max=limits.w_max_m, w_min=limits.w_min_m
    )
    for name, value in vars(grasp).items():
        assert torch.equal(torch.nan_to_num(value, 7.0), torch.nan_to_num(getattr(held.grasp, name), 7.0)), name
    assert torch.equal(held.squeezed_m, squeezed(grasp, limits))
    assert torch.equal(held.attached, attach(held.T_obj_ee, grasp.shift_m))
    assert int((grasp.shift_m.abs() > 1e-3).sum()) > 20  # else the line above compares nothing
    held = grasp.width_m <= limits.w_max_m
    material = held & (grasp.margin_m < grasp.cut_m)
    assert [5 < int(kind.sum()) < N - 5 for kind in (grasp.empty, held, material)] == [True] * 3


@pytest.mark.parametrize("simulated", [False, True])
def test_the_verdict_is_the_first_criterion_that_was_evaluated_and_failed(simulated):
    g = torch.Generator().manual_seed(0)
    criteria = []
    for _ in range(5):
        margin = 3e-4 * torch.randn(N, generator=g)
        evaluated = torch.rand(N, generator=g) < 0.8
        kind = torch.randint(1, 4, (N,), generator=g, dtype=torch.int8)
        number = torch.where(evaluated, margin, torch.nan)
        criteria.append(Criterion(number, evaluated, passed=(margin > 0) & evaluated, kind=kind))
    active, valid = (torch.rand(N, generator=g) < 0.8 for _ in range(2))
    lengths = {k: torch.rand(N, generator=g) for k in ("width_m", "opening_m", "shift_m")}
    held = SimpleNamespace(active=active, grasp=SimpleNamespace(**lengths))
    found = verdict(REGISTRY[:5], criteria, held, lengths["width_m"], valid if simulated else None)  # type: ignore[arg-type]
    for i in each(range(N)):
        judged = bool(valid[i]) or not simulated
        asked = [judged and bool(c.evaluated[i]) for c in criteria]
        fine = [judged and bool(c.passed[i]) for c in criteria]
        failed = [k + 1 for k in range(5) if asked[k] and not fine[k]]
        outcome = failed[0] if failed else int(Outcome.SUCCESS)
        outcome = int(Outcome.INVALID_SIM) if not judged else outcome
        outcome = int(Outcome.INVALID_INPUT) if not active[i] else outcome
        assert int(found["outcome"][i]) == outcome and bool(found["success"][i]) == (outcome == 0)
        kinds = [int(c.kind[i]) if a else 0 for a, c in zip(asked, criteria, strict=True)]
        assert found["margin_kind"][i].tolist() == kinds
        assert found["evaluated"][i].tolist() == asked and found["passed"][i].tolist() == fine
        near = any(a and abs(float(c.margin[i])) < 1e-4 for a, c in zip(asked, criteria, strict=True))
        assert bool(found["borderline"][i]) == near
        for k, c in enumerate(criteria):
            m = float(c.margin[i]) if judged else math.nan
            assert float(found["margin"][i, k]) == m or (math.isnan(m) and math.isnan(float(found["margin"][i, k])))
        for name, key in (("width_m", "width_m"), ("opening_m", "opening_m"), ("grasp_shift_m", "shift_m")):
            value = float(found[name][i])
            assert value == float(lengths[key][i]) if active[i] else math.isnan(value)
