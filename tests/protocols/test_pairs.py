"""Trials, files of answers and evaluators of different benchmarks are not mixed: a line says what to take."""

import pickle
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from problems import default_evaluator

from r2h_batch import Benchmark, Evaluator, Predictions, load_benchmark
from r2h_batch.base.errors import FileError
from r2h_batch.config import Thresholds
from r2h_batch.protocols.benchmark import trials_digest
from r2h_batch.protocols.of_run import benchmark_of_run
from r2h_batch.scene.objects import load_objects
from r2h_batch.scene.robot import load_robot
from r2h_batch.sweep.command import main as sweep
from r2h_batch.trials.predictions import check_benchmark, load_answers, write_predictions

FROZEN = {
    "r2h-v0": ("3bff8fe196d6ec35", "425d5ad2f97d0e45"),
    "r2h-v1": ("e9a7531f1846efa2", "c8a4e8d3732c3426"),
    "r2h-release": ("9cbc6ebf451a6c2b", "77ce88e347fbf381"),
}
"""Digests of the benchmark and of its first 1,000 trials of each split, as at 6ab3d7cc."""


def eye(n: int) -> torch.Tensor:
    return torch.eye(4).repeat(n, 1, 1)


@pytest.mark.check
@pytest.mark.parametrize("name", FROZEN)
def test_a_frozen_benchmark_and_its_trials_never_change(name):
    benchmark = load_benchmark(name)
    assert (benchmark.digest[:16], trials_digest(benchmark.trials(1000))[:16]) == FROZEN[name]


def test_trials_of_another_benchmark_are_refused_by_everything_that_judges():
    judge, trials = default_evaluator(), load_benchmark("r2h-v2").trials(3, splits="S0")
    line = r"are of benchmark r2h-v2 \(\w{8}\), and r2h-v0 \(\w{8}\) is judged here; take trials of evaluator.benchmark"
    for stages in ("pose", "all"):
        with pytest.raises(ValueError, match=line):
            judge.score(eye(3), eye(3), trials, stages)
    with pytest.raises(ValueError, match=line):
        judge.score_motion(eye(3), torch.zeros(3, 2, 6), torch.arange(2.0), trials)
    with pytest.raises(ValueError, match=line):  # some of them, moved and repeated, are still r2h-v2's
        judge.score(eye(2), eye(2), trials[1:].to("cpu").clone())
    other = replace(judge.benchmark, thresholds=Thresholds(reach_radius_m=0.08))
    with pytest.raises(ValueError, match=r"r2h-v0.*r2h-v0"):
        judge.score(eye(2), eye(2), other.trials(1))
    assert (
        len(judge.score(eye(3), eye(3), trials.named(["a"] * 96), "pose")) == 3
    )  # who names them himself vouches for them
    assert len(judge.score(eye(2), eye(2), judge.benchmark.trials(1), "pose")) == 2


def test_trials_know_their_benchmark_wherever_they_go():
    benchmark = load_benchmark("r2h-v1")
    trials = benchmark.trials(4)
    for same in (
        trials,
        trials[2:],
        trials.to("cpu"),
        pickle.loads(pickle.dumps(trials)),
        benchmark.trials_with_ids(trials.trial_id),
    ):
        assert same.benchmark == benchmark.label == f"r2h-v1@{benchmark.digest}"
    assert trials.named(benchmark.objects).benchmark == ""


