"""The command `study`: simulation against people. Without arguments it shows the paper's own study."""

import sys
from collections.abc import Sequence
from pathlib import Path

from r2h_batch.command_line import Command, call, check_seed, failed, refuse
from r2h_batch.io.write import check_output_file, write_text
from r2h_batch.verdicts import SPLITS

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


def plan(
    *,
    participants: int = 30,
    s0: int = 2,
    s1: int = 3,
    methods: tuple[str, ...] = (
        "FC-Handover",
        "Handover-VA",
        "Contact-Handover",
        "Intent-Handover",
    ),
    seed: int = 0,
) -> int:
    """Write a within-subject schedule as CSV: the paper's by default.

    Args:
        participants: how many people take part.
        s0: objects of S0 that each participant is handed.
        s1: objects of S1.
        methods: names of the methods; everybody meets all of them, with the same objects.
        seed: of the shuffling.
    """
    from r2h_batch.bodies.objects import load_objects
    from r2h_batch.report.text import csv_text
    from r2h_batch.study.plan import schedule

    check_seed(seed)
    built_in = load_objects()
    objects = {split: [o.name for o in built_in if o.split == split] for split in SPLITS}
    rows = schedule(participants, methods, objects, {"S0": s0, "S1": s1}, seed=seed)
    sys.stdout.write(csv_text(rows))
    return 0


COMMANDS: dict[str, Command] = {"paper": paper, "ratings": ratings, "real": real, "plan": plan}


def main(arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.study") -> int:
    """Exit code: 0, or 2 with one line if something cannot be used."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return call(COMMANDS, words or ["paper"], prog=prog, name="study")
    except ValueError as error:
        return refuse("study", error)
    except OSError as error:
        return failed("study", error)
