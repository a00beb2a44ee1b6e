"""Damaged, foreign and half-written files are found, named, set aside and written again."""

import os
import re
import shutil

import pyarrow.parquet as pq
import pytest
from made_runs import NAMES, OUTCOMES, files_of, made_trials, make_header, make_scores, put_shard, store, write

from r2h_batch.__main__ import main
from r2h_batch.runs.files import RunError
from r2h_batch.runs.header import shards_of
from r2h_batch.runs.store import load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep.rows import score_rows

DAMAGE = ("flip", "flip the footer", "truncate", "append", "empty")


def damage(path, how):
    data = bytearray(path.read_bytes())
    if how == "flip":
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif how == "flip the footer":
        data[-30] ^= 1
        path.write_bytes(data)
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "truncate":
        path.write_bytes(data[:-10])
    else:
        path.write_bytes(data + b"0")


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_shard_is_named_verify_marks_it_and_only_it_is_written_again(tmp_path, how, capsys):
    folder = tmp_path / "run"
    trials, scores = write(folder, shard_trials=5)
    digest = load_run(folder).digest("m")
    bad = files_of(folder)[1]
    damage(bad, how)
    with pytest.raises(RunError, match=f"{bad.name}: cut or flipped bits.*results verify"):
        load_run(folder)
    assert main(["results", "verify", str(folder)]) == 1
    out = capsys.readouterr().out
    assert str(bad) in out and "cut or flipped bits" in out and "m: 1 of 3 shards to be scored: 1" in out
    run, aside = load_run(folder), bad.with_name(f"{bad.name}.bad")
    assert run.unfinished == ("m",) and [s.index for s in run.missing("m")] == [1] and aside.exists()
    again = open_run(folder, make_header(6, 6))
    store(again, "m", trials, scores)
    assert load_run(folder).digest("m") == digest and not aside.exists()
    assert main(["results", "verify", str(folder)]) == 0
    assert "as it was written" in capsys.readouterr().out


def test_a_shard_of_another_run_or_method_is_foreign(tmp_path, capsys):
    for name, seed in (("a", 0), ("b", 1)):
        write(tmp_path / name, shard_trials=5, seed=seed)
    digest = load_run(tmp_path / "a").digest("m")
    own, other = (files_of(tmp_path / name)[0] for name in ("a", "b"))
    own.unlink()
    shutil.copy(other, own.parent)
    with pytest.raises(RunError, match="foreign"):
        load_run(tmp_path / "a")
    assert main(["results", "verify", str(tmp_path / "a")]) == 1
    assert "foreign" in capsys.readouterr().out
    trials = made_trials(6, 6)
    run = open_run(tmp_path / "a", make_header(6, 6))
    assert [s.index for s in run.todo("m")] == [0]
    store(run, "m", trials, make_scores(trials, OUTCOMES))
    assert load_run(tmp_path / "a").digest("m") == digest


@pytest.mark.parametrize("name", ["000007-0123456789abcdef.parquet", "000000-0123456789abcdef.parquet", "notes.txt"])
def test_a_file_that_holds_no_shard_of_the_plan_is_set_aside(tmp_path, capsys, name):
    write(tmp_path / "run")
    stray = tmp_path / "run" / "shards" / "m" / name
    stray.write_bytes(files_of(tmp_path / "run")[0].read_bytes())
    if name.startswith("000000"):  # under the digest that it has, beside the shard
        table = pq.read_table(stray, partitioning=None)
        stray.unlink()
        stray = put_shard(stray, table)
    load_run(tmp_path / "run")  # it is no part of the run
    assert main(["results", "verify", str(tmp_path / "run")]) == 1
    assert re.search("foreign: .*; set aside", capsys.readouterr().out)
    assert len(files_of(tmp_path / "run")) == 1 and load_run(tmp_path / "run").methods == ("m",)
    assert name.startswith("000000") or not stray.exists()


def test_a_run_json_that_was_edited_is_refused(tmp_path):
    write(tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    path.write_text(path.read_text().replace('"seed": 0', '"seed": 1'))
    with pytest.raises(RunError, match="its own hash"):
        load_run(tmp_path / "run")


@pytest.mark.parametrize("when", ["sync_file", "os.replace"])
def test_a_disk_that_fills_up_leaves_no_partial_shard_and_the_folder_goes_on_after_freeing(tmp_path, monkeypatch, when):
    write(tmp_path / "run", method="first")

    def full(*_):
        raise OSError(28, os.strerror(28))

    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("second", {"kind": "test"})
    monkeypatch.setattr(f"r2h_batch.runs.shard.{when}", full)
    trials = made_trials(6, 6)
    run = open_run(tmp_path / "run", make_header(6, 6))
    with pytest.raises(OSError, match="No space"), run.write("second", shards_of(run.header)[0]) as writer:
        writer.append(trials=score_rows(trials, make_scores(trials, OUTCOMES), NAMES))
    monkeypatch.undo()
    assert not files_of(tmp_path / "run", "second") and not list((tmp_path / "run").rglob("*.tmp"))
    assert load_run(tmp_path / "run").methods == ("first",)
    write(tmp_path / "run", method="second")
    assert load_run(tmp_path / "run").methods == ("first", "second")
