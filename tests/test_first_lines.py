"""docs/results/first_lines.md is the page of its JSON, and its bench measures what it says (bench/first_lines.py)."""

import json
import os
import sys
from pathlib import Path

import pytest
from rounds import each

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.check


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(ROOT / "bench"))
    try:
        import first_lines

        yield first_lines
    finally:
        sys.path.remove(str(ROOT / "bench"))


def test_the_page_is_that_of_its_json(bench):
    data = json.loads(bench.STORED.read_text("utf-8"))
    assert bench.PAGE.read_text("utf-8") == bench.page(data)
    assert list(data["rows"]) == [*bench.COMMANDS, *bench.CALLS], "measure again"
    for name, row in each(data["rows"].items()):
        for turn in bench.ROUNDS:
            own = row[turn]
            assert 0.0 <= own["first_s"] <= own["whole_s"] and own["silent_s"] <= own["whole_s"] + 0.01, name
            assert own["end"] in ("0", "limit"), name


def test_what_is_late_and_what_ended_early_are_told_apart(bench):
    row = {"first_s": 1.0, "silent_s": 2.0, "whole_s": 9.0, "cpu_s": 9.0, "said": "x", "end": "0"}
    made = {"cores": 2, "cpu": "c", "load_at_start": 0.0}
    late, quick, mute = row | {"first_s": 6.5}, row | {"whole_s": 3.0}, row | {"first_s": 0.0}
    rows = {"why": (row, row), "figures": (row, late), "report": (quick, quick), "Python: score": (mute, mute)}
    rows = {name: dict(zip(bench.ROUNDS, both, strict=True)) for name, both in rows.items()}
    text = bench.page({"rows": rows, "hardware": made, "commit": "0" * 40})
    assert "Of 4 commands and calls, 3 take longer than 5 s." in text
    assert "later than that: `figures`, Python: score." in text and "both times: `report`." in text


def test_a_command_is_watched_until_it_ends_or_is_ended(bench, tmp_path, monkeypatch):
    line = [sys.executable, "-c", "import time; time.sleep(.4); print('one', flush=True); time.sleep(.8); print('two')"]
    found = bench.watched(line, dict(os.environ), tmp_path / "log")
    assert found["said"] == "one" and found["end"] == "0" and (tmp_path / "log").read_text() == "one\ntwo\n"
    assert 0.4 <= found["first_s"] < found["whole_s"] - 0.7 and 0.7 < found["silent_s"] < found["whole_s"]
    assert (
        bench.watched([sys.executable, "-c", "raise SystemExit(3)"], dict(os.environ), tmp_path / "log")["end"] == "3"
    )
    monkeypatch.setattr(bench, "LIMIT_S", 0.5)
    slow = bench.watched([sys.executable, "-c", "import time; time.sleep(60)"], dict(os.environ), tmp_path / "log")
    assert slow["end"] == "limit" and slow["first_s"] == 0.0 and slow["whole_s"] < 20
