"""Joints with speed limits of their own: the time law against each joint alone, and a Panda arm in MuJoCo C."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.judge.motion.time_law import path_time, time_at, time_path
from r2h_batch.methods.oracle import predict
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.robot_file import ROBOTS, load_robot

PANDA = load_robot("panda_hand")
LAW = ExecConfig(sim="none", max_velocity_rad_s=float(PANDA.max_velocity.min()))
V = 0.1 * PANDA.max_velocity
A = 0.1 * LAW.max_acceleration_rad_s2 * PANDA.max_velocity / PANDA.max_velocity.min()


def alone(d: np.ndarray) -> np.ndarray:
    """How long each joint takes by itself over d (..., 7) rad, stopping at both ends."""
    d = np.abs(d)
    return np.where(d >= V**2 / A, d / V + V / A, 2 * np.sqrt(d / A))


def paths(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(4)
    q = np.cumsum(rng.normal(0, 1, (n, 5, 7)) * rng.choice([0.01, 0.3, 1.0], (n, 5, 1)), axis=1)
    return torch.from_numpy(q).float(), torch.full((n,), 5, dtype=torch.int32)


@pytest.mark.check
def test_a_segment_takes_as_long_as_its_slowest_joint_alone():
    path, length = paths(200)
    motion = time_path(path, length, LAW, PANDA.joint_weight)
    each = alone(np.diff(path.double().numpy(), axis=1))
    np.testing.assert_allclose(np.diff(motion.time_s.double().numpy(), axis=1), each.max(2), atol=2e-5)
    np.testing.assert_allclose(path_time(path, length, LAW, PANDA.joint_weight), each.max(2).sum(1), rtol=1e-12)
    assert {3, 4, 5, 6} & set(each.argmax(2).ravel())
    assert (np.abs(np.diff(path, axis=1)).argmax(2) != each.argmax(2)).any()
    half = time_at(path, length, motion, torch.full((200,), 2, dtype=torch.int32), torch.full((200,), 0.5), LAW)
    np.testing.assert_allclose(half, (motion.time_s[:, 2] + motion.time_s[:, 3]) / 2, atol=1e-5)
    assert (load_robot().joint_weight == 1.0).all()


def panda_with_2f85() -> Robot:
    ur = load_robot()
    names = [
        "open_gap_m",
        "T_flange_ee",
        "T_flange_gripper",
        "gripper_part",
        "gripper_motion",
        "gripper_side",
        "linkage",
    ]
    last = np.full(len(ur.gripper.link), 8, np.int32)
    given = {name: getattr(ur, name) for name in names} | {"gripper": replace(ur.gripper, link=last)}
    return replace(PANDA, name="panda_2f85", digest="panda, 2f85", **given)


def test_mujoco_keeps_a_panda_on_its_planned_motion():
    """Masses, servos and torque limits of the file: the tracking error is a fraction of a milliradian."""
    robot = panda_with_2f85()
    benchmark = load_benchmark("r2h-v1").on(robot)
    config = EvalConfig(execute=ExecConfig(sim="mujoco", model="arm"))
    evaluator = Evaluator(benchmark, config)
    trials = benchmark.trials(2)
    answer = predict(trials, evaluator.scene, seed=0, evaluator=evaluator)
    scores = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials, keep_motion=True)
    assert scores.success.all()
    planned = Evaluator(benchmark, replace(config, execute=ExecConfig(sim="none")))
    plan = planned.score(answer.T_obj_ee, answer.T_world_ee, trials)
    for k in range(len(trials)):
        n = int(plan.path_len[k])
        times, path = plan.path_time_s[k, :n].double().numpy(), plan.path[k, :n].double().numpy()
        assert abs(float(scores.t_exec_s[k]) - times[-1]) < 0.2
        q = scores.motion[k, : int(scores.motion_len[k])].double().numpy()
        at = np.arange(len(q)) * config.execute.step_s * config.execute.record_steps
        assert np.abs(q - timed(path, times, at)).max() < 3e-4


@pytest.mark.parametrize("model", ["arm", pytest.param("scene", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "ur10e_2f85")) for name in ROBOTS[1:]]
)
def test_engines_agree_on_every_built_in_robot(name, model):
    """As the UR5e's (test_motion.py): MuJoCo C and MuJoCo-Warp step by step, and the plan in verdicts."""
    benchmark, found = load_benchmark("r2h-v1").on(load_robot(name)), {}
    trials = benchmark.trials(2)
    answer = None
    for sim in ("none", "mujoco", "mjwarp"):
        law = ExecConfig(sim=sim, model=model, scale=0.5, settle_s=0.1, dwell_s=0.1)
        evaluator = Evaluator(benchmark, EvalConfig(execute=law))
        answer = answer or predict(trials, evaluator.scene, seed=0, evaluator=evaluator)
        found[sim] = evaluator.score(answer.T_obj_ee, answer.T_world_ee, trials, keep_motion=True)
    plan, c, w = found.values()
    assert plan.success.all() and c.success.all() and w.success.all()
    assert torch.equal(c.motion_len, w.motion_len) and (c.motion_len > 100).all()
    assert float((c.motion - w.motion).abs().max()) < 5e-6
    np.testing.assert_allclose(w.t_exec_s, c.t_exec_s, atol=0.0081)
    np.testing.assert_allclose(w.margin, c.margin, atol=5e-5)
    np.testing.assert_allclose(c.t_exec_s, plan.t_exec_s, atol=0.15)
    np.testing.assert_allclose(c.margin, plan.margin, atol=1e-3)


def timed(path: np.ndarray, times: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Postures at times, s: every joint runs the trapezoid of the joint that takes longest, in float64."""
    k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    d = np.diff(path, axis=0)
    pace = alone(d).argmax(1)
    whole, v, a = np.abs(d[np.arange(len(d)), pace]), V[pace], A[pace]
    total = alone(d).max(1)
    ramp = np.minimum(v / a, total / 2)[k]
    t = np.clip(at - times[k], 0, total[k])
    near = np.minimum(t, total[k] - t)
    s = np.where(near < ramp, a[k] * near**2 / 2, a[k] * ramp**2 / 2 + a[k] * ramp * (near - ramp))
    share = np.where(t <= total[k] / 2, s, whole[k] - s) / np.maximum(whole[k], 1e-12)
    return path[k] + share[:, None] * d[k]
