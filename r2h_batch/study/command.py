"""The command `study`: simulation against people."""

import sys
from pathlib import Path

from r2h_batch.command_line import Command, check_range

MOST_TRIALS = 10**9


def ratings(file: Path, /) -> int:
    """Your own ratings: a CSV with columns participant, method, dimension, rating (1 to 5).

    Args:
        file: one row for each rating. Participants who did not rate every method are left out and
            counted.
    """
    from r2h_batch.study.report import rating_report, read_ratings

    sys.stdout.write(rating_report(read_ratings(file)))
    return 0


def real(run: Path, file: Path, /, *, trials: int) -> int:
    """Your own robot against a run: a CSV with columns method, real_sr (percent: 85 or 85%),
    real_t_tot_s.

    Args:
        run: a run folder with the same methods.
        file: one row for each method, by the sweep's word (fc) or the table's name.
        trials: trials of each method on the robot.
    """
    from r2h_batch.study.report import real_report

    check_range("--trials", trials, 1, MOST_TRIALS)
    sys.stdout.write(real_report(run, file, trials))
    return 0


COMMANDS: dict[str, Command] = {"ratings": ratings, "real": real}
