"""The sweep command: what it refuses, prints and stores. The evaluator is a fake except at the end."""

import importlib.util
import json
import os
import resource
import signal
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_runs import NAMES, make_header, make_predictions, make_scores, make_trials

from r2h_batch import sweep
from r2h_batch.predictions import write_predictions
from r2h_batch.results import load_run
from r2h_batch.types import Outcome, Predictions

PLAIN = {k: v for k, v in os.environ.items() if k not in ("HOME", "TERM", "LANG", "LC_ALL")} | {
    "LANG": "C",
    "TERM": "dumb",
}

WITH_HOME = {**os.environ, "LANG": "C", "TERM": "dumb"}  # a home for the kernel cache


def command(*arguments, env=PLAIN):
    line = [sys.executable, "-m", "r2h_batch.sweep", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, env=env, timeout=900, check=False)


# --- the command line -----------------------------------------------------------------------------------------------


def test_help_lists_every_flag_and_answers_at_once():
    def spent() -> (
        float
    ):  # CPU seconds of finished children: what --help costs on an idle core, however busy this one is
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    command("--help")  # writes the byte code
    before = spent()
    done = command("--help")
    seconds = spent() - before
    assert done.returncode == 0 and done.stderr == ""
    for name in ("method", "splits", "trials", "device", "out", "seed", "predictions", "object-mesh", "preset"):
        assert f"--{name}" in done.stdout
    for name in ("format", "save-paths", "threads", "allow-missing", "sim"):
        assert f"--{name}" in done.stdout
    assert seconds < 0.7


def test_help_imports_neither_torch_nor_warp():
    code = (
        "import sys, r2h_batch.sweep as s\ntry: s.main(['--help'])\nexcept SystemExit: pass\nprint(sorted(sys.modules))"
    )
    modules = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    for heavy in ("'torch'", "'warp'", "'numpy'", "'pyarrow'", "'mujoco'"):
        assert heavy not in modules


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("--trails 3 --method random", ["unknown flag --trails", "did you mean --trials?", "--save-paths"]),
        ("--method random -x", ["unknown flag -x", "--method"]),
        (
            "--method randm",
            ["unknown method 'randm'", "did you mean random?", "random, oracle", "package.module:function"],
        ),
        ("--method random --splits S2", ["S2", "'S0', 'S1'"]),
        ("--method random --splits", ["--splits names no split"]),
        ("--method random --trials many", ["--trials", "many"]),
        ("--method random --trials 0", ["--trials is 0", "1 or more"]),
        ("--method random --threads -1", ["--threads is -1", "1 or more"]),
        ("--method random --trials", ["--trials"]),
        ("--method random --preset fast", ["fast", "'default', 'paper'"]),
        ("--method random --format html", ["html", "'md', 'latex', 'csv', 'json'"]),
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


def test_a_typing_error_on_a_plain_terminal_exits_with_2_and_one_ascii_line():
    done = command("--methud", "random")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.isascii() and done.stderr.count("\n") == 1
    assert "did you mean --method?" in done.stderr


def test_several_methods_splits_files_and_meshes_are_taken():
    line = (
        "--method random oracle my.rules:best --splits S1 --predictions a.npz b.safetensors"
        " --object-mesh mug.obj saw.stl:S1 --save-paths --allow-missing --threads 2 --seed 5 --out runs/x"
    )
    options = sweep.parse(line.split())
    assert options.method == ("random", "oracle", "my.rules:best") and options.splits == ("S1",)
    assert options.predictions == ("a.npz", "b.safetensors") and options.object_mesh == ("mug.obj", "saw.stl:S1")
    assert options.save_paths and options.allow_missing
    assert (options.threads, options.seed, options.out) == (2, 5, "runs/x")


# --- the run, with a fake evaluator ---------------------------------------------------------------------------------


