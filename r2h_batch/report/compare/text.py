"""Comparisons as Markdown that also reads as plain text, as LaTeX, CSV or JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from r2h_batch.base.registry import NOT_SAID
from r2h_batch.base.table import (
    NA,
    Column,
    Record,
    Table,
    document,
    json_text,
    notes_list,
    of_lines,
    plain,
)
from r2h_batch.report.statistics.aggregate import Rate
from r2h_batch.report.statistics.paired import ALPHA, DRAWS, Comparison, Pair
from r2h_batch.report.statistics.rates import RATES
from r2h_batch.report.statistics.rates import shares as known_shares
from r2h_batch.report.text import MOST_LINES, NOTE_LINES, few_notes, in_words, legend, short_names
from r2h_batch.report.turn import MARK, Turned, about
from r2h_batch.verdicts import SPLITS

FORMATS = ("md", "latex", "csv", "json")

Shares = Mapping[str, Mapping[tuple[str, str], Rate]]
"""Method -> (split, key of `rates.shares`) -> rate."""

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


def _crowded(pairs: Sequence[Pair]) -> list[str]:
    """A note where Holm's correction decides a verdict: in a table of fewer pairs it is another one."""
    if n := sum(pair.alone != pair.verdict for pair in pairs):
        of = f"{n} of {len(pairs)} pairs read otherwise"
        return [f"{of} if compared alone (--method A B), as Holm corrects for all."]
    return []


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
    reads: Mapping[str, str] | None = None,
) -> str:
    """The comparisons as text that ends in a newline.

    Args:
        comparisons: what `compare` gives.
        fmt: one of `FORMATS`.
        origin: where the rows come from; LaTeX writes it as comments.
        notes: what a reader should know about the runs; Markdown and LaTeX write them.
        turns: turn tests of the methods, under their names in the comparisons.
        shares: shares of their rows on these trials.
        reads: method -> what it may read, a word of `READS`; empty where nobody says.
    """
    shares, reads = shares or {}, reads or {}
    if fmt == "md":
        return _md(comparisons, notes, turns, shares, reads)
    if fmt == "latex":
        words = [f"reads: {n} {word or NOT_SAID}" for n, word in reads.items()]
        return _latex(comparisons, origin or {}, [*notes, *words], turns, shares)
    if fmt == "csv":
        return _all_pairs(comparisons, turns, shares, reads).csv()
    if fmt == "json":
        return json_text([_record(c, turns, shares, reads) for c in comparisons])
    raise ValueError(f"unknown format {fmt!r}; allowed are {', '.join(FORMATS)}")


def _record(
    c: Comparison, turns: Sequence[Turned], shares: Shares, reads: Mapping[str, str]
) -> dict[str, Any]:
    own = [test for test in turns if test.group == c.group]
    found = {**asdict(c), "rank": None if c.rank is None else c.rank.tolist()}
    known = {
        method: {name: asdict(rate) for (split, name), rate in rates.items() if split == c.group}
        for method, rates in shares.items()
    }
    found |= {"shares": known} if any(known.values()) else {}
    found |= {"reads": {n: reads[n] or NOT_SAID for n in c.names if n in reads}} if reads else {}
    return found | ({"turns": about(own)} if own else {})


def _shares(shares: Shares) -> Table:
    """Split, method, and each share with its interval and rows."""
    names = [
        n for n in known_shares() if any(n == k for rates in shares.values() for _, k in rates)
    ]
    short, records = short_names(list(shares)), []
    for split in SPLITS:
        for method, rates in shares.items():
            own = {name: rates.get((split, name)) for name in names}
            if any(own.values()):
                record: dict[str, Any] = {"split": split, "method": short[method]}
                for name, r in own.items():
                    ends = (r.percent, r.low, r.high, r.total) if r else [None] * 4
                    keys = (name, f"{name}_low", f"{name}_high", f"{name}_of")
                    record |= zip(keys, ends, strict=True)
                records.append(record)
    form = "{value:.1f} [{low:.0f}, {high:.0f}] {of}"
    columns = [Column("split", "Split", left=True), Column("method", "Method", left=True)]
    columns += [Column(name, RATES[name].heading, form) for name in names]
    return Table(columns, records, title=SHARES_NOTE)


