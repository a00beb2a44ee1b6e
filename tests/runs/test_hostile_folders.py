"""Run folders that somebody else wrote: one line and an exit code whatever they say, and nothing outside is touched."""

import contextlib
import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from made_runs import NAMES, files_of, make_header, make_scores, make_trials, read_json, write_run

from r2h_batch.__main__ import main
from r2h_batch.runs import store as run_store
from r2h_batch.runs.rows import TRIAL_SCHEMA, score_rows
from r2h_batch.runs.store import RunError, claim, load_run, mark_for_rerun, open_run, run_hash, sha256_of, shard_at

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


RECEIPT = [
    *[("outcomes", v) for v in (..., [], {"S0": {"banana": 3}, "S1": {"success": 3}})],
    *[("outcomes.S0", {"success": v}) for v in (1e15, -3, None)],
    *[("files", v) for v in (..., [], {"bananas": {}})],
    *[("files.trials.path", v) for v in (..., 7, ESC)],
    *[("files.trials.bytes", v) for v in (..., "many", 1e300)],
    *[("files.trials.sha256", v) for v in ("../" * 20, 7, "f" * 64)],
    *[("first", v) for v in (1, -1, None)],
    ("run", "0" * 64),
    ("method", ESC),
    ("seconds", "long"),
]


@pytest.mark.parametrize(("where", "value"), RECEIPT, ids=lambda v: repr(v)[:30])
def test_a_receipt_with_an_odd_field_is_refused_and_its_shard_scored_again(run, capsys, where, value):
    path = run / "manifest" / "m" / "000000.json"
    in_file(path, lambda d: put(d, where, value))
    for command in ("digest", "report", "compare"):
        assert COMMANDS[command](run) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and captured.err[:-1].isprintable()
    assert COMMANDS["verify"](run) == 1
    captured = capsys.readouterr()
    assert all(line.isprintable() for line in captured.out.splitlines()) and "shard 0 of 'm'" in captured.out
    assert load_run(run).unfinished == ("m",) and not path.exists()


@pytest.mark.parametrize("form", ["../victim.parquet", "trials/m/../../../victim.parquet", "{victim}"])
def test_a_receipt_that_names_a_file_elsewhere_is_set_aside_and_that_file_is_neither_read_nor_renamed(
    run, form, capsys
):
    victim = run.parent / "victim.parquet"
    os.mkfifo(victim)  # reading it would wait for ever
    receipt = run / "manifest" / "m" / "000000.json"
    in_file(receipt, lambda d: put(d, "files.trials.path", form.format(victim=victim)))
    assert COMMANDS["verify"](run) == 1
    assert "the only one it may name is trials/m/000000-" in capsys.readouterr().out
    assert sorted(p.name for p in run.parent.iterdir()) == ["run", "victim.parquet"]


@pytest.mark.parametrize(
    "what", ["trials", "manifest", "methods", "trials/m", "manifest/m", "methods/m.json", "run.json"]
)
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


@pytest.mark.parametrize("seen", ["foreign: no receipt names it", "missing"])
def test_what_another_part_has_stored_since_it_was_looked_at_stays(run, monkeypatch, seen):
    """A part of a sweep starts while another one is between a file and its receipt: the look is old when the claim is free."""
    header, (file,) = read_json(run / "run.json"), (run / "trials" / "m").iterdir()
    shard = None if seen.startswith("foreign") else shard_at(header, 0)
    before, looks, look = sorted(run.rglob("*")), [], run_store.problems_of

    def first_look_is_old(*arguments):
        looks.append(arguments)
        return [run_store.Problem("m", shard, file, seen)] if len(looks) == 1 else look(*arguments)

    with monkeypatch.context() as m:
        m.setattr("r2h_batch.runs.store.problems_of", first_look_is_old)
        assert mark_for_rerun(run, header) == []
    assert sorted(p for p in run.rglob("*") if ".claims" not in p.parts) == [
        p for p in before if ".claims" not in p.parts
    ]
    load_run(run)
    (run / "manifest" / "m" / "000000.json").unlink()  # and a file that no receipt names is still set aside
    (line,) = mark_for_rerun(run, header)
    assert line.endswith("foreign: no receipt names it; set aside") and not file.exists()


