"""Robots out of a URDF or an MJCF: both say the same robot, the file's shapes are its bodies, bad files say why."""

import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from needs import needs
from refusals import one_line
from robot_files import read_arm, write_mjcf, write_urdf

from r2h_batch.__main__ import main
from r2h_batch.config import Workplace
from r2h_batch.data import robot as importer
from r2h_batch.data import robot_shapes
from r2h_batch.data.robot import import_robot
from r2h_batch.data.robot_pairs import touching
from r2h_batch.data.robot_srdf import read_srdf
from r2h_batch.scene.robot import ShapeKind, ee_pose
from r2h_batch.scene.robot_file import read_robot, robot_arrays, robot_file

HAND = ("left_finger", "right_finger")
READY = (0.0, -0.9, 0.0, 2.3, 0.0, -1.74, 0.0)


def made(path: Path, **more):
    return import_robot(path, name="made", base="base", flange="flange", packages={}, fingers=HAND, **more)


@pytest.fixture(scope="module", autouse=True)
def coarse():
    """Few samples suffice for plain shapes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importer, "POSTURES", 500)
        patch.setattr(robot_shapes, "PROTRUSION_SPACING_M", 2e-3)
        yield


@pytest.fixture(scope="module")
def arm(coarse, tmp_path_factory):
    return made(write_urdf(tmp_path_factory.mktemp("arm")))


def test_a_urdf_and_an_mjcf_of_one_arm_give_one_robot(arm, tmp_path):
    by_urdf, report, _ = arm
    by_mjcf, *_ = made(write_mjcf(tmp_path), home=by_urdf.home_q)
    one, other = robot_arrays(by_urdf), robot_arrays(by_mjcf)
    assert one.keys() == other.keys() and all(np.abs(one[name] - other[name]).max() < 1e-9 for name in one)
    assert robot_file(by_urdf) == robot_file(by_mjcf)
    kinds = [ShapeKind(k).name for k in by_urdf.arm.kind]
    assert kinds == ["CYLINDER", "CYLINDER", "CAPSULE", "CYLINDER", "BOX", "HULL", "CAPSULE", "CYLINDER"]
    assert by_urdf.open_gap_m == pytest.approx(0.08) and report["links"]["l2"]["from"] == "shapes of the file"


def test_an_mjcfs_frames_angles_includes_and_anchors_are_read(tmp_path):
    usual, _ = read_arm(write_mjcf(tmp_path), bare=True)
    # the body is turned by 45 degrees, which ref takes back; its joint's anchor lies 30 mm along its z
    (tmp_path / "motors.xml").write_text('<mujoco><actuator><motor joint="j7" ctrlrange="-33 33"/></actuator></mujoco>')
    changes = {
        '<body name="l2" pos="0 0 0.18"': '<frame pos="0 0 0.1"><body name="l2" pos="0 0 0.05" euler="0 45 0"',
        '<body name="l3"': '<body name="l3_"><body name="l3"',
        '<joint name="j2"': '<joint name="j2" pos="0 0 0.03" ref="45"',
        "</body></body></worldbody>": "</body></frame></body></body></worldbody>",
        "<sensor/>": '<include file="motors.xml"/>',
    }
    path = write_mjcf(tmp_path, **changes)
    read, _ = read_arm(path, bare=True)
    assert read.joints == usual.joints and read.effort[6] == 33
    assert read.T_parent_joint[1][:3, 3] == pytest.approx([0.03 * 0.5**0.5, 0, 0.15 + 0.03 * 0.5**0.5])
    assert np.abs(read.T_parent_joint[1][:3, :3] - usual.T_parent_joint[1][:3, :3]).max() < 1e-9
    anchor = usual.T_parent_joint[1][:3, :3].T @ [0, 0, 0.03]
    assert np.abs(read.links[2].com - usual.links[2].com + anchor).max() < 1e-9


def test_a_cylinder_between_two_balls_is_a_capsule_and_bad_collision_shapes_are_not_used(tmp_path):
    own = '<collision><origin xyz="0 0 0.09"/><geometry><capsule radius="0.05" length="0.12"/></geometry></collision>'
    ball = '<visual><origin xyz="0 0 {}"/><geometry><sphere radius="0.05"/></geometry></visual>'
    tube = '<visual><origin xyz="0 0 0.09"/><geometry><'
    changes = {own: own + ball.format("0.03") + ball.format("0.15"), f"{tube}capsule": f"{tube}cylinder"}
    (shape,) = read_arm(write_urdf(tmp_path, **changes), bare=True)[1][2].shapes
    assert shape.kind == "capsule" and np.allclose(shape.size, [0.05, 0.06])
    mesh = '<mesh filename="parts/block.stl" scale="0.001 0.001 0.001"/></geometry></collision>'
    for side, source, note in ((0.0702, "collision shapes of the file", False), (0.06, None, True)):
        box = f'<box size="{side} 0.0702 0.1802"/></geometry></collision>'
        row = made(write_urdf(tmp_path, **{mesh: box}), home=READY).report["links"]["l5"]
        assert row.get("from") == source and ("not_used" in row) == note
        assert row["mean_mm"] < 3 and row["worst_protrusion_mm"] <= 0.1


BAD = {
    '<!DOCTYPE m [<!ENTITY a "b">]><mujoco model': ("<mujoco model", "declares a document type"),
    '<body name="base"><replicate count="1000000000"/>': ('<body name="base" pos="0 0 0">', "<replicate> is not read"),
    '<include file="made.xml"/><compiler': ("<compiler", "more than 16 includes"),
    'file="/etc/block.stl"': ('file="block.stl"', "points outside the folder"),
    'name="j3" type="slide"': ('name="j3"', "j3 is prismatic"),
    '<equality><joint joint1="j3" joint2="j2"/></equality><actuator': ("<actuator", "j3 is a mimic joint"),
    2000 * "<body>" + 2000 * "</body>": ('<light pos="0 0 3"/>', "nested too deeply"),
    'pos="inf 0 0"': ('pos="0 0 0.18"', "is not finite"),
    'mass="nan"': ('mass="1.5"', "MuJoCo: "),
}  # fmt: skip


@pytest.mark.parametrize("new", BAD, ids=lambda text: text[:40])
def test_a_bad_mjcf_is_refused_in_one_line(new, tmp_path):
    old, words = BAD[new]
    with one_line(words):
        read_arm(write_mjcf(tmp_path, **{old: new}), bare=True)


SRDF = """<robot name="made"><disable_collisions link1="base" link2="l3" reason="Never"/>
<disable_collisions link1="l6" link2="left_finger" reason="Adjacent"/><disable_collisions link1="other" link2="l3"/>
<group_state name="ready" group="arm">{joints}</group_state><group_state name="part" group="arm"/></robot>"""


def srdf_of(folder: Path, posture=READY) -> Path:
    joints = "".join(f'<joint name="j{k + 1}" value="{x}"/>' for k, x in enumerate(posture))
    (folder / "made.srdf").write_text(SRDF.format(joints=joints))
    return folder / "made.srdf"


def test_an_srdf_is_compared_and_gives_a_posture(tmp_path):
    robot, report, _ = made(write_urdf(tmp_path), srdf=srdf_of(tmp_path), home="ready")
    assert robot.home_q == READY
    checked = {tuple(robot.links[k] for k in pair) for pair in robot.self_pairs}
    both = report["srdf"]["off_but_checked"], report["srdf"]["on_but_not_checked"]
    assert ("base", "l3") in checked and both[0]["base - l3"].endswith("the SRDF: Never")
    assert all(("l6 - gripper" in part) == inside for part, inside in zip(both, (("l6", "gripper") in checked, False)))
    assert both[1].keys() == {
        f"{a} - {b}" for i, a in enumerate(robot.links) for b in robot.links[i + 1 :]
        if (a, b) not in checked | {("l6", "gripper")}
    }  # fmt: skip


@pytest.mark.parametrize(
    ("home", "words"),
    [
        ("part", "no state of the SRDF that has all joints; those are: ready"),
        ((0.0,) * 6, "--home has 6 numbers; .* has 7 joints"),
        ((0.0, 0.9, 0.0, 2.2, 0.0, 0.0, 0.0), "made.urdf: [^,]* and table"),
        ((0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0), "outside the joint limits"),
    ],
)
def test_a_home_that_cannot_be_one_is_refused_in_one_line(home, words, tmp_path):
    with one_line(words):
        made(write_urdf(tmp_path), srdf=srdf_of(tmp_path), home=home)


def test_what_overlaps_is_named_with_the_gripper_open_or_closed(arm):
    robot, home = arm.robot, np.array(arm.robot.home_q)
    T = ee_pose(robot, home)
    assert not touching(robot, home, Workplace())
    for y, words in ((0.0, "gripper and table (gripper closed)"), (0.046, "gripper and table (gripper open)")):
        at = T[:3, 3] + y * T[:3, 1]
        assert touching(robot, home, Workplace(table_center=tuple(at.tolist()), table_half=(1e-3,) * 3)) == [words]
    assert touching(robot, home, Workplace(table_center=(0.0, 0.0, 0.3))) and not touching(robot, home)


@needs("gl")
def test_the_command_writes_a_robot_and_tells_what_it_is(arm, tmp_path, capsys, monkeypatch):
    assumed = arm._replace(report=arm.report | {"assumed_speed": list(arm.report["joints"])})
    monkeypatch.setattr(importer, "import_robot", lambda *_, **__: assumed)
    out = tmp_path / "made"
    line = ["import", "robot", "--base", "base", "--flange", "flange", "--out"]
    assert main([*line, str(out), "--mjcf", "made.xml"]) == 0
    told = capsys.readouterr().out
    robot, report = read_robot(out), json.loads((out / "report.json").read_text())
    assert robot.ik_missed == (10_000, report["ik_missed"]) and report["ik_missed"] < 50
    assert f"numerical, {report['ik_missed']} of 10000 reachable poses missed" in told
    for words in (
        "not checked: base - l1: neighbours",
        "j4: -2.600 to 2.600 rad, 2 rad/s, 80 N m",
        "none of j1, j2, j3, j4, j5, j6, j7: 2 rad/s",
    ):
        assert words in told
    text = (out / "robot.yaml").read_text()
    (out / "robot.yaml").write_text(text.replace(f"ik_missed: [10000, {report['ik_missed']}]", "ik_missed: [7, 1]"))
    assert read_robot(out) == robot and read_robot(out).ik_missed == (7, 1)
    image = imageio.imread(out / "home.png")
    seen = (image < 250).any(2)
    assert image.shape == (640, 1280, 3) and min(seen[:, :640].mean(), seen[:, 640:].mean()) > 0.02
    assert main([*line, str(tmp_path / "x"), "--urdf", "a.urdf", "--mjcf", "a.xml"]) == 2
    assert "--urdf FILE, as --mjcf FILE or as --from PACKAGE:NAME" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('<!DOCTYPE r [<!ENTITY a "b">]>' + SRDF, "declares a document type"),
        ("<mujoco/>", "an SRDF has <robot>"),
        (SRDF.replace('link1="base"', ""), "needs link1 and link2"),
        (SRDF.replace("{joints}", '<joint name="j1" value="soon"/>'), "has no value in rad"),
    ],
)
def test_a_bad_srdf_is_refused_in_one_line(text, words, tmp_path):
    (tmp_path / "made.srdf").write_text(text)
    with one_line(words):
        read_srdf(tmp_path / "made.srdf")
