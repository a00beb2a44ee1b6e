"""Trials in open formats: read by other programs' readers, they are the library's, and answers made of them are scored."""

import json

import numpy as np
import pytest
import trimesh

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.scene.hand import load_hand_set
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.robot_file import load_robot


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("open") / "t"
    assert (
        main(["export", "trials", "--benchmark", "r2h-v1", "--out", str(out), "--trials", "7", "--open-formats"]) == 0
    )
    return out / "open"


def read(path):
    return json.loads(path.read_text())


def test_arrays_are_those_of_the_npz_files_and_meshes_the_librarys(folder):
    for name in ("trials", "hands", "objects/hammer"):
        with np.load(folder.parent / f"{name}.npz") as own:
            for key, value in read(folder / f"{name}.json").items():
                assert np.array_equal(np.array(value, own[key].dtype).reshape(own[key].shape), own[key]), (name, key)
    (hammer,), hands = load_objects(["hammer"]), load_hand_set()
    mesh = trimesh.load(folder / "objects/hammer.obj", process=False, group_material=False, split_object=False)
    assert np.array_equal(np.float32(mesh.vertices), hammer.vertices)
    assert mesh.volume == pytest.approx(hammer.mesh.volume, rel=1e-6)
    lines = (folder / "objects/hammer.obj").read_text().splitlines()
    parts = [n for k, n in enumerate(hammer.part_names) if (hammer.face_part == k).any()]
    assert [x[2:] for x in lines if x.startswith("g ")] == parts
    for h in set(load_benchmark("r2h-v1").trials(7).hand_index.tolist()):
        hand = trimesh.load(folder / f"hands/{h}.obj", process=False)
        own = hands.model.pose(hands.pose[[h]], hands.shape[[h]], hands.side[[h]])
        assert np.array_equal(np.float32(hand.vertices), own.vertices[0].numpy()) and hand.volume > 0
    frames = read(folder / "frames.json")
    assert np.allclose(ee_pose(load_robot(), frames["home_rad"]), frames["T_world_ee_at_home"], atol=1e-9)


def test_answers_made_of_them_alone_are_scored(folder, tmp_path, capsys):
    trials = read(folder / "trials.json")
    pose = np.eye(4)[None].repeat(len(trials["trial_id"]), 0)
    pose[:, :3, 3] = trials["ball_center"]
    grasps = [read(folder / f"objects/{name}.json")["grasp_T_obj_ee"][0] for name in trials["object_name"]]
    mine = {"method": "mine", "trial_id": trials["trial_id"], "T_obj_ee": grasps, "T_world_ee": pose.tolist()}
    (tmp_path / "mine.json").write_text(json.dumps(mine))
    lines = map(str.strip, (folder / "README.md").read_text().splitlines())
    given = next(x for x in lines if x.startswith("r2h-batch sweep")).removeprefix("r2h-batch ")
    given = given.replace("mine.json", str(tmp_path / "mine.json")).split()
    assert main([*given, "--execute.sim", "none", "--out", str(tmp_path / "run")]) == 0
    assert "mine" in capsys.readouterr().out
