"""The nearest pose of a target that the arm cannot reach: what it misses is the distance, by a search."""

import numpy as np
import pytest
import torch
from oracle import out_of_reach
from scipy.spatial.transform import Rotation

from r2h_batch.base.launch import launch_trials
from r2h_batch.config import HOME_Q
from r2h_batch.judge.ik import solve_ik, ur_parameters
from r2h_batch.kernels.ik.nearest import nearest_posture
from r2h_batch.scene.robot import forward_kinematics
from r2h_batch.scene.robot_file import load_robot

COUNT = 160


@pytest.fixture(scope="module")
def missed() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unreachable targets (B, 4, 4), the postures that come nearest (B, 6), and by how much they miss (B,), m."""
    rng = np.random.default_rng(5)
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    R = Rotation.random(COUNT, random_state=5).as_matrix()
    # a third points the hand horizontally, or nearly: psi3 is free there, or turns by pi within a small angle
    flat = np.arange(COUNT) % 3 == 0
    R[flat, 2, 2] = rng.choice([0.0, 1e-5, -1e-3, 0.02], flat.sum())
    z = R[:, :, 2] / np.linalg.norm(R[:, :, 2], axis=1, keepdims=True)
    y = np.cross(z, R[:, :, 0])
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    T[:, :3, :3] = np.stack([np.cross(y, z), y, z], 2)
    T[::50, :3, :3] = np.diag([1.0, -1.0, -1.0])  # straight down: the hand's turn says nothing of joint 1
    T[:, :3, 3] = rng.uniform(-1, 1, (COUNT, 3)) * np.where(np.arange(COUNT) % 4 == 0, 0.3, 1.5)[:, None]
    target = torch.from_numpy(T).float()
    valid = solve_ik(target).valid
    q, residual = torch.empty((COUNT, 6)), torch.empty(COUNT)
    inputs = {"ur": ur_parameters(load_robot(), HOME_Q), "rotation_lever_m": 0.1, "T_world_ee": target}
    inputs |= {"active": torch.ones(COUNT, dtype=torch.bool), "branches": valid}
    outputs = {"q": q, "residual": residual}
    launch_trials(nearest_posture, COUNT, inputs=inputs, outputs=outputs, device="cpu", threads=1, chunk=256)
    rows = ~valid.any(1)
    assert rows.sum() > 100
    return target[rows].double().numpy(), q[rows].double().numpy(), residual[rows].double().numpy()


def test_the_margin_of_an_unreachable_target_is_its_distance_to_what_the_arm_reaches(missed) -> None:
    T, q, residual = missed
    robot = load_robot()
    ee = forward_kinematics(robot, q)[:, 6] @ robot.T_wrist3_flange @ robot.T_flange_ee
    assert np.abs(ee[:, :3, :3] - T[:, :3, :3]).max() < 1e-5
    assert np.abs(np.linalg.norm(ee[:, :3, 3] - T[:, :3, 3], axis=1) - residual).max() < 2e-6
    least = np.array([out_of_reach(t) for t in T])
    assert np.abs(residual - least).max() < 5e-5, np.abs(residual - least).max()
