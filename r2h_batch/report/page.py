"""A run as one HTML page that needs no network: which method is better, on which objects, why trials
fail, and a search over the trials.

jinja2 fills page.html and escapes all text that comes from files; matplotlib draws (figures.py).
"""

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from r2h_batch.base.table import NA, PERCENT, Column, Table, of_lines
from r2h_batch.report import figures
from r2h_batch.report.compare.text import p_words
from r2h_batch.report.statistics import breakdown
from r2h_batch.report.statistics.aggregate import Row, wilson_interval
from r2h_batch.report.statistics.common import Common
from r2h_batch.report.statistics.few import FEW
from r2h_batch.report.statistics.paired import Comparison, compare, pair_up
from r2h_batch.report.statistics.tally import Tally, tally
from r2h_batch.report.table import (
    BEST_NOTE,
    READS_COLUMN,
    SPLIT,
    Report,
    best_cells,
    method_column,
    number_column,
    records_of,
    share_columns,
    table_of,
)
from r2h_batch.report.text import in_words, short_names
from r2h_batch.report.turn import Turned
from r2h_batch.runs.rows import OUTCOME_NAMES
from r2h_batch.runs.store import Run
from r2h_batch.verdicts import EVERY, UNITS

TRIALS_SHOWN = 20_000
"""Trials of all methods together that a page holds. Of a larger run it holds the first trials of
each outcome."""

LEAST_TRIALS = 10
"""Rates of fewer trials are grey."""
FIRST_PICTURES = 3
"""Pictures above the tables."""

_VERDICTS = ("better", "better here", "tied", "worse here", "worse")
MARKS = dict(zip(_VERDICTS, "\u25b2\u25b3=\u25bd\u25bc", strict=True))
"""A verdict of `compare` as one sign."""


def page(
    run: Run,
    gallery: Mapping[str, Sequence[Mapping[str, str]]] | None = None,
    *,
    common: Common | None = None,
    few: int = FEW,
) -> str:
    """The page as text.

    Args:
        run: what `load_run` or `join` gives.
        gallery: method -> pictures with `trial`, `outcome`, `src`, `alt`, `caption`, `command` and `href`.
        common: the trials on which several runs are compared; None: they are not compared.
        few: new categories whose mean the prediction intervals speak about.

    Raises:
        ValueError: if matplotlib is missing.
    """
    import jinja2

    figures.needs_matplotlib()
    counted = [tally(run, m) for m in run.methods]
    table = table_of(run, counted=counted, alike=len(run.runs) == 1 or common is not None, few=few)
    short = short_names(run.methods)
    runs = run.runs
    used = [o for o in OUTCOME_NAMES if any(row.counts[o] for row in table.rows)]
    rows = [row for row in table.rows if row.split != "Avg"]
    bars = {m: [(row.split, row.counts) for row in rows if row.method == m] for m in run.methods}
    found = {short[m]: breakdown.margin_histograms(run, m) for m in run.methods}
    margins = [
        figures.ridges(
            entry.name.capitalize(),
            {m: h[entry.name] for m, h in found.items()},
            scale=UNITS[entry.unit].scale,
            unit=UNITS[entry.unit].shown,
            zero=True,
        )
        for entry in run.criteria
    ]
    times = breakdown.time_histograms(run, "t_exec_s")
    comparable = len(run.methods) > 1 and not (len(runs) > 1 and common is None)
    compared = compare(pair_up([run], common), few=few) if comparable else ()
    together = _co_failures(counted, short)
    loader = jinja2.PackageLoader("r2h_batch.report", ".")
    strict = jinja2.StrictUndefined
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=strict)
    return environment.get_template("page.html").render(
        title=", ".join(r.folder.resolve().name for r in runs),
        origin=in_words(table.origin),
        short=short,
        overview=_overview(table, compared, short).html(
            name="overview", sortable=True, least=LEAST_TRIALS
        ),
        moved=any(test.marked for test in table.turns),
        bold=bool(best_cells(table)),
        kind="categories" if table.families else "objects",
        splits=list(dict.fromkeys(row.split for row in table.rows)),
        matrices=[_matrix(c) for c in compared],
        heat=_heat(counted, run.methods),
        families=_families(counted, run) if table.families else [],
        least=LEAST_TRIALS,
        first_pictures=_first_pictures(table, gallery or {}, short),
        failures=[figures.failure_bars(short[m], bars[m]) for m in run.methods],
        legend=[(figures.WORDS[o], figures.COLORS[o]) for o in used],
        margins=[figure for figure in margins if figure],
        times=figures.ridges("T_exec", {short[m]: h for m, h in times.items()}, scale=1, unit="s"),
        co_failures=together.html(sortable=True) if together.records else "",
        gallery=gallery or {},
        table=_full(table, short).html(name="full", sortable=True, least=LEAST_TRIALS),
        notes=[*table.notes, *([BEST_NOTE] if best_cells(table) else [])],
        facts=of_lines(("field of run.json", "value"), _all_facts(runs), left=2).html(),
        trials=_trials(run, gallery or {}),
    )


