"""The command `study`: a real robot against a run, and tests of people's ratings."""

import sys
from pathlib import Path

from r2h_batch.base.command_line import Command, check_range

MOST_TRIALS = 10**9


def ratings(file: Path, /) -> int:
    """Test people's ratings: a CSV with columns participant, method, dimension, rating (1 to 5).

    Args:
        file: one row for each rating. The command leaves out and counts participants who did not
            rate every method.
    """
    from r2h_batch.sweep.study.report import rating_report, read_ratings

    sys.stdout.write(rating_report(read_ratings(file)))
    return 0


def real(run: Path, file: Path, /, *, trials: int | None = None) -> int:
    """Compare your own robot with a run, trial by trial: the table that `export real` wrote, filled in.

    Args:
        run: a run folder with the same methods and trials.
        file: a CSV with columns trial_id, method, outcome (success, failure), failed_criterion, seconds; rows without an outcome
            are left out. Or, without ids, a row for each method: method, real_sr (percent: 85 or 85%), real_t_tot_s.
        trials: only for a file without ids: trials of each method on the robot.
    """
    from r2h_batch.sweep.study.real import real_report

    if trials is not None:
        check_range("--trials", trials, 1, MOST_TRIALS)
    sys.stdout.write(real_report(run, file, trials))
    return 0


COMMANDS: dict[str, Command] = {"ratings": ratings, "real": real}
