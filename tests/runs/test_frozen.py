"""Run folders that r2h_batch 0.3 wrote (commit 7d23856b) open as they did: every command that reads one, on each kind of run.
One later run was judged by a criterion of a package that is installed nowhere (`test_plugged.py` has its text)."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from made_runs import write_run

from r2h_batch.__main__ import main
from r2h_batch.report.table import table_of
from r2h_batch.runs.store import join, load_run
from r2h_batch.verdicts import ELSEWHERE

FROZEN = Path(__file__).resolve().parents[1] / "frozen"
PLUGGED = "plugged"
RUNS = ("static", "simulated", "closed_loop", "sees", "draft", "quarantine", PLUGGED)
DIGESTS = json.loads((FROZEN / "digests.json").read_text())
"""Run -> method -> what `results digest` said, and the outcomes of its rows in order; both as 0.3 read them."""
UNFINISHED = {"quarantine": 1}
"""Run -> exit code of `report` and `compare`, where a method's shards are not all there."""


@pytest.fixture
def run(request, tmp_path):
    """A copy: nothing may be written into the kept ones."""
    return Path(shutil.copytree(FROZEN / request.param, tmp_path / request.param))


@pytest.mark.parametrize("name", RUNS)
def test_rows_and_digests_are_those_that_were_stored(name):
    stored = load_run(FROZEN / name)
    assert set(stored.methods) | set(stored.unfinished) == set(DIGESTS[name])
    for method in stored.methods:
        assert stored.digest(method) == DIGESTS[name][method]["digest"], method
        outcomes = [row["outcome"] for row in stored.trials(method).to_pylist()]
        assert outcomes == DIGESTS[name][method]["outcomes"].split(), method


@pytest.mark.parametrize("run", RUNS, indirect=True)
def test_tables_pages_and_reasons_are_printed(run, tmp_path, capsys):
    page, finished = tmp_path / "page.html", UNFINISHED.get(run.name, 0) == 0
    several = finished and len(load_run(run).methods) > 1
    for line in (
        ["report", str(run)],
        ["report", str(run), "--by-object", "--format", "json"],
        ["report", str(run), "--format", "html", "--out", str(page)],
        *([["compare", str(run)]] if several else []),
        *([["compare", str(run), "baselines"]] if run.name == "static" else []),
        ["ls", "runs", str(run.parent)],
        ["results", "digest", str(run)],
        ["why", str(run), "0"],
    ):
        code, said = main(line), capsys.readouterr()
        expected = UNFINISHED.get(run.name, 0) if line[0] == "report" else 0
        headless = "baselines" in line  # their receivers have heads, those of this run none
        assert code == (2 if headless else expected), f"{' '.join(line)}: {said.err}"
        assert said.out or page.exists() if not headless else "head" in said.err


def test_what_was_called_presented_is_told_apart_and_never_mixed(tmp_path, capsys):
    """The column `presented` of these rows asked for something else."""
    old, static = "presented_before_0_4", load_run(FROZEN / "static")
    new = write_run(tmp_path / "new", {"newer": np.zeros(16, int)}, 8, 8)
    rows = table_of(join([static, new])).rows
    own = {m: {k for r in rows if r.method == m for k in r.shares} for m in (*static.methods, "newer")}
    for method in static.methods:
        assert old in own[method] and not {"presented", "upright"} & own[method]
    assert old not in own["newer"] and {"presented", "upright"} <= own["newer"]
    then = json.loads((FROZEN / "static" / "results.json").read_text())["rows"]
    mine = {(r.split, r.method): r.shares.get(old) for r in table_of(static).rows}
    assert {(r["split"], r["method"]): r["presented"] for r in then} == {
        k: None if rate is None else rate.percent for k, rate in mine.items()
    }
    assert main(["report", str(FROZEN / "static"), "--full"]) == 0
    said = capsys.readouterr().out
    assert "| Presented, before 0.4 |" in said and "| Presented |" not in said


LATER = {
    "simulated": pytest.mark.slow,
    "quarantine": pytest.mark.slow,
    "closed_loop": pytest.mark.whole(part="closed_loop"),
}
AGAIN = [pytest.param(name, marks=[LATER[name]] if name in LATER else []) for name in RUNS]
"""Runs whose rows are judged again; two of them as another one is, and in one each row is an episode that is played."""


@pytest.mark.parametrize("run", AGAIN, indirect=True)
def test_nothing_is_set_aside_and_rows_are_judged_again(run, capsys):
    before = sorted(p.relative_to(run) for p in run.rglob("*"))
    assert main(["results", "verify", str(run)]) == 0, capsys.readouterr()
    assert sorted(p.relative_to(run) for p in run.rglob("*")) == before
    main(["results", "reevaluate", str(run), "--rows", "2", "--seed", "0"])
    said = capsys.readouterr()
    assert "Traceback" not in said.err and "judged again" in said.out, said


@pytest.mark.parametrize("run", ["static", "closed_loop", "draft"], indirect=True)
def test_a_trial_is_shown(run, tmp_path, capsys):
    method = load_run(run).methods[0]
    strips = tmp_path / "strips.png"
    line = ["view", str(run), "--method", method, "--trial", "0", "--strips", str(strips), "--frames", "2"]
    assert main(line) == 0, capsys.readouterr().err
    assert strips.stat().st_size > 1000


@pytest.mark.parametrize("run", [PLUGGED], indirect=True)
def test_a_criterion_and_a_share_that_are_not_installed_are_told_in_one_line(run, capsys):
    assert main(["report", str(run), "--format", "json"]) == 0
    said = capsys.readouterr()
    line = (
        "read without the columns of criterion centred (strange 1.0) and share slow (strange 1.0), not installed here;"
    )
    assert said.err.count("not installed") == 1 and line in said.err
    rows = json.loads(said.out)["rows"]
    assert rows and not any("centre" in key or "slow" in key for row in rows for key in row)
    for row in (r for r in rows if r["split"] != "Avg"):  # its verdicts stay
        own = DIGESTS[PLUGGED][row["method"]]["outcomes"].split()[slice(*{"S0": (0, 8), "S1": (8, 16)}[row["split"]])]
        assert row["sr"] == 100 * own.count("success") / 8


@pytest.mark.parametrize("run", [PLUGGED], indirect=True)
def test_a_table_and_a_reason_say_what_a_criterion_that_is_gone_decided(run, capsys):
    lost = {m: o["outcomes"].split().count(ELSEWHERE) for m, o in DIGESTS[PLUGGED].items()}
    assert main(["report", str(run), "--format", "json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    for method, n in lost.items():
        words = f"{n} of 16 rows of {method} failed criterion centred (strange 1.0), not installed here: SR counts them"
        assert any(note.startswith(words) for note in notes) == bool(n)
    assert any(lost.values())
    assert main(["report", str(run)]) == 0
    assert "failed criterion centred (strange 1.0)" in capsys.readouterr().out
    assert main(["why", str(run), "0"]) == 0
    assert "criterion centred (strange 1.0), which is not installed" in capsys.readouterr().out
