"""Robot files: what is written is read as the same robot, built-in arms hold what the import promises, bad files say why."""

import json
from contextlib import nullcontext
from dataclasses import fields
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from refusals import one_line
from robot_files import read_arm
from seven import seven_joints, with_hulls, with_jaws, with_table

from r2h_batch.data import robot_links, robot_shapes
from r2h_batch.data.robot import gripper_of
from r2h_batch.data.robot_chain import read_chain, read_fingers
from r2h_batch.data.robot_links import Meshes, check_meshes, link_of, seen_of
from r2h_batch.data.robot_model import read_model
from r2h_batch.data.robot_pairs import touching
from r2h_batch.data.robot_shapes import CORNERS, Target, fit_hulls
from r2h_batch.scene import robot as robots
from r2h_batch.scene.robot import Robot, ee_pose, slide_table
from r2h_batch.scene.robot_file import ROBOTS, load_robot, read_robot, robot_arrays, write_robot
from r2h_batch.scene.robot_visuals import arm_urdf


def same(a: object, b: object) -> bool:
    if isinstance(a, (robots.Dynamics, robots.Linkage, robots.Primitives)):
        return all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, tuple) and a and isinstance(a[0], np.ndarray):
        return len(a) == len(b) and all(map(np.array_equal, a, b))
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


@pytest.mark.parametrize(
    "robot", [with_jaws(seven_joints()), with_hulls(load_robot()), with_table(seven_joints())], ids=lambda r: r.name
)
def test_a_robot_written_and_read_is_equal_field_by_field(robot: Robot, tmp_path: Path) -> None:
    write_robot(tmp_path, robot)
    again = read_robot(tmp_path)
    for f in fields(Robot):
        assert f.name == "digest" or same(getattr(robot, f.name), getattr(again, f.name)), f.name
    assert read_robot(tmp_path) == again != robot


@pytest.mark.parametrize("name", ROBOTS[1:])
def test_a_built_in_arm_keeps_what_the_import_promises(name: str) -> None:
    robot = load_robot(name)
    report = json.loads((files("r2h_batch.assets") / "robot" / name / "report.json").read_text())
    palm = set(report["links"]) - set(robot.links)
    for link, row in report["links"].items():
        assert row["mean_mm"] <= (4.0 if link in palm else 3.0) and row["worst_protrusion_mm"] <= 0.1, link
    assert len(palm) == (robot.linkage.table is not None)
    tool, home = load_robot().T_wrist3_ee, ee_pose(robot, robot.home_q)
    assert palm or np.array_equal(robot.T_wrist3_ee, tool)
    assert home[2, 2] < -0.9999 and abs(home[1, 3]) < 1e-3 and not touching(robot, np.array(robot.home_q))


def test_hulls_hold_the_mesh_that_they_are_cut_from():
    ring = trimesh.creation.torus(0.06, 0.015, major_sections=24, minor_sections=12)
    mesh = Target(ring.triangles, [])
    hulls = fit_hulls(mesh, lambda found: len(found) == 4, 4)
    assert max(len(hull.points) for hull in hulls) <= CORNERS
    solids = [trimesh.convex.convex_hull(hull.points) for hull in hulls]
    outside = np.min([-trimesh.proximity.signed_distance(solid, ring.vertices) for solid in solids], axis=0)
    assert outside.max() < 1e-5 and mesh.mean_overshoot_mm(hulls) < 12


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda y: y.update(format=2), "format"),
        (lambda y: y["arm"].update(home_rad=[0.0] * 5), "home_rad"),
        (lambda y: y["arm"].update(max_velocity_rad_s=[1e-9] * 6), "max_velocity_rad_s"),
        (lambda y: y["arm"].update(visuals="../../x"), "visuals"),
        (lambda y: y["arm"]["links"].__setitem__(3, "table"), "called 'table'"),
        (lambda y: y.update(gripper={"law": "slide"}), "gripper"),
    ],
)
def test_a_wrong_robot_yaml_is_refused_in_one_line(change, words, tmp_path):
    write_robot(tmp_path, load_robot())
    data = yaml.safe_load((tmp_path / "robot.yaml").read_text())
    change(data)
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(data))
    with one_line(words):
        read_robot(tmp_path)


