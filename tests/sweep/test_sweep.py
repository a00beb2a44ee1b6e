"""The sweep command: what it refuses, prints and stores. The evaluator is a fake except at the end."""

import json
import sys
from types import SimpleNamespace

import fake_bench
import numpy as np
import pytest
import torch
from made_runs import made_trials, make_predictions

from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs
from r2h_batch.trials.predictions import write_predictions

# --- the command line -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("--trails 3 --method random", ["unknown flag --trails", "did you mean --trials?", "see --help"]),
        (
            "--method randm",
            ["unknown method 'randm'", "did you mean random?", "random, oracle", "package.module:function"],
        ),
        ("--method mine.npz", ["--method mine.npz: a file of poses is given with --predictions mine.npz"]),
        ("--method mine=rules/mine.py", ["name its function too, such as rules/mine.py:predict"]),
        ("--method random --splits S2", ["S2", "--splits is 'S2'; allowed are S0, S1"]),
        ("--method random --trials 0", ["--trials is 0", "1 or more"]),
        ("--method random --device gpu", ["'gpu'", "cpu, cuda"]),
        ("--method random random", ["random is given twice"]),
        ("", ["nothing to score", "--method random oracle", "--predictions FILE"]),
    ],
)
def test_a_bad_command_line_is_one_line_with_the_valid_names_and_exit_code_2(capsys, line, parts):
    assert sweep.main(line.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("sweep: ") and captured.err.count("\n") == 1
    for part in parts:
        assert part in captured.err


# --- the run, with a fake evaluator ---------------------------------------------------------------------------------


@pytest.fixture
def fake(monkeypatch):
    """Replaces everything that needs geometry; `fake.evaluator` is the one of the last run."""
    state = SimpleNamespace(evaluator=None)

    def set_up(request):
        bench = fake_bench.set_up(request)
        state.evaluator = bench.evaluator
        return bench

    monkeypatch.setattr(jobs, "set_up", set_up)
    return state


@pytest.fixture
def here(monkeypatch):
    """The name under which this file's methods can be imported."""
    monkeypatch.setitem(sys.modules, "my_rules", fake_bench)
    return "my_rules"


def test_a_predictions_file_in_any_order_is_scored_as_what_it_is(fake, tmp_path, capsys):
    made = make_predictions(made_trials(4, 4), "Mine (learned)")
    made.T_world_ee[5] = float("nan")
    order = torch.tensor([7, 3, 0, 5, 1, 2, 6, 4])
    write_predictions(tmp_path / "p.npz", made[order])
    file, out = str(tmp_path / "p.npz"), str(tmp_path / "run")
    line = ["--benchmark", "r2h-v1", "--predictions", file, "--trials", "4", "--out", out, "--format", "json"]
    assert sweep.main(line) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(r["split"], r["method"], r["sr"], r["n_invalid_input"]) for r in rows][:2] == [
        ("S0", "Mine (learned)", 50.0, 0),
        ("S1", "Mine (learned)", 50.0, 1),
    ]
    run = load_run(out)
    assert run.header["command"] == ["python", "-m", "r2h_batch.sweep", *line]  # its own, not this program's
    stored = np.array(run.poses("Mine (learned)")["T_world_ee"].to_pylist(), np.float32).reshape(-1, 4, 4)
    assert stored.tobytes() == made.T_world_ee.numpy().tobytes()
    assert run.trials("Mine (learned)")["t_method_s"].null_count == 8
    assert run.entry("Mine (learned)").source["file"] == file


def test_missing_predictions_are_refused_or_counted_as_failures(fake, tmp_path, capsys):
    write_predictions(tmp_path / "p.npz", make_predictions(made_trials(4, 4), "m")[torch.tensor([0, 2, 3])])
    line = [
        "--benchmark",
        "r2h-v1",
        "--predictions",
        str(tmp_path / "p.npz"),
        "--trials",
        "4",
        "--out",
        str(tmp_path / "run"),
        "--format",
        "json",
    ]
    assert sweep.main(line) == 2
    assert "5 trial ids are planned but missing: 1, 4, 5, 6, 7;" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    assert sweep.main([*line, "--allow-missing"]) == 0
    rows = {r["split"]: r for r in json.loads(capsys.readouterr().out)["rows"]}
    assert (rows["S0"]["n"], rows["S0"]["sr"], rows["S0"]["n_missing"]) == (4, 50.0, 1)
    assert (rows["S1"]["n"], rows["S1"]["sr"], rows["S1"]["n_missing"]) == (4, 0.0, 4)
    assert load_run(tmp_path / "run").trials("m").num_rows == 8


