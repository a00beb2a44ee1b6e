"""The command `results transfer`: a row for each stored pose and case, kept where it is there already."""

import json
import re
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_runs import write_side

from r2h_batch.__main__ import main
from r2h_batch.closed_loop.transfer.cases import Case
from r2h_batch.report.page import page
from r2h_batch.report.table import render as render_table
from r2h_batch.report.table import table_of
from r2h_batch.report.transfers import MADE_OF
from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.transfer import SCHEMA, render

QUICK = ["--sim", "none", "--quiet"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("transfer") / "run"
    assert (
        main(["sweep", "--benchmark", "r2h-v1", "--method", "random", "--trials", "3", "--out", str(folder), *QUICK])
        == 0
    )
    return folder


def stored(run):
    (entry,) = load_run(run).entries
    return run / "transfer" / f"{entry.slug}.parquet"


def test_each_stored_pose_has_a_row_for_each_case_and_a_second_call_keeps_them(run, capsys):
    assert main(["results", "transfer", str(run), "--processes", "1"]) == 0
    first = pq.read_table(stored(run))
    assert first.schema.remove_metadata().equals(SCHEMA) and len(first) == 6
    rows = first.to_pylist()
    assert all((r["outcome"] == "not_received") == (not r["received"]) for r in rows)
    assert all((r["slip_m"] is None) == (not r["received"]) for r in rows)
    assert any(r["outcome"] == "taken" for r in rows)
    shown = capsys.readouterr().out
    assert "From success to taken" in shown and "Times are inputs, not validated" in shown
    before = stored(run).read_bytes()
    assert main(["results", "transfer", str(run), "--processes", "1"]) == 0
    assert stored(run).read_bytes() == before
    assert "has these transfers" in capsys.readouterr().err
    assert main(["results", "transfer", str(run), "--processes", "1", "--scenario", "touch"]) == 0
    both = pq.read_table(stored(run))
    assert both.slice(0, 6).equals(first.replace_schema_metadata(both.schema.metadata)) and len(both) == 12
    assert set(both["scenario"].to_pylist()) == {"take", "touch"}
    assert main(["results", "verify", str(run)]) == 0


def test_batched_worlds_write_the_same_outcomes_and_do_not_mix_with_the_other_engines(run, tmp_path, capsys):
    assert main(["results", "transfer", str(run), "--processes", "1"]) == 0
    other = tmp_path / "other"
    shutil.copytree(run, other)
    exact = [r for r in pq.read_table(stored(other)).to_pylist() if r["scenario"] == "take"]
    capsys.readouterr()
    assert main(["results", "transfer", str(other), "--sim", "mjwarp"]) == 0
    assert "has these transfers" not in capsys.readouterr().err
    batched = pq.read_table(stored(other)).to_pylist()
    assert [r["outcome"] for r in exact] == [r["outcome"] for r in batched] and exact != batched
    assert any(r["outcome"] == "taken" for r in batched)
    assert main(["results", "transfer", str(run), "--sim", "mjwarp", "--processes", "2"]) == 2
    assert "mjwarp has its worlds in one process" in capsys.readouterr().err


def test_a_run_without_bodies_and_wrong_words_are_told_what_is_missing(run, tmp_path, capsys):
    bare = tmp_path / "bare"
    assert (
        main(["sweep", "--method", "random", "--trials", "1", "--benchmark", "r2h-v0", "--out", str(bare), *QUICK]) == 0
    )
    assert main(["results", "transfer", str(bare)]) == 2
    assert "no receiver's body; sweep a benchmark of people" in capsys.readouterr().err
    assert main(["results", "transfer", str(run), "--scenario", "grab"]) == 2
    assert "take, touch, nobody, pull-early, weak" in capsys.readouterr().err
    assert main(["results", "transfer", str(run), "--release", "soon"]) == 2
    said = "never, timer, threshold, load-share, probe; your own is package.module:Class or FILE.py:Class"
    assert said in capsys.readouterr().err
    (own := tmp_path / "tug.py").write_text(
        "from r2h_batch.closed_loop.transfer.release import Action\n\n\nclass Tug:\n    def __init__(self, robot):\n"
        "        self.no = robot.weight_n[:1] < 0\n\n    def __call__(self, seen):\n        return Action(self.no)\n"
    )
    assert main(["results", "transfer", str(run), "--release", f"{own}:Tug", "--processes", "2"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert "release policy tug.py:Tug: open is a tensor (1,) of bool on cpu; it must be a tensor (" in line


def test_the_report_goes_from_success_to_taken_and_files_of_other_rows_are_left_out(run, tmp_path):
    assert main(["results", "transfer", str(run), "--processes", "1"]) == 0
    loaded = load_run(run)
    table = table_of(loaded)
    rows = pq.read_table(stored(run)).to_pylist()
    takes = [r for r in rows if r["scenario"] == "take"]
    (funnel,) = table.funnels
    assert funnel.release == "load-share" and funnel.taken.total == len(takes) == 6
    got = (sum(r["success"] for r in takes), sum(r["received"] for r in takes))
    taken = [r for r in takes if r["outcome"] == "taken"]
    assert (funnel.success.count, funnel.received.count) == got and funnel.taken.count == len(taken)
    assert funnel.both.count == sum(r["success"] for r in taken)
    text = render_table(table, "md")
    assert "From success to taken" in text and f"{funnel.taken.percent:.1f}" in text
    assert json.loads(render_table(table, "json"))["transfers"][0]["taken"]["count"] == len(taken)
    assert "<h2>From success to taken</h2>" in page(loaded)
    other = tmp_path / "other"
    shutil.copytree(run, other)
    (entry,) = load_run(other).entries
    about = json.loads(pq.read_schema(stored(run)).metadata[MADE_OF]) | {"rows": "another"}
    write_side(other / "transfer" / f"{entry.slug}.parquet", pq.read_table(stored(run)), {MADE_OF: about})
    assert table_of(load_run(other)).funnels == ()
    assert "From success to taken" not in render_table(table_of(load_run(other)), "md")


def test_several_persons_of_a_trial_do_not_narrow_its_interval_as_more_trials_would(run):
    """All persons of a trial agree, so four of them say no more than one."""

    def width(persons: int, trials: int) -> float:
        n = persons * trials
        trial_id = np.repeat(np.arange(trials), persons)
        words = {
            "trial_id": trial_id,
            "release": ["never"] * n,
            "scenario": ["take"] * n,
            "person": np.tile(np.arange(persons), trials).astype(np.int16),
            "success": np.ones(n, bool),
            "received": np.ones(n, bool),
            "outcome": np.where(trial_id % 2 == 0, "taken", "dropped"),
            "false_release": np.zeros(n, bool),
        }
        columns = [pa.array(words[f.name], f.type) if f.name in words else pa.array(np.ones(n), f.type) for f in SCHEMA]
        file = run / "made.parquet"
        pq.write_table(pa.Table.from_arrays(columns, schema=SCHEMA), file)
        shown = render({"m": file}, [Case("never", "take", k) for k in range(persons)])
        low, high = re.search(r"50\.0 \[([\d.]+), ([\d.]+)\]", shown).groups()
        return float(high) - float(low)

    assert width(4, 20) >= width(1, 20) > 1.5 * width(1, 80)


def test_rates_of_weak_and_firm_grips_and_of_stiff_arms_stand_in_their_own_columns(tmp_path):
    """Eight received objects: three of the four weak grips drop theirs, and stiff arms take three of four."""
    n = 8
    words = {
        "trial_id": np.arange(n),
        "release": ["never"] * n,
        "scenario": ["take"] * n,
        "person": np.zeros(n, np.int16),
        "outcome": ["dropped", "dropped", "dropped", "taken", *["taken"] * 4],
        "person_grip": [0.5, 0.6, 0.7, 0.8, 1.2, 1.4, 1.6, 1.8],
        "person_arm_n_m": [10.0, 20, 80, 30, 40, 50, 60, 70],
        "false_release": np.zeros(n, bool),
    }
    columns = [pa.array(words[f.name], f.type) if f.name in words else pa.array(np.ones(n), f.type) for f in SCHEMA]
    file = tmp_path / "made.parquet"
    pq.write_table(pa.Table.from_arrays(columns, schema=SCHEMA), file)
    shown = render({"m": file}, [Case("never", "take", 0)]).splitlines()
    (k,) = (k for k, line in enumerate(shown) if "weak grip" in line)
    headings, cells = ([c.strip() for c in shown[i].split("|")] for i in (k, k + 2))  # a rule lies between
    ends = dict(zip(headings, cells, strict=True))
    assert (ends["weak grip"], ends["firm grip"], ends["stiff arm"]) == ("25.0", "100.0", "75.0")
