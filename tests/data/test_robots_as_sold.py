"""Robots as they are sold: sites and offsets as flanges, missing torques, loops, fitted shapes, pads from meshes, COLLADA."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from grasp_cases import model_of
from refusals import one_line
from robot_files import ARM, read_arm, write_mjcf, write_urdf

from r2h_batch.data import robot as robot_import
from r2h_batch.data import robot_links, robot_shapes
from r2h_batch.data.robot_chain import at_flange, read_chain, read_fingers
from r2h_batch.data.robot_links import Meshes, files_of, link_of
from r2h_batch.data.robot_model import read_model
from r2h_batch.data.robot_pads import Window
from r2h_batch.judge.grasp import close_gripper, gripper_poses
from r2h_batch.scene.grasp_tables import grasp_tables
from r2h_batch.scene.mesh_import import file as mesh_file
from r2h_batch.scene.robot import gripper_primitives_at
from r2h_batch.scene.robot_file import load_robot, read_robot, write_robot


def turned(x: float = 0.0, y: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    T[:3, 3] = x, y, z
    return T


def test_a_site_or_a_link_with_an_offset_is_a_flange(tmp_path):
    site = '<site name="tool" pos="0.01 0 0.02" euler="0 90 0"/>'
    path = write_mjcf(tmp_path, **{'<body name="flange"': f'{site}<body name="flange"'})
    model = read_model(path)
    by_site, name = at_flange(model, "tool", np.eye(4), bare=False)
    chain = read_chain(by_site, "base", name)
    assert np.abs(chain.T_last_flange - turned(0.01, 0, 0.02, np.pi / 2)).max() < 1e-9
    offset = turned(0.03, 0, 0, np.pi / 2)
    by_link, name = at_flange(model, "l7", offset, bare=False)
    with pytest.warns(UserWarning, match="without flange and what it carries: the 2F-85 replaces it"):
        chain = read_chain(by_link, "base", name)
    assert np.abs(chain.T_last_flange - offset).max() < 1e-9
    # with the file's gripper the link carries nothing but itself, and the fingers stay where they are
    model, name = at_flange(model, "l7", offset, bare=True)
    bare, usual = read_chain(model, "base", name, bare=True), read_fingers(read_model(path), "flange", PADS)
    assert bare.links[-1].members == ("l7",) and bare.links[-1].mass == 1.5
    moved = read_fingers(model, name, PADS)
    for one, other in zip(moved.parts, usual.parts, strict=True):
        assert np.abs(offset @ one.T - turned(0, 0, 0.07) @ other.T).max() < 1e-9
    with one_line("--flange hand is not a link or site; the last are .*, tool"):
        at_flange(read_model(path), "hand", np.eye(4), bare=False)


PADS = ("left_finger", "right_finger")


def test_another_gripper_replaces_that_of_the_file_wherever_it_hangs_at_the_last_link(tmp_path):
    model = read_model(write_urdf(tmp_path))
    kept = read_chain(model, "base", "flange")
    assert "flange" in kept.links[-1].members and kept.replaced == ()  # what carries the new gripper stays
    by_offset, name = at_flange(model, "l7", turned(z=0.07), bare=False)
    for at, named in ((model, "l7"), (by_offset, name)):
        with pytest.warns(UserWarning, match="without flange and what it carries: the 2F-85 replaces it"):
            chain = read_chain(at, "base", named)
        assert chain.replaced == ("flange",), "it carries the fingers"
        assert not {"flange", *PADS} & {*chain.links[-1].members}
    fingers = {name: replace(link, joint=None) for name, link in model.links.items() if name in PADS}
    tool = replace(model, links={**model.links, **fingers})  # a tool that nothing moves is no gripper
    chain = read_chain(tool, "base", "l7")
    assert chain.replaced == () and {"flange", *PADS} <= {*chain.links[-1].members}


def test_joints_without_a_torque_get_what_holds_the_stretched_arm_twice(tmp_path):
    motor = '<motor joint="j2" ctrlrange="-40.0 40.0" gear="2"/>'
    chain, _ = read_arm(write_mjcf(tmp_path, **{motor: '<position joint="j2" kp="100"/>'}))
    assert chain.assumed == ("j2",) and chain.effort[0] == 80
    lengths = [np.linalg.norm(ARM[k][0]) for k in range(2, 7)]
    at = np.cumsum([0.0, *lengths])
    moment = sum(link.mass * (a + np.linalg.norm(link.com)) for link, a in zip(chain.links[2:], at, strict=True))
    moment += 2.0 * (at[-1] + 0.07)
    assert chain.effort[1] == pytest.approx(2 * 9.81 * moment)
    (tmp_path / "u").mkdir()
    no_effort, _ = read_arm(write_urdf(tmp_path / "u", **{' effort="80"': ""}))
    assert no_effort.assumed == ("j1", "j2", "j3", "j4") and no_effort.effort[1] == pytest.approx(chain.effort[1])


LOOP = """<mujoco><compiler angle="radian"/><worldbody><body name="hand"><geom type="box" size="0.04 0.04 0.02" mass="0.3"/>
{fingers}</body></worldbody><equality>
<connect body1="left_pad" body2="left_bar" anchor="0 0 {end}"/><connect body1="right_pad" body2="right_bar" anchor="0 0 {end}"/>
<joint joint1="right_crank" joint2="left_crank" polycoef="0 1 0 0 0"/></equality></mujoco>"""
FINGER = """<body name="{side}_link" pos="0 {y}0.02 0.05" {turn}><joint name="{side}_crank" axis="-1 0 0" range="0 0.8"/>
<geom type="box" size="0.004 0.002 0.02" pos="0 0 0.02" mass="0.02"/>
<body name="{side}_pad" pos="0 0 0.05"><joint name="{side}_pin" axis="1 0 0" range="-1 1"/>
<geom type="box" size="0.01 0.004 0.015" pos="0 0.005 0.02" mass="0.02"/></body></body>
<body name="{side}_bar" pos="0 {y}{inner} 0.05" {turn}><joint name="{side}_bar" axis="-1 0 0" range="-1 1"/>
<geom type="box" size="0.002 0.002 0.02" pos="0 0 0.02" mass="0.01"/></body>"""


def write_loop(folder: Path, **changes: str) -> Path:
    """Two parallelograms: cranks and bars of 50 mm, the bars 10 mm further in, pads between their ends."""
    sides = (("left", "", 'euler="0 0 0"'), ("right", "-", 'euler="0 0 3.141592653589793"'))
    fingers = "".join(FINGER.format(side=s, y=y, turn=turn, inner="0.01") for s, y, turn in sides)
    text = LOOP.replace("{fingers}", fingers)
    # the bars end where the pads' own points 10 mm further in are
    text = text.replace('anchor="0 0 {end}"', 'anchor="0 -0.01 0"')
    for old, new in changes.items():
        assert old in text, old
        text = text.replace(old, new)
    (folder / "loop.xml").write_text(text)
    return folder / "loop.xml"


def test_the_loops_of_a_gripper_close_and_its_pads_stay_parallel(tmp_path):
    model = read_model(write_loop(tmp_path))
    fingers = read_fingers(model, "hand", ("left_pad", "right_pad"))
    pad = next(p for p in fingers.parts if p.name == "left_pad")
    angle = np.linspace(0.0, 0.8, len(pad.T))
    angle = angle if pad.T[-1, 1, 3] > pad.T[0, 1, 3] else angle[::-1]
    # closed form: a crank of 50 mm about its pivot, the pad not turned
    away = np.stack([0 * angle, 0.02 + 0.05 * np.sin(angle), 0.05 + 0.05 * np.cos(angle)], 1)
    assert np.abs(pad.T[:, :3, 3] - away).max() < 1e-6 and np.abs(pad.T[:, :3, :3] - np.eye(3)).max() < 1e-5
    bar = next(p for p in fingers.parts if p.name == "left_bar")
    crank = next(p for p in fingers.parts if p.name == "left_link")
    assert np.abs(bar.T[:, :3, :3] - crank.T[:, :3, :3]).max() < 1e-5


def test_pads_of_a_loop_that_stop_apart_stand_where_the_crank_has_them_and_hold_nothing_thinner(tmp_path):
    """Closed form: cranks of 50 mm, 20 mm out. At angle 0 the pads' faces are 42 mm apart, and stop."""
    model = read_model(write_loop(tmp_path))
    pads = ("left_pad", "right_pad")
    fingers = read_fingers(model, "hand", pads)
    meshes = Meshes(model, [*files_of(fingers.palm), *(g for p in fingers.parts for g in p.shown)], {})
    fields, _, _ = robot_import.gripper_of(fingers, pads, 6, meshes)
    made = replace(load_robot(), name="loop", digest="loop", **fields)
    write_robot(tmp_path / "loop", made)
    stop, opened = 0.042, 0.042 + 0.1 * np.sin(0.8)
    gap = np.array([stop, 0.05, 0.071, 0.09, opened])
    sine = (gap / 2 - 0.021) / 0.05
    height = 0.05 + 0.05 * np.sqrt(1 - sine**2)
    for robot in (made, read_robot(tmp_path / "loop")):
        assert (robot.closed_gap_m, robot.open_gap_m) == pytest.approx((stop, opened), abs=1e-6)
        # 30 um: chords of the arc between 65 samples
        T = np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee @ gripper_primitives_at(robot, gap)
        for i in np.flatnonzero(np.array(robot.gripper_part) == "pad"):
            side = robot.gripper_side[i]
            assert np.allclose(T[:, i, 1, 3], side * (gap / 2 + 0.004), atol=1e-6)
            assert np.allclose(T[:, i, 2, 3], height + 0.02, atol=3e-5)
            assert np.allclose(T[:, i, :3, :3], np.diag([side, side, 1]), atol=1e-6)
        # the cranks' boxes of 4 mm turn about their pivots
        cranks = [i for i, size in enumerate(robot.gripper.size) if np.allclose(size, [0.004, 0.002, 0.02])]
        assert len(cranks) == 2
        for i in cranks:
            side = robot.gripper_side[i]
            y, z = side * (0.02 + 0.02 * sine), 0.05 + 0.02 * np.sqrt(1 - sine**2)
            assert np.allclose(T[:, i, 1, 3], y, atol=3e-5) and np.allclose(T[:, i, 2, 3], z, atol=3e-5)
        _, p = gripper_poses(robot, torch.from_numpy(gap).float())
        assert np.abs(p.numpy() - gripper_primitives_at(robot, gap)[..., :3, 3]).max() < 1e-6
        boxes = [trimesh.creation.box((0.05, width, 0.06)) for width in (0.030, 0.041, 0.043, 0.060)]
        tables = grasp_tables([model_of(box) for box in boxes], robot)
        held = close_gripper(tables, torch.eye(4).repeat(4, 1, 1), torch.arange(4, dtype=torch.int32))
        assert held.width_m.tolist() == pytest.approx([0.030, 0.041, 0.043, 0.060], abs=2e-5)
        assert held.opening_m.tolist() == pytest.approx([stop, stop, 0.043, 0.060], abs=2e-5)
        assert ((held.width_m - stop) > 0).tolist() == [False, False, True, True]
        assert held.margin_m[:2].tolist() == pytest.approx([-0.012, -0.001], abs=2e-5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({'<joint joint1="right_crank" joint2="left_crank" polycoef="0 1 0 0 0"/>': ""}, "needs a motor"),
        ({'name="left_pin" axis="1 0 0" range="-1 1"': 'name="left_pin" axis="1 0 0" range="-0.1 0.1"'}, "stay open"),
    ],
)
def test_a_loop_that_nothing_drives_or_that_does_not_close_is_refused_in_one_line(changes, words, tmp_path):
    with one_line(words):
        read_fingers(read_model(write_loop(tmp_path, **changes)), "hand", ("left_pad", "right_pad"))


