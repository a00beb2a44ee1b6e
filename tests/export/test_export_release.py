"""Trials written in the form of the authors' release, and read back."""

import json

import numpy as np
import pytest
from sweep_command import in_process

from r2h_batch.compare.command import main as compare_main
from r2h_batch.export.command import export_main
from r2h_batch.importers.command import main as import_main
from r2h_batch.report.__main__ import main as report_main
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
    for path in (written / "files").glob("oracle_*.json"):
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
    for path in (written / "files").glob("oracle_*.json"):
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


def test_results_are_in_the_releases_schema_and_read_back_as_a_run_of_their_verdicts(run, written, tmp_path, capsys):
    for method in ("oracle", "random"):
        files = tmp_path / method
        assert (
            export_main([str(run), "--to", "r2handoversim", "--method", method, "--trials", "1", "--out", str(files)])
            == 0
        )
    both = [r for m in ("oracle", "random") for r in json.loads((tmp_path / m / "results.json").read_text())]
    assert len(both) == 8 and len({r["trial_id"] for r in both}) == 8
    for m in ("oracle", "random"):
        own = {f"{m}_{r['trial_id']}": r for r in load_run(run).trials(m).to_pylist()}
        for r in both:
            if r["variant"] == m:
                row = own[r["trial_id"]]
                assert r["success"] == (row["outcome"] == "success") and r["object_id"] == row["object"]
                assert r["first_failure"] == (None if r["success"] else row["outcome"])
                stays = row["passed_safe"] is None  # at home, without a path
                assert r["metrics"] == {c: row[f"passed_{c}"] for c in CRITERIA} | ({"safe": True} if stays else {})
        table = {t["split"]: t for t in json.loads((tmp_path / m / "paper_table.json").read_text())}
        assert set(table) == {"S0", "S1", "Avg"} and table["S0"]["Fafford"] is None
        failed = {c: table["S1"][k] for c, k in (("stability", "Fstab"), ("plan", "Fplan"), ("reach", "Freach"))}
        rows = [r for r in both if (r["variant"], r["split"]) == (m, "S1")]  # an object each
        assert failed == {c: 100.0 * sum(r["first_failure"] == c for r in rows) / len(rows) for c in failed}
        assert table["Avg"]["SR"] == (table["S0"]["SR"] + table["S1"]["SR"]) / 2
        header = (tmp_path / m / "results.csv").read_text().splitlines()[0]
        assert header.startswith(
            "trial_id,object_id,variant,split,success,first_failure,stability,plan,reach,affordance,safe"
        )
    (tmp_path / "both").mkdir()
    (tmp_path / "both" / "results.json").write_text(json.dumps(both))
    back = tmp_path / "back"
    assert import_main(["results", str(tmp_path / "both"), "--from", "r2handoversim", "--out", str(back)]) == 0
    theirs = load_run(back)
    assert theirs.methods == ("oracle", "random") and theirs.header["protocol"] == "r2handoversim"
    for m in theirs.methods:
        # in S0 and S1 the trials of a run stand in the order of their ids, objects in turn
        a, b = (
            sorted((r["split"], r["object"], r["outcome"]) for r in x.trials(m).to_pylist())
            for x in (theirs, load_run(run))
        )
        assert a == b
    capsys.readouterr()
    assert report_main([str(back)]) == 0 and "verdicts of the release" in capsys.readouterr().out
    assert compare_main([str(back)]) == 0 and "oracle" in capsys.readouterr().out
    wrong = [{**both[0], "success": not both[0]["success"]}]
    (tmp_path / "wrong.json").write_text(json.dumps(wrong))
    assert (
        import_main(["results", str(tmp_path / "wrong.json"), "--from", "r2handoversim", "--out", str(tmp_path / "no")])
        == 2
    )
    assert "wrong.json[0]: first_failure or success is not what its metrics say" in capsys.readouterr().err
