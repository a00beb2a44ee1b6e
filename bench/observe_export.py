"""Speed and size of the data to learn from that `export views` writes: docs/observe.md.

`python bench/observe_export.py --json bench/results/observe_export.json` writes a shard as the page's command does. Process
seconds of one core; a small shard is written first, so that kernels are compiled, instances built and meshes of table and robot
drawn.
"""

import argparse
import tempfile
import time
from pathlib import Path

from _report import Report
from run import Bench

FAMILIES, PAIRS, FIRST = "* x 5 seed 5", 16, 8
"""As `export views` takes them; trials of the shard that is not measured."""
MEASURES = (
    *("bench/observe_export.py", "kernels/observe", "r2h_batch/observe", "r2h_batch/training", "r2h_batch/methods/oracle.py"),
    *("r2h_batch/evaluate.py", "r2h_batch/launching.py", "r2h_batch/stages.py", "r2h_batch/work.py", "r2h_batch/judge"),
)  # fmt: skip


def measure(options: argparse.Namespace, report: Report) -> None:
    """Writes a shard, reads it, and collects the figures."""
    trials = options.trials
    import h5py
    import torch

    from r2h_batch import load_benchmark
    from r2h_batch.observe.sees import Sees
    from r2h_batch.training.pairs import stream
    from r2h_batch.training.views import write_views

    torch.set_num_threads(1)
    sees = Sees.parse("cell-v1")
    report.add("observe_export.trials", trials)
    with tempfile.TemporaryDirectory() as folder:
        for count, name in ((FIRST, "first"), (trials, "measured")):
            pairs = stream(load_benchmark(), FAMILIES, pairs=PAIRS, trials=count, seed=0)
            begin = time.process_time()
            (path,) = write_views(pairs, sees, Path(folder) / name, shards=range(1), tell=print)
            seconds = time.process_time() - begin
        with h5py.File(path) as file:
            won = file["pairs/success"][:]
        report.add("observe_export.trials_per_s", trials / seconds)
        report.add("observe_export.kb", path.stat().st_size / trials / 1e3)
        report.add("observe_export.pairs", PAIRS)
        report.add("observe_export.pairs_won", float(won.mean()))


BENCH = Bench(__doc__, measure, MEASURES, {"--trials": {"default": 250, "help": "of the shard"}})

if __name__ == "__main__":
    BENCH.main()