def test_any_chunk_shard_and_part_gives_the_same_digest(fake, here, tmp_path, capsys):
    write_predictions(
        tmp_path / "p.npz",
        make_predictions(made_trials(40, 40), "m")[torch.arange(0, 80, 3)],
    )
    base = [
        "--benchmark",
        "r2h-v1",
        "--method",
        f"{here}:best",
        "--predictions",
        str(tmp_path / "p.npz"),
        "--allow-missing",
        "--trials",
        "40",
    ]
    digests = set()
    for name, more in (
        ("plain", [[]]),
        ("small", [["--chunk", "3", "--shard-trials", "11"]]),
        ("odd", [["--chunk", "7", "--shard-trials", "80"]]),
        ("parts", [["--shard", f"{i}/3", "--shard-trials", "9"] for i in (2, 1, 3)]),
    ):
        out = str(tmp_path / name)
        for extra in more:
            assert sweep.main([*base, *extra, "--out", out, "--format", "csv"]) == 0
        run = load_run(out)
        digests.add((run.digest("my_rules:best"), run.digest("m")))
        assert run.unfinished == ()
    assert len(digests) == 1


def test_a_part_without_a_shard_says_so_instead_of_that_its_rows_are_stored(fake, here, tmp_path, capsys):
    line = ["--benchmark", "r2h-v1", "--method", f"{here}:best", "--trials", "20", "--out", str(tmp_path / "run")]
    for part, empty in (("2/2", True), ("1/2", False), ("1/2", False)):
        assert sweep.main([*line, "--shard", part]) == 0
        told = capsys.readouterr().err
        assert ("part 2 of 2 has nothing to do, because the 40 trials are 1 shard" in told) == empty, part
    assert "reused" in told


def never(*_, **__):
    raise RuntimeError("too late: something slow has begun")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--object-mesh ok.stl:s0", "FILE:S0, FILE:S1"),
        ("--object-mesh ok.stl:S2", "split is 'S2'"),
        ("--object-mesh ok.stl:S0:handle", "S0 object has no receiver region"),
        ("--object-mesh ok.fbx", "convert it"),
        ("--object-mesh none.stl", "no file none.stl"),
        ("--object-mesh ok.stl:S1", "needs the receiver's region"),
        ("--robot UR5", "no robot is called 'UR5'"),
        ("--out ok.stl", "ok.stl: cannot be written"),
    ],
)
def test_words_that_cannot_be_meant_are_refused_before_a_benchmark_is_loaded(
    tmp_path, capsys, monkeypatch, line, words
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("r2h_batch.trials.edit.load_benchmark", never)
    monkeypatch.setattr("r2h_batch.trials.load.load_benchmark", never)
    (tmp_path / "ok.stl").write_text("solid")
    assert sweep.main(["--method", "random", *line.split()]) == 2
    told = capsys.readouterr()
    assert told.out == "" and words in told.err and told.err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["ok.stl"]


def test_a_mesh_that_gets_no_trial_is_refused_before_it_is_built(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("r2h_batch.trials.edit.object_from_argument", never)
    (tmp_path / "plane.stl").write_text("solid")
    line = f"--benchmark r2h-v0 --method random --object-mesh {tmp_path}/plane.stl:S0 --trials 2 --out {tmp_path}/run"
    assert sweep.main(line.split()) == 2
    assert "plane gets none of 2 trials of S0" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    with pytest.raises(RuntimeError, match="too late"):  # enough trials: it is built
        sweep.main(line.replace("--trials 2", "--trials 99").split())


def test_a_table_through_the_robot_is_refused_once_and_a_lower_one_is_not(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(jobs, "files_of", never)  # what follows
    text = "protocol: r2h-v0\nobjects: [{built_in: cup}]\ntable: {center: [0, 0, %s], half: [0.475, 0.6, 0.025]}\n"
    path = tmp_path / "high.yaml"
    line = f"--benchmark {path} --method random --splits S0 --trials 2 --execute.sim none --out {tmp_path}/run".split()
    path.write_text(text % 0.5)
    assert sweep.main(line) == 2
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1
    assert "benchmark high" in told.err and "forearm and table" in told.err and "table or home" in told.err
    assert not (tmp_path / "run").exists()
    path.write_text(text % -0.1)
    with pytest.raises(RuntimeError, match="too late"):
        sweep.main(line)
