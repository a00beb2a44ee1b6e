"""A job array under fire: its jobs are killed and start again; the rows are those of one undisturbed process.

`python bench/soak.py --parts 4 --kills 30 --kill-every 3 --trials 50000 --shard-trials 1000 --json bench/results/job_array.json`:
the real evaluator, `--sim none`. At the end the digests of both folders must be equal.
"""

import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from _report import ROOT, Report, arguments

from r2h_batch.results.command import verify
from r2h_batch.runs.store import load_run


def sweep(out: Path, given: object, part: str = "1/1") -> subprocess.Popen[str]:
    """The sweep command, or a part of it, as a process of its own, quiet."""
    line = [sys.executable, "-m", "r2h_batch.sweep", "--method", "random", "--sim", "none", "--out", str(out)]
    line += ["--trials", str(given.trials), "--shard-trials", str(given.shard_trials), "--format", "csv"]  # type: ignore[attr-defined]
    line += ["--shard", part]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT)


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


def finish(report: Report, plain: Path, fire: Path) -> None:
    """Whether the disturbed run has the rows of the other."""
    same = load_run(plain).digest("random") == load_run(fire).digest("random")
    report.add("soak.digest_equal", same)
    report.add("soak.verified", verify(fire) == 0)
    assert same, "the disturbed run has other rows"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=50_000, help="of each of two splits")
    parser.add_argument("--shard-trials", type=int, default=1000)
    parser.add_argument("--kill-every", type=float, default=3.0, help="seconds between kills, on average")
    parser.add_argument("--seed", type=int, default=0, help="of the kills")
    parser.add_argument("--parts", type=int, default=4, help="jobs of the array, all at once")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--folder", type=Path, help="keep both run folders here")
    given = parser.parse_args()
    report, dice = Report(), random.Random(given.seed)
    with tempfile.TemporaryDirectory() as temporary:
        base = given.folder or Path(temporary)
        plain, fire = base / "undisturbed", base / "disturbed"
        start = time.perf_counter()
        process = sweep(plain, given)
        text, _ = process.communicate()
        assert process.returncode == 0, text[-2000:]
        report.add("soak.trials", 2 * given.trials)
        report.add("soak.undisturbed_s", time.perf_counter() - start)
        report.add("soak.parts", given.parts)
        report.add("soak.kills", job_array(fire, given, dice))
        finish(report, plain, fire)
    report.write(given.json)


if __name__ == "__main__":
    main()
