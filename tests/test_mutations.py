"""tools/mutate.py can still put its faults into the code."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.check
def test_every_mutations_old_text_stands_in_its_file_exactly_once_and_its_tests_exist():
    spec = importlib.util.spec_from_file_location("mutate", ROOT / "tools" / "mutate.py")
    assert spec is not None and spec.loader is not None
    mutate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(mutate)
    assert len(mutate.MUTATIONS) >= 119 and mutate.stale() == []
