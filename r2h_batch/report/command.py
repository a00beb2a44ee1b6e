"""What the command `report` does with stored rows alone; r2h_batch.gallery.command is the command,
with pictures of trials."""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from r2h_batch.command_line import refuse, tell
from r2h_batch.io.write import write_text

if TYPE_CHECKING:
    from r2h_batch.runs.store import Run

Gallery = Callable[[], Mapping[str, Sequence[Mapping[str, str]]]]
"""Makes the pictures of each method, once the run is known to be there."""


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
    out: Path | None = None,
    gallery: Gallery | None = None,
) -> int:
    """Print the table of a run folder or write it to `out`; exit code 0, 1 a method is not
    complete, 2 refused."""
    from r2h_batch.runs.store import load_run

    try:
        stored = load_run(run).only(method)
        if not stored.methods:
            raise ValueError(f"{run}: no method is complete; run its sweep again to go on")
        text = _text(stored, format, by_object, columns, intervals, order, gallery)
    except ValueError as error:
        return refuse("report", error)
    if out is None:
        sys.stdout.write(text)
    else:
        write_text(out, text)
        print(out)
    for name in stored.unfinished:
        missing = sum(s.last - s.first for s in stored.missing(name))
        tell(f"report: {name} is not in the table, {missing} of its trials are not scored yet")
    return 1 if stored.unfinished else 0


def _text(
    stored: "Run",
    fmt: str,
    by_object: bool,
    columns: int,
    intervals: bool,
    order: str,
    gallery: Gallery | None,
) -> str:
    if fmt == "html":
        from r2h_batch.report.page import page

        return page(stored, gallery() if gallery else None)
    if by_object:
        from r2h_batch.report.table import object_lines

        return object_lines(stored, fmt)
    from r2h_batch.report.table import render, table_of
    from r2h_batch.statistics.breakdown import parse_order
    from r2h_batch.verdicts import CRITERIA

    table = table_of(stored, parse_order(order) if order else CRITERIA)
    return render(table, fmt, columns=columns, intervals=intervals)
