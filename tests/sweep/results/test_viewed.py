"""The command `results viewed`: how much of the region the receivers see, and the column beside Presented."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from r2h_batch import load_benchmark
from r2h_batch.__main__ import main
from r2h_batch.methods import random as random_method
from r2h_batch.observe.eyes import view
from r2h_batch.report import table as report
from r2h_batch.report.viewed import mean_share, view_rates
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.reevaluation import Judge
from r2h_batch.sweep.results.viewed import HIDERS, SCHEMA, viewed_rows
from r2h_batch.types import PlanReason

QUICK = ["--sim", "none", "--quiet"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewed") / "run"
    assert main(["sweep", "--method", "random", "--trials", "12", "--out", str(folder), *QUICK]) == 0
    return folder


@pytest.mark.check
def test_rows_are_those_with_a_region_a_held_object_and_a_posture_and_say_what_the_eyes_see(run, capsys):
    assert main(["results", "viewed", str(run)]) == 0
    shown, stored = capsys.readouterr().out, load_run(run)
    (entry,) = stored.entries
    table = pq.read_table(run / "viewed" / f"{entry.slug}.parquet")
    assert table.schema.remove_metadata().equals(SCHEMA)
    judge = Judge(stored)
    poses = {r["trial_id"]: r for r in stored.poses(entry.name).to_pylist()}
    ids = np.array(sorted(poses))
    trials = judge.trials(ids)
    grasp, pose = (
        torch.tensor([poses[i][k] for i in ids.tolist()]).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")
    )
    scores = judge.evaluator.score(grasp, pose, trials, stages="pose")
    reached = scores.plan_reason != int(PlanReason.IK_UNREACHABLE)
    fits = scores.passed[:, 0] & reached & scores.presented_angle_deg.isfinite()
    assert table["trial_id"].to_pylist() == ids[fits.numpy()].tolist() and 4 <= len(table) < len(ids)
    shift = scores.grasp_shift_m.double().nan_to_num()[:, None, None]
    held = grasp.double().clone()
    held[:, :3, 3] += held[:, :3, 1] * shift[:, 0]
    T = (pose.double() @ torch.linalg.inv(held)).float()[fits]
    again = view(judge.evaluator.scene, trials[fits], T, scores.q_goal[fits], scores.opening_m[fits])
    viewed = table["viewed"].to_numpy()
    assert np.abs(viewed - again.seen.numpy()).max() < 0.006  # poses differ in the last bits
    every = viewed + sum(table[f"hidden_by_{k}"].to_numpy() for k in HIDERS)
    assert every == pytest.approx(1.0, abs=1e-6)
    line = next(x for x in shown.splitlines() if x.startswith("random")).split("|")
    assert float(line[2]) == pytest.approx(100 * viewed.mean(), abs=0.06) and int(line[1]) == len(table)


def test_the_object_is_where_the_pads_have_moved_it_and_what_is_not_held_out_has_no_row():
    benchmark = load_benchmark("r2h-v2")
    evaluator, trials = benchmark.evaluator(), benchmark.trials(12)
    trials = trials[trials.trial_id % 2 == 1]  # S1
    asked = random_method.predict(trials, evaluator.scene)
    grasp, pose = asked.T_obj_ee.clone(), asked.T_world_ee.clone()
    grasp[:, :3, 3] += 0.008 * grasp[:, :3, 1]  # beside the middle of the pads
    pose[::3, 2, 3] += 3.0  # out of reach
    scores = evaluator.score(grasp, pose, trials, stages="pose")
    rows, columns = viewed_rows(scores)
    unreached = (PlanReason.IK_UNREACHABLE, PlanReason.IK_NOT_FOUND)
    held = scores.passed[:, 0].numpy() & ~np.isin(scores.plan_reason.numpy(), unreached)
    assert rows.tolist() == np.flatnonzero(held).tolist() and 3 <= len(rows) < 12 and not set(rows) & {0, 3, 6, 9}
    part = trials[torch.from_numpy(rows)]
    shift = scores.grasp_shift_m[rows]
    assert float(shift.abs().max()) > 0.004

    def seen(moved):
        at = grasp[rows].double()
        at[:, :3, 3] += moved * at[:, :3, 1] * shift.double()[:, None]
        T = (pose[rows].double() @ torch.linalg.inv(at)).float()
        return view(evaluator.scene, part, T, scores.q_goal[rows], scores.opening_m[rows]).seen.numpy()

    assert np.abs(columns["viewed"] - seen(1.0)).max() < 0.005 < np.abs(columns["viewed"] - seen(0.0)).max()


def test_report_shows_the_mean_beside_presented_once_it_is_stored(run, tmp_path, capsys):
    assert main(["results", "viewed", str(run)]) == 0
    table, rates = report.table_of(load_run(run)), view_rates(load_run(run))
    names = list(table.shares)
    assert names.index("viewed") == names.index("presented") + 1
    ((split, method),) = rates
    row = next(r for r in table.rows if r.split == "S1" and r.method == method)
    assert split == "S1" and row.shares["viewed"] == rates[split, method]
    assert "In view" in report.render(table, "md") and '"viewed"' in report.render(table, "json")
    heads, *lines = report.render(table, "csv").splitlines()
    assert {len(x.split(",")) for x in lines} and "viewed_low" in heads.split(",")
    # what was made of other rows is not shown
    path = next((run / "viewed").iterdir())
    kept = path.read_bytes()
    other = pq.read_table(path)
    pq.write_table(other.replace_schema_metadata({}), path)
    assert not view_rates(load_run(run)) and "In view" not in report.render(report.table_of(load_run(run)), "md")
    path.write_bytes(kept)
    capsys.readouterr()
    assert main(["results", "verify", str(run)]) == 0 and "viewed/" in capsys.readouterr().out


def test_the_mean_has_a_t_interval_within_0_and_100():
    found = mean_share(np.array([0.2, 0.4, 0.6]))
    # t of two degrees of freedom: 4.303
    assert found.percent == pytest.approx(40.0) and found.low == 0.0
    assert found.high == pytest.approx(40 + 4.30265 * 20 / np.sqrt(3), abs=1e-3) and found.total == 3
    one = mean_share(np.array([0.3]))
    assert (one.low, one.high) == (0.0, 100.0)


def test_runs_without_bodies_are_refused_in_one_line(tmp_path, capsys):
    folder = tmp_path / "hands"
    line = ["sweep", "--benchmark", "r2h-v0", "--method", "random", "--trials", "1", "--out", str(folder), *QUICK]
    assert main(line) == 0
    capsys.readouterr()
    assert main(["results", "viewed", str(folder)]) == 2
    shown = capsys.readouterr()
    assert "no receiver's body" in shown.err and shown.err.count("\n") == 1 and not shown.out
