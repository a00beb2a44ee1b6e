"""Which links of the robot can touch which: the checked pairs against MuJoCo, scanned and at random."""

from itertools import pairwise, product

import mujoco
import numpy as np

from r2h_batch.data import robot_pairs as self_pairs
from r2h_batch.scene.robot import load_robot

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
    for (a, b), (i, j, first, second, enough) in scans.items():
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
