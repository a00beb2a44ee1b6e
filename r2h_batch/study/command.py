"""The command `study`: simulation against people. Without arguments it shows the paper's own study."""

import sys
from pathlib import Path

from r2h_batch.command_line import Command
from r2h_batch.io.write import check_output_file, write_text

MOST_TRIALS = 10**9


def paper(*, box: Path | None = None, overwrite: bool = False) -> int:
    """The paper's sim-to-real table and ratings.

    Args:
        box: also write the box plots of the ratings to this .svg file.
        overwrite: replace a file that is there.
    """
    _check_box(box, overwrite)
    from r2h_batch.study import report
    from r2h_batch.study.stats import Summary

    sys.stdout.write(report.paper_report())
    if box is not None:
        counts = report.read_counts(report.paper_table("ratings"))
        write_text(box, report.box_plot({k: Summary.of_counts(c) for k, c in counts.items()}))
    return 0


def ratings(file: Path, /, *, box: Path | None = None, overwrite: bool = False) -> int:
    """Your own ratings: a CSV with columns participant, method, dimension, rating (1 to 5).

    Args:
        file: one row for each rating. Participants who did not rate every method are left out and
            counted.
        box: also write the box plots to this .svg file.
        overwrite: replace a file that is there.
    """
    _check_box(box, overwrite)
    from r2h_batch.study import report

    tables = report.read_ratings(file)
    sys.stdout.write(report.rating_report(tables))
    if box is not None:
        summaries = {k: v for d in tables for k, v in report.summaries(d, tables[d]).items()}
        write_text(box, report.box_plot(summaries))
    return 0


def _check_box(box: Path | None, overwrite: bool) -> None:
    if box is not None:
        check_output_file(box, overwrite=overwrite, flag="--box", endings=(".svg",))


def real(run: Path, file: Path, /, *, trials: int) -> int:
    """Your own robot against a run: a CSV with columns method, real_sr (percent: 85 or 85%),
    real_t_tot_s.

    Args:
        run: a run folder with the same methods.
        file: one row for each method, by the sweep's word (fc) or the table's name.
        trials: trials of each method on the robot.
    """
    from r2h_batch.study.report import real_report
    from r2h_batch.study.stats import StudyError

    if not 1 <= trials <= MOST_TRIALS:
        raise StudyError(f"--trials is {trials}; it must be 1 to {MOST_TRIALS}")
    sys.stdout.write(real_report(run, file, trials))
    return 0


COMMANDS: dict[str, Command] = {"paper": paper, "ratings": ratings, "real": real}
