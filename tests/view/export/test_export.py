"""Exported trials open in plain MuJoCo elsewhere, and MuJoCo's distances on them are the stored margins."""

import csv
import re
import shutil
import subprocess
import sys

import mujoco
import numpy as np
import oracle
import pytest
import trimesh
from rounds import each

from r2h_batch.config import HOME_Q
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.view import mjcf as export
from r2h_batch.view.stored import Reader

TRIALS = (0, 3)
CAP_M = 0.05
CHECKED = {"hand", "table", "self", "object_hand", "object_table", "object_robot"}


@pytest.fixture(scope="module")
def exported(run, tmp_path_factory):
    """{trial id: (stored trial, folder)}; the folders were moved after they were written."""
    base = tmp_path_factory.mktemp("exports")
    result = {}
    for k in TRIALS:
        stored = Reader(run).trial(k, "oracle")
        folder = export.export_trial(stored, base / f"first{k}")
        result[k] = (stored, shutil.move(folder, base / f"moved{k}"))
    return result


def load(folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    return model, mujoco.MjData(model)


def groups(model):
    """Geom ids by what they belong to: links of the robot (by body), gripper, object, hand, table; visuals apart."""
    found, visual = {}, []
    for i in range(model.ngeom):
        name = model.geom(i).name
        if name.endswith("_visual"):
            visual.append(i)
            continue
        kind = name.split("/")[0]
        found.setdefault(model.body(model.geom_bodyid[i]).name if kind == "robot" else kind, []).append(i)
    return found, visual


def clearances(model, data, q):
    """Smallest mj_geomDistance of every class of pairs, from the names alone and robot.json's pairs."""
    robot, (ids, _) = load_robot(), groups(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    pairs = [("hand", link, "hand") for link in robot.links]
    pairs += [("table", link, "table") for link in robot.links if link not in ("base", "shoulder")]
    pairs += [("self", robot.links[a], robot.links[b]) for a, b in robot.self_pairs]
    pairs += [("object_hand", "object", "hand"), ("object_table", "object", "table")]
    pairs += [("object_robot", "object", robot.links[a]) for a in robot.object_pairs]
    least = dict.fromkeys(CHECKED, 0.06)
    for name, one, two in pairs:
        for a in ids[one]:
            for b in ids[two]:
                gap = np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b])
                if gap - model.geom_rbound[a] - model.geom_rbound[b] < least[name]:
                    least[name] = min(least[name], mujoco.mj_geomDistance(model, data, a, b, 0.07, None))
    return least


def trajectory(folder, name="trajectory.csv"):
    with (folder / name).open() as file:
        rows = list(csv.reader(file))
    return rows[0], np.array(rows[1:], np.float64)


def test_distances_on_the_exported_geoms_are_those_of_the_planners_bodies(exported, scene):
    rng = np.random.default_rng(0)
    objects = {o.name: i for i, o in enumerate(scene.objects)}
    for stored, folder in each(exported.values()):
        model, data = load(folder)
        staged = oracle.Staged(
            objects[stored.row["object"]],
            stored.row["hand_index"],
            stored.T_obj_ee_attached,
            stored.T_world_hand,
            stored.row["opening_m"],
        )
        twin = oracle.mujoco_scene(scene, staged)
        for q in each((*stored.q, *(stored.q[-1] + rng.normal(size=(6, 6)) * 0.2))):
            ours, theirs = clearances(model, data, q), twin.clearances(q, cap=CAP_M).distance
            for name in CHECKED:
                if theirs[name] < CAP_M and theirs[name] > 0:
                    assert abs(ours[name] - theirs[name]) <= 5e-6, (name, ours[name], theirs[name])
                else:
                    assert (ours[name] > 0) == (theirs[name] > 0)


