"""Sweeps of the fake bench as processes, to be killed: what they left is compared with an undisturbed run."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import fake_bench

import r2h_batch.report.table  # noqa: F401 (a fork would import it)
from r2h_batch.judge.plan import load_searches
from r2h_batch.runs.store import load_run
from r2h_batch.sweep import command as sweep
from r2h_batch.sweep import jobs
from r2h_batch.sweep.results.command import verify

SUPPORT = Path(__file__).parent
SWEEP = [sys.executable, str(SUPPORT / "fake_bench.py"), "--trials", "60", "--shard-trials", "10", "--chunk", "5"]
SLOW = "fake_bench:slow"
DEADLY = "fake_bench:deadly"


def environment(tmp_path, **more):
    path = os.pathsep.join([str(SUPPORT.parents[1]), str(SUPPORT)])
    extra = {"PYTHONPATH": path, "FAKE_LOG": str(tmp_path / "log"), "RAY_USAGE_STATS_ENABLED": "0"}
    extra["RAY_worker_niceness"] = "0"  # Ray's 15 starves workers where others work too
    return {**os.environ, **extra, "TERM": "dumb", **more}


class Fork:
    """The sweep command in a fork of this process: as good as a process of its own to be killed, and 4 CPU s cheaper."""

    def __init__(self, line, env, before):
        load_searches("cpu")  # once here, not in every fork
        self.args, self.said = line, [tempfile.TemporaryFile("w+") for _ in range(2)]  # noqa: SIM115 (read at the end)
        self.pid = os.fork()
        if self.pid:
            return
        code = 99
        try:
            for number, file in enumerate(self.said, 1):
                os.dup2(file.fileno(), number)
            sys.stdout, sys.stderr = (os.fdopen(n, "w", buffering=1) for n in (1, 2))
            sys.argv = line
            os.environ.update(env)
            jobs.set_up = fake_bench.set_up
            before()
            code = sweep.main(line[1:])
            sys.stdout.flush()
        finally:
            os._exit(code)

    def send_signal(self, number):
        os.kill(self.pid, number)

    def kill(self):
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout):
        end = time.monotonic() + timeout
        while not (ended := os.waitpid(self.pid, os.WNOHANG))[0]:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired(self.args, timeout)
            time.sleep(0.02)
        self.returncode = os.waitstatus_to_exitcode(ended[1])
        for file in self.said:
            file.seek(0)
        return [file.read() for file in self.said]


def start(tmp_path, out, method=SLOW, *flags, before=lambda: None, fork=False, **more):
    """A sweep of the fake bench; `before` is called in its process first. What starts Ray needs a process of its own."""
    methods = [method] if isinstance(method, str) else method
    line = [*SWEEP, "--benchmark", "r2h-v1", "--method", *methods, "--out", str(out), "--format", "csv", *flags]
    env = environment(tmp_path, **more)
    if fork or "--engine" not in flags:
        return Fork(line[1:], env, before)
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)


def finish(process, timeout=300):
    """Exit code, stdout and stderr; kills what hangs."""
    try:
        out, error = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, out, error


def wait_for(condition, what, timeout=180):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end, f"waited {timeout} s for {what}"
        time.sleep(0.02)


def stored_shards(out):
    return sorted((out / "shards").rglob("[!.]*.parquet")) if (out / "shards").exists() else []


def same_rows(out, undisturbed, method=SLOW):
    run = load_run(out)
    assert run.methods == (method,)
    assert run.trials(method)["trial_id"].to_pylist() == list(range(120))
    assert verify(out) == 0 and not list(out.rglob("*.tmp"))
    assert run.digest(method) == undisturbed[method]
