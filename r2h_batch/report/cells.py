"""What stands in Table I: its columns, one cell, the best ones, and the notes below. Every writer
of the table uses these."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import floor, log10

from r2h_batch.report.text import NA
from r2h_batch.statistics.aggregate import FAILURES, RATES, TIMES, Mean, Rate, Row
from r2h_batch.verdicts import CRITERIA, SPLITS

__all__ = [
    "BEST_NOTE",
    "FOOTNOTES",
    "HEADINGS",
    "Table",
    "best_cells",
    "cell",
    "interval",
    "invalid",
]

HEADINGS = {
    "sr": "SR",
    "t_plan_s": "T_plan",
    "t_exec_s": "T_exec",
    "t_tot_s": "T_tot",
    **{rate: entry.heading for rate, entry in FAILURES.items()},
}
"""Table I's columns in its order."""

_SKIPPED = " and ".join(
    f"{split}'s {entry.heading}"
    for split in SPLITS
    for entry in FAILURES.values()
    if split not in entry.splits
)

FOOTNOTES = (
    "SR and F_*: percent of all N planned trials of the split; a trial counts once, at its first failure in the order"
    f" {', '.join(name.capitalize() for name in CRITERIA)}. With invalid and missing they add up to 100.",
    "T_plan: mean over the trials in which planning ran, amortised (batch wall time / B), without the method's own"
    " time; T_exec: mean over the trials whose arm came to rest at its goal; T_tot = T_plan + T_exec; the counts are in"
    " the last table.",
    f"Avg: mean of the two splits, {_SKIPPED} (not evaluated) taken as 0.",
    "Presented: percent of S1's trials, failed ones too, whose receiver's region faces the palm (seen from the TCP, 90 degrees"
    " at most) and lies within the ball's radius of c_h; no part of SR.",
    "Intervals: 95 %. Wilson speaks about more trials with these objects; the object-clustered t interval about new"
    " objects of the same kind.",
)


BEST_NOTE = (
    "Bold: best rate of the split; all methods were asked the same trials. It does not say that the difference is more than"
    " chance: r2h-batch compare does. Times of a machine, and means over the trials that moved, are never best."
)


@dataclass(frozen=True)
class Table:
    """What a report shows: rows in order, and where they come from (protocol, digest, preset,
    device, ...).

    `folder`: of the run, for the commands that are named below the table; empty: none are.
    """

    rows: tuple[Row, ...]
    origin: Mapping[str, str]
    folder: str = ""


def cell(row: Row, column: str) -> str:
    """One cell of Table I: rates with one decimal, seconds with two or more, `n/a` where nothing is
    defined."""
    if column in TIMES:
        return _seconds(row.times[column])
    rate = row.rates[column]
    return NA if rate is None else f"{rate.percent:.1f}"


def _seconds(mean: Mean) -> str:
    """Two decimals, or two digits below 0.1 s (amortised planning takes less than a
    millisecond)."""
    if mean.value is None:
        return NA
    return f"{mean.value:.2f}" if mean.value >= 0.1 or mean.value == 0 else _two_digits(mean.value)


def _two_digits(value: float) -> str:
    return f"{value:.{1 - floor(log10(value))}f}"


def invalid(row: Row) -> int:
    """Trials of a line that could not be judged."""
    return row.counts["invalid_input"] + row.counts["invalid_sim"]


def interval(rate: Rate | None) -> str:
    """`LOW-HIGH` in percent, `n/a` where nothing is defined."""
    return NA if rate is None else f"{rate.low:.1f}-{rate.high:.1f}"


def best_cells(table: Table) -> set[tuple[str, str, str]]:
    """(split, method, column) of the best printed rate of each split, ties included; none where all
    are equal.

    Rates alone: all methods were asked the same trials. T_plan depends on the machine, T_exec is
    over the trials that moved.
    """
    best = set()
    for split in dict.fromkeys(row.split for row in table.rows):
        rows = [row for row in table.rows if row.split == split]
        for column in (c for c in HEADINGS if c in RATES):
            values = {
                row.method: float(cell(row, column)) for row in rows if cell(row, column) != NA
            }
            if len(set(values.values())) > 1:
                top = (max if column == "sr" else min)(values.values())
                best |= {
                    (split, method, column) for method, value in values.items() if value == top
                }
    return best
