"""Gradients of margins: the evaluator's own differences, on every benchmark, what they lead to, and in hostile batches."""

import copy
from dataclasses import replace
from functools import cache

import pytest
import torch
from problems import Batch, assert_same, default_evaluator, kinematic_evaluator
from rounds import each
from scipy.spatial.transform import Rotation
from seven import with_hulls
from slopes import STEPS, candidates, gradients, measured_slopes

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base import se3, twist
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.methods import random
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.types import Outcome, PlanReason

STABILITY, PLAN, REACH, AFFORDANCE, SAFE = range(5)
AS_PLANNED = EvalConfig(execute=ExecConfig(sim="none"))


@cache
def evaluator_of(robot: str) -> Evaluator:
    """A built-in robot, or an arm of six joints with hulls that has no closed form."""
    if robot == "ur5e_2f85":
        return default_evaluator()
    own = load_robot("panda_hand" if robot == "panda_hand" else "ur5e_2f85")
    if robot != "panda_hand":  # a wrist whose axes are not a UR's
        T = own.T_parent_joint.copy()
        T[3, :3, :3] = Rotation.from_euler("x", 0.05).as_matrix() @ T[3, :3, :3]
        own = replace(with_hulls(own), T_parent_joint=T)
        assert own.family == "numerical"
    return Evaluator(load_benchmark("r2h-v1").on(own))


@pytest.fixture(scope="module")
def batch():
    return candidates(default_evaluator(), 96)


@pytest.mark.check
def test_values_are_bitwise_those_without_a_gradient(batch):
    evaluator = default_evaluator()
    plain = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")
    scores, _ = gradients(evaluator, batch)
    assert_same(scores, plain)
    assert not plain.margin.requires_grad and scores.margin.requires_grad and not scores.q_goal.requires_grad


@cache
def asked(name: str) -> tuple[Evaluator, Batch]:
    """A benchmark's evaluator and candidates; of r2h-v3 only Pick is asked beside the five criteria."""
    benchmark = load_benchmark(name)
    if benchmark.asks:
        benchmark = replace(benchmark, asks=("pick",))
    evaluator = Evaluator(benchmark, AS_PLANNED)
    trials = benchmark.trials(32)
    poses = random.predict(trials, evaluator.scene, seed=0)
    return evaluator, Batch(trials, poses.T_obj_ee, poses.T_world_ee)


@pytest.mark.parametrize(
    "name",
    ["r2h-v1", "r2h-v3", *(pytest.param(n, marks=pytest.mark.whole(part="judge")) for n in ("r2h-v2", "panda_hand"))],
)
def test_a_gradient_is_the_evaluators_own_difference_of_every_criterion(name):
    evaluator, batch = (evaluator_of(name), None) if name == "panda_hand" else asked(name)
    batch = batch or candidates(evaluator, 48)
    scores, slopes = gradients(evaluator, batch)
    expected = measured_slopes(evaluator, batch)
    for c, criterion in each(enumerate(scores.criteria)):
        rows = scores.evaluated[:, c]
        error = (slopes[rows, c].double() - expected[rows, c]).abs().amax(1)
        assert (error < 2e-3).all(), f"{criterion}: {error.max()}"
        assert (expected[rows, c].abs().amax(1) > 0.05).sum() >= 5, criterion
        assert not slopes[~rows, c].any()


