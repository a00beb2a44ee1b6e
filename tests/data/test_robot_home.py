"""Where an imported arm starts: free postures, flanges that are turned, what a refusal says."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import one_line
from robot_files import write_urdf
from scipy.spatial.transform import Rotation

from r2h_batch.config import Workplace
from r2h_batch.data import robot as importer
from r2h_batch.data import robot_home, robot_shapes
from r2h_batch.data.robot import import_robot
from r2h_batch.data.robot_chain import read_chain
from r2h_batch.data.robot_home import free_home, homes, turn_of, turned, usual_place
from r2h_batch.data.robot_model import read_model
from r2h_batch.scene.robot import ee_pose, forward_kinematics, frozen
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot
from r2h_batch.scene.robot_visuals import arm_urdf

ACROSS = {'<joint name="f" type="fixed"><parent link="l7"/><child link="flange"/><origin xyz="0 0 0.07"/>': (
    '<joint name="f" type="fixed"><parent link="l7"/><child link="flange"/><origin xyz="0 0 0.07" rpy="0 -1.5707963 0"/>'
)}  # fmt: skip


def made(path, **more):
    return import_robot(path, **{"name": "made", "base": "base", "flange": "flange", "packages": {}} | more)


@pytest.fixture(scope="module", autouse=True)
def coarse():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(importer, "POSTURES", 500)
        patch.setattr(robot_shapes, "PROTRUSION_SPACING_M", 2e-3)
        yield


def test_postures_have_the_tcp_where_they_say_and_lie_within_limits():
    robot = load_robot("panda_hand")
    places = [usual_place(robot)[:3, 3] + [0, 0, up * robot.reach_m] for up in (0.0, 0.15)]
    found = list(homes(robot))
    for q in each_of(found, 12):
        at = ee_pose(robot, np.array(q))
        assert (robot.lower <= q).all() and (q <= robot.upper).all()
        tilt = np.degrees(np.arccos(np.clip(-at[2, 2], -1, 1)))
        assert min(abs(tilt - x) for x in (0, 45, 90)) < 0.05
    first = ee_pose(robot, np.array(found[0]))
    assert np.abs(first[:3, 3] - places[0]).max() < 2e-4 and first[2, 2] == pytest.approx(-1, abs=1e-6)


def each_of(found, least):
    assert len(found) >= least
    return found


def test_a_ur_starts_in_the_posture_of_a_ur():
    usual = load_robot(DEFAULT_ROBOT)
    assert next(homes(usual)) == pytest.approx(usual.home_q, abs=1e-4)


def test_home_is_the_first_posture_without_overlap(monkeypatch):
    robot, seen = load_robot("panda_hand"), []

    class Look:
        def __init__(self, *_):
            pass

        def __call__(self, q):
            seen.append(tuple(q))
            return ["l3 and gripper"] if len(seen) < 4 else []

    monkeypatch.setattr(robot_home, "Touching", Look)
    assert free_home(robot, Workplace(), "arm.urdf") == seen[-1] and len(set(seen)) == 4
    monkeypatch.setattr(Look, "__call__", lambda *_: ["l3 and gripper", "l1 and table"])
    with one_line(
        r"arm.urdf: \d+ postures .* were tried: links overlap in each, most often l3 and gripper; give one with"
    ):
        free_home(robot, Workplace(), "arm.urdf")


def test_a_flange_whose_z_points_across_is_refused_with_the_turn_and_yes_takes_it(tmp_path, monkeypatch):
    path = write_urdf(tmp_path, **ACROSS)
    with monkeypatch.context() as patch:
        patch.setattr(importer, "bodies_of", lambda *_: pytest.fail("a body was fitted"))
        with one_line(
            "the z of --flange .*: --offset=0,0,0,0,1.5708,0 turns it there, --yes takes that, --offset=0,0,0,0,0,0 keeps"
        ):
            made(path)
    straight = made(write_urdf(tmp_path)).robot
    turned = made(write_urdf(tmp_path, **ACROSS), turn=True)
    assert turned.report["offset"] == "0,0,0,0,1.5708,0"
    one, other = straight.T_wrist3_flange, turned.robot.T_wrist3_flange
    assert np.abs(one[:3, 2] - other[:3, 2]).max() < 1e-6 and np.abs(one[:3, 3] - other[:3, 3]).max() < 1e-9


@pytest.mark.parametrize("arm", ["ur3e", "ur5e"])
def test_the_tool0_of_a_ur_points_away_although_the_last_link_lies_behind_it(arm):
    """Its flange is the origin of the last joint, and the link's mass is 2 cm nearer to the arm."""
    path, robot = arm_urdf(arm), load_robot(f"{arm}_2f85")
    chain = read_chain(read_model(path), "base_link", "tool0")
    assert chain.links[-1].com[2] < -0.01 and np.abs(chain.T_last_flange - np.eye(4)).max() == 0
    assert turn_of(robot, chain) == ""
    away = replace(chain, T_last_flange=chain.T_last_flange @ turned("0,0,0,3.1416,0,0"))
    inwards = replace(robot, T_wrist3_flange=frozen(away.T_last_flange), digest="turned into the arm")
    assert turn_of(inwards, away) == "0,0,0,3.1416,0,0"