def test_a_shape_fitted_to_a_mesh_is_measured(tmp_path):
    fitted = {'<geom class="seen" type="mesh" mesh="block"': '<geom class="seen" type="box" mesh="block"'}
    _, links = read_arm(write_mjcf(tmp_path, **fitted))
    (shape,) = links[5].shapes
    assert shape.kind == "box" and np.allclose(np.sort(shape.size), [0.035, 0.035, 0.09], atol=1e-6)
    assert np.allclose(shape.pos, [0, 0, 0.09], atol=1e-6)


JAWS = """<robot name="jaws"><link name="flange"><visual><geometry><box size="0.1 0.1 0.05"/></geometry></visual>{mass}</link>
<link name="l"><visual><geometry><mesh filename="finger.stl"/></geometry></visual>{mass}</link>
<link name="r"><visual><origin rpy="0 0 3.141592653589793"/>
<geometry><mesh filename="finger.stl"/></geometry></visual>{mass}</link>
<joint name="one" type="prismatic"><parent link="flange"/><child link="l"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
{limit}</joint>
<joint name="two" type="prismatic"><parent link="flange"/><child link="r"/><origin xyz="0 0 0.1"/><axis xyz="0 -1 0"/>
{limit}</joint></robot>"""
MASS = '<inertial><mass value="0.2"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
LIMIT = '<limit lower="0" upper="0.04" velocity="1" effort="1"/>'


