"""A real robot beside a run: paired trial by trial, or rate by rate."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.base.errors import FileError, UsageError
from r2h_batch.base.table import Table, document, of_lines
from r2h_batch.report.statistics.aggregate import wilson_interval
from r2h_batch.report.statistics.intervals import paired_score_interval
from r2h_batch.report.statistics.paired import mcnemar
from r2h_batch.sweep.study.report import spearman
from r2h_batch.sweep.study.table_file import (
    LINE,
    NAME,
    PERCENT,
    Column,
    columns_of,
    number,
    optional,
    read_table,
    words,
)
from r2h_batch.verdicts import CRITERIA, IN_ORDER

RATE_COLUMNS = {"method": NAME, "real_sr": PERCENT, "real_t_tot_s": number(0, 1e5)}
OUTCOMES = ("success", "failure")
OUTCOME_COLUMNS: dict[str, Column] = {
    "outcome": optional(words(OUTCOMES)),
    "failed_criterion": optional(words(CRITERIA)),
    "seconds": optional(number(0, 1e5)),
}
"""Cells that somebody fills in for each trial; an empty outcome is a trial that was not run. A benchmark may ask for more
criteria (`Run.asks`)."""
TRIAL_COLUMNS = {"trial_id": number(0, 2**63 - 1, whole=True), "method": NAME, **OUTCOME_COLUMNS}
OF_RATES = 3
"""Fewer methods have no rank correlation."""


@dataclass(frozen=True)
class Pairs:
    """One method's trials that both the run and the robot have.

    Attributes:
        sim: (N,) whether the run's trial succeeds.
        real: (N,) whether the robot's does.
        failed: outcome of the run and of the robot of each trial: success or a criterion; "" is a failure without a word.
        seconds: (N,) measured, NaN where nobody noted it.
        planned_s: (N,) the run's, NaN without.
    """

    sim: np.ndarray
    real: np.ndarray
    failed: tuple[tuple[str, str], ...]
    seconds: np.ndarray
    planned_s: np.ndarray


def real_report(run: Path, file: Path, trials: int | None) -> str:
    """A robot's results against those of a run, and how their orders agree.

    Args:
        run: the run folder.
        file: CSV with the columns of `TRIAL_COLUMNS`, as `export real` writes it; or, without ids, of `RATE_COLUMNS`.
        trials: trials of each method on the robot, for a file without ids.

    Raises:
        UsageError: `trials` is missing for a file without ids, or given for one with them.
        FileError: a line that nothing can be made of.
    """
    if "trial_id" in columns_of(file):
        if trials is not None:
            raise UsageError(
                f"--trials is {trials}; {file} has trial ids, which count themselves: leave it out"
            )
        return _paired_report(run, file)
    if trials is None:
        raise UsageError(
            f"{file} has no column trial_id; give one (export real writes the table), or --trials with rates"
        )
    return _rates_report(run, file, trials)


def _paired_report(run: Path, file: Path) -> str:
    found, empty = paired_trials(run, file)
    lines = []
    for name, p in found.items():
        n, both = len(p.sim), int((p.sim & p.real).sum())
        only_sim, only_real = int((p.sim & ~p.real).sum()), int((~p.sim & p.real).sum())
        low, high = paired_score_interval(only_real, only_sim, n)
        moved = (
            f"{100 * (p.real.mean() - p.sim.mean()):+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"
        )
        counts = [str(c) for c in (both, only_sim, only_real, n - both - only_sim - only_real)]
        rates = [_rate(p.sim), _rate(p.real), moved, f"{mcnemar(only_real, only_sim):.2g}"]
        lines.append([name, str(n), *rates, *counts, _seconds(p)])
    head = [
        "Method",
        "n",
        "sim SR",
        "real SR",
        "real - sim",
        "p",
        "both",
        "sim only",
        "real only",
        "neither",
        "s",
    ]
    parts: list[Table | str] = [
        "Success on the same trials; in brackets 95 % intervals (Wilson; Tango for the difference); p: McNemar.",
        of_lines(head, lines),
    ]
    if empty:
        parts.append(f"{empty} rows have no outcome and are left out.")
    parts.append(_by_criterion(found))
    sim, real = (
        [100 * float(x.mean()) for x in column]
        for column in zip(*((p.sim, p.real) for p in found.values()))
    )
    if len(found) >= OF_RATES:
        parts.append(_orders(sim, real, [(len(p.sim), len(p.real)) for p in found.values()]))
    return document(parts)


def paired_trials(run: Path, file: Path) -> tuple[dict[str, Pairs], int]:
    """Method -> its trials in both, and the number of rows without an outcome.

    Args:
        run: the run folder.
        file: CSV with the columns of `TRIAL_COLUMNS`.

    Raises:
        FileError: a trial twice, one that the run lacks, a success that names a criterion; or no outcome at all.
    """
    from r2h_batch.runs.store import load_run

    stored = load_run(run)
    lines: dict[str, dict[int, Mapping[str, Any]]] = {}
    empty = 0
    judged_by = [e.name for e in IN_ORDER if e.name in (*CRITERIA, *stored.asks)]
    columns = TRIAL_COLUMNS | {"failed_criterion": optional(words(judged_by))}
    for line in read_table(file, columns):
        where = f"{file}: line {line[LINE]}"
        name, trial = stored.named(line["method"]), int(line["trial_id"])
        if trial in lines.setdefault(name, {}):
            raise FileError(f"{where}: trial {trial} of {name} is there twice; once is enough")
        if line["outcome"] == "success" and line["failed_criterion"]:
            raise FileError(
                f"{where}: a success has no failed criterion; leave {line['failed_criterion']!r} out"
            )
        lines[name][trial] = line
        empty += not line["outcome"]
    found = {}
    for name, rows in lines.items():
        if name not in stored.methods:
            raise FileError(
                f"{file}: {name} is not complete in {run}; run its sweep again to go on"
            )
        judged = {r["trial_id"]: r for r in stored.trials(name).to_pylist()}
        unknown = [i for i in rows if i not in judged]
        if unknown:
            raise FileError(
                f"{file}: line {rows[unknown[0]][LINE]}: {run} has no trial {unknown[0]} of {name}"
            )
        tried = [(judged[i], row) for i, row in rows.items() if row["outcome"]]
        if tried:
            found[name] = _pairs(tried)
    if not found:
        raise FileError(
            f"{file}: no row has an outcome; write success or failure into each trial that was run"
        )
    return found, empty


def _pairs(tried: Sequence[tuple[Mapping[str, Any], Mapping[str, Any]]]) -> Pairs:
    def real(row: Mapping[str, Any]) -> str:
        return "success" if row["outcome"] == "success" else row["failed_criterion"] or ""

    def planned(row: Mapping[str, Any]) -> float:
        return float("nan") if row["t_exec_s"] is None else float(row["t_exec_s"])

    failed = tuple((str(a["outcome"]), real(b)) for a, b in tried)
    return Pairs(
        np.array([a == "success" for a, _ in failed]),
        np.array([b == "success" for _, b in failed]),
        failed,
        np.array([float("nan") if b["seconds"] is None else b["seconds"] for _, b in tried]),
        np.array([planned(a) for a, _ in tried]),
    )


def _rate(hits: np.ndarray) -> str:
    low, high = wilson_interval(hits.sum(), len(hits))
    return f"{100 * hits.mean():.1f} ({100 * low:.0f}-{100 * high:.0f})"


def _seconds(p: Pairs) -> str:
    both = np.isfinite(p.seconds) & np.isfinite(p.planned_s)
    return f"{np.median(p.seconds[both] - p.planned_s[both]):+.2f}" if both.any() else "-"


def _by_criterion(found: Mapping[str, Pairs]) -> Table:
    """A table of what the robot did, for each outcome of the run."""
    counts = Counter(pair for p in found.values() for pair in p.failed)
    lines = []
    for outcome in ("success", *(e.name for e in IN_ORDER)):
        row = {b: n for (a, b), n in counts.items() if a == outcome}
        if total := sum(row.values()):
            same = row.get(outcome, 0)
            others = [
                f"{b or 'failure, no criterion noted'} {n}"
                for b, n in sorted(row.items())
                if b != outcome
            ]
            lines.append(
                [
                    outcome,
                    str(total),
                    str(same),
                    f"{100 * same / total:.0f}",
                    ", ".join(others) or "-",
                ]
            )
    head = ["in the run", "n", "the robot too", "%", "else on the robot"]
    title = "Agreement by outcome, all methods together (s above: median of measured less planned time)."
    return of_lines(head, lines, title=title)


def _orders(sim: Sequence[float], real: Sequence[float], counts: Sequence[tuple[int, int]]) -> str:
    c = spearman(sim, real, counts=(min(a for a, _ in counts), min(b for _, b in counts)))
    low, high = c.measured
    return (
        f"Spearman's rank correlation of the success rates: {c.rho:+.2f}, p = {c.p:.2f}; 95 % if the same methods"
        f" were measured again: {low:+.2f} to {high:+.2f}\n"
        f"Mean maximum rank violation (SIMPLER): {rank_violation(sim, real):.1f} points; 0: the orders agree."
    )


def rank_violation(sim: Sequence[float], real: Sequence[float]) -> float:
    """Mean over methods of the largest real difference to a method that the simulation puts on the other side, points.

    Args:
        sim: (N,) success rates in simulation, percent.
        real: (N,) success rates on the robot, percent.

    Source: Li et al. 2024, Evaluating real-world robot manipulation policies in simulation (SIMPLER).
    """
    s, r = np.asarray(sim, np.float64), np.asarray(real, np.float64)
    turned = (s[:, None] < s[None]) != (r[:, None] < r[None])
    return float((np.abs(r[:, None] - r[None]) * turned).max(1).mean())


def _rates_report(run: Path, file: Path, trials: int) -> str:
    from r2h_batch.report.table import table_of
    from r2h_batch.runs.store import load_run

    stored = load_run(run)
    # the last row of a method stays: Avg, or its only split
    rows = {row.method: row for row in table_of(stored).rows}
    lines: dict[str, list[str]] = {}
    sim, real, counts = [], [], []
    for line in read_table(file, RATE_COLUMNS):
        name = stored.named(line["method"])
        if name in lines:
            raise FileError(f"{file}: line {line[LINE]}: {name} is there twice; once is enough")
        if name not in rows:
            raise FileError(f"{file}: line {line[LINE]}: {name} is not complete in {run}")
        rate, total = rows[name].rates["sr"], rows[name].times["t_tot_s"].value
        sr = rate.percent if rate else 0.0
        t = float("nan") if total is None else total
        real_sr, real_t = line["real_sr"], line["real_t_tot_s"]
        low, high = unpaired_interval((real_sr / 100, trials), (sr / 100, rows[name].n))
        moved = f"{real_sr - sr:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"
        rates = [f"{sr:.1f}", f"{real_sr:.1f}", moved]
        lines[name] = [name, *rates, f"{t:.2f}", f"{real_t:.2f}", f"{real_t - t:+.2f}"]
        sim.append(sr)
        real.append(real_sr)
        counts.append((rows[name].n, trials))
    head = ["Method", "sim SR", "real SR", "delta (95 %)", "sim T", "real T", "delta"]
    words = "No trial is paired, so the intervals are wide: a column trial_id narrows them (`export real`)."
    orders = _orders(sim, real, counts) if len(lines) >= OF_RATES else ""
    return document([of_lines(head, lines.values()), words, orders])


def unpaired_interval(a: tuple[float, int], b: tuple[float, int]) -> tuple[float, float]:
    """95 % interval of the difference a - b of two rates of different trials, as fractions.

    Args:
        a: rate in [0, 1] and its trials.
        b: the other one.

    Source: Newcombe 1998, Interval estimation for the difference between independent proportions, method 10 (Wilson hybrid).
    """
    (p, (l1, u1)), (q, (l2, u2)) = ((x, wilson_interval(x * n, n)) for x, n in (a, b))
    return (
        float(p - q - np.hypot(p - l1, u2 - q)),
        float(p - q + np.hypot(u1 - p, q - l2)),
    )
