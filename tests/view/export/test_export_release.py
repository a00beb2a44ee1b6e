"""Trials written in the form of the authors' release, and read back."""

import json
import re
import shutil

import numpy as np
import pytest
import trimesh
from rounds import each
from sweep_command import in_process

from r2h_batch.__main__ import main
from r2h_batch.runs.store import load_run
from r2h_batch.verdicts import CRITERIA
from r2h_batch.view.export.release import release_names, write_release_results


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """A trial of each split in the release's form."""
    folder = tmp_path_factory.mktemp("release")
    line = ["--method", "oracle", "--trials", "1", "--out", str(folder / "files")]
    assert main(["export", "release", str(run), *line]) == 0
    return folder


@pytest.mark.whole(part="view")
def test_trials_that_are_read_back_get_the_verdicts_that_they_had(run, written):
    """Verdicts of the motion as given and of one that is planned anew."""
    own = {r["trial_id"]: r for r in load_run(run).trials("oracle").to_pylist()}
    for more in ([], ["--replan"]):
        out = written / f"run{len(more)}"
        done = in_process("--trials-from", written / "files", "--execute.sim", "none", *more, "--out", out)
        assert done.returncode == 0, done.stderr
        back = load_run(out)
        rows = {
            int(back.labels[r["trial_id"]][0].rsplit("_", 1)[1]): r for r in back.trials("r2handoversim").to_pylist()
        }
        assert rows.keys() < own.keys() and len(rows) == 2
        for i, row in rows.items():
            assert row["outcome"] == own[i]["outcome"]
            for name in CRITERIA:
                if own[i][f"margin_{name}_m"] is not None:
                    atol = 2e-6 if name in ("stability", "reach", "affordance") else 2e-3  # between 60 Hz samples
                    assert row[f"margin_{name}_m"] == pytest.approx(own[i][f"margin_{name}_m"], abs=atol)


ODD_TEXTS = {
    "a way out": "../../outside",
    "an absolute place": "/tmp/x",
    "an odd letter": "a b",
    "nothing": "",
    "200 letters too many": "x" * 400,
    "another file of the folder": "Results",
}


@pytest.mark.parametrize("text", ODD_TEXTS.values(), ids=ODD_TEXTS)
def test_a_text_that_is_no_id_of_the_release_gets_another_one_and_nothing_lies_beside_the_folder(text):
    names = release_names([0, 2], "or/acle", {0: (text, ""), 2: ("fine-1", "theirs")})
    assert names == {0: ("or_acle_0", "or/acle"), 2: ("fine-1", "theirs")}


def test_no_two_trials_of_an_export_have_one_file():
    twice = release_names([0, 2], "a", {0: ("x", ""), 2: ("X", "")})
    made = release_names([0, 2], "a", {0: ("a_2", ""), 2: ("?", "")})
    assert {t for t, _ in twice.values()} == {t for t, _ in made.values()} == {"a_0", "a_2"}


def test_the_export_of_a_strangers_run_stays_in_its_folder(run, tmp_path):
    copy = tmp_path / "a" / "run"
    shutil.copytree(run, copy)
    ids = [r["trial_id"] for r in load_run(copy).trials("oracle").to_pylist()]
    (copy / "ids.csv").write_text("trial_id,id,variant\n" + "".join(f"{i},../../out/{i},x\n" for i in ids))
    line = ["--method", "oracle", "--trials", "1"]
    assert main(["export", "release", str(copy), *line, "--out", str(tmp_path / "a" / "files")]) == 0
    assert not (tmp_path / "out").exists() and len([*(tmp_path / "a" / "files").glob("oracle_*.json")]) == 2


def test_a_hands_mesh_decides_safe_where_its_posture_is_unknown(run, written):
    """The same skin without what our exporter writes for us alone: palm and skin are what they were."""
    (written / "plain").mkdir()
    for path in (written / "files").glob("oracle_*.json"):
        (written / "plain" / path.name).write_text(
            json.dumps({**json.loads(path.read_text()), "provenance": "somebody"})
        )
    done = in_process("--trials-from", written / "plain", "--execute.sim", "none", "--out", written / "skins")
    assert done.returncode == 0, done.stderr
    own = {r["trial_id"]: r for r in load_run(run).trials("oracle").to_pylist()}
    back = load_run(written / "skins")
    for row in back.trials("r2handoversim").to_pylist():
        mine = own[int(back.labels[row["trial_id"]][0].rsplit("_", 1)[1])]
        assert row["margin_reach_m"] == pytest.approx(mine["margin_reach_m"], abs=2e-6)
        assert row["margin_safe_m"] == pytest.approx(mine["margin_safe_m"], abs=2e-3)  # between 60 Hz samples
    done = in_process("--trials-from", written / "plain", "--method", "fc", "--out", written / "no")
    assert done.returncode == 2 and "fc needs the hands' postures" in done.stderr