def jaws_of(folder: Path, window: Window | None = None):
    """Fingers of a bar 12 mm thick, whose end of 20 mm by 16 mm stands 3 mm further in and is the pad."""
    bar = trimesh.creation.box((0.02, 0.012, 0.06), trimesh.transformations.translation_matrix((0, 0.011, 0.03)))
    tip = trimesh.creation.box((0.016, 0.010, 0.020), trimesh.transformations.translation_matrix((0, 0.007, 0.05)))
    trimesh.util.concatenate([bar, tip]).export(folder / "finger.stl")
    (folder / "jaws.urdf").write_text(JAWS.replace("{mass}", MASS).replace("{limit}", LIMIT))
    model = read_model(folder / "jaws.urdf")
    fingers = read_fingers(model, "flange", ("l", "r"))
    meshes = Meshes(model, [*files_of(fingers.palm), *(g for p in fingers.parts for g in p.shown)], {})
    return robot_import.gripper_of(fingers, ("l", "r"), 6, meshes, window)


def test_the_flats_of_two_fingers_that_face_each_other_are_the_pads(tmp_path):
    gripper, _, told = jaws_of(tmp_path)
    assert told["from"] == "flats of the meshes" and told["proud_mm"] < 1e-3
    assert (told["low_m"], told["high_m"], told["width_m"]) == pytest.approx((0.14, 0.16, 0.016), abs=1e-6)
    assert gripper["open_gap_m"] == pytest.approx(0.08 + 2 * 0.002) and gripper["gripper_part"].count("pad") == 2
    assert gripper["T_flange_ee"][2, 3] == pytest.approx(0.15)


