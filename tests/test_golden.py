"""Rows, candidates and an export are bit for bit what they were: CONTRIBUTING.md says when `make golden` is allowed."""

import json
from pathlib import Path

import pytest
from golden import CASES, GOLDEN, PARTS, compute, holds, sweep_digests

from r2h_batch.scene.robot_file import load_robot, write_robot

QUICK = ("pose", "none")
EVERY_DAY = [
    pytest.param(case, PARTS.get(case), id=case, marks=pytest.mark.check if case in QUICK else ()) for case in CASES
]
WHOLE = [pytest.param(case, None, id=f"{case}-whole", marks=pytest.mark.whole(part="golden")) for case in PARTS]


@pytest.mark.parametrize(("case", "method"), EVERY_DAY + WHOLE)
def test_nothing_has_changed(case: str, method: str | None, tmp_path: Path) -> None:
    stored = json.loads(GOLDEN.read_text())
    found = compute(case, tmp_path, method)
    assert found and set(found) <= set(stored["cases"])
    for name, part in found.items():
        kind = holds(stored, name)
        assert part[kind] == stored["cases"][name][kind], f"{name}: {kind} changed; see CONTRIBUTING.md, golden"


def test_a_robot_file_equal_to_the_built_in_one_gives_goldens_digests(tmp_path: Path) -> None:
    stored, folder = json.loads(GOLDEN.read_text()), tmp_path / "mine"
    write_robot(folder, load_robot())
    (name, part), *_ = sweep_digests("none", tmp_path, ["intent"], ["--robot", str(folder)]).items()
    kind = holds(stored, name)
    assert part[kind] == stored["cases"][name][kind]
