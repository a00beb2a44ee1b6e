"""Run folders of format 3: those that are shipped are read and verified, and nothing in them is changed."""

import json
import shutil
from pathlib import Path

import pytest

from r2h_batch.__main__ import main
from r2h_batch.runs.files import RunError
from r2h_batch.runs.header import read_header
from r2h_batch.runs.store import load_run
from r2h_batch.runs.writing import open_run

ROWS = Path(__file__).resolve().parents[2] / "bench" / "rows" / "v0"
RANDOM = "004e769a2fd5c0006c2dfec51d57b31462df215510e7a9a5d476718178862df5"
"""Digest of the random method's rows, as the version that stored them gave it."""


@pytest.fixture
def run(tmp_path):
    return shutil.copytree(ROWS, tmp_path / "run")


def changed(folder):
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} != {
        folder / p.relative_to(ROWS): p.read_bytes() for p in ROWS.rglob("*") if p.is_file()
    }


def test_shipped_rows_keep_their_digest_and_verify(run, capsys):
    stored = load_run(run)
    assert stored.digest("random") == RANDOM and not stored.unfinished
    assert stored.trials("random").num_rows == stored.poses("random").num_rows == 1000
    assert main(["results", "verify", str(run)]) == 0 and not changed(run)


@pytest.mark.parametrize("how", ["flip", "cut", "remove", "path elsewhere", "another run"])
def test_damage_is_named_by_every_command_and_nothing_is_renamed(run, how, capsys):
    path = next((run / "trials" / "random").iterdir())
    receipt = run / "manifest" / "random" / "000000.json"
    data = bytearray(path.read_bytes())
    if how == "flip":
        data[len(data) // 2] ^= 1
    path.unlink()
    if how != "remove":
        path.write_bytes(data[:-9] if how == "cut" else data)
    said = json.loads(receipt.read_text())
    if how == "path elsewhere":
        said["files"]["trials"]["path"] = "../victim.parquet"
    if how == "another run":
        said["run"] = "0" * 64
    receipt.write_text(json.dumps(said))
    names = sorted(p.relative_to(run) for p in run.rglob("*"))
    with pytest.raises(RunError, match="restore it from a copy"):
        load_run(run)
    assert main(["report", str(run)]) == 2 and capsys.readouterr().err.count("\n") == 1
    assert main(["results", "verify", str(run)]) == 1
    out = capsys.readouterr().out
    assert ("000000.json" if "path" in how or "run" in how else path.name) in out and "restore it" in out
    assert sorted(p.relative_to(run) for p in run.rglob("*")) == names


def test_no_sweep_resumes_such_a_folder(run):
    header = read_header(run)
    with pytest.raises(RunError, match="differs in format; choose another --out"):
        open_run(run, header)
    assert not changed(run)
