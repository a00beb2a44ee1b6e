"""`make gpu` on a machine without a GPU: the same lines, on a few trials, on the CPU."""

import json
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).resolve().parents[1] / "bench"


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCH))  # scripts there find each other so
    sys.modules.pop("gpu", None)
    import gpu

    return gpu


@pytest.mark.slow
def test_a_dry_run_leaves_figures_of_every_part_that_needs_no_gpu(gpu, tmp_path, monkeypatch, capsys):
    apart = ("worlds", "marked_tests")  # processes of their own, and minutes of MuJoCo-Warp on a CPU
    monkeypatch.setattr(gpu, "PARTS", tuple(p for p in gpu.PARTS if p.__name__ not in apart))
    gpu.BENCH.main(["--device", "cpu", "--trials", "2", "--out", str(tmp_path)])
    values = json.loads((tmp_path / "gpu.json").read_text())["values"]
    ends = {k.removeprefix("gpu.part."): v for k, v in values.items() if k.startswith("gpu.part.")}
    assert set(ends) == {p.__name__ for p in gpu.PARTS} and all(v.startswith("done") for v in ends.values())
    assert values["gpu.mix.outcomes_that_differ"] == 0 and values["gpu.mix.trials"] == 2
    assert values["gpu.same_bits.permuted"] is True and values["gpu.trials_per_s"] > 0
    assert values["gpu.search.rows"] == 2 and values["gpu.search.launches"] >= 1
    parts = [values[f"gpu.search.{x}_us_per_trial"] for x in ("straight_lines", "search", "shortcuts", "clearances")]
    assert min(parts) > 0 and values["gpu.search.share_of_whole"] > 0
    assert "| gpu.trials_per_s |" in (tmp_path / "gpu.md").read_text()
