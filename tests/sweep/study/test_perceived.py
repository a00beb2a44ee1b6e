"""Measures beside the paper's ratings, and ratings of single trials beside measures."""

import csv
from itertools import combinations

import numpy as np
import oracle
import pytest

from r2h_batch.__main__ import main
from r2h_batch.runs.store import load_run
from r2h_batch.scene.hand import palm_frame
from r2h_batch.sweep.study.perceived import MEASURES

METHODS = ("fc", "handover-va", "contact")
QUICK = ["--sim", "none", "--quiet", "--trials", "3", "--save-paths"]
COMFORT = (3.2, 2.8, 2.5)  # Fig. 7 of the paper


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("perceived") / "run"
    assert main(["sweep", "--benchmark", "r2h-v1", "--method", *METHODS, "--out", str(folder), *QUICK]) == 0
    return folder


@pytest.fixture(scope="module")
def trials(run, tmp_path_factory):
    file = tmp_path_factory.mktemp("trials") / "trials.csv"
    assert main(["study", "trials", str(run), "--out", str(file)]) == 0
    with file.open(newline="") as opened:
        return file, list(csv.DictReader(opened))


def array(row, name, *shape):
    return np.array([float(row[f"{name}_{i}"]) for i in range(np.prod(shape))]).reshape(shape)


def test_measures_stand_beside_the_ratings_with_their_order_and_the_warning(run, capsys):
    assert main(["report", str(run), "--perceived"]) == 0
    text = capsys.readouterr().out
    cells = {r[0].strip(): r[1:] for line in text.splitlines() if (r := line.strip("|").split("|"))[1:]}
    stored = load_run(run)
    for at, entry in enumerate(stored.entries):
        outcome = stored.trials(entry.name)["outcome"].to_pylist()
        assert float(cells["SR, %"][at]) == pytest.approx(100 * outcome.count("success") / len(outcome), abs=0.05)
    assert list(cells)[2:6] == [
        "people: comfort",
        "people: safety",
        "people: naturalness",
        MEASURES["f_afford"].heading,
    ]
    assert [float(x) for x in cells["people: comfort"][:3]] == list(COMFORT)
    times = [stored.trials(e.name)["t_exec_s"].to_numpy() for e in stored.entries]
    values = [np.nanmean(t) for t in times]
    agree = [np.sign((values[a] - values[b]) * (COMFORT[a] - COMFORT[b])) for a, b in combinations(range(3), 2)]
    assert float(cells[MEASURES["t_exec_s"].heading][3]) == pytest.approx(-np.mean(agree), abs=0.01)
    assert "decide nothing" in text


def test_a_trial_is_written_with_its_poses_and_what_its_person_sees(run, trials, scene):
    stored = load_run(run)
    entry = stored.entries[0].name
    poses = {r["trial_id"]: r for r in stored.poses(entry).to_pylist()}
    hands = {r["trial_id"]: r["hand_index"] for r in stored.details(entry).to_pylist()}
    objects = {o.name: o for o in scene.objects}
    mine = [r for r in trials[1] if r["method"] == entry]
    assert len(trials[1]) == 18 and len(mine) == 6
    for row in mine:
        i = int(row["trial_id"])
        assert array(row, "T_world_ee", 16) == pytest.approx(poses[i]["T_world_ee"])
        grasp, ee, hand = (array(row, name, 4, 4) for name in ("T_obj_ee", "T_world_ee", "T_world_hand"))
        of = hands[i]
        joints, side = scene.hands.set.geometry.joints[of : of + 1].double(), scene.hands.set.side[of : of + 1]
        normal = hand[:3, :3] @ palm_frame(joints, side)[1][0].numpy()
        assert float(row["finger_palm"]) == (ee[:3, 2] @ -normal >= np.cos(np.radians(45)))
        corners = objects[row["object"]].vertices
        middle = ee @ np.linalg.inv(grasp) @ [*(corners.min(0) + corners.max(0)) / 2, 1]
        shoulder, _, _, torso, size = array(row, "receiver", 5, 4)
        facing = np.array([torso[3], size[3], 0])
        sideways = np.cross([0, 0, 1], facing)
        across = sideways * (sideways @ (torso - shoulder)[:3])  # from the shoulder to the median plane
        head = shoulder[:3] + across + [0, 0, 0.17] + 0.08 * facing
        assert float(row["head_m"]) == pytest.approx(np.linalg.norm(middle[:3] - head), abs=1e-4)


def test_the_closing_speed_is_that_of_the_distance_to_the_hand_in_mujoco_c(run, trials, scene):
    """Along the stored plan at the times of a trapezoid of its own; the twin's hand is made of convex pieces."""
    stored, names, looked_at = load_run(run), [o.name for o in scene.objects], 0
    tables = {
        kind: {(e.name, r["trial_id"]): r for e in stored.entries for r in getattr(stored, kind)(e.name).to_pylist()}
        for kind in ("trials", "details", "paths")
    }
    for row in trials[1]:
        key = row["method"], int(row["trial_id"])
        path = np.array(tables["paths"].get(key, {"q": []})["q"], float)
        if len(path) != 2 or row["closing_m_s"] == "n/a" or looked_at == 5:
            continue
        detail = tables["details"][key]
        shift = np.eye(4)
        shift[1, 3] = detail["grasp_shift_m"]
        held = array(row, "T_obj_ee", 4, 4) @ shift
        hand = array(row, "T_world_hand", 4, 4)
        twin = oracle.mujoco_scene(
            scene, oracle.Staged(names.index(row["object"]), detail["hand_index"], held, hand, detail["opening_m"])
        )
        far = np.abs(path[1] - path[0]).max()
        v, a = 0.1 * np.pi, 0.1 * 5.0
        whole = far / v + v / a if far >= v * v / a else 2 * np.sqrt(far / a)
        t = np.linspace(0, whole, 100)
        ramp = min(v / a, whole / 2)
        speed = np.interp(np.linspace(0, whole, 4000), [0, ramp, whole - ramp, whole], [0, a * ramp, a * ramp, 0])
        gone = np.interp(t, np.linspace(0, whole, 4000), np.cumsum(speed) / speed.sum())
        gap = np.array([twin.clearances(path[0] + s * (path[1] - path[0]), cap=0.25).distance["hand"] for s in gone])
        near = gap[:-1] < 0.25
        assert float(row["closing_m_s"]) == pytest.approx((-np.diff(gap) / np.diff(t))[near].max(), rel=0.05, abs=0.003)
        looked_at += 1
    assert looked_at >= 3