def _marked(c: Comparison, short: Mapping[str, str], turns: Sequence[Turned]) -> dict[str, str]:
    """The short names of a group's methods, with a mark where a turn moves SR by too much."""
    moved = {test.method for test in turns if test.marked and test.group == c.group}
    return {name: short[name] + (f" {MARK}" if name in moved else "") for name in c.names}


def _columns(c: Comparison, shown: Mapping[str, str]) -> list[Column]:
    """What Markdown shows of each pair."""
    return [
        Column("a", "A", lambda r: shown[r["a"]], left=True),
        Column("b", "B", lambda r: shown[r["b"]], left=True),
        Column("difference", "A-B", "{value:+.1f}"),
        Column("ends", f"95 % all {_new(c)}", lambda r: _ends(r["low"], r["high"])),
        Column("few", f"{c.few} new", lambda r: _ends(r["few_low"], r["few_high"], 0)),
        Column("only", "only A/B", lambda r: f"{r['only_a']}/{r['only_b']}"),
        Column("p_holm", "p here", lambda r: _p(r["p_holm"])),
        Column("p_new_holm", "p new", lambda r: _p(r["p_new_holm"])),
        Column("verdict", "A is"),
    ]


def _ranks(c: Comparison, shown: Mapping[str, str], reads: Mapping[str, str]) -> Table:
    """How often each method has each rank, and its worst one."""
    chances = [[f"{100 * p:.0f} %" for p in row] for row in ([] if c.rank is None else c.rank)]
    ranks = dict(zip(c.ranked, chances, strict=True))
    for name, worst in zip(c.ranked, c.worst or (), strict=True):
        without = f" without {worst.without.replace('_', ' ')}" if worst.without else ""
        ranks[name] = [*ranks[name], f"#{worst.rank}{without}"]
    bound = ["bound", *[""] * len(c.ranked)]
    lines = [
        [
            shown[name],
            *([reads[name] or NOT_SAID] if name in reads else []),
            f"{rate:.1f}",
            *ranks.get(name, bound),
        ]
        for name, rate in zip(c.names, c.rates, strict=True)
    ]
    head = ["Method", *(["Reads"] if set(c.names) <= reads.keys() else []), "SR"]
    return of_lines([*head, *(f"#{i + 1}" for i in range(len(c.ranked))), "worst"], lines)


def brief(
    comparisons: Sequence[Comparison],
    notes: Sequence[str] = (),
    turns: Sequence[Turned] = (),
    reads: Mapping[str, str] | None = None,
    more: str = "r2h-batch compare RUN --full",
) -> str:
    """The pairs over all trials, with the difference in each split, in `MOST_LINES` lines. `render` has the rest.

    Args:
        comparisons: what `compare` gives.
        notes: what a reader should know about the runs.
        turns: turn tests of the methods.
        reads: method -> what it may read, a word of `READS`; empty where nobody says.
        more: the command that prints all of it.
    """
    *splits, whole = comparisons
    shown = _marked(whole, short_names(list(whole.names)), turns)
    of_split = {c.group: {(p.a, p.b): p.difference for p in c.pairs} for c in splits}
    records = [
        asdict(p) | {s: own.get((p.a, p.b)) for s, own in of_split.items()} for p in whole.pairs
    ]
    pair, _, ends, _, _, _, p_new, verdict = _columns(whole, shown)[1:]
    columns = [
        *(_columns(whole, shown)[0], pair),
        *([Column("reads", "Reads", lambda r: _both(r, reads or {}), left=True)] if reads else []),
        *(Column(s, f"A-B {s}", "{value:+.1f}") for s in of_split),
        *(Column("difference", f"A-B {whole.group}", "{value:+.1f}"), ends, p_new, verdict),
    ]
    most = MOST_LINES - NOTE_LINES - 5
    left = len(records) - most
    rest = f"{left} more pairs, " if left > 0 else ""
    trials = (
        f"{whole.n} trials ({', '.join(f'{c.n} {c.group}' for c in splits)})"
        if splits
        else f"{whole.n} trials"
    )
    kind = "categories" if whole.new == "categories" else "objects"
    words = few_notes(
        f"95 %, p new: all {kind} (Holm corrected). better: p new < {ALPHA}; better here: these objects.",
        [*_crowded(whole.pairs), *notes],
        f"{rest}each split, ranks, shares, p here: {more}",
    )
    title = f"{trials}, paired on the trial id; A-B: difference of SR in points."
    return document([Table(columns, records[:most], title=title), words])


