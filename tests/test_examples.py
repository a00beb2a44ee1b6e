"""The examples run, in a shortened form, and do what they say."""

import json
import runpy
from importlib import import_module
from pathlib import Path

import pytest
import torch

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture(autouse=True)
def examples_on_the_path_and_torchs_threads_as_they_were(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def test_scoring_candidates_is_short_and_prints_two_rates(capsys):
    lines = (EXAMPLES / "score_candidates.py").read_text().splitlines()
    assert len([x for x in lines if x.strip() and not x.startswith(("import", "from", '"""'))]) <= 20
    runpy.run_path(str(EXAMPLES / "score_candidates.py"), run_name="__main__")
    out = capsys.readouterr().out
    assert "1024 candidates in" in out and "the best of 16 does in" in out


def test_refining_turns_failing_candidates_into_passing_ones(capsys):
    refine_poses = import_module("refine_poses")
    before, after = refine_poses.main(["--trials", "8", "--steps", "30"])
    assert before < 0.3 and after > 0.2
    assert "failing ones refined in 30 steps" in capsys.readouterr().out


def test_a_generator_is_trained_and_judged_in_three_ways(tmp_path):
    train_generator = import_module("train_generator")
    short = ["--proposals", "300", "--steps", "6", "--batch", "32", "--trials", "12", "--candidates", "2"]
    result = train_generator.main([*short, "--out", str(tmp_path), "--weights", str(tmp_path / "weights.pt")])
    assert json.loads((tmp_path / "results" / "training_loop.json").read_text())["rates"] == result["rates"]
    assert list(result["rates"]) == ["plain", "best of 2", "guided, 2 steps"]
    assert all(0 <= r["low"] <= r["rate"] <= r["high"] <= 1 and r["trials"] == 6 for r in result["rates"].values())
    assert (tmp_path / "training_loop.png").stat().st_size > 5000 and (tmp_path / "weights.pt").exists()


def test_a_servo_learns_from_closed_loops_and_is_played_on_unseen_trials(capsys):
    learn_servo = import_module("learn_servo")
    found = learn_servo.main(["--trials", "1", "--population", "2", "--generations", "1"])
    out = capsys.readouterr().out
    assert "1 unseen trials" in out and out.count("generation") == 1
    assert -1 <= found["return before"] <= 1 and found["success after"] >= found["success before"]


def test_ppo_begins_as_the_servo_and_is_compared_with_it_on_unseen_trials(capsys):
    learn_ppo = import_module("learn_ppo")
    untrained = learn_ppo.main(["--trials", "2", "--rounds", "0", "--repeats", "1"])
    assert all(untrained[f"{key}, ppo - servo"] == 0 for key in ("success %", "return", "time s"))
    trained = learn_ppo.main(["--trials", "2", "--rounds", "1", "--repeats", "1"])
    assert "round 0: success" in capsys.readouterr().out and trained["return, servo"] == untrained["return, servo"]


def test_a_method_that_sees_grasps_the_cloud_and_hands_over_some_of_the_things(tmp_path):
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.command import main

    method = f"seen={EXAMPLES / 'grasp_seen.py'}:predict"
    assert (
        main(["--method", method, "--sees", "cell-v1", "--trials", "6", "--sim", "none", "--out", str(tmp_path)]) == 0
    )
    outcomes = load_run(tmp_path).trials("seen")["outcome"].to_pylist()
    assert outcomes.count("success") >= 4 and "invalid_input" not in outcomes