@pytest.mark.parametrize(
    ("hulls", "change", "words"),
    [
        (0, lambda a: a.pop("com"), "has no com"),
        (0, lambda a: a.update(size=np.full_like(a["size"], np.nan)), "size holds a number that is not finite"),
        (0, lambda a: a.update(link=a["link"] * 0), "every link"),
        (0, lambda a: a.update(self_pairs=np.array([[3, 3]])), "pairs name two links"),
        (0, lambda a: a.update(T_link_prim=2 * a["T_link_prim"]), "not a rigid pose"),
        (0, lambda a: a.update(T_parent_joint=a["T_parent_joint"][::-1].copy()), "not that of a UR"),
        (0, lambda a: a.update(mass=a["mass"] * 1e300), "masses to 1000 kg"),
        (0, lambda a: a["T_parent_joint"].__setitem__((slice(None), slice(3), 3), 0), "between 1 mm and 5 m"),
        (1, lambda a: a.update(corners=a["corners"][:-1]), "add up to the number of corners"),
        (1, lambda a: a.update(corners=a["corners"] + 1.0), "ball about the middle"),
    ],
)
def test_a_wrong_robot_npz_is_refused_in_one_line(hulls, change, words, tmp_path):
    robot = with_hulls(load_robot()) if hulls else load_robot()
    write_robot(tmp_path, robot)
    arrays = {name: np.array(x) for name, x in robot_arrays(robot).items()}
    change(arrays)
    np.savez(tmp_path / "robot.npz", **arrays)
    with one_line(words):
        read_robot(tmp_path)


URDF = """<robot name="one"><link name="base"><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link>
<link name="hand"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
<joint name="turn" type="{kind}"><parent link="base"/><child link="hand"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<!DOCTYPE r [<!ENTITY a "b">]>' + URDF, "declares a document type"),
        (URDF.replace("<robot", '<robot xmlns:xacro="x"').replace("<axis", "<xacro:if/><axis"), "xacro"),
        (URDF.replace("{kind}", "prismatic"), "turn is prismatic"),
        (URDF.replace("{mesh}", "../a.stl"), "points outside the folder"),
        (URDF.replace("{mesh}", "package://arm/a.stl"), "--package arm=FOLDER"),
        (URDF.replace('velocity="1"', 'velocity="-1"'), "velocity -1; it must be above 0, or left out for 2 rad/s"),
        (URDF.replace("0 0 1", "0 nan 1"), "3 numbers"),
        (URDF.replace("</robot>", 300 * '<joint name="j"/>' + "</robot>"), "301 links or joints"),
    ],
)
def test_a_bad_urdf_is_refused_in_one_line(text, words, tmp_path):
    (tmp_path / "one.urdf").write_text(text.replace("{kind}", "revolute").replace("{mesh}", "a.stl"))
    with one_line(words):
        read_arm(tmp_path / "one.urdf", "base", "hand")


JAWS = """<robot name="jaws"><link name="flange"><visual><geometry><mesh filename="palm.stl"/></geometry></visual>{mass}</link>
<link name="l">{box}{mass}</link><link name="r">{box}{mass}</link>
<joint name="one" type="{kind}"><parent link="flange"/><child link="l"/><origin xyz="0 0 0.1"/><axis xyz="{axis}"/>{limit}</joint>
<joint name="two" type="prismatic"><parent link="flange"/><child link="r"/><origin xyz="0 0 0.1"/><axis xyz="0 -1 0"/>
{limit}</joint>
</robot>"""
USUAL = {
    "box": '<collision><geometry><box size="0.02 0.01 0.03"/></geometry></collision>',
    "kind": "prismatic",
    "mass": '<inertial><mass value="0.2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>',
    "axis": "0 1 0",
    "limit": '<limit lower="0" upper="0.04" velocity="1" effort="1"/>',
}


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Few samples suffice for a palm that is a box."""
    monkeypatch.setattr(robot_shapes, "PROTRUSION_SPACING_M", 2e-3)


