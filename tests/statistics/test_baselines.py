"""The shipped rows of the built-in methods: whole, as the present code judges them, and comparable with a run of any size."""

import csv
import io
import json

import pytest

from r2h_batch.__main__ import main
from r2h_batch.compare.command import FOLDERS, baselines_for, stored_rows
from r2h_batch.runs.store import load_run
from r2h_batch.statistics.common import common_trials
from r2h_batch.sweep.command import main as sweep
from r2h_batch.sweep.options import METHODS


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f.name)
def test_the_shipped_rows_are_whole_and_of_all_built_in_methods(folder):
    run = load_run(folder)
    assert run.header["trials"] == {"S0": 500, "S1": 500} and not run.unfinished
    assert {e.source["function"] for e in run.entries} == {
        f"r2h_batch.methods.{m.replace('-', '_')}:predict" for m in METHODS
    }
    assert baselines_for(run.header) == folder


def test_in_a_checkout_rows_of_the_runs_protocol_and_preset_are_the_baselines():
    for protocol, preset, name in (("r2h-v0", "default", "v0"), ("r2h-v1", "paper", "v1-paper-preset")):
        folder = baselines_for({"protocol": protocol, "configuration": {"name": preset}})
        assert folder.name == name and load_run(folder).header["protocol"] == protocol
        assert load_run(folder).header["configuration"]["name"] == preset and folder in stored_rows()


def test_a_small_run_is_compared_with_the_shipped_baselines_without_a_rerun(tmp_path, capsys, monkeypatch):
    line = ["--method", "random", "--trials", "12", "--sim", "none", "--out", str(tmp_path / "mine")]
    assert sweep(line) == 0
    capsys.readouterr()
    monkeypatch.chdir(tmp_path)
    assert (
        main(["compare", str(tmp_path / "mine"), "baselines", "--method", "random", "oracle", "--format", "csv"]) == 0
    )
    rows = {(r["group"], r["a"], r["b"]): r for r in csv.DictReader(io.StringIO(capsys.readouterr().out))}
    assert {(a, b) for _, a, b in rows} == {
        ("random", "oracle")
    }  # the shipped random has the same answers and verdicts
    assert rows["S0", "random", "oracle"]["n"] == "12" and float(rows["S0", "random", "oracle"]["difference"]) < 0
    assert main(["compare", str(tmp_path / "mine"), "baselines", "--format", "json"]) == 0
    whole = json.loads(capsys.readouterr().out)[-1]
    assert [p["a"] for p in whole["pairs"]] == ["random"] * 5 and len(whole["names"]) == 6  # each baseline once
    assert len(whole["ranked"]) == len(whole["rank"]) == 4 and not {"random", "oracle"} & set(whole["ranked"])
    assert all(p["p_holm"] <= 5 * p["p"] + 1e-12 for p in whole["pairs"])
    assert main(["compare", str(tmp_path / "mine"), "baselines", "--all-pairs"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert (
        "the first 12 S0, 12 S1, which all of them hold" in text and "random is given twice, and counted once" in text
    )
    with pytest.raises(ValueError, match=r"differ in digests \(code\)|differ in configuration"):
        mine, shipped = load_run(tmp_path / "mine"), load_run(FOLDERS[1])
        mine.header["digests"]["code"] = "another"
        common_trials([mine, shipped])
    shipped.header["digests"]["objects"] = "others"
    with pytest.raises(
        ValueError, match=r"differ in digests \(objects\).*the shipped baselines have the default options"
    ):
        common_trials([mine, shipped], proven=FOLDERS)
