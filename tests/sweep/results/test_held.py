"""The command `results held`: which grasps hold in physics, and where tables show it."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from r2h_batch.__main__ import main
from r2h_batch.closed_loop.transfer.cases import Simulator
from r2h_batch.closed_loop.transfer.handed import gripped_of
from r2h_batch.closed_loop.transfer.model import Setting
from r2h_batch.judge.grasp_physics import close_in_physics
from r2h_batch.report.compare.stored import ROWS
from r2h_batch.report.held import stable_rates
from r2h_batch.report.table import render, table_of
from r2h_batch.runs.files import RunError
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.held import SCHEMA
from r2h_batch.sweep.results.reevaluation import Judge

QUICK = ["--sim", "none", "--quiet"]
FC, VA = "FC-Handover (oracle hand + noise)", "Handover-VA (oracle labels + noise)"


def test_closing_fingers_and_the_weight_lose_objects_that_stability_passes():
    """Rows of r2h-v1 that ship with the package. A simulation with its own approach and another step agrees."""
    run = load_run(ROWS / "v1")
    judge = Judge(run)
    evaluator = judge.evaluator
    lost, others = {}, {}
    for name, ids in (("oracle", [13, 21]), (FC, [16]), (VA, [8, 10])):
        stored = {r["trial_id"]: r for r in run.poses(name).to_pylist() if r["trial_id"] in ids}
        grasp, handover = (
            torch.tensor([stored[i][k] for i in ids]).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")
        )
        scores = evaluator.kinematic.score(grasp, handover, judge.trials(np.array(ids)), stages="pose")
        gripped = gripped_of(scores, np.array(ids))
        assert gripped.trial_id.tolist() == ids  # all pass Stability
        robot, objects = evaluator.scene.robot, tuple(evaluator.scene.objects)
        found = Simulator(robot, objects, Setting(), 0).hold(gripped)
        T_ee_gripper = np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper
        other = close_in_physics(
            objects, gripped.object_index.astype(np.int32), np.linalg.inv(T_ee_gripper @ gripped.T_gripper_obj), robot,
            shake=True, shake_m_s2=0.0, down_ee=gripped.down @ T_ee_gripper[:3, :3].T,
        )  # fmt: skip
        keys = [(objects[k].name, i) for k, i in zip(gripped.object_index, ids, strict=True)]
        lost |= dict(zip(keys, found.lost, strict=True))
        others |= dict(zip(keys, other.slip_m < 0.02, strict=True))
    assert lost == {
        ("power_drill", 13): "weight",
        ("hammer", 21): None,
        ("headphones", 16): "closing",
        ("cup", 8): "closing",
        ("wineglass", 10): None,
    }
    assert {key: word is None for key, word in lost.items()} == others


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("held") / "run"
    sweep = ["sweep", "--method", "random", "--trials", "3", "--benchmark", "r2h-v0", "--out", str(folder), *QUICK]
    assert main(sweep) == 0  # receivers need no bodies
    return folder


def test_the_rate_is_stored_once_and_every_table_of_the_run_shows_it(run, capsys):
    assert stable_rates(load_run(run)) == {} and "Physically stable" not in render(table_of(load_run(run)), "md")
    assert main(["results", "held", str(run), "--processes", "1"]) == 0
    assert "Grasps that hold in physics" in capsys.readouterr().out
    (entry,) = load_run(run).entries
    path = run / "held" / f"{entry.slug}.parquet"
    table = pq.read_table(path)
    assert table.schema.remove_metadata().equals(SCHEMA)
    for row in table.to_pylist():
        assert row["held"] == (row["lost"] is None) and row["squeezed_m"] is not None
        assert (row["slip_m"] is None) == (row["lost"] == "closing")
        if row["slip_m"] is not None:
            assert (row["lost"] == "weight") == (row["slip_m"] >= 0.02)
            assert row["undecided"] or abs(row["slip_m"] - 0.02) >= 0.003
    passed = load_run(run).trials(entry.name, ["trial_id", "passed_stability"]).to_pylist()
    assert table["trial_id"].to_pylist() == sorted(r["trial_id"] for r in passed if r["passed_stability"])
    before = path.read_bytes()
    assert main(["results", "held", str(run), "--processes", "1"]) == 0
    assert path.read_bytes() == before and "has these rows" in capsys.readouterr().err
    loaded = load_run(run)
    rates = stable_rates(loaded)
    assert sum(r.rate.total for r in rates.values()) == len(table)
    assert sum(r.rate.count for r in rates.values()) == table["held"].to_pylist().count(True)
    shown = table_of(loaded)
    assert "Physically stable" in render(shown, "md")
    (first, *_) = json.loads(render(shown, "json"))["rows"]
    found = rates[first["split"], entry.name]
    assert first["physically_stable"] == pytest.approx(found.rate.percent)
    assert first["physically_undecided"] == pytest.approx(found.undecided.percent)
    assert main(["results", "verify", str(run)]) == 0


def test_another_torsion_has_files_of_its_own_and_leaves_the_tables_alone(run, capsys):
    before = stable_rates(load_run(run))
    assert main(["results", "held", str(run), "--processes", "1", "--torsion-mm", "2.5"]) == 0
    (entry,) = load_run(run).entries
    files = sorted(p.name for p in (run / "held").iterdir())
    assert files == sorted([f"{entry.slug}.parquet", f"{entry.slug}.torsion-2.5mm.parquet"])
    tables = [pq.read_table(run / "held" / name) for name in files]
    carries = [t["carries"].to_numpy() for t in tables]
    both = np.isfinite(carries[0]) & np.isfinite(carries[1])
    order = [0, 1] if files[0].endswith("2.5mm.parquet") else [1, 0]
    assert both.any() and (carries[order[0]][both] <= 1.01 * carries[order[1]][both]).all()
    assert stable_rates(load_run(run)) == before
    capsys.readouterr()
    assert main(["results", "held", str(run), "--torsion-mm", "20"]) == 2
    assert "--torsion-mm 20" in capsys.readouterr().err


def test_files_of_older_versions_stay_readable_and_tables_leave_their_rate_out(run):
    (entry,) = load_run(run).entries
    path = run / "held" / f"{entry.slug}.parquet"
    kept, table = path.read_bytes(), pq.read_table(path)
    older = ["trial_id", "object", "split", "success", "held", "slip_m", "turn_deg", "closing_m"]
    pq.write_table(table.select(older), path)
    assert stable_rates(load_run(run)) == {}
    assert "Physically stable" not in render(table_of(load_run(run)), "md")
    path.write_bytes(kept)


def test_figures_of_other_rows_are_left_out(run):
    (entry,) = load_run(run).entries
    path = run / "held" / f"{entry.slug}.parquet"
    table = pq.read_table(path)
    metadata = {b"r2h_batch held": json.dumps({"rows": "of another run", "code": ""}).encode()}
    kept = path.read_bytes()
    pq.write_table(table.replace_schema_metadata(metadata), path)
    assert stable_rates(load_run(run)) == {}
    path.write_bytes(b"no table")
    with pytest.raises(RunError, match=r"held/.*cannot be read.*sets it aside"):
        load_run(run)
    path.write_bytes(kept)
    assert stable_rates(load_run(run))
