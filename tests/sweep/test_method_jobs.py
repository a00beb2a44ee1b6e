"""How methods get into a sweep: names, stand-ins, noise, a user's predictor, and the documented example itself."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from problems import default_evaluator

from r2h_batch.runs.provenance import file_digest
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs
from r2h_batch.sweep.request import Methods

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def bench():
    return jobs.Setting(default_evaluator(), {}, lambda *_: None, lambda _: None)


def names(bench, **given) -> list[str]:
    return [j.name for j in jobs.make_jobs(Methods(**given), [], bench)]


def test_a_users_network_is_named_and_reaches_contact_alone(bench, tmp_path, monkeypatch):
    (tmp_path / "my_net.py").write_text("def half(grid):\n    return 0.5 * grid[:, 0]\n")
    monkeypatch.syspath_prepend(tmp_path)
    given = jobs.make_jobs(Methods(("fc", "contact"), predictor="my_net:half"), [], bench)
    assert [j.name for j in given] == ["FC-Handover (oracle hand + noise)", "Contact-Handover (my_net:half + noise)"]
    contact = {"file": "my_net:half", "sha256": file_digest([tmp_path / "my_net.py"])}
    assert json.loads(given[1].source["predictors"])["contact"] == contact


def test_the_documented_example_is_a_method_and_runs(tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "howto" / "method.md").read_text(), re.S)
    assert len([line for line in code.splitlines() if line]) <= 15
    (tmp_path / "my_rules.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    try:
        line = [
            "--benchmark",
            "r2h-v1",
            "--method",
            "my_rules:predict",
            "--trials",
            "6",
            "--sim",
            "none",
            "--format",
            "json",
            "--out",
            "run",
        ]
        assert sweep.main([*line, "--predictor-noise", "0"]) == 0
    finally:
        sys.modules.pop("my_rules", None)
    table = json.loads(capsys.readouterr().out)
    assert table["origin"]["predictor noise"] == "0"
    run = load_run(tmp_path / "run")
    assert run.trials("my_rules:predict").num_rows == 12
    assert run.header["predictors"]["noise"]["target_translation_m"] == 0
    margins = np.array(run.trials("my_rules:predict")["margin_reach_m"])
    assert (margins[~np.isnan(margins)] > 0.05).all()  # the TCP is where the object is wanted
