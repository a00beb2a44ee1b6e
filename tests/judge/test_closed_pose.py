"""Where closing puts objects: flat against the pads and in their middle, as the slow closing from the widest gap does."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from staging import frame

from r2h_batch.base.launch import init_warp
from r2h_batch.judge.closed_pose import closed_poses
from r2h_batch.judge.grasp_physics import close_in_physics
from r2h_batch.scene.objects import build_object
from r2h_batch.scene.robot import load_robot

X, Y, Z = np.eye(3)
ROBOT = load_robot()


@pytest.fixture(scope="module")
def box():
    init_warp()
    return build_object(trimesh.creation.box((0.06, 0.03, 0.06)).subdivide(), "box_30", pieces=True)


def gripped(T_obj_ee):
    """T_gripper_obj of grasps."""
    return np.linalg.inv(T_obj_ee @ np.linalg.inv(ROBOT.T_flange_ee) @ ROBOT.T_flange_gripper)


@pytest.fixture(scope="module")
def grasps():
    """In the middle, 2 mm off it, and turned by 6 degrees about the approach."""
    turn = Rotation.from_euler("z", 6, degrees=True).as_matrix()
    T = np.stack([frame(Z, Y, np.zeros(3)), frame(Z, Y, 0.002 * Y), frame(Z, Y, np.zeros(3))])
    T[2, :3, :3] = T[2, :3, :3] @ turn
    return T


def closed(box, T, opening_m=0.03):
    n = len(T)
    return closed_poses(ROBOT, (box,), np.zeros(n, np.int64), T, np.full(n, opening_m))


def angle_deg(T, other):
    return np.degrees(Rotation.from_matrix(T[:, :3, :3].swapaxes(1, 2) @ other[:, :3, :3]).magnitude())


@pytest.mark.check
def test_a_box_comes_to_the_middle_and_lies_flat_against_the_pads(box, grasps):
    before = gripped(grasps)
    after = closed(box, before)
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    assert moved[0] < 5e-4 and moved[1] == pytest.approx(0.002, abs=5e-4)
    slow = close_in_physics((box,), np.zeros(2, np.int32), grasps[:2], ROBOT).moved_m
    assert moved[:2] == pytest.approx(slow, abs=5e-4)
    flat = np.repeat(after[:1], 3, axis=0)
    assert angle_deg(before, flat)[2] == pytest.approx(6.0, abs=0.3) and (angle_deg(after, flat) < 0.7).all()


def test_what_has_closed_stays_where_it_is_and_a_row_is_alone_what_it_is_among_others(box, grasps):
    after = closed(box, gripped(grasps))
    assert np.array_equal(closed(box, gripped(grasps)[[2]])[0], after[2])
    assert np.array_equal(closed(box, gripped(grasps)[[2, 0, 1]]), after[[2, 0, 1]])
    again = closed(box, after)
    assert (np.linalg.norm(again[:, :3, 3] - after[:, :3, 3], axis=1) < 4e-4).all()


def test_an_object_that_is_not_between_the_pads_stays(box, grasps):
    far = gripped(grasps[:1])
    far[0, :3, 3] += 0.5
    assert np.array_equal(closed(box, far), far)
