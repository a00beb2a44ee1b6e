"""What a change touches of `make test-all` (tools/touched.py): each part can be reached, and lines lead to files."""

import importlib.util
import re
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.check


@pytest.fixture(scope="module")
def touched() -> ModuleType:
    spec = importlib.util.spec_from_file_location("touched", ROOT / "tools" / "touched.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_change_of_a_stage_runs_golden_and_one_of_a_page_the_site(touched: ModuleType) -> None:
    assert touched.parts_of(["kernels/ik/solve.py"]) == ["golden"]
    assert touched.parts_of(["docs/choices.md", "tests/test_ik.py"]) == ["pages", "site"]
    assert touched.expression(["pages", "site"]) == "whole(part='pages') or whole(part='site')"
    assert touched.expression(touched.parts_of(["CHANGELOG.md"])) == ""


def test_each_part_of_the_tests_is_in_the_table_and_each_line_of_the_table_leads_to_files(touched: ModuleType) -> None:
    tests = [p.read_text("utf-8") for p in (ROOT / "tests").rglob("test_*.py") if p != Path(__file__)]
    marked = {part for text in tests for part in re.findall(r'mark\.whole\(part="(\w+)"\)', text)}
    assert marked == {part for _, parts in touched.table() for part in parts} and len(marked) > 2
    git = ["git", "-C", str(ROOT), "ls-files"]
    files = subprocess.run(git, capture_output=True, text=True, check=True).stdout.splitlines()
    assert [place for place, _ in touched.table() if not any(f.startswith(place) for f in files)] == []
    package = {f for f in files if f.startswith(("r2h_batch/", "kernels/")) and "." in f.rpartition("/")[2]}
    unread = {f for f in package if not touched.parts_of([f])} - {"r2h_batch/__init__.py", "r2h_batch/ruff.toml"}
    assert unread - {"r2h_batch/py.typed"} == set()