def test_given_pads_replace_those_that_are_found(tmp_path):
    gripper, _, told = jaws_of(tmp_path, Window(0.105, 0.135, 0.018))
    assert told["from"] == "--pads" and told["high_m"] == 0.135
    assert gripper["open_gap_m"] == pytest.approx(0.08 + 2 * 0.005) and gripper["T_flange_ee"][2, 3] == pytest.approx(
        0.12
    )
    with one_line("no flats that face each other; give --pads=LOW,HIGH,WIDTH"):
        jaws_of(tmp_path, Window(0.3, 0.4, 0.02))


def test_collada_is_read_in_metres_or_the_collision_mesh_stands_in(tmp_path, monkeypatch):
    pytest.importorskip("collada")
    seen = '<visual><origin xyz="0 0 0.09"/><geometry><mesh filename="parts/block.'
    scaled = 'stl" scale="0.001 0.001 0.001"/>'
    path = write_urdf(tmp_path, **{seen + scaled: seen + 'dae"/>'})
    text = trimesh.exchange.dae.export_collada(trimesh.creation.box((7, 7, 18))).decode()
    assert "<unit" not in text
    (tmp_path / "parts" / "block.dae").write_text(text.replace("</asset>", '<unit meter="0.01"/></asset>', 1))
    sides = pytest.approx([0.07, 0.07, 0.18])
    _, links = read_arm(path, bare=True)
    assert links[5].meshed == 12 and np.ptp(links[5].triangles.reshape(-1, 3), axis=0) == sides
    monkeypatch.setattr(robot_links, "reads_collada", lambda: False)
    (tmp_path / "parts" / "block.dae").write_text("not read")
    _, links = read_arm(path, bare=True)
    assert np.ptp(links[5].triangles.reshape(-1, 3), axis=0) == sides