class FakeEvaluator:
    """Success where the trial id is even, else a Plan failure; a pose that is not finite is INVALID_INPUT."""

    def __init__(self):
        self.config = SimpleNamespace(chunk=2048)
        self.sizes = []
        objects = [SimpleNamespace(name=n, split=s) for n, s in zip(NAMES.objects, NAMES.object_splits)]
        sides = torch.tensor([("right", "left").index(s) for s in NAMES.hand_sides])
        hands = SimpleNamespace(set=SimpleNamespace(side=sides, digest="h"))
        self.scene = SimpleNamespace(device="cpu", objects=objects, hands=hands, part_names=NAMES.parts)

    def score(self, T_obj_ee, T_world_ee, trials):
        assert T_obj_ee.shape == T_world_ee.shape == (len(trials), 4, 4)
        self.sizes.append(len(trials))
        outcome = np.where(trials.trial_id.numpy() % 2 == 0, Outcome.SUCCESS, Outcome.PLAN)
        outcome[~torch.isfinite(T_world_ee).all(-1).all(-1).numpy()] = Outcome.INVALID_INPUT
        return make_scores(trials, outcome)


@pytest.fixture
def fake(monkeypatch):
    """Replaces everything that needs geometry; `fake.evaluator` is the one of the last run."""
    state = SimpleNamespace(evaluator=None)

    def prepare(options):
        n = {s: options.trials if s in options.splits else 0 for s in ("S0", "S1")}
        trials = make_trials(n["S0"], n["S1"])
        state.evaluator = FakeEvaluator()
        planned = {s: k for s, k in n.items() if k}
        header = make_header(0, 0, trials=planned, seed=options.seed, save_paths=options.save_paths)
        return state.evaluator, trials, header

    monkeypatch.setattr(sweep, "_prepare", prepare)
    return state


def best(trials, scene, *, seed):
    """A user's method: a pose that depends on trial id and seed only."""
    T = torch.eye(4).repeat(len(trials), 1, 1)
    T[:, 0, 3] = trials.trial_id.float() + 1000 * seed
    return T, T + len(scene.objects)


def timed(trials, scene, *, seed):
    """A user's method with its own clock."""
    T_obj_ee, T_world_ee = best(trials, scene, seed=seed)
    return Predictions(trials.trial_id, T_obj_ee, T_world_ee, torch.full((len(trials),), 0.25), "ignored")


def wrong(trials, scene, *, seed):
    """A user's method that forgets half of the trials."""
    return tuple(p[::2] for p in best(trials, scene, seed=seed))


class Interrupted:
    """Called as a method, it presses Ctrl-C."""

    def __call__(self, trials, scene, *, seed):
        signal.raise_signal(signal.SIGTERM)


@pytest.fixture
def here(monkeypatch):
    """The name under which this file's methods can be imported."""
    monkeypatch.setitem(sys.modules, "my_rules", sys.modules[__name__])
    return "my_rules"


def test_the_table_goes_to_stdout_and_everything_else_to_stderr(fake, here, tmp_path, capsys):
    out = tmp_path / "run"
    assert sweep.main(["--method", f"{here}:best", "--trials", "6", "--out", str(out), "--format", "csv"]) == 0
    captured = capsys.readouterr()
    lines = captured.out.splitlines()
    assert lines[0].startswith("split,method,") and [r.partition(",")[0] for r in lines[1:]] == ["S0", "S1", "Avg"]
    assert captured.err.splitlines()[-1] == f"run folder: {out}"
    assert "12 trials in" in captured.err and "trials/s" in captured.err
    assert "\x1b" not in captured.err and "\r" not in captured.err


