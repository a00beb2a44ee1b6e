"""The command `study`: simulation against people. Light until there is work; without arguments the
paper's own study."""

import sys
from collections.abc import Sequence
from pathlib import Path

from r2h_batch.command_line import Command, call, check_seed, failed, refuse
from r2h_batch.io.write import check_output_file, csv_cell, write_text
from r2h_batch.verdicts import SPLITS

MOST_TRIALS = 10**9


def paper(*, box: Path | None = None, overwrite: bool = False) -> int:
    """The paper's sim-to-real table and ratings.

    Args:
        box: also write the box plots of the ratings to this .svg file.
        overwrite: replace a file that is there.
    """
    if box is not None:
        check_output_file(box, overwrite=overwrite, flag="--box", endings=(".svg",))
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
        file: one row for each rating; participants who did not rate every method are left out and
        counted. box: also write the box plots to this .svg file. overwrite: replace a file that is
        there.
    """
    if box is not None:
        check_output_file(box, overwrite=overwrite, flag="--box", endings=(".svg",))
    from r2h_batch.study import report
    from r2h_batch.study.stats import Summary

    sys.stdout.write(report.rating_report(file))
    if box is not None:
        tables = report.read_ratings(file)
        summaries = {
            (m, d): Summary.of(t[:, i])
            for d, (t, names, _) in tables.items()
            for i, m in enumerate(names)
        }
        write_text(box, report.box_plot(summaries))
    return 0


def real(run: Path, file: Path, /, *, trials: int) -> int:
    """Your own robot against a run: a CSV with columns method, real_sr (percent: 85 or 85%),
    real_t_tot_s.

    Args:
        run: a run folder with the same methods.
        file: one row for each method, by the sweep's word (fc) or the table's name.
        trials: trials of each method on the robot.
    """
    from r2h_batch.report.table import table_of
    from r2h_batch.report.text import aligned
    from r2h_batch.runs.store import load_run
    from r2h_batch.study.report import REAL_COLUMNS, correlation_line, sim_to_real
    from r2h_batch.study.stats import StudyError, spearman
    from r2h_batch.study.table_file import LINE, read_table

    if not 1 <= trials <= MOST_TRIALS:
        raise StudyError(f"--trials is {trials}; it must be 1 to {MOST_TRIALS}")
    stored = load_run(run)
    rows = {
        r.method: r for r in table_of(stored).rows
    }  # the last line of a method: Avg, or its only split
    found = read_table(file, REAL_COLUMNS)
    names = [stored.named(r["method"]) for r in found]
    if twice := [k for k, name in enumerate(names) if name in names[:k]]:
        raise StudyError(
            f"{file}: line {found[twice[0]][LINE]}: {names[twice[0]]} is there twice; once is enough"
        )
    sim = {}
    for name, row in rows.items():
        rate, total = row.rates["sr"], row.times["t_tot_s"].value
        sim[name] = (rate.percent if rate else 0.0, float("nan") if total is None else total)
    lines = sim_to_real(
        sim, {name: (r["real_sr"], r["real_t_tot_s"]) for name, r in zip(names, found)}
    )
    print(aligned(["Method", "sim SR", "real SR", "delta", "sim T", "real T", "delta"], lines, 1))
    if len(found) > 2:
        c = spearman(
            [sim[m][0] for m in names],
            [r["real_sr"] for r in found],
            counts=(rows[names[0]].n, trials),
        )
        print()
        line = correlation_line("sim SR, real SR", c)
        print(aligned(["Pair", "rho", "measured again", "other methods", "p"], [line], 1))
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
    import csv

    from r2h_batch.bodies.objects import load_objects
    from r2h_batch.study.plan import schedule

    check_seed(seed)
    built_in = load_objects()
    objects = {split: [o.name for o in built_in if o.split == split] for split in SPLITS}
    rows = schedule(participants, methods, objects, {"S0": s0, "S1": s1}, seed=seed)
    writer = csv.DictWriter(sys.stdout, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: csv_cell(v) for k, v in row.items()} for row in rows)
    return 0


COMMANDS: dict[str, Command] = {"paper": paper, "ratings": ratings, "real": real, "plan": plan}


def main(arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.study") -> int:
    """Exit code: 0, or 2 with one line when something cannot be used."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return call(COMMANDS, given or ["paper"], prog=prog, name="study")
    except ValueError as error:
        return refuse("study", error)
    except OSError as error:
        return failed("study", error)
