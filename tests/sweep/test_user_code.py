"""How a user's method is found: beside the command, as a file, under a name of its own; also by workers of Ray."""

import sys

import pytest
from fake_bench import set_up as set_up_fake

from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs

RULES = """
import torch
from {helper} import SCALE

def predict(trials, scene, *, seed):
    T = SCALE * torch.eye(4).repeat(len(trials), 1, 1)
    return T, T
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """Two folders with a `uc_rules.py` each, and the path of modules as it was before."""
    for folder, helper in (("here", "uc_helper"), ("there", "uc_other"), ("third", "uc_helper")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "uc_rules.py").write_text(RULES.format(helper=helper))
        (tmp_path / folder / f"{helper}.py").write_text("SCALE = 1.0\n")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(jobs, "set_up", set_up_fake)
    yield tmp_path
    for name in [n for n in sys.modules if n.startswith("uc_")]:
        del sys.modules[name]


@pytest.mark.parametrize(
    ("said", "name", "function"),
    [
        ("uc_rules:predict", "uc_rules:predict", "uc_rules:predict"),
        ("../there/uc_rules.py:predict", "uc_rules.py:predict", "uc_rules.py:predict"),
        ("mine=../there/uc_rules.py:predict", "mine", "uc_rules.py:predict"),
    ],
)
def test_a_method_is_found_beside_the_command_and_as_a_file(place, said, name, function):
    assert sweep.main(["--benchmark", "r2h-v1", "--method", said, "--trials", "3", "--out", "run"]) == 0
    run = load_run("run")
    assert run.methods == (name,) and run.entry(name).source["function"] == function
    assert str(place) not in (place / "here/run/run.json").read_text().partition('"command"')[0]


@pytest.mark.parametrize(
    ("flags", "who"),
    [
        (["--receiver-motion", "moves", "--policy", "uc_wrong.py:act"], "--policy uc_wrong.py:act"),
        (["--objects", "families:uc_wrong.py:FAMILY x 2"], "--objects: uc_wrong.py:FAMILY"),
        (["--predictor", "uc_wrong.py:predict"], "predictor uc_wrong.py:predict"),
    ],
)
@pytest.mark.parametrize(("code", "what"), [("def f(:", "SyntaxError: invalid syntax"), ("exit(0)", "SystemExit: 0")])
def test_code_that_raises_while_it_is_imported_is_refused_in_one_line(
    place, monkeypatch, capsys, flags, who, code, what
):
    monkeypatch.undo()  # the true set_up
    monkeypatch.chdir(place)
    (place / "uc_wrong.py").write_text(code)
    line = ["--benchmark", "r2h-v1", "--method", "contact", "--trials", "3", "--execute.sim", "none", "--out", "run"]
    assert sweep.main([*line, *flags]) == 2
    error = capsys.readouterr().err
    assert who in error and what in error and error.count("\n") == 1, error


@pytest.mark.parametrize("code", ["import numpy as np\nnp.load('none.npy')\n", "import json\njson.loads('{')\n"])
def test_an_error_in_a_library_is_told_by_the_users_own_line(code, place, capsys):
    file = place / "uc_calls.py"
    file.write_text(code)
    assert sweep.main(["--method", f"{file}:predict", "--trials", "1"]) == 2
    said = capsys.readouterr().err
    assert f"({file}, line 2)" in said and "site-packages" not in said


def test_two_files_of_one_name_are_two_methods_and_helpers_of_one_name_are_refused(place, capsys):
    line = [
        "--benchmark",
        "r2h-v1",
        "--method",
        "a=uc_rules.py:predict",
        "b=../there/uc_rules.py:predict",
        "--trials",
        "3",
        "--out",
        "run",
    ]
    assert sweep.main(line) == 0
    run = load_run("run")
    assert run.methods == ("a", "b") and run.entry("a").source["sha256"] != run.entry("b").source["sha256"]
    capsys.readouterr()
    assert (
        sweep.main(
            ["--benchmark", "r2h-v1", "--method", "c=../third/uc_rules.py:predict", "--trials", "3", "--out", "run"]
        )
        == 2
    )
    error = capsys.readouterr().err
    assert "uc_rules.py imports uc_helper, and " in error and "rename one of them" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "replaced"),
    [
        ("Evaluator.score = lambda *a, **k: None", "Evaluator.score"),
        (
            "[setattr(e, 'score', len) for e in gc.get_objects() if type(e).__name__ == 'FakeEvaluator']",
            "FakeEvaluator.score",
        ),
    ],
    ids=["in its class", "in itself"],
)
def test_a_method_that_changes_what_judges_it_is_refused_in_one_line(change, replaced, place, monkeypatch, capsys):
    from r2h_batch.evaluate import Evaluator

    monkeypatch.setattr(Evaluator, "score", Evaluator.score)  # put back at the end
    lines = ["import gc", "from r2h_batch.evaluate import Evaluator", "def predict(trials, scene, *, seed):"]
    lines += [
        f"    {change}",
        "    T = torch.eye(4).repeat(len(trials), 1, 1)",
        "    return T, T",
    ]
    (place / "here" / "uc_evil.py").write_text("\n".join(["import torch", *lines]) + "\n")
    words = ["--benchmark", "r2h-v1", "--method", "uc_evil:predict", "--trials", "3", "--out", "run"]
    assert sweep.main(words) == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert f"method uc_evil:predict: it replaced {replaced}; a method may not change what judges it" in error