def test_what_was_scored_and_how_is_in_the_run_folder(fake, here, tmp_path):
    out = tmp_path / "run"
    line = [
        "--method",
        f"{here}:best",
        f"{here}:timed",
        "--trials",
        "300",
        "--seed",
        "2",
        "--save-paths",
        "--out",
        str(out),
    ]
    assert sweep.main(line) == 0
    run = load_run(out)
    assert run.methods == ("my_rules:best", "my_rules:timed")
    assert fake.evaluator.sizes == [32, 256, 256, 88] * 2
    trials = make_trials(300, 300)
    expected, _ = best(trials, fake.evaluator.scene, seed=2)
    for method in run.methods:
        poses = run.poses(method)
        assert np.array_equal(np.array(poses["T_obj_ee"].to_pylist(), np.float32).reshape(-1, 4, 4), expected.numpy())
        table = run.trials(method)
        assert table["trial_id"].to_pylist() == list(range(600))
        assert table["outcome"].to_pylist() == ["success", "plan"] * 300
        assert run.paths(method)["trial_id"].to_pylist() == list(range(0, 600, 2))
    assert run.trials("my_rules:timed")["t_method_s"].to_pylist() == [0.25] * 600
    assert all(0 < s < 1 for s in run.trials("my_rules:best")["t_method_s"].to_pylist())


