"""The command `results held`: which objects the closed gripper holds under their weight, and where tables show it."""

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
from r2h_batch.report.compare.stored import baselines_for
from r2h_batch.report.held import held_rates
from r2h_batch.report.table import render, table_of
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.held import SCHEMA
from r2h_batch.sweep.results.reevaluation import Judge

QUICK = ["--sim", "none", "--quiet"]
FC = "FC-Handover (oracle hand + noise)"


def test_objects_that_stability_passes_slide_out_under_their_weight_alone():
    """Rows of r2h-v1 that ship with the package. A simulation with its own approach and half the time step agrees."""
    run = load_run(baselines_for())
    judge = Judge(run)
    evaluator = judge.evaluator
    slips = {}
    for name, ids in (("oracle", [13, 21]), (FC, [16])):
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
        for k, i in enumerate(ids):
            slips[objects[gripped.object_index[k]].name, i] = (found[k, 1], other.slip_m[k])
    ours = {key: pair[0] for key, pair in slips.items()}
    assert ours["power_drill", 13] > 0.08 and ours["headphones", 16] > 0.02 and ours["hammer", 21] < 0.005
    assert all((a < 0.02) == (b < 0.02) for a, b in slips.values()), slips


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("held") / "run"
    sweep = ["sweep", "--method", "random", "--trials", "3", "--benchmark", "r2h-v0", "--out", str(folder), *QUICK]
    assert main(sweep) == 0  # receivers need no bodies
    return folder


def test_the_rate_is_stored_once_and_every_table_of_the_run_shows_it(run, capsys):
    assert held_rates(load_run(run)) == {} and "Held 1 s" not in render(table_of(load_run(run)), "md")
    assert main(["results", "held", str(run), "--processes", "1"]) == 0
    assert "Held under their weight for 1 s" in capsys.readouterr().out
    (entry,) = load_run(run).entries
    path = run / "held" / f"{entry.slug}.parquet"
    table = pq.read_table(path)
    assert table.schema.remove_metadata().equals(SCHEMA)
    assert all(r["held"] == (r["slip_m"] < 0.02) for r in table.to_pylist())
    passed = load_run(run).trials(entry.name, ["trial_id", "passed_stability"]).to_pylist()
    assert table["trial_id"].to_pylist() == sorted(r["trial_id"] for r in passed if r["passed_stability"])
    before = path.read_bytes()
    assert main(["results", "held", str(run), "--processes", "1"]) == 0
    assert path.read_bytes() == before and "has these rows" in capsys.readouterr().err
    loaded = load_run(run)
    rates = held_rates(loaded)
    assert sum(r.total for r in rates.values()) == len(table)
    assert sum(r.count for r in rates.values()) == table["held"].to_pylist().count(True)
    shown = table_of(loaded)
    assert "Held 1 s" in render(shown, "md")
    (first, *_) = json.loads(render(shown, "json"))["rows"]
    assert first["held_1s"] == pytest.approx(rates[first["split"], entry.name].percent)
    assert main(["results", "verify", str(run)]) == 0


def test_figures_of_other_rows_are_left_out(run):
    (entry,) = load_run(run).entries
    path = run / "held" / f"{entry.slug}.parquet"
    table = pq.read_table(path)
    metadata = {b"r2h_batch held": json.dumps({"rows": "of another run", "code": ""}).encode()}
    kept = path.read_bytes()
    pq.write_table(table.replace_schema_metadata(metadata), path)
    assert held_rates(load_run(run)) == {}
    path.write_bytes(b"no table")
    assert held_rates(load_run(run)) == {}
    path.write_bytes(kept)
    assert held_rates(load_run(run))
