"""The robot's kinematics against DH, MuJoCo and the URDFs; its primitives against airo-models' meshes."""

import hashlib
import json
import re
from functools import cache
from importlib.resources import files
from pathlib import Path

import airo_models
import mujoco
import numpy as np
import pytest
import trimesh
from convex_twin import primitive_distance
from rounds import each

from r2h_batch.assets.robot import build_robot
from r2h_batch.scene import robot as robots
from r2h_batch.scene.robot import drive_from_gap, forward_kinematics, gap_from_drive, pad_center_z
from r2h_batch.scene.robot_file import load_robot

MODELS, ROBOT = Path(airo_models.__file__).parent, load_robot()
Q0 = np.array([-0.3225, -1.7453, 1.4312, -1.2566, -1.5708, 1.2483])
JOINTS, P = 6, np.pi
# The visual origins of ur5e.urdf, written down a second time: mesh, rpy, xyz.
VISUALS = {
    "base": ("base", (0, 0, 0), (0, 0, 0)),
    "shoulder": ("shoulder", (0, 0, P), (0, 0, 0)),
    "upper_arm": ("upperarm", (P / 2, 0, -P / 2), (0, 0, 0.138)),
    "forearm": ("forearm", (P / 2, 0, -P / 2), (0, 0, 0.007)),
    "wrist_1": ("wrist1", (P / 2, 0, 0), (0, 0, -0.127)),
    "wrist_2": ("wrist2", (0, 0, 0), (0, 0, -0.0997)),
    "wrist_3": ("wrist3", (P / 2, 0, 0), (0, 0, -0.0989)),
}
FINGERS = ("outer_knuckle", "outer_finger", "inner_finger", "inner_knuckle")


def arm_mesh(link: str) -> trimesh.Trimesh:
    name, rpy, xyz = VISUALS[link]
    mesh = trimesh.load(MODELS / f"arms/ur5e/visual/{name}.obj", force="mesh", process=False)
    T = trimesh.transformations.euler_matrix(*rpy, "sxyz")
    T[:3, 3] = xyz
    return mesh.apply_transform(T)


def gripper_mesh(file: str, scale: float = 1e-3) -> trimesh.Trimesh:
    path = MODELS / f"grippers/robotiq_2f_85/meshes/visual/{file}.obj"
    return trimesh.load(path, force="mesh", process=False).apply_scale(scale)


def face_samples(mesh: trimesh.Trimesh, count: int = 20_000) -> np.ndarray:
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=1)
    return np.concatenate([points, mesh.vertices])


@cache
def finger_points(part: str) -> np.ndarray:
    return face_samples(gripper_mesh(f"robotiq_arg2f_85_{part}"), 8_000)


def union_depth(kinds, poses, sizes, points):
    """How far points are outside all shapes (negative inside)."""
    local = [(points - T[:3, 3]) @ T[:3, :3] for T in poses]
    return np.min([primitive_distance(k, s, x) for k, s, x in zip(kinds, sizes, local, strict=True)], axis=0)


def urdf_model(path: str) -> mujoco.MjModel:
    """A URDF's kinematics in MuJoCo C: the shapes are cut out, the fixed links stay."""
    text = re.sub(r"drake:", "", (MODELS / path).read_text())
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", text, flags=re.S)
    inertia = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
    text = re.sub(r"<inertial>.*?</inertial>", "", text, flags=re.S)
    text = re.sub(r'<link name="(\w+)"\s*/>', r'<link name="\1"></link>', text)
    text = re.sub(r'(<link name="\w+">)', rf"\1{inertia}", text)
    compiler = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco></robot>'
    return mujoco.MjModel.from_xml_string(text.replace("</robot>", compiler))


def body_pose(data: mujoco.MjData, name: str) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.body(name).xmat.reshape(3, 3), data.body(name).xpos
    return T


def test_flange_agrees_with_the_published_dh_parameters():
    rng = np.random.default_rng(0)
    d, a = (0.1625, 0, 0, 0.1333, 0.0997, 0.0996), (0, -0.425, -0.3922, 0, 0, 0)
    alpha = (P / 2, 0, 0, P / 2, -P / 2, 0)
    for q in each(rng.uniform(-2 * P, 2 * P, (50, JOINTS))):
        T = np.diag([-1.0, -1.0, 1.0, 1.0])  # DH's base is turned by half a turn against base_link
        for i in range(JOINTS):
            c, s, ca, sa = np.cos(q[i]), np.sin(q[i]), np.cos(alpha[i]), np.sin(alpha[i])
            T = T @ [[c, -s * ca, s * sa, a[i] * c], [s, c * ca, -c * sa, a[i] * s], [0, sa, ca, d[i]], [0, 0, 0, 1]]
        np.testing.assert_allclose(forward_kinematics(ROBOT, q)[JOINTS] @ ROBOT.T_wrist3_flange, T, atol=1e-6)


def test_every_link_agrees_with_the_urdf_in_mujoco():
    rng, model = np.random.default_rng(1), urdf_model("arms/ur5e/ur5e.urdf")
    data = mujoco.MjData(model)
    assert [model.joint(i).name for i in range(model.njnt)] == list(ROBOT.joints)
    np.testing.assert_allclose(model.jnt_range, np.column_stack([ROBOT.lower, ROBOT.upper]), atol=1e-12)
    q = rng.uniform(-2 * P, 2 * P, (50, JOINTS))
    T = forward_kinematics(ROBOT, q)
    for n in range(len(q)):
        data.qpos[:] = q[n]
        mujoco.mj_kinematics(model, data)
        for i, link in enumerate(ROBOT.links[1 : JOINTS + 1]):
            np.testing.assert_allclose(T[n, i + 1], body_pose(data, f"{link}_link"), atol=1e-6)
        np.testing.assert_allclose(T[n, JOINTS] @ ROBOT.T_wrist3_flange, body_pose(data, "tool0"), atol=1e-6)


