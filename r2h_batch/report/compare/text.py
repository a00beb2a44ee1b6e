"""Comparisons as Markdown that also reads as plain text, as LaTeX, CSV or JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from r2h_batch.report.statistics.aggregate import Rate
from r2h_batch.report.statistics.paired import ALPHA, DRAWS, Comparison, Pair
from r2h_batch.report.statistics.shares import SHARES
from r2h_batch.report.text import (
    NA,
    aligned,
    csv_text,
    json_text,
    legend,
    notes_list,
    plain,
    short_names,
    tex,
    tex_comments,
    tex_number,
    tex_table,
)
from r2h_batch.report.turn import MARK, Turned, about
from r2h_batch.verdicts import SPLITS

FORMATS = ("md", "latex", "csv", "json")

Shares = Mapping[str, Mapping[tuple[str, str], Rate]]
"""Method -> (split, key of `SHARES`) -> rate."""

SHARES_NOTE = "Shares of rows on these trials, percent [95 %, Wilson] and rows; no part of SR."

NOTES = (
    "p here: McNemar's exact test, for these objects. p new: a t test over {1}, for new ones. Holm corrected both over the"
    " pairs of their table.",
    "95 % all {0}: a t interval over {1}, of the mean of all {1}. {4} new: where the mean of {4} new {1} lies (95 %). Neither is"
    " corrected for the other pairs.",
    f"#1: a bootstrap over {{2}} ({DRAWS} draws), for new {{1}}.",
    "worst: a method's worst rank with one {3} left out, and which.",
    f"better, worse: decided for new {{1}} (p new below {ALPHA}). better here, worse here: decided for these objects only. tied:"
    " not decided.",
)


def _notes(comparisons: Sequence[Comparison]) -> list[str]:
    """The notes with the words for what new ones are drawn of: objects, or categories of several."""
    if any(c.new == "categories" for c in comparisons):
        words = ("cat.", "categories", "categories and their objects", "category")
    else:
        words = ("obj.", "objects", "objects", "object")
    few = next((c.few for c in comparisons), "")
    return [note.format(*words, few) for note in NOTES]


def _new(comparison: Comparison) -> str:
    return "cat." if comparison.new == "categories" else "obj."


def p_words(pair: Pair) -> str:
    """The corrected p values of a pair: for these objects, and for new ones."""
    return f"{_p(pair.p_holm)} here, {_p(pair.p_new_holm)} new"


def _p(p: float | None) -> str:
    return NA if p is None else f"{p:.2g}" if p >= 0.001 else f"{p:.0e}"


def _ends(low: float | None, high: float | None, digits: int = 1) -> str:
    known = low is not None and high is not None
    return f"{low:+.{digits}f} to {high:+.{digits}f}" if known else NA


def render(
    comparisons: Sequence[Comparison],
    fmt: str = "md",
    *,
    origin: Mapping[str, str] | None = None,
    notes: Sequence[str] = (),
    turns: Sequence[Turned] = (),
    shares: Shares | None = None,
) -> str:
    """The comparisons as text that ends in a newline.

    Args:
        comparisons: what `compare` gives.
        fmt: one of `FORMATS`.
        origin: where the rows come from; LaTeX writes it as comments.
        notes: what a reader should know about the runs; Markdown and LaTeX write them.
        turns: turn tests of the methods, under their names in the comparisons.
        shares: shares of their rows on these trials.
    """
    shares = shares or {}
    if fmt == "md":
        return _md(comparisons, notes, turns, shares)
    if fmt == "latex":
        return _latex(comparisons, origin or {}, notes, turns, shares)
    if fmt == "csv":
        return _csv(comparisons, turns, shares)
    if fmt == "json":
        return json_text([_record(c, turns, shares) for c in comparisons])
    raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(FORMATS)}")


def _record(c: Comparison, turns: Sequence[Turned], shares: Shares) -> dict[str, Any]:
    own = [test for test in turns if test.group == c.group]
    found = {**asdict(c), "rank": None if c.rank is None else c.rank.tolist()}
    known = {
        method: {name: asdict(rate) for (split, name), rate in rates.items() if split == c.group}
        for method, rates in shares.items()
    }
    found |= {"shares": known} if any(known.values()) else {}
    return found | ({"turns": about(own)} if own else {})


def _share_lines(shares: Shares) -> tuple[list[str], list[list[str]]]:
    """Headings and lines of a table: split, method, and each share with its interval and rows."""
    names = [n for n in SHARES if any(n == k for rates in shares.values() for _, k in rates)]
    short, lines = short_names(list(shares)), []
    for split in SPLITS:
        for method, rates in shares.items():
            own = [rates.get((split, name)) for name in names]
            cells = [
                f"{r.percent:.1f} [{r.low:.0f}, {r.high:.0f}] {r.total}" if r else NA for r in own
            ]
            if any(own):
                lines.append([split, short[method], *cells])
    return ["Split", "Method", *(SHARES[name].heading for name in names)], lines


def _marked(c: Comparison, short: Mapping[str, str], turns: Sequence[Turned]) -> dict[str, str]:
    """The short names of a group's methods, with a mark where a turn moves SR by too much."""
    moved = {test.method for test in turns if test.marked and test.group == c.group}
    return {name: short[name] + (f" {MARK}" if name in moved else "") for name in c.names}


