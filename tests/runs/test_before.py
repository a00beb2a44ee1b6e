"""Rows of r2h_batch 0.3 that were judged by what nobody judges by any more: read, counted and judged again."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from made_runs import write_run
from rounds import each

from r2h_batch.__main__ import main
from r2h_batch.report.statistics.breakdown import examples
from r2h_batch.report.statistics.common import common_trials
from r2h_batch.report.statistics.thresholds import rethreshold
from r2h_batch.report.table import render, table_of
from r2h_batch.runs import before
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.judge import Judge
from r2h_batch.sweep.results.reevaluation import reevaluate
from r2h_batch.trials.of_run import benchmark_of_run

DRAFT = Path(__file__).resolve().parents[1] / "frozen" / "draft"
"""A run of r2h-v3 under its former name, which asked for Taken, with transfers beside its shards."""


@pytest.fixture
def run():
    return load_run(DRAFT)


@pytest.fixture
def method(run):
    return run.named("fc")


def test_what_is_not_read_is_told_once_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(before, "_told", set())
    for _ in range(2):
        assert main(["report", str(DRAFT)]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "0.3" in line]
    assert len(said) == 1 and str(DRAFT) in said[0] and "transfer/" in said[0]
    assert "passed_taken" in said[0] and "keep the outcome taken" in said[0]


def test_a_run_that_lacks_nothing_is_told_nothing(run):
    assert before.unread(DRAFT.parent / "static", load_run(DRAFT.parent / "static").header) == ""
    assert before.unread(DRAFT, run.header) != ""


def test_every_folder_of_before_beside_the_shards_is_told_and_stays(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(before, "_told", set())
    run = shutil.copytree(DRAFT.parent / "static", tmp_path / "run")
    for name in before.FOLDERS:
        (run / name).mkdir()
        (run / name / "whatever.parquet").write_bytes(b"it was")
    assert main(["compare", str(run)]) == 0
    (said,) = [line for line in capsys.readouterr().err.splitlines() if "0.3" in line]
    assert f"not read: {', '.join(f'{name}/' for name in before.FOLDERS)}" in said
    assert main(["results", "verify", str(run)]) == 0
    assert all((run / name / "whatever.parquet").read_bytes() == b"it was" for name in before.FOLDERS)


def test_runs_of_persons_without_a_head_are_told_and_never_compared_with_others(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(before, "_told", set())
    body = {"configuration": {"name": "default", "receiver": "body"}}
    outcomes = {"m": np.arange(12) % 3, "n": np.arange(12) % 2}
    old = write_run(tmp_path / "old", outcomes, 6, 6, **body)
    assert capsys.readouterr().err.count("its receivers have no head") == 1
    new = write_run(tmp_path / "new", outcomes, 6, 6, **body, person=["forearm", "upper_arm", "torso", "head"])
    assert "head" not in capsys.readouterr().err
    for pair in each(((old, new), (new, old))):
        with pytest.raises(
            ValueError, match=r"differ in their persons' heads \(the receivers of old have none\): .*; sweep the older"
        ):
            common_trials(pair)
    assert not common_trials([old, old]).notes and not common_trials([new, new]).notes
    assert main(["compare", str(old.folder), str(new.folder)]) == 2
    said = capsys.readouterr().err
    assert (
        "the receivers of old have none" in said and "no head" not in said
    )  # which `old` was told when it was opened first


def test_runs_of_a_benchmark_under_its_former_name_are_paired_with_those_of_today(tmp_path):
    outcomes, digests = {"m": np.arange(12) % 3}, {"trials": "0123456789abcdef", "benchmark": "1" * 64}
    runs = [
        write_run(tmp_path / name, outcomes, 6, 6, protocol=name, digests=digests)
        for name in ("r2h-v3", "r2h-v3-draft", "r2h-v2")
    ]
    for pair in each((runs[:2], runs[1::-1])):
        assert not common_trials(pair).notes
    with pytest.raises(ValueError, match="differ in benchmark"):
        common_trials(runs[1:])


def test_hands_alone_are_judged_as_before_and_body_m_says_whose_it_is(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(before, "_told", set())
    outcomes = {"m": np.arange(12) % 3}
    old = write_run(tmp_path / "old", outcomes, 6, 6)
    new = write_run(tmp_path / "new", outcomes, 6, 6, person=["forearm", "upper_arm", "torso", "head"])
    assert not capsys.readouterr().err
    (note,) = common_trials([old, new]).notes
    assert note.startswith("body_m of old is of arm and torso alone")
    digests = {"digests": {"trials": "0123456789abcdef", "sees": "cameras"}}  # which see a head since
    old = write_run(tmp_path / "old sees", outcomes, 6, 6, **digests)
    new = write_run(tmp_path / "new sees", outcomes, 6, 6, person=new.header["person"], **digests)
    with pytest.raises(ValueError, match="the receivers of old sees have none"):
        common_trials([old, new])


def test_rows_that_failed_there_keep_their_outcome_and_count_as_failures(run, method):
    rows = run.trials(method).to_pylist()
    assert run.asks == ("pick", "received") and run.header["asks"] == ["pick", "received", "taken"]
    assert not {"passed_taken", "transfer_end"} & set(run.trials(method).column_names)
    lost = [r["trial_id"] for r in rows if r["outcome"] == "taken"]
    assert lost and all(r["passed_received"] for r in rows if r["outcome"] == "taken")
    table = table_of(run)
    of = [r for r in table.rows if r.method == method and r.split != "Avg"]
    assert sum(r.counts["taken"] for r in of) == len(lost)
    assert sum(r.counts["success"] for r in of) == sum(r["outcome"] == "success" for r in rows)
    assert f"{len(lost)} of {len(rows)} rows of {method} failed Taken" in render(table, "md").replace("\n  ", " ")
    assert "failed Taken" in json.dumps(json.loads(render(table, "json"))["notes"])
    kept, total = examples(run, method, 8)
    assert total == len(rows) and "taken" in kept["outcome"].to_pylist()


def test_other_thresholds_leave_them_failed(run, method):
    (point,) = rethreshold(run)
    stricter = rethreshold(run, reach_radius_m=[0.001])[0]
    taken = OUTCOME_NAMES.index("taken")
    assert point.counts[method][:, taken].sum() > 0 == stricter.counts[method][:, taken].sum()


def test_why_names_what_it_failed_by(run, method, capsys):
    lost = next(r["trial_id"] for r in run.trials(method).to_pylist() if r["outcome"] == "taken")
    assert main(["why", str(DRAFT), str(lost), "--method", "fc"]) == 0
    assert "taken fails: r2h_batch 0.3 judged by it, this version does not" in capsys.readouterr().out


@pytest.mark.parametrize("rows", [4, pytest.param(16, marks=pytest.mark.slow)])
def test_they_are_judged_again_in_the_same_trials_by_the_criteria_that_there_are(run, method, rows):
    benchmark = benchmark_of_run(run.header, "x")
    assert benchmark.asks == run.asks and benchmark.digest != run.header["digests"]["benchmark"]
    found = reevaluate(run, method, rows, Judge(run))
    assert found.scored == rows
    # where the object is held differs by millimetres from where a simulated closing had put it
    others = {d.column for d in found.differences}
    assert others <= {"outcome", "passed_received", "margin_received_m", "received_reason", "received_grasps"}
    assert not [d for d in found.differences if d.stored == "taken" and d.again == "success"]
