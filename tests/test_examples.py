"""The examples run, in a shortened form, and do what they say."""

import json
import runpy
from importlib import import_module
from pathlib import Path

import pytest
import torch

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.training import stream

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
pytestmark = pytest.mark.whole(part="examples")


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


def test_a_generator_learns_from_new_instances_and_is_judged_beside_random_pairs(tmp_path):
    train_generator = import_module("train_generator")
    short = ["--families", "cup,hammer x 2 seed 5", "--items", "1", "--steps", "6", "--batch", "8", "--trials", "6"]
    result = train_generator.main([*short, "--candidates", "2", "--out", str(tmp_path)])
    assert json.loads((tmp_path / "results" / "training_loop.json").read_text())["rates"] == result["rates"]
    ways = ["random", "generator", "best of 2 random", "best of 2", "guided, 2 steps"]
    assert list(result["rates"]) == ways and result["benchmark"] == "r2h-v2"
    assert all(0 <= r["low"] <= r["rate"] <= r["high"] <= 1 and r["trials"] == 12 for r in result["rates"].values())
    assert result["rates"]["best of 2 random"]["passed"] >= result["rates"]["random"]["passed"]
    assert (tmp_path / "training_loop.png").stat().st_size > 5000


def test_a_generators_pose_is_what_its_numbers_say_and_its_candidates_are_those_of_the_object():
    """A pair of the stream, written as numbers and read again, is the pair; a sample takes one of the object's candidates."""
    generator, train_generator = import_module("generator"), import_module("train_generator")
    item = stream(load_benchmark(), "cup,hammer x 1 seed 5", pairs=3, trials=6).item(0)
    _, middle = generator.held(item, item["T_obj_ee"])
    T_world_palm, _ = generator.palm_of(item)
    T_palm_ee = torch.linalg.inv(T_world_palm)[:, None] @ item["T_world_ee"]
    read = generator.from_middle(
        generator.to_pose(generator.to_numbers(generator.at_middle(T_palm_ee, middle))), middle
    )
    torch.testing.assert_close(T_world_palm[:, None] @ read, item["T_world_ee"], atol=1e-5, rtol=0)
    benchmark = load_benchmark()
    sampler = train_generator.Sampler(generator.Generator(), Evaluator(benchmark), benchmark.trials(3), seed=1)
    (T_obj_ee, _), _, _ = sampler.generated(4)
    same = (T_obj_ee[:, :, None] == sampler.seen["candidates"][:, None]).all((-1, -2)) & sampler.seen["exists"][:, None]
    assert same.any(-1).all()


def test_a_servo_learns_from_closed_loops_and_is_played_on_unseen_trials(capsys):
    learn_servo = import_module("learn_servo")
    found = learn_servo.main(["--trials", "1", "--population", "2", "--generations", "1"])
    out = capsys.readouterr().out
    assert "1 unseen trials" in out and out.count("generation") == 1
    assert -1 <= found["return before"] <= 1 and found["success after"] >= found["success before"]


def test_ppo_begins_as_the_servo_and_is_compared_with_it_on_unseen_trials(capsys):
    learn_ppo = import_module("learn_ppo")
    short = ["--families", "cup,hammer x 1 seed 5", "--learn", "2", "--trials", "2", "--repeats", "1"]
    untrained = learn_ppo.main([*short, "--rounds", "0"])
    assert all(untrained[f"{key}, ppo - servo"] == 0 for key in ("success %", "return", "time s"))
    trained = learn_ppo.main([*short, "--rounds", "1"])
    assert "round 0: success" in capsys.readouterr().out and trained["return, servo"] == untrained["return, servo"]
    assert (trained["instances"], trained["learned"], trained["unseen"]) == (2, 2, 4)


def test_a_method_that_sees_grasps_the_cloud_and_hands_over_some_of_the_things(tmp_path):
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.command import main

    method = f"seen={EXAMPLES / 'grasp_seen.py'}:predict"
    assert (
        main(
            ["--method", method, "--sees", "cell-v1", "--trials", "6", "--execute.sim", "none", "--out", str(tmp_path)]
        )
        == 0
    )
    outcomes = load_run(tmp_path).trials("seen")["outcome"].to_pylist()
    assert outcomes.count("success") >= 4 and "invalid_input" not in outcomes


def test_ppo_of_stable_baselines_learns_from_handovers(capsys):
    ppo_sb3 = import_module("ppo_sb3")
    found = ppo_sb3.main(["--steps", "1500", "--envs", "8", "--trials", "6"])
    assert found["episodes"] >= 8 and -1.1 <= found["return"] <= 1
    assert "success" in capsys.readouterr().out


def test_a_network_learns_through_the_judge_in_a_compiled_step():
    found = import_module("compiled_step").main(["--trials", "16", "--steps", "40"])
    assert found["after"] >= found["before"] + 0.15


def test_spawned_workers_bring_items_that_a_network_learns_from(capsys):
    losses = import_module("spawned_stream").main(["--families", "cup,hammer x 1 seed 5", "--items", "3"])
    assert len(losses) == 3 and losses[-1] < losses[0]
    assert "2 spawned workers" in capsys.readouterr().out
