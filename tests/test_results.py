"""Run folders: what is written is read back, whole or not at all, and never mixed with another run."""

import json
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from made_runs import NAMES, make_header, make_predictions, make_scores, make_trials, read_json, write_run

from r2h_batch import results
from r2h_batch.results import RunError, load_run, open_run
from r2h_batch.rows import (
    OUTCOME_NAMES,
    PATH_SCHEMA,
    POSE_SCHEMA,
    TRIAL_SCHEMA,
    missing_rows,
    path_rows,
    pose_rows,
    score_rows,
)
from r2h_batch.types import CRITERIA, CollidingPair, Outcome, PlanReason

OUTCOMES = np.array([0, 1, 2, 3, 5, 6, 7, 0, 4, 5, 2, 0])


def write(folder, outcome=OUTCOMES, method="m", source=None, **changes):
    n = len(outcome) // 2
    trials = make_trials(n, len(outcome) - n)
    with open_run(folder, make_header(n, len(outcome) - n, **changes)) as run:
        scores = make_scores(trials, outcome)
        with run.write(method, source or {"kind": "test"}) as writer:
            writer.append(trials=score_rows(trials, scores, NAMES), poses=pose_rows(make_predictions(trials)))
            if changes.get("save_paths"):
                writer.append(paths=path_rows(scores))
    return trials, scores


def test_every_column_comes_back_as_it_was_scored(tmp_path):
    trials, scores = write(tmp_path / "run")
    table = load_run(tmp_path / "run").trials("m")
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
    for name in ("t_plan_s", "t_exec_s", "width_m", "opening_m", "grasp_shift_m", "witness_time_s"):
        assert table[name].to_pylist() == [None if np.isnan(v) else v for v in getattr(scores, name).tolist()]
    for row, q, point, length in zip(table.to_pylist(), scores.q_goal, scores.witness_point, scores.path_len):
        assert row["q_goal"] == (q.tolist() if length else None)
        assert row["witness_point_m"] == (point.tolist() if length else None)
        assert row["witness_plan_part"] == ("forearm" if length else None)
        assert row["witness_safe_part"] == ("left_pad" if length else None)
        assert row["plan_reason"] == {"plan": "ik_in_collision"}.get(
            row["outcome"], "not_evaluated" if row["outcome"].startswith("invalid") else "ok"
        )
        assert row["plan_pair"] == ("object_hand" if row["outcome"] == "plan" else None)
    assert table["borderline"].to_pylist() == scores.borderline.tolist()
    assert table["t_method_s"].null_count == len(table)


@pytest.mark.parametrize("n", [0, 1, 2, 33])
def test_rows_of_any_number_of_trials_have_the_schemas(n):
    trials = make_trials(n, 0)
    scores = make_scores(trials, np.arange(n) % 3)
    tables = (
        (score_rows(trials, scores, NAMES, torch.zeros(n)), TRIAL_SCHEMA),
        (missing_rows(trials, NAMES), TRIAL_SCHEMA),
        (pose_rows(make_predictions(trials)), POSE_SCHEMA),
        (path_rows(scores), PATH_SCHEMA),
    )
    for table, schema in tables:
        table.validate(full=True)
        assert table.schema.equals(schema)
    assert [t.num_rows for t, _ in tables[:3]] == [n, n, n]


def test_poses_come_back_bit_for_bit_even_when_they_are_not_numbers(tmp_path):
    trials = make_trials(4, 4)
    predictions = make_predictions(trials)
    predictions.T_world_ee[2, 0, 0] = float("nan")
    predictions.T_obj_ee[3, 1, 1] = float("inf")
    with open_run(tmp_path / "run", make_header(4, 4)) as run, run.write("m", {}) as writer:
        scores = make_scores(trials, np.zeros(8, int))
        writer.append(trials=score_rows(trials, scores, NAMES), poses=pose_rows(predictions))
    table = load_run(tmp_path / "run").poses("m")
    for name in ("T_obj_ee", "T_world_ee"):
        stored = np.array(table[name].combine_chunks().flatten(), np.float32).reshape(-1, 4, 4)
        assert stored.tobytes() == getattr(predictions, name).numpy().tobytes()