def jaws_of(folder: Path, urdf: str = JAWS, **changes: str):
    trimesh.creation.box((0.1, 0.1, 0.05)).export(folder / "palm.stl")
    text = urdf
    for key, value in (USUAL | changes).items():
        text = text.replace("{" + key + "}", value)
    (folder / "jaws.urdf").write_text(text)
    model = read_model(folder / "jaws.urdf")
    fingers = read_fingers(model, "flange", ("l", "r"))
    check_meshes([fingers.palm], fingers.parts, model.shown)
    meshes = Meshes(model, [*seen_of(fingers.palm), *(g for p in fingers.parts for g in p.shown)], {})
    return fingers, gripper_of(fingers, ("l", "r"), 6, meshes)[0], meshes


def test_jaws_of_a_urdf_stand_and_open_as_it_says(tmp_path):
    jaws, gripper, meshes = jaws_of(tmp_path)
    one, two = jaws.parts
    assert jaws.palm.mass == one.mass == two.mass == 0.2
    assert np.allclose(one.T[[0, -1], :3, 3], [[0, 0, 0.1], [0, 0.04, 0.1]])
    assert np.allclose(two.T[[0, -1], :3, 3], [[0, 0, 0.1], [0, -0.04, 0.1]])
    ((T, half),) = one.boxes
    assert np.array_equal(T, np.eye(4)) and np.allclose(half, [0.01, 0.005, 0.015])
    assert np.allclose(np.ptp(link_of(jaws.palm, meshes).triangles.reshape(-1, 3), axis=0), [0.1, 0.1, 0.05])
    # the jaws' boxes are 10 mm thick and begin with their middles in one place
    assert np.allclose(gripper["linkage"].table, slide_table(0.0, 0.07)) and np.isclose(gripper["open_gap_m"], 0.07)


CRANKS = """<robot name="cranks"><link name="flange"><visual><geometry><mesh filename="palm.stl"/></geometry></visual>{mass}
</link><link name="a">{bar}{mass}</link><link name="b">{bar}{mass}</link><link name="l">{box}</link><link name="r">{box}</link>
<joint name="one" type="revolute"><parent link="flange"/><child link="a"/><origin xyz="0 0.012 0.06"/><axis xyz="-1 0 0"/>
<limit lower="0" upper="0.8" velocity="1" effort="1"/></joint>
<joint name="two" type="revolute"><parent link="flange"/><child link="b"/><origin xyz="0 -0.012 0.06"/><axis xyz="1 0 0"/>
<mimic joint="one" multiplier="{other}"/></joint>
<joint name="three" type="revolute"><parent link="a"/><child link="l"/><origin xyz="0 0 0.05"/><axis xyz="-1 0 0"/>
<mimic joint="one" multiplier="{pad}"/></joint>
<joint name="four" type="revolute"><parent link="b"/><child link="r"/><origin xyz="0 0 0.05"/><axis xyz="1 0 0"/>
<mimic joint="one" multiplier="{pad}"/></joint></robot>"""
TURNING = {
    "bar": '<collision><origin xyz="0 0 0.025"/><geometry><box size="0.01 0.004 0.05"/></geometry></collision>',
    "other": "1",
    "pad": "-1",
}


