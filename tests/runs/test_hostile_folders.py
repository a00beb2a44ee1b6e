"""Run folders that somebody else wrote: one line and an exit code whatever they say, and nothing outside is touched."""

import contextlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from made_runs import (
    NAMES,
    files_of,
    forge,
    made_trials,
    make_header,
    make_scores,
    read_json,
    receipt_of,
    with_a_fatal_footer,
    with_receipt,
    write_run,
)

from r2h_batch.__main__ import main
from r2h_batch.runs import verify as verifying
from r2h_batch.runs.files import RunError, claim
from r2h_batch.runs.header import Record, checked, run_hash, shard_at
from r2h_batch.runs.rows import TRIAL_SCHEMA
from r2h_batch.runs.store import load_run
from r2h_batch.runs.verify import mark_for_rerun
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep.rows import score_rows

COMMANDS = {
    "verify": lambda folder: main(["results", "verify", str(folder)]),
    "digest": lambda folder: main(["results", "digest", str(folder)]),
    "report": lambda folder: main(["report", str(folder)]),
    "compare": lambda folder: main(["compare", str(folder)]),
    "rethreshold": lambda folder: main(["results", "rethreshold", str(folder)]),
}
ESC = "\x1b]0;owned\x07\x1b[2J"


def in_file(path, change):
    data = read_json(path)
    change(data)
    if path.name == "run.json":
        with contextlib.suppress(KeyError, AttributeError):  # no hash can be made of it: the old one stays
            data["hash"] = run_hash(data)
    path.write_text(json.dumps(data))


def put(data, where, value):
    """Set a field by its dotted path; `...`: take it away."""
    *path, last = where.split(".")
    for key in path:
        data = data[key]
    if value is ...:
        del data[last]
    else:
        data[last] = value


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    n = np.zeros(6, int)
    folder = tmp_path_factory.mktemp("good") / "run"
    write_run(folder, {"m": n, "second": n}, 3, 3)
    return folder


@pytest.fixture
def run(good, tmp_path):
    return shutil.copytree(good, tmp_path / "run")


HEADER = [
    *[(f, None) for f in ("versions", "digests", "device", "configuration", "stored")],
    *[(f, ...) for f in ("versions.r2h_batch", "digests.trials", "protocol")],
    *[("trials.S0", v) for v in (10**15, -1, "3", True)],
    *[("shard_trials", v) for v in (1e300, 10**15, 2.5)],
    ("trials", {"S0": 10**12, "S1": 3}),
    ("versions.r2h_batch", ESC),
    ("configuration.thresholds", {"reach_radius_m": 0.1}),
    ("motion", {"engine": 7}),
    ("predictors", {"noise_factor": "loud"}),
    ("objects", [{"name": ESC, "split": "S0", "built_in": True}]),
    ("objects", [{"name": "cup", "split": "S0", "built_in": True}] * 2),
    ("stored", ["../../etc"]),
    ("protocol", "x" * 100_000),
]


@pytest.mark.parametrize(("where", "value"), HEADER, ids=lambda v: repr(v)[:30])
def test_a_run_json_with_an_odd_field_is_one_line(run, capsys, where, value):
    in_file(run / "run.json", lambda d: put(d, where, value))
    for command in COMMANDS.values():
        assert command(run) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and len(captured.err) < 600
        assert "run.json" in captured.err and captured.err[:-1].isprintable()


class Sized(Record):
    size: int


def test_a_field_that_is_refused_is_told_with_what_was_given_and_one_that_is_missing_by_its_name_alone():
    for data, given in (({"size": "seven", "other": "word"}, True), ({"other": "word"}, False)):
        with pytest.raises(RunError) as refused:
            checked(Sized, data, Path("run.json"))
        said = str(refused.value)
        assert "size" in said and "word" not in said and ("'seven'" in said) == given, said


RECEIPT = [
    ("", ...),
    *[("outcomes", v) for v in (..., [], {"S0": {"banana": 3}, "S1": {"success": 3}})],
    *[("outcomes.S0", {"success": v}) for v in (1e15, -3, None)],
    *[("first", v) for v in (1, -1, None)],
    ("run", "0" * 64),
    ("method", ESC),
    ("seconds", "long"),
]


