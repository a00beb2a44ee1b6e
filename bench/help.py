"""What `--help` of every command costs: CPU seconds, and the ratio to starting Python. `python bench/help.py --json FILE`

The median of several runs of each, in turns with `python -c pass`: a busy machine slows both alike.
"""

import subprocess
import sys
from resource import RUSAGE_CHILDREN, getrusage
from statistics import median

from _report import ROOT, Report, arguments

from r2h_batch.__main__ import COMMANDS


def cpu_seconds(*line: str) -> float:
    """User and system time of one process and its children."""
    before = getrusage(RUSAGE_CHILDREN)
    subprocess.run([sys.executable, *line], check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
    after = getrusage(RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=int, default=7)
    given = parser.parse_args()
    lines: dict[str, tuple[str, ...]] = {"all": ("-m", "r2h_batch", "--help")}
    lines |= {name: ("-m", "r2h_batch", name, "--help") for name in COMMANDS}
    report = Report()
    for name, line in lines.items():
        cpu_seconds(*line)  # byte code and the disk's cache
        pairs = [(cpu_seconds("-c", "pass"), cpu_seconds(*line)) for _ in range(given.runs)]
        python, helped = median(p for p, _ in pairs), median(h for _, h in pairs)
        report.add(f"help.{name}_cpu_s", helped)
        report.add(f"help.{name}_ratio", helped / python)
    report.write(given.json)


if __name__ == "__main__":
    main()
