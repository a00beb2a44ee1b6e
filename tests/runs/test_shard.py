"""A shard is one file: what it holds, who stores it first, and what a writer that was killed leaves behind."""

import multiprocessing
import os
import resource
import shutil
import signal
import socket
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

from r2h_batch.__main__ import main
from r2h_batch.base.io.write import atomic_path
from r2h_batch.runs.files import GO_ON, RunError, replace_json, sha256_of, temporary_name, trouble_in
from r2h_batch.runs.header import shards_of
from r2h_batch.runs.shard import number_of, shard_folder, stored_files
from r2h_batch.runs.store import load_run
from r2h_batch.runs.verify import mark_for_rerun
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep.rows import detail_rows, score_rows


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


@pytest.mark.alone
def test_of_writers_at_the_same_moment_one_is_stored_and_nothing_of_the_others(tmp_path):
    write(tmp_path / "plain")
    digest = load_run(tmp_path / "plain").digest("m")
    with ProcessPoolExecutor(4, multiprocessing.get_context("fork")) as pool:
        for k in range(8):
            folder, start = tmp_path / str(k), time.time() + 0.3
            list(pool.map(race, [folder] * 4, range(4), [start] * 4))
            assert list(shard_folder(folder, "m").iterdir()) == files_of(folder) and len(files_of(folder)) == 1
            assert load_run(folder).digest("m") == digest  # whoever's they are, the rows are these


@pytest.mark.alone
@pytest.mark.parametrize("killed", ["before its name", "after its name"])
def test_a_writer_that_is_killed_has_stored_its_shard_or_nothing(tmp_path, monkeypatch, killed):
    trials, folder = made_trials(6, 6), tmp_path / "run"
    if not (child := os.fork()):

        def die(temporary, final, give=os.replace):
            if killed == "after its name":
                give(temporary, final)
            os._exit(1)  # no block ends, nothing is removed

        try:
            run = open_run(folder, make_header(6, 6))
            run.register("m", {"kind": "test"})
            (shard,) = run.todo("m")
            with run.claim("m", shard), run.write("m", shard) as writer:
                writer.append(trials=score_rows(trials, make_scores(trials, OUTCOMES), NAMES))
                monkeypatch.setattr("r2h_batch.runs.shard.os.replace", die)
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 1
    assert len(list((folder / ".claims").iterdir())) == len(list(shard_folder(folder, "m").iterdir())) == 1
    run, stored = open_run(folder, make_header(6, 6)), files_of(folder)
    run.register("m", {"kind": "test"})
    assert [s.index for s in run.todo("m")] == ([] if stored else [0]) and len(stored) == (killed == "after its name")
    for shard in run.todo("m"):
        with run.claim("m", shard) as own:
            assert own.died == [f"process {child} on {socket.gethostname()}"]
            store(run, "m", trials, make_scores(trials, OUTCOMES))
    assert list(shard_folder(folder, "m").iterdir()) == files_of(folder) and load_run(folder).methods == ("m",)
    assert not list((folder / ".claims").iterdir()) and files_of(folder) == (stored or files_of(folder))


def test_what_other_writers_left_when_they_were_killed_goes_with_the_next_sweep_once_it_is_an_hour_old(tmp_path):
    write(tmp_path / "run")
    run = tmp_path / "run"
    left = [temporary_name(run / "run.json"), temporary_name(run / "methods" / "m.json"), run / ".0123456789ab.tmp.md"]
    own = [run / ".mine.tmp", run / "methods" / ".notes"]
    for path in (*left, *own):
        path.write_text("half")
    assert mark_for_rerun(run, load_run(run).header) == [] and all(p.exists() for p in left)
    for path in (*left, *own):
        os.utime(path, (time.time() - 4000,) * 2)
    assert mark_for_rerun(run, load_run(run).header) == []
    assert not any(p.exists() for p in left) and all(p.exists() for p in own)


def test_what_a_writer_that_is_gone_has_left_is_named_by_verify_and_removed_at_once(tmp_path, capsys):
    write(tmp_path / "run")
    run = tmp_path / "run"
    if not (child := os.fork()):
        for place in (run / "run.json", run / "methods" / "m.json", shard_folder(run, "m") / "000001"):
            temporary_name(place).write_text("half")
        try:
            with atomic_path(run / "table.md") as temporary:
                temporary.write_text("half")
                os.kill(os.getpid(), signal.SIGKILL)
        finally:
            os._exit(1)
    os.waitpid(child, 0)
    mine, left = temporary_name(run / "run.json"), sorted(run.rglob(".*.tmp*"))
    mine.write_text("half")
    assert len(left) == 4 and main(["results", "verify", str(run)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sorted(lines[:4]) == sorted(f"{p}: half written by a process that is gone; removed" for p in left)
    assert mine.exists() and not any(p.exists() for p in left)


def test_a_full_disk_names_the_file_and_no_half_of_it_stays(tmp_path):
    folder, trials = tmp_path / "run", made_trials(6, 6)
    run = open_run(folder, make_header(6, 6))
    run.register("m", {"kind": "test"})
    most = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with pytest.raises(OSError, match="File too large") as error, run.write("m", *run.todo("m")) as writer:
            writer.append(trials=score_rows(trials, make_scores(trials, OUTCOMES), NAMES))
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, most[1]))
        named = trouble_in(folder, error.value)
        with pytest.raises(OSError, match="File too large") as error:
            replace_json(folder / "progress.json", {"text": "x" * 200})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
    assert named == f"run folder {folder}: shards/m/000000.parquet: File too large; {GO_ON}"
    assert error.value.filename == str(folder / "progress.json")
    assert not files_of(folder) and not list(folder.rglob("*.tmp"))


def test_a_shard_that_nobody_could_read_again_is_not_stored(tmp_path, monkeypatch):
    folder, trials = tmp_path / "run", made_trials(6, 6)
    run = open_run(folder, make_header(6, 6))
    run.register("m", {"kind": "test"})
    monkeypatch.setattr("r2h_batch.runs.shard.time.strftime", lambda *_: 7)  # as a method may leave it
    with pytest.raises(RunError, match=r"cannot be read again .*written.*; nothing was stored"):
        store(run, "m", trials, make_scores(trials, OUTCOMES))
    assert not files_of(folder) and not list(folder.rglob("*.tmp"))


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
