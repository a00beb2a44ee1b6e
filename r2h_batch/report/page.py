"""A run as one HTML page that needs no network: tables, charts, choices and versions, and a search over trials."""

import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np

from r2h_batch.report import charts
from r2h_batch.report.table import BEST_NOTE, FOOTNOTES, HEADINGS, Table, best_cells, cell, table_of
from r2h_batch.report.text import NA
from r2h_batch.results.reading import Run
from r2h_batch.statistics import breakdown
from r2h_batch.statistics.aggregate import RATES, Row
from r2h_batch.statistics.tally import Tally, tally
from r2h_batch.verdicts import CRITERIA

TRIALS_SHOWN = 20_000
"""Trials of all methods together that a page carries; above, the first of each outcome stand for the others."""


def page(run: Run) -> str:
    """The page as text."""
    methods = [tally(run, m, by_object=True) for m in run.methods]
    table = table_of(run, counted=methods)
    body = [
        f"<h1>{_text(run.folder.resolve().name)}</h1>",
        f"<p class=origin>{' &middot; '.join(f'{_text(k)} <b>{_text(v)}</b>' for k, v in table.origin.items())}</p>",
        _section("Table I", _table(table), "".join(f"<li>{_text(n)}</li>" for n in (*FOOTNOTES, BEST_NOTE))),
        _section(
            "Failures by method",
            charts.outcome_bars([(f"{r.split}  {r.method}", r.counts) for r in _split_rows(table)]),
        ),
        *(_by_object(v) for v in methods),
        _section(
            "Margins",
            _margins(run),
            "<li>Positive: the criterion passes. Margins outside the range count in the outermost bins;"
            " a Plan without a path has none.</li>",
        ),
        _section(
            "Times",
            _times(run),
            "<li>T_plan is amortised (batch wall time / B): it is the same for all trials of a batch.</li>",
        ),
        _section("Criteria that fail together", "".join(map(_co_failures, methods))),
        _search(run),
        _section("Choices and versions", _facts(run.header)),
    ]
    template = resources.files("r2h_batch.report").joinpath("page.html").read_text(encoding="utf-8")
    return template.replace("{{title}}", _text(run.folder.resolve().name)).replace("{{body}}", "\n".join(body))


def _text(value: object) -> str:
    return html.escape(str(value))


def _section(title: str, content: str, notes: str = "") -> str:
    return f"<section><h2>{_text(title)}</h2>{content}{f'<ul class=notes>{notes}</ul>' if notes else ''}</section>"


def _split_rows(table: Table) -> list[Row]:
    return [row for row in table.rows if row.split != "Avg"]


def _grid(headings: Sequence[str], lines: Sequence[Sequence[str]], left: int) -> str:
    """An HTML table; cells are HTML already."""
    head = "".join(f"<th>{_text(h)}</th>" for h in headings)
    body = "".join(
        "<tr>" + "".join(f"<td{' class=l' if i < left else ''}>{c}</td>" for i, c in enumerate(line)) + "</tr>"
        for line in lines
    )
    return f"<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _table(table: Table) -> str:
    best = best_cells(table)

    def value(row: Row, column: str) -> str:
        text = cell(row, column)
        text = f"<b>{text}</b>" if (row.split, row.method, column) in best else text
        rate = row.rates.get(column) if column in RATES else None
        return text + (f"<small>{rate.low:.1f}&ndash;{rate.high:.1f}</small>" if rate else "")

    lines = []
    for row in table.rows:
        new = row.sr_new_objects
        extra = [
            f"{new.low:.1f}&ndash;{new.high:.1f}" if new else NA,
            str(row.n),
            str(row.counts["invalid_input"] + row.counts["invalid_sim"]),
            str(row.counts["missing"]),
        ]
        lines.append([row.split, _text(row.method), *(value(row, c) for c in HEADINGS), *extra])
    return _grid(["Split", "Method", *HEADINGS.values(), "SR, new objects", "N", "invalid", "missing"], lines, 2)


def _by_object(v: Tally) -> str:
    bars = [(f"{row.split}  {name}", row.counts) for name, row in breakdown.by_object(v)]
    return _section(f"Failures by object: {v.method}", charts.outcome_bars(bars))


def _margins(run: Run) -> str:
    found = {m: breakdown.margin_histograms(run, m) for m in run.methods}
    parts = []
    for c in CRITERIA:
        series = {m: h[c] for m, h in found.items()}
        parts.append(charts.histograms(f"{c.capitalize()} margin", series, scale=1000, unit="mm", zero=True))
    return f"<div class=charts>{''.join(parts)}</div>"


def _times(run: Run) -> str:
    parts = []
    for name, title, scale, unit in (("t_exec_s", "T_exec", 1.0, "s"), ("t_plan_s", "T_plan", 1000.0, "ms")):
        if found := breakdown.time_histograms(run, name):
            parts.append(charts.histograms(title, found, scale=scale, unit=unit))
    return f"<div class=charts>{''.join(parts)}</div>"


def _co_failures(v: Tally) -> str:
    found = breakdown.co_failures(v)
    lines = [
        [c, *(f"{f}<small>of {e}</small>" if e else NA for f, e in zip(found.failed[i], found.evaluated[i]))]
        for i, c in enumerate(CRITERIA)
    ]
    return f"<h3>{_text(v.method)}</h3>" + _grid(["fails with", *CRITERIA], lines, 1)


def _search(run: Run) -> str:
    """The trials as columns of one JSON block, which the page's script filters."""
    each = max(1, TRIALS_SHOWN // len(run.methods))
    data: dict[str, Any] = {"columns": list(breakdown.SHOWN), "methods": {}}
    notes = []
    for method in run.methods:
        table, total = breakdown.examples(run, method, each)
        data["methods"][method] = [_column(table[c].to_pylist()) for c in breakdown.SHOWN]
        if len(table) < total:
            notes.append(f"<li>{_text(method)}: {len(table)} of {total} trials, the first of each outcome.</li>")
    # a "</script>" in a method's name would end the block
    block = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return _section(
        "Trials",
        f'<div id=search></div><script type="application/json" id=trials>{block}</script>',
        "".join(notes),
    )


def _column(values: list[Any]) -> list[Any]:
    if any(isinstance(v, float) for v in values):
        return [None if v is None or not np.isfinite(v) else round(v, 5) for v in values]
    return values


def _facts(header: Mapping[str, Any]) -> str:
    lines: list[tuple[str, str]] = []

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{prefix}.{key}" if prefix else key, inner)
        elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
            walk(prefix, ", ".join(f"{v.get('name')} ({v.get('split')})" for v in value))
        else:
            text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
            lines.append((prefix, text))

    for key in ("protocol", "trials", "seed", "configuration", "digests", "objects", "versions", "device", "platform"):
        if key in header:
            walk(key, header[key])
    for key in ("git_commit", "command", "created", "stored", "shard_trials", "hash"):
        if header.get(key) is not None:
            walk(key, header[key])
    rows = [[_text(k), f"<code>{_text(v)}</code>"] for k, v in lines]
    note = "<p>What each choice means and why it was made: docs/choices.md of the project.</p>"
    return note + _grid(["field of run.json", "value"], rows, 2)
