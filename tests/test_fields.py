"""What a method is given: the page's tables are the docstrings of the classes."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, "tools/fields.py"]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The tree as far as the tool reads it."""
    for part in ("tools", "r2h_batch", "docs/howto"):
        shutil.copytree(
            ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("*.p*[gtc]", "__pycache__", "compare")
        )
    return tmp_path


@pytest.mark.check
def test_the_page_of_methods_shows_the_fields_as_the_classes_describe_them(copy: Path) -> None:
    assert subprocess.run([*COMMAND, "--check"], cwd=ROOT).returncode == 0, "run python tools/fields.py"
    page = copy / "docs" / "howto" / "method.md"
    good = page.read_text()
    assert "`scene.hands.palm_normal` | float32 (H, 3) |" in good and "`candidate_table(scene).score` |" in good
    page.write_text(good.replace("| `trials.hand_index` |", "| `trials.hand` |"))
    refused = subprocess.run([*COMMAND, "--check"], cwd=copy, capture_output=True, text=True)
    assert refused.returncode == 1 and "run python tools/fields.py" in refused.stderr
    assert subprocess.run(COMMAND, cwd=copy).returncode == 0 and page.read_text() == good


def test_a_field_without_words_is_named(copy: Path) -> None:
    file = copy / "r2h_batch" / "scene" / "tables.py"
    file.write_text(file.read_text().replace("    set: HandSet\n", "    tips: HandSet\n    set: HandSet\n", 1))
    done = subprocess.run(COMMAND, cwd=copy, capture_output=True, text=True)
    assert done.returncode == 1 and "scene/tables.py: Hands.tips has no docstring" in done.stderr
