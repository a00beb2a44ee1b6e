"""Run folders: what is written is read back, whole or not at all, and never mixed with another run."""

import json
import os
import signal
import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_runs import (
    NAMES,
    OUTCOMES,
    files_of,
    make_header,
    make_predictions,
    make_scores,
    make_trials,
    read_json,
    store,
    write,
    write_run,
)

from r2h_batch.runs import store as run_store
from r2h_batch.runs.rows import DETAIL_SCHEMA, LATER_COLUMNS, OUTCOME_NAMES, TRIAL_SCHEMA, pose_rows, score_rows
from r2h_batch.runs.store import RunError, load_run, open_run, shards_of
from r2h_batch.types import CRITERIA, Outcome
from r2h_batch.validate_tensors import as_numbers

ALL = ["details", "poses", "paths"]


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
    trials = make_trials(4, 4)
    predictions = make_predictions(trials)
    predictions.T_world_ee[2, 0, 0] = float("nan")
    predictions.T_obj_ee[3, 1, 1] = float("inf")
    run = open_run(tmp_path / "run", make_header(4, 4, stored=["poses"]))
    run.register("m", {})
    with run.write("m", *run.todo("m")) as writer:
        scores = make_scores(trials, np.array([0, 0, 6, 6, 0, 0, 0, 0]))  # 6: invalid_input
        writer.append(trials=score_rows(trials, scores, NAMES), poses=pose_rows(predictions))
    table = load_run(tmp_path / "run").poses("m")
    for name in ("T_obj_ee", "T_world_ee"):
        stored = np.array(table[name].combine_chunks().flatten(), np.float32).reshape(-1, 4, 4)
        assert stored.tobytes() == getattr(predictions, name).numpy().tobytes()


def test_saved_paths_hold_the_waypoints_times_and_goal_of_every_trial_with_a_path(tmp_path):
    _, scores = write(tmp_path / "run", stored=["paths"])
    rows = {r["trial_id"]: r for r in load_run(tmp_path / "run").paths("m").to_pylist()}
    lengths = scores.path_len.tolist()
    assert set(rows) == {i for i, n in enumerate(lengths) if n}
    for i, row in rows.items():
        assert row["q"] == scores.path[i, : lengths[i]].tolist()
        assert row["time_s"] == scores.path_time_s[i, : lengths[i]].tolist()
        assert row["q_goal"] == scores.q_goal[i].tolist()


@pytest.mark.parametrize("kind", ALL)
def test_what_was_not_asked_for_is_not_stored_and_asking_for_it_says_how_to_get_it(tmp_path, kind):
    write(tmp_path / "run", stored=[k for k in ALL if k != kind])
    with pytest.raises(RunError, match=f"--save-{kind}"):
        getattr(load_run(tmp_path / "run"), kind)("m")
    assert not (tmp_path / "run" / kind).exists()


def test_the_manifest_says_what_was_run_how_it_ended_and_where_it_is(tmp_path):
    write(tmp_path / "run", method="FC-Handover (oracle hand)", shard_trials=8)
    run = load_run(tmp_path / "run")
    for field in (*run_store.IDENTITY, "command", "hash", "shard_trials"):
        assert field in run.header
    entry = run.entry("FC-Handover (oracle hand)")
    assert entry["source"] == {"kind": "test"} and sorted(entry["receipts"]) == [0, 1]
    first, second = (entry["receipts"][i] for i in (0, 1))
    assert (first["first"], first["last"], second["last"]) == (0, 8, 12)
    assert sum(first["outcomes"]["S0"].values()) == 6 and sum(first["outcomes"]["S1"].values()) == 2
    path = tmp_path / "run" / first["files"]["trials"]["path"]
    assert path.parent == tmp_path / "run" / "trials" / "FC-Handover_oracle_hand"
    assert path.name == f"000000-{run_store.sha256_of(path)[:16]}.parquet"
    metadata = pq.read_schema(path).metadata
    assert metadata[b"r2h_batch.format"] == str(run_store.FORMAT).encode()
    assert metadata[b"r2h_batch.method"] == b"FC-Handover (oracle hand)"
    assert metadata[b"r2h_batch.run"].decode() == run.header["hash"]


def test_methods_whose_names_differ_only_in_odd_characters_get_their_own_files(tmp_path):
    for name in ("a/b", "a b", "A_b", "../../etc"):
        write(tmp_path / "run", method=name)
    run = load_run(tmp_path / "run")
    folders = [(run.folder / e["receipts"][0]["files"]["trials"]["path"]).parent.resolve() for e in run.entries]
    assert run.methods == ("a/b", "a b", "A_b", "../../etc")
    assert len({str(f).lower() for f in folders}) == 4
    assert all(f.parent == (run.folder / "trials").resolve() for f in folders)