def test_a_claim_that_is_a_link_writes_nothing_where_it_leads(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("years of work")
    (tmp_path / "claim").symlink_to(precious)
    with pytest.raises(OSError, match="take it away"), claim(tmp_path / "claim"):
        pass
    assert precious.read_text() == "years of work"


def forge(run, change, kind="trials", method="m"):
    """Another table under a shard's receipt, with the sha256 that it has."""
    path = files_of(run, f"{kind}/{method}")[0]
    table = change(pq.read_table(path, partitioning=None))
    path.unlink()
    pq.write_table(table, path)
    sha = sha256_of(path)
    new = path.with_name(f"000000-{sha[:16]}.parquet")
    path.rename(new)
    stored = {"path": f"{kind}/{method}/{new.name}", "sha256": sha, "bytes": new.stat().st_size}
    in_file(run / "manifest" / method / "000000.json", lambda d: put(d, f"files.{kind}", stored))


def with_words(table, name, words):
    index = table.column_names.index(name)
    column = pa.DictionaryArray.from_arrays(pa.array([0] * len(table), pa.int32()), pa.array(words, pa.string()))
    return table.set_column(index, name, column)


FORGED = {
    "more rows than planned": lambda t: pa.concat_tables([t] * 1000),
    "fewer rows": lambda t: t.slice(1),
    "no object": lambda t: t.set_column(1, "object", pa.nulls(len(t), t.schema.field(1).type)),
    "an unknown outcome": lambda t: with_words(t, "outcome", ["banana"]),
    "an object that moves the cursor": lambda t: with_words(t, "object", [ESC]),
    "a word that is empty": lambda t: with_words(t, "object", [""]),
    "a column of another type": lambda t: t.set_column(1, "object", t["object"].cast(pa.string())),
}


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_table_with_the_right_sha256_is_one_line(run, what, capsys):
    forge(run, FORGED[what])
    for command in ("report", "compare"):
        assert COMMANDS[command](run) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.count("\n") == 1 and captured.err[:-1].isprintable()


def test_a_table_that_unpacks_to_more_than_its_rows_can_hold_is_refused_undecoded(run, monkeypatch):
    forge(run, lambda t: with_words(t, "object", ["x" * (20 << 20)]))  # a few kB on the disk
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

    forge(run, without, "poses")
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
    forge(run, MADE_UP[what])
    assert COMMANDS["report"](run) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and "m: 1 rows have another outcome than their criteria say" in captured.err


@pytest.mark.parametrize("ids", [[0, 2, 2, 1, 3, 5], [0, 2, 4, 1, 3, 7], [2, 0, 4, 1, 3, 5]])
def test_rows_of_other_trials_with_a_right_sha256_are_found_and_scored_again(tmp_path, ids, capsys):
    n = np.zeros(6, int)
    trials = make_trials(3, 3)
    trials.trial_id[:] = torch.tensor([0, 2, 4, 1, 3, 5])
    run = open_run(tmp_path / "run", make_header(3, 3, protocol="r2h-v1"))
    run.register("m", {"kind": "test"})
    with run.write("m", *run.todo("m")) as writer:
        writer.append(trials=score_rows(trials, make_scores(trials, n), NAMES))
    assert COMMANDS["verify"](tmp_path / "run") == 0
    forge(tmp_path / "run", lambda t: t.set_column(0, TRIAL_SCHEMA.field("trial_id"), pa.array(ids, pa.int64())))
    with pytest.raises(RunError, match="trial_id"):
        load_run(tmp_path / "run")
    assert COMMANDS["verify"](tmp_path / "run") == 1
    assert "shard 0 of 'm' will be scored again" in capsys.readouterr().out
