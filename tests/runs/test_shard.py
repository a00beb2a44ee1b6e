"""A shard is one file: what it holds, who stores it first, and what a writer that was killed leaves behind."""

import multiprocessing
import os
import shutil
import time
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pyarrow.parquet as pq
import pytest
from made_runs import (
    NAMES,
    OUTCOMES,
    files_of,
    made_trials,
    make_header,
    make_scores,
    put_shard,
    receipt_of,
    store,
    write,
)

from r2h_batch.runs import shard as shards
from r2h_batch.runs.files import RunError, link_once, sha256_of
from r2h_batch.runs.header import shards_of
from r2h_batch.runs.rows import detail_rows, score_rows
from r2h_batch.runs.shard import finish_storing, number_of, shard_folder, stored_files
from r2h_batch.runs.store import load_run
from r2h_batch.runs.writing import open_run


def test_a_shard_is_one_file_that_any_reader_of_parquet_opens_under_the_digest_that_it_has(tmp_path):
    write(tmp_path / "run", stored=["poses", "details", "paths"])
    (path,) = files_of(tmp_path / "run")
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    assert path.name == f"000000-{sha256_of(path)[:16]}.parquet"
    frame = pq.read_table(path, partitioning=None).to_pandas()
    run = load_run(tmp_path / "run")
    assert frame["outcome"].tolist() == run.trials("m")["outcome"].to_pylist()
    answered = [i for i, pose in zip(frame["trial_id"], frame["poses"]) if pose is not None]
    assert answered == run.poses("m")["trial_id"].to_pylist()
    has_path = [i for i, path in zip(frame["trial_id"], frame["paths"]) if path is not None]
    assert has_path == run.paths("m")["trial_id"].to_pylist() and 0 < len(has_path) < 12
    receipt = receipt_of(path)
    assert (receipt["first"], receipt["last"], receipt["method"]) == (0, 12, "m")
    assert receipt["run"] == run.header["hash"] and receipt["outcomes"]["S0"]["success"] == 1


def test_a_page_whose_bits_flip_after_the_digest_was_compared_is_refused_when_it_is_read(tmp_path):
    write(tmp_path / "run")
    run = load_run(tmp_path / "run")
    (path,) = files_of(tmp_path / "run")
    with pq.ParquetFile(path) as file:
        group = file.metadata.row_group(0)
        names = [group.column(i).path_in_schema for i in range(group.num_columns)]
        chunk = group.column(names.index("margin_safe_m"))
    data = bytearray(path.read_bytes())
    data[chunk.data_page_offset + chunk.total_compressed_size - 3] ^= 1
    path.write_bytes(data)
    with pytest.raises(RunError, match=r"cannot be read.*[Cc]hecksum"):
        run.trials("m")


def race(folder, number, start):
    """One of several writers of one shard, each with times of its own."""
    trials = made_trials(6, 6)
    run = open_run(folder, make_header(6, 6))
    run.register("m", {"kind": "test"})
    (shard,) = shards_of(run.header)
    with run.write("m", shard) as writer:
        scores = make_scores(trials, OUTCOMES, t_plan_s=0.1 + 0.01 * number)
        writer.append(trials=score_rows(trials, scores, NAMES))
        while time.time() < start:
            time.sleep(0.0005)
    return [p.name for p in files_of(folder)]


def test_of_writers_at_the_same_moment_one_is_stored_and_nothing_of_the_others(tmp_path):
    with ProcessPoolExecutor(4, multiprocessing.get_context("fork")) as pool:
        for k in range(8):
            folder, start = tmp_path / str(k), time.time() + 0.3
            seen = list(pool.map(race, [folder] * 4, range(4), [start] * 4))
            assert len({tuple(names) for names in seen}) == 1 and len(seen[0]) == 1  # each saw the stored one, no other
            assert [p.name for p in shard_folder(folder, "m").iterdir()] == seen[0]
            load_run(folder)