def test_rows_can_come_in_chunks_and_shards_of_any_size_hold_the_same_rows(tmp_path):
    trials = make_trials(5, 5)
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
        trials = make_trials(6, 6)
        run = open_run(tmp_path / name, make_header(6, 6))
        store(run, "m", trials, make_scores(trials, outcome, t_plan_s=t_plan_s, t_exec_s=t_exec_s))
        digests[name] = load_run(tmp_path / name).digest("m")
    assert digests["a"] == digests["slower"]
    assert len(set(digests.values())) == 3


def test_a_write_that_fails_leaves_what_was_stored_and_no_trace_of_its_own(tmp_path):
    write(tmp_path / "run", method="first")
    trials = make_trials(6, 6)
    before = sorted(p for p in (tmp_path / "run").rglob("*") if p.is_file())
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("first", {"kind": "test"})
    run.slugs["second"] = "second"
    with pytest.raises(RuntimeError, match="power"), run.write("second", shards_of(run.header)[0]) as writer:
        writer.append(trials=score_rows(trials, make_scores(trials, OUTCOMES), NAMES))
        raise RuntimeError("power")
    assert load_run(tmp_path / "run").methods == ("first",)
    assert sorted(p for p in (tmp_path / "run").rglob("*") if p.is_file()) == before


def test_what_a_killed_sweep_left_of_a_shard_is_removed_by_the_next_one_and_is_no_parquet_file(tmp_path):
    write(tmp_path / "run")
    stale = run_store.temporary_name(tmp_path / "run" / "trials" / "m" / "000000")
    assert stale.suffix != ".parquet"
    stale.write_bytes(b"half a file")
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("m", {"kind": "test"})
    with run.claim("m", shards_of(run.header)[0]) as mine:
        assert mine and not stale.exists()


def test_totals_are_asserted_on_write(tmp_path):
    trials = make_trials(6, 5)
    scores = make_scores(trials, OUTCOMES[:11])
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("m", {})
    with pytest.raises(RunError, match="planned were"), run.write("m", *run.todo("m")) as writer:
        writer.append(trials=score_rows(trials, scores, NAMES))
    run = load_run(tmp_path / "run")
    assert run.methods == () and run.unfinished == ("m",) and not files_of(tmp_path / "run")


def test_totals_are_asserted_on_reading(tmp_path):
    write(tmp_path / "run")
    path = tmp_path / "run" / "manifest" / "m" / "000000.json"
    receipt = read_json(path)
    receipt["outcomes"]["S0"]["success"] += 1
    path.write_text(json.dumps(receipt))
    with pytest.raises(RunError, match=r"holds \{'S0': 7, 'S1': 6\} trials, planned were \{'S0': 6, 'S1': 6\}"):
        load_run(tmp_path / "run")


def test_a_column_that_may_not_be_empty_is_refused_when_it_is(tmp_path):
    trials = make_trials(6, 6)
    rows = score_rows(trials, make_scores(trials, OUTCOMES), NAMES)
    rows = rows.set_column(4, TRIAL_SCHEMA.field("outcome"), pa.nulls(12, TRIAL_SCHEMA.field("outcome").type))
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("m", {})
    with pytest.raises(ValueError, match="outcome"), run.write("m", *run.todo("m")) as writer:
        writer.append(trials=rows)


def test_a_run_from_before_a_column_was_stored_is_read_with_it_empty_and_keeps_its_digest(tmp_path, monkeypatch):
    write(tmp_path / "run")
    (path,) = (tmp_path / "run" / "trials" / "m").iterdir()
    pq.write_table(pq.read_table(path).drop_columns(list(LATER_COLUMNS)), path)
    digest = load_run(tmp_path / "run", verify=False).digest("m")
    with monkeypatch.context() as m:  # the version that stored it knew no more columns, and gave the same digest
        names = [n for n in TRIAL_SCHEMA.names if n not in LATER_COLUMNS]
        m.setattr(run_store, "TRIAL_SCHEMA", pa.schema([TRIAL_SCHEMA.field(n) for n in names]))
        assert load_run(tmp_path / "run", verify=False).digest("m") == digest
    table = load_run(tmp_path / "run", verify=False).trials("m")
    assert table.schema.equals(TRIAL_SCHEMA, check_metadata=False)
    assert all(table[name].null_count == 12 for name in LATER_COLUMNS) and table["plan_pair"].null_count < 12


def test_the_same_configuration_may_add_a_method_and_finds_the_stored_one(tmp_path):
    write(tmp_path / "run", method="a")
    run = open_run(tmp_path / "run", make_header(6, 6, command=["later"]))
    run.register("a", {"kind": "test"})
    run.register("b", {"kind": "test"})
    assert run.todo("a") == [] and len(run.todo("b")) == 1
    write(tmp_path / "run", method="b")
    assert load_run(tmp_path / "run").methods == ("a", "b")


