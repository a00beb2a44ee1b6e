"""Sweeps of the fake bench as processes, to be killed: what they left is compared with an undisturbed run."""

import os
import subprocess
import sys
import time
from pathlib import Path

from r2h_batch.results.command import verify
from r2h_batch.runs.store import load_run

SUPPORT = Path(__file__).parent
SWEEP = [sys.executable, str(SUPPORT / "fake_bench.py"), "--trials", "60", "--shard-trials", "10", "--chunk", "5"]
SLOW = "fake_bench:slow"
DEADLY = "fake_bench:deadly"


def environment(tmp_path, **more):
    path = os.pathsep.join([str(SUPPORT.parents[1]), str(SUPPORT)])
    extra = {"PYTHONPATH": path, "FAKE_LOG": str(tmp_path / "log"), "RAY_USAGE_STATS_ENABLED": "0"}
    return {**os.environ, **extra, "TERM": "dumb", **more}


def start(tmp_path, out, method=SLOW, *flags, **more):
    methods = [method] if isinstance(method, str) else method
    line = [*SWEEP, "--method", *methods, "--out", str(out), "--format", "csv", *flags]
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


def same_rows(out, undisturbed, method=SLOW):
    run = load_run(out)
    assert run.methods == (method,)
    assert run.trials(method)["trial_id"].to_pylist() == list(range(120))
    assert verify(out) == 0 and not list(out.rglob("*.tmp"))
    assert run.digest(method) == undisturbed[method]
