"""Large numbers of trials and calls, with and without kills: rows, memory and time stay what they were.

`python bench/soak.py array --json bench/results/job_array.json`: a job array, whose jobs are killed and start again.
`python bench/soak.py long --json bench/results/long.json`: many trials in one process, then a tenth again with kills,
flipped bits and full disks between.
`python bench/soak.py calls --json bench/results/calls.json`: 100,000 calls of one row of each kind, a process for each.

The sweeps use the real evaluator with `--execute.sim none`. Rows are compared by the run's digest.
"""

import argparse
import multiprocessing
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

from _report import ROOT, Report, resident_mib
from run import Bench

from r2h_batch import load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import random as random_method
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

COUNTS = (500, 10_000, 50_000, 100_000)
"""Calls after which memory is read."""

KINDS = ("pose", "all", "gradient")


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


def array(given: argparse.Namespace, base: Path, report: Report, dice: random.Random) -> None:
    """Sweep a folder as so many jobs at once, each killed and started again at random."""
    plain, fire, start = base / "undisturbed", base / "disturbed", time.perf_counter()
    ended(sweep(plain, given))
    report.add("soak.trials", 2 * given.trials)
    report.add("soak.undisturbed_s", time.perf_counter() - start)
    report.add("soak.parts", given.parts)
    parts = [f"{i + 1}/{given.parts}" for i in range(given.parts)]
    jobs, kills = {p: sweep(fire, given, p) for p in parts}, 0
    while jobs:
        time.sleep(dice.uniform(0, 2 * given.kill_every))
        part = dice.choice(sorted(jobs))
        if kills < given.kills and jobs[part].poll() is None:
            jobs[part].send_signal(signal.SIGKILL)
            kills += 1
        for part, job in list(jobs.items()):
            if job.poll() is None:
                continue
            text, _ = job.communicate()
            if job.returncode == -signal.SIGKILL:
                jobs[part] = sweep(fire, given, part)
                continue
            assert job.returncode == 0, text[-2000:]
            del jobs[part]
    report.add("soak.kills", kills)
    compare(report, "soak", plain, fire)


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


def calls(given: argparse.Namespace, report: Report) -> None:
    """Calls of one row; memory after so many."""
    for kind in given.kinds:
        # a process of its own: what one kind has taken would hide what the next one takes
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            for name, value in pool.submit(memory_of_calls, kind, given.calls).result().items():
                report.add(f"calls.{kind}.{name}", value)
        report.write(given.json)


def memory_of_calls(kind: str, calls: int) -> dict[str, float]:
    """Resident memory in MiB after each of `COUNTS` calls, and milliseconds a call."""
    judge = Evaluator(load_benchmark(), EvalConfig(execute=ExecConfig(sim="none")), threads=1)
    trials = load_benchmark().trials(50)
    answer = random_method.predict(trials, judge.scene, seed=0)
    moved = answer.T_world_ee.clone().requires_grad_(kind == "gradient")
    seen, start = {}, time.perf_counter()
    for i in range(calls):
        row = slice(i % len(trials), i % len(trials) + 1)
        scores = judge.score(answer.T_obj_ee[row], moved[row], trials[row], "all" if kind == "all" else "pose")
        if kind == "gradient":
            moved.grad = None
            scores.margin.nan_to_num(0.0, 0.0, 0.0).sum().backward()
        if i + 1 in COUNTS:
            seen[f"memory_mib_after_{i + 1}"] = resident_mib()
    return {**seen, "ms_per_call": 1e3 * (time.perf_counter() - start) / calls}


def run(given: argparse.Namespace, report: Report) -> None:
    """Measures all of it."""
    given.trials = given.trials or (50_000 if given.mode == "array" else 20_000)
    given.shard_trials = given.shard_trials or 1000
    if given.mode == "calls":
        calls(given, report)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            run = array if given.mode == "array" else long
            run(given, given.folder or Path(temporary), report, random.Random(given.seed))


BENCH = Bench(
    __doc__,
    run,
    MEASURES,
    {
        "mode": {"choices": ("array", "long", "calls")},
        "--trials": {"type": int, "help": "of each of two splits; array: 50,000, long: 20,000"},
        "--shard-trials": {"type": int, "help": "array: 1000, long: 1000"},
        "--kill-every": {"default": 3.0, "help": "seconds between kills, on average"},
        "--seed": {"default": 0, "help": "of the kills"},
        "--folder": {"type": Path, "help": "keep both run folders here"},
        "--parts": {"default": 4, "help": "array: jobs, all at once"},
        "--kills": {"default": 30, "help": "array: of jobs"},
        "--limit-s": {"type": float, "default": float("inf"), "help": "long: end the undisturbed run then"},
        "--kinds": {"nargs": "+", "choices": KINDS, "default": KINDS, "help": "calls: what they ask for"},
        "--calls": {"type": int, "default": COUNTS[-1], "help": "calls: of each kind"},
    },
    peer="an undisturbed run",
)

if __name__ == "__main__":
    BENCH.main()