def test_the_stored_margins_are_what_mujoco_measures_along_the_trajectory(exported):
    judged = 0
    for stored, folder in exported.values():
        model, data = load(folder)
        _, rows = trajectory(folder)
        margin, safe = stored.row["margin_plan_m"], stored.row["margin_safe_m"]
        q = rows[:, 1:]
        least = [min(clearances(model, data, x).values()) for x in q[:: max(1, len(q) // 60)]] + [
            min(clearances(model, data, q[-1]).values())
        ]
        assert min(least) >= margin - 5e-5
        vertices, faces = _hand_mesh(model, data, folder)
        distance = min(_robot_distance(model, data, vertices[faces], x) for x in (*q[:: max(1, len(q) // 12)], q[-1]))
        assert distance >= safe - 5e-5
        if stored.row["witness_time_s"] is not None:  # Safe's own moment and part
            at = q[np.abs(rows[:, 0] - stored.row["witness_time_s"]).argmin()]
            assert abs(_robot_distance(model, data, vertices[faces], at) - safe) <= 1.5e-3  # 10 ms beside it at most
            part = stored.row["witness_safe_part"]
            assert {f"robot/{part}", f"gripper/{part}"} & {model.geom(i).name for i in range(model.ngeom)}
            judged += 1
    assert judged >= 1


def _hand_mesh(model, data, folder):
    mesh = trimesh.load(folder / "meshes" / "hand_mesh.obj", process=False)
    mujoco.mj_forward(model, data)
    hand = data.body("hand")
    return np.asarray(mesh.vertices) @ hand.xmat.reshape(3, 3).T + hand.xpos, np.asarray(mesh.faces)


def _robot_distance(model, data, triangles, q):
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    best = CAP_M
    for i in range(model.ngeom):
        name = model.geom(i).name
        if name.split("/")[0] in ("robot", "gripper") and not name.endswith("_visual"):
            if np.linalg.norm(triangles.mean((0, 1)) - data.geom_xpos[i]) - model.geom_rbound[i] > 0.25 + best:
                continue
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = data.geom_xmat[i].reshape(3, 3), data.geom_xpos[i]
            best = min(
                best,
                oracle.mesh_distance(
                    oracle._KIND_OF_TYPE[int(model.geom_type[i])], model.geom_size[i], T, triangles, cap=best
                ),
            )
    return best


def test_the_trajectory_is_the_timed_path_with_all_its_waypoints(exported):
    robot = load_robot()
    for stored, folder in each(exported.values()):
        header, rows = trajectory(folder)
        assert header == ["time_s", *robot.joints]
        t, q = rows[:, 0], rows[:, 1:]
        assert t[0] == 0 and (np.diff(t) > 0).all() and np.diff(t).max() <= 0.01 + 1e-9
        assert -0.1 < t[-1] - stored.row["t_exec_s"] < 0.3  # the arm is within a millimetre of the goal before the end
        assert np.allclose(q[0], HOME_Q, atol=1e-6) and np.allclose(q[-1], stored.row["q_goal"], atol=1e-6)
        for w, time in zip(stored.q, stored.time_s, strict=True):
            k = np.abs(q - w).max(1).argmin()
            assert np.abs(q[k] - w).max() <= 1e-8 * 10 and abs(t[k] - time) <= 1e-4
        speed, gain = 0.1 * np.pi, 0.5
        rate = np.abs(np.diff(q, axis=0)).max(1) / np.diff(t)
        assert rate.max() <= speed * 1.01
        fine = np.diff(t) > 5e-3
        assert (np.abs(np.diff(rate)) / 0.01)[fine[1:] & fine[:-1]].max() <= gain * 1.1 + 1e-3


def test_a_model_opens_at_home_stays_there_and_plays_with_the_script_beside_it(exported):
    _, folder = exported[0]
    model, data = load(folder)
    assert np.allclose(data.qpos, HOME_Q) and model.ncam >= 1 and model.nlight >= 1 and model.nu == 6
    mujoco.mj_step(model, data, 200)
    assert np.abs(data.qpos - HOME_Q).max() < 1e-9
    line = [sys.executable, str(folder / "play.py"), "--check", "--servos"]
    done = subprocess.run(line, capture_output=True, text=True, check=True, cwd=folder.parent)
    found = re.search(r"gripper ([0-9.]+) mm from its target, (\d+) contacts", done.stdout)
    assert found and float(found[1]) < 1.0 and found[2] == "0"


def test_contacts_are_those_of_the_checked_pairs(exported):
    for stored, folder in each(exported.values()):
        model, data = load(folder)
        data.qpos[:] = stored.q[-1]
        mujoco.mj_forward(model, data)
        assert stored.row["outcome"] == "success" and data.ncon == 0
        rng, agreed = np.random.default_rng(1), set()
        for q in rng.uniform(-np.pi, np.pi, (60, 6)):
            least = clearances(model, data, q)  # leaves the posture in data
            if any(abs(x) < 1e-4 for x in least.values()):
                continue
            held = least["hand"] < 0 and all(least[k] > 0 for k in CHECKED - {"hand"})
            if not held:  # the base and the hand both stand still: MuJoCo looks for no contact between them
                assert (data.ncon > 0) == (min(least.values()) < 0), least
            agreed |= {k for k in CHECKED if least[k] < 0}
        assert {"table", "self"} <= agreed
