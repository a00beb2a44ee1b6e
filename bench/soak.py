"""A long sweep under fire: kills, flipped bits and full disks against an undisturbed run of the same trials.

`python bench/soak.py --trials 1000000 --kill-every 180 --json bench/results/soak.json`: 2 M trials twice. The real evaluator,
`--sim none`. At the end the digests of both folders must be equal, time per trial and memory flat from 10,000 trials on.
`--parts 4 --kills 30 --kill-every 3 --trials 50000 --shard-trials 1000`: a job array, whose jobs are killed and start again.
"""

import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median

from _report import ROOT, Report, arguments

from r2h_batch.results.command import verify
from r2h_batch.runs.store import load_run

SETTLED = 10_000
"""Trials after which nothing may grow any more."""

FULL_BYTES = 4096
"""What a process may still write to a file when its disk is full: a limit on file sizes, as quotas are."""


@dataclass
class Watched:
    """What was seen of the sweeps: (trials stored, MiB of the process), and what was done to them."""

    memory: list[tuple[int, float]] = field(default_factory=list)
    done: dict[str, int] = field(default_factory=dict)


def sweep(out: Path, given: object, part: str = "1/1") -> subprocess.Popen[str]:
    """The sweep command, or a part of it, as a process of its own, quiet."""
    line = [sys.executable, "-m", "r2h_batch.sweep", "--method", "random", "--sim", "none", "--out", str(out)]
    line += ["--trials", str(given.trials), "--shard-trials", str(given.shard_trials), "--format", "csv"]  # type: ignore[attr-defined]
    line += ["--shard", part]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT)


def receipts(out: Path) -> list[Path]:
    return sorted((out / "manifest").rglob("[!.]*.json")) if (out / "manifest").is_dir() else []


