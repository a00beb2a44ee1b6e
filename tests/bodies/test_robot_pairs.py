"""Which links of the robot can touch which: the checked pairs against MuJoCo, scanned and at random; home is clear."""

from itertools import pairwise

import mujoco
import numpy as np

from r2h_batch.assets.robot import self_pairs
from r2h_batch.bodies.robot import JOINTS, load_robot

Q0 = np.array([-0.3225, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483])
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
    data = mujoco.MjData(model)
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
        nearest = self_pairs.FAR_M
        for u in first:
            for v in second:
                data.qpos[:] = 0.0
                data.qpos[[i, j]] = u, v
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_collision(model, data)
                pairs = np.sort(owner[data.contact.geom], axis=1)
                ours = data.contact.dist[(pairs == wanted).all(axis=1)]
                nearest = min(nearest, float(ours.min(initial=nearest)))
        assert nearest > enough, (a, b, nearest)


def test_neighbours_touch_in_their_sockets_always_or_never():
    robot, rng = load_robot(), np.random.default_rng(6)
    model = mujoco.MjModel.from_xml_string(self_pairs.mjcf(robot))
    data = mujoco.MjData(model)
    owner = np.array([robot.links.index(model.geom(g).name.split("/")[0]) for g in range(model.ngeom)])
    counts: dict[tuple[int, int], int] = {}
    for q in rng.uniform(-P, P, (1_500, JOINTS)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        for g1, g2 in {tuple(sorted(g)) for g in data.contact.geom[data.contact.dist <= 0]}:
            if abs(owner[g1] - owner[g2]) == 1:
                counts[g1, g2] = counts.get((g1, g2), 0) + 1
    assert counts and set(counts.values()) == {1_500}


def test_home_is_clear_of_table_and_itself():
    robot = load_robot()
    model = mujoco.MjModel.from_xml_string(self_pairs.mjcf(robot))
    data = mujoco.MjData(model)
    data.qpos[:] = Q0
    mujoco.mj_kinematics(model, data)
    link = [model.geom(g).name.split("/")[0] for g in range(model.ngeom)]
    checked = {(robot.links[a], robot.links[b]) for a, b in robot.self_pairs}
    for g in range(model.ngeom):
        for h in range(g + 1, model.ngeom):
            if (link[g], link[h]) in checked:
                assert mujoco.mj_geomDistance(model, data, g, h, 1.0, None) > 0.05, (link[g], link[h])
        if link[g] != "base":
            R, size = data.geom_xmat[g].reshape(3, 3), model.geom_size[g]
            sphere = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE
            box = model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX
            low = np.abs(R[2]) @ size if box else size[0] * (1 if sphere else np.hypot(R[2, 0], R[2, 1]))
            low += 0.0 if box else abs(R[2, 2]) * size[1]
            assert data.geom_xpos[g][2] - low > 0.08, link[g]
