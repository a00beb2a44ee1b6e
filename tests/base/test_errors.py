"""The family of the user's errors, and what the command line alone makes of it."""

import ast
import builtins
from pathlib import Path

import pytest

import r2h_batch
from r2h_batch.base import errors
from r2h_batch.base.command_line import exit_code_of

CONTROL = {"Stopped", "NothingFits", "PluginError", "Ended"}
"""No user reads them: whoever calls catches them (those of plug-ins are below base; commands make one line of them)."""


@pytest.mark.check
@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.UserError, 2),
        (errors.FileError, 2),
        (errors.UsageError, 2),
        (errors.AnswerError, 2),
        (errors.MachineError, 1),
    ],
)
def test_the_command_line_makes_one_line_and_an_exit_code_of_every_error_of_the_family(error, code, capsys):
    def work():
        raise type("OfSomeRoom", (error,), {})("a.npz: given 3;\nallowed is 4")

    assert exit_code_of("trials", work) == code
    assert capsys.readouterr().err == "trials: a.npz: given 3; allowed is 4\n"


def test_another_error_is_ours_and_keeps_its_traceback():
    def work():
        raise KeyError("of a slip of our own")

    with pytest.raises(KeyError):
        exit_code_of("trials", work)


def test_every_class_of_error_that_a_user_meets_is_of_the_family():
    bases = {c.__name__: {c.__name__} for c in (errors.UserError, errors.MachineError)}
    others = {}
    for path in Path(r2h_batch.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and node.name not in bases:
                others[node.name] = {ast.unparse(base) for base in node.bases}
    family, before = set(bases), 0
    while before < len(family):
        before = len(family)
        family |= {name for name, above in others.items() if above & family}
    built_in = {n for n, c in vars(builtins).items() if isinstance(c, type) and issubclass(c, BaseException)}
    assert {"FileError", "UsageError", "RunError", "RenderError"} < family
    assert {name for name, above in others.items() if above & built_in} == CONTROL


def test_the_only_word_that_begins_as_the_given_one_is_the_nearest():
    names = ["r2h-v1", "r2h-v2", "r2h-v3-more"]
    assert errors.nearest("r2h-v3", names) == ", did you mean r2h-v3-more?"
    assert errors.nearest("r2h-v", names) == ", did you mean r2h-v2?"  # several begin so: the nearest letters
    assert errors.nearest("zzzz", names) == ""
