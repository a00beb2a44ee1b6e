"""Trials, files of answers and evaluators of different benchmarks are not mixed: a line says what to take."""

import copy
import pickle
import re
import sys
from dataclasses import replace
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import torch
from problems import default_evaluator

from r2h_batch import Benchmark, Evaluator, Predictions, load_benchmark
from r2h_batch.base.errors import FileError
from r2h_batch.config import EvalConfig, Thresholds
from r2h_batch.data.people import built_in_people, people_hand_set
from r2h_batch.scene.objects import load_objects, object_digest
from r2h_batch.scene.robot_file import load_robot
from r2h_batch.sweep.command import main as sweep
from r2h_batch.trials.benchmark import trials_digest
from r2h_batch.trials.of_run import benchmark_of_run
from r2h_batch.trials.predictions import Answers, check_benchmark, load_answers, write_predictions

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
        "--execute.sim",
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


def test_memory_of_a_benchmark_stays_where_it_is_when_it_goes_to_a_worker():
    """What was drawn from it reads that memory; torch moves that of a tensor that it sends to a spawned process."""
    benchmark = load_benchmark("r2h-v2")
    own = replace(benchmark, hand_set=replace(benchmark.hand_set))
    before = trials_digest(own.trials(3))
    again = pickle.loads(bytes(ForkingPickler.dumps(own)))
    assert not any(t.is_shared() for t in (own.hand_set.side, own.hand_set.shape, own.hand_set.model.vertices))
    assert trials_digest(own.trials(3)) == before == trials_digest(again.trials(3))
    assert copy.copy(own) is own and copy.deepcopy([own])[0] is own


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
        Evaluator(v1, EvalConfig(thresholds=Thresholds(reach_radius_m=0.2)))
    with pytest.raises(TypeError, match="Evaluator\\(config=EvalConfig"):
        Evaluator(EvalConfig())
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
        "r2h-v4": "no benchmark is called 'r2h-v4', did you mean r2h-v",
        "own_benchmark:number": "returned int; it must return a Benchmark",
        "own_benchmark:none": "has no function 'none'",
        "nothing.yaml": "nothing.yaml",
    }.items():
        with pytest.raises(FileError, match=line):
            load_benchmark(given)
    sys.modules.pop("own_benchmark", None)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (
            "def f():\n    raise RuntimeError('two\\nlines')\n",
            r"RuntimeError: two lines \(.*raises.py, line 2\); it must re",
        ),
        ("import sys\ndef f():\n    sys.exit(0)\n", r"SystemExit: 0 \(.*raises.py, line 3\)"),
        ("def f():\n    return f()\n", r"RecursionError: .* \(.*raises.py, line 2\)"),
        ("def f(x):\n    return x\n", r"TypeError: f\(\) missing 1 required .*; it must return a Benchmark"),
        ("raise SystemExit(0)\n", r"SystemExit: 0 \(.*raises.py, line 1\); it must be package"),
        ("def f(:\n", r"SyntaxError: invalid syntax \(raises.py, line 1\); it must be package"),
        ("f = 5\n", "is a int, no function; it must be package"),
    ],
)
def test_code_of_a_benchmark_that_raises_or_leaves_is_refused_in_one_line(code, said, tmp_path, monkeypatch, capsys):
    """`sys.exit(0)` ended a sweep with exit code 0 and no word."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "raises", raising=False)  # of the case before
    (tmp_path / "raises.py").write_text(code)
    line = ["--method", "random", "--trials", "1", "--out", str(tmp_path / "run")]
    assert sweep([*line, "--benchmark", f"{tmp_path}/raises.py:f"]) == 2
    captured = capsys.readouterr()
    sys.modules.pop("raises", None)
    assert captured.out == "" and captured.err.count("\n") == 1
    assert re.search(said, captured.err), captured.err


def test_a_stored_run_brings_no_code():
    header = {"protocol": "mine", "digests": {}, "configuration": {"plan": {"object_collision": "hull"}},
              "benchmark": {"flags": ["--benchmark os:getcwd"]}, "versions": {}}  # fmt: skip
    with pytest.raises(FileError, match=r"given --benchmark os:getcwd; .* --code os:getcwd"):
        benchmark_of_run(header, "run")


@pytest.mark.parametrize("said", ["b/evil.py:pwn", "evil.py:pwn"])
def test_a_file_called_like_a_function_beside_a_stored_run_does_not_run(said, tmp_path, monkeypatch):
    """A file of this very name makes it a path to whoever looks for the run's files."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "run"
    for name in ("run/b", "run"):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
    for name in (run / said, run / "evil.py", tmp_path / said.rpartition("/")[2], tmp_path / "evil.py"):
        name.parent.mkdir(parents=True, exist_ok=True)
        name.write_text("from pathlib import Path\nPath('ran').write_text('')\ndef pwn(): return None\n")
    (run / "b" / "evil.py").write_text((run / said).read_text())
    header = {"protocol": "mine", "digests": {}, "configuration": {"plan": {"object_collision": "hull"}},
              "benchmark": {"flags": [f"--benchmark {said}"]}, "versions": {}}  # fmt: skip
    with pytest.raises(FileError, match=f"given --benchmark {said}; .* --code {said}"):
        benchmark_of_run(header, str(run))
    assert not (tmp_path / "ran").exists()


