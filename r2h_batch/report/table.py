"""Table I as text: Markdown, LaTeX, CSV or JSON from the rows of `aggregate.summarise`. Formatting only."""

import csv
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import floor, log10
from typing import Any

from r2h_batch.files import csv_cell
from r2h_batch.report.text import NA, aligned, plain, wrapped
from r2h_batch.results.reading import Run
from r2h_batch.statistics import breakdown
from r2h_batch.statistics.aggregate import RATES, TIMES, Mean, Rate, Row, summarise
from r2h_batch.statistics.tally import Tally, tally
from r2h_batch.verdicts import CRITERIA

FORMATS = ("md", "latex", "csv", "json")

HEADINGS = {
    "sr": "SR",
    "t_plan_s": "T_plan",
    "t_exec_s": "T_exec",
    "t_tot_s": "T_tot",
    "f_plan": "F_plan",
    "f_reach": "F_reach",
    "f_safe": "F_safe",
    "f_stab": "F_stab",
    "f_afford": "F_afford",
}
"""Table I's columns in its order."""

FOOTNOTES = (
    "SR and F_*: percent of all N planned trials of the split; a trial counts once, at its first failure in the order"
    " Stability, Plan, Reach, Affordance, Safe. With invalid and missing they add up to 100.",
    "T_plan: mean over the trials in which planning ran, amortised (batch wall time / B), without the method's own"
    " time; T_exec: mean over the trials whose arm came to rest at its goal; T_tot = T_plan + T_exec; the counts are in"
    " the last table.",
    "Avg: mean of the two splits, S0's F_afford (not evaluated) taken as 0.",
    "Intervals: 95 %. Wilson speaks about more trials with these objects; the object-clustered t interval about new"
    " objects of the same kind.",
)


BEST_NOTE = (
    "Bold: best value of the split. It does not say that the difference is more than chance:"
    " python -m r2h_batch.compare does."
)


@dataclass(frozen=True)
class Table:
    """What a report shows: rows in order, and where they come from (protocol, digest, preset, device, ...)."""

    rows: tuple[Row, ...]
    origin: Mapping[str, str]


def table_of(run: Run, order: Sequence[str] = CRITERIA, counted: Sequence[Tally] | None = None) -> Table:
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
    if "motion" in header:
        origin["motion"] = str(header["motion"]["engine"]).replace("none", "as planned")
    if "predictors" in header:
        origin["predictor noise"] = f"{header['predictors']['noise_factor']:g}"
    if tuple(order) != CRITERIA:
        origin["order of criteria"] = ", ".join(order)
    return Table(summarise(rows), origin)


def render(table: Table, fmt: str) -> str:
    """The table as text that ends in a newline; `fmt` is one of `FORMATS`."""
    writers: dict[str, Callable[[Table], str]] = {"md": _md, "latex": _latex, "csv": _csv, "json": _json}
    if fmt not in writers:
        raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(FORMATS)}")
    return writers[fmt](table)


def cell(row: Row, column: str) -> str:
    """One cell of Table I: rates with one decimal, seconds with two or more, `n/a` where nothing is defined."""
    if column in TIMES:
        return _seconds(row.times[column])
    rate = row.rates[column]
    return NA if rate is None else f"{rate.percent:.1f}"


def _seconds(mean: Mean) -> str:
    """Two decimals, or two digits below 0.1 s (amortised planning takes less than a millisecond)."""
    if mean.value is None:
        return NA
    return f"{mean.value:.2f}" if mean.value >= 0.1 or mean.value == 0 else _two_digits(mean.value)


def _two_digits(value: float) -> str:
    return f"{value:.{1 - floor(log10(value))}f}"


def _invalid(row: Row) -> int:
    return row.counts["invalid_input"] + row.counts["invalid_sim"]


def interval(rate: Rate | None) -> str:
    """`LOW-HIGH` in percent, `n/a` where nothing is defined."""
    return NA if rate is None else f"{rate.low:.1f}-{rate.high:.1f}"


def _md(table: Table) -> str:
    rates = [c for c in HEADINGS if c in RATES]
    names = [(row.split, plain(row.method)) for row in table.rows]
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
            str(_invalid(row)),
            str(row.counts["missing"]),
        ]
        for n, row in zip(names, table.rows)
    ]
    others = ("N", "SR new obj.", "n T_plan", "n T_exec", "T_method", "invalid", "missing")
    parts = [
        "  \n".join(f"{key}: {value}" for key, value in table.origin.items()),
        "Rates in percent, times in seconds.",
        aligned(["Split", "Method", *HEADINGS.values()], main, 2),
        "Wilson 95 % intervals of the rates.",
        aligned(["Split", "Method", *(HEADINGS[c] for c in rates)], ends, 2),
        "Counts, the object-clustered 95 % interval of SR, and T_method, the method's own time per trial.",
        aligned(["Split", "Method", *others], counts, 2),
        "\n".join(wrapped(note) for note in FOOTNOTES),
    ]
    return "\n\n".join(parts) + "\n"


