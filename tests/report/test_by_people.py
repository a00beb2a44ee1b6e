"""Success by people: every group's counts by hand, and whom no method serves."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from made_runs import made_trials, make_header, make_scores, store, write_run

from r2h_batch.report.people import people_lines, served
from r2h_batch.runs.side import write_side
from r2h_batch.runs.store import Run, load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.types import Outcome

PEOPLE = [
    # age, female, stature, hand, seated, redrawn
    [30, 0, 1.78, 0.205, 0, 0],
    [40, 0, 1.80, 0.207, 0, 0],
    [50, 1, 1.60, 0.184, 0, 0],
    [8, 1, 1.25, 0.148, 0, 0],
    [8, 0, 1.15, 0.145, 1, 3],
    [75, 1, 1.45, 0.175, 0, 0],
]


@pytest.fixture
def run(tmp_path) -> Run:
    # one object: every method serves the three median adults; the seated child gets it from nobody
    trials = made_trials(6, 0)
    trials = replace(
        trials, object_index=torch.zeros(6, dtype=torch.int32), person=torch.tensor(PEOPLE, dtype=torch.float32)
    )
    folder = open_run(tmp_path / "run", make_header(6, 0))
    plan = int(Outcome.PLAN)
    for name, outcome in {"a": [0, 0, 0, plan, plan, 0], "b": [0, 0, 0, 0, plan, plan]}.items():
        store(folder, name, trials, make_scores(trials, np.array(outcome)))
    return load_run(tmp_path / "run")


def test_groups_count_their_trials(run: Run) -> None:
    found = served(run)
    groups = {
        (by, name): found.success[:, rows].sum(1).tolist() + [int(rows.sum())] for by, name, rows in found.groups()
    }
    assert groups["age, years", "below 13"] == [0, 1, 2]
    assert groups["stature, m", "below 1.2"] == [0, 0, 1]
    assert groups["hand, cm", "19 to 21"] == [2, 2, 2]
    assert groups["seat", "seated"] == [0, 0, 1]
    assert groups["sex", "female"] == [2, 2, 3]
    for by in ("age, years", "stature, m", "hand, cm", "sex", "seat"):
        assert sum(counts[2] for (kind, _), counts in groups.items() if kind == by) == 6


@pytest.mark.check
def test_who_is_not_served_is_named(run: Run) -> None:
    found = served(run)
    assert found.median_adults().tolist() == [True, True, True, False, False, False]
    assert len(found.served_objects()) == 1
    text = people_lines(run)
    assert "Not served: 1 people (16.7 % of the trials with these objects)" in text
    last = text.strip().splitlines()[-1]
    assert [cell.strip() for cell in last.strip("|").split("|")][2:] == ["male", "8", "1.15", "14.5", "seated"]
    assert people_lines(run, "csv").startswith("by,group,method,n,successes,no_method,redrawn\nall,all,a,6,4,1,3\n")


def test_a_run_without_people_gets_one_line(tmp_path) -> None:
    with pytest.raises(ValueError, match="this run has no people; sweep with --people adults"):
        people_lines(write_run(tmp_path / "run", {"m": np.zeros(4, int)}, 2, 2))


def stored_later(run: Run) -> None:
    """Reception of method a's six trials, of which five have a goal posture."""
    entry = run.entry("a")
    columns = {
        "trial_id": np.arange(6),
        "success": [True, True, True, False, False, True],
        "evaluated": [True] * 5 + [False],
        "received": [True, False, True, True, False, False],
    }
    write_side(entry.folder / "reception" / f"{entry.slug}.parquet", pa.table(columns))


def test_received_is_counted_by_people_where_it_is_stored(run: Run) -> None:
    assert "received" not in people_lines(run)
    stored_later(run)
    found = json.loads(people_lines(run, "json"))["rows"]
    cell = {(r["by"], r["group"], r["method"]): r for r in found}
    assert cell["all", "all", "a"]["received"] == pytest.approx(3 / 5)
    assert cell["age, years", "65 and more", "a"]["received"] is None and "received" not in cell["all", "all", "b"]
    text = people_lines(run)
    (head,) = (line for line in text.splitlines() if "a: received" in line)
    assert "b: received" not in head
    below = [line for line in text.splitlines() if "below 13" in line][1]
    assert [c.strip() for c in below.strip("|").split("|")][2:] == ["50.0"]


def test_reception_of_other_rows_is_left_out(run: Run) -> None:
    stored_later(run)
    path = run.entry("a").folder / "reception" / f"{run.entry('a').slug}.parquet"
    table = pq.read_table(path)
    other = pa.array([False, True, True, False, False, True])
    write_side(path, table.set_column(1, "success", other))
    assert served(run).later == {}