def validate(t):
    """The release's rules for a trial (docs/protocol.md of r2handoversim 0.11.0)."""
    assert t["schema_version"] == "handover.trial.v1" and t["units"] == "m" and t["split"] in ("S0", "S1")
    assert re.fullmatch(r"[A-Za-z0-9_-]+", t["id"]) and t["object_id"] and t["variant"]
    named = ("T_object_gripper", "target_T_world_gripper", "T_tcp_asset_tool")
    for T in (*(np.array(t[k]) for k in named), np.array(t["receiver"]["T_world_hand"])):
        R = T[:3, :3]
        assert np.abs(T[3] - [0, 0, 0, 1]).max() <= 1e-7 and np.abs(R.T @ R - np.eye(3)).max() <= 1e-6
        assert abs(np.linalg.det(R) - 1) <= 1e-6
    boxes = [b for k in ("object_boxes", "hand_boxes_world", "obstacle_boxes_world", "usage_boxes") for b in t[k]]
    for b in boxes:
        assert len(b["center"]) == 3 and min(b["half_extents"]) > 0 and isinstance(b["label"], str)
        R = np.array(b["rotation"])
        assert np.abs(R.T @ R - np.eye(3)).max() <= 1e-6
    assert t["object_boxes"] and t["hand_boxes_world"] and bool(t["usage_boxes"]) == (t["split"] == "S1")
    for mesh in (t["object_mesh_object"], t["hand_mesh_world"]):
        v, f = np.array(mesh["vertices"]), np.array(mesh["faces"])
        assert np.isfinite(v).all() and v.shape[1] == f.shape[1] == 3 and 0 <= f.min() <= f.max() < len(v)
    colors = np.array(t["object_mesh_object"]["colors"])
    assert colors.shape == np.shape(t["object_mesh_object"]["vertices"]) and 0 <= colors.min() <= colors.max() <= 1
    palm = np.array(t["receiver"]["T_world_hand"])
    assert np.allclose(palm[:3, 3], t["palm_position_world"], rtol=0, atol=1e-8)
    assert np.allclose(palm[:3, 2], t["palm_normal_world"], rtol=0, atol=1e-8)
    assert t["receiver"]["side"] in ("left", "right") and t["receiver"]["static_world"] is True
    assert 0 < t["gripper_opening_m"] <= 0.086 and 0 < t["max_opening_m"] <= 0.085 and t["dt_s"] == 1 / 60
    for joints in (np.array(t["planned_joints"]), np.array(t["executed_joints"])):
        assert joints.ndim == 2 and joints.shape[1] == 6 and np.abs(joints).max() <= 2 * np.pi
    assert np.abs(np.diff(t["executed_joints"], axis=0)).max() <= 0.0101  # 0.6 rad/s at 60 Hz
    assert "planning" not in t or t["planning"]["status"] == "failed"  # no digest of theirs is claimed
    json.dumps(t, allow_nan=False)


def test_files_keep_what_the_release_demands_of_a_trial(written):
    for path in each((written / "files").glob("oracle_*.json")):
        t = json.loads(path.read_text())
        validate(t)
        joints = np.array(t["executed_joints"])
        assert np.allclose(joints[[0, -1]], np.array(t["planned_joints"])[[0, -1]], atol=1e-5)
        # boxes hold what they stand for
        for points, boxes in (("object_mesh_object", "object_boxes"), ("hand_mesh_world", "hand_boxes_world")):
            v = np.array(t[points]["vertices"])[:, None]
            c, h = (np.array([b[k] for b in t[boxes]]) for k in ("center", "half_extents"))
            assert (np.abs(v - c) <= h + 1e-9).all(2).any(1).all()