def _both(pair: Record, reads: Mapping[str, str]) -> str:
    """What the methods of a pair may read: one word, or both."""
    a, b = (reads.get(pair[side]) or NOT_SAID for side in "ab")
    return a if a == b else f"{a} / {b}"


def _md(
    comparisons: Sequence[Comparison],
    notes: Sequence[str],
    turns: Sequence[Turned],
    shares: Shares,
    reads: Mapping[str, str],
) -> str:
    short = short_names([name for c in comparisons for name in c.names])
    parts: list[Table | str] = []
    for c in comparisons:
        shown = _marked(c, short, turns)
        title = f"{c.group}: {c.n} trials, paired on the trial id"
        parts.append(Table(_columns(c, shown), [asdict(p) for p in c.pairs], title=title))
        if c.rank is not None:
            parts.append(_ranks(c, shown, reads))
    columns = "A-B: difference of SR in points. #1: how often a method has that rank."
    crowded = _crowded([pair for c in comparisons for pair in c.pairs])
    words = [*map(plain, legend(short)), *notes, columns, *_notes(comparisons), *crowded]
    return document([*parts, _shares(shares), notes_list(words)])


def _latex(
    comparisons: Sequence[Comparison],
    origin: Mapping[str, str],
    notes: Sequence[str],
    turns: Sequence[Turned],
    shares: Shares,
) -> str:
    """All pairs over both columns of a page; what is decided for new objects or categories too is bold."""
    short = short_names([name for c in comparisons for name in c.names])
    records: list[dict[str, Any]] = []
    for c in comparisons:
        shown = _marked(c, short, turns)
        for k, p in enumerate(c.pairs):
            names = {"group": "" if k else c.group, "a": shown[p.a], "b": shown[p.b]}
            records.append(asdict(p) | names)
    bold = {(k, "verdict") for k, r in enumerate(records) if r["verdict"] in ("better", "worse")}
    words = [*legend(short), *notes, *_notes(comparisons)]
    decided = f"bold: decided for new ones too, alpha {ALPHA}"
    pairs = Table(
        (
            *(Column("group", tex=" ", left=True), Column("a", tex="$A$", left=True)),
            Column("b", tex="$B$", left=True),
            Column("difference", form="{value:+.1f}", tex="$A-B$"),
            Column("ends", form=_tex_ends, tex=r"95\,\%"),
            *(Column("only_a", tex="only $A$"), Column("only_b", tex="only $B$")),
            Column("p_holm", form=lambda r: _tex_p(r["p_holm"]), tex="$p$ here"),
            Column("p_new_holm", form=lambda r: _tex_p(r["p_new_holm"]), tex="$p$ new"),
            Column("verdict", tex="$A$ is", left=True),
        ),
        records,
        notes=[*(f"{key}: {value}" for key, value in in_words(origin).items()), *words, decided],
        bold=frozenset(bold),
        groups=[("", len(c.pairs)) for c in comparisons],
    )
    of_rows = _shares(shares)
    below = [replace(of_rows, notes=[SHARES_NOTE])] if of_rows.records else []
    return "\n".join(t.latex() for t in (pairs, *below)) + "\n"


def _tex_ends(pair: Record) -> str:
    known = pair["low"] is not None and pair["high"] is not None
    return f"[{pair['low']:+.1f}, {pair['high']:+.1f}]" if known else NA


def _tex_p(p: float | None) -> str:
    return NA if p is None else "<0.001" if p < 0.001 else f"{p:.3f}"


def _all_pairs(
    comparisons: Sequence[Comparison],
    turns: Sequence[Turned],
    shares: Shares,
    reads: Mapping[str, str],
) -> Table:
    """One row for each group and pair, with both rates and the share of draws in which each method
    is first; shares of rows where there are any; where there are turn tests, with the largest move of each
    method's rate."""
    records = []
    shown = [
        n for n in known_shares() if any(n == k for rates in shares.values() for _, k in rates)
    ]
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
            said = {
                f"reads_{s}": reads.get(m) or NOT_SAID for s, m in (("a", pair.a), ("b", pair.b))
            }
            pair_fields |= said if reads else {}
            records.append(pair_fields | rates | firsts | of_rows | moves)
    return Table((), records)
