"""The same run object by object: each one's rates, and which criteria fail together."""

import csv
import io
import json
from collections.abc import Callable

from r2h_batch.io.write import csv_cell
from r2h_batch.report.cells import HEADINGS, Table, cell, interval
from r2h_batch.report.table import record, table_of
from r2h_batch.report.text import NA, aligned, legend, plain, short_names, wrapped
from r2h_batch.runs.store import Run
from r2h_batch.statistics import breakdown
from r2h_batch.statistics.aggregate import RATES, Row
from r2h_batch.statistics.tally import Tally, tally
from r2h_batch.verdicts import CRITERIA

Lines = list[tuple[str, Row]]


def object_lines(run: Run, fmt: str = "md") -> str:
    """Every method's rates for every object, as md, latex, csv or json; md also says which criteria
    fail together."""
    counted = [tally(run, method, by_object=True) for method in run.methods]
    table = table_of(run, counted=counted)
    lines = [line for t in counted for line in breakdown.by_object(t)]
    writers: dict[str, Callable[[], str]] = {
        "md": lambda: _md(counted, lines),
        "latex": lambda: _latex(table, lines),
        "csv": lambda: _csv(lines),
        "json": lambda: _json(table, lines),
    }
    if fmt not in writers:
        raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(writers)}")
    return writers[fmt]()


def _md(counted: list[Tally], lines: Lines) -> str:
    short = short_names([t.method for t in counted])
    shown = [c for c in HEADINGS if c in RATES]
    rows = [
        [
            row.split,
            name,
            plain(short[row.method]),
            str(row.n),
            *(cell(row, c) for c in shown),
            interval(row.rates["sr"]),
        ]
        for name, row in lines
    ]
    parts = [
        aligned(
            ["Split", "Object", "Method", "N", *(HEADINGS[c] for c in shown), "SR 95 %"], rows, 3
        )
    ]
    if told := legend(short):
        parts.append("\n".join(wrapped(plain(line)) for line in told))
    for t in counted:
        for split in t.splits:
            counts = breakdown.co_failures(t, split)
            pairs = [
                [
                    c,
                    *(
                        f"{f}/{e}" if e else NA
                        for f, e in zip(counts.failed[i], counts.evaluated[i])
                    ),
                ]
                for i, c in enumerate(CRITERIA)
            ]
            parts += [
                f"{plain(short[t.method])}, {split}: trials that fail both / in which both were evaluated.",
                aligned(["", *CRITERIA], pairs, 1),
            ]
    return "\n\n".join(parts) + "\n"


def _latex(table: Table, lines: Lines) -> str:
    from r2h_batch.report.latex_tables import object_table

    return object_table(table, lines)


def _csv(lines: Lines) -> str:
    text = io.StringIO()
    records = [{"object": name} | record(row) for name, row in lines]
    if records:
        writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {k: NA if v is None else csv_cell(v) for k, v in r.items()} for r in records
        )
    return text.getvalue()


def _json(table: Table, lines: Lines) -> str:
    data = {
        "format": 1,
        "origin": dict(table.origin),
        "rows": [{"object": n} | record(row) for n, row in lines],
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"
