"""Gradients of margins: against finite differences of the evaluator's own numbers, float64 twins, and in hostile batches."""

import copy
from dataclasses import replace
from functools import cache
from typing import Any

import change_twin
import numpy as np
import pytest
import torch
from oracle import Staged, hand_triangles, mujoco_scene
from planning_twins import jacobian_ik
from problems import assert_same, default_evaluator
from scipy.spatial.transform import Rotation
from seven import with_hulls
from slopes import candidates, gradients, measured_slopes

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.base import se3, twist
from r2h_batch.judge.attach import attach_object
from r2h_batch.judge.goal import judge_goals
from r2h_batch.scene.robot import Robot, ee_pose, load_robot
from r2h_batch.training import witnesses
from r2h_batch.training.witnesses import HELD_M, arm_at
from r2h_batch.types import CRITERIA, Outcome, PlanReason

STABILITY, PLAN, REACH, AFFORDANCE, SAFE = range(5)
SLOPE_ERROR = 0.03
"""float32 margins good to 2 um over steps of 0.1 mm; what bends less than the limit for kinks adds the rest."""


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


def check_against_finite_differences(
    evaluator: Evaluator, n: int, seed: int, least: dict[str, int]
) -> dict[str, float]:
    slopes = measured_slopes(evaluator, candidates(evaluator, n, seed=seed))
    shares = {}
    reason = slopes.scores.plan_reason
    for c, name in enumerate(CRITERIA):
        rows = slopes.smooth(c)
        if c == SAFE:  # of the nearest posture; not differentiated, as documented
            rows &= reason != int(PlanReason.IK_UNREACHABLE)
        if c in (PLAN, SAFE):  # a search's number jumps
            rows &= reason != int(PlanReason.IK_NOT_FOUND)
        margin = slopes.scores.margin[:, c]
        # the number stays at its bound there, the gradient still shows the way out
        out = slopes.plateau(c) & (margin < 0)
        if c == AFFORDANCE:  # fingers that hold the region: 0.5 mm deep, nearly, wherever they go along it
            out |= ((margin + 5e-4).abs() < HELD_M) & (slopes.measured[:, c].abs().amax(1) < 0.2)
        judged = rows & ~out
        right = slopes.error(c) < SLOPE_ERROR
        shares[name] = float((right & judged).sum() / judged.sum())
        counted = int(judged.sum()), int(slopes.scores.evaluated[:, c].sum()), int(out.sum())
        right_share = f"{shares[name]:.4f} of these right"
        print(f"{name}: {counted[0]} of {counted[1]} without a kink, {counted[2]} on a plateau; {right_share}")
        sloped = judged & (slopes.gradient[:, c].abs().amax(1) > 0.05)
        assert int(sloped.sum()) >= least[name], f"{name}: only {int(sloped.sum())} rows with a slope"
        assert not (slopes.plateau(c) & rows & (margin >= 0) & (slopes.gradient[:, c].abs().amax(1) > 0.05)).any()
    return shares


@pytest.mark.parametrize(
    ("robot", "n", "seed", "least", "share"),
    [
        ("ur5e_2f85", 100, 3, (30, 50, 50, 15, 15), 0.95),
        ("panda_hand", 100, 3, (45, 35, 65, 10, 15), 0.93),
        pytest.param("ur5e_2f85", 1500, 11, (450, 800, 800, 200, 200), 0.98, marks=pytest.mark.slow),
        pytest.param("panda_hand", 1500, 11, (450, 400, 800, 120, 150), 0.95, marks=pytest.mark.slow),
    ],
)
def test_gradients_are_the_slopes_of_the_evaluators_own_margins(robot, n, seed, least, share):
    shares = check_against_finite_differences(evaluator_of(robot), n, seed, dict(zip(CRITERIA, least, strict=True)))
    assert min(shares.values()) > share, shares


@pytest.mark.check
def test_values_are_bitwise_those_without_a_gradient(batch):
    evaluator = default_evaluator()
    plain = evaluator.score(batch.T_obj_ee, batch.T_world_ee, batch.trials, stages="pose")
    scores, _ = gradients(evaluator, batch)
    assert_same(scores, plain)
    assert not plain.margin.requires_grad and scores.margin.requires_grad and not scores.q_goal.requires_grad


def changes_in_float64(evaluator: Evaluator, rows: Any) -> tuple[change_twin.Changes, torch.Tensor, torch.Tensor]:
    """The twin from the evaluator's witnesses, and the poses (B, 4, 4) around which it is taken."""
    scores = evaluator.score(rows.T_obj_ee, rows.T_world_ee, rows.trials, stages="pose")
    held = attach_object(evaluator.scene, rows.T_obj_ee, rows.T_world_ee, rows.trials, evaluator.config)
    # no public way to the IK branches that a verdict was made from
    ik, branches = evaluator._branches(evaluator.config, held)
    goal = judge_goals(evaluator.scene, held.body_poses, held.T_world_ee, ik, branches, held.active)
    found = {name: getattr(scores, name) for name in ("margin", "evaluated", "witness_part")}
    w = witnesses.find(evaluator.scene, evaluator.config, found, held, goal)
    twin = change_twin.Changes(evaluator.scene, evaluator.config, found, held, goal, w)
    return twin, twin.held.T_obj_ee, twin.held.T_world_ee


