"""Comparisons as Markdown that also reads as plain text, as LaTeX, CSV or JSON."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from r2h_batch.io.write import csv_cell
from r2h_batch.report import latex
from r2h_batch.report.text import NA, aligned, legend, plain, short_names, wrapped
from r2h_batch.statistics.paired import ALPHA, DRAWS, Comparison, Pair

FORMATS = ("md", "latex", "csv", "json")

NOTES = (
    "McNemar's exact test speaks about these objects; the interval of the difference in points and the ranks come from"
    f" drawing the objects again ({DRAWS} draws, percentiles) and speak about new ones. Holm: over all pairs.",
    "better, worse: both decide. here: decided for these objects, not for new ones. tied: not decided.",
)


def render(
    comparisons: Sequence[Comparison],
    fmt: str = "md",
    *,
    origin: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """The comparisons as text that ends in a newline; `fmt` is one of `FORMATS`."""
    if fmt == "md":
        return _md(comparisons, notes)
    if fmt == "latex":
        return _latex(comparisons, origin or {}, notes)
    if fmt == "csv":
        return _csv(comparisons)
    if fmt == "json":
        records = [
            {**asdict(c), "rank": None if c.rank is None else c.rank.tolist()} for c in comparisons
        ]
        return json.dumps(records, indent=1, allow_nan=False) + "\n"
    raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(FORMATS)}")


def _interval(pair: Pair) -> str:
    return NA if pair.low is None or pair.high is None else f"{pair.low:+.1f} to {pair.high:+.1f}"


def _md(comparisons: Sequence[Comparison], notes: Sequence[str]) -> str:
    short = short_names([name for c in comparisons for name in c.names])
    parts = []
    for c in comparisons:
        parts.append(f"{c.group}: {c.n} trials, paired on the trial id")
        lines = [
            [
                plain(short[pair.a]),
                plain(short[pair.b]),
                f"{pair.difference:+.1f}",
                _interval(pair),
                f"{pair.only_a}/{pair.only_b}",
                f"{pair.p_holm:.2g}",
                pair.verdict,
            ]
            for pair in c.pairs
        ]
        parts.append(
            aligned(["A", "B", "A-B", "95 % new obj.", "only A/B", "Holm p", "A is"], lines, 2)
        )
        if c.rank is not None:
            ranks = [[f"{100 * p:.0f} %" for p in row] for row in c.rank]
            table = [
                [plain(short[n]), f"{r:.1f}", *cells]
                for n, r, cells in zip(c.names, c.rates, ranks)
            ]
            parts.append(
                aligned(["Method", "SR", *(f"#{i + 1}" for i in range(len(c.names)))], table, 1)
            )
    told = [*map(plain, legend(short)), *notes]
    told.append(
        "A-B: difference of SR in points. Holm p: McNemar's, over all pairs. #1: how often a method has that rank."
    )
    parts.append("\n".join(wrapped(note) for note in (*told, *NOTES)))
    return "\n\n".join(parts) + "\n"


def _latex(
    comparisons: Sequence[Comparison], origin: Mapping[str, str], notes: Sequence[str]
) -> str:
    """All pairs over both columns of a page; undecided ones stay grey words, decided ones bold."""
    short = short_names([name for c in comparisons for name in c.names])
    groups = []
    for c in comparisons:
        rows: list[str] = []
        for pair in c.pairs:
            ends = (
                NA
                if pair.low is None or pair.high is None
                else f"[{pair.low:+.1f}, {pair.high:+.1f}]"
            )
            word = (
                rf"\textbf{{{pair.verdict}}}"
                if pair.verdict in ("better", "worse")
                else pair.verdict
            )
            p = r"{$<$0.001}" if pair.p_holm < 0.001 else f"{pair.p_holm:.3f}"
            names = [latex.escaped(short[pair.a]), latex.escaped(short[pair.b])]
            counts = [str(pair.only_a), str(pair.only_b)]
            cells = [
                c.group if not rows else "",
                *names,
                f"{pair.difference:+.1f}",
                ends,
                *counts,
                p,
                word,
            ]
            rows.append(" & ".join(cells) + r" \\")
        groups.append(rows)
    spec = [
        "l",
        "l",
        "l",
        latex.number(3, 1).replace("3.1", "+3.1"),
        "c",
        "r",
        "r",
        latex.number(1, 3),
        "l",
    ]
    head = [
        "",
        "$A$",
        "$B$",
        "{$A-B$}",
        r"95\,\%",
        "only $A$",
        "only $B$",
        "{$p$ (Holm)}",
        "$A$ is",
    ]
    said = [*legend(short), *notes, *NOTES, f"bold: decided for new objects too, alpha {ALPHA}"]
    return "\n".join([*latex.comments(origin, said), *latex.table(spec, head, groups)]) + "\n"


def _csv(comparisons: Sequence[Comparison]) -> str:
    """One row for each group and pair, with both rates and the share of draws in which each method
    is first."""
    text = io.StringIO()
    records = []
    for c in comparisons:
        rate = dict(zip(c.names, c.rates))
        first = (
            dict.fromkeys(c.names) if c.rank is None else dict(zip(c.names, c.rank[:, 0].tolist()))
        )
        for pair in c.pairs:
            of_both = {
                "sr_a": rate[pair.a],
                "sr_b": rate[pair.b],
                "first_a": first[pair.a],
                "first_b": first[pair.b],
            }
            records.append({"group": c.group, "n": c.n, **asdict(pair), **of_both})
    if records:
        writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(
            {k: NA if v is None else csv_cell(v) for k, v in r.items()} for r in records
        )
    return text.getvalue()
