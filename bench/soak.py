"""A large number of trials, with and without kills: rows, memory and time stay what they were.

`python bench/soak.py --json bench/results/long.json`: many trials in one process, then a tenth again with kills, flipped bits
and full disks between.

The sweeps use the real evaluator with `--execute.sim none`. Rows are compared by the run's digest.
"""

import argparse
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from _report import ROOT, Report, resident_mib
from run import Bench

from r2h_batch.runs.store import load_run
from r2h_batch.sweep.results.command import verify

MEASURES = (
    "bench/soak.py",
    "kernels",
    "r2h_batch/judge",
    "r2h_batch/scene",
    "r2h_batch/base/launch",
    "r2h_batch/evaluate.py",
    "r2h_batch/launching.py",
    "r2h_batch/stages.py",
    "r2h_batch/work.py",
    "r2h_batch/runs",
    "r2h_batch/sweep",
)
FULL_BYTES = 4096
"""Bytes that a process may still write to a file when its disk is full: a limit on file sizes, as quotas are."""


def sweep(out: Path, given: argparse.Namespace, part: str = "1/1", *more: str) -> subprocess.Popen[str]:
    """The sweep command, or a part of it, as a process of its own, quiet."""
    line = [
        sys.executable,
        "-m",
        "r2h_batch.sweep",
        "--method",
        "random",
        "--execute.sim",
        "none",
        "--out",
        str(out),
    ]
    line += ["--trials", str(given.trials), "--shard-trials", str(given.shard_trials), "--format", "csv"]
    line += ["--shard", part, *more]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT)


def ended(process: subprocess.Popen[str]) -> None:
    """Waits for a sweep, which must end well."""
    text, _ = process.communicate()
    assert process.returncode == 0, text[-2000:]


def stored_shards(out: Path) -> list[Path]:
    return sorted((out / "shards").rglob("[!.]*.parquet"))


def digest(out: Path, shards: set[int]) -> str:
    """Digest of these shards of a run."""
    run = load_run(out)
    entry = run.entry("random")
    kept = {i: s for i, s in entry.shards.items() if i in shards}
    return replace(run, entries=(replace(entry, shards=kept),)).digest("random")


def compare(report: Report, name: str, plain: Path, fire: Path) -> None:
    """Whether the disturbed run has the rows of the other, as far as both came."""
    ran, disturbed = (set(load_run(p).entry("random").shards) for p in (plain, fire))
    shards = ran & disturbed
    report.add(f"{name}.shards_compared", len(shards))
    report.add(f"{name}.digest_equal", same := bool(shards) and digest(plain, shards) == digest(fire, shards))
    report.add(f"{name}.verified", verify(fire) == 0)
    assert same, "the disturbed run has other rows"


def long(given: argparse.Namespace, base: Path, report: Report, dice: random.Random) -> None:
    """One undisturbed process, then a tenth of its shards with a disturbance every so often."""
    plain, fire, start = base / "undisturbed", base / "disturbed", time.perf_counter()
    process, tenth = sweep(plain, given), 0
    while process.poll() is None:
        time.sleep(0.5)
        stored = len(stored_shards(plain)) * given.shard_trials
        if stored * 5 // given.trials > tenth and process.poll() is None:
            tenth = stored * 5 // given.trials
            report.add(f"long.memory_mib_at_{stored}", resident_mib(process.pid))
            report.add(f"long.trials_per_s_at_{stored}", stored / (time.perf_counter() - start))
        if time.perf_counter() - start > given.limit_s:
            process.send_signal(signal.SIGTERM)
            break
    text, _ = process.communicate()
    assert process.returncode in (0, 130), text[-2000:]
    ranges = [s.shard for s in load_run(plain).entry("random").shards.values()]
    report.add("long.trials", sum(s.last - s.first for s in ranges))
    report.add("long.seconds", time.perf_counter() - start)
    memory = [float(v) for name, v in report.values.items() if name.startswith("long.memory_mib_at_")]
    report.add("long.memory_mib_first", memory[0])
    report.add("long.memory_mib_most", max(memory))
    report.add("long.bytes", sum(p.stat().st_size for p in plain.rglob("*") if p.is_file()))
    report.write(given.json)
    for how, count in under_fire(fire, given, dice).items():
        report.add(f"long.{how.replace(' ', '_')}", count)
    compare(report, "long", plain, fire)


def under_fire(out: Path, given: argparse.Namespace, dice: random.Random) -> dict[str, int]:
    """Sweep a tenth of the shards with kills, flipped bits and full disks until they are complete."""
    done = dict.fromkeys(("kill", "kill and flip", "full disk"), 0)
    while True:
        process, before = sweep(out, given, "1/10"), len(stored_shards(out))
        end = time.monotonic() + dice.uniform(0, 2 * given.kill_every)
        # one shard at least is new, or a machine slower than the kills would never come to an end
        while process.poll() is None and (time.monotonic() < end or len(stored_shards(out)) <= before):
            time.sleep(0.1)
        if process.poll() is not None:
            ended(process)
            return done
        how = min(done, key=lambda h: done[h])
        done[how] += 1
        disturb(process, how, out, dice)


def disturb(process: subprocess.Popen[str], how: str, out: Path, dice: random.Random) -> None:
    """Kill it, kill it and flip a bit, or fill its disk and see that it ends with one line and exit code 1."""
    if how == "full disk":
        hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (FULL_BYTES, hard))
        text, _ = process.communicate()
        last = (text.strip().splitlines() or [""])[-1]
        full = process.returncode == 1 and last.startswith("sweep: ") and "Traceback" not in text
        assert full or process.returncode == 0, text[-2000:]  # 0: it had nothing left to write
        return
    process.send_signal(signal.SIGKILL)
    process.communicate()
    if how == "kill and flip":
        path = dice.choice(sorted((out / "shards").rglob("*.parquet")))
        data = bytearray(path.read_bytes())
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
        path.write_bytes(data)


def run(given: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    with tempfile.TemporaryDirectory() as temporary:
        long(given, given.folder or Path(temporary), report, random.Random(given.seed))


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "--trials": {"default": 20_000, "help": "of each of two splits"},
        "--shard-trials": {"default": 1000},
        "--kill-every": {"default": 3.0, "help": "seconds between kills, on average"},
        "--seed": {"default": 0, "help": "of the kills"},
        "--folder": {"type": Path, "help": "keep both run folders here"},
        "--limit-s": {"default": float("inf"), "help": "end the undisturbed run then"},
    },
    peer="an undisturbed run",
)

if __name__ == "__main__":
    BENCH.main()
