"""tools/mutate.py puts one fault into a file: the same one for a seed, and code that compiles."""

import ast
import importlib.util
import random
import sys
from pathlib import Path

import pytest
from rounds import each

ROOT = Path(__file__).resolve().parents[1]
FILES = ("kernels/geometry/gjk.py", "r2h_batch/judge/metrics.py", "r2h_batch/runs/store.py")


@pytest.fixture(scope="module")
def mutate():
    spec = importlib.util.spec_from_file_location("mutate", ROOT / "tools" / "mutate.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("file", FILES)
def test_each_fault_is_one_change_of_code_that_compiles_and_follows_from_the_seed(mutate, file):
    text = (ROOT / file).read_text()
    plain = ast.unparse(ast.parse(text))
    found = [mutate.mutant(text, random.Random(f"{file} 0 {k}")) for k in range(30)]
    assert len({m.text for m in found}) > 15 and all(m.text != plain for m in found)
    changed = [sum(a != b for a, b in zip(plain.split("\n"), m.text.split("\n"), strict=False)) for m in found]
    assert sum(n == 1 for n in changed) >= 25  # the others stand where `not` needs brackets over several lines
    for m in each(found):
        compile(m.text, file, "exec")
    assert found == [mutate.mutant(text, random.Random(f"{file} 0 {k}")) for k in range(30)]


def test_a_file_without_a_place_for_a_fault_is_refused(mutate):
    with pytest.raises(ValueError, match="no place"):
        mutate.mutant('"""Only words."""\nname: int\n', random.Random(0))


def test_a_fault_is_killed_by_a_test_that_fails_and_not_by_one_that_a_mark_leaves_out(
    mutate, tmp_path, monkeypatch, capsys
):
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = -m 'not slow'\nmarkers = slow\n")
    (tmp_path / "larger.py").write_text("def larger(a, b):\n    return max(a, b)\n")
    (tmp_path / "test_larger.py").write_text(
        "import larger, pytest\n@pytest.mark.slow\ndef test_it():\n    assert larger.larger(1, 2) == 2\n"
    )
    monkeypatch.setattr(mutate, "ROOT", tmp_path)
    line = ["mutate.py", "larger.py", "--count", "1", "test_larger.py"]
    monkeypatch.setattr(sys, "argv", line)
    assert mutate.main() == 2 and capsys.readouterr().out.startswith("no test ran")
    monkeypatch.setattr(sys, "argv", [*line, "--", "-m", "slow"])
    assert mutate.main() == 0 and "1 of 1 killed" in capsys.readouterr().out