@pytest.mark.parametrize("suffix", [".npz", ".safetensors"])
def test_a_predictions_file_in_any_order_is_scored_as_what_it_is(fake, tmp_path, suffix, capsys):
    made = make_predictions(make_trials(4, 4), "Mine (learned)")
    made.T_world_ee[5] = float("nan")
    order = torch.tensor([7, 3, 0, 5, 1, 2, 6, 4])
    write_predictions(tmp_path / f"p{suffix}", made[order])
    file, out = str(tmp_path / f"p{suffix}"), str(tmp_path / "run")
    assert sweep.main(["--predictions", file, "--trials", "4", "--out", out, "--format", "json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(r["split"], r["method"], r["sr"], r["n_invalid_input"]) for r in rows][:2] == [
        ("S0", "Mine (learned)", 50.0, 0),
        ("S1", "Mine (learned)", 50.0, 1),
    ]
    run = load_run(out)
    stored = np.array(run.poses("Mine (learned)")["T_world_ee"].to_pylist(), np.float32).reshape(-1, 4, 4)
    assert stored.tobytes() == made.T_world_ee.numpy().tobytes()
    assert run.trials("Mine (learned)")["t_method_s"].null_count == 8
    assert run.entry("Mine (learned)")["source"]["file"] == file


def test_missing_predictions_are_refused_or_counted_as_failures(fake, tmp_path, capsys):
    write_predictions(tmp_path / "p.npz", make_predictions(make_trials(4, 4), "m")[torch.tensor([0, 2, 3])])
    line = [
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


def test_methods_may_be_added_later_and_stored_ones_are_not_scored_again(fake, here, tmp_path, capsys):
    out = ["--trials", "3", "--out", str(tmp_path / "run"), "--format", "csv"]
    assert sweep.main(["--method", f"{here}:best", *out]) == 0
    assert sweep.main(["--method", f"{here}:best", f"{here}:timed", *out]) == 0
    captured = capsys.readouterr()
    assert "my_rules:best: already in the run folder" in captured.err
    assert len(fake.evaluator.sizes) == 2
    assert captured.out.count("my_rules:timed") == 3


@pytest.mark.parametrize("change", [["--trials", "4"], ["--seed", "1"], ["--save-paths"], ["--splits", "S0"]])
def test_another_configuration_in_the_same_folder_is_refused(fake, here, tmp_path, capsys, change):
    line = ["--method", f"{here}:best", "--trials", "3", "--out", str(tmp_path / "run")]
    assert sweep.main(line) == 0
    capsys.readouterr()
    assert sweep.main([*line, *change]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "choose another --out" in captured.err and captured.err.count("\n") == 1


def test_the_same_method_name_from_another_file_is_refused_and_the_folder_is_free_again(fake, tmp_path, capsys):
    line = ["--trials", "2", "--out", str(tmp_path / "run"), "--format", "csv"]
    for name, seed in (("a.npz", 0), ("b.npz", 1)):
        write_predictions(tmp_path / name, make_predictions(make_trials(2, 2), "same", seed))
    assert sweep.main(["--predictions", str(tmp_path / "a.npz"), *line]) == 0
    assert sweep.main(["--predictions", str(tmp_path / "b.npz"), *line]) == 2
    assert "already holds 'same' from another source" in capsys.readouterr().err
    assert sweep.main(["--predictions", str(tmp_path / "a.npz"), *line]) == 0


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("no_such_module:f", ["no_such_module", "package.module:function"]),
        ("my_rules:bset", ["bset", "package.module:function"]),
    ],
)
def test_a_method_that_cannot_be_imported_is_refused(fake, here, tmp_path, capsys, name, parts):
    assert sweep.main(["--method", name, "--trials", "3", "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    for part in parts:
        assert part in error
    assert not (tmp_path / "run").exists()


def test_a_method_that_answers_with_another_shape_is_named(fake, here, tmp_path):
    with pytest.raises(TypeError, match=r"my_rules:wrong: T_obj_ee is \(3, 4, 4\); it must be a tensor \(6, 4, 4\)"):
        sweep.main(["--method", f"{here}:wrong", "--trials", "3", "--out", str(tmp_path / "run")])
    assert load_run(tmp_path / "run").methods == ()


def test_two_files_with_one_method_name_are_refused(fake, tmp_path, capsys):
    for name in ("a.npz", "b.npz"):
        write_predictions(tmp_path / name, make_predictions(make_trials(2, 2), "same"))
    files = [str(tmp_path / n) for n in ("a.npz", "b.npz")]
    assert sweep.main(["--predictions", *files, "--trials", "2", "--out", str(tmp_path / "run")]) == 2
    assert "two methods are called 'same'" in capsys.readouterr().err


def test_a_bad_predictions_file_is_refused_before_anything_else_happens(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(sweep, "_prepare", lambda _: pytest.fail("prepared"))
    (tmp_path / "p.npz").write_bytes(b"PK\x03\x04 nothing")
    assert sweep.main(["--predictions", str(tmp_path / "p.npz"), "--out", str(tmp_path / "run")]) == 2
    assert sweep.main(["--predictions", str(tmp_path / "none.npz"), "--out", str(tmp_path / "run")]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 2
    assert "no such file" in captured.err and not (tmp_path / "run").exists()


def test_a_stop_signal_ends_with_130_and_leaves_a_folder_that_can_go_on(fake, here, tmp_path, capsys, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(sys.modules[here], "stop", Interrupted(), raising=False)
    line = ["--trials", "3", "--out", str(tmp_path / "run"), "--format", "csv"]
    try:
        assert sweep.main(["--method", f"{here}:best", f"{here}:stop", *line]) == 130
        assert capsys.readouterr().err.splitlines()[-1].startswith("sweep: interrupted")
        assert load_run(tmp_path / "run").methods == ("my_rules:best",)
        assert not list((tmp_path / "run").rglob("*.tmp"))
        assert sweep.main(["--method", f"{here}:best", f"{here}:timed", *line]) == 0
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_full_disk_is_one_line_and_exit_code_1(fake, here, tmp_path, capsys, monkeypatch):
    def full(*_, **__):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("r2h_batch.results._commit", full)
    assert sweep.main(["--method", f"{here}:best", "--trials", "3", "--out", str(tmp_path / "run")]) == 1
    error = capsys.readouterr().err
    assert error.splitlines()[-1] == "sweep: writing the run folder: No space left on device"
    assert not list((tmp_path / "run").rglob("*.tmp")) and not list((tmp_path / "run").rglob("*.parquet"))


def test_without_out_the_folder_is_named_after_the_time(fake, here, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sweep.main(["--method", f"{here}:best", "--trials", "2"]) == 0
    folder = capsys.readouterr().err.splitlines()[-1].removeprefix("run folder: ")
    assert folder.startswith("runs/2") and load_run(tmp_path / folder).methods == ("my_rules:best",)


# --- with the evaluator ---------------------------------------------------------------------------------------------

needs_evaluator = pytest.mark.skipif(
    any(
        importlib.util.find_spec(f"r2h_batch.{m}") is None
        for m in ("evaluate", "trials", "methods.random", "methods.oracle")
    ),
    reason="r2h_batch.evaluate, trials and methods are not there yet",
)


@needs_evaluator
def test_random_and_oracle_over_both_splits_on_a_plain_terminal(tmp_path):
    line = ["--method", "random", "oracle", "--trials", 6, "--out", tmp_path / "run", "--save-paths"]
    done = command(*line, env=WITH_HOME)
    assert done.returncode == 0, done.stderr
    assert done.stdout.isascii() and done.stdout.startswith("preset: default")
    assert done.stderr.splitlines()[-1] == f"run folder: {tmp_path / 'run'}"
    run = load_run(tmp_path / "run")
    assert run.methods == ("random", "oracle")
    for method in run.methods:
        table = run.trials(method)
        assert table.num_rows == 12 and run.poses(method).num_rows == 12
        assert len(set(table["object"].to_pylist())) == 12
        has_path = [r["trial_id"] for r in table.to_pylist() if r["t_exec_s"] is not None]  # all come to rest
        assert run.paths(method)["trial_id"].to_pylist() == has_path
    outcomes = run.trials("oracle")["outcome"].to_pylist()
    assert outcomes.count("success") >= 10


@needs_evaluator
def test_a_methods_stored_poses_scored_as_a_file_give_the_same_rows(tmp_path):
    first = command("--method", "random", "--trials", 8, "--out", tmp_path / "a", env=WITH_HOME)
    assert first.returncode == 0, first.stderr
    run = load_run(tmp_path / "a")
    poses = run.poses("random")
    parts = [torch.tensor(poses[k].to_pylist()).reshape(-1, 4, 4) for k in ("T_obj_ee", "T_world_ee")]
    order = torch.randperm(len(parts[0]), generator=torch.Generator().manual_seed(1))
    ids = torch.tensor(poses["trial_id"].to_pylist())
    write_predictions(tmp_path / "p.safetensors", Predictions(ids, *parts, None, "random again")[order])
    second = command("--predictions", tmp_path / "p.safetensors", "--trials", 8, "--out", tmp_path / "b", env=WITH_HOME)
    assert second.returncode == 0, second.stderr
    timing = ["t_plan_s", "t_method_s"]
    a, b = (r.drop_columns(timing) for r in (run.trials("random"), load_run(tmp_path / "b").trials("random again")))
    assert a.equals(b)


@needs_evaluator
def test_sim_chooses_the_engine_and_run_json_names_it(tmp_path):
    found = {}
    for sim in ("auto", "none", "mjwarp"):
        done = command("--method", "random", "--trials", 6, "--sim", sim, "--out", tmp_path / sim, env=WITH_HOME)
        assert done.returncode == 0, done.stderr
        run = load_run(tmp_path / sim)
        header = json.loads((tmp_path / sim / "run.json").read_text())
        found[sim] = header["motion"], header["configuration"]["execute"]["sim"], run.trials("random")
    assert found["auto"][:2] == ({"engine": "mujoco", "step_s": 0.002, "sample_s": 0.008}, "mujoco")
    assert found["none"][:2] == ({"engine": "none", "step_s": None, "sample_s": None}, "none")
    assert found["mjwarp"][0]["engine"] == found["mjwarp"][1] == "mjwarp"
    times = {k: [t for t in v[2]["t_exec_s"].to_pylist() if t is not None] for k, v in found.items()}
    assert len(times["auto"]) >= 4 and times["auto"] == pytest.approx(times["mjwarp"], abs=0.009)
    assert all(0.02 < a - b < 0.3 for a, b in zip(times["none"], times["auto"], strict=True))  # 1 mm before the end
    assert found["auto"][2]["outcome"].equals(found["none"][2]["outcome"])


@needs_evaluator
def test_another_device_without_a_gpu_is_refused():
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    done = command("--method", "random", "--trials", 1, "--device", "cuda")
    assert done.returncode == 2 and done.stdout == "" and "no CUDA device" in done.stderr
