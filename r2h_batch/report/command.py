"""The command `report`: `python -m r2h_batch.report --help`. What is heavy is imported when there is work."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from r2h_batch.command_line import call, refuse, tell


def run(
    run: Path,
    /,
    *,
    format: Literal["md", "latex", "csv", "json", "html"] = "md",
    by_object: bool = False,
    columns: Literal[1, 2] = 2,
    intervals: bool = False,
    order: str = "",
    method: tuple[str, ...] = (),
) -> int:
    """Print the table of a run folder.

    Args:
        run: a run folder, as `python -m r2h_batch.sweep --out` writes it.
        format: md, latex, csv or json; html: one page with charts and a search over trials, no network needed.
        by_object: each object's rates instead of Table I; in md also the criteria that fail together. The html page has both.
        columns: latex: all of Table I over both columns of a page (2), or each split's SR in one (1).
        intervals: latex: 95 % intervals below the rates; the other formats have them anyway.
        order: look for the first failure in another order, such as reach,plan (the others follow).
        method: only these methods, by the sweep's word (fc) or the table's name; all unless given.
    """
    from r2h_batch.results.reading import load_run
    from r2h_batch.verdicts import CRITERIA

    try:
        stored = load_run(run).only(method)
        if not stored.methods:
            raise ValueError(f"{run}: no method is complete; run its sweep again to go on")
        if format == "html":
            from r2h_batch.report.page import page

            text = page(stored)
        elif by_object:
            from r2h_batch.report.objects import object_lines

            text = object_lines(stored, format)
        else:
            from r2h_batch.report.table import render, table_of
            from r2h_batch.statistics.breakdown import parse_order

            table = table_of(stored, parse_order(order) if order else CRITERIA)
            text = render(table, format, columns=columns, intervals=intervals)
    except (ValueError, OSError) as error:
        return refuse("report", error)
    sys.stdout.write(text)
    for name in stored.unfinished:
        missing = sum(s.last - s.first for s in stored.missing(name))
        tell(f"report: {name} is not in the table, {missing} of its trials are not scored yet")
    return 1 if stored.unfinished else 0


def main(arguments: Sequence[str] | None = None, *, prog: str = "python -m r2h_batch.report") -> int:
    """Exit code: 0 printed, 1 a method is not complete, 2 refused with one line."""
    return call(run, sys.argv[1:] if arguments is None else arguments, prog=prog, name="report")