def test_a_stored_method_from_another_source_is_refused(tmp_path):
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("a", {"kind": "predictions", "sha256": "1"})
    with pytest.raises(RunError, match="made with another sha256; choose"):
        run.register("a", {"kind": "predictions", "sha256": "2"})


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
    with pytest.raises(
        RunError,
        match=rf"another run, which differs in {next(iter(change))}( \(\w+\))?; choose another --out, or --force-new",
    ):
        open_run(tmp_path / "run", make_header(6, 6, **change))
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_another_machine_of_the_same_kind_may_share_a_folder_and_another_shard_size_may_not(tmp_path):
    write(tmp_path / "run")
    open_run(tmp_path / "run", make_header(6, 6, device={"kind": "cpu", "name": "cpu: another model"}))
    open_run(tmp_path / "run", make_header(6, 6, shard_trials=5), exact=False)
    with pytest.raises(RunError, match="shards of 100000 trials, asked were 5"):
        open_run(tmp_path / "run", make_header(6, 6, shard_trials=5))


def test_a_folder_with_other_things_in_it_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match=r"thesis\.tex"):
        open_run(tmp_path, make_header(1, 1))
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_where_the_folder_should_be_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(RunError, match="cannot be written"):
        open_run(tmp_path / "run", make_header(1, 1))


def test_an_empty_folder_is_taken(tmp_path):
    write(tmp_path)
    assert load_run(tmp_path).methods == ("m",)


def test_two_writers_of_one_shard_leave_the_rows_of_the_first_and_no_files_of_the_second(tmp_path):
    trials = make_trials(6, 6)
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


def test_a_claim_is_given_to_one_at_a_time_and_falls_with_its_process_though_a_child_of_that_lives(tmp_path):
    """The child: such as a server that a method forked."""
    with run_store.claim(tmp_path / "c") as first, run_store.claim(tmp_path / "c") as second:
        assert first and not second
    read, write = os.pipe()
    holder = os.fork()
    if not holder:
        with run_store.claim(tmp_path / "c"):
            if not os.fork():
                os.write(write, str(os.getpid()).encode())  # it runs: so it has closed what it inherited
                time.sleep(60)
                os._exit(0)
            time.sleep(60)
    child = int(os.read(read, 100))
    try:
        with run_store.claim(tmp_path / "c") as own:
            assert not own
        os.kill(holder, signal.SIGKILL)
        os.waitpid(holder, 0)
        os.kill(child, 0)  # it lives
        with run_store.claim(tmp_path / "c") as own:
            assert own
    finally:
        os.kill(child, signal.SIGKILL)


def test_a_method_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    run = write_run(tmp_path / "run", {"a": np.zeros(2, int), "b": np.zeros(2, int)}, 1, 1)
    with pytest.raises(RunError, match="it has a, b"):
        run.trials("c")


def test_other_tools_read_the_rows_without_this_package(tmp_path):
    write(tmp_path / "run", shard_trials=5)
    tables = [pq.ParquetFile(p).read() for p in files_of(tmp_path / "run")]
    table = pa.concat_tables(tables).unify_dictionaries()
    assert table.group_by("outcome").aggregate([("trial_id", "count")]).num_rows == len(set(OUTCOMES))
    assert json.loads((tmp_path / "run" / "run.json").read_text())["protocol"] == "made"


def test_equal_rows_give_equal_bytes(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / name)
    assert [p.name for p in files_of(tmp_path / "a")] == [p.name for p in files_of(tmp_path / "b")]


def test_a_writer_that_was_killed_between_a_files_two_names_leaves_nothing_behind(tmp_path):
    write(tmp_path / "run", shard_trials=5)
    receipt = next((tmp_path / "run" / "manifest").rglob("*.json"))
    finished = [receipt, tmp_path / "run" / "run.json", next((tmp_path / "run" / "methods").glob("*.json"))]
    twice = [run_store.temporary_name(path) for path in finished]
    for path, second in zip(finished, twice, strict=True):
        second.hardlink_to(path)
    half_done = run_store.temporary_name(receipt)  # a living writer's: it has no other name yet
    half_done.write_text("{")
    folder = open_run(tmp_path / "run", load_run(tmp_path / "run").header)
    assert folder.todo("m") == []
    assert not any(second.exists() for second in twice) and half_done.exists()
    assert all(path.exists() for path in finished)


def test_a_run_that_claims_a_million_shards_is_listed_at_once(tmp_path):
    run = open_run(tmp_path / "run", make_header(10**6, 0, shard_trials=1))
    for k in range(4):
        run.register(f"m{k}", {"kind": "test"})
    start = time.process_time()
    found = load_run(tmp_path / "run")
    assert found.methods == () and found.unfinished == ("m0", "m1", "m2", "m3")
    assert time.process_time() - start < 0.5
    assert len(found.missing("m0")) == 10**6


def test_numbers_and_lists_of_any_size_are_refused_by_name():
    deep = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(TypeError, match=r"^q is a list of lists in lists, too deep to read; it must be numbers"):
        as_numbers("q", deep, "numbers", "cpu")
