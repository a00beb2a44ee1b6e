"""One command and its subcommands: what they are called, how they refuse, what `--help` imports."""

import ast
import re
import subprocess
import sys
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import pytest

from r2h_batch.__main__ import COMMANDS, main
from r2h_batch.base.command_line import counted
from r2h_batch.base.gone import GONE
from r2h_batch.sweep.options import FIRST, GROUPS, Flags, full_help
from r2h_batch.sweep.settings import settings

NESTED = (
    "results verify",
    "results digest",
    "results reevaluate",
    "results rethreshold",
    "results reception",
    "study ratings",
    "study real",
    *(f"export {kind}" for kind in ("trials", "scene", "release", "real", "views")),
)


def helped(capsys, *line):
    with pytest.raises(SystemExit) as stop:
        main([*line, "--help"])
    assert not stop.value.code
    return capsys.readouterr().out


def test_help_names_the_program_as_it_was_called_and_lists_the_subcommands(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    for name in (*COMMANDS, *NESTED):
        assert helped(capsys, *name.split()).startswith(f"usage: r2h-batch {name} ")
    out = helped(capsys)
    assert out.startswith("usage: r2h-batch") and all(name in out for name in COMMANDS)
    assert len(out.splitlines()) <= 25
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("r2h_batch 0")


HELP_OF_ALL = """
import sys
from dataclasses import fields
from r2h_batch.__main__ import COMMANDS, main
for name in COMMANDS:
    try: main([name, "--help"])
    except SystemExit: pass
    heavy = {"torch", "warp", "numpy", "pyarrow", "scipy", "mujoco", "trimesh", "pydantic"} & set(sys.modules)
    if heavy: sys.exit(f"{name} --help imports {heavy}")
"""


JUDGED = """
import sys
from r2h_batch import Evaluator, load_benchmark
from r2h_batch.methods import random
judge, trials = Evaluator(), load_benchmark().trials(1)
answer = random.predict(trials, judge.scene)
assert len(judge.score(answer.T_obj_ee, answer.T_world_ee, trials).success) == 2
slow = {"scipy", "trimesh", "matplotlib", "pandas", "mujoco_warp", "sympy"} & set(sys.modules)
if slow: sys.exit(f"judging imports {slow}")
"""


@pytest.mark.parametrize("name", ["view", "report", "compare", "export trials", "export scene", "results reception"])
def test_help_shows_lists_as_dots_and_no_empty_word(capsys, name):
    out = helped(capsys, *name.split(), *(["--help-all"] if name == "export scene" else []))
    assert "..." in out and not re.findall(r"\[[A-Z{][^]\n]*\.\.\.\]|\{,", out)


def test_the_help_of_a_command_loads_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", HELP_OF_ALL], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.count("usage: ") == len(COMMANDS), done.stderr


def test_who_judges_waits_for_no_library_that_judging_does_not_need():
    done = subprocess.run([sys.executable, "-c", JUDGED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (["sweep", "--method", "random", "--robot", ""], "--robot has no value; write one, or leave --robot out"),
        (["sweep", "--method", "random", "--people="], "--people has no value"),
        (["sweep", "--method", "random", "--turn", ""], "--turn has no value"),
        (["results", "rethreshold", "x", "--reach-radius", ""], "--reach-radius has no value"),
        (["report", ""], "an argument is empty"),
    ],
)
def test_an_empty_word_is_refused_and_does_not_mean_the_default(line, named, capsys):
    """A script says --robot "$ROBOT": where nothing set the variable, the default robot would be judged."""
    assert main(line) == 2
    error = capsys.readouterr().err
    assert named in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        ("sweeep", ["'sweeep', did you mean sweep?", "results"]),
        ("--hepl", ["did you mean --help?"]),
        ("study rael", ["did you mean real?"]),
        ("report x --fromat md", ["--fromat, did you mean --format?", "--by-object"]),
        ("compare", ["no run folder"]),
        ("results rethreshold x --reach-radios 1", ["did you mean --reach-radius?"]),
        ("export scene x --trail 1 --out y", ["did you mean --trial?"]),
        ("export trials --out x --splits S3", ["--splits is 'S3'", "allowed are S0, S1\n"]),
        (
            "sweep --method random --benchmark r2h-w3",
            ["no benchmark is called 'r2h-w3', did you mean r2h-v3?; allowed are"],
        ),
        (
            "sweep --benchmark r2h-v1 --method random --people adults children",
            ["--people takes one value, and 'children' stands behind it"],
        ),
        (
            "sweep --benchmark r2h-v1 --method random --objects families:*x1000",
            ["x 1,000 of 16 families is 16,000 objects; at most 1,000 are allowed, so write x 1 to x 62"],
        ),
        (
            "sweep --benchmark r2h-v1 --method random --objects families:" + "a" * 9000,
            ["no family is called 'aaaa", "there are "],
        ),
        ("ls", ["ls: missing: one of methods, objects, "]),
        ("why", ["why: missing: run folder of a sweep"]),
        ("ls robot", ["is 'robot', did you mean robots?; allowed are methods, "]),
        (
            "sweep --benchmark r2h-v1 --method random --objects not_there",
            ["not_there: there is no such folder or file; --objects takes"],
        ),
        ("export trials --trials 3", ["--out"]),
        ("sweep --benchmark r2h-v1 --method fc --method random", ["--method is given twice", "--method A B"]),
        ("import robot --urdf x --base b --flange f --out y --package a=1 --package=b=2", ["--package is given twice"]),
    ],
)
def test_what_is_not_understood_is_one_line_with_the_nearest_match_and_exit_code_2(line, parts, capsys):
    assert main(line.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    for part in parts:
        assert part in captured.err


def test_the_help_of_a_sweep_names_every_flag() -> None:
    shown = {*re.findall(r"--[a-z][a-z0-9.-]+", full_help("r2h-batch sweep"))}
    names = [*(f.name for f in fields(Flags)), *settings()]
    assert len(settings()) > 20 and {f"--{name.replace('_', '-')}" for name in names} - shown == set()


def test_the_first_help_of_a_sweep_is_one_screen_of_what_everybody_needs(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = helped(capsys, "sweep")
    lines = text.splitlines()
    assert len(lines) <= 40 and max(map(len, lines)) <= 80
    flags = re.findall(r"^  (--[a-z-]+)", text, re.M)
    eight = ["method", "predictions", "benchmark", "trials", "robot", "preset", "device", "out"]
    assert flags == [*(f"--{name}" for name in eight), "--config"] and list(FIRST) == eight
    assert text.index("--out") < text.index("--help-all")
    assert all(re.search(rf"^  {name} ", text, re.M) for name in (*GROUPS, "configuration"))


def test_the_help_of_a_sweep_names_the_default_of_every_option_that_has_one() -> None:
    entries = re.split(r"\n(?=  \S)", full_help("r2h-batch sweep"))
    told = {e.split()[0].removeprefix("--").replace("-", "_"): " ".join(e.split()) for e in entries if e.strip()}
    for field in fields(Flags):
        set_to = field.default not in ("", (), None) and not isinstance(field.default, bool)
        assert ("default" in told[field.name]) >= set_to, field.name
    assert told["trials"].endswith("(default: 500)") and told["splits"].endswith("(default: S0 S1)")
    assert "default: runs/" in told["out"] and "default" not in told["quiet"]


OTHERS = {"--rule", "--bar", "--head", "--tyro-", "--always", "--dirty", "--abbrev", "--exclude", "--no-deps"}
"""Colours of a page, flags of Ray, tyro, git and pip."""
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*(?:\.[a-z][a-z0-9-]*)?")


def strings(file):
    """The text of a file's strings, without docstrings."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    told = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}
    return [
        n.value
        for n in ast.walk(tree)
        if isinstance(n, ast.Constant) and isinstance(n.value, str) and id(n) not in told
    ]


def test_messages_name_only_flags_that_the_help_of_a_command_names(capsys):
    shown = {"--help", "--version"}
    for name, (where, _) in COMMANDS.items():
        module, function = where.split(":")
        found = getattr(import_module(f"r2h_batch.{module}"), function)
        for line in [[name, sub] for sub in found] if isinstance(found, dict) else [[name]]:
            shown |= {*FLAG.findall(helped(capsys, *line))}
    shown |= {*FLAG.findall(full_help("r2h-batch sweep"))}
    package = Path(import_module("r2h_batch").__file__).parent
    files = [f for f in package.rglob("*.py") if f.name != "play.py"]  # a program of its own, in exported scenes
    named = {(flag, f.name) for f in files for text in strings(f) for flag in FLAG.findall(text)}
    named -= {(flag, "gone.py") for name in GONE for flag in FLAG.findall(name)}
    assert len(named) > 150 and {(flag, name) for flag, name in named if flag not in shown | OTHERS} == set()


@pytest.mark.parametrize("name", [*COMMANDS, *NESTED])
def test_the_help_of_each_command_fits_on_a_screen_and_says_where_the_rest_is(monkeypatch, capsys, name):
    monkeypatch.setenv("COLUMNS", "80")
    text = helped(capsys, *name.split())
    assert len(text.splitlines()) <= 60
    if "--help-all explains them" in text:
        more = re.findall(r"--[a-z-]+", text[text.index("explains them") :].partition(".")[0])
        every = helped(capsys, *name.split(), "--help-all")
        assert "--benchmark" in more and {f for f in more if not re.search(rf"^  {f}(?![a-z-])", every, re.M)} == set()
        assert not [f for f in more if re.search(rf"^  {f}(?![a-z-])", text, re.M)]


@pytest.mark.parametrize(
    ("number", "things", "said"),
    [(1, "people", "1 person"), (2, "people", "2 people"), (1, "hands", "1 hand"), (0, "hands", "0 hands")],
)
def test_one_of_many_things_is_named_in_the_singular(number, things, said):
    assert counted(number, things) == said


def test_too_little_address_space_is_told_in_a_line_before_the_work():
    code = (
        "import resource as r; r.setrlimit(r.RLIMIT_AS, (MOST, -1)); from r2h_batch.__main__ import main;"
        " main(['ls', 'runs', '/nowhere'])"
    )
    said = []
    for limit in ("3 << 30", "-1"):
        line = [sys.executable, "-c", code.replace("MOST", limit)]
        said.append(subprocess.run(line, capture_output=True, text=True, timeout=100).stderr.splitlines())
    words = "`ulimit -v` allows 3.0 GiB of address space, and 4 GiB may be needed; raise it (`ulimit -v unlimited`)"
    assert said[0][0] == f"ls: {words} if the command fails"
    assert not any("ulimit" in line for line in said[1])
