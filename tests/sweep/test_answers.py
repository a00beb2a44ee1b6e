"""Nobody changes what is judged: answers of methods are checked, and stored rows are those of the plan."""

import io
import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import torch
from fake_bench import best
from fake_bench import set_up as set_up_fake
from made_runs import NAMES, make_header, make_scores
from made_runs import made_trials as planned

from r2h_batch import load_benchmark
from r2h_batch.base.errors import AnswerError
from r2h_batch.base.registry import DEFAULT_BENCHMARK
from r2h_batch.runs.files import RunError
from r2h_batch.runs.store import load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs
from r2h_batch.sweep.answers import answer_of
from r2h_batch.sweep.rows import detail_rows, score_rows
from r2h_batch.trials.predictions import write_predictions
from r2h_batch.types import Predictions

# --- what a method answers ------------------------------------------------------------------------------------------


@pytest.fixture
def trials():
    return load_benchmark("r2h-v1").trials(2, splits=("S0", "S1"))


def poses(trials, dtype=torch.float32):
    return torch.eye(4, dtype=dtype).repeat(len(trials), 1, 1)


def raise_(error):
    raise error


WRONG = {
    "nothing": (lambda t: None, "its answer is a NoneType; it must be r2h_batch.Predictions or"),
    "half of the rows": (lambda t: (poses(t)[::2], poses(t)), r"T_obj_ee is torch.float32 \(2, 4, 4\)"),
    "half precision": (lambda t: (poses(t), poses(t).half()), "T_world_ee is torch.float16"),
    "meta": (lambda t: (poses(t), poses(t).to("meta")), "T_world_ee has no memory for its numbers"),
    "sparse": (lambda t: (poses(t).to_sparse(), poses(t)), r"T_obj_ee is a tensor of layout sparse_coo; .*to_dense"),
    "time runs backwards": (lambda t: (poses(t), poses(t), torch.full((4,), -1.0)), "t_method_s is -1; 0 to"),
    "another order": (
        lambda t: Predictions(t.trial_id.flip(0), poses(t), poses(t)),
        "trial_id differs from that of the 4 trials",
    ),
    "the end of the program": (lambda t: sys.exit(0), r"SystemExit: 0 \(.*test_answers.py, line \d+\)"),
    "an error that does not say what it is": (
        lambda t: raise_(type("Silent", (RuntimeError,), {"__str__": lambda self: 1 / 0})()),
        "Silent: an error whose text cannot be had",
    ),
    "an error of no kind": (lambda t: raise_(BaseException("mine")), "BaseException: mine"),
    "its own error": (lambda t: [][0], r"IndexError: list index out of range \(.*test_answers.py, line \d+\)"),
}


@pytest.mark.check
@pytest.mark.parametrize("case", WRONG)
def test_an_answer_that_cannot_be_scored_names_method_and_argument(trials, case):
    answer, words = WRONG[case]
    with pytest.raises(AnswerError, match=f"method mine: {words}") as error:
        answer_of("mine", trials, answer)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("what", ["none", "closed", "another"])
def test_what_a_method_prints_goes_to_stderr_and_its_streams_end_with_its_call(trials, what, capsys):
    def prints(mine):
        print("hello")
        if what == "closed":
            sys.stdout.close()
        sys.stdout = sys.stderr = None if what == "none" else io.StringIO()
        return poses(mine), poses(mine)

    before = sys.stdout, sys.stderr
    answer_of("mine", trials, prints)
    assert (sys.stdout, sys.stderr) == before
    out, err = capsys.readouterr()
    assert out == "" and err == ("" if what == "closed" else "mine printed: hello\n")


def test_a_method_reaches_neither_the_trials_nor_the_answers_that_are_judged(trials):
    before, kept = trials.clone(), {}

    def cheats(mine):
        kept["mine"], kept["answer"] = mine, poses(mine)
        for value in vars(mine).values():
            if isinstance(value, torch.Tensor):  # names beside them: a tuple
                value.zero_()
        return kept["answer"], kept["answer"]

    given = answer_of("cheats", trials, cheats)
    kept["answer"].zero_()
    for name, value in vars(before).items():
        now = getattr(trials, name)
        assert torch.equal(now, value) if isinstance(value, torch.Tensor) else now == value
    assert torch.equal(given.T_obj_ee, poses(trials)) and torch.equal(given.trial_id, before.trial_id)


# --- in a sweep -----------------------------------------------------------------------------------------------------

CHEAT = """
import torch

def honest(trials, scene, *, seed):
    T = torch.eye(4, dtype=torch.float32).repeat(len(trials), 1, 1)
    T[:, 2, 3] = 0.4
    return torch.eye(4).repeat(len(trials), 1, 1), T

def cheats(trials, scene, *, seed):
    answer = honest(trials, scene, seed=seed)
    trials.T_world_hand[:] = torch.eye(4)
    trials.T_world_hand[:, 0, 3] = 5.0
    trials.object_index.zero_()
    trials.trial_id.add_(2)
    return answer
"""


