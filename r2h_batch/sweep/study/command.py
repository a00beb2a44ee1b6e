"""The command `study`: simulation against people."""

import sys
from pathlib import Path

from r2h_batch.base.command_line import Command, check_range
from r2h_batch.base.io.write import check_output_file, write_text
from r2h_batch.protocols.choice import DEFAULT, BenchmarkChoice

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
    """Compare your own robot with a run, trial by trial: the table that `real export` wrote, filled in.

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


def trials(
    run: Path,
    /,
    *,
    out: Path,
    method: tuple[str, ...] = (),
    overwrite: bool = False,
    benchmark: BenchmarkChoice = DEFAULT,
    device: str = "cpu",
) -> int:
    """Write the trials of a run with poses, receivers and measures as CSV, to show them to people.

    Args:
        run: a run folder with poses; its trials need a receiver's body (as of r2h-v2).
        out: the file to write, a line for each trial and method.
        method: only these methods, by the sweep's word (fc) or the table's name.
        overwrite: replace a file that is there.
        benchmark: where its files are now, if they are not where the sweep found them.
        device: cpu, cuda or cuda:N.
    """
    from r2h_batch.runs.store import load_run
    from r2h_batch.sweep.results.reception import tables_of_run
    from r2h_batch.sweep.study.perceived import measured_trials, trials_csv

    check_output_file(out, overwrite=overwrite)
    stored = load_run(run).only(method)
    write_text(out, trials_csv(tables_of_run(stored, benchmark, device, measured_trials)))
    print(out)
    return 0


def rated(
    ratings: Path, /, *, trials: Path, out: Path | None = None, overwrite: bool = False
) -> int:
    """Print people's ratings of single trials beside the measures of these trials.

    Args:
        ratings: a CSV with columns participant, method, trial_id, dimension, rating (1 to 5); methods
            as in --trials.
        trials: what `study trials` wrote.
        out: a CSV to write, a line for each rating with the measures, for a mixed model.
        overwrite: replace a file that is there.
    """
    from r2h_batch.sweep.study.perceived import rated as joined

    if out is not None:
        check_output_file(out, overwrite=overwrite)
    text, rows = joined(ratings, trials)
    sys.stdout.write(text)
    if out is not None:
        write_text(out, rows)
        print(out)
    return 0


def comfort(run: Path, file: Path, /) -> int:
    """Compare people's comfort with objects that they were handed with a run's measures of these objects.

    Args:
        run: a run folder with the rated objects.
        file: comfort.csv of `import objects --from hoh`: object, capture, handover, giver, receiver.
    """
    from r2h_batch.sweep.study.comfort import comfort_report

    sys.stdout.write(comfort_report(run, file))
    return 0


COMMANDS: dict[str, Command] = {
    "ratings": ratings,
    "real": real,
    "trials": trials,
    "rated": rated,
    "comfort": comfort,
}
