import dataclasses

import numpy as np
import pytest
import torch
import warp as wp
from needs import needs
from rounds import each

from r2h_batch.base.launch import init_warp, launch
from r2h_batch.base.launch.threads import on_threads
from r2h_batch.config import HOME_Q
from r2h_batch.judge import ik_jacobian
from r2h_batch.judge.ik import solve_ik, ur_parameters
from r2h_batch.kernels.ik.step import nearest_turn
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.robot_file import load_robot

wp.set_module_options(OPTIONS)

PI = np.pi
HOME = np.array(HOME_Q)
UR = ur_parameters(load_robot(), HOME_Q)
N = 4_000


def random_targets(n, seed):
    return ee_pose(load_robot(), np.random.default_rng(seed).uniform(-PI, PI, (n, 6))).astype(np.float32)


def handover_targets(n, seed):
    rng = np.random.default_rng(seed)
    R = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    R[:, :, 0] *= np.linalg.det(R)[:, None]
    r, azimuth = rng.uniform(0.45, 0.8, n), rng.uniform(-PI, PI, n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(0.1, 0.7, n)], 1)
    return T.astype(np.float32)


def orthonormal(T):
    T = T.astype(np.float64)
    z = T[..., :3, 2] / np.linalg.norm(T[..., :3, 2], axis=-1, keepdims=True)
    y = T[..., :3, 1] - z * (T[..., :3, 1] * z).sum(-1, keepdims=True)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    T[..., :3, :3] = np.stack([np.cross(y, z), y, z], -1)
    return T


def closed_form_solutions(T_world_ee):
    """ur-analytic-ik's answer: a list of (up to 8) joint vectors per pose. Its base is world turned by half a turn."""
    import ur_analytic_ik  # here: not on every Python (needs.py), and most of this file does without

    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    T = turn @ orthonormal(T_world_ee) @ np.linalg.inv(load_robot().T_flange_ee)
    return [np.array(ur_analytic_ik.ur5e.inverse_kinematics(np.ascontiguousarray(t))).reshape(-1, 6) for t in T]


def errors(q, T_world_ee):
    """Position (m) and rotation (rad) errors by robot.py's forward kinematics, float64."""
    T, goal = ee_pose(load_robot(), q), orthonormal(T_world_ee)
    position = np.linalg.norm(T[..., :3, 3] - goal[..., :3, 3], axis=-1)
    D = T[..., :3, :3] @ np.swapaxes(goal[..., :3, :3], -1, -2)
    skew = np.stack([D[..., 2, 1] - D[..., 1, 2], D[..., 0, 2] - D[..., 2, 0], D[..., 1, 0] - D[..., 0, 1]], -1)
    return position, np.arctan2(np.linalg.norm(skew, axis=-1), np.trace(D, axis1=-2, axis2=-1) - 1)


def reaches(answer, T_world_ee, position_m=1e-5, rotation_rad=1e-5):
    """Asserts that every target has a solution, and that every solution reaches its target."""
    valid = answer.valid.numpy()
    position, rotation = errors(answer.q.numpy()[valid], T_world_ee[np.nonzero(valid)[0]])
    assert answer.reachable.all() and position.max() <= position_m and rotation.max() <= rotation_rad


def wrapped(x):
    return (x + PI) % (2 * PI) - PI


@pytest.fixture(scope="module")
def targets():
    return np.concatenate([random_targets(N, 1), handover_targets(N, 2)])


@pytest.fixture(scope="module")
def result(targets):
    return solve_ik(torch.from_numpy(targets))


@pytest.fixture(scope="module")
def oracle(targets):
    return closed_form_solutions(targets)


@needs("ur_analytic_ik")
def test_no_target_that_the_closed_form_solves_is_missed(targets, result, oracle):
    solvable = np.array([len(s) > 0 for s in oracle])
    assert solvable[:N].mean() > 0.999 and 0.6 < solvable[N:].mean() < 0.95
    assert result.reachable[:N].all()  # they come from joint angles
    missed = np.flatnonzero(solvable & ~result.reachable.numpy())
    assert missed.size == 0, f"{missed.size} missed, first {missed[:10]}"
    extra = np.flatnonzero(~solvable & result.reachable.numpy())  # residuals are checked elsewhere: the oracle's misses
    assert extra.size <= 2, f"{extra.size} solved without the closed form, first {extra[:10]}"