def test_home_points_the_gripper_straight_down():
    T = robots.ee_pose(ROBOT, Q0)
    np.testing.assert_allclose(T[:3, :3], np.diag([-1.0, 1.0, -1.0]), atol=2e-4)
    np.testing.assert_allclose(T[:3, 3], [0.4206, 0.0, 0.4494], atol=1e-4)
    np.testing.assert_allclose(forward_kinematics(ROBOT, Q0)[7][:3, 3], [0.4206, 0.0, 0.5916], atol=1e-4)


def test_linkage_matches_scene_md_and_inverts():
    q = np.linspace(0.0, 0.8, 81)
    gap = 2 * (0.0054058 + 0.0376 * np.cos(q) - 0.0430 * np.sin(q))
    np.testing.assert_allclose(gap_from_drive(ROBOT, q), gap, atol=2e-7)
    np.testing.assert_allclose(pad_center_z(ROBOT, q), 0.087324 + 0.0430 * np.cos(q) + 0.0376 * np.sin(q), atol=1e-9)
    np.testing.assert_allclose(drive_from_gap(ROBOT, gap_from_drive(ROBOT, q)), q, atol=1e-12)
    np.testing.assert_array_equal(drive_from_gap(ROBOT, [1.0, -1.0]), [0.0, 0.8])
    ee_z = float(pad_center_z(ROBOT, drive_from_gap(ROBOT, 0.0425))) + ROBOT.T_flange_gripper[2, 3]
    assert abs(ee_z - ROBOT.T_flange_ee[2, 3]) < 1e-7


@pytest.mark.parametrize("gap_m", [0.0, 0.0425, 0.085])
def test_gripper_shapes_cover_the_finger_meshes_where_the_urdf_puts_them(gap_m):
    model = urdf_model("grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf")
    data, drive = mujoco.MjData(model), float(drive_from_gap(ROBOT, gap_m))
    for joint in range(model.njnt):  # the mimic tags: inner fingers turn back, all others go along
        data.qpos[joint] = -drive if "inner_finger" in model.joint(joint).name else drive
    mujoco.mj_kinematics(model, data)
    T_gripper_world = np.linalg.inv(body_pose(data, "base_link_inertia"))
    T_gripper_ee = np.linalg.inv(ROBOT.T_flange_gripper) @ ROBOT.T_flange_ee
    poses = T_gripper_ee @ robots.gripper_primitives_at(ROBOT, gap_m)
    names = np.array(ROBOT.gripper.names)
    for side in ("left", "right"):
        for part in FINGERS:
            chosen = np.array([n.startswith(f"{side}_{part}_") for n in names])
            T = T_gripper_world @ body_pose(data, f"{side}_{part}")
            points = trimesh.transform_points(finger_points(part), T)
            outside = union_depth(ROBOT.gripper.kind[chosen], poses[chosen], ROBOT.gripper.size[chosen], points)
            assert outside.max() < 0.5e-3, (side, part, outside.max())
        pad = int(np.flatnonzero(names == f"{side}_pad")[0])
        T_pad = T_gripper_world @ body_pose(data, f"{side}_inner_finger_pad")
        np.testing.assert_allclose(poses[pad][:3, 3], T_pad[:3, 3], atol=1e-9)
        np.testing.assert_allclose(ROBOT.gripper.size[pad], [0.011, 0.003175, 0.01875], atol=1e-12)
        assert abs(abs(poses[pad][1, 3]) - 0.003175 - float(gap_from_drive(ROBOT, drive)) / 2) < 1e-12


def test_body_shapes_cover_gripper_base_and_coupling():
    coupling = gripper_mesh("robotiq_gripper_coupling")
    coupling.apply_translation([0, 0, -ROBOT.T_flange_gripper[2, 3] - coupling.bounds[0, 2]])
    points = np.concatenate([face_samples(coupling), face_samples(gripper_mesh("robotiq_arg2f_85_base_link", 1.0))])
    body = np.array([part == "body" for part in ROBOT.gripper_part])
    shapes = ROBOT.gripper.kind[body], ROBOT.gripper.T_link_prim[body], ROBOT.gripper.size[body]
    assert union_depth(*shapes, points).max() < 0.5e-3


@pytest.mark.parametrize("link", VISUALS)
def test_arm_primitives_cover_dense_face_samples(link):
    chosen = ROBOT.arm.link == ROBOT.links.index(link)
    points = face_samples(arm_mesh(link), 40_000)
    shapes = ROBOT.arm.kind[chosen], ROBOT.arm.T_link_prim[chosen], ROBOT.arm.size[chosen]
    assert union_depth(*shapes, points).max() < 0.5e-3


def test_robot_json_is_what_the_build_script_writes_and_its_digest_is_the_files_hash():
    raw = (files("r2h_batch.assets") / "robot" / "robot.json").read_bytes()
    data = json.loads(raw)
    rebuilt = build_robot.robot_data(build_robot.read_fitted(data))
    assert json.dumps(rebuilt, indent=1) + "\n" == raw.decode()
    assert ROBOT.digest == hashlib.sha256(raw).hexdigest()
    assert load_robot() is ROBOT
    with pytest.raises(ValueError, match="read-only"):
        ROBOT.upper[0] = 0.0