def test_saved_paths_hold_the_waypoints_times_and_goal_of_every_trial_with_a_path(tmp_path):
    _, scores = write(tmp_path / "run", save_paths=True)
    rows = {r["trial_id"]: r for r in load_run(tmp_path / "run").paths("m").to_pylist()}
    lengths = scores.path_len.tolist()
    assert set(rows) == {i for i, n in enumerate(lengths) if n}
    for i, row in rows.items():
        assert row["q"] == scores.path[i, : lengths[i]].tolist()
        assert row["time_s"] == scores.path_time_s[i, : lengths[i]].tolist()
        assert row["q_goal"] == scores.q_goal[i].tolist()


def test_without_save_paths_asking_for_them_says_how_to_get_them(tmp_path):
    write(tmp_path / "run")
    with pytest.raises(RunError, match="--save-paths"):
        load_run(tmp_path / "run").paths("m")


def test_a_missing_trial_is_a_row_with_its_names_and_nothing_else():
    trials = make_trials(2, 1)
    for row in missing_rows(trials, NAMES).to_pylist():
        assert row["outcome"] == "missing" and row["object"] and row["split"] and row["side"]
        known = ("trial_id", "object", "split", "hand_index", "side", "outcome")
        assert all(v is None for k, v in row.items() if k not in known)


def test_scores_in_another_order_than_their_trials_are_refused():
    trials = make_trials(3, 0)
    scores = make_scores(trials, np.zeros(3, int))
    with pytest.raises(ValueError, match="same order"):
        score_rows(trials[torch.tensor([1, 0, 2])], scores, NAMES)


def test_run_json_says_what_was_run_and_how_it_ended(tmp_path):
    write(tmp_path / "run", method="FC-Handover (oracle hand)")
    header = read_json(tmp_path / "run" / "run.json")
    for field in (*results.IDENTITY, "command", "methods"):
        assert field in header
    (entry,) = header["methods"]
    assert entry["name"] == "FC-Handover (oracle hand)" and entry["rows"] == 12
    assert sum(entry["outcomes"]["S0"].values()) == sum(entry["outcomes"]["S1"].values()) == 6
    assert entry["files"]["trials"]["path"] == "trials/FC-Handover_oracle_hand.parquet"
    metadata = pq.read_schema(tmp_path / "run" / entry["files"]["trials"]["path"]).metadata
    assert metadata[b"r2h_batch.format"] == str(results.FORMAT).encode()
    assert metadata[b"r2h_batch.method"] == b"FC-Handover (oracle hand)"


def test_methods_whose_names_differ_only_in_odd_characters_get_their_own_files(tmp_path):
    for name in ("a/b", "a b", "A_b", "../../etc"):
        write(tmp_path / "run", method=name)
    run = load_run(tmp_path / "run")
    paths = [m["files"]["trials"]["path"] for m in run.header["methods"]]
    assert run.methods == ("a/b", "a b", "A_b", "../../etc")
    assert len({p.lower() for p in paths}) == 4
    assert all((run.folder / p).resolve().parent == (run.folder / "trials").resolve() for p in paths)


def test_rows_can_come_in_chunks(tmp_path):
    trials = make_trials(5, 5)
    scores = make_scores(trials, np.zeros(10, int))
    with open_run(tmp_path / "run", make_header(5, 5)) as run, run.write("m", {}) as writer:
        for rows in (slice(0, 1), slice(1, 7), slice(7, 10)):
            part = trials[rows]
            poses = pose_rows(make_predictions(part))
            writer.append(trials=score_rows(part, scores[rows], NAMES), poses=poses)
    assert load_run(tmp_path / "run").trials("m").equals(score_rows(trials, scores, NAMES))


def test_a_write_that_fails_leaves_the_other_methods_and_no_trace_of_its_own(tmp_path):
    write(tmp_path / "run", method="first")
    trials = make_trials(6, 6)
    with (
        pytest.raises(RuntimeError, match="power"),
        open_run(tmp_path / "run", make_header(6, 6)) as run,
        run.write("second", {}) as writer,
    ):
        writer.append(trials=score_rows(trials, make_scores(trials, OUTCOMES), NAMES))
        raise RuntimeError("power")
    assert load_run(tmp_path / "run").methods == ("first",)
    files = sorted(str(p.relative_to(tmp_path / "run")) for p in (tmp_path / "run").rglob("*") if p.is_file())
    assert files == [".lock", "poses/first.parquet", "run.json", "trials/first.parquet"]


