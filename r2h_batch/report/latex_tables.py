"""Table I, and SR by object, for a paper."""

from collections.abc import Sequence

from r2h_batch.report import latex
from r2h_batch.report.cells import BEST_NOTE, FOOTNOTES, HEADINGS, Table, best_cells, cell, interval
from r2h_batch.report.text import NA, legend, short_names
from r2h_batch.statistics.aggregate import FAILURES, RATES, TIMES, Row

__all__ = ["main_table", "object_table"]

COLUMNS = (1, 2)


def main_table(table: Table, *, columns: int, intervals: bool) -> str:
    """All of Table I over both columns of a page, or each split's SR in one; with 95 % intervals
    below the rates."""
    if columns not in COLUMNS:
        raise ValueError(f"--columns is {columns}; a page has 1 or 2")
    short = short_names([row.method for row in table.rows])
    notes = [*legend(short), *_counts(table, short), BEST_NOTE, *FOOTNOTES]
    write = _wide if columns == 2 else _narrow
    return "\n".join([*latex.comments(table.origin, notes), *write(table, short, intervals)]) + "\n"


def _counts(table: Table, short: dict[str, str]) -> list[str]:
    def words(row: Row) -> str:
        invalid = row.counts["invalid_input"] + row.counts["invalid_sim"]
        return (
            f"{row.split} {short[row.method]}: N {row.n}, T_plan over {row.times['t_plan_s'].count}, T_exec over"
            f" {row.times['t_exec_s'].count}, invalid {invalid}, missing {row.counts['missing']}, SR of new objects"
            f" {interval(row.sr_new_objects)}"
        )

    return [words(row) for row in table.rows]


def _ends(row: Row, column: str) -> str:
    rate = row.rates.get(column)
    return "" if rate is None else rf"{{\scriptsize [{rate.low:.1f}, {rate.high:.1f}]}}"


def _wide(table: Table, short: dict[str, str], intervals: bool) -> list[str]:
    best = best_cells(table)
    groups: dict[str, list[str]] = {}
    for row in table.rows:
        lines = groups.setdefault(row.split, [])
        values = [
            latex.cell(cell(row, c), bold=(row.split, row.method, c) in best) for c in HEADINGS
        ]
        lines.append(
            " & ".join([row.split if not lines else "", latex.escaped(short[row.method]), *values])
            + r" \\"
        )
        if intervals:
            lines.append(" & ".join(["", "", *(_ends(row, c) for c in HEADINGS)]) + r" \\[2pt]")
    longest = max([len(cell(r, "t_plan_s").partition(".")[2]) for r in table.rows], default=2)
    spec = [latex.text_column()] * 2
    spec += [
        latex.number(*((3, 1) if c in RATES else (2, longest if c == "t_plan_s" else 2)))
        for c in HEADINGS
    ]
    times, failures = (sum(c in of for c in HEADINGS) for of in (TIMES, FAILURES))
    first = 4 + times  # the split, the method and SR stand before the times
    top = [
        rf" & & {{SR}} & \multicolumn{{{times}}}{{c}}{{Time (s)}}"
        rf" & \multicolumn{{{failures}}}{{c}}{{First failure (\%)}} \\",
        rf"\cmidrule(lr){{4-{first - 1}}}\cmidrule(l){{{first}-{first + failures - 1}}}",
    ]
    names = {c: h.partition("_")[2] or h for c, h in HEADINGS.items()} | {"sr": r"(\%)"}
    return latex.table(
        spec, ["", "Method", *(f"{{{n}}}" for n in names.values())], list(groups.values()), top
    )


def _narrow(table: Table, short: dict[str, str], intervals: bool) -> list[str]:
    best = best_cells(table)
    splits = list(dict.fromkeys(row.split for row in table.rows))
    rows = {(row.method, row.split): row for row in table.rows}
    lines = []
    for method, name in short.items():
        mine = [rows.get((method, s)) for s in splits]
        values = [
            latex.cell(
                NA if r is None else cell(r, "sr"),
                bold=r is not None and (r.split, method, "sr") in best,
            )
            for r in mine
        ]
        lines.append(" & ".join([latex.escaped(name), *values]) + r" \\")
        if intervals:
            lines.append(
                " & ".join(["", *("" if r is None else _ends(r, "sr") for r in mine)]) + r" \\[2pt]"
            )
    spec = [latex.text_column(), *[latex.number(3, 1)] * len(splits)]
    top = [
        rf" & \multicolumn{{{len(splits)}}}{{c}}{{Success (\%)}} \\",
        rf"\cmidrule(l){{2-{len(splits) + 1}}}",
    ]
    return latex.table(spec, ["Method", *(f"{{{s}}}" for s in splits)], [lines], top)


def object_table(table: Table, lines: Sequence[tuple[str, Row]]) -> str:
    """SR of every object (rows) and method (columns) over both columns of a page."""
    methods = short_names([row.method for _, row in lines])
    cells = {(row.split, name, row.method): row for name, row in lines}
    groups: dict[str, list[str]] = {}
    for split, name in dict.fromkeys((row.split, name) for name, row in lines):
        of_split = groups.setdefault(split, [])
        found = [cells.get((split, name, m)) for m in methods]
        values = [latex.cell(NA if r is None else cell(r, "sr")) for r in found]
        n = max(r.n for r in found if r is not None)
        first = [split if not of_split else "", latex.escaped(name.replace("_", " ")), str(n)]
        of_split.append(" & ".join([*first, *values]) + r" \\")
    spec = ["l", "l", "r", *[latex.number(3, 1)] * len(methods)]
    head = [
        "",
        "Object",
        "$N$",
        *(rf"{{\rotatebox{{60}}{{{latex.escaped(m)}}}}}" for m in methods.values()),
    ]
    notes = [
        r"and \usepackage{graphicx}",
        "SR in percent of N trials of each object",
        *legend(methods),
    ]
    return (
        "\n".join(
            [*latex.comments(table.origin, notes), *latex.table(spec, head, list(groups.values()))]
        )
        + "\n"
    )
