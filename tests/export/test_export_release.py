"""Trials written in the form of the authors' release, and read back."""

import csv
import json

import numpy as np
import pytest
import torch

from r2h_batch import Evaluator
from r2h_batch.benchmark import read_benchmark
from r2h_batch.export.command import export_main
from r2h_batch.export.stored import Reader
from r2h_batch.importers.command import main as import_main
from r2h_batch.trials.protocol import trials_of
from r2h_batch.verdicts import CRITERIA, Outcome


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """Two trials of each split, written and read back."""
    folder = tmp_path_factory.mktemp("release")
    arguments = [str(run), "--to", "r2handoversim", "--method", "oracle", "--out", str(folder / "files")]
    assert export_main(arguments) == 0
    assert import_main(["trials", str(folder / "files"), "--from", "r2handoversim", "--out", str(folder / "back")]) == 0
    return folder


def test_trials_that_are_read_back_get_the_verdicts_that_they_had(run, written):
    benchmark = read_benchmark(written / "back" / "benchmark.yaml")
    poses = {k: torch.from_numpy(v) for k, v in np.load(written / "back" / "predictions.npz").items()}
    trials = trials_of(benchmark, poses["trial_id"])
    scores = Evaluator.from_benchmark(benchmark).kinematic.score(poses["T_obj_ee"], poses["T_world_ee"], trials)
    with (written / "back" / "trials.csv").open() as file:
        ids = {int(r["trial_id"]): int(r["id"].rsplit("_", 1)[1]) for r in csv.DictReader(file)}
    assert len(ids) == 4
    for k, i in enumerate(poses["trial_id"].tolist()):
        row = Reader(run).trial(ids[i], "oracle").row
        assert Outcome(int(scores.outcome[k])).name.lower() == row["outcome"]
        for c, name in enumerate(CRITERIA):
            if name in ("stability", "reach", "affordance") and row[f"margin_{name}_m"] is not None:
                assert float(scores.margin[k, c]) == pytest.approx(row[f"margin_{name}_m"], abs=2e-6)


def test_files_keep_what_the_release_demands_of_a_trial(written):
    for path in (written / "files").glob("*.json"):
        t = json.loads(path.read_text())
        T = {k: np.array(t[k]) for k in ("T_object_gripper", "target_T_world_gripper")}
        for a in (*T.values(), np.array(t["receiver"]["T_world_hand"])):
            assert np.abs(a[:3, :3].T @ a[:3, :3] - np.eye(3)).max() < 1e-6 and (a[3] == [0, 0, 0, 1]).all()
        palm = np.array(t["receiver"]["T_world_hand"])
        assert np.allclose(palm[:3, 3], t["palm_position_world"], atol=1e-8)
        assert np.allclose(palm[:3, 2], t["palm_normal_world"], atol=1e-8)
        joints = np.array(t["executed_joints"])
        assert joints.shape[1] == 6 and np.abs(np.diff(joints, axis=0)).max() <= 0.01  # 0.6 rad/s at 60 Hz
        assert np.allclose(joints[[0, -1]], np.array(t["planned_joints"])[[0, -1]], atol=1e-5)
        # boxes hold what they stand for
        for points, boxes in (("object_mesh_object", "object_boxes"), ("hand_mesh_world", "hand_boxes_world")):
            v = np.array(t[points]["vertices"])[:, None]
            c, h = (np.array([b[k] for b in t[boxes]]) for k in ("center", "half_extents"))
            assert (np.abs(v - c) <= h + 1e-9).all(2).any(1).all()
        assert bool(t["usage_boxes"]) == (t["split"] == "S1")