def test_a_trial_that_was_theirs_is_judged_exported_and_valid_with_its_id_and_its_joints(written, tmp_path):
    """Hands without a posture, planned and executed joints: what came in goes out."""
    (tmp_path / "in").mkdir()
    theirs = {}
    for path in sorted((written / "files").glob("oracle_*.json"))[:2]:
        t = json.loads(path.read_text()) | {"provenance": "somebody", "variant": "FS"}
        t["id"] = f"their-{t['id']}"
        t["planned_joints"] = [t["executed_joints"][0], *t["executed_joints"][1::7], t["executed_joints"][-1]]
        theirs[t["id"]] = t
        (tmp_path / "in" / f"{t['id']}.json").write_text(json.dumps(t))
    done = in_process("--trials-from", tmp_path / "in", "--execute.sim", "none", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    run = (tmp_path / "run").rename(tmp_path / "moved")
    assert len(list(run.glob("imported-*"))) == 1
    (tmp_path / "in").rename(tmp_path / "gone")
    assert main(["export", "release", str(run), "--out", str(tmp_path / "out")]) == 0
    line = [str(run), "--trial"]
    assert main(["export", "scene", *line, min(theirs), "--out", str(tmp_path / "scene")]) == 0
    assert main(["export", "scene", *line, "nobody's", "--out", str(tmp_path / "no")]) == 2
    assert main(["export", "scene", *line, "9" * 20, "--out", str(tmp_path / "no")]) == 2
    for name, t in theirs.items():
        back = json.loads((tmp_path / "out" / f"{name}.json").read_text())
        validate(back)
        assert back["variant"] == "FS" and back["split"] == t["split"]
        for key in ("planned_joints", "executed_joints", "target_T_world_gripper", "palm_position_world"):
            assert np.allclose(back[key], t[key], atol=2e-6), key
        mine, own = (trimesh.Trimesh(**x["hand_mesh_world"], process=False) for x in (back, t))
        assert mine.volume == pytest.approx(own.volume, rel=1e-4) and mine.volume > 0


def by_the_paper(row) -> str:
    """The outcome of a row by the paper's five criteria, behind which further ones are looked at."""
    return "success" if row["outcome"] in CRITERIA[5:] else row["outcome"]


def test_results_are_in_the_releases_schema_and_read_back_as_a_run_of_their_verdicts(run, written, tmp_path, capsys):
    for method in ("oracle", "random"):
        line = ["--method", method, "--trials", "1", "--out", str(tmp_path / method)]
        assert main(["export", "release", str(run), *line]) == 0
    both = [r for m in ("oracle", "random") for r in json.loads((tmp_path / m / "results.json").read_text())]
    assert len(both) == 8 and len({r["trial_id"] for r in both}) == 8
    for m in ("oracle", "random"):
        own = {f"{m}_{r['trial_id']}": r for r in load_run(run).trials(m).to_pylist()}
        for r in both:
            if r["variant"] == m:
                row = own[r["trial_id"]]
                assert r["success"] == (by_the_paper(row) == "success") and r["object_id"] == row["object"]
                assert r["first_failure"] == (None if r["success"] else by_the_paper(row))
                stays = row["passed_safe"] is None  # at home, without a path
                assert r["metrics"] == {c: row[f"passed_{c}"] for c in CRITERIA[:5]} | ({"safe": True} if stays else {})
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
    assert main(["import", "results", str(tmp_path / "both"), "--from", "r2handoversim", "--out", str(back)]) == 0
    theirs = load_run(back)
    assert theirs.methods == ("oracle", "random") and theirs.header["protocol"] == "r2handoversim"
    for m in theirs.methods:
        # in S0 and S1 the trials of a run stand in the order of their ids, objects in turn
        a, b = (
            sorted((r["split"], r["object"], by_the_paper(r)) for r in x.trials(m).to_pylist())
            for x in (theirs, load_run(run))
        )
        assert a == b
    capsys.readouterr()
    assert main(["report", str(back)]) == 0 and "verdicts of the release" in capsys.readouterr().out
    assert main(["compare", str(back)]) == 0 and "oracle" in capsys.readouterr().out
    wrong = [{**both[0], "success": not both[0]["success"]}]
    (tmp_path / "wrong.json").write_text(json.dumps(wrong))
    line = ["results", str(tmp_path / "wrong.json"), "--from", "r2handoversim", "--out", str(tmp_path / "no")]
    assert main(["import", *line]) == 2
    assert "wrong.json[0]: first_failure or success is not what its metrics say" in capsys.readouterr().err
    (tmp_path / "wrong.json").write_text(json.dumps([{**both[0], "variant": "a\nb"}]))
    assert main(["import", *line]) == 2
    error = capsys.readouterr().err
    assert "wrong.json[0]: variant" in error and error.count("\n") == 1


def test_compare_pairs_a_run_of_imported_trials_with_results_of_the_same_names(written, tmp_path, capsys):
    """With one trial's name missing, it refuses."""
    done = in_process("--trials-from", written / "files", "--execute.sim", "none", "--out", tmp_path / "mine")
    assert done.returncode == 0, done.stderr
    results = json.loads((written / "files" / "results.json").read_text())
    results = [r for r in results if (written / "files" / f"{r['trial_id']}.json").is_file()]
    for name, rows in (("same", results[::-1]), ("other", [{**results[0], "trial_id": "another"}, *results[1:]])):
        (tmp_path / f"{name}.json").write_text(json.dumps(rows))
        line = ["results", str(tmp_path / f"{name}.json"), "--from", "r2handoversim", "--out", str(tmp_path / name)]
        assert main(["import", *line]) == 0
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "mine"), str(tmp_path / "same")]) == 0
    assert "paired by their names" in capsys.readouterr().out
    assert main(["compare", str(tmp_path / "mine"), str(tmp_path / "other")]) == 2
    assert "differ in the names of their trials" in capsys.readouterr().err