def other_parts(v1: Benchmark) -> dict[str, Benchmark]:
    """r2h-v1 with one thing exchanged that decides what is asked or how it is judged."""
    first, *rest = v1.objects
    many = load_objects(["cup", "bowl"])
    grown = people_hand_set(built_in_people("adults"))
    listed = v1.trials(3)
    moved = replace(listed, T_world_hand=listed.T_world_hand + 1e-3)

    def with_first(**changes: object) -> Benchmark:
        return v1.with_objects([replace(first, **changes), *rest])

    return {
        "rule": replace(load_benchmark("r2h-v0"), objects=v1.objects, hand_set=v1.hand_set),
        "hands": replace(v1, hand_set=grown),
        "body": replace(v1, receiver="body"),
        "people": replace(v1, people=built_in_people("adults")),
        "other people": replace(v1, people=built_in_people("children")),
        "robot": replace(v1, robot=load_robot("ur10e_2f85")),
        "robot, people as for the UR5e": replace(v1, robot=load_robot("ur10e_2f85"), persons="as-for-ur5e"),
        "limits": replace(v1, thresholds=Thresholds(reach_radius_m=0.08)),
        "place": replace(v1, workplace=v1.workplace.scaled(1.01)),
        "objects": v1.with_objects(many),
        "objects, the other way round": v1.with_objects(many[::-1]),
        "mass": with_first(mass=first.mass + 0.001),
        "split": with_first(split="S1" if first.split == "S0" else "S0"),
        "words": with_first(words=load_objects(["cup_05"])[0].words),
        "roles": with_first(roles={first.part_names[0]: "grasp"}),
        "listed": replace(v1, listed=listed),
        "listed, moved": replace(v1, listed=moved),
    }


def test_all_that_decides_is_in_the_digest_and_names_are_not():
    v1 = load_benchmark("r2h-v1")
    found = {"itself": v1.digest} | {name: b.digest for name, b in other_parts(v1).items()}
    same = [(a, b) for a in found for b in found if a < b and found[a] == found[b]]
    assert same == [] and len(found) > 15
    renamed = replace(v1, name="mine")
    assert renamed.digest == v1.digest and renamed.label == f"mine@{v1.digest}"


def test_answers_to_an_edited_benchmark_of_the_same_name_are_refused_and_to_a_renamed_one_are_not():
    v1 = load_benchmark("r2h-v1")
    trials = replace(v1, thresholds=Thresholds(reach_radius_m=0.08)).trials(1)
    poses = Predictions(trials.trial_id, eye(2), eye(2), method="mine")
    with pytest.raises(FileError, match=r"file: answers trials of benchmark r2h-v1 \(\w{8}\), and r2h-v1 "):
        check_benchmark(Answers(poses, benchmark=trials.benchmark), v1.label, "file")
    with pytest.raises(FileError, match=rf"file: its benchmark is 'r2h-v1', which is no name@digest; .* '{v1.label}'"):
        check_benchmark(Answers(poses, benchmark="r2h-v1"), v1.label, "file")
    renamed = replace(v1, name="mine")
    check_benchmark(Answers(poses, benchmark=renamed.label), v1.label, "file")
    judge = default_evaluator()
    own = replace(judge.benchmark, name="mine").trials(1)
    assert own.benchmark.startswith("mine@") and len(judge.score(eye(2), eye(2), own, "pose")) == 2


def test_a_run_is_judged_by_the_benchmark_that_it_says_to_the_last_limit():
    v1 = load_benchmark("r2h-v1")

    def header(benchmark: Benchmark) -> dict:
        digests = {"objects": object_digest(benchmark.objects), "hand_set": benchmark.hand_set.digest}
        return {
            "protocol": "r2h-v1",
            "digests": {**digests, "benchmark": benchmark.digest},
            "configuration": {"plan": {"object_collision": "hull"}, "receiver": benchmark.receiver},
            "benchmark": {"flags": []},
            "versions": {"r2h_batch": "1"},
        }

    assert benchmark_of_run(header(v1), "run").digest == v1.digest
    body = replace(v1, receiver="body")
    assert benchmark_of_run(header(body), "run").receiver == "body"
    for name in ("limits", "place", "mass", "objects"):
        with pytest.raises(FileError, match=r"run: was made with other .*benchmark"):
            benchmark_of_run(header(other_parts(v1)[name]), "run")
    with pytest.raises(FileError, match="run: --code mine:f: the run names no code"):
        benchmark_of_run(header(v1), "run", ("mine:f",))