def test_temporary_files_of_a_killed_sweep_are_not_parquet_and_are_cleaned(tmp_path):
    write(tmp_path / "run")
    trials = make_trials(6, 6)
    with open_run(tmp_path / "run", make_header(6, 6)) as run, run.write("n", {}) as writer:
        during = [p for p in (tmp_path / "run" / "trials").iterdir() if p.name != "m.parquet"]
        assert during and not any(p.suffix == ".parquet" for p in during)
        writer.append(trials=score_rows(trials, make_scores(trials, OUTCOMES), NAMES))
        writer.append(poses=pose_rows(make_predictions(trials)))
    stale = tmp_path / "run" / "trials" / ".x.parquet.0123.tmp"
    stale.write_bytes(b"half a file")
    with open_run(tmp_path / "run", make_header(6, 6)):
        assert not stale.exists()


def test_totals_are_asserted_on_write(tmp_path):
    trials = make_trials(6, 5)
    scores = make_scores(trials, OUTCOMES[:11])
    with (
        pytest.raises(RunError, match="planned were"),
        open_run(tmp_path / "run", make_header(6, 6)) as run,
        run.write("m", {}) as writer,
    ):
        writer.append(trials=score_rows(trials, scores, NAMES), poses=pose_rows(make_predictions(trials)))
    assert load_run(tmp_path / "run").methods == ()


def test_a_column_that_may_not_be_empty_is_refused_when_it_is(tmp_path):
    trials = make_trials(6, 6)
    rows = score_rows(trials, make_scores(trials, OUTCOMES), NAMES)
    rows = rows.set_column(5, TRIAL_SCHEMA.field("outcome"), pa.nulls(12, TRIAL_SCHEMA.field("outcome").type))
    with (
        pytest.raises(ValueError, match="outcome"),
        open_run(tmp_path / "run", make_header(6, 6)) as run,
        run.write("m", {}) as writer,
    ):
        writer.append(trials=rows)


def test_the_same_configuration_may_add_a_method_and_finds_the_stored_one(tmp_path):
    write(tmp_path / "run", method="a")
    with open_run(tmp_path / "run", make_header(6, 6, command=["later"])) as run:
        assert run.stored("a", {"kind": "test"})
        assert not run.stored("b", {"kind": "test"})
    write(tmp_path / "run", method="b")
    assert load_run(tmp_path / "run").methods == ("a", "b")


def test_a_stored_method_from_another_source_is_refused(tmp_path):
    write(tmp_path / "run", method="a", source={"kind": "predictions", "sha256": "1"})
    with (
        pytest.raises(RunError, match="another source"),
        open_run(tmp_path / "run", make_header(6, 6)) as run,
    ):
        run.stored("a", {"kind": "predictions", "sha256": "2"})


@pytest.mark.parametrize(
    "change",
    [
        {"protocol": "r2h-v1"},
        {"configuration": {"name": "paper"}},
        {"digests": {"trials": "f"}},
        {"seed": 1},
        {"save_paths": True},
        {"device": {"kind": "cuda", "name": "x"}},
        {"versions": {"r2h_batch": "0.2.0"}},
        {"trials": {"S0": 7, "S1": 6}},
    ],
    ids=lambda c: next(iter(c)),
)
def test_another_configuration_is_refused_naming_what_differs(tmp_path, change):
    write(tmp_path / "run")
    before = (tmp_path / "run" / "run.json").read_bytes()
    with (
        pytest.raises(RunError, match=f"another {next(iter(change))}; choose another --out"),
        open_run(tmp_path / "run", make_header(6, 6, **change)),
    ):
        pass
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_a_folder_with_other_things_in_it_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(RunError, match=r"thesis\.tex"), open_run(tmp_path, make_header(1, 1)):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_where_the_folder_should_be_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(RunError, match="cannot be written"), open_run(tmp_path / "run", make_header(1, 1)):
        pass


