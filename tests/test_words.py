"""Docstrings say first what a thing is: a noun or a verb, not what somebody may ask about it."""

import ast
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("r2h_batch", "kernels", "assets", "bench", "tests", "tools", "examples")
FIRST = ("Of", "What")
RIDDLES = ("that is none", "that are none", "so-manieth", "shall be", "nobody's")


def docstrings(source: str) -> list[tuple[int, str]]:
    """(line, text) of modules, classes, functions, and of the constants and fields that strings follow."""
    found = []
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        for line in body if isinstance(body, list) else ():
            if (
                isinstance(line, ast.Expr)
                and isinstance(line.value, ast.Constant)
                and isinstance(line.value.value, str)
            ):
                found.append((line.lineno, line.value.value.strip()))
    return found


def sources(folder: str) -> list[Path]:
    listed = subprocess.run(["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in listed.split() if name.endswith(".py") and (ROOT / name).exists()]


@pytest.mark.check
@pytest.mark.parametrize("folder", FOLDERS)
def test_no_docstring_begins_with_of_or_what_or_holds_a_riddle(folder: str) -> None:
    files = sources(folder)
    wrong, count = [], 0
    for path in files:
        for line, text in docstrings(path.read_text(encoding="utf-8")):
            count += 1
            riddle = next((r for r in RIDDLES if r in " ".join(text.split())), "")
            if text.split(" ", 1)[0].rstrip(":,") in FIRST or riddle:
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {text[:60]!r}")
    assert files and count > 10 and wrong == []


def test_docstrings_of_constants_and_fields_are_found() -> None:
    source = '"""A."""\nX = 1\n"""Of X."""\nclass C:\n    """C."""\n    y: int\n    """What y is."""\n'
    assert sorted(text for _, text in docstrings(source)) == ["A.", "C.", "Of X.", "What y is."]