def test_poses_get_the_same_rows_from_a_method_that_edits_its_trials_and_from_a_file(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_cheat.py").write_text(CHEAT)
    monkeypatch.syspath_prepend(tmp_path)
    planned = load_benchmark("r2h-v1").trials(4, splits=("S0", "S1"))
    import my_cheat

    write_predictions(tmp_path / "p.npz", Predictions(planned.trial_id, *my_cheat.honest(planned, None, seed=0)))
    out = tmp_path / "run"
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "my_cheat:cheats",
        "--predictions",
        str(tmp_path / "p.npz"),
        "--trials",
        "4",
        "--execute.sim",
        "none",
    ]
    try:
        assert sweep.main([*line, "--save-paths", "--out", str(out)]) == 0
    finally:
        sys.modules.pop("my_cheat", None)
    run = load_run(out)
    assert run.digest("my_cheat:cheats") == run.digest("unnamed")
    assert run.details("unnamed")["hand_index"].to_pylist() == planned.hand_index.tolist()


@pytest.fixture
def fake(monkeypatch):
    """The sweep on a fake evaluator, with methods of a module `mine`."""
    mine = type(sys)("mine")

    def late(trials, scene, *, seed):
        return *best(trials, scene, seed=seed), torch.full((len(trials),), -1.0)

    mine.late, mine.best, mine.number = late, best, 3
    mine.other = lambda a, b, c, *, seed: None
    monkeypatch.setitem(sys.modules, "mine", mine)
    monkeypatch.setattr(jobs, "set_up", set_up_fake)


def test_other_methods_finish_when_one_answers_nonsense(fake, tmp_path, capsys):
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "mine:late",
        "mine:best",
        "--trials",
        "3",
        "--out",
        str(tmp_path / "run"),
    ]
    assert sweep.main(line) == 2
    captured = capsys.readouterr()
    (said,) = [x for x in captured.err.splitlines() if "t_method_s" in x]
    assert said == (
        "sweep: method mine:late: t_method_s is -1; 0 to 1e+09 seconds are allowed, NaN where it was not measured"
    )
    assert "mine:best" in captured.out and "Traceback" not in captured.err
    run = load_run(tmp_path / "run")
    assert run.methods == ("mine:best",) and run.trials("mine:best").num_rows == 6
    assert (
        sweep.main(["--benchmark", "r2h-v1", "--method", "mine:late", "--trials", "3", "--out", str(tmp_path / "run")])
        == 2
    )
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("mine:number", "--method mine:number: 3 is not a callable object; it must be package.module:function"),
        ("mine:other", "--method mine:other: missing a required argument: 'c'; it must be package.module:function"),
        ("mine:none", "mine has no function 'none'; it must be package.module:function"),
        ("broken_rules:f", "--method broken_rules:f: SystemExit: 7 ("),
    ],
)
def test_a_method_that_is_none_is_refused_before_any_preparation(fake, monkeypatch, tmp_path, capsys, spec, words):
    (tmp_path / "broken_rules.py").write_text("raise SystemExit(7)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(jobs, "set_up", lambda request: pytest.fail("prepared before the method was looked for"))
    assert sweep.main(["--benchmark", "r2h-v1", "--method", spec, "--trials", "3", "--out", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("def predcit(trials, scene): ...\n", "FILE has no function 'predict', did you mean predcit?; it must be"),
        (
            "print 'hello'\n",
            "SyntaxError: Missing parentheses in call to 'print'. Did you mean print(...)? (FILE, line 1)",
        ),
        ("import torch\nimport no_such\n", "ModuleNotFoundError: No module named 'no_such' (FILE, line 2)"),
    ],
)
def test_what_a_module_raises_is_told_with_its_line_and_a_misspelt_function_with_the_nearest(
    fake, tmp_path, capsys, text, said
):
    file = tmp_path / "near_rules.py"
    file.write_text(text)
    assert sweep.main(["--method", f"{file}:predict", "--trials", "3", "--out", str(tmp_path / "run")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    shown = line.replace(str(file), "FILE").replace(f"({file.name},", "(FILE,")
    assert said in shown
    # how a method is named is no help where it was found, and raised an error
    assert ("it must be package.module:function" in line) == ("has no function" in said)


# --- stored rows and the plan ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "ids", "words"),
    [
        ("trials", [0, 0, 4, 6, 1, 3, 5, 7], "its trial_id are not in the order of the plan, each once"),
        ("trials", [0, 2, 40, 6, 1, 3, 5, 7], "trial_id 40 is not planned here"),
        ("details", [0, 2, 4, 6, 1, 3, 5, 9], "trial_id 9 is not planned here"),
    ],
)
def test_rows_that_are_not_the_plans_are_not_written(tmp_path, kind, ids, words):
    run = open_run(tmp_path / "run", make_header(4, 4, protocol=DEFAULT_BENCHMARK, stored=["details"]))
    run.register("m", {"kind": "test"})
    (shard,) = run.todo("m")
    trials = replace(planned(4, 4), trial_id=load_benchmark("r2h-v1").trials(4, splits=("S0", "S1")).trial_id)
    scores = make_scores(trials, np.zeros(8, int))
    rows = {"trials": score_rows(trials, scores, NAMES), "details": detail_rows(trials, scores, NAMES)}
    wrong = rows | {kind: rows[kind].set_column(0, rows[kind].schema.field(0), pa.array(ids, pa.int64()))}
    with pytest.raises(RunError, match=f"{kind}: {words}; nothing was stored"), run.write("m", shard) as writer:
        writer.append(**wrong)
    assert not list((tmp_path / "run").rglob("*.parquet"))
    with run.write("m", shard) as writer:
        writer.append(**rows)
    assert load_run(tmp_path / "run").trials("m").num_rows == 8