def test_an_empty_folder_is_taken(tmp_path):
    write(tmp_path)
    assert load_run(tmp_path).methods == ("m",)


def test_two_sweeps_on_one_folder_are_not_let_in_together(tmp_path):
    with (
        open_run(tmp_path / "run", make_header(6, 6)),
        pytest.raises(RunError, match="another sweep"),
        open_run(tmp_path / "run", make_header(6, 6)),
    ):
        pass
    with open_run(tmp_path / "run", make_header(6, 6)):
        pass


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove"])
def test_a_damaged_file_is_found_by_its_sha256_and_named(tmp_path, damage):
    write(tmp_path / "run")
    path = tmp_path / "run" / "trials" / "m.parquet"
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[len(data) // 2] ^= 1
        path.write_bytes(data)
    elif damage == "truncate":
        path.write_bytes(data[:-10])
    else:
        path.unlink()
    with pytest.raises(RunError, match=r"trials/m\.parquet"):
        load_run(tmp_path / "run")
    with pytest.raises(RunError, match=r"trials/m\.parquet"), open_run(tmp_path / "run", make_header(6, 6)):
        pass


@pytest.mark.parametrize("content", ["{", "[]", '{"format": 99}', "nothing"])
def test_a_run_json_that_is_damaged_or_of_another_format_is_refused(tmp_path, content):
    write(tmp_path / "run")
    (tmp_path / "run" / "run.json").write_text(content)
    with pytest.raises(RunError, match=r"run\.json"):
        load_run(tmp_path / "run")


def test_a_table_of_another_schema_is_refused_naming_the_column(tmp_path):
    write(tmp_path / "run")
    path = tmp_path / "run" / "trials" / "m.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["margin_safe_m"]), path)
    with pytest.raises(RunError, match="margin_safe_m"):
        load_run(tmp_path / "run", verify=False).trials("m")


def test_a_method_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    run = write_run(tmp_path / "run", {"a": np.zeros(2, int), "b": np.zeros(2, int)}, 1, 1)
    with pytest.raises(RunError, match="it has a, b"):
        run.trials("c")


def test_other_tools_read_the_rows_without_this_package(tmp_path):
    write(tmp_path / "run")
    table = pq.ParquetFile(tmp_path / "run" / "trials" / "m.parquet").read()
    assert table.group_by("outcome").aggregate([("trial_id", "count")]).num_rows == len(set(OUTCOMES))
    assert json.loads((tmp_path / "run" / "run.json").read_text())["protocol"] == "r2h-v0"


def test_equal_rows_give_equal_bytes(tmp_path):
    digests = set()
    for name in ("a", "b"):
        write(tmp_path / name)
        digests.add(read_json(tmp_path / name / "run.json")["methods"][0]["files"]["trials"]["sha256"])
    assert len(digests) == 1


def test_a_disk_that_fills_up_leaves_no_partial_file(tmp_path, monkeypatch):
    write(tmp_path / "run", method="first")

    def full(_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(results, "_sha256", full)
    with pytest.raises(OSError, match="No space"):
        write(tmp_path / "other")
    assert not list((tmp_path / "other").rglob("*.parquet")) and not list((tmp_path / "other").rglob("*.tmp"))
    monkeypatch.undo()
    write(tmp_path / "other")
    assert load_run(tmp_path / "other").methods == ("m",)


def test_outcome_names_follow_the_enum():
    assert OUTCOME_NAMES[Outcome.INVALID_SIM] == "invalid_sim" and OUTCOME_NAMES[-1] == "missing"


def test_the_documentation_names_every_column_and_every_word_in_it():
    text = (Path(__file__).parent.parent / "docs" / "run_folder.md").read_text(encoding="utf-8")
    columns = [f.name for schema in (TRIAL_SCHEMA, POSE_SCHEMA, PATH_SCHEMA) for f in schema]
    words = [*OUTCOME_NAMES, *(r.name.lower() for r in PlanReason), *(p.name.lower() for p in CollidingPair if p)]
    for name in (*columns, *words, *results.IDENTITY):
        assert f"`{name}`" in text, name
