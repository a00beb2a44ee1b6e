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
    order: str = "",
    method: tuple[str, ...] = (),
) -> int:
    """Print the table of a run folder.

    Args:
        run: a run folder, as `python -m r2h_batch.sweep --out` writes it.
        format: md, latex, csv or json; html: one page with charts and a search over trials, no network needed.
        by_object: each object's rates and the criteria that fail together, instead of Table I.
        order: look for the first failure in another order, such as reach,plan (the others follow).
        method: only these methods, by the sweep's word (fc) or the table's name; all unless given.
    """
    from r2h_batch.results.reading import load_run
    from r2h_batch.verdicts import CRITERIA

    try:
        stored = load_run(run).only(method)
        if not stored.methods:
            raise ValueError(f"{run}: no method is complete; run its sweep again to go on")
        if by_object:
            from r2h_batch.report.objects import object_lines

            text = object_lines(stored)
        elif format == "html":
            from r2h_batch.report.page import page

            text = page(stored)
        else:
            from r2h_batch.report.table import render, table_of
            from r2h_batch.statistics.breakdown import parse_order

            text = render(table_of(stored, parse_order(order) if order else CRITERIA), format)
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