def _cell(text: str, value: float | None, low: str = "", high: str = "") -> Any:
    """A cell as page.html writes it; it sorts by `value`, and cells without one come first."""
    value = -1 if value is None else value
    return {"text": text, "value": value, "low": low, "high": high}


def _rate(row: Row | None) -> Any:
    rate = row.rates["sr"] if row else None
    if rate is None:
        return _cell(NA, None)
    low, high = f"{rate.low:.1f}", f"{rate.high:.1f}"
    return _cell(f"{rate.percent:.1f}", round(rate.percent, 4), low, high)


def _overview(report: Report, compared: Sequence[Comparison], short: Mapping[str, str]) -> Table:
    """A line for each method: SR of each split with its interval, the rank on new objects, the
    failures and T_exec of the last row (Avg, or the only split)."""
    best, kind = best_cells(report), "categories" if report.families else "objects"
    splits = list(dict.fromkeys(row.split for row in report.rows))
    records: list[dict[str, Any]] = []
    bold: set[tuple[int, str]] = set()
    for method in dict.fromkeys(row.method for row in report.rows):
        own = {r["split"]: r for r in records_of(report) if r["method"] == method}
        tests = [t for t in report.turns if t.method == method and t.marked]
        record = dict(own[splits[-1]]) | {
            "about": _about(method, tests),
            "turn_marked": bool(tests),
        }
        for split, row in own.items():
            record |= {f"{split}{k[2:]}": row[k] for k in ("sr", "sr_low", "sr_high", "sr_of")}
            bold |= {(len(records), split)} if (split, method, "sr") in best else set()
        rank = _rank(compared[-1], method) if compared else {"text": NA, "value": None}
        records.append(record | {"rank": rank["value"], "rank_text": rank["text"]})
    words = f"first failures, {splits[-1]}, % of all trials"
    failures = [replace(number_column(report, c), title=words, ends=False) for c in report.failures]
    columns = (
        replace(method_column(short), about="about"),
        READS_COLUMN,
        *(Column(s, f"SR {s}", PERCENT, ends=True, bar=True) for s in splits),
        Column(
            "rank",
            form=lambda r: str(r["rank_text"]),
            title=f"rank by SR among new {kind}: those of at least 5 % of the draws",
        ),
        *failures,
        replace(number_column(report, "t_exec_s"), title=f"simulated seconds, {splits[-1]}"),
    )
    return Table(columns, records, bold=frozenset(bold))


def _about(method: str, tests: Sequence[Turned]) -> str:
    """What a method's cell says when it is pointed at."""
    return ". ".join([method, *(" ".join(t.sentence for t in tests) for _ in tests[:1])])


def _rank(c: Comparison, method: str) -> dict[str, Any]:
    """The mean rank over the bootstrap's draws, and the ranks of at least one draw in twenty."""
    if c.rank is None or method not in c.ranked:
        return {"text": NA, "value": len(c.names)}
    share = c.rank[c.ranked.index(method)]
    likely = [i + 1 for i in np.flatnonzero(share >= 0.05).tolist()]
    ends = dict.fromkeys((likely[0], likely[-1]) if likely else (NA,))
    text = "\u2013".join(map(str, ends))
    return {"text": text, "value": round(float((share * np.arange(1, len(share) + 1)).sum()), 4)}