@pytest.mark.parametrize(("where", "value"), RECEIPT, ids=lambda v: repr(v)[:30])
def test_a_receipt_with_an_odd_field_is_refused_and_its_shard_scored_again(run, capsys, where, value):
    (path,) = files_of(run, "m")
    receipt = receipt_of(path)
    if where:
        put(receipt, where, value)
    path = with_receipt(path, receipt if where else ["no receipt"])
    for command in ("digest", "report", "compare"):
        assert COMMANDS[command](run) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and captured.err[:-1].isprintable()
    assert COMMANDS["verify"](run) == 1
    captured = capsys.readouterr()
    assert all(line.isprintable() for line in captured.out.splitlines()) and "shard 0 of 'm'" in captured.out
    assert load_run(run).unfinished == ("m",) and not path.exists()


@pytest.mark.parametrize("what", ["shards", "methods", "shards/m", "methods/m.json", "run.json"])
def test_a_link_in_place_of_a_part_of_the_folder_is_refused_by_every_command(run, tmp_path, what, capsys):
    moved = tmp_path / "elsewhere"
    (run / what).rename(moved)
    (run / what).symlink_to(moved)
    before = sorted(tmp_path.rglob("*"))
    for command in COMMANDS.values():
        assert command(run) == 2
        error = capsys.readouterr().err
        assert "a symbolic link" in error and error.count("\n") == 1
    with pytest.raises(RunError, match="a symbolic link"):
        open_run(run, make_header(3, 3))
    assert sorted(tmp_path.rglob("*")) == before


def test_a_link_in_place_of_a_shard_is_set_aside_and_what_it_leads_to_stays(run, tmp_path, capsys):
    (path,) = files_of(run, "m")
    victim = tmp_path / "victim.parquet"
    path.rename(victim)
    path.symlink_to(victim)
    before = victim.read_bytes()
    assert COMMANDS["verify"](run) == 1
    assert "no regular file; shard 0 of 'm' will be scored again" in capsys.readouterr().out
    assert victim.read_bytes() == before and load_run(run).unfinished == ("m",)
    path.with_name(f"{path.name}.bad").unlink()
    os.mkfifo(path)  # reading it would wait for ever
    assert COMMANDS["verify"](run) == 1


def test_what_another_part_has_stored_since_it_was_looked_at_stays(run, monkeypatch):
    """A part of a sweep stores the shard again while it is looked at: the look is old when the claim is free."""
    (path,), looks, look = files_of(run, "m"), [], verifying.problems_of
    shard = shard_at(read_json(run / "run.json"), 0)

    def first_look_is_old(*arguments, **words):
        looks.append(arguments)
        return [verifying.Problem("m", shard, path, "cut")] if len(looks) == 1 else look(*arguments, **words)

    monkeypatch.setattr("r2h_batch.runs.verify.problems_of", first_look_is_old)
    assert mark_for_rerun(run, read_json(run / "run.json")) == [] and len(looks) == 2
    assert path.exists() and load_run(run).methods == ("m", "second")


def test_a_shard_that_another_sweep_holds_is_not_set_aside(run):
    (path,) = files_of(run, "m")
    path.write_bytes(b"0")
    with claim(run / ".claims" / "m-000000"):
        assert mark_for_rerun(run, read_json(run / "run.json")) == [] and path.exists()
    assert len(mark_for_rerun(run, read_json(run / "run.json"))) == 1 and not path.exists()


def test_a_damaged_footer_is_told_by_the_digest_before_anything_opens_it(run, capsys):
    """The file in reproductions: pyarrow aborts when it is asked for the columns' types."""
    (path,) = files_of(run, "m")
    path.write_bytes(with_a_fatal_footer(path.read_bytes()))
    for command in ("report", "compare", "digest", "rethreshold"):
        assert COMMANDS[command](run) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1
        assert path.name in captured.err and "cut or flipped bits" in captured.err
    assert COMMANDS["verify"](run) == 1
    assert f"{path}: " in capsys.readouterr().out and load_run(run).unfinished == ("m",)


