"""Sweeps that are killed: after the same command has run again, the digest of all rows is that of an undisturbed run.

The evaluator is a fake; processes, signals and files are real.
"""

import os
import random
import resource
import signal
import time
from collections import Counter
from pathlib import Path

import fake_bench
import pyarrow.parquet as pq
import pytest
from disturbed import DEADLY, SLOW, finish, same_rows, start, stored_shards, wait_for

from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs
from r2h_batch.sweep.results.command import verify

pytestmark = pytest.mark.alone


def test_kill_9_of_the_process_loses_one_shard_at_most(tmp_path, undisturbed):
    out = tmp_path / "run"
    first = start(tmp_path, out)
    wait_for(lambda: len(stored_shards(out)) >= 3, "three shards")
    first.kill()
    finish(first)
    stored = stored_shards(out)
    assert 3 <= len(stored) < 12
    times = [p.stat().st_mtime_ns for p in stored]
    code, table, error = finish(start(tmp_path, out))
    assert code == 0 and table.startswith("split,"), error
    assert [p.stat().st_mtime_ns for p in stored] == times
    same_rows(out, undisturbed)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_signal_ends_with_130_and_the_same_command_goes_on(tmp_path, undisturbed, number):
    out = tmp_path / "run"
    first = start(tmp_path, out, SLOW, FAKE_SECONDS="0.2")
    wait_for(lambda: len(stored_shards(out)) >= 1, "a shard")
    first.send_signal(number)
    code, table, error = finish(first)
    assert code == 130 and table == "" and error.splitlines()[-1].startswith("sweep: interrupted"), error
    assert 1 <= len(stored_shards(out)) < 12 and not list(out.rglob("*.tmp"))
    code, _, error = finish(start(tmp_path, out, FAKE_SECONDS="0"))
    assert code == 0, error
    same_rows(out, undisturbed)


def test_a_read_only_folder_is_one_line_with_what_to_do(tmp_path):
    out = Path("/sys/r2h_batch_run")  # nobody may make folders there, root neither
    if os.geteuid() != 0:
        out = tmp_path / "run"
        out.mkdir(mode=0o500)
    code, table, error = finish(start(tmp_path, out))
    assert code == 2 and table == "" and "cannot be written" in error and "choose another --out" in error
    assert "Traceback" not in error


def test_a_full_disk_is_one_line_and_the_sweep_goes_on_after_freeing(tmp_path, undisturbed):
    """A file size limit is what a quota looks like: the write fails with EFBIG instead of ENOSPC."""
    out = tmp_path / "run"

    def small_files():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))

    code, table, error = finish(start(tmp_path, out, before=small_files))
    assert code == 1 and table == "", error
    assert error.splitlines()[-1].startswith("sweep: ") and "Traceback" not in error
    assert not list(out.rglob("*.tmp")) and not list(out.rglob("*.parquet")) and not stored_shards(out)
    code, _, error = finish(start(tmp_path, out, FAKE_SECONDS="0"))
    assert code == 0, error
    same_rows(out, undisturbed)


def test_parts_at_once_of_which_some_are_killed_and_started_again_give_the_rows_of_one_process(tmp_path, undisturbed):
    """An array of jobs, of which a queue starts two again, and a sweep of all shards beside it."""
    out = tmp_path / "run"
    parts = [start(tmp_path, out, SLOW, "--shard", f"{i}/5") for i in (1, 2, 3, 4, 5)]
    whole = start(tmp_path, out)
    wait_for(lambda: len(stored_shards(out)) >= 2, "two shards")
    for i in (1, 3):
        parts[i].kill()
        finish(parts[i])
        parts[i] = start(tmp_path, out, SLOW, "--shard", f"{i + 1}/5")
    ends = [finish(p) for p in [*parts, whole]]
    assert [code for code, _, _ in ends] == [0] * 6, ends
    assert sum(table.startswith("split,") for _, table, _ in ends) >= 1
    same_rows(out, undisturbed)