def _matrix(c: Comparison) -> dict[str, Any]:
    """A sign and a sentence for each ordered pair of methods."""
    opposite = dict(zip(MARKS, reversed(MARKS)))
    words = {}
    for p in c.pairs:
        known = p.low is not None and p.high is not None
        ends = f", 95 % for all {c.new} {p.low:+.1f} to {p.high:+.1f}" if known else ""
        if p.few_low is not None and p.few_high is not None:
            ends += f", for {c.few} new ones {p.few_low:+.1f} to {p.few_high:+.1f}"
        sentence = (
            f"{p.a} is {p.verdict}: {p.difference:+.1f} points{ends}; "
            f"only {p.a} {p.only_a}, only {p.b} {p.only_b}; Holm p {p_words(p)}"
        )
        words[p.a, p.b] = (MARKS[p.verdict], sentence)
        words[p.b, p.a] = (MARKS[opposite[p.verdict]], sentence)
    lines = [(a, [words.get((a, b), ("", "")) for b in c.names]) for a in c.names]
    return {"group": c.group, "n": c.n, "names": c.names, "lines": lines}


def _heat(
    counted: Sequence[Tally], methods: Sequence[str], names: Collection[str] | None = None
) -> list[dict[str, Any]]:
    """SR of each object (lines), or of some, and method."""
    cells = {
        (row.split, name, row.method): row for t in counted for name, row in breakdown.by_object(t)
    }
    lines = []
    for split, name in sorted({key[:2] for key in cells if names is None or key[1] in names}):
        own = [cells.get((split, name, m)) for m in methods]
        values = [_rate(row) | {"n": row.n if row else 0} for row in own]
        lines.append(_heat_line(split, name, values))
    return lines


def _heat_line(split: str, name: str, cells: list[dict[str, Any]]) -> dict[str, Any]:
    numbers = sorted({c["n"] for c in cells if c["n"]})
    ends = dict.fromkeys((numbers[0], numbers[-1]))
    return {
        "split": split,
        "object": name.replace("_", " "),
        "n": "\u2013".join(map(str, ends)),
        "most": numbers[-1],
        "cells": cells,
    }


def _families(counted: Sequence[Tally], run: Run) -> list[dict[str, Any]]:
    """SR of each family (lines) and method, with the lines of its objects."""
    category, rows = run.categories, dict[tuple[str, str], dict[str, list[Row]]]()
    for t in counted:
        for name, row in breakdown.by_object(t):
            own = rows.setdefault((row.split, category.get(name, name)), {})
            own.setdefault(row.method, []).append(row)
    lines = []
    for (split, family), by_method in sorted(rows.items()):
        cells = [_pooled(by_method.get(m, ())) for m in run.methods]
        names = {name for name in category if category[name] == family}
        objects = [line for line in _heat(counted, run.methods, names) if line["split"] == split]
        lines.append(_heat_line(split, family, cells) | {"objects": objects})
    return lines


def _pooled(rows: Sequence[Row]) -> dict[str, Any]:
    """The cell of all trials of some rows."""
    n, hits = sum(r.n for r in rows), sum(r.counts["success"] for r in rows)
    if not n:
        return _cell(NA, None) | {"n": 0}
    low, high = (100 * float(x) for x in wilson_interval(hits, n))
    share = 100 * hits / n
    return _cell(f"{share:.1f}", round(share, 4), f"{low:.1f}", f"{high:.1f}") | {"n": n}


def _first_pictures(
    table: Report, gallery: Mapping[str, Sequence[Mapping[str, str]]], short: Mapping[str, str]
) -> list[dict[str, str]]:
    """A picture of each of the most frequent causes of all methods together, then a success; of the method that has most."""
    rows = [row for row in table.rows if row.split != "Avg"]
    total = {o: sum(row.counts[o] for row in rows) for o in OUTCOME_NAMES}
    causes = sorted((e.name for e in EVERY if total[e.name]), key=lambda o: -total[o])
    found: list[dict[str, str]] = []
    for outcome in (*causes[: FIRST_PICTURES - 1], "success", *causes[FIRST_PICTURES - 1 :]):
        of = {m: sum(r.counts[outcome] for r in rows if r.method == m) for m in gallery}
        for method in sorted(of, key=lambda m: -of[m]):
            own = [p for p in gallery[method] if p.get("outcome") == outcome]
            if own and len(found) < FIRST_PICTURES:
                found.append({"method": short[method], **own[0]})
                break
    return found


def _co_failures(counted: Sequence[Tally], short: Mapping[str, str]) -> Table:
    """The pairs of criteria that at least one trial of a method fails together."""
    records = []
    for t in counted:
        found = breakdown.co_failures(t)
        for i, a in enumerate(t.judged):
            for j, b in list(enumerate(t.judged))[i + 1 :]:
                if n := int(found.failed[i, j]):
                    both = int(found.evaluated[i, j])
                    records.append({"method": short[t.method], "a": a, "b": b, "n": n, "of": both})
    names = {"method": "Method", "a": "fails", "b": "and"}
    words = (Column(name, heading, left=True) for name, heading in names.items())
    return Table((*words, Column("n", "trials"), Column("of")), records)


