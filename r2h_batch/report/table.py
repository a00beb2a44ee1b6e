"""Table I as text: Markdown, LaTeX, CSV or JSON from the rows of `aggregate.summarise`. Formatting
only."""

import csv
import io
import json
import shlex
from collections.abc import Callable, Sequence
from typing import Any

from r2h_batch.io.write import csv_cell
from r2h_batch.report.cells import FOOTNOTES, HEADINGS, Table, cell, interval, invalid
from r2h_batch.report.latex_tables import main_table
from r2h_batch.report.text import NA, aligned, legend, plain, short_names, wrapped
from r2h_batch.runs.store import Run
from r2h_batch.statistics import breakdown
from r2h_batch.statistics.aggregate import RATES, TIMES, Row, summarise
from r2h_batch.statistics.tally import Tally, tally
from r2h_batch.verdicts import CRITERIA

FORMATS = ("md", "latex", "csv", "json")


def table_of(
    run: Run, order: Sequence[str] = CRITERIA, counted: Sequence[Tally] | None = None
) -> Table:
    """The table of every complete method of a run folder, first failures looked for in `order`.

    `counted`: these methods' trials, where they were counted already.
    """
    header = run.header
    rows = [tally(run, method) for method in run.methods] if counted is None else list(counted)
    if tuple(order) != CRITERIA:
        rows = [breakdown.in_order(v, order) for v in rows]
    origin = {
        "preset": str(header["configuration"].get("name", "custom")),
        "protocol": str(header["protocol"]),
        "trials": ", ".join(f"{n} {split}" for split, n in header["trials"].items()),
        "trials digest": str(header["digests"]["trials"]),
        "device": str(header["device"]["name"]),
        "r2h_batch": str(header["versions"]["r2h_batch"]),
    }
    if flags := (header.get("benchmark") or {}).get("flags"):
        origin["benchmark"] = (
            f"{' '.join(flags)}, digest {header['digests'].get('benchmark', 'unknown')}"
        )
    if "motion" in header:
        origin["motion"] = str(header["motion"]["engine"]).replace("none", "as planned")
    if "predictors" in header:
        origin["predictor noise"] = f"{header['predictors']['noise_factor']:g}"
    # what methods and planner know, where it is not as everywhere else
    said = header["configuration"]
    if (said.get("plan") or {}).get("hand", "true") != "true":
        origin["paths planned against"] = f"the {said['plan']['hand']} hand"
    if said.get("candidates", "filtered") != "filtered":
        origin["grasp candidates"] = str(said["candidates"]).replace("-", " ")
    if tuple(order) != CRITERIA:
        origin["order of criteria"] = ", ".join(order)
    return Table(summarise(rows), origin, str(run.folder))


def render(table: Table, fmt: str, *, columns: int = 2, intervals: bool = False) -> str:
    """The table as text that ends in a newline; `fmt` is one of `FORMATS`.

    LaTeX for 1 or 2 `columns` of a page, with 95 % `intervals` where they are asked for; the other
    formats have them anyway.
    """
    if fmt == "latex":
        return main_table(table, columns=columns, intervals=intervals)
    writers: dict[str, Callable[[Table], str]] = {"md": _md, "csv": _csv, "json": _json}
    if fmt not in writers:
        raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(FORMATS)}")
    return writers[fmt](table)


