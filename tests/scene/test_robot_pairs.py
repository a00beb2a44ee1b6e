"""Which links of the robot can touch which: the checked pairs against MuJoCo, scanned and at random."""

from dataclasses import replace
from itertools import pairwise, product

import mujoco
import numpy as np
import pytest
from rounds import each

from r2h_batch.data import robot_pairs as self_pairs
from r2h_batch.scene.robot import Primitives, Robot, ShapeKind
from r2h_batch.scene.robot_file import load_robot

P = np.pi


def test_checked_pairs_are_those_that_touch_sometimes():
    robot = load_robot()
    checked = {(robot.links[a], robot.links[b]) for a, b in robot.self_pairs}
    rates = self_pairs.contact_rates(robot, 4_000, seed=5)
    assert {pair for pair, (rate, _) in rates.items() if 0.0 < rate < 1.0} == checked
    neighbours = set(pairwise(robot.links))
    for pair, (rate, distance) in rates.items():
        assert pair in checked or pair in neighbours or (rate == 0.0 and distance > 0.01), pair


def test_unchecked_pairs_stay_apart_on_a_dense_scan_of_their_joints():
    robot = load_robot()
    model = mujoco.MjModel.from_xml_string(self_pairs.mjcf(robot))
    data, kinds = mujoco.MjData(model), (model.geom_contype.copy(), model.geom_conaffinity.copy())
    owner = np.array([robot.links.index(model.geom(g).name.split("/")[0]) for g in range(model.ngeom)])
    # Joints in between, steps of the scan, and a distance that half a step cannot use up (4, 10, 7, 16, 4 mm).
    fine, coarse = np.arange(-P, P, P / 180), np.arange(-P, P, P / 36)
    scans = {
        ("base", "upper_arm"): (0, 1, coarse[::9], fine, 0.011),  # the base is a body of revolution
        ("forearm", "wrist_2"): (3, 4, coarse, coarse, 0.018),
        ("wrist_1", "wrist_3"): (4, 5, coarse, coarse, 0.014),
        ("wrist_1", "gripper"): (4, 5, coarse, coarse, 0.030),
        ("wrist_2", "gripper"): (4, 5, coarse[:1], coarse, 0.040),
    }
    for (a, b), (i, j, first, second, enough) in each(scans.items()):
        wanted = sorted((robot.links.index(a), robot.links.index(b)))
        meant = np.isin(owner, wanted)
        model.geom_contype[:], model.geom_conaffinity[:] = (np.where(meant, x, 0) for x in kinds)
        nearest = self_pairs.FAR_M
        for u, v in product(first, second):
            data.qpos[:] = 0.0
            data.qpos[[i, j]] = u, v
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            pairs = np.sort(owner[data.contact.geom], axis=1)
            ours = data.contact.dist[(pairs == wanted).all(axis=1)]
            nearest = min(nearest, float(ours.min(initial=nearest)))
        assert nearest > enough, (a, b, nearest)


def with_one_distance(apart_m: float, other: str) -> Robot:
    """A UR5e whose base is so far from another link in every posture: two capsules about axes that cross, which joints
    between them turn in themselves. All other links are specks on their joints' axes."""
    robot = load_robot()
    n, height, radius = len(robot.links) - 1, robot.T_parent_joint[0][2, 3], 0.02
    place, size = np.tile(np.eye(4), (n, 1, 1)), np.full((n, 3), 1e-3)
    # the shoulder's joint and its neighbour's stand at the same height: the base reaches up to below it
    place[0, 2, 3] = height - apart_m - 2 * radius - 0.01
    size[0] = radius, 0.01, 0.0
    size[robot.links.index(other)] = radius, 0.01, 0.0
    T = [np.array(T) for T in robot.T_parent_joint]
    if other == "forearm":  # an upper arm of no length: the elbow's axis is the shoulder's
        T[2][:3, 3] = 0.0
    arm = Primitives(
        robot.links[:n], np.arange(n, dtype=np.int32), np.full(n, ShapeKind.CAPSULE, np.int32), place, size
    )
    return replace(robot, arm=arm, T_parent_joint=np.array(T), digest=f"{apart_m}, {other}")


@pytest.mark.parametrize(
    ("apart_m", "other", "checked"),
    [(0.0095, "upper_arm", True), (0.0105, "upper_arm", False), (0.03, "forearm", True), (-0.001, "upper_arm", False)],
)
def test_pairs_are_left_out_that_stay_10_mm_apart_with_two_joints_between_them_or_always_touch(apart_m, other, checked):
    found = self_pairs.checked_pairs(with_one_distance(apart_m, other), 100)
    assert found["base", other][0] == checked
    if apart_m > 0:
        rates = self_pairs.contact_rates(with_one_distance(apart_m, other), 100)
        assert rates["base", other] == (0.0, pytest.approx(apart_m, abs=1e-6))
    assert all(not say[0] for (a, b), say in found.items() if (a, b) in set(pairwise(load_robot().links)))
