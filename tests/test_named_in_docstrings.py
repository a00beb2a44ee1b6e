"""Modules and files that docstrings name are there."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.usefixtures("syntax_trees")


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


ROOMS = [p.name for p in (ROOT / "r2h_batch").iterdir() if (p / "__init__.py").exists()]
DOTTED = re.compile(rf"(?<![\w./\"])(?:r2h_batch\.)?((?:{'|'.join(ROOMS)}|kernels)(?:\.[a-z_]\w*)+)(?!\w*\()")
IN_PATH = re.compile(r"(?<![\w./])((?:[a-z_]+/)+[a-z_0-9]+\.py)")
FILES = ("csv", "html", "json", "md", "npz", "py", "xml")
OTHERS = ("acronym_tools/acronym.py",)
"""Files of other projects that docstrings name."""


def is_there(dotted: str) -> bool:
    """Whether a dotted name leads to a folder, a module, or a name that its module's text has."""
    at = ROOT if dotted.startswith("kernels") else ROOT / "r2h_batch"
    parts = dotted.split(".")
    for i, part in enumerate(parts):
        if (at / part).is_dir():
            at = at / part
            continue
        module, rest = (
            (at / f"{part}.py", parts[i + 1 :]) if (at / f"{part}.py").exists() else (at / "__init__.py", [part])
        )
        text = module.read_text(encoding="utf-8") if module.exists() else ""
        return bool(text) and all(re.search(rf"\b{name}\b", text) for name in rest)
    return True


@pytest.mark.check
def test_modules_and_files_that_docstrings_name_exist() -> None:
    wrong, seen = [], 0
    for path in [p for folder in ("r2h_batch", "kernels") for p in sources(folder)]:
        for line, text in docstrings(path.read_text(encoding="utf-8")):
            for name in DOTTED.findall(text):
                seen += 1
                if name.rpartition(".")[2] not in FILES and not is_there(name):
                    wrong.append(f"{path.relative_to(ROOT)}:{line}: {name}")
            for name in IN_PATH.findall(text):
                seen += 1
                if name not in OTHERS and not any(
                    (base / name).exists() for base in (ROOT, ROOT / "r2h_batch", ROOT / "kernels", path.parent)
                ):
                    wrong.append(f"{path.relative_to(ROOT)}:{line}: {name}")
    assert seen > 100 and wrong == []