def test_a_claim_that_is_a_link_writes_nothing_where_it_leads(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("years of work")
    (tmp_path / "claim").symlink_to(precious)
    with pytest.raises(OSError, match="take it away"), claim(tmp_path / "claim"):
        pass
    assert precious.read_text() == "years of work"


def forge_shard(run, change, kind="trials", method="m"):
    forge(files_of(run, method)[0], change, kind)


def with_words(table, name, words):
    index = table.column_names.index(name)
    column = pa.DictionaryArray.from_arrays(pa.array([0] * len(table), pa.int32()), pa.array(words, pa.string()))
    return table.set_column(index, name, column)


FORGED = {
    "more rows than planned": lambda t: pa.concat_tables([t] * 1000),
    "a column twice": lambda t: t.append_column("trial_id", t["trial_id"]),
    "fewer rows": lambda t: t.slice(1),
    "no object": lambda t: t.set_column(1, "object", pa.nulls(len(t), t.schema.field(1).type)),
    "an unknown outcome": lambda t: with_words(t, "outcome", ["banana"]),
    "an object that moves the cursor": lambda t: with_words(t, "object", [ESC]),
    "a word that is empty": lambda t: with_words(t, "object", [""]),
    "a column of another type": lambda t: t.set_column(1, "object", t["object"].cast(pa.string())),
}


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_table_with_the_right_sha256_is_one_line(run, what, capsys):
    forge_shard(run, FORGED[what])
    for command in ("report", "compare"):
        assert COMMANDS[command](run) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and captured.err[:-1].isprintable()


def test_a_table_that_unpacks_to_more_than_its_rows_can_hold_is_refused_undecoded(run, monkeypatch):
    forge_shard(run, lambda t: with_words(t, "object", ["x" * (20 << 20)]))  # a few kB on the disk
    read = []
    monkeypatch.setattr(pq.ParquetFile, "read", lambda *_, **__: read.append(1))
    with pytest.raises(RunError, match=r"unpacks to .* bytes; at most"):
        load_run(run, verify=False).trials("m")
    assert not read


def test_a_pose_without_its_numbers_is_refused_by_its_column(tmp_path):
    run, n = tmp_path / "run", np.zeros(6, int)
    write_run(run, {"m": n}, 3, 3, stored=["poses", "details"])

    def without(table):
        field = table.schema.field("T_obj_ee")
        return table.set_column(1, field, pa.array([[None] * 16] * len(table), field.type))

    forge_shard(run, without, "poses")
    with pytest.raises(RunError, match="column 'T_obj_ee' has 96 empty numbers"):
        load_run(run).poses("m")


def at(row, **values):
    """A change of a table: other values in one row."""

    def change(table):
        for name, value in values.items():
            column = table[name].to_pylist()
            column[row] = value
            place = table.column_names.index(name)
            table = table.set_column(place, table.schema.field(place), pa.array(column, table.schema.field(place).type))
        return table

    return change


MADE_UP = {  # of six rows that are successes: S0 0, 1, 2, S1 3, 4, 5
    "another outcome than the first failure": at(3, passed_reach=False),
    "a success without Affordance in S1": at(4, passed_affordance=None),
    "an outcome that no criterion says": at(2, outcome="safe"),
}


@pytest.mark.parametrize("what", MADE_UP)
def test_an_outcome_that_its_criteria_do_not_give_is_refused_by_every_table(run, what, capsys):
    forge_shard(run, MADE_UP[what])
    assert COMMANDS["report"](run) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "m: 1 rows have another outcome than their criteria say" in captured.err


@pytest.mark.parametrize("ids", [[0, 2, 2, 1, 3, 5], [0, 2, 4, 1, 3, 7], [2, 0, 4, 1, 3, 5]])
def test_rows_of_other_trials_with_a_right_sha256_are_found_and_scored_again(tmp_path, ids, capsys):
    n = np.zeros(6, int)
    trials = made_trials(3, 3)
    trials.trial_id[:] = torch.tensor([0, 2, 4, 1, 3, 5])
    run = open_run(tmp_path / "run", make_header(3, 3, protocol="r2h-v1"))
    run.register("m", {"kind": "test"})
    with run.write("m", *run.todo("m")) as writer:
        writer.append(trials=score_rows(trials, make_scores(trials, n), NAMES))
    assert COMMANDS["verify"](tmp_path / "run") == 0
    forge_shard(tmp_path / "run", lambda t: t.set_column(0, TRIAL_SCHEMA.field("trial_id"), pa.array(ids, pa.int64())))
    with pytest.raises(RunError, match="trial_id"):
        load_run(tmp_path / "run")
    assert COMMANDS["verify"](tmp_path / "run") == 1
    assert "shard 0 of 'm' will be scored again" in capsys.readouterr().out


def test_a_name_of_several_trials_means_none_of_them(run, capsys):
    (run / "ids.csv").write_text("trial_id,id,variant\n0,a,x\n2,b,x\n4,a,y\n")
    with pytest.raises(RunError, match=r"trials 0 and 4 have the id 'a' in ids.csv; give a trial's number"):
        load_run(run).trial_id("a")
    assert load_run(run).trial_id("b") == 2
    with pytest.raises(RunError, match="no trial has the id 'c'"):
        load_run(run).trial_id("c")
