"""The paper's benchmark in one page: the commands of docs/your_data.md, end to end on small files in the released layouts."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hand_data import FRAMES, write_arctic, write_grab, write_h2o
from mano_files import mano_dictionary, write_mano
from scipy.spatial.transform import Rotation

from r2h_batch.__main__ import main
from r2h_batch.data.mano import load_mano
from r2h_batch.trials.yaml_file import read_benchmark

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "your_data.md").read_text("utf-8")
PAGE = PAGE.partition("## The paper's benchmark")[2]


def block(x0, x1):
    mesh = trimesh.creation.box((x1 - x0, 0.02, 0.02)).subdivide()
    mesh.apply_translation(((x0 + x1) / 2, 0.3, 0.0))
    return mesh


def write_oakink_objects(root):
    """A mug without parts and a knife with a handle, parts as point clouds."""
    meta = root / "shape" / "metaV2"
    meta.mkdir(parents=True)
    names = {"C1": {"name": "mug"}, "C2": {"name": "knife 1"}, "C3": {"name": "pan"}}
    (meta / "object_id.json").write_text(json.dumps(names))
    for name in ("mug", "knife 1", "pan"):
        at = root / "shape" / "OakInkObjectsV2" / name / "align_ds"
        at.mkdir(parents=True)
        block(-0.1, 0.1).export(at / "scan.ply")
    parts = root / "OakBase" / "knife" / "knife 1"
    parts.mkdir(parents=True)
    for k, (name, span, attr) in enumerate([("handle", (-0.1, 0.0), ["held_by_hand"]), ("blade", (0.0, 0.1), ["cut"])]):
        trimesh.PointCloud(block(*span).sample(300, seed=k)).export(parts / f"part_{k}.ply")
        (parts / f"part_{k}.json").write_text(json.dumps({"name": name, "attr": attr}))


def write_grasps(folder):
    """GraspGen's JSON for its Franka: from above, closing along the block's y, at 40 places."""
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, :3, 0], T[:, :3, 2] = [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]
    T[:, :3, 1] = np.cross(T[0, :3, 2], T[0, :3, 0])
    T[:, 0, 3] = np.linspace(-0.09, 0.09, 40)
    T[:, 2, 3] = 0.1122 - 0.009
    folder.mkdir()
    for name in ("mug", "knife_1"):
        grasps = {"transforms": T.tolist(), "object_in_gripper": [True] * 40}
        (folder / f"{name}.json").write_text(json.dumps({"object": {"file": "x", "scale": 1.0}, "grasps": grasps}))


@pytest.fixture
def released(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for side, name in enumerate(("RIGHT", "LEFT")):
        write_mano(tmp_path / f"MANO_{name}.pkl", mano_dictionary(side))
    mean = load_mano("MANO_RIGHT.pkl", "MANO_LEFT.pkl").model.pose_mean.double().numpy()
    write_grab(tmp_path / "GRAB", subjects=True)
    write_grab(tmp_path / "GRAB", "s1/cup_lift_1", idle=(1,))
    write_arctic(tmp_path / "ARCTIC", mean)
    camera = np.tile(np.eye(4), (FRAMES, 1, 1))
    camera[:, :3, :3] = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix()
    write_h2o(tmp_path / "H2O", camera)
    write_oakink_objects(tmp_path / "OakInk")
    write_grasps(tmp_path / "grasps")
    return tmp_path


def test_five_commands_lead_from_the_released_files_to_table_1(released, capsys):
    commands = [shlex.split(line)[1:] for line in PAGE.split("```")[1].strip().splitlines()]
    assert len(commands) == 5
    said = []
    for command in commands:
        small = {"200": "3", "500": "4", "contact": "random", "intent": "", "fc": ""}
        assert main([w for w in (small.get(w, w) for w in command) if w]) == 0, capsys.readouterr().err
        said.append(capsys.readouterr().out)
    assert "2 objects of oakink (1 with a receiver's region)" in said[0]
    assert "7 hands of grab, arctic, h2o (4 right, 3 left)" in said[2] and "1 idle hand left out" in said[2]
    assert "S0: mug" in said[3] and "S1: knife_1" in said[3] and "3 right, 3 left, " in said[3]
    assert "grasps of its own: mug 40, knife_1 40" in said[3]
    found = read_benchmark("paper/benchmark.yaml")
    assert sorted(set(found.hand_set.posture)) == ["arctic", "grab", "h2o"]
    run = json.loads(Path("runs/paper/run.json").read_text())
    assert "Handover-VA" in said[4] and run["trials"] == {"S0": 4, "S1": 4}