@pytest.mark.parametrize("name", ["r2h-v2", "r2h-v3"])
@pytest.mark.parametrize(("rows", "entries"), [(6, 60), pytest.param(48, 200, marks=pytest.mark.slow)])
def test_random_entries_agree_with_differences_over_a_tenth_of_the_way(name, rows, entries):
    """Of all that the benchmark asks for. Where a margin runs straight through a difference no nearest body changes, and its
    slope at the pose is the same."""
    evaluator = kinematic_evaluator(name)
    trials = evaluator.benchmark.trials_with_ids(torch.arange(rows))
    poses = random.predict(trials, evaluator.scene, seed=0)
    batch = Batch(trials, poses.T_obj_ee, poses.T_world_ee)
    scores, slopes = gradients(evaluator, batch)
    cells = torch.nonzero((scores.evaluated & scores.margin.isfinite())[:, :, None].expand(-1, -1, 12))
    cells = cells[torch.randperm(len(cells), generator=torch.Generator().manual_seed(1))[:entries]]
    row, criterion, way = cells.T
    half, lever = STEPS[way].double(), torch.tensor([1.0, 0.1]).double()[way % 6 // 3]  # a radian counts 10 cm

    def margin(share: float) -> torch.Tensor:
        """At a share of the gradient's own step, forward along each entry's twist."""
        xi = torch.zeros(len(cells), 12)
        xi[torch.arange(len(cells)), way] = share * STEPS[way]
        moved = (
            twist.retract(T[row], part).contiguous()
            for T, part in zip((batch.T_obj_ee, batch.T_world_ee), xi.split(6, 1), strict=True)
        )
        found = evaluator.score(*moved, trials[row], stages="pose").margin
        return found[torch.arange(len(cells)), criterion].double()

    back, here, ahead = (margin(share) for share in (-1.0, 0.0, 1.0))
    straight = ((ahead - here) - (here - back)).abs() < 0.05 * lever * half
    near = (margin(0.1) - margin(-0.1)) / (0.2 * half)
    agrees = (slopes[row, criterion, way] - near).abs() <= 0.03 * lever + 0.05 * near.abs()
    assert len(cells) == entries and (near.abs() > 0.1 * lever).double().mean() > 0.2
    assert straight.double().mean() > 0.7 and agrees.double().mean() > 0.85
    assert agrees[straight].double().mean() > 0.97  # depths of overlaps are bounds, to 1 %


def test_one_pose_alone_has_the_gradient_that_it_has_beside_the_other(batch):
    evaluator, few, found = default_evaluator(), batch.rows(slice(0, 12)), []
    for asks in ((True, True), (True, False), (False, True)):
        poses = [T.clone().requires_grad_(a) for T, a in zip((few.T_obj_ee, few.T_world_ee), asks, strict=True)]
        scores = evaluator.score(*poses, few.trials, stages="pose")
        scores.margin[scores.evaluated].sum().backward()
        found.append([T.grad for T in poses])
    (grasp, handover), (alone, none), (nothing, other) = found
    assert none is nothing is None and grasp.any() and handover.any()
    assert torch.equal(grasp, alone) and torch.equal(handover, other)


def test_the_person_is_part_of_a_gradient():
    evaluator, batch = asked("r2h-v2")
    of_hand = Evaluator(replace(evaluator.benchmark, receiver="hand", head_clearance_m=0.0), AS_PLANNED)
    scores, slopes = gradients(evaluator, batch)
    assert evaluator.benchmark.receiver == "body"
    trials = of_hand.benchmark.trials_with_ids(batch.trials.trial_id)
    bare, other = gradients(of_hand, replace(batch, trials=trials))
    decided = scores.margin[:, SAFE] < bare.margin[:, SAFE] - 1e-3
    assert decided.sum() >= 3 and (slopes[decided, SAFE] != other[decided, SAFE]).any(1).all()


@pytest.mark.parametrize("name", [pytest.param("r2h-v1", marks=pytest.mark.slow), "r2h-v2"])
def test_ascent_leads_failing_candidates_to_poses_that_pass(name):
    evaluator, batch = asked(name)
    batch = batch.rows(slice(0, None, 3))
    weight = torch.tensor([1.0] * 3 + [10.0] * 3)
    poses = torch.stack([batch.T_obj_ee, batch.T_world_ee], 1)
    moved = torch.zeros(len(batch), 2, 6, requires_grad=True)
    adam = torch.optim.Adam([moved], lr=0.004)
    passes = []
    for _ in range(60):
        T = twist.retract(poses, weight * moved)
        scores = evaluator.score(T[:, 0], T[:, 1], batch.trials, stages="pose")
        passes.append(int(scores.success.sum()))
        adam.zero_grad()
        (-scores.soft(temperature_m=0.005, log=True).sum()).backward()
        adam.step()
    failing = len(batch) - passes[0]
    assert failing > 10 and passes[-1] - passes[0] > 0.5 * failing, passes


def test_a_step_in_place_before_the_way_back_changes_no_gradient(batch):
    evaluator, few = default_evaluator(), batch.rows(slice(0, 8))
    found = []
    for step in (False, True):
        T = few.T_world_ee.clone().requires_grad_()
        scores = evaluator.score(few.T_obj_ee, T, few.trials, stages="pose")
        if step:
            with torch.no_grad():
                T.add_(0.01)
        scores.margin[scores.evaluated].sum().backward()
        found.append(T.grad)
    assert found[0].any() and torch.equal(*found)


def test_a_target_that_was_not_found_comes_nearer_along_the_gradient():
    evaluator = evaluator_of("panda_hand")
    batch = candidates(evaluator, 200, seed=13)
    scores = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")
    reasons = int(PlanReason.IK_NOT_FOUND), int(PlanReason.IK_UNREACHABLE)
    missed = (scores.plan_reason == reasons[0]) | (scores.plan_reason == reasons[1])
    rows = torch.nonzero(missed & (scores.margin[:, PLAN] < -0.02)).flatten()
    _, slopes = gradients(evaluator, batch.rows(rows))
    uphill, margin = slopes[:, PLAN, 6:], scores.margin[rows, PLAN]
    assert len(rows) >= 12
    xi = -0.2 * margin[:, None] * uphill * torch.tensor([1.0] * 3 + [100.0] * 3)  # 10 cm like a radian
    T_world_ee = se3.orthonormalise(twist.retract(batch.T_world_ee[rows], xi)).contiguous()
    after = evaluator.score(batch.T_obj_ee[rows], T_world_ee, batch.trials[rows], stages="pose")
    share = float((after.margin[:, PLAN] > margin).float().mean())
    assert share > 0.9, share


def test_rows_that_are_no_poses_have_no_gradient_and_leave_the_others_alone(batch):
    evaluator = default_evaluator()
    T_obj_ee, T_world_ee = batch.T_obj_ee.clone(), batch.T_world_ee.clone()
    T_obj_ee[3] = torch.nan
    T_world_ee[5, 0, 3] = torch.inf
    T_world_ee[7, :3, :3] *= 2.0
    T_obj_ee[9] = 0.0
    bad = torch.tensor([3, 5, 7, 9])
    poses = T_obj_ee.requires_grad_(), T_world_ee.requires_grad_()
    scores = evaluator.score(*poses, batch.trials, stages="pose")
    assert (scores.outcome[bad] == int(Outcome.INVALID_INPUT)).all()
    clean = batch.T_obj_ee.clone().requires_grad_(), batch.T_world_ee.clone().requires_grad_()
    expected = evaluator.score(*clean, batch.trials, stages="pose")
    for log in (False, True):
        found = torch.autograd.grad(scores.soft(temperature_m=0.005, log=log).sum(), poses, retain_graph=True)
        wanted = torch.autograd.grad(expected.soft(temperature_m=0.005, log=log).sum(), clean, retain_graph=True)
        for a, b in zip(found, wanted, strict=True):
            good = torch.ones(len(a), dtype=torch.bool)
            good[bad] = False
            assert torch.isfinite(a).all() and not a[bad].any()
            assert torch.equal(a[good], b[good]) and a[good].any()


def test_gradients_do_not_depend_on_batch_order_or_threads(batch):
    evaluator = default_evaluator()
    _, whole = gradients(evaluator, batch.rows(slice(0, 33)))
    _, one = gradients(evaluator, batch.rows(slice(11, 12)))
    order = torch.randperm(33, generator=torch.Generator().manual_seed(0))
    _, turned = gradients(evaluator, batch.rows(order))
    assert torch.equal(whole[11:12], one) and torch.equal(whole[order], turned)
    threads, evaluator.threads = evaluator.threads, 1
    try:
        _, alone = gradients(evaluator, batch.rows(slice(0, 33)))
    finally:
        evaluator.threads = threads
    assert torch.equal(whole, alone)
    chunked = copy.copy(evaluator)
    chunked.config = replace(evaluator.config, chunk=7)
    assert torch.equal(gradients(chunked, batch.rows(slice(0, 33)))[1], whole)
    assert gradients(evaluator, batch.rows(slice(0, 0)))[1].shape == (0, 5, 12)


@pytest.mark.parametrize("robot", ["ur5e_2f85", "panda_hand"])
def test_an_overlap_of_hand_and_robot_is_left_along_the_gradient(robot):
    evaluator = evaluator_of(robot)
    batch = candidates(evaluator, 300, seed=13)
    scores = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")
    missed = [int(PlanReason.IK_UNREACHABLE), int(PlanReason.IK_NOT_FOUND)]
    reached = ~torch.isin(scores.plan_reason, torch.tensor(missed, dtype=torch.int8))
    met = (scores.margin[:, SAFE] < -1e-3) & reached
    rows = torch.nonzero(met).flatten()
    _, slopes = gradients(evaluator, batch.rows(rows))
    uphill = slopes[:, SAFE, 6:]
    length = uphill[:, :3].norm(dim=1)
    assert (
        len(rows) >= 10 and (length > 0.1).float().mean() > 0.8
    )  # in the core of a part nothing changes within a step
    xi = torch.zeros(len(rows), 6)
    xi[:, :3] = 0.06 * uphill[:, :3] / length[:, None].clamp(min=1e-3)
    T_world_ee = se3.orthonormalise(twist.retract(batch.T_world_ee[rows], xi)).contiguous()
    after = evaluator.score(batch.T_obj_ee[rows], T_world_ee, batch.trials[rows], stages="pose")
    kept = after.plan_reason != int(PlanReason.IK_UNREACHABLE)
    rises = after.margin[:, SAFE] > scores.margin[rows, SAFE]
    assert (rises & kept).sum() > 0.6 * kept.sum()


@pytest.mark.gpu
def test_gradients_on_cuda_are_those_on_the_cpu(batch):
    device = torch.device("cuda")
    _, expected = gradients(default_evaluator(), batch)
    moved = type(batch)(batch.trials.to(device), batch.T_obj_ee.to(device), batch.T_world_ee.to(device))
    _, found = gradients(Evaluator(load_benchmark("r2h-v1"), device=device), moved)
    close = (found.cpu() - expected).abs().amax((1, 2)) < 1e-2
    assert close.float().mean() > 0.97
