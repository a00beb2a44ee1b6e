"""Every rule-based method with every gate: docs/baselines.md.

`python bench/gates.py --json bench/results/gates.json` sweeps every method with every gate and keeps the rows in
bench/options/gates (r2h-v2, motion as planned). A row that names no gate is the method's row of Table I.
"""

import argparse

from _report import Report
from _rows import kept_rows, rates_of
from run import Bench

OWN = {"fc": "hand", "handover-va": "ik", "contact": "none", "intent": "none"}
"""Method -> the gate of its row in Table I."""
GATES = ("none", "ik", "hand")
TRIALS = 240
FLAGS = ("--benchmark", "r2h-v2", "--execute.sim", "none", "--no-poses")
MEASURES = (
    *("bench/gates.py", "kernels", "r2h_batch/judge", "r2h_batch/scene", "r2h_batch/methods"),
    *(
        "r2h_batch/trials",
        "r2h_batch/evaluate.py",
        "r2h_batch/launching.py",
        "r2h_batch/stages.py",
        "r2h_batch/work.py",
    ),
)


def answered(method: str, gate: str) -> str:
    """The sweep's word for a method with this gate; its own is not said."""
    return method if gate == OWN[method] else f"{method},gate={gate}"


def measure(options: argparse.Namespace, report: Report) -> None:
    """Sweeps, keeps the rows, and collects the figures."""
    trials = options.trials
    report.add("gates.trials", trials)
    words = [answered(m, gate) for m in OWN for gate in GATES]
    rates = rates_of(kept_rows("gates", words, "--trials", trials, *FLAGS), words)
    for method in OWN:
        for gate in GATES:
            for split, row in rates[answered(method, gate)].items():
                report.add(f"gates.{method.replace('-', '_')}.{gate}.{split.lower()}", row["sr"])


BENCH = Bench(
    __doc__,
    measure,
    MEASURES,
    {"--trials": {"default": TRIALS, "help": "of each split"}},
    peer="each method's own gate",
)

if __name__ == "__main__":
    BENCH.main()