@pytest.mark.parametrize("n", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_gradcheck_in_float64(n):
    evaluator = default_evaluator()
    changes, T_obj_ee, T_world_ee = changes_in_float64(evaluator, candidates(evaluator, n, seed=5))
    xi = torch.zeros(n, 12, dtype=torch.float64, requires_grad=True)

    def margins(xi: torch.Tensor) -> torch.Tensor:
        return changes(twist.retract(T_obj_ee, xi[:, :6]), twist.retract(T_world_ee, xi[:, 6:]))

    assert torch.autograd.gradcheck(margins, xi, eps=1e-7, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("robot", ["ur5e_2f85", "panda_hand", "without a closed form"])
def test_every_derivative_is_that_of_the_float64_twin(robot):
    evaluator = evaluator_of(robot)
    batch = candidates(evaluator, 200, seed=13)
    twin, *clean = changes_in_float64(evaluator, batch)
    exact = [T.clone().requires_grad_() for T in clean]
    moved = twin(*exact)
    poses = batch.T_obj_ee.clone().requires_grad_(), batch.T_world_ee.clone().requires_grad_()
    margin = evaluator.score(*poses, batch.trials, stages="pose").margin
    for c, name in enumerate(CRITERIA):
        wanted = torch.stack(torch.autograd.grad(moved[:, c].sum(), exact, retain_graph=True), 1)[:, :, :3]
        given = torch.ones(len(margin))
        found = torch.stack(torch.autograd.grad(margin[:, c], poses, given, retain_graph=True), 1)[:, :, :3]
        size = wanted.abs().amax((1, 2, 3))
        wrong = (found - wanted).abs().amax((1, 2, 3)) > 2e-3 * (0.1 + size)
        assert int((size > 0.01).sum()) >= 10 and not wrong.any(), f"{name}: rows {torch.nonzero(wrong).flatten()}"


def slopes_of(f: Any, T: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Central differences of f along the twists of T, float64."""
    out = np.zeros(6)
    for j in range(6):
        xi = torch.zeros(6, dtype=torch.float64)
        xi[j] = step
        ahead, behind = (twist.retract(torch.from_numpy(T), s * xi).numpy() for s in (1, -1))
        out[j] = (f(ahead) - f(behind)) / (2 * step)
    return out


def attachment(scores: Any, rows: Any, i: int) -> np.ndarray:
    T = rows.T_obj_ee[i].double().numpy().copy()
    T[:3, 3] += T[:3, 1] * float(scores.grasp_shift_m[i])
    return T


def stays(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Which joints (J,) stay when the ee moves: those at a limit, if the others can do it."""
    at_limit = (q < robot.lower + 1e-5) | (q > robot.upper - 1e-5)
    return at_limit if at_limit.sum() <= len(q) - 6 else np.zeros_like(at_limit)


def check_postures(evaluator: Evaluator, batch: Any, criterion: int, count: int) -> tuple[int, int]:
    """How many of the first separated rows have the slopes of MuJoCo C (Plan) or the exact mesh (Safe) in float64.

    The posture follows the ee by the least motion of the joints. Rows that the arm decides come first.
    """
    scene = evaluator.scene
    scores, slopes = gradients(evaluator, batch)
    inside = (scores.margin[:, criterion] > 1e-4) & (scores.margin[:, criterion] < 0.045)
    wanted = inside & (scores.plan_reason == int(PlanReason.OK))
    by_arm = slopes[:, criterion, 6:].any(1) & (scores.witness_part[:, int(criterion == SAFE)] < scene.world.n_arm)
    order = torch.argsort(by_arm.logical_not().int(), stable=True)
    rows = order[wanted[order]][:count].tolist()
    assert len(rows) == count
    right, at_limit = 0, 0
    for i in rows:
        trial, held = batch.trials, attachment(scores, batch, i)
        staged = Staged(
            int(trial.object_index[i]), int(trial.hand_index[i]), held, trial.T_world_hand[i].double().numpy(),
            float(scores.opening_m[i]),
        )  # fmt: skip
        twin, triangles = mujoco_scene(scene, staged), hand_triangles(scene, staged)
        q0 = scores.q_goal[i].double().numpy()

        def margin(T_world_ee: np.ndarray, twin=twin, triangles=triangles, q0=q0) -> float:
            q = jacobian_ik(scene.robot, T_world_ee, q0, within=1e-9, held=stays(scene.robot, q0))
            if q is None:  # a joint meets its limit within the step
                return np.nan
            return twin.least(q)[0] if criterion == PLAN else twin.safe_at(triangles, q)

        T_world_ee = batch.T_world_ee[i].double().numpy()
        assert abs(margin(T_world_ee) - float(scores.margin[i, criterion].detach())) < 2e-5
        expected = slopes_of(margin, T_world_ee)
        right += bool(np.abs(expected - slopes[i, criterion, 6:].detach().numpy()).max() < 0.01)
        at_limit += bool(np.isnan(expected).any())
    assert at_limit <= len(rows) // 10
    return right, len(rows) - at_limit


@pytest.mark.parametrize(
    ("robot", "n", "seed", "counts"),
    [
        ("panda_hand", 96, 3, (6, 4)),
        ("without a closed form", 96, 3, (5, 3)),
        pytest.param("ur5e_2f85", 600, 9, (100, 25), marks=pytest.mark.slow),
        pytest.param("panda_hand", 600, 9, (100, 25), marks=pytest.mark.slow),
    ],
)
def test_plan_and_safe_move_as_in_float64_twins(robot, n, seed, counts):
    evaluator = evaluator_of(robot)
    many = candidates(evaluator, n, seed=seed)
    for criterion, count in zip((PLAN, SAFE), counts, strict=True):
        right, of = check_postures(evaluator, many, criterion, count)
        assert right >= of - max(1, of // 33), f"{CRITERIA[criterion]}: {right} of {of}"


def test_a_redundant_arm_follows_by_the_least_motion_and_joints_at_a_limit_stay():
    robot, scene = load_robot("panda_hand"), evaluator_of("panda_hand").scene
    q = np.random.default_rng(1).uniform(robot.lower, robot.upper, (300, 7))
    rows = np.arange(300)
    q[rows[::3], rows[::3] % 7] = robot.upper[rows[::3] % 7]
    q[::6, 2] = robot.lower[2]
    q = q.astype(np.float32).astype(np.float64)
    held = np.array([stays(robot, x) for x in q])
    assert 20 < held.any(1).sum() < 100
    rates = arm_at(scene, torch.from_numpy(q).float())["inverse"].double().numpy()
    checked = 0
    for x, hold, found in zip(q, held, rates, strict=True):
        ahead, behind = (np.stack([ee_pose(robot, x + h) for h in s * np.eye(7)]) for s in (1e-6, -1e-6))
        turns = Rotation.from_matrix(ahead[:, :3, :3] @ behind[:, :3, :3].swapaxes(1, 2)).as_rotvec()
        J = np.concatenate([ahead[:, :3, 3] - behind[:, :3, 3], turns], 1).T / 2e-6
        J = np.where(hold, 0.0, J)
        if np.linalg.svd(J)[1].min() > 0.05:  # the rates are damped by 1e-3
            checked += 1
            assert np.abs(found - np.linalg.pinv(J)).max() < 1e-3 * np.abs(found).max()
    assert checked > 150


def test_a_target_that_was_not_found_comes_nearer_along_the_gradient():
    evaluator = evaluator_of("panda_hand")
    batch = candidates(evaluator, 200, seed=13)
    scores, slopes = gradients(evaluator, batch)
    reasons = int(PlanReason.IK_NOT_FOUND), int(PlanReason.IK_UNREACHABLE)
    missed = (scores.plan_reason == reasons[0]) | (scores.plan_reason == reasons[1])
    rows = torch.nonzero(missed & (scores.margin[:, PLAN] < -0.02)).flatten()
    uphill, margin = slopes[rows, PLAN, 6:], scores.margin[rows, PLAN].detach()
    assert len(rows) >= 12 and (uphill[:, :3].norm(dim=1) - 1).abs().max() < 1e-4
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
    scores, slopes = gradients(evaluator, batch)
    missed = [int(PlanReason.IK_UNREACHABLE), int(PlanReason.IK_NOT_FOUND)]
    reached = ~torch.isin(scores.plan_reason, torch.tensor(missed, dtype=torch.int8))
    met = (scores.margin[:, SAFE] < -1e-3) & reached
    rows = torch.nonzero(met).flatten()
    uphill = slopes[rows, SAFE, 6:]
    length = uphill[:, :3].norm(dim=1)
    assert len(rows) >= 10 and (length > 0.1).float().mean() > 0.9
    xi = torch.zeros(len(rows), 6)
    xi[:, :3] = 0.06 * uphill[:, :3] / length[:, None].clamp(min=1e-3)
    T_world_ee = se3.orthonormalise(twist.retract(batch.T_world_ee[rows], xi)).contiguous()
    after = evaluator.score(batch.T_obj_ee[rows], T_world_ee, batch.trials[rows], stages="pose")
    kept = after.plan_reason != int(PlanReason.IK_UNREACHABLE)
    rises = after.margin[:, SAFE] > scores.margin[rows, SAFE].detach()
    assert (rises & kept).sum() > 0.6 * kept.sum()


@pytest.mark.gpu
def test_gradients_on_cuda_are_those_on_the_cpu(batch):
    device = torch.device("cuda")
    _, expected = gradients(default_evaluator(), batch)
    moved = type(batch)(batch.trials.to(device), batch.T_obj_ee.to(device), batch.T_world_ee.to(device))
    _, found = gradients(Evaluator(load_benchmark("r2h-v1"), device=device), moved)
    close = (found.cpu() - expected).abs().amax((1, 2)) < 1e-2
    assert close.float().mean() > 0.97