@pytest.mark.slow
def test_forty_kills_of_sweeps_in_one_folder_and_full_disks_lose_nothing_judge_nothing_twice_and_leave_nothing(
    tmp_path,
):
    """Jobs of an array, each index twice, beside two sweeps of everything. Each is killed at a random moment and starts
    again, some on a full disk."""
    dice, out, many, log = random.Random(0), tmp_path / "run", ("--quiet", "--trials", "300"), tmp_path / "log"
    code, _, error = finish(start(tmp_path, tmp_path / "plain", SLOW, *many, FAKE_SECONDS="0"))
    assert code == 0, error
    log.write_text("")

    def full_disk():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))

    def job(part, before=lambda: None):
        return part, start(tmp_path, out, SLOW, *many, *part, before=before, FAKE_SECONDS="0.4")

    def runs(process):
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    jobs_now = [job(part) for part in (*[("--shard", f"{i}/3") for i in (1, 1, 2, 2, 3, 3)], (), ())]
    killed, ended, left_out = 0, Counter(), 0
    while jobs_now:
        time.sleep(dice.uniform(0, 0.5))
        part, process = jobs_now.pop(dice.randrange(len(jobs_now)))
        if runs(process) and killed < 40:
            process.kill()
            finish(process)
            killed += 1
            jobs_now.append(job(part, full_disk if killed % 5 == 0 else lambda: None))
        elif runs(process):
            jobs_now.append((part, process))
        else:
            code, _, error = finish(process)
            assert code in (0, 1) and "Traceback" not in error, error
            ended[code] += 1
            left_out += "left out" in error
            if code or killed < 40:
                jobs_now.append(job(part))
    assert killed == 40 and ended[0] >= 8 and ended[1] >= 1, (
        ended
    )  # 1: a full disk, or a shard at which three were killed
    assert load_run(out).digest(SLOW) == load_run(tmp_path / "plain").digest(SLOW) and verify(out) == 0
    assert len(stored_shards(out)) == 60
    # two answers make a shard: who is killed or meets a full disk has taken those of one shard along, nobody else
    answers = len(log.read_text().splitlines())
    assert 120 <= answers <= 120 + 2 * (killed + ended[1]), (answers, ended)
    for path in out.rglob(".*.tmp*"):  # an hour later
        os.utime(path, (time.time() - 4000,) * 2)
    code, _, error = finish(job(())[1])
    assert code == 0, error
    shards = {f"shards/fake_bench_slow/{p.name}" for p in stored_shards(out)}
    named = {"run.json", "methods/fake_bench_slow.json", "table.md", "results.json", "README.md"}
    parts = {f"{name}{i}.{end}" for name, end in (("progress", "json"), ("log", "txt")) for i in ("", "-1", "-2", "-3")}
    there = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
    assert shards | named <= there <= shards | named | parts, there
    print(
        f"{killed} kills, {ended[1]} ends on a full disk or without a shard ({left_out}), {answers} answers for 120 chunks"
    )


def test_a_shard_that_always_kills_the_sweep_comes_last_is_left_out_named_and_tried_again(tmp_path, undisturbed):
    out = tmp_path / "run"

    def once_more(deadly="47"):
        code, table, error = finish(start(tmp_path, out, DEADLY, FAKE_DEADLY=deadly))
        return code, table + error

    for deaths, stored in ((1, 4), (2, 11), (3, 11)):  # the second try stores all others before it dies again
        code, said = once_more()
        assert code == -signal.SIGKILL and len(stored_shards(out)) == stored, said
        assert (tmp_path / "log").read_text() == "x" * deaths
    mark = out / ".claims" / "fake_bench_deadly-000004"
    died = mark.read_text().splitlines()
    assert len(died) == 3 and list(mark.parent.iterdir()) == [mark]
    code, table, error = finish(start(tmp_path, out, DEADLY, "--quiet", FAKE_DEADLY="47"))
    words = (
        f"{DEADLY}: left out after three tries: shards 4 (the last: {died[-1]} died); the same command tries them again"
    )
    assert code == 1 and words in error and table == "", error  # --quiet does not leave an exit code unexplained
    assert (tmp_path / "log").read_text() == "xxx"
    assert [s.index for s in load_run(out).missing(DEADLY)] == [4]
    for _ in range(3):
        assert once_more()[0] == -signal.SIGKILL  # three tries more
    assert once_more()[0] == 1 and (tmp_path / "log").read_text() == "x" * 6
    code, said = once_more("-1")
    assert code == 0 and "split," in said, said
    assert not list((out / ".claims").iterdir())
    same_rows(out, undisturbed, DEADLY)


