"""Sweep efficiency: trials/s of 2 Ray workers against twice those of one single-threaded worker, same trials, same digest.

Steady: trials over the seconds that workers spent on shards, as their receipts say. Wall: of the whole command, which
includes starting Python, Ray and two evaluators. Both figures mean little on a machine that others use: `load` says so.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from _report import ROOT, Report, arguments


def sweep(folder: Path, trials: int, *flags: str) -> tuple[float, float, str]:
    """Wall seconds, seconds spent on shards, and digest of a sweep of `random`."""
    from r2h_batch.runs.store import load_run

    line = [sys.executable, "-m", "r2h_batch.sweep", "--method", "random", "--trials", str(trials), "--threads", "1"]
    line += ["--shard-trials", str(trials // 4), "--out", str(folder), *flags]
    start = time.perf_counter()
    subprocess.run(line, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT)
    wall = time.perf_counter() - start
    run = load_run(folder)
    return wall, sum(r["seconds"] for r in run.entry("random")["receipts"].values()), run.digest("random")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trials", type=int, default=2000, help="of each split")
    given = parser.parse_args()
    report = Report()
    n = 2 * given.trials
    with tempfile.TemporaryDirectory() as temporary:
        one = sweep(Path(temporary) / "one", given.trials)
        two = sweep(Path(temporary) / "two", given.trials, "--engine", "ray", "--workers", "2")
    report.add("engines.trials", n)
    report.add("engines.one_worker_trials_per_s", n / one[1])
    report.add("engines.two_workers_trials_per_s", 2 * n / two[1])
    report.add("engines.efficiency_steady", one[1] / two[1])
    report.add("engines.one_worker_wall_s", one[0])
    report.add("engines.two_workers_wall_s", two[0])
    report.add("engines.efficiency_wall", one[0] / (2 * two[0]))
    report.add("engines.same_digest", one[2] == two[2])
    report.write(given.json)


if __name__ == "__main__":
    main()