def _md(
    comparisons: Sequence[Comparison],
    notes: Sequence[str],
    turns: Sequence[Turned],
    shares: Shares,
) -> str:
    short = short_names([name for c in comparisons for name in c.names])
    parts = []
    for c in comparisons:
        shown = _marked(c, short, turns)
        head = ["A", "B", "A-B", f"95 % all {_new(c)}", f"{c.few} new", "only A/B"]
        head += ["p here", "p new", "A is"]
        parts.append(f"{c.group}: {c.n} trials, paired on the trial id")
        lines = []
        for pair in c.pairs:
            ends = [_ends(pair.low, pair.high), _ends(pair.few_low, pair.few_high, 0)]
            names = [plain(shown[pair.a]), plain(shown[pair.b])]
            cells = [f"{pair.difference:+.1f}", *ends, f"{pair.only_a}/{pair.only_b}"]
            p = [_p(pair.p_holm), _p(pair.p_new_holm)]
            lines.append([*names, *cells, *p, pair.verdict])
        parts.append(aligned(head, lines, 2))
        if c.rank is not None:
            chances = [[f"{100 * p:.0f} %" for p in row] for row in c.rank]
            ranks = dict(zip(c.ranked, chances, strict=True))
            for name, worst in zip(c.ranked, c.worst or (), strict=True):
                without = f" without {worst.without.replace('_', ' ')}" if worst.without else ""
                ranks[name] = [*ranks[name], f"#{worst.rank}{without}"]
            bound = ["bound", *[""] * len(c.ranked)]
            table = [
                [plain(shown[name]), f"{rate:.1f}", *ranks.get(name, bound)]
                for name, rate in zip(c.names, c.rates, strict=True)
            ]
            places = [f"#{i + 1}" for i in range(len(c.ranked))]
            parts.append(aligned(["Method", "SR", *places, "worst"], table, 1))
    head, rows = _share_lines(shares)
    if rows:
        rows = [[split, plain(method), *cells] for split, method, *cells in rows]
        parts += [SHARES_NOTE, aligned(head, rows, 2)]
    columns = "A-B: difference of SR in points. #1: how often a method has that rank."
    parts.append(notes_list([*map(plain, legend(short)), *notes, columns, *_notes(comparisons)]))
    return "\n\n".join(parts) + "\n"


def _latex(
    comparisons: Sequence[Comparison],
    origin: Mapping[str, str],
    notes: Sequence[str],
    turns: Sequence[Turned],
    shares: Shares,
) -> str:
    """All pairs over both columns of a page; what is decided for new objects or categories too is bold."""
    short = short_names([name for c in comparisons for name in c.names])
    groups = []
    for c in comparisons:
        shown = _marked(c, short, turns)
        rows: list[str] = []
        for pair in c.pairs:
            known = pair.low is not None and pair.high is not None
            ends = f"[{pair.low:+.1f}, {pair.high:+.1f}]" if known else NA
            bold = pair.verdict in ("better", "worse")
            word = rf"\textbf{{{pair.verdict}}}" if bold else pair.verdict
            p = [_tex_p(pair.p_holm), _tex_p(pair.p_new_holm)]
            names = ["" if rows else c.group, tex(shown[pair.a]), tex(shown[pair.b])]
            counts = [str(pair.only_a), str(pair.only_b)]
            cells = [*names, f"{pair.difference:+.1f}", ends, *counts, *p, word]
            rows.append(" & ".join(cells) + r" \\")
        groups.append(rows)
    signed = tex_number(3, 1).replace("3.1", "+3.1")
    spec = ["l", "l", "l", signed, "c", "r", "r", *[tex_number(1, 3)] * 2, "l"]
    head = ["", "$A$", "$B$", "{$A-B$}", r"95\,\%", "only $A$", "only $B$"]
    head += ["{$p$ here}", "{$p$ new}", "$A$ is"]
    decided = f"bold: decided for new ones too, alpha {ALPHA}"
    comments = tex_comments(origin, [*legend(short), *notes, *_notes(comparisons), decided])
    tables = tex_table(spec, head, groups)
    columns, lines = _share_lines(shares)
    if lines:
        cells = [" & ".join(map(tex, line)) + r" \\" for line in lines]
        tables += [
            f"% {SHARES_NOTE}",
            *tex_table(["l"] * len(columns), [*map(tex, columns)], [cells]),
        ]
    return "\n".join([*comments, *tables]) + "\n"


def _tex_p(p: float | None) -> str:
    return "{" + NA + "}" if p is None else r"{$<$0.001}" if p < 0.001 else f"{p:.3f}"


def _csv(comparisons: Sequence[Comparison], turns: Sequence[Turned], shares: Shares) -> str:
    """One row for each group and pair, with both rates and the share of draws in which each method
    is first; shares of rows where there are any; where there are turn tests, with the largest move of each
    method's rate."""
    records = []
    shown = [n for n in SHARES if any(n == k for rates in shares.values() for _, k in rates)]
    for c in comparisons:
        rate = dict(zip(c.names, c.rates))
        ranks = [] if c.rank is None else c.rank.tolist()
        first = {name: row[0] for name, row in zip(c.ranked, ranks)}
        most = {test.method: test.most.points for test in turns if test.group == c.group}
        for pair in c.pairs:
            rates = {"sr_a": rate[pair.a], "sr_b": rate[pair.b]}
            firsts = {"first_a": first.get(pair.a), "first_b": first.get(pair.b)}
            moves = {"turn_a": most.get(pair.a), "turn_b": most.get(pair.b)} if turns else {}
            of_rows = {
                f"{name}_{side}": rate and rate.percent
                for name in shown
                for side, method in (("a", pair.a), ("b", pair.b))
                for rate in [shares.get(method, {}).get((c.group, name))]
            }
            pair_fields = {"group": c.group, "n": c.n, **asdict(pair), "few": c.few}
            records.append(pair_fields | rates | firsts | of_rows | moves)
    return csv_text(records)