def test_a_collada_file_with_a_document_type_is_refused(tmp_path):
    pytest.importorskip("collada")
    (tmp_path / "a.dae").write_text('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/hostname">]><COLLADA>&b;</COLLADA>')
    with one_line("declares a document type", ValueError):
        mesh_file.load_robot_meshes([tmp_path / "a.dae"], "x")


def test_one_process_reads_all_meshes_and_a_bad_one_is_named(tmp_path, monkeypatch):
    calls = []
    read = mesh_file.read_in_child
    monkeypatch.setattr(mesh_file, "read_in_child", lambda *a, **k: calls.append(1) or read(*a, **k))
    for k in range(3):
        trimesh.creation.box((k + 1, 1, 1)).export(tmp_path / f"{k}.stl")
    paths = [tmp_path / f"{k}.stl" for k in range(3)]
    found = mesh_file.load_robot_meshes(paths, "x")
    assert len(calls) == 1 and [round(np.ptp(m.vertices[:, 0])) for m in found] == [1, 2, 3]
    (tmp_path / "1.stl").write_bytes(b"solid nothing")
    with one_line("1.stl", ValueError):
        mesh_file.load_robot_meshes(paths, "x")


def test_a_comment_about_xacro_is_not_a_program_and_a_file_finds_the_package_that_it_lies_in(tmp_path):
    folder = tmp_path / "made_description" / "urdf"
    folder.mkdir(parents=True)
    path = write_urdf(
        folder,
        **{
            "<robot": "<!-- made by xacro:macro --><robot",
            '"parts/block.stl"': '"package://made_description/urdf/parts/block.stl"',
        },
    )
    _, links = read_arm(path, bare=True)
    assert links[5].meshed == 12
    with one_line("--package other=FOLDER"):
        read_arm(write_urdf(folder, **{'"parts/block.stl"': '"package://other/block.stl"'}), bare=True)


def test_a_package_may_lie_beside_the_file_or_in_the_folder_of_a_package(tmp_path):
    """As wheels of simulators have it: xarm/xarm6.urdf beside xarm/xarm_description/."""
    around = tmp_path / "around"
    named = {'"parts/block.stl"': '"package://made/block.stl"'}
    (folder := around / "arms" / "one").mkdir(parents=True)
    path = write_urdf(folder, **named)
    (folder / "parts").rename(around / "made")
    with one_line("give --package made=FOLDER"):  # two folders above: nobody's package
        read_arm(path, bare=True)
    part = read_chain(read_model(path), "base", "flange").links[5]
    assert link_of(part, Meshes(read_model(path), files_of(part), {"around": around})).meshed == 12
    with one_line("give --package made=FOLDER"):
        link_of(part, Meshes(read_model(path), files_of(part), {"around": tmp_path / "other"}))
    (around / "made").rename(folder / "made")
    assert read_arm(path, bare=True)[1][5].meshed == 12
    for name in ("..", "."):
        with one_line("--package"):
            read_arm(write_urdf(folder, **{'"parts/block.stl"': f'"package://{name}/one/made/block.stl"'}), bare=True)


def test_a_mesh_named_by_an_absolute_url_is_read_below_the_files_folder_or_a_packages(tmp_path):
    def named(folder: Path, mesh: Path) -> Path:
        folder.mkdir(exist_ok=True)
        return write_urdf(folder, **{'"parts/block.stl"': f'"file:///{mesh}"'})

    here, beside = tmp_path / "urdf", tmp_path / "meshes"
    _, links = read_arm(named(here, here / "parts" / "block.stl"), bare=True)
    assert links[5].meshed == 12
    (here / "parts").rename(beside)
    path = named(here, beside / "block.stl")
    part = read_chain(read_model(path), "base", "flange").links[5]
    assert link_of(part, Meshes(read_model(path), files_of(part), {"made": tmp_path})).meshed == 12
    for mesh in (beside / "block.stl", here / ".." / "meshes" / "block.stl"):
        with one_line("is outside its folder; give the folder above it with --package NAME=FOLDER"):
            read_arm(named(here, mesh), bare=True)


