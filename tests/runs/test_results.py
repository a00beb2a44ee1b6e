"""Run folders: what is written is read back, whole or not at all, and never mixed with another run."""

import json
import os
import signal
import socket
import time

import numpy as np
import pyarrow as pa
import pytest
from made_runs import (
    NAMES,
    OUTCOMES,
    files_of,
    forge,
    made_trials,
    make_header,
    make_predictions,
    make_scores,
    store,
    write,
    write_run,
)

from r2h_batch.__main__ import main
from r2h_batch.runs import files
from r2h_batch.runs import store as run_store
from r2h_batch.runs.columns import later
from r2h_batch.runs.files import RunError, claim, owner_of, temporary_name
from r2h_batch.runs.header import shards_of
from r2h_batch.runs.rows import DETAIL_SCHEMA, OUTCOME_NAMES, TRIAL_SCHEMA
from r2h_batch.runs.store import load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep.rows import pose_rows, score_rows
from r2h_batch.types import CRITERIA, Outcome

ALL = ["details", "poses", "paths"]
LATER = [name for name in later("trials") if name in TRIAL_SCHEMA.names]
"""Columns that older runs lack."""


def test_every_column_comes_back_as_it_was_scored(tmp_path):
    trials, scores = write(tmp_path / "run", stored=ALL, shard_trials=5)
    run = load_run(tmp_path / "run")
    table = run.trials("m")
    assert table.schema.equals(TRIAL_SCHEMA, check_metadata=False)
    assert table["trial_id"].to_pylist() == trials.trial_id.tolist()
    assert table["outcome"].to_pylist() == [OUTCOME_NAMES[o] for o in OUTCOMES]
    assert table["split"].to_pylist() == ["S0"] * 6 + ["S1"] * 6
    assert table["object"].to_pylist() == [NAMES.objects[i] for i in trials.object_index.tolist()]
    assert table["side"].to_pylist() == [NAMES.hand_sides[i] for i in trials.hand_index.tolist()]
    for i, c in enumerate(CRITERIA):
        passed = [p if e else None for p, e in zip(scores.passed[:, i].tolist(), scores.evaluated[:, i].tolist())]
        assert table[f"passed_{c}"].to_pylist() == passed
        margin = [None if np.isnan(m) else m for m in scores.margin[:, i].tolist()]
        assert table[f"margin_{c}_m"].to_pylist() == margin
    details = run.details("m")
    assert details.schema.equals(DETAIL_SCHEMA, check_metadata=False)
    assert details["hand_index"].to_pylist() == trials.hand_index.tolist()
    for stored, names in ((table, ("t_plan_s", "t_exec_s")), (details, DETAIL_SCHEMA.names[2:5])):
        for name in names:
            assert stored[name].to_pylist() == [None if np.isnan(v) else v for v in getattr(scores, name).tolist()]
    for row, q, point, length in zip(details.to_pylist(), scores.q_goal, scores.witness_point, scores.path_len):
        assert row["q_goal"] == (q.tolist() if length else None)
        assert row["witness_point_m"] == (point.tolist() if length else None)
        assert row["witness_time_s"] == (1.5 if length else None)
        assert row["witness_plan_part"] == ("forearm" if length else None)
        assert row["witness_safe_part"] == ("left_pad" if length else None)
    for row in table.to_pylist():
        assert row["plan_reason"] == {"plan": "ik_in_collision"}.get(
            row["outcome"], "not_evaluated" if row["outcome"].startswith("invalid") else "ok"
        )
        assert row["plan_pair"] == ("object_hand" if row["outcome"] == "plan" else None)
        assert row["nearest_pair"] is None
    assert table["borderline"].to_pylist() == scores.borderline.tolist()
    assert table["t_method_s"].null_count == len(table)


def test_poses_come_back_bit_for_bit_even_when_they_are_not_numbers(tmp_path):
    trials = made_trials(4, 4)
    predictions = make_predictions(trials)
    predictions.T_world_ee[2, 0, 0] = float("nan")
    predictions.T_obj_ee[3, 1, 1] = float("inf")
    run = open_run(tmp_path / "run", make_header(4, 4, stored=["poses"]))
    run.register("m", {})
    with run.write("m", *run.todo("m")) as writer:
        scores = make_scores(trials, np.array([0, 0, Outcome.INVALID_INPUT, Outcome.INVALID_INPUT, 0, 0, 0, 0]))
        writer.append(trials=score_rows(trials, scores, NAMES), poses=pose_rows(predictions))
    table = load_run(tmp_path / "run").poses("m")
    for name in ("T_obj_ee", "T_world_ee"):
        stored = np.array(table[name].combine_chunks().flatten(), np.float32).reshape(-1, 4, 4)
        assert stored.tobytes() == getattr(predictions, name).numpy().tobytes()