def memory_mib(pid: int) -> float | None:
    """Resident memory of a process; None where it is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGESIZE") / 2**20


def flip(out: Path, dice: random.Random) -> None:
    """One bit of one stored table."""
    if files := sorted((out / "trials").rglob("*.parquet")):
        path = dice.choice(files)
        data = bytearray(path.read_bytes())
        data[dice.randrange(len(data))] ^= 1 << dice.randrange(8)
        path.write_bytes(data)


def disturb(process: subprocess.Popen[str], how: str, out: Path, dice: random.Random) -> None:
    """Kill it, kill it and flip a bit, or fill its disk and see that it ends with one line and exit code 1."""
    if how == "full disk":
        hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)[1]
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (FULL_BYTES, hard))
        text, _ = process.communicate(timeout=3600)
        if process.returncode == 0:  # it had nothing left to write
            return
        last = text.strip().splitlines()[-1]
        assert process.returncode == 1 and last.startswith("sweep: ") and "Traceback" not in text, text[-2000:]
        return
    process.send_signal(signal.SIGKILL)
    process.communicate()
    if how == "kill and flip":
        flip(out, dice)


def under_fire(out: Path, given: object, dice: random.Random) -> Watched:
    """Sweep the folder until it is complete, with a disturbance every so often."""
    seen, kinds = Watched(), ["kill", "kill and flip", "full disk"]
    while True:
        process, before = sweep(out, given), len(receipts(out))
        end = time.monotonic() + given.kill_every * (0.5 + dice.random())  # type: ignore[attr-defined]
        # one shard at least is new, or a machine slower than the kills would never come to an end
        while process.poll() is None and (time.monotonic() < end or len(receipts(out)) <= before):
            time.sleep(0.5)
            if (mib := memory_mib(process.pid)) is not None:
                seen.memory.append((len(receipts(out)) * given.shard_trials, mib))  # type: ignore[attr-defined]
        if process.poll() is not None:
            text, _ = process.communicate()
            assert process.returncode == 0, text[-2000:]
            return seen
        how = kinds[sum(seen.done.values()) % len(kinds)]
        seen.done[how] = seen.done.get(how, 0) + 1
        print(f"{len(receipts(out))} shards: {how}", file=sys.stderr, flush=True)
        disturb(process, how, out, dice)


def job_array(out: Path, given: object, dice: random.Random) -> int:
    """Sweep the folder as so many jobs at once, each killed and started again at random; the number of kills."""
    parts = [f"{i + 1}/{given.parts}" for i in range(given.parts)]  # type: ignore[attr-defined]
    jobs, kills = {p: sweep(out, given, p) for p in parts}, 0
    while jobs:
        time.sleep(dice.uniform(0, 2 * given.kill_every))  # type: ignore[attr-defined]
        part = dice.choice(sorted(jobs))
        if kills < given.kills and jobs[part].poll() is None:  # type: ignore[attr-defined]
            jobs[part].send_signal(signal.SIGKILL)
            kills += 1
        for part, job in list(jobs.items()):
            if job.poll() is None:
                continue
            text, _ = job.communicate()
            if job.returncode == -signal.SIGKILL:
                jobs[part] = sweep(out, given, part)
                continue
            assert job.returncode == 0, text[-2000:]
            del jobs[part]
    return kills


def seconds_per_trial(out: Path) -> list[tuple[int, float]]:
    """(trials before it, seconds a trial) of every shard, from the receipts."""
    data = [json.loads(p.read_text()) for p in receipts(out)]
    return sorted((d["first"], d["seconds"] / (d["last"] - d["first"])) for d in data)


def drift(points: list[tuple[int, float]]) -> float:
    """Median of the last quarter over that of the first, of what was seen after `SETTLED`; 1 is flat."""
    values = [v for n, v in sorted(points) if n >= SETTLED] or [v for _, v in points]
    quarter = max(len(values) // 4, 1)
    return median(values[-quarter:]) / median(values[:quarter])


def finish(report: Report, plain: Path, fire: Path) -> None:
    """Whether the disturbed run has the rows of the other."""
    same = load_run(plain).digest("random") == load_run(fire).digest("random")
    report.add("soak.digest_equal", same)
    report.add("soak.verified", verify(fire) == 0)
    assert same, "the disturbed run has other rows"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=1_000_000, help="of each of two splits")
    parser.add_argument("--shard-trials", type=int, default=10_000)
    parser.add_argument("--kill-every", type=float, default=180.0, help="seconds between disturbances, on average")
    parser.add_argument("--seed", type=int, default=0, help="of the disturbances")
    parser.add_argument("--parts", type=int, default=1, help="instead: a job array of so many parts, all at once")
    parser.add_argument("--kills", type=int, default=30, help="of jobs of the array")
    parser.add_argument("--folder", type=Path, help="keep both run folders here")
    given = parser.parse_args()
    report, dice = Report(), random.Random(given.seed)
    with tempfile.TemporaryDirectory() as temporary:
        base = given.folder or Path(temporary)
        plain, fire = base / "undisturbed", base / "disturbed"
        start = time.perf_counter()
        process = sweep(plain, given)
        calm = Watched()
        while process.poll() is None:
            time.sleep(1)
            if (mib := memory_mib(process.pid)) is not None:
                calm.memory.append((len(receipts(plain)) * given.shard_trials, mib))
        text, _ = process.communicate()
        assert process.returncode == 0, text[-2000:]
        report.add("soak.trials", 2 * given.trials)
        report.add("soak.undisturbed_s", time.perf_counter() - start)
        start = time.perf_counter()
        if given.parts > 1:
            report.add("soak.parts", given.parts)
            report.add("soak.kills", job_array(fire, given, dice))
            finish(report, plain, fire)
            report.write(given.json)
            return
        seen = under_fire(fire, given, dice)
        report.add("soak.disturbed_s", time.perf_counter() - start)
        for how, count in seen.done.items():
            report.add(f"soak.{how.replace(' ', '_')}", count)
        times = seconds_per_trial(plain)
        report.add("soak.ms_per_trial", 1e3 * median(v for _, v in times))
        report.add("soak.time_drift", drift(times))
        report.add("soak.memory_mib", max(v for _, v in calm.memory))
        report.add("soak.memory_drift", drift(calm.memory))
        report.add("soak.memory_disturbed_mib", max(v for _, v in seen.memory))
        finish(report, plain, fire)
        report.write(given.json)


if __name__ == "__main__":
    main()
