"""The arm's model against mechanics written down again: mass matrix, weight, payloads, servos, limits."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from dynamics_twin import ROBOT, bodies, centers, mass_matrix, some_payload

from r2h_batch.config import HOME_Q
from r2h_batch.scene.dynamics import arm_model, load
from r2h_batch.scene.robot import forward_kinematics

G = 9.81
STEP_S = 0.002


def loaded(model, payload):
    """A copy of the arm's model that holds this payload."""
    model = copy.copy(model)
    load(model, payload, mujoco.MjData(model))
    return model


@pytest.mark.parametrize("seed", range(5))
def test_mass_matrix_and_weight_are_those_of_the_links_gripper_and_payload(seed):
    rng = np.random.default_rng(seed)
    payload = some_payload(rng)
    base = arm_model(ROBOT, step_s=STEP_S)
    model = loaded(base, payload)
    data = mujoco.MjData(model)
    q = rng.uniform(-3, 3, 6)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    M = np.zeros((6, 6))
    mujoco.mj_fullM(model, data, M)
    np.testing.assert_allclose(M, mass_matrix(q, payload), atol=2e-7)
    h, mass = 1e-5, np.array([b[2] for b in bodies(payload)])
    torque = [
        G * mass @ (centers(q + d, payload) - centers(q - d, payload))[:, 2] / (2 * h) for d in h * np.eye(6)
    ]  # fmt: skip
    np.testing.assert_allclose(data.qfrc_bias, torque, atol=1e-6)
    np.testing.assert_allclose(data.qfrc_gravcomp, torque, atol=1e-6)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-9 + 1e3 * np.abs(data.ctrl - q).max())


def hold(model: mujoco.MjModel, q: np.ndarray, seconds: float) -> np.ndarray:
    """Joint positions over time while the servos are told to stay at q."""
    data = mujoco.MjData(model)
    data.qpos[:] = data.ctrl[:] = q
    out = []
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        out.append(data.qpos.copy())
    return np.array(out)


def tcp(q: np.ndarray) -> np.ndarray:
    return (forward_kinematics(ROBOT, q)[..., 7, :, :] @ np.array([0, 0, 0.142, 1.0]))[..., :3]


def test_holding_still_for_two_seconds_drifts_less_than_a_tenth_of_a_millimetre():
    rng = np.random.default_rng(0)
    base = arm_model(ROBOT, step_s=STEP_S)
    for q in [np.array(HOME_Q), *rng.uniform(-2.5, 2.5, (5, 6))]:
        model = loaded(base, some_payload(rng, 1.0))
        drift = np.linalg.norm(tcp(hold(model, q, 2.0)) - tcp(q), axis=1)
        assert drift.max() < 1e-6


def test_an_unknown_payload_sinks_by_its_weight_over_the_servos_stiffness():
    base = arm_model(ROBOT, step_s=STEP_S, payload_known=False)
    payload = replace(some_payload(np.random.default_rng(0), 1.0), T_gripper_obj=np.eye(4))
    model = loaded(base, payload)
    q = np.array(HOME_Q)
    end = hold(model, q, 2.0)[-1]
    data = mujoco.MjData(model)
    data.qpos[:] = end
    mujoco.mj_forward(model, data)
    load = data.qfrc_gravcomp - data.qfrc_bias  # what nobody compensates
    np.testing.assert_allclose(end - q, load / -model.actuator_biasprm[:, 1], atol=1e-7)
    sag = tcp(q)[2] - tcp(end)[2]
    assert 5e-5 < sag < 1e-3


def test_torques_stay_within_the_joints_limits_weight_included():
    base = arm_model(ROBOT, step_s=STEP_S)
    assert base.jnt_actfrcrange[:, 1].tolist() == [150.0] * 3 + [28.0] * 3
    model = loaded(base, some_payload(np.random.default_rng(0), 1.0))
    data = mujoco.MjData(model)
    data.qpos[:] = HOME_Q
    data.ctrl[:] = np.array(HOME_Q) + 1.0  # far more than the servos may answer at once
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, model.jnt_actfrcrange[:, 1])
    assert (data.qfrc_gravcomp[1:3] != 0).all()