TWICE = '<link name="l2"/><link name="base">'
BAD = {
    "link l3 has a mass of -1.5 kg": ('<link name="l3">', None),
    "two links are called l2": ('<link name="base">', TWICE),
    "link l5 has two parents, l4 and base": (
        "</robot>",
        '<joint name="k" type="fixed"><parent link="base"/><child link="l5"/></joint></robot>',
    ),
    "hangs in a circle of joints": (
        "</robot>",
        '<joint name="k" type="fixed"><parent link="left_finger"/><child link="base"/></joint></robot>',
    ),
    "<link> has 65 attributes; 64 are allowed": (
        "</robot>",
        "<link " + " ".join(f'a{k}="1"' for k in range(65)) + "/></robot>",
    ),
    "a link has no name": ("</robot>", "<link/></robot>"),
    "two joints are called j2": ('name="j3"', 'name="j2"'),
    "joint left_slide follows itself": (
        '<joint name="left_slide" type="prismatic">',
        '<joint name="left_slide" type="prismatic"><mimic joint="left_slide"/>',
    ),
}  # fmt: skip


@pytest.mark.parametrize("words", BAD)
def test_what_is_wrong_with_a_tree_is_named(words, tmp_path):
    old, new = BAD[words]
    path = write_urdf(tmp_path, **({} if new is None else {old: new}))
    if new is None:
        text = path.read_text()
        at = text.index('<mass value="1.5"', text.index(old))
        path.write_text(text[:at] + text[at:].replace('"1.5"', '"-1.5"', 1))
    with one_line(words):
        read_model(path)


def test_what_sticks_out_of_large_triangles_is_measured_in_bounded_memory(monkeypatch):
    """Halves of sides of 6 cm have 23,000 points 0.4 mm apart."""
    monkeypatch.setattr(robot_shapes, "POINTS_AT_ONCE", 30_000)
    mesh = trimesh.creation.box((0.06, 0.06, 0.02))
    sizes, whole = [], robot_shapes.lattice
    monkeypatch.setattr(robot_shapes, "lattice", lambda t, spacing: (p := whole(t, spacing), sizes.append(len(p)))[0])
    target = robot_shapes.Target(np.asarray(mesh.triangles), [])
    sizes.clear()
    ball = robot_shapes.Shape("capsule", np.zeros(3), np.eye(3), np.array([0.03, 0.005, 0.0]))
    assert target.protrusion([ball]) == pytest.approx(np.hypot(np.hypot(0.03, 0.03), 0.005) - 0.03, abs=1e-9)
    assert len(sizes) > 3 and max(sizes) < 50_000 < sum(sizes)
    small = [len(t) for t in robot_shapes.few_at_once(np.full((5, 3, 3), 0.5), 0.1)]
    assert small == [5]


def test_links_are_counted_before_a_mesh_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(robot_links, "load_robot_meshes", lambda *_: pytest.fail("a mesh was read"))

    def made(path: Path, **more):
        return robot_import.import_robot(
            path, name="m", base=more.pop("base", "base"), flange="flange", packages={}, **more
        )

    with one_line("1 joints move flange; allowed are 6 or 7"):
        made(write_urdf(tmp_path), base="l6")
    with one_line("--fingers l7 is not a link that a joint of the gripper"):
        made(write_urdf(tmp_path), fingers=("l7", "left_finger"))
    with one_line("needs lower < upper"):
        made(write_urdf(tmp_path, **{'lower="-1.8" upper="1.8"': 'lower="0.5" upper="0.5"'}))
    with one_line("joint of l2 is several joints; the arm's joints must be revolute"):
        made(write_urdf(tmp_path, **{'name="j2" type="revolute"': 'name="j2" type="planar"'}))
    for name in ("", "b" * 2000):
        with one_line("a mesh's file is called '" + name[:40] + "'; give a name of 1 to 1000 characters"):
            made(write_urdf(tmp_path, **{'"parts/block.stl"': f'"{name}"'}))
    far = read_chain(
        read_model(write_urdf(tmp_path, **{'lower="-1.8" upper="1.8"': 'lower="-9" upper="1"'})), "base", "flange"
    )
    assert far.lower.min() == -2 * np.pi and far.upper.max() < 2 * np.pi
    with one_line("link l4 is not a body: mass 0 kg"):
        path = write_urdf(tmp_path)
        text = path.read_text()
        at = text.index('<mass value="1.5"', text.index('<link name="l4">'))
        path.write_text(text[:at] + text[at:].replace('"1.5"', '"0"', 1))
        made(path)


