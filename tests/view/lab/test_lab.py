"""A laboratory's files: frames and TCP against Denavit and Hartenberg's closed form, paths, sheets in true size, the folder."""

import csv
import json
import re

import matplotlib as mpl
import numpy as np
import pytest
import trimesh
from rounds import each

from r2h_batch.__main__ import main
from r2h_batch.commands.real import ids_of
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.view.lab.frames import pendant
from r2h_batch.view.lab.paths import path_of, postures, ros2_of, tcp_of, urscript_of
from r2h_batch.view.lab.sheets import RULER_M, Drawn, _marks, grasp_sheet, hand_sheet, write_sheet
from r2h_batch.view.stored import Reader

D = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
A = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
"""The UR5e's published parameters, in the frame `base` of its controller."""


def controller_flange(q):
    """T_base_tool0 as a UR5e's controller computes it, by Denavit and Hartenberg."""
    T = np.eye(4)
    for theta, d, a, alpha in each(zip(q, D, A, ALPHA, strict=True)):
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return T


@pytest.fixture(scope="module")
def stored(run):
    """A trial of the oracle with a path, and the run folder's reader."""
    reader = Reader(run)
    name = reader.method("oracle")
    success = next(r["trial_id"] for r in reader.rows(name).to_pylist() if r["outcome"] == "success")
    return reader.trial(success, name)


@pytest.mark.check
def test_the_pendants_numbers_are_those_of_the_controllers_own_kinematics():
    robot, random = load_robot(), np.random.default_rng(0)
    for q in each(random.uniform(-np.pi, np.pi, (20, 6))):
        T_base_tcp = controller_flange(q) @ robot.T_flange_ee
        x, y, z, *turn = pendant(tcp_of(robot, q[None])[0])
        np.testing.assert_allclose([x, y, z], 1000 * T_base_tcp[:3, 3], atol=0.02)
        angle = np.linalg.norm(turn)
        k = np.array(turn) / angle
        K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        R = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K  # Rodrigues
        np.testing.assert_allclose(R, T_base_tcp[:3, :3], atol=1e-4)


@pytest.mark.parametrize("tcp_speed", [0.05, 0.25, 1.5])
def test_a_path_starts_at_home_ends_at_the_goal_and_keeps_to_the_speed(stored, tcp_speed):
    path = path_of(stored, step_s=0.008, tcp_speed=tcp_speed)
    np.testing.assert_allclose(path.q[[0, -1]], stored.q[[0, -1]], atol=1e-6)
    assert (np.diff(path.time_s) > 0).all() and np.diff(path.time_s[:-1]) == pytest.approx(0.008)
    p = tcp_of(stored.robot, path.q)[:, :3, 3]
    fastest = (np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(path.time_s)).max()
    assert fastest <= 1.01 * tcp_speed
    assert path.slower == 1.0 or fastest == pytest.approx(tcp_speed, rel=0.02)
    # what the velocities add up to is where the arm goes
    went = path.q[0] + np.concatenate(
        [
            np.zeros((1, 6)),
            np.cumsum((path.velocity[1:] + path.velocity[:-1]) / 2 * np.diff(path.time_s)[:, None], axis=0),
        ]
    )
    assert np.abs(went - path.q).max() < 0.004
    own = postures(stored, path.time_s / path.slower)
    np.testing.assert_allclose(own, path.q, atol=1e-12)


def test_the_way_back_is_the_same_postures_in_the_other_order(stored):
    path = path_of(stored, step_s=0.01, tcp_speed=0.25)
    back = path.back
    np.testing.assert_array_equal(back.q, path.q[::-1])
    np.testing.assert_array_equal(back.velocity, -path.velocity[::-1])
    assert back.time_s[0] == 0 and back.time_s[-1] == path.time_s[-1] and (np.diff(back.time_s) > 0).all()


def test_ros_2_and_urscript_say_the_same_path(stored):
    path = path_of(stored, step_s=0.008, tcp_speed=0.25)
    message = ros2_of(path)
    assert message["joint_names"][0] == "shoulder_pan_joint" and message["header"]["frame_id"] == "base_link"
    for point, q, v, t in each(zip(message["points"], path.q, path.velocity, path.time_s, strict=True)):
        assert set(point) == {"positions", "velocities", "accelerations", "effort", "time_from_start"}
        np.testing.assert_allclose(point["positions"], q, atol=1e-8)
        np.testing.assert_allclose(point["velocities"], v, atol=1e-8)
        at = point["time_from_start"]
        assert at["sec"] + 1e-9 * at["nanosec"] == pytest.approx(t, abs=1e-8) and at["nanosec"] < 10**9
    program = urscript_of(path, "r2h_0_there", stored.robot, load_kg=1.5, load_m=(0.0, 0.01, 0.1))
    told = [list(map(float, m.split(","))) for m in re.findall(r"servoj\(\[(.*?)\]", program)]
    np.testing.assert_allclose(told, path.q[1:], atol=1e-6)
    assert "set_tcp(p[0.000000, 0.000000, 0.153203, 0.000000, 0.000000, 0.000000])" in program
    assert "set_payload(1.500, [0.000000, 0.010000, 0.100000])" in program
    # the arm is stopped before the first step where it stands elsewhere
    assert program.index("halt") < program.index("servoj(")
    assert program.count("def ") == 1 and program.rstrip().endswith("r2h_0_there()")


