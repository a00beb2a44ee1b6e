"""A simulator that fails, and solids inside each other, through the command line: counted, never scored, kept to look at."""

import json

import numpy as np
import torch

from r2h_batch import load_benchmark
from r2h_batch.judge.motion import sim_mujoco
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep.results.command import verify
from r2h_batch.trials.predictions import write_predictions
from r2h_batch.types import Predictions


def test_what_the_simulator_failed_on_is_invalid_in_the_table_and_stored_with_its_state(tmp_path, monkeypatch, capsys):
    """Rows 7 and 9: whatever fails in an engine (room for contacts, NaN) comes out of `simulate` as not valid."""
    honest, failed = sim_mujoco.simulate, []

    def failing(job):
        answer = honest(job)
        answer.valid[0] = False
        answer.q[0, 3:] = np.nan
        failed.append(int(job.rows[0]))
        return answer

    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "oracle",
        "--trials",
        "2",
        "--splits",
        "S0",
        "--execute.sim",
        "mujoco",
        "--execute.model",
        "arm",
    ]
    assert sweep.main([*line, "--out", str(tmp_path / "good"), "--format", "json"]) == 0
    monkeypatch.setattr(sim_mujoco, "simulate", failing)
    capsys.readouterr()
    assert sweep.main([*line, "--out", str(tmp_path / "bad"), "--format", "json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rows"]
    assert failed and (row["n"], row["n_invalid_sim"], row["sr"]) == (2, 1, 50.0)
    good, bad = (load_run(tmp_path / name) for name in ("good", "bad"))
    outcomes = bad.trials("oracle")["outcome"].to_pylist()
    broken = outcomes.index("invalid_sim")
    other = 1 - broken
    assert outcomes[other] == good.trials("oracle")["outcome"].to_pylist()[other] == "success"
    stored = bad.trials("oracle").to_pylist()[broken]
    assert all(stored[f"passed_{c}"] is None for c in ("stability", "plan", "reach", "safe"))
    (failure,) = bad.failures("oracle").to_pylist()
    assert failure["trial_id"] == stored["trial_id"] and len(failure["q"]) >= 2
    assert np.isnan(np.array(failure["executed_q"], float)).any()
    assert verify(tmp_path / "bad") == 0


def test_a_gripper_closed_around_the_hand_is_a_collision_in_the_stored_rows(tmp_path):
    """Row 8: solids wholly inside each other have no surfaces that cross; they collide all the same."""
    trials = load_benchmark("r2h-v1").trials(4, splits=["S0"])
    T_world_ee = trials.T_world_hand.clone()  # the TCP at the wrist, the hand between and inside the fingers
    T_obj_ee = torch.eye(4).repeat(4, 1, 1)
    write_predictions(tmp_path / "in.npz", Predictions(trials.trial_id, T_obj_ee, T_world_ee, None, "inside"))
    line = [
        "--benchmark",
        "r2h-v1",
        "--predictions",
        str(tmp_path / "in.npz"),
        "--trials",
        "4",
        "--splits",
        "S0",
        "--execute.sim",
        "none",
    ]
    assert sweep.main([*line, "--out", str(tmp_path / "run")]) == 0
    rows = load_run(tmp_path / "run").trials("inside").to_pylist()
    assert len(rows) == 4 and not any(r["outcome"] == "success" for r in rows)
    assert all(r["passed_plan"] is False or r["passed_safe"] is False for r in rows)
