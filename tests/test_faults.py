"""What kills a sweep: after the same command has run again, the digest of all rows is that of an undisturbed run.

The evaluator is a fake; processes, signals and files are real.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from r2h_batch.results import load_run, main

TESTS = Path(__file__).parent
SWEEP = [sys.executable, str(TESTS / "fake_bench.py"), "--trials", "60", "--shard-trials", "10", "--chunk", "5"]
SLOW = "fake_bench:slow"


def environment(tmp_path, **more):
    path = os.pathsep.join([str(TESTS.parent), str(TESTS)])
    extra = {"PYTHONPATH": path, "FAKE_LOG": str(tmp_path / "log"), "RAY_USAGE_STATS_ENABLED": "0"}
    return {**os.environ, **extra, "TERM": "dumb", **more}


def start(tmp_path, out, method=SLOW, *flags, **more):
    line = [*SWEEP, "--method", method, "--out", str(out), "--format", "csv", *flags]
    env = environment(tmp_path, **more)
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)


def finish(process, timeout=120):
    """Exit code, stdout and stderr; kills what hangs."""
    try:
        out, error = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, out, error


def wait_for(condition, what, timeout=90):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"waited {timeout} s for {what}"
        time.sleep(0.02)


def receipts(out):
    return sorted((out / "manifest").rglob("[!.]*.json")) if (out / "manifest").exists() else []


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Digest of all rows by method, from runs that nothing happened to."""
    tmp_path = tmp_path_factory.mktemp("undisturbed")
    digests = {}
    for method in (SLOW, "fake_bench:deadly"):
        out = tmp_path / method.partition(":")[2]
        code, _, error = finish(start(tmp_path, out, method, FAKE_DEADLY="-1", FAKE_SECONDS="0"))
        assert code == 0, error
        digests[method] = load_run(out).digest(method)
    return digests


def same_rows(out, undisturbed, method=SLOW):
    run = load_run(out)
    assert run.methods == (method,)
    assert run.trials(method)["trial_id"].to_pylist() == list(range(120))
    assert main("verify", out) == 0 and not list(out.rglob("*.tmp"))
    assert run.digest(method) == undisturbed[method]


def test_kill_9_of_the_process_loses_one_shard_at_most(tmp_path, undisturbed):
    out = tmp_path / "run"
    first = start(tmp_path, out)
    wait_for(lambda: len(receipts(out)) >= 3, "three shards")
    first.kill()
    finish(first)
    stored = receipts(out)
    assert 3 <= len(stored) < 12
    times = [p.stat().st_mtime_ns for p in stored]
    code, table, error = finish(start(tmp_path, out))
    assert code == 0 and table.startswith("split,"), error
    assert [p.stat().st_mtime_ns for p in stored] == times
    same_rows(out, undisturbed)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_signal_ends_with_130_and_the_same_command_goes_on(tmp_path, undisturbed, number):
    out = tmp_path / "run"
    first = start(tmp_path, out, SLOW, FAKE_SECONDS="0.2")
    wait_for(lambda: len(receipts(out)) >= 1, "a shard")
    first.send_signal(number)
    code, table, error = finish(first)
    assert code == 130 and table == "" and error.splitlines()[-1].startswith("sweep: interrupted"), error
    assert 1 <= len(receipts(out)) < 12 and not list(out.rglob("*.tmp"))
    code, _, error = finish(start(tmp_path, out, FAKE_SECONDS="0"))
    assert code == 0, error
    same_rows(out, undisturbed)


def test_two_sweeps_on_one_folder_share_the_work_and_one_takes_over_when_the_other_is_killed(tmp_path, undisturbed):
    out = tmp_path / "run"
    both = [start(tmp_path, out, FAKE_SECONDS="0.15") for _ in range(2)]
    log = tmp_path / "log"
    wait_for(lambda: log.exists() and len({line.split()[0] for line in log.read_text().splitlines()}) == 2, "both")
    wait_for(lambda: len(receipts(out)) >= 4, "four shards")
    both[0].kill()
    finish(both[0])
    code, table, error = finish(both[1])
    assert code == 0 and table.startswith("split,"), error
    same_rows(out, undisturbed)
    answered = [int(line.split()[1]) for line in log.read_text().splitlines()]
    assert len(answered) <= 24 + 2  # 24 chunks; the killed one had begun at most one shard of two


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
    code = (
        "import resource, runpy, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))\n"
        "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    )
    line = [sys.executable, "-c", code, *SWEEP[1:], "--method", SLOW, "--out", str(out)]
    done = subprocess.run(line, capture_output=True, text=True, env=environment(tmp_path), check=False, timeout=120)
    assert done.returncode == 1 and done.stdout == "", done.stderr
    assert done.stderr.splitlines()[-1].startswith("sweep: ") and "Traceback" not in done.stderr
    assert not list(out.rglob("*.tmp")) and not list(out.rglob("*.parquet")) and not receipts(out)
    code, _, error = finish(start(tmp_path, out, FAKE_SECONDS="0"))
    assert code == 0, error
    same_rows(out, undisturbed)


def test_three_parts_at_once_give_the_rows_of_one_process(tmp_path, undisturbed):
    out = tmp_path / "run"
    parts = [start(tmp_path, out, SLOW, "--shard", f"{i}/3") for i in (1, 2, 3)]
    results = [finish(p) for p in parts]
    assert [code for code, _, _ in results] == [0, 0, 0], results
    assert sum(table.startswith("split,") for _, table, _ in results) >= 1
    same_rows(out, undisturbed)