def best_cells(table: Table) -> set[tuple[str, str, str]]:
    """(split, method, column) of the best printed value of each split, ties included; none where all are equal."""
    best = set()
    for split in dict.fromkeys(row.split for row in table.rows):
        rows = [row for row in table.rows if row.split == split]
        for column in HEADINGS:
            values = {row.method: float(cell(row, column)) for row in rows if cell(row, column) != NA}
            if len(set(values.values())) > 1:
                top = (max if column == "sr" else min)(values.values())
                best |= {(split, method, column) for method, value in values.items() if value == top}
    return best


_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_TEX |= {c: "\\" + c for c in "&%$#_{}"}


def _tex(text: str) -> str:
    return "".join(_TEX.get(c, c) for c in text)


def _latex(table: Table) -> str:
    best = best_cells(table)

    def value(row: Row, column: str) -> str:
        rate = row.rates.get(column)
        ends = "" if rate is None else rf" {{\scriptsize[{rate.low:.1f}, {rate.high:.1f}]}}"
        text = cell(row, column)
        return (rf"\textbf{{{text}}}" if (row.split, row.method, column) in best else text) + ends

    def heading(name: str) -> str:
        symbol, _, index = name.partition("_")
        return rf"$\mathrm{{{symbol}}}$" if not index else rf"${symbol}_{{\text{{{index}}}}}$"

    lines = [
        "% needs booktabs and amsmath",
        *(f"% {key}: {_tex(value)}" for key, value in table.origin.items()),
        r"\begin{tabular}{ll" + "r" * len(HEADINGS) + "}",
        r"\toprule",
        r" & & Success (\%) & \multicolumn{3}{c}{Time (s)} & \multicolumn{5}{c}{Failure (\%)} \\",
        r"\cmidrule(lr){3-3}\cmidrule(lr){4-6}\cmidrule(lr){7-11}",
        "Split & Method & " + " & ".join(map(heading, HEADINGS.values())) + r" \\",
    ]
    previous = None
    for row in table.rows:
        if row.split != previous:
            lines.append(r"\midrule")
        first = row.split if row.split != previous else ""
        lines.append(" & ".join([first, _tex(row.method), *(value(row, c) for c in HEADINGS)]) + r" \\")
        previous = row.split
    lines.append(r"\bottomrule")
    provenance = "; ".join(f"{key} {value}" for key, value in table.origin.items())
    sizes = "; ".join(
        f"{row.split} {row.method}: N={row.n}, T_plan over {row.times['t_plan_s'].count},"
        f" T_exec over {row.times['t_exec_s'].count}, invalid {_invalid(row)}, missing {row.counts['missing']},"
        f" SR for new objects {interval(row.sr_new_objects)}"
        for row in table.rows
    )
    for note in (*FOOTNOTES, BEST_NOTE, sizes + ".", provenance + "."):
        lines.append(rf"\multicolumn{{11}}{{@{{}}p{{\linewidth}}@{{}}}}{{\footnotesize {_tex(note)}}} \\")
    return "\n".join([*lines, r"\end{tabular}"]) + "\n"


def _record(row: Row) -> dict[str, Any]:
    """One flat row: every number of the table under its own name, None where nothing is defined."""
    record: dict[str, Any] = {"split": row.split, "method": row.method, "n": row.n, "n_objects": row.n_objects}
    for name in RATES:
        rate = row.rates[name]
        record |= {name: rate and rate.percent, f"{name}_low": rate and rate.low, f"{name}_high": rate and rate.high}
    new = row.sr_new_objects
    record |= {"sr_new_objects_low": new and new.low, "sr_new_objects_high": new and new.high}
    for name in TIMES:
        record |= {name: row.times[name].value, f"{name}_n": row.times[name].count}
    return record | {f"n_{name}": count for name, count in row.counts.items()}


def _csv(table: Table) -> str:
    text = io.StringIO()
    records = [_record(row) | {k.replace(" ", "_"): v for k, v in table.origin.items()} for row in table.rows]
    if records:
        writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: NA if v is None else csv_cell(v) for k, v in record.items()} for record in records)
    return text.getvalue()


def _json(table: Table) -> str:
    data = {"format": 1, "origin": dict(table.origin), "rows": list(map(_record, table.rows)), "notes": FOOTNOTES}
    return json.dumps(data, indent=1, allow_nan=False) + "\n"
