"""The sweep command with the real evaluator, on few trials."""

import json

import pytest
import torch
from sweep_command import WITH_HOME, command, in_process

from r2h_batch.report.statistics.common import common_trials
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.sweep.results.reevaluation import reevaluate
from r2h_batch.trials.predictions import write_predictions
from r2h_batch.types import Predictions


def test_a_sweep_on_a_plain_terminal_prints_ascii_and_stores_every_row_with_its_pose_and_path(tmp_path):
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "random",
        "oracle",
        "--trials",
        3,
        "--out",
        tmp_path / "run",
        "--save-paths",
    ]
    done = in_process(*line)
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii() and done.stdout.startswith("Split|Method|Reads|   SR|")
    assert done.stderr.splitlines()[-1] == f"run folder: {tmp_path / 'run'}"
    run = load_run(tmp_path / "run")
    assert run.methods == ("random", "oracle")
    for method in run.methods:
        table = run.trials(method)
        assert table.num_rows == 6 and run.poses(method).num_rows == 6
        assert len(set(table["object"].to_pylist())) == 6
        has_path = [r["trial_id"] for r in table.to_pylist() if r["t_exec_s"] is not None]
        assert run.paths(method)["trial_id"].to_pylist() == has_path
    outcomes = run.trials("oracle")["outcome"].to_pylist()
    assert outcomes.count("success") >= 5


def test_a_methods_stored_poses_scored_as_a_file_give_the_same_rows(tmp_path):
    first = in_process("--method", "random", "--trials", 4, "--out", tmp_path / "a")
    assert first.returncode == 0, first.stderr
    run = load_run(tmp_path / "a")
    poses = run.poses("random")
    parts = [torch.tensor(poses[k].to_pylist()).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")]
    order = torch.randperm(len(parts[0]), generator=torch.Generator().manual_seed(1))
    ids = torch.tensor(poses["trial_id"].to_pylist())
    write_predictions(tmp_path / "p.npz", Predictions(ids, *parts, None, "random again")[order])
    second = in_process("--predictions", tmp_path / "p.npz", "--trials", 4, "--out", tmp_path / "b")
    assert second.returncode == 0, second.stderr
    timing = ["t_plan_s", "t_method_s"]
    a, b = (r.drop_columns(timing) for r in (run.trials("random"), load_run(tmp_path / "b").trials("random again")))
    assert a.equals(b)


@pytest.mark.slow
def test_one_process_two_ray_workers_and_three_parts_give_the_same_digest(tmp_path):
    base = ["--benchmark", "r2h-v1", "--method", "random", "oracle", "--trials", 30, "--threads", 1]
    sweeps = {
        "one": [["--chunk", 7, "--shard-trials", 60]],
        "ray": [["--engine", "ray", "--workers", 2, "--shard-trials", 13]],
        "parts": [["--shard", f"{i}/3", "--shard-trials", 11] for i in (1, 2, 3)],
    }
    digests = {}
    for name, lines in sweeps.items():
        for more in lines:
            done = command(*base, *more, "--out", tmp_path / name, env=WITH_HOME)
            assert done.returncode == 0, done.stderr
        run = load_run(tmp_path / name)
        digests[name] = [run.digest(m) for m in ("random", "oracle")]
    assert digests["one"] == digests["ray"] == digests["parts"]


def test_sim_chooses_the_engine_and_run_json_names_it(tmp_path):
    found = {}
    for sim in ("auto", "none"):
        flags = ["--execute.sim", sim, "--out", tmp_path / sim]
        done = in_process("--method", "random", "--trials", 3, *flags)
        assert done.returncode == 0, done.stderr
        run = load_run(tmp_path / sim)
        header = json.loads((tmp_path / sim / "run.json").read_text())
        found[sim] = header["motion"], header["configuration"]["execute"]["sim"], run.trials("random")
    assert found["auto"][:2] == ({"engine": "mujoco", "model": "auto", "step_s": 0.002, "sample_s": 0.008}, "mujoco")
    assert found["none"][:2] == ({"engine": "none", "model": None, "step_s": None, "sample_s": None}, "none")
    times = {k: [t for t in v[2]["t_exec_s"].to_pylist() if t is not None] for k, v in found.items()}
    assert len(times["auto"]) >= 2
    assert all(0.02 < a - b < 0.3 for a, b in zip(times["none"], times["auto"], strict=True))  # 1 mm before the end
    assert found["auto"][2]["outcome"].equals(found["none"][2]["outcome"])


def test_object_errors_are_those_of_one_sweep_in_shards_of_files_and_again_and_others_are_not_paired(tmp_path):
    line = ["--benchmark", "r2h-v1", "--method", "random", "--trials", 6, "--execute.sim", "none"]
    off = [*line, "--object-errors", "rgb", "--object-errors.gross", "0.5"]

    def swept(name, *words):
        done = in_process(*words, "--out", tmp_path / name)
        assert done.returncode == 0, done.stderr
        return load_run(tmp_path / name)

    def rows(run):
        table = run.trials(run.methods[0]).sort_by("trial_id")
        return table.drop_columns([c for c in ("t_plan_s", "t_method_s", "method") if c in table.column_names])

    true, wrong = swept("true", *line), swept("off", *off)
    parts = swept("parts", *off, "--shard-trials", 5, "--chunk", 3)
    assert rows(wrong).equals(rows(parts)) and not rows(wrong).equals(rows(true))
    answers = [run.poses("random").sort_by("trial_id") for run in (true, wrong)]
    assert answers[0].equals(answers[1])  # methods answer as before: they believe what they see
    said = wrong.header["configuration"]["object_errors"]
    assert said == {"translation_m": 0.01, "rotation_deg": 8.0, "gross": 0.5, "gross_turn": "half", "seed": 0}
    with pytest.raises(ValueError, match=r"differ in configuration \(object_errors\): their trials cannot be paired"):
        common_trials([true, wrong])
    poses = answers[1].to_pydict()
    T = [torch.tensor(poses[k]).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")]
    write_predictions(tmp_path / "p.npz", Predictions(torch.tensor(poses["trial_id"]), *T, method="file"))
    of_file = [*off[:2], "--predictions", tmp_path / "p.npz", *off[4:]]
    assert rows(swept("file", *of_file)).equals(rows(wrong))
    assert reevaluate(wrong, "random", 12, Judge(wrong)).equal == 12