def test_a_sweep_that_is_stopped_or_meets_a_full_disk_leaves_no_mark_of_a_death(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(jobs, "set_up", fake_bench.set_up)
    monkeypatch.setattr(pq, "write_table", lambda *a, **k: (_ for _ in ()).throw(OSError(28, "No space left")))
    line = ["--benchmark", "r2h-v1", "--method", "fake_bench:best", "--trials", "6", "--out", str(tmp_path / "run")]
    for _ in range(4):
        assert sweep.main(line) == 1
    mark = tmp_path / "run" / ".claims" / "fake_bench_best-000000"
    assert not mark.exists()
    monkeypatch.undo()
    monkeypatch.setattr(jobs, "set_up", fake_bench.set_up)
    mark.symlink_to(tmp_path / "elsewhere")
    assert sweep.main(line) == 1
    mark.unlink()
    os.mkfifo(mark)
    capsys.readouterr()
    assert sweep.main(line) == 1
    assert f"{mark} is a pipe, where the run has a file of its own; move it away" in capsys.readouterr().err
    assert not (tmp_path / "elsewhere").exists() and not stored_shards(tmp_path / "run")


@pytest.mark.parametrize("place", ["run.json", "shards", ".claims/fake_bench_best-000000"])
@pytest.mark.parametrize("kind", ["folder", "pipe"])
def test_what_stands_in_the_place_of_a_runs_own_file_is_named_with_the_run_folder_and_what_to_do(
    place, kind, tmp_path, monkeypatch, capsys
):
    """A line before that was of an inner file: `.progress.json.198102dc09de.tmp: Is a directory`."""
    monkeypatch.setattr(jobs, "set_up", fake_bench.set_up)
    out = tmp_path / "run"
    name = "fake_bench:best"
    line = ["--benchmark", "r2h-v1", "--method", name, "--trials", "6", "--out", str(out)]
    assert sweep.main(line) == 0 and sweep.main([*line[:-1], str(tmp_path / "other")]) == 0
    for path in out.rglob("*"):  # nothing is scored yet, and somebody put something there
        if path.is_file() and path.name != "run.json":
            path.unlink()
    wrong = out / place
    for path in sorted(wrong.rglob("*"), reverse=True) if wrong.is_dir() else ():
        path.rmdir()
    if wrong.exists():
        wrong.rmdir() if wrong.is_dir() else wrong.unlink()
    wrong.parent.mkdir(parents=True, exist_ok=True)
    wrong.mkdir() if kind == "folder" else os.mkfifo(wrong)
    capsys.readouterr()
    code = sweep.main(line)
    error = [x for x in capsys.readouterr().err.splitlines() if x.startswith("sweep: ")]
    mine = "folder" if place == "shards" else "file"
    if kind == mine:
        assert code == 0 and not error
        return
    assert code in (1, 2) and len(error) == 1, error
    assert f"{wrong} is a {kind}, where the run has a {mine} of its own; move it away and run the same" in error[0]
    wrong.rmdir() if kind == "folder" else wrong.unlink()
    if place != "run.json":
        assert sweep.main(line) == 0 and load_run(out).digest(name) == load_run(tmp_path / "other").digest(name)