@pytest.mark.whole(part="data")
def test_a_last_link_that_the_file_does_not_show_is_a_ball_of_1_mm_and_other_such_links_are_refused(tmp_path):
    def without(link: str) -> Path:
        path = write_urdf(tmp_path, **{'"j3"': '"left/j3"'})  # as MuJoCo names what it attaches
        text = path.read_text()
        at = text.index(f'<link name="{link}">')
        cut = text.index("<visual>", at), text.index("<inertial>", at)
        path.write_text(text[: cut[0]] + text[cut[1] :])
        return path

    made = {"name": "m", "base": "base", "flange": "flange", "packages": {}, "fingers": PADS}
    with one_line("link l4 has no visual mesh or shape"):
        robot_import.import_robot(without("l4"), **made)
    with pytest.warns(UserWarning, match="shows nothing of link l7: it collides as a ball of 1 mm"):
        found = robot_import.import_robot(without("l7"), **made).robot
    assert found.joints[1:4] == ("j2", "left_j3", "j4")
    (k,) = np.flatnonzero(found.arm.link == 7)
    assert found.arm.size[k, :2].tolist() == pytest.approx([1e-3, 1e-4]) and not found.arm.T_link_prim[k, :3, 3].any()


def test_a_flange_that_no_posture_points_down_is_refused_before_bodies_are_fitted(tmp_path, monkeypatch):
    monkeypatch.setattr(robot_import, "bodies_of", lambda *_: pytest.fail("a body was fitted"))
    with one_line(r"no posture has the gripper at \[.*\] m of --base or near it, pointing down or forward; turn"):
        path, far = write_urdf(tmp_path), turned(z=3.0)
        robot_import.import_robot(path, name="m", base="base", flange="flange", packages={}, offset=far)


def test_link_of_a_part_that_only_collides_as_a_mesh_shows_that_mesh(tmp_path):
    changes = {'<geom class="seen" type="mesh" mesh="block" pos="0 0 0.09"/>': ""}
    model = read_model(write_mjcf(tmp_path, **changes))
    part = read_chain(model, "base", "flange").links[5]
    assert link_of(part, Meshes(model, files_of(part), {})).meshed == 12


def test_files_that_lie_above_are_read_from_a_folder_of_the_user_and_from_no_other(tmp_path):
    """MJCFs of simulators say meshdir="../stls": PACKAGE has both, and --package NAME=FOLDER may say so."""
    folder = tmp_path / "package" / "arm"
    folder.mkdir(parents=True)
    path = write_mjcf(folder, **{'meshdir="parts"': 'meshdir="../stls"'})
    (tmp_path / "package" / "stls").mkdir()
    next(folder.rglob("block.stl")).rename(tmp_path / "package" / "stls" / "block.stl")
    model = read_model(path, [tmp_path / "package"])
    part = read_chain(model, "base", "flange", bare=True).links[5]
    assert link_of(part, Meshes(model, files_of(part), {})).meshed == 12
    for other in ((), (tmp_path / "package" / "arm",)):
        one = read_model(path, other)
        with one_line("stls/block.stl points outside the folder; give the folder above it with --package NAME=FOLDER"):
            Meshes(one, files_of(part), {})
    (tmp_path / "package" / "stls" / "block.stl").unlink()
    (tmp_path / "package" / "stls" / "block.stl").symlink_to("/etc/hosts")
    with one_line("a link that leads outside the folder"):
        Meshes(model, files_of(part), {})
    path.write_text(path.read_text().replace("<compiler", '<include file="../../out.xml"/><compiler', 1))
    with one_line("out.xml points outside the folder"):
        read_model(path, [tmp_path / "package"])