@needs("ur_analytic_ik")
def test_every_branch_of_the_closed_form_is_found(targets, result, oracle):
    q, valid = result.q.numpy().astype(np.float64), result.valid.numpy()
    total = lost = 0
    for i, solutions in enumerate(oracle):
        mine = q[i][valid[i]]
        for s in solutions:
            total += 1
            lost += not (np.abs(wrapped(mine - s)).max(1) < 1e-3).any()
    assert total > 40_000
    assert lost <= 4, f"{lost} of {total} branches lost"  # the oracle doubles or shifts branches next to singularities


def test_residuals_hold_for_an_independent_forward_kinematics(targets, result):
    valid = result.valid.numpy()
    row = np.nonzero(valid)[0]
    position, rotation = errors(result.q.numpy()[valid], targets[row])
    assert position.max() <= 1e-5 and rotation.max() <= 1e-5
    assert position.max() < 1e-6 and rotation.max() < 2e-6  # what float32 angles allow
    assert np.abs(position - result.position_error_m.numpy()[valid]).max() < 1e-9
    assert np.abs(rotation - result.rotation_error_rad.numpy()[valid]).max() < 1e-9
    assert np.isnan(result.q.numpy()[~valid]).all() and np.isinf(result.position_error_m.numpy()[~valid]).all()


def test_joints_stand_at_the_turn_nearest_home_within_limits(result):
    robot = load_robot()
    q = result.q.numpy()[result.valid.numpy()].astype(np.float64)
    assert (q >= robot.lower).all() and (q <= robot.upper).all()
    for turns in (-2, -1, 1, 2):
        other = q + turns * 2 * PI
        allowed = (other >= robot.lower) & (other <= robot.upper)
        assert (np.abs(other - HOME) >= np.abs(q - HOME) - 1e-6)[allowed].all()
    assert (np.abs(q[:, [0, 1, 3, 4, 5]] - HOME[[0, 1, 3, 4, 5]]) <= PI + 1e-6).all()


@wp.kernel(enable_backward=False)
def turned(
    angle: wp.array(dtype=wp.float64), home: wp.float64, lower: wp.float64, upper: wp.float64, q_out: wp.array(dtype=float)
):  # fmt: skip
    i = wp.tid()
    q_out[i] = nearest_turn(angle[i], home, lower, upper)


def test_an_angle_at_a_limit_is_within_it_after_rounding_to_float32():
    init_warp()
    most = 2 * np.pi
    assert float(np.float32(most)) > most
    for side in each((1.0, -1.0)):
        q = wp.zeros(2, dtype=float)
        inputs = {"angle": np.array([0.0, side * most]), "home": side * most, "lower": -most, "upper": most}
        launch(turned, 2, inputs=inputs, outputs={"q": q}, device="cpu")
        assert (np.abs(q.numpy().astype(np.float64)) <= most).all() and np.allclose(q.numpy(), side * most, atol=2e-6)


def test_branches_outside_a_range_of_less_than_a_turn_are_invalid(targets, result):
    """The same poses for a shoulder and a wrist that turn less: the branches within their ranges, and no other."""
    robot = load_robot()
    lower, upper = robot.lower.copy(), robot.upper.copy()
    lower[[1, 5]], upper[[1, 5]] = HOME[[1, 5]] - [0.9, 1.5], HOME[[1, 5]] + [0.7, 2.0]
    narrow = dataclasses.replace(robot, lower=lower, upper=upper, digest="narrow")
    some = torch.from_numpy(targets[:1000])
    found = solve_ik(some, robot=narrow)
    q, before = found.q.double().numpy(), result.q[:1000].double().numpy()
    inside = ((before >= lower) & (before <= upper)).all(2)  # turns nearest home: no other turn is within
    assert (found.valid.numpy() == inside).all() and (np.isnan(q) == ~inside[..., None]).all()
    assert 0.02 < inside.mean() < 0.5 * result.valid[:1000].float().mean()
    assert (q[inside] == before[inside]).all()
    jacobian = ik_jacobian.solve_ik(some[:100], robot=narrow)
    at = jacobian.valid.numpy()
    assert (
        at.any()
        and (jacobian.q.double().numpy()[at] >= lower).all()
        and (jacobian.q.double().numpy()[at] <= upper).all()
    )