@pytest.mark.parametrize("killed", ["before its name", "after its name"])
def test_a_writer_killed_between_the_two_names_of_its_file_has_stored_the_shard(tmp_path, monkeypatch, killed):
    trials = made_trials(6, 6)
    folder = tmp_path / "run"
    if not (child := os.fork()):
        names = []

        def die(temporary, final):
            names.append(final)
            if len(names) == 1 or killed == "after its name":
                link_once(temporary, final)
            if len(names) == 2:
                os._exit(1)  # no block ends, nothing is removed

        monkeypatch.setattr(shards, "link_once", die)
        try:
            store(open_run(folder, make_header(6, 6)), "m", trials, make_scores(trials, OUTCOMES))
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    left = sorted(p.name for p in shard_folder(folder, "m").iterdir())
    assert ".000000.turn" in left and len(left) == (2 if killed.startswith("before") else 3)
    run = open_run(folder, make_header(6, 6))
    run.register("m", {"kind": "test"})
    assert run.todo("m") == []
    assert [p.name for p in shard_folder(folder, "m").iterdir()] == [files_of(folder)[0].name]
    assert load_run(folder).methods == ("m",)


def test_a_later_writer_ends_the_turn_of_one_that_was_killed_and_its_own_rows_are_not_stored(tmp_path):
    trials = made_trials(6, 6)
    write(tmp_path / "first")
    (first,) = files_of(tmp_path / "first")
    run = open_run(tmp_path / "run", make_header(6, 6))
    run.register("m", {"kind": "test"})
    (shard,) = run.todo("m")
    place = shard_folder(tmp_path / "run", "m")
    place.mkdir(parents=True)
    (place / ".000000.turn").write_bytes(first.read_bytes())
    with run.write("m", shard) as writer:
        writer.append(trials=score_rows(trials, make_scores(trials, OUTCOMES, t_plan_s=0.9), NAMES))
    assert [p.name for p in place.iterdir()] == [first.name]
    assert np.nanmean(load_run(tmp_path / "run").trials("m")["t_plan_s"].to_numpy()) < 0.2
    assert finish_storing(place, shard) == place / first.name


def test_rows_of_trials_that_a_shard_does_not_have_are_refused(tmp_path):
    run = open_run(tmp_path / "run", make_header(6, 6, stored=["details"]))
    run.register("m", {"kind": "test"})
    trials = made_trials(6, 6)
    scores = make_scores(trials, OUTCOMES)
    other = made_trials(6, 7)[1:]
    other_scores = make_scores(made_trials(6, 7), np.append(OUTCOMES, 0))[1:]
    with pytest.raises(RunError, match="nothing was stored"), run.write("m", *run.todo("m")) as writer:
        writer.append(trials=score_rows(trials, scores, NAMES), details=detail_rows(other, other_scores, NAMES))
    assert not files_of(tmp_path / "run")


def test_a_shard_of_another_method_of_the_run_is_refused_under_this_ones_name(tmp_path):
    folder, trials = tmp_path / "run", made_trials(6, 6)
    run = open_run(folder, make_header(6, 6))
    for name in ("good", "poor"):
        store(run, name, trials, make_scores(trials, OUTCOMES))
    good, poor = (files_of(folder, name) for name in ("good", "poor"))
    poor[0].unlink()
    shutil.copy(good[0], poor[0].parent)
    with pytest.raises(RunError, match="foreign, its method is 'good' and not 'poor'"):
        load_run(folder)


def test_of_two_files_of_one_shard_the_one_with_the_smallest_name_counts(tmp_path):
    """Whoever stores a shard second finds the first; two names are left only by a file system that lost one for a while."""
    write(tmp_path / "run")
    (first,) = files_of(tmp_path / "run")
    table = pq.read_table(first, partitioning=None)
    second = put_shard(first, table.set_column(table.column_names.index("t_plan_s"), "t_plan_s", table["t_exec_s"]))
    assert second.name != first.name and number_of(second) == number_of(first) == 0
    header = load_run(tmp_path / "run").header
    low, high = sorted((first, second))
    assert stored_files(header, tmp_path / "run", "m") == {0: low} and high.exists()