def test_fingers_on_cranks_become_a_table_of_their_circle(tmp_path):
    fingers, gripper, meshes = jaws_of(tmp_path, CRANKS, **TURNING)
    other = gripper_of(fingers, ("r", "l"), 6, meshes)[0]  # in whatever order they are named
    assert np.allclose(gripper["T_flange_gripper"], np.eye(4)) and np.allclose(other["T_flange_gripper"], np.eye(4))
    link = gripper["linkage"]
    gap = np.linspace(-2 * link.drive_upper, -2 * link.drive_lower, link.table.shape[1])
    turn = np.arcsin((gap / 2 - 0.012 + 0.005) / 0.05)  # a crank of 50 mm, pads of 5 mm half
    assert np.isclose(gap[0], 0.014) and np.isclose(turn[-1], 0.8)
    assert gripper["gripper_motion"][-4:] == ("table_1",) * 2 + ("table_0",) * 2
    assert np.abs(link.table[0, :, 1] - 0.05 * (np.cos(turn) - 1)).max() < 1e-6 and np.ptp(link.table[0, :, 2]) < 1e-9
    assert np.abs(link.table[1, :, 2] + turn).max() < 1e-4 and link.jaw_mass_kg == 0.2 and np.isclose(link.mass_kg, 0.6)
    assert np.isclose(gripper["T_flange_ee"][2, 3], np.interp(gap[-1] / 2, gap, 0.06 + 0.05 * np.cos(turn)), atol=1e-6)


@pytest.mark.parametrize(
    ("urdf", "changes", "words"),
    [
        (JAWS, {"kind": "revolute"}, "must stay parallel"),
        (JAWS, {"axis": "0 -1 0"}, "must be mirror images"),
        (JAWS, {"box": ""}, "neither boxes to collide nor a mesh"),
        (CRANKS, TURNING | {"other": "-1"}, "must open apart"),
        (CRANKS.replace('joint="one" multiplier="{other}"', 'joint="two"'), TURNING, "follows itself"),
        (CRANKS.replace('<mimic joint="one" multiplier="{pad}"/>', "{limit}"), TURNING, "3 joints of the gripper move"),
    ],
)
def test_jaws_that_are_none_are_refused_in_one_line(urdf, changes, words, tmp_path):
    with one_line(words):
        jaws_of(tmp_path, urdf, **changes)


def test_the_chain_of_the_ur5es_urdf_is_the_built_in_one() -> None:
    chain, robot = read_chain(read_model(arm_urdf("ur5e")), "base_link", "tool0"), load_robot()
    assert np.array_equal(chain.T_parent_joint, robot.T_parent_joint)
    assert np.array_equal(chain.T_last_flange, robot.T_wrist3_flange)
    assert np.array_equal(chain.effort, robot.max_torque)


def test_the_chain_of_the_ur3es_urdf_is_the_shipped_one() -> None:
    chain, robot = read_chain(read_model(arm_urdf("ur3e")), "base_link", "tool0"), load_robot("ur3e_2f85")
    moving, dynamics = chain.links[1:], robot.dynamics
    read = (chain.T_parent_joint, chain.T_last_flange, chain.lower, chain.upper, chain.velocity, chain.effort)
    kept = (robot.T_parent_joint, robot.T_wrist3_flange, robot.lower, robot.upper, robot.max_velocity, robot.max_torque)
    read += tuple(np.array([getattr(link, name) for link in moving]) for name in ("mass", "com", "inertia"))
    kept += (dynamics.mass, dynamics.com, dynamics.inertia)
    assert all(np.abs(a - b).max() < 1e-12 for a, b in zip(read, kept, strict=True))


def test_a_mesh_in_millimetres_and_too_many_meshes_are_refused_before_they_are_covered(tmp_path, monkeypatch) -> None:
    trimesh.creation.box((100, 100, 900)).export(tmp_path / "a.stl")
    text = URDF.format(mesh="a.stl", kind="revolute")
    for link, words in (("", "900 m long"), ('scale="0.001 0.001 0.001"', None), ('scale="0 0 0"', "0 m long")):
        (tmp_path / "one.urdf").write_text(text.replace('"a.stl"', f'"a.stl" {link}'))
        with one_line(words) if words else nullcontext():
            read_arm(tmp_path / "one.urdf", "base", "hand")
    visual = text[text.index("<visual>") : text.index("</link>")]
    (tmp_path / "one.urdf").write_text(text.replace(visual, 3 * visual))
    monkeypatch.setattr(robot_links, "MAX_MESHES", 2)  # each is read by a process of its own
    with one_line("more than 2 visual meshes"):
        read_arm(tmp_path / "one.urdf", "base", "hand")