def test_sheets_are_in_true_size(stored, tmp_path):
    with mpl.rc_context({"pdf.compression": 0}):
        for name, drawn in each({"hand": hand_sheet(stored), "grasp": grasp_sheet(stored)}.items()):
            path = tmp_path / f"{name}.pdf"
            assert write_sheet(drawn, name, path) in ("A4", "A3")
            text = path.read_bytes().decode("latin-1")
            sides = [float(x) for x in re.search(r"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", text).groups()]
            assert sorted(x * 25.4 / 72 for x in sides) in (
                pytest.approx([210, 297], abs=0.1),
                pytest.approx([297, 420], abs=0.1),
            )
            # the ruler: the one level line of 100 mm
            lines = re.findall(r"([\d.]+) ([\d.]+) m\s+([\d.]+) ([\d.]+) l\s+S", text)
            level = [float(x1) - float(x0) for x0, y0, x1, y1 in lines if abs(float(y0) - float(y1)) < 1e-3]
            assert any(abs(x * 25.4 / 72 - 1000 * RULER_M) < 0.05 for x in level)


def test_the_hands_sheet_says_where_it_is(stored):
    drawn = hand_sheet(stored)
    x, y = drawn.cross
    assert f"{1000 * x:.0f} mm along x and {1000 * y:.0f} mm along y" in drawn.words[0]
    assert f"{-1000 * x:.0f} and {-1000 * y:.0f} mm on a UR's pendant" in drawn.words[0]
    points = drawn.shapes[0][0]
    assert np.linalg.norm(points.mean(0) - drawn.cross) < 0.05
    assert np.linalg.norm(points.mean(0) - stored.T_world_hand[:2, 3]) < 0.15


@pytest.mark.whole(part="view")
def test_a_folder_for_the_laboratory_and_back(run, tmp_path, capsys):
    out = tmp_path / "lab"
    assert main(["export", "real", str(run), "--trials", "0-2", "--out", str(out), "--rate-hz", "50"]) == 0
    printed = capsys.readouterr().out
    assert "SAFETY.txt first" in printed and "left out, because they have no path" in printed
    rows = list(csv.DictReader((out / "outcomes.csv").open()))
    assert {r["method"] for r in rows} == {"oracle", "random"} and all(r["outcome"] == "" for r in rows)
    folders = sorted(out.glob("trials/*"))
    assert len(folders) == len(rows)
    for folder in each(folders):
        names = {p.name for p in folder.iterdir()}
        assert names == {
            *(f"{way}.{kind}" for way in ("there", "back") for kind in ("csv", "ros2.json", "script")),
            *("hand.pdf", "grasp.pdf", "trial.json"),
        }
        lab = json.loads((folder / "trial.json").read_text())["lab"]
        assert lab["tcp_mm_rad"] == pytest.approx([0, 0, 153.2, 0, 0, 0], abs=0.01) and lab["payload_kg"] > 1.05
    masses = {r["object"]: r for r in csv.DictReader((out / "objects/objects.csv").open())}
    for name, row in each(masses.items()):
        mesh = trimesh.load(out / f"objects/{name}.stl")
        assert abs(mesh.volume) / 1000 == pytest.approx(float(row["volume_ml"]), rel=1e-3, abs=0.06)
        assert 20 < np.ptp(mesh.vertices, axis=0).max() < 600  # millimetres
    for r in rows:
        r["outcome"], r["seconds"] = "success", "9.5"
    with (out / "filled.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    assert main(["study", "real", str(run), str(out / "filled.csv")]) == 0
    text = capsys.readouterr().out
    assert re.search(rf"oracle *\| *{sum(r['method'] == 'oracle' for r in rows)}\|100.0", text)


def test_ids_are_read_or_refused():
    assert ids_of("3,7,12-14") == [3, 7, 12, 13, 14] and ids_of("0-2, 1") == [0, 1, 2]


@pytest.mark.parametrize(
    "flags, words",
    [
        (["--trials", "4-2"], "runs backwards; write 2-4"),
        (["--trials", "all"], "write ids like 0-39"),
        (["--trials", "0-5000"], "must be 1 to 1000"),
        (["--trials", "0,77"], "no trial 77"),
        (["--tcp-speed", "9"], "--tcp-speed is 9; it must be from 0.01 to 1.5 m/s"),
        (["--rate-hz", "1000"], "--rate-hz is 1000; it must be from 10 to 500"),
        (["--method", "nobody"], "nobody"),
    ],
)
def test_a_wrong_word_gets_one_line(run, tmp_path, capsys, flags, words):
    assert main(["export", "real", str(run), "--out", str(tmp_path / "x"), *flags]) == 2
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error


def test_the_rectangle_of_the_pads_is_drawn_on_the_sheet_of_the_grasp_alone():
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    triangle = (np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]), np.array([[0, 1, 2]]), "#000000")
    pads = ((0.01, 0.02), (0.011, 0.019))
    for given in each([None, pads]):
        axes = Figure().add_subplot()
        _marks(axes, Drawn((triangle,), (), "x", "z", pads=given))
        found = [p.get_bbox().bounds for p in axes.patches if isinstance(p, Rectangle)]
        assert len(found) == (given is not None)
    assert found[0] == pytest.approx((-0.001, 0.001, 0.022, 0.038))
