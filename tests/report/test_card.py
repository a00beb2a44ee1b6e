"""Files of a finished sweep for people: table, numbers and a card; and what `ls` lists."""

import json

import numpy as np
import pytest
import yaml
from made_runs import write_run

from r2h_batch.report.card import write_summary
from r2h_batch.report.table import render, table_of
from r2h_batch.runs.store import load_run


@pytest.fixture
def run(tmp_path):
    odd = "a: [b] | <c>"
    run = write_run(tmp_path / "runs" / "mine", {"a": np.zeros(8, int), odd: np.ones(8, int)}, 4, 4)
    write_summary(run)
    return run


def test_the_summary_holds_the_table_and_names_the_rows_of_every_method(run):
    assert (run.folder / "table.md").read_text() == render(table_of(run), "md")
    assert (
        json.loads((run.folder / "results.json").read_text())["rows"]
        == json.loads(render(table_of(run), "json"))["rows"]
    )
    front, body = (run.folder / "README.md").read_text().removeprefix("---\n").split("\n---\n", 1)
    configs = yaml.safe_load(front)["configs"]
    found = [sorted(run.folder.glob(c["data_files"][0]["path"])) for c in configs]
    assert len(found) == 2 and all(found) and not set(found[0]) & set(found[1])
    assert "Split|Method" in body and "\nS0 " in body and "r2h-batch results reevaluate" in body
    assert load_run(run.folder).methods == run.methods  # a run folder as before
