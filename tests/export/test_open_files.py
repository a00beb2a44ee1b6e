"""Trials in open formats: read by other programs' readers, they are the library's, and answers made of them are scored."""

import csv
import json

import numpy as np
import pytest
import torch
import trimesh

from r2h_batch import make_trials
from r2h_batch.__main__ import main
from r2h_batch.bodies.hand import load_hand_set
from r2h_batch.bodies.objects import load_objects
from r2h_batch.bodies.robot import ee_pose, load_robot
from r2h_batch.export.trial_files import write_open
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.predictions import align, load_predictions


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def matrices(rows, name):
    return np.array([[float(r[f"{name}_{i}"]) for i in range(16)] for r in rows], np.float32).reshape(-1, 4, 4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("open") / "t"
    assert main(["trials", "--out", str(out), "--trials", "7", "--open-formats"]) == 0
    return out / "open"


def test_tables_and_meshes_are_what_the_library_has(folder):
    trials, objects, hands = make_trials(trials=7), load_objects(), load_hand_set()
    table = rows_of(folder / "trials.csv")
    assert [int(r["trial_id"]) for r in table] == trials.trial_id.tolist()
    assert np.array_equal(matrices(table, "T_world_hand"), trials.T_world_hand.numpy())
    same = json.loads((folder / "trials.json").read_text())
    assert [r["object"] for r in same] == [r["object"] for r in table]
    assert np.array_equal(
        np.array([r["T_world_hand"] for r in same], np.float32).reshape(-1, 4, 4), trials.T_world_hand
    )
    for row in table:
        o, h = objects[int(row["object_index"])], int(row["hand_index"])
        mesh = trimesh.load(folder / row["mesh"], process=False, group_material=False, split_object=False)
        assert np.array_equal(np.float32(mesh.vertices), o.vertices) and len(mesh.faces) == len(o.faces)
        assert mesh.volume == pytest.approx(o.mesh.volume, rel=1e-6)
        hand = trimesh.load(folder / row["hand_mesh"], process=False)
        own = hands.model.pose(hands.pose[[h]], hands.shape[[h]], hands.side[[h]])
        assert np.array_equal(np.float32(hand.vertices), own.vertices[0].numpy()) and hand.volume > 0
        assert row["side"] == ("right", "left")[int(hands.side[h])]
    about = {h["hand_index"]: h for h in json.loads((folder / "hands.json").read_text())}
    first = table[0]
    T, hand = trials.T_world_hand[0].double().numpy(), about[int(first["hand_index"])]
    palm = np.mean([hand["joints_m"][j] for j in (0, 1, 4, 7, 10)], 0)
    ball = T[:3, :3] @ (palm + 0.12 * np.array(hand["palm_normal"])) + T[:3, 3]
    assert np.allclose([float(first[f"ball_center_{k}"]) for k in "xyz"], ball, atol=1e-6)


def test_parts_region_grasps_and_frames(folder):
    (hammer,) = load_objects(["hammer"])
    lines = (folder / "objects" / "hammer.obj").read_text().splitlines()
    assert [x[2:] for x in lines if x.startswith("g ")] == [
        n for k, n in enumerate(hammer.part_names) if (hammer.face_part == k).any()
    ]
    region = trimesh.load(folder / "objects" / "hammer_region.obj", process=False)
    assert region.area == pytest.approx(hammer.mesh.area_faces[hammer.receiver_face].sum(), rel=1e-6)
    points = rows_of(folder / "objects" / "hammer_points.csv")
    assert np.array_equal(np.array([[r[k] for k in "xyz"] for r in points], np.float32), hammer.points)
    assert [int(r["region"]) for r in points] == hammer.receiver_face[hammer.point_face].tolist()
    grasps = rows_of(folder / "objects" / "hammer_grasps.csv")
    assert np.array_equal(matrices(grasps, "T_obj_ee"), candidates_of((hammer,))[0].T_obj_ee)
    frames = json.loads((folder / "frames.json").read_text())
    assert np.allclose(ee_pose(load_robot(), frames["home_rad"]), frames["T_world_ee_at_home"], atol=1e-9)
    assert len(load_objects()) > len(
        json.loads((folder / "objects.json").read_text())
    )  # seven trials meet seven objects


def test_answers_made_of_the_tables_alone_are_scored(folder, tmp_path, capsys):
    table = rows_of(folder / "trials.csv")
    names = ["trial_id", *(f"{k}_{i}" for k in ("T_obj_ee", "T_world_ee") for i in range(16))]
    with (tmp_path / "mine.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(names)
        for row in table:
            grasp = rows_of(folder / "objects" / f"{row['object']}_grasps.csv")[0]
            pose = np.eye(4)
            pose[:3, 3] = [float(row[f"ball_center_{k}"]) for k in "xyz"]
            out.writerow([row["trial_id"], *(grasp[f"T_obj_ee_{i}"] for i in range(16)), *pose.ravel()])
    found = load_predictions(tmp_path / "mine.csv")
    assert align(found, make_trials(trials=7).trial_id, source="mine").tolist() == list(range(14))
    readme = (folder / "README.md").read_text()
    line = next(x.strip() for x in readme.splitlines() if x.strip().startswith("r2h-batch sweep"))
    given = line.removeprefix("r2h-batch ").replace("mine.csv", str(tmp_path / "mine.csv")).split()
    assert main([*given, "--sim", "none", "--out", str(tmp_path / "run")]) == 0
    assert "mine" in capsys.readouterr().out


def test_receivers_with_bodies_come_along(tmp_path):
    from dataclasses import replace

    from r2h_batch.benchmark import built_in

    own = replace(built_in(), objects=load_objects(["cup"]), drawn="r2h-v1")
    trials = make_trials("S0", 2, benchmark=own)
    write_open(tmp_path / "open", own, trials, "sweep")
    rows = rows_of(tmp_path / "open" / "trials.csv")
    found = np.array([[float(r[f"receiver_{i}"]) for i in range(20)] for r in rows], np.float32)
    assert np.array_equal(found.reshape(-1, 5, 4), trials.receiver.numpy())


def test_a_name_that_is_a_formula_stays_text(tmp_path):
    from dataclasses import replace

    from r2h_batch.benchmark import built_in

    (cup,) = load_objects(["cup"])
    own = replace(built_in(), objects=(replace(cup, instruction="=SUM(A1:A9)"),))
    write_open(tmp_path / "open", own, make_trials("S0", 1, benchmark=own), "sweep")
    (row,) = rows_of(tmp_path / "open" / "trials.csv")
    assert row["instruction"] == "'=SUM(A1:A9)"
    assert torch.equal(
        torch.from_numpy(matrices([row], "T_world_hand")), make_trials("S0", 1, benchmark=own).T_world_hand
    )