def test_rows_can_come_in_chunks_and_shards_of_any_size_hold_the_same_rows(tmp_path):
    trials = made_trials(5, 5)
    scores = make_scores(trials, np.arange(10) % 3)
    whole = score_rows(trials, scores, NAMES)
    digests = set()
    for size in (1, 3, 7, 100):
        folder = tmp_path / str(size)
        run = open_run(folder, make_header(5, 5, shard_trials=size))
        run.register("m", {})
        for shard in reversed(run.todo("m")):
            with run.write("m", shard) as writer:
                for i in range(shard.first, shard.last):
                    writer.append(trials=whole[i : i + 1])
        stored = load_run(folder)
        assert stored.trials("m").to_pylist() == whole.to_pylist()
        assert len(files_of(folder)) == -(-10 // size)
        digests.add(stored.digest("m"))
    assert len(digests) == 1


def test_the_digest_is_of_the_rows_and_not_of_the_clock(tmp_path):
    digests = {}
    changed = np.where(np.arange(12) == 7, Outcome.SAFE, OUTCOMES)
    for name, outcome, t_plan_s, t_exec_s in (
        ("a", OUTCOMES, 0.1, 8.5),
        ("slower", OUTCOMES, 0.7, 8.5),
        ("other outcome", changed, 0.1, 8.5),
        ("other path", OUTCOMES, 0.1, 8.6),
    ):
        trials = made_trials(6, 6)
        run = open_run(tmp_path / name, make_header(6, 6))
        store(run, "m", trials, make_scores(trials, outcome, t_plan_s=t_plan_s, t_exec_s=t_exec_s))
        digests[name] = load_run(tmp_path / name).digest("m")
    assert digests["a"] == digests["slower"]
    assert len(set(digests.values())) == 3


def test_what_a_killed_sweep_left_of_a_shard_is_removed_by_the_next_one_and_is_no_parquet_file(tmp_path):
    write(tmp_path / "run")
    stale = temporary_name(tmp_path / "run" / "shards" / "m" / "000000")
    assert stale.suffix != ".parquet"
    stale.write_bytes(b"half a file")
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("m", {"kind": "test"})
    with run.claim("m", shards_of(run.header)[0]) as mine:
        assert mine is not None and not stale.exists()


def test_totals_are_asserted_on_write(tmp_path):
    trials = made_trials(6, 5)
    scores = make_scores(trials, OUTCOMES[:11])
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("m", {})
    with pytest.raises(RunError, match="planned were"), run.write("m", *run.todo("m")) as writer:
        writer.append(trials=score_rows(trials, scores, NAMES))
    run = load_run(tmp_path / "run")
    assert run.methods == () and run.unfinished == ("m",) and not files_of(tmp_path / "run")


def test_a_run_from_before_a_column_was_stored_is_read_with_it_empty_and_keeps_its_digest(tmp_path, monkeypatch):
    write(tmp_path / "run")
    (path,) = files_of(tmp_path / "run")
    forge(path, lambda table: table.drop_columns(LATER))
    digest = load_run(tmp_path / "run").digest("m")
    with monkeypatch.context() as m:  # the version that stored it knew no more columns, and gave the same digest
        names = [n for n in TRIAL_SCHEMA.names if n not in LATER]
        m.setattr(run_store, "schema_of", lambda header, kind, **_: pa.schema([TRIAL_SCHEMA.field(n) for n in names]))
        assert load_run(tmp_path / "run").digest("m") == digest
    table = load_run(tmp_path / "run").trials("m")
    assert table.schema.equals(TRIAL_SCHEMA, check_metadata=False)
    assert all(table[name].null_count == 12 for name in LATER) and table["plan_pair"].null_count < 12


@pytest.mark.parametrize(
    "change",
    [
        {"protocol": "r2h-v1"},
        {"configuration": {"name": "paper"}},
        {"digests": {"trials": "f"}},
        {"seed": 1},
        {"stored": ["paths"]},
        {"device": {"kind": "cuda", "name": "x"}},
        {"versions": {"r2h_batch": "0.2.0"}},
        {"trials": {"S0": 7, "S1": 6}},
    ],
    ids=lambda c: next(iter(c)),
)
def test_another_configuration_is_refused_naming_what_differs_and_what_to_do(tmp_path, change):
    write(tmp_path / "run")
    before = (tmp_path / "run" / "run.json").read_bytes()
    field = "seed \\(0, now 1\\)" if "seed" in change else rf"{next(iter(change))}( \(\w+\))?"
    with pytest.raises(RunError, match=rf"another run, which differs in {field}; choose another --out"):
        open_run(tmp_path / "run", make_header(6, 6, **change))
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_another_machine_of_the_same_kind_may_share_a_folder_and_another_shard_size_may_not(tmp_path):
    write(tmp_path / "run")
    open_run(tmp_path / "run", make_header(6, 6, device={"kind": "cpu", "name": "cpu: another model"}))
    open_run(tmp_path / "run", make_header(6, 6, shard_trials=5), exact=False)
    with pytest.raises(RunError, match="shards of 100000 trials; the command wants 5"):
        open_run(tmp_path / "run", make_header(6, 6, shard_trials=5))


def test_two_writers_of_one_shard_leave_the_rows_of_the_first_and_no_files_of_the_second(tmp_path):
    trials = made_trials(6, 6)
    a, b = open_run(tmp_path / "run", make_header(6, 6)), open_run(tmp_path / "run", make_header(6, 6))
    for run in (a, b):
        run.register("m", {"kind": "test"})
    (shard,) = a.todo("m")
    with b.write("m", shard) as late:
        late.append(trials=score_rows(trials, make_scores(trials, OUTCOMES, t_plan_s=0.9), NAMES))
        store(a, "m", trials, make_scores(trials, OUTCOMES, t_plan_s=0.1))
    run = load_run(tmp_path / "run")
    assert np.nanmean(run.trials("m")["t_plan_s"].to_numpy()) < 0.2
    assert len(files_of(tmp_path / "run")) == 1 and not list((tmp_path / "run").rglob("*.tmp"))


@pytest.mark.alone
def test_a_claim_is_given_to_one_at_a_time_and_falls_with_its_process_though_a_child_of_that_lives(tmp_path):
    """The child: such as a server that a method forked."""
    with claim(tmp_path / "c") as first, claim(tmp_path / "c") as second:
        assert first is not None and second is None
    read, write = os.pipe()
    holder = os.fork()
    if not holder:
        with claim(tmp_path / "c"):
            if not os.fork():
                os.write(write, str(os.getpid()).encode())  # it runs: so it has closed what it inherited
                time.sleep(60)
                os._exit(0)
            time.sleep(60)
    child = int(os.read(read, 100))
    try:
        with claim(tmp_path / "c") as own:
            assert own is None
        os.kill(holder, signal.SIGKILL)
        os.waitpid(holder, 0)
        os.kill(child, 0)  # it lives
        with claim(tmp_path / "c") as own:
            assert own is not None and own.died == [f"process {holder} on {socket.gethostname()}"]
        assert not (tmp_path / "c").exists()
    finally:
        os.kill(child, signal.SIGKILL)


def test_a_claim_goes_with_its_block_and_whoever_has_opened_it_before_does_not_hold_one_of_nothing(
    tmp_path, monkeypatch
):
    """Between opening the file and locking it, its holder's block ends: another process may hold the next file by then."""
    path, opened = tmp_path / "c", files._open_own

    def open_late(place):
        monkeypatch.setattr(files, "_open_own", opened)
        with claim(place):
            return opened(place)

    monkeypatch.setattr(files, "_open_own", open_late)
    with claim(path) as own, claim(path) as other:
        assert own is not None and other is None and path.exists()
    with pytest.raises(OSError, match="full"), claim(path):
        raise OSError(28, "full")
    assert not path.exists()


@pytest.mark.parametrize("text", ["process 7 on host", "..process 7 on host", "\x1b[2J" * 100_000, ""])
def test_the_claim_of_a_version_before_or_of_somebody_else_counts_no_death(tmp_path, text):
    (tmp_path / "c").write_text(text)
    with claim(tmp_path / "c") as own:
        assert own.died == [] and owner_of(tmp_path / "c") == f"process {os.getpid()} on {socket.gethostname()}"


def test_a_folder_of_before_with_a_quarantine_opens_and_its_shard_is_scored(tmp_path, capsys):
    run = tmp_path / "run"
    digest = write_run(run, {"m": np.zeros(12, int), "n": np.zeros(12, int)}, 6, 6, shard_trials=4).digest("m")
    files_of(run)[1].unlink()
    (run / "quarantine" / "m").mkdir(parents=True)
    note = {"method": "m", "first": 4, "last": 8, "errors": ["the sweep's process ended 3 times while it was scored"]}
    (run / "quarantine" / "m" / "000001.json").write_text(json.dumps(note))
    (run / ".claims").mkdir(exist_ok=True)
    (run / ".claims" / "m-000001").write_text("...process 7 on host")
    assert load_run(run).unfinished == ("m",)
    main(["report", str(run), "--full"])
    assert "| n " in capsys.readouterr().out and main(["results", "verify", str(run)]) == 0
    again = open_run(run, load_run(run).header)
    again.register("m", load_run(run).entry("m").source)
    assert [s.index for s in again.todo("m")] == [1]
    trials = made_trials(6, 6)
    with again.claim("m", again.todo("m")[0]) as own:
        assert own.died == []
        store(again, "m", trials, make_scores(trials, np.zeros(12, int)))
    assert load_run(run).digest("m") == digest and not list((run / ".claims").iterdir())


def test_a_run_that_claims_a_million_shards_is_listed_at_once(tmp_path):
    run = open_run(tmp_path / "run", make_header(10**6, 0, shard_trials=1))
    for k in range(4):
        run.register(f"m{k}", {"kind": "test"})
    start = time.process_time()
    found = load_run(tmp_path / "run")
    assert found.methods == () and found.unfinished == ("m0", "m1", "m2", "m3")
    assert time.process_time() - start < 0.5
