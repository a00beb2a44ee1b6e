"""Trials written in the form of the authors' release, and read back."""

import json

import numpy as np
import pytest
from sweep_command import in_process

from r2h_batch.export.command import export_main
from r2h_batch.runs.store import load_run
from r2h_batch.verdicts import CRITERIA


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """Two trials of each split in the release's form."""
    folder = tmp_path_factory.mktemp("release")
    assert export_main([str(run), "--to", "r2handoversim", "--method", "oracle", "--out", str(folder / "files")]) == 0
    return folder


def test_trials_that_are_read_back_get_the_verdicts_that_they_had(run, written):
    """Of the motion as given and of one that is planned anew."""
    own = {r["trial_id"]: r for r in load_run(run).trials("oracle").to_pylist()}
    for more in ([], ["--replan"]):
        out = written / f"run{len(more)}"
        done = in_process("--trials-from", written / "files", "--sim", "none", *more, "--out", out)
        assert done.returncode == 0, done.stderr
        back = load_run(out)
        rows = {
            int(back.labels[r["trial_id"]][0].rsplit("_", 1)[1]): r for r in back.trials("r2handoversim").to_pylist()
        }
        assert rows.keys() == own.keys() and len(rows) == 4
        for i, row in rows.items():
            assert row["outcome"] == own[i]["outcome"]
            for name in CRITERIA:
                if own[i][f"margin_{name}_m"] is not None:
                    atol = 2e-6 if name in ("stability", "reach", "affordance") else 2e-3  # between 60 Hz samples
                    assert row[f"margin_{name}_m"] == pytest.approx(own[i][f"margin_{name}_m"], abs=atol)


def test_a_hands_mesh_decides_safe_where_its_posture_is_unknown(run, written):
    """The same skin without what our exporter writes for us alone: palm and skin are what they were."""
    (written / "plain").mkdir()
    for path in (written / "files").glob("*.json"):
        (written / "plain" / path.name).write_text(
            json.dumps({**json.loads(path.read_text()), "provenance": "somebody"})
        )
    done = in_process("--trials-from", written / "plain", "--sim", "none", "--out", written / "skins")
    assert done.returncode == 0, done.stderr
    own = {r["trial_id"]: r for r in load_run(run).trials("oracle").to_pylist()}
    back = load_run(written / "skins")
    for row in back.trials("r2handoversim").to_pylist():
        mine = own[int(back.labels[row["trial_id"]][0].rsplit("_", 1)[1])]
        assert row["margin_reach_m"] == pytest.approx(mine["margin_reach_m"], abs=2e-6)
        assert row["margin_safe_m"] == pytest.approx(mine["margin_safe_m"], abs=2e-3)  # between 60 Hz samples
    done = in_process("--trials-from", written / "plain", "--method", "fc", "--out", written / "no")
    assert done.returncode == 2 and "fc needs the hands' postures" in done.stderr


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