def test_another_home_moves_the_turns_only(targets, result):
    home = HOME + np.array([0.0, 0, 0, 0, 0, 4.0])
    other = solve_ik(torch.from_numpy(targets[:1000]), home=tuple(home))
    assert (other.valid == result.valid[:1000]).all()
    difference = (other.q - result.q[:1000])[other.valid].numpy()
    assert np.abs(difference[:, :5]).max() == 0
    turns = difference[:, 5] / (2 * PI)
    assert np.abs(turns - np.round(turns)).max() < 1e-6 and (np.round(turns) == 1).any()


@needs("ur_analytic_ik")
def test_unreachable_targets_are_proven_so(targets, result, oracle):
    unreachable = (~result.reachable).numpy()
    assert unreachable[N:].mean() > 0.05
    assert (result.unreachable_proven.numpy() == unreachable).all()
    assert not any(len(oracle[i]) for i in np.flatnonzero(unreachable))


def test_targets_out_of_reach_or_inside_the_shoulder_cylinder_are_unreachable():
    R = np.diag([-1.0, 1.0, -1.0])
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, :3] = R
    T[:, :3, 3] = [[1.3, 0, 0.4], [0.05, 0.05, 0.4], [0.4, 0.1, 0.4]]  # wrist centre: far, 71 mm off the axis, ordinary
    answer = solve_ik(torch.from_numpy(T.astype(np.float32)))
    assert answer.unreachable_proven.tolist() == [True, True, False]
    assert answer.reachable.tolist() == [False, False, True]


def test_where_sin_q5_is_zero_points_of_the_line_are_given():
    rng = np.random.default_rng(5)
    q = rng.uniform(-PI, PI, (1000, 6))
    q[:, 2] = rng.uniform(0.3, 2.6, 1000)
    q[:, 4] = np.where(rng.random(1000) < 0.5, 0.0, PI)
    T = ee_pose(load_robot(), q).astype(np.float32)
    answer = solve_ik(torch.from_numpy(T))
    assert answer.singular.float().mean() > 0.9
    reaches(answer, T)
    nearly = q.copy()
    nearly[:, 4] += 10.0 ** rng.uniform(-5, -2, 1000)
    answer = solve_ik(torch.from_numpy(ee_pose(load_robot(), nearly).astype(np.float32)))
    assert answer.reachable.all()


def test_where_the_wrist_centre_is_over_the_shoulder_or_the_elbow_straight_a_solution_is_found():
    rng = np.random.default_rng(6)
    q = rng.uniform(-PI, PI, (4000, 6))
    psi = q[:, 2] + q[:, 3]
    x = UR.a2 + UR.a3 * np.cos(q[:, 2]) - UR.d5 * np.sin(psi)
    z = -UR.a3 * np.sin(q[:, 2]) - UR.d5 * np.cos(psi)
    q[:2000, 1] = np.arctan2(x, -z)[:2000]  # shoulder singularity: both shoulder sides fall together
    q[2000:, 2] = 0.0  # elbow singularity: both elbows fall together
    T = ee_pose(load_robot(), q).astype(np.float32)
    p5 = T[:2000, :2, 3] - UR.tool * T[:2000, :2, 2]
    assert np.abs(np.linalg.norm(p5, axis=1) - UR.d4).max() < 1e-6
    answer = solve_ik(torch.from_numpy(T))
    reaches(answer, T)


def test_where_arm_and_wrist_are_straight_together_rounding_the_target_does_not_lose_it():
    rng = np.random.default_rng(7)
    q = rng.uniform(-PI, PI, (4000, 6))
    q[:, 2] = 0.0
    q[:, 4] = 10.0 ** rng.uniform(-7, -2, 4000)  # a rounding of 6e-8 rad turns psi3 by up to 0.1 rad
    T = ee_pose(load_robot(), q).astype(np.float32)
    reaches(solve_ik(torch.from_numpy(T)), T, 2e-6, 3e-6)


@pytest.mark.parametrize("n", [0, 1, 2048])
def test_rows_do_not_depend_on_batch_order_or_threads(n, targets, result):
    order = np.random.default_rng(n).permutation(len(targets))[:n]
    for threads in (1, 3):
        with on_threads(threads):
            part = solve_ik(torch.from_numpy(targets[order]))
        for field in each(dataclasses.fields(part)):
            whole = getattr(result, field.name)[torch.from_numpy(order)]
            assert getattr(part, field.name).numpy().tobytes() == whole.numpy().tobytes(), field.name
