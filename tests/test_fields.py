"""What a method is given: the site's tables are the docstrings of the classes."""

import importlib
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rounds import each

ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, "tools/fields.py"]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The tree as far as the tool reads it."""
    for part in ("tools", "r2h_batch"):
        shutil.copytree(
            ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("*.p*[gtc]", "__pycache__", "compare")
        )
    return tmp_path


@pytest.mark.check
def test_the_page_of_fields_has_a_place_for_each_table_and_shows_fields_as_the_classes_describe_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(ROOT / "tools")
    fields = importlib.import_module("fields")
    text = (ROOT / "docs" / "reference" / "fields.md").read_text(encoding="utf-8")
    assert sorted(fields.PLACE.findall(text)) == sorted(fields.TABLES)
    shown = fields.on_page_markdown(text)
    assert "`scene.hands.palm_normal` | float32 (H, 3) |" in shown and "`candidate_table(scene).score` |" in shown
    for name in each(fields.TABLES):
        assert fields.table(name) in shown


def test_a_field_without_words_is_named(copy: Path) -> None:
    file = copy / "r2h_batch" / "scene" / "tables.py"
    file.write_text(file.read_text().replace("    set: HandSet\n", "    tips: HandSet\n    set: HandSet\n", 1))
    done = subprocess.run(COMMAND, cwd=copy, capture_output=True, text=True)
    assert done.returncode == 1 and "scene/tables.py: Hands.tips has no docstring" in done.stderr