def test_each_object_counts_the_same_in_the_exported_averages_and_a_total_is_the_sum_of_both_times(tmp_path):
    """By hand: in S0 a cup with three trials and a can with one; in S1 a pan with two and a pot with one."""
    made = [  # split, object, outcome, planning and execution in s
        ("S0", "cup", "success", 1.0, 4.0), ("S0", "cup", "success", 2.0, 5.0), ("S0", "cup", "plan", 3.0, 6.0),
        ("S0", "can", "reach", 8.0, 1.0), ("S1", "pan", "success", 1.0, 2.0), ("S1", "pan", "affordance", 1.0, 2.0),
        ("S1", "pot", "safe", 3.0, 4.0),
    ]  # fmt: skip
    rows = [
        {
            "trial_id": i, "split": split, "object": thing, "outcome": outcome, "width_m": 0.03, "t_plan_s": plan_s,
            "t_exec_s": exec_s, **{f"passed_{c}": c != outcome for c in CRITERIA},
        }
        for i, (split, thing, outcome, plan_s, exec_s) in enumerate(made)
    ]  # fmt: skip
    write_release_results(rows, {i: (f"t{i}", "FS") for i in range(len(rows))}, tmp_path)
    results = json.loads((tmp_path / "results.json").read_text())
    assert [r["total_time_s"] for r in results] == [5.0, 7.0, 9.0, 9.0, 3.0, 3.0, 7.0]
    s0, s1, avg = json.loads((tmp_path / "paper_table.json").read_text())
    # S0: cup 2 of 3, can 0 of 1. Of all four trials it would be 50 %
    assert (s0["objects"], s0["trials"], s1["objects"], s1["trials"], avg["objects"], avg["trials"]) == (
        2,
        4,
        2,
        3,
        4,
        7,
    )
    assert (s0["SR"], s0["Fplan"], s0["Freach"]) == pytest.approx((100 / 3, 50 / 3, 50.0))
    assert (s0["Tplan"], s0["Texec"], s0["Ttot"]) == pytest.approx(((2 + 8) / 2, (5 + 1) / 2, (7 + 9) / 2))
    assert (s1["SR"], s1["Fafford"], s1["Fsafe"]) == pytest.approx((25.0, 25.0, 50.0)) and s0["Fafford"] is None
    assert (s1["Tplan"], s1["Texec"], s1["Ttot"]) == pytest.approx((2.0, 3.0, 5.0))
    assert (avg["SR"], avg["Fafford"], avg["Ttot"]) == pytest.approx(((100 / 3 + 25) / 2, 12.5, (8 + 5) / 2))
    write_release_results([{**rows[0], "t_plan_s": None}, *rows[1:]], {i: (f"t{i}", "FS") for i in range(7)}, tmp_path)
    s0, s1, avg = json.loads((tmp_path / "paper_table.json").read_text())
    assert s0["Tplan"] is s0["Ttot"] is avg["Ttot"] is None and s0["Texec"] == 3.0 and s1["Ttot"] == 5.0