def _md(table: Table) -> str:
    rates = [c for c in HEADINGS if c in RATES]
    short = short_names([row.method for row in table.rows])
    names = [(row.split, plain(short[row.method])) for row in table.rows]
    main = [[*n, *(cell(row, c) for c in HEADINGS)] for n, row in zip(names, table.rows)]
    ends = [[*n, *(interval(row.rates[c]) for c in rates)] for n, row in zip(names, table.rows)]
    counts = [
        [
            *n,
            str(row.n),
            interval(row.sr_new_objects),
            str(row.times["t_plan_s"].count),
            str(row.times["t_exec_s"].count),
            cell(row, "t_method_s"),
            str(invalid(row)),
            str(row.counts["missing"]),
        ]
        for n, row in zip(names, table.rows)
    ]
    others = ("N", "SR new obj.", "n T_plan", "n T_exec", "T_method", "invalid", "missing")
    shown = [
        [*n, f"{row.presented.percent:.1f}", interval(row.presented), str(row.presented.total)]
        for n, row in zip(names, table.rows)
        if row.presented
    ]
    met = [
        [*n, f"{row.body_met.percent:.1f}", interval(row.body_met), str(row.body_met.total)]
        for n, row in zip(names, table.rows)
        if row.body_met
    ]
    parts = [
        "  \n".join(f"{key}: {value}" for key, value in table.origin.items()),
        "Rates in percent, times in seconds.",
        aligned(["Split", "Method", *HEADINGS.values()], main, 2),
        "Wilson 95 % intervals of the rates.",
        aligned(["Split", "Method", *(HEADINGS[c] for c in rates)], ends, 2),
        "Counts, the object-clustered 95 % interval of SR, and T_method, the method's own time per trial.",
        aligned(["Split", "Method", *others], counts, 2),
        *(
            [
                "Presented (not in SR).",
                aligned(["Split", "Method", "Presented", "95 %", "of"], shown, 2),
            ]
            if shown
            else []
        ),
        *(
            [
                "Motions that meet the receiver's arm or torso (in Safe with --receiver body only).",
                aligned(["Split", "Method", "Body met", "95 %", "of"], met, 2),
            ]
            if met
            else []
        ),
        "\n".join(wrapped(note) for note in [*map(plain, legend(short)), *FOOTNOTES]),
        *([next_commands(table)] if table.folder else []),
    ]
    return "\n\n".join(parts) + "\n"


def next_commands(table: Table) -> str:
    """What one asks next of this run, as commands."""
    several = len({row.method for row in table.rows}) > 1
    lines = [
        ("compare", "" if several else " baselines", "which differences are more than chance"),
        ("report", " --format html > report.html", "by object, margins, every trial"),
        ("results verify", " --rejudge 200", "whether the rows are what the evaluator says"),
    ]
    folder = shlex.quote(table.folder)
    return "Next:\n\n" + "\n".join(
        f"    r2h-batch {c} {folder}{more}  # {what}" for c, more, what in lines
    )


def record(row: Row) -> dict[str, Any]:
    """One flat row: every number of the table under its own name, None where nothing is defined."""
    fields: dict[str, Any] = {
        "split": row.split,
        "method": row.method,
        "n": row.n,
        "n_objects": row.n_objects,
    }
    for name in RATES:
        rate = row.rates[name]
        fields |= {
            name: rate and rate.percent,
            f"{name}_low": rate and rate.low,
            f"{name}_high": rate and rate.high,
        }
    new = row.sr_new_objects
    fields |= {"sr_new_objects_low": new and new.low, "sr_new_objects_high": new and new.high}
    shown = row.presented
    fields |= {
        "presented": shown and shown.percent,
        "presented_low": shown and shown.low,
        "presented_high": shown and shown.high,
    }
    met = row.body_met
    fields |= {
        "body_met": met and met.percent,
        "body_met_low": met and met.low,
        "body_met_high": met and met.high,
    }
    for name in TIMES:
        fields |= {name: row.times[name].value, f"{name}_n": row.times[name].count}
    return fields | {f"n_{name}": count for name, count in row.counts.items()}


def _csv(table: Table) -> str:
    text = io.StringIO()
    records = [
        record(row) | {k.replace(" ", "_"): v for k, v in table.origin.items()}
        for row in table.rows
    ]
    if records:
        writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {k: NA if v is None else csv_cell(v) for k, v in r.items()} for r in records
        )
    return text.getvalue()


def _json(table: Table) -> str:
    data = {
        "format": 1,
        "origin": dict(table.origin),
        "rows": list(map(record, table.rows)),
        "notes": FOOTNOTES,
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"