def _full(report: Report, short: Mapping[str, str]) -> Table:
    """Every cell of Table I, rates with their intervals."""
    best, kind = best_cells(report), "categories" if report.families else "objects"
    records = records_of(report)
    for record, row in zip(records, report.rows, strict=True):
        test = report.turn_of(row)
        record["about"] = _about(row.method, [test] if test and test.marked else [])
    bold = {
        (k, c)
        for k, row in enumerate(report.rows)
        for c in report.headings
        if (row.split, row.method, c) in best
    }
    few, form = f"95 %: the mean of {report.few} {kind} that you bring", "{low:.1f}\u2013{high:.1f}"
    columns = (
        *(SPLIT, replace(method_column(short), about="about"), READS_COLUMN),
        *(number_column(report, c) for c in report.headings),
        Column(f"sr_new_{kind}", f"SR, new {kind}", form, title=f"95 %: the mean of all {kind}"),
        Column("sr_few", f"SR, of {report.few} new", form, title=few),
        *share_columns(report),
        *(Column("n", "N"), Column("invalid"), Column("n_missing", "missing")),
    )
    return Table(columns, records, bold=frozenset(bold))


def _trials(run: Run, gallery: Mapping[str, Sequence[Mapping[str, str]]]) -> dict[str, Any]:
    """The trials as columns of one JSON block, which the page's script filters, with the page of a
    trial and the command that shows one; the notes name the methods of which it holds a part."""
    each = max(1, TRIALS_SHOWN // len(run.methods))
    shown = breakdown.shown(run)
    data: dict[str, Any] = {"columns": list(shown)}
    data["margins"] = {
        e.margin_column: [e.name, UNITS[e.unit].shown, UNITS[e.unit].scale] for e in run.criteria
    }
    data |= {name: {} for name in ("methods", "view", "pages")}
    notes = []
    for method in run.methods:
        data["view"][method] = run.view_command(method)
        data["pages"][method] = {p["trial"]: p["href"] for p in gallery.get(method, ())}
        table, total = breakdown.examples(run, method, each)
        data["methods"][method] = [_numbers(table[c]) for c in shown]
        if len(table) < total:
            notes.append(f"{method}: {len(table)} of {total} trials, the first of each outcome.")
    # "<" is escaped because a "</script>" in a method's name would end the block
    block = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return {"block": block, "notes": notes}


def _numbers(column: pa.ChunkedArray) -> list[Any]:
    values = column.to_pylist()
    if not pa.types.is_floating(column.type):
        return values
    return [None if v is None or not np.isfinite(v) else round(v, 5) for v in values]


FACTS = (
    "protocol", "robot", "trials", "seed", "configuration", "digests", "objects", "versions", "device", "platform",
    "git_commit", "command", "created", "stored", "shard_trials", "hash",
)  # fmt: skip
"""Fields of run.json in the order in which a page shows them."""


def _all_facts(runs: Sequence[Run]) -> list[tuple[str, str]]:
    """Fields of each run.json; once those that are the same in all."""
    each = [(run.folder.resolve().name, dict(_facts(run.header))) for run in runs]
    lines = []
    for key in dict.fromkeys(key for _, facts in each for key in facts):
        values = [(name, facts.get(key, NA)) for name, facts in each]
        if len({value for _, value in values}) == 1:
            lines.append((key, values[0][1]))
        else:
            lines += [(f"{key} ({name})", value) for name, value in values]
    return lines


def _facts(header: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Fields of run.json with dotted names, as text."""

    def walk(prefix: str, value: Any) -> Iterator[tuple[str, str]]:
        if isinstance(value, dict):
            for key, inner in value.items():
                yield from walk(f"{prefix}.{key}" if prefix else key, inner)
        elif isinstance(value, list) and any(isinstance(v, dict) for v in value):
            yield prefix, ", ".join(f"{v.get('name')} ({v.get('split')})" for v in value)
        else:
            yield prefix, " ".join(map(str, value)) if isinstance(value, list) else str(value)

    for key in FACTS:
        if header.get(key) is not None:
            yield from walk(key, header[key])