def test_a_wrist_that_ends_in_a_joint_across_it_is_turned_along_the_hand():
    """The axis of such a joint points across; both directions fit the axes of the link, and the arm has a posture for both."""
    robot = load_robot("ur5e_2f85")
    chain = read_chain(read_model(arm_urdf("ur5e")), "base_link", "tool0")
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # y along the joint's axis, z across it
    T[:3, 3] = 0, 0.1, 0
    across = replace(chain, T_last_flange=T)
    assert abs(T[2, 1]) == 1 and abs(T[:3, 2] @ [0, 1, 0]) == 1
    out = replace(robot, T_wrist3_flange=frozen(T), digest="a hand across the last joint")
    assert turn_of(out, across) == "0,0,0,3.1416,0,0"


def test_offsets_turn_z_as_their_table_says():
    for offset, (axis, sign) in robot_home.TURNS.items():
        R = robot_home.turned(offset)[:3, :3]
        given = Rotation.from_euler("xyz", [float(x) for x in offset.split(",")[3:]]).as_matrix()
        assert np.abs(R - given).max() < 1e-3 and R[:, 2].tolist() == [sign * float(k == axis) for k in range(3)]


def test_a_largest_moment_above_the_sum_of_the_others_is_the_sum(tmp_path):
    old = 'ixx="0.01" ixy="0" ixz="0" iyy="0.012" iyz="0" izz="0.008"'
    with pytest.warns(UserWarning, match="is above the sum of the others, as of no body: taken as the sum"):
        robot = made(write_urdf(tmp_path, **{old: old.replace("0.012", "0.02")})).robot
    moments = np.linalg.eigvalsh(robot.dynamics.inertia)
    assert moments[:, 2] == pytest.approx(moments[:, 0] + moments[:, 1], rel=1e-6) and moments[0, 2] == pytest.approx(
        0.018
    )
    with one_line("is not a body: mass 1.5 kg"):
        made(write_urdf(tmp_path, **{old: old.replace("0.012", "0.03")}))


def test_an_arm_whose_shoulder_is_in_the_table_is_refused_before_any_search(tmp_path, monkeypatch):
    """Joints 1 and 2 at the height of the base: the rod between them lies on the table's top at every posture."""
    joint = '<joint name="j{}" type="revolute"><parent link="{}"/><child link="l{}"/><origin xyz="{}"/>'
    low = {joint.format(2, "l1", 2, "0 0 0.18"): joint.format(2, "l1", 2, "0.1 0 0")}
    low |= {joint.format(1, "base", 1, "0 0 0.15"): joint.format(1, "base", 1, "0 0 0")}
    path = write_urdf(tmp_path, **low)
    monkeypatch.setattr(robot_home, "_led_to", lambda *_: pytest.fail("a posture was searched"))
    with one_line("l2 and table overlap in each of 256 postures drawn at random; .* give a --base below this link"):
        made(path)


def test_corners_of_a_mesh_in_the_table_are_found_before_bodies_are_fitted():
    robot, table = load_robot("panda_hand"), Workplace()
    top = table.table_center[2] + table.table_half[2]
    first = next(homes(robot))
    T = forward_kinematics(robot, np.array(first))
    k = robot.table_from
    inside = np.array([table.table_center[0], table.table_center[1], top - 0.001])
    meshes = [np.full((1, 3, 3), 0.001)] * len(robot.links[:-1])
    touching = [*meshes]
    touching[k] = np.tile((inside - T[k, :3, 3]) @ T[k, :3, :3], (1, 3, 1))
    assert free_home(robot, table, "arm.urdf", meshes) == first
    assert free_home(robot, table, "arm.urdf", touching) != first


WALL = '<visual><origin xyz="0.6 0 0.4"/><geometry><box size="{} 1.4 2.0"/></geometry></visual>'
"""A wall of the base: the gripper is in it in each posture to start from, and beside it in others."""


def with_wall(depth: float) -> dict[str, str]:
    base = '<link name="base"><visual>'
    return {base: base.replace("<visual>", WALL.format(depth) + "<visual>")}


def test_an_arm_whose_gripper_meets_a_link_in_each_posture_is_refused_before_all_links_are_fitted(
    tmp_path, monkeypatch
):
    fitted, of_a_link = [], importer.bodies_of

    def told(link, *more):
        fitted.append(link.name)
        return of_a_link(link, *more)

    monkeypatch.setattr(importer, "bodies_of", told)
    with one_line(r"\d+ postures .* were tried: links overlap in each, most often base and gripper; give one with"):
        made(write_urdf(tmp_path, **with_wall(0.9)))
    assert fitted == ["base"]


@pytest.mark.whole(part="data")
def test_a_link_that_the_gripper_meets_in_some_postures_alone_is_fitted_once_with_the_others(tmp_path, monkeypatch):
    """This wall ends below the places that are tried after the usual one."""
    fitted, of_a_link = [], importer.bodies_of
    usual = made(write_urdf(tmp_path)).robot.home_q
    monkeypatch.setattr(
        importer, "bodies_of", lambda link, *more: (fitted.append(link.name), of_a_link(link, *more))[1]
    )
    low = with_wall(0.9)
    path = write_urdf(tmp_path, **{old: new.replace("0.6 0 0.4", "0.6 0 -0.52") for old, new in low.items()})
    assert made(path).robot.home_q != usual and fitted == ["base", *(f"l{k}" for k in range(1, 8))]


@pytest.mark.whole(part="data")
def test_a_link_that_always_meets_the_gripper_is_no_reason_to_refuse(tmp_path):
    """Such a pair is not checked: here l6 holds a ball that reaches past the flange in every posture."""
    ball = '<sphere radius="0.045"/>'
    robot = made(write_urdf(tmp_path, **{ball: ball.replace("0.045", "0.2")})).robot
    k = robot.links.index("l6")
    assert [k, len(robot.links) - 1] not in robot.self_pairs.tolist()