def test_a_file_of_answers_to_another_benchmark_is_refused_and_one_that_says_nothing_is_told_of(tmp_path, capsys):
    trials, file = load_benchmark("r2h-v2").trials(2), str(tmp_path / "mine.npz")
    answers = Predictions(trials.trial_id, eye(4), eye(4), method="mine")
    write_predictions(file, answers, benchmark=trials.benchmark)
    assert load_answers(file).benchmark == trials.benchmark
    line = [
        "--predictions",
        file,
        "--trials",
        "2",
        "--sim",
        "none",
        "--benchmark",
        "r2h-v1",
        "--out",
        str(tmp_path / "run"),
    ]
    assert sweep(line) == 2
    said = capsys.readouterr().err
    assert "mine.npz: answers trials of benchmark r2h-v2" in said and "r2h-v1" in said and "--benchmark" in said
    np.savez(file, trial_id=trials.trial_id, T_obj_ee=eye(4), T_world_ee=eye(4))
    assert sweep(line) == 0
    assert "does not say its benchmark; it is judged on r2h-v1" in capsys.readouterr().err
    check_benchmark(load_answers(file), trials.benchmark, "mine")
    np.savez(file, trial_id=trials.trial_id, T_obj_ee=eye(4), T_world_ee=eye(4), benchmark=np.array([1.0]))
    with pytest.raises(ValueError, match="'benchmark' is float64"):
        load_answers(file)


def test_a_benchmark_is_a_value_that_is_edited_and_carried(tmp_path):
    v1 = load_benchmark("r2h-v1")
    assert load_benchmark("r2h-v1") is v1
    cup = v1.with_objects(load_objects(["cup"]))
    arm = v1.on(load_robot("ur10e_2f85"))
    assert len({b.digest for b in (v1, cup, arm)}) == 3 and cup.name == "r2h-v1"
    for benchmark in (v1, cup, arm, load_benchmark("r2h-v2")):
        again = pickle.loads(pickle.dumps(benchmark))
        assert again.digest == benchmark.digest and trials_digest(again.trials(2, splits="S0")) == trials_digest(
            benchmark.trials(2, splits="S0")
        )
    assert len(pickle.dumps(v1)) < 1_500_000  # objects by name: only the hands travel
    with pytest.raises(AttributeError):
        v1.name = "other"
    with pytest.raises(
        ValueError, match=r"config.thresholds is .*say one: dataclasses.replace\(benchmark, thresholds=...\)"
    ):
        Evaluator(load_benchmark("r2h-v1"), v1)
    with pytest.raises(TypeError, match="Evaluator\\(config=EvalConfig"):
        Evaluator(load_benchmark("r2h-v1"))
    with pytest.raises(ValueError, match="receiver is body, trials of r2h-v0 have none; take a benchmark of people"):
        replace(load_benchmark("r2h-v0"), receiver="body")


def test_a_benchmark_comes_by_name_file_or_function_and_a_typo_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("format: 1\nprotocol: r2h-v0\nobjects: [{built_in: cup}]\n")
    (tmp_path / "benchmark.yaml").write_text("format: 1\nprotocol: r2h-v1\n")
    (tmp_path / "own_benchmark.py").write_text(
        "from dataclasses import replace\nfrom r2h_batch import load_benchmark\n"
        "def mine():\n    return replace(load_benchmark('r2h-v1'), name='mine', receiver='body')\n"
        "def number():\n    return 3\n"
    )
    assert [o.name for o in load_benchmark("mine.yaml").objects] == ["cup"] and load_benchmark(
        "mine.yaml"
    ).name == "mine"
    assert load_benchmark(tmp_path).digest == load_benchmark("r2h-v1").digest
    mine = load_benchmark("own_benchmark:mine")
    assert isinstance(mine, Benchmark) and mine.receiver == "body" and mine.name == "mine"
    for given, line in {
        "r2h-v3": "no benchmark is called 'r2h-v3', did you mean r2h-v",
        "own_benchmark:number": "returned int; it must return a Benchmark",
        "own_benchmark:none": "has no function 'none'",
        "nothing.yaml": "nothing.yaml",
    }.items():
        with pytest.raises(FileError, match=line):
            load_benchmark(given)
    sys.modules.pop("own_benchmark", None)


def test_a_stored_run_brings_no_code():
    header = {"protocol": "mine", "digests": {}, "configuration": {"plan": {"object_collision": "hull"}},
              "benchmark": {"flags": ["--benchmark os:getcwd"]}, "versions": {}}  # fmt: skip
    from r2h_batch.protocols.choice import BenchmarkChoice

    with pytest.raises(FileError, match="give what its sweep was given: --benchmark os:getcwd"):
        benchmark_of_run(header, BenchmarkChoice(), "run")
