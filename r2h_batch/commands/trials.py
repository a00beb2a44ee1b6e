"""The command `export trials`: what a method may read. Light until there is work."""

import json
from pathlib import Path
from typing import Literal

from r2h_batch.base.command_line import check_range, counted
from r2h_batch.base.errors import UsageError
from r2h_batch.base.io.write import check_output_folder
from r2h_batch.trials.choice import DEFAULT, BenchmarkChoice

MOST_TRIALS = 10**6


def trials(
    *,
    out: Path,
    trials: int = 500,
    splits: tuple[Literal["S0", "S1"], ...] = ("S0", "S1"),
    benchmark: BenchmarkChoice = DEFAULT,
    open_formats: bool = False,
) -> int:
    """Write a benchmark's trials and everything that a handover method may read to make predictions.

    Args:
        out: a new or empty folder.
        trials: trials of each split, 1 or more.
        splits: S0 free handover, S1 functional.
        benchmark: as in r2h-batch sweep; by default the default one.
        open_formats: also write OBJ and JSON into OUT/open, for methods in any language.
    """
    check_range("--trials", trials, 1, MOST_TRIALS, ": all are held in memory")
    if not splits:
        raise UsageError("--splits names no split; allowed are S0, S1")
    check_output_folder(out, overwrite=None)
    from r2h_batch.trials.edit import edited
    from r2h_batch.verdicts import SPLITS
    from r2h_batch.view.export.trial_files import write_trials

    chosen = [s for s in SPLITS if s in splits]
    found = edited(benchmark)
    digest = write_trials(
        out, chosen, trials, benchmark=found, open_formats=open_formats, flags=benchmark.flags()
    )
    written = json.loads((out / "manifest.json").read_text())[
        "trials"
    ]  # a trials file has its own number
    each = ", ".join(f"{n} of {split}" for split, n in written.items())
    print(
        f"{found.protocol}: {counted(sum(written.values()), 'trials')} ({each}) in {out}, digest {digest}"
    )
    return 0
