"""A report offers only commands that take its folders, and compares only what was judged alike."""

import shlex

import numpy as np
import pytest
from made_runs import write_run

from r2h_batch.__main__ import main
from r2h_batch.report.compare.stored import stored_rows
from r2h_batch.report.next_commands import judged_alike, next_commands
from r2h_batch.report.page import page
from r2h_batch.report.statistics.common import common_trials
from r2h_batch.report.table import best_cells, table_of
from r2h_batch.runs.store import join, load_run

DEFAULT, _, *OTHERS = (f for f in stored_rows() if not f.name.startswith("r2h-v3"))  # other criteria


def offered(runs):
    return [shlex.split(line, comments=True)[1:] for line in next_commands(runs).splitlines() if "r2h-batch" in line]


@pytest.mark.parametrize("folders", [[DEFAULT], [OTHERS[0]], [DEFAULT, OTHERS[0]]], ids=["one", "other", "two"])
def test_compare_is_offered_where_it_does_not_refuse_and_nowhere_else(folders, capsys):
    runs = [load_run(f) for f in folders]
    names = [words[0] for words in offered(runs)]
    assert ("compare" in names) == judged_alike(runs) == (len(folders) == 1)
    for words in offered(runs):
        if words[0] == "compare":
            assert main(words) == 0
    if "compare" not in names:
        assert main(["compare", *map(str, folders)]) == 2
    assert ("results" in names) == (len(folders) == 1)
    capsys.readouterr()


def test_a_folder_below_the_working_directory_is_named_from_there(tmp_path, monkeypatch):
    run = write_run(tmp_path / "runs" / "mine", {"mine": np.zeros(8, int)}, 4, 4)
    assert {words[1] for words in offered([run])} == {str(tmp_path / "runs" / "mine")}
    monkeypatch.chdir(tmp_path)
    assert {words[1] for words in offered([run])} == {"runs/mine"}
    monkeypatch.chdir(tmp_path / "runs" / "mine")
    assert {words[1] for words in offered([run])} == {str(tmp_path / "runs" / "mine")}


def test_below_the_short_form_the_whole_table_is_offered_first():
    runs = [load_run(DEFAULT)]
    short = next_commands(runs, printed="brief").splitlines()
    where = offered(runs)[0][1]
    assert offered(runs)[0] == ["why", where] and not any(w[0] == "why" for w in offered(runs * 2))
    assert shlex.split(short[2], comments=True) == ["r2h-batch", "report", where, "--full"]
    assert short[:2] + short[3:] == next_commands(runs).splitlines()


def test_a_run_of_other_trials_is_not_offered_the_baselines(tmp_path, capsys):
    run = write_run(tmp_path / "run", {"mine": np.zeros(8, int)}, 4, 4)
    assert [words[0] for words in offered([run])] == ["why", "report"]  # no poses are stored either
    assert main(["compare", str(run.folder), "baselines"]) == 2
    capsys.readouterr()


def test_nothing_is_bold_across_configurations():
    runs = [load_run(f).only([m]) for f, m in ((DEFAULT, "fc"), (OTHERS[1], "intent"))]
    assert runs[0].header["trials"] == runs[1].header["trials"] and not judged_alike(runs)
    assert best_cells(table_of(join(runs))) and not best_cells(table_of(join(runs), alike=judged_alike(runs)))


def test_a_page_of_runs_that_differ_says_how_many_trials_each_rate_has_and_that_nothing_is_compared(tmp_path):
    sizes = {"a": 12, "b": 6}
    runs = [write_run(tmp_path / m, {m: np.arange(2 * n) % 3}, n, n) for m, n in sizes.items()]
    text = page(join(runs), common=None)
    assert "Bold" not in text and "2\u20134" in text  # N of an object, from the fewest to the most
    assert "<small>of 4</small>" in text and "<small>of 2</small>" in text
    alone = page(runs[0], common=common_trials([runs[0]]))
    assert "<small>of 4</small>" not in alone
