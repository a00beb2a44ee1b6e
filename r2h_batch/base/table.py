"""The value of every table that is printed: columns, records and notes, and the text of it in five formats.

People read `columns`, each with a heading and a way to say a cell, in Markdown (which also reads as plain text), LaTeX
and HTML. Programs read `records`: CSV and JSON have each of their values under its own name, unrounded. All text of the
records is escaped in each format; headings, forms and notes are the author's.
"""

import csv
import io
import json
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any

from r2h_batch.base.io.write import csv_cell

NA = "n/a"
"""A cell in which nothing is defined."""

TERMINAL = 100
"""Characters in a line of a terminal."""

NOTE = 98
"""Characters in a line of a note."""

TEXT = "{value}"
PERCENT = "{value:.1f}"
INTERVAL = "{low:.1f}-{high:.1f}"
RATE = "{value:.1f} [{low:.1f}, {high:.1f}]"

Record = Mapping[str, Any]
Form = str | Callable[[Record], str]


@dataclass(frozen=True)
class Column:
    """What people see of one value of the records.

    Attributes:
        name: its key.
        heading: in Markdown and HTML; empty: the name.
        form: how a cell is said. {value} is the record's value under `name`, {low}, {high} and {of} are those under
            NAME_low, NAME_high (its interval) and NAME_of (of how many it is); or a function of the record.
        scale: shown number / stored number, of value and interval.
        none: said where a value that the form names is not there.
        left: aligned to the left, as words are; numbers stand to the right.
        group: heading above neighbours that have the same one; LaTeX writes it.
        tex: heading in LaTeX, as LaTeX; a line for each line of the head. Empty: the heading.
        title: what HTML says when the heading is pointed at.
        about: key of what HTML says when a cell is pointed at.
        own: what a cell says is the author's own: Markdown does not escape it.
        ends: HTML and LaTeX may write the interval below the number.
        bar: HTML draws it too, on a scale to 100.
    """

    name: str
    heading: str = ""
    form: Form = TEXT
    scale: float = 1.0
    none: str = NA
    left: bool = False
    group: str = ""
    tex: str = ""
    title: str = ""
    about: str = ""
    own: bool = False
    ends: bool = False
    bar: bool = False

    @property
    def head(self) -> str:
        """The heading."""
        return self.heading or self.name

    def say(self, record: Record) -> str:
        """The cell of a record, not escaped."""
        if callable(self.form):
            return self.form(record)
        known = {"value": record.get(self.name)}
        known |= {end: record.get(f"{self.name}_{end}") for end in ("low", "high", "of")}
        used: dict[str, Any] = {k: v for k, v in known.items() if f"{{{k}" in self.form}
        if any(value is None for value in used.values()):
            return self.none
        if self.scale != 1.0:
            used = {k: v if k == "of" else self.scale * v for k, v in used.items()}
        return self.form.format(**used)

    def is_text(self, record: Record) -> bool:
        """Whether the cell holds words of the record, which may be anybody's."""
        return not self.own and (callable(self.form) or isinstance(record.get(self.name), str))


@dataclass(frozen=True)
class Table:
    """Columns for people, records for programs, and what must be known about both.

    Attributes:
        columns: what Markdown, LaTeX and HTML show, in order.
        records: a row each, with the same keys; None is what is not defined.
        notes: a line each.
        title: what it is of; stands above the table.
        bold: (place of the record, name of the column) of cells that LaTeX and HTML print bold.
        groups: heading, as LaTeX, and number of records of each part between two rules; empty: one part without a heading.
    """

    columns: Sequence[Column]
    records: Sequence[Record]
    notes: Sequence[str] = ()
    title: str = ""
    bold: frozenset[tuple[int, str]] = frozenset()
    groups: Sequence[tuple[str, int]] = ()

    def md(self) -> str:
        """Markdown that also reads well as plain text: title, table and notes, without a last newline."""
        lines = [
            [plain(said) if c.is_text(r) else said for c in self.columns for said in [c.say(r)]]
            for r in self.records
        ]
        table = _aligned([c.head for c in self.columns], lines, [c.left for c in self.columns])
        return "\n\n".join(filter(None, (self.title, table, notes_list(self.notes))))

    def csv(self) -> str:
        """Every value of the records; what is not defined is `n/a`, and no text is run as a formula."""
        text = io.StringIO()
        if self.records:
            writer = csv.DictWriter(text, list(self.records[0]), lineterminator="\n")
            writer.writeheader()
            for record in self.records:
                writer.writerow({k: NA if v is None else csv_cell(v) for k, v in record.items()})
        return text.getvalue()

    def json(self, **beside: Any) -> str:
        """Every value of the records as `rows`, the notes if there are any, and what stands beside them."""
        notes = {"notes": list(self.notes)} if self.notes else {}
        return json_text({"format": 1, **beside, "rows": list(self.records), **notes})

    def latex(self, *, intervals: bool = False) -> str:
        """A tabular with booktabs and siunitx; notes are comments above it. Caption, label and the table environment are the
        paper's.

        Args:
            intervals: below the numbers of columns with `ends`, in small type.
        """
        kinds = [_tex_kind(c, self.records) for c in self.columns]
        # columns stand nearer than LaTeX's 12 pt: eleven fit the width of two columns of a paper, more of them nearly
        nearer = 3 if len(self.columns) <= _FIT else 7
        spec = rf"@{{\extracolsep{{-{nearer}pt}}}}" + "".join(kinds) + "@{}"
        lines = [rf"\begin{{tabular}}{{{spec}}}", r"\toprule", *_tex_head(self.columns)]
        first = 0
        for heading, size in self.groups or [("", len(self.records))]:
            lines.append(r"\midrule")
            if heading:
                lines.append(rf"\multicolumn{{{len(self.columns)}}}{{@{{}}l}}{{{heading}}} \\")
            for place in range(first, first + size):
                lines += self._tex_lines(place, kinds, intervals)
            first += size
        return "\n".join([*tex_comments(self.notes), *lines, r"\bottomrule", r"\end{tabular}"])

    def _tex_lines(self, place: int, kinds: Sequence[str], intervals: bool) -> list[str]:
        record, cells = self.records[place], []
        for column, kind in zip(self.columns, kinds, strict=True):
            said = column.say(record)
            bold = r"\bfseries " if (place, column.name) in self.bold else ""
            number = kind.startswith("S") and _NUMBER.fullmatch(said)
            braced = f"{{{tex(said)}}}" if kind.startswith("S") else tex(said)
            cells.append(bold + (said if number else braced))
        lines = [" & ".join(cells) + r" \\"]
        if intervals:
            small = replace_forms(self.columns, "[{low:.1f}, {high:.1f}]")
            ends = [c.say(record) if c.ends else "" for c in small]
            ends = [rf"{{\scriptsize {e}}}" if e else "" for e in ends]
            lines.append(" & ".join(ends) + r" \\[2pt]")
        return lines

    def html(
        self, *, name: str = "", sortable: bool = False, least: int = 0, rows: str = ""
    ) -> str:
        """A table element, title before and notes behind it.

        Args:
            name: the element's id.
            sortable: headings and cells say (`data-sort`, `data-v`) how a script sorts them.
            rows: key of the records whose first word is the class of a row.
            least: numbers with an interval that are of fewer than this are grey and say of how many they are.
        """
        sort = " data-sort" if sortable else ""
        head = "".join(
            f"<th{_left(c)}{sort}{_attribute('title', c.title)}>{escape(c.head)}</th>"
            for c in self.columns
        )
        body = "".join(
            f"<tr{_attribute('class', str(r.get(rows, '')).partition(' ')[0])}>"
            f"{''.join(self._html_cell(c, k, sortable, least) for c in self.columns)}</tr>\n"
            for k, r in enumerate(self.records)
        )
        opening = f"<table{_attribute('id', name)}{' data-sortable' if sortable else ''}>"
        thead = f"<thead><tr>{head}</tr></thead>" if any(c.head for c in self.columns) else ""
        title = f"<p><b>{escape(self.title)}</b></p>" if self.title else ""
        notes = "".join(f"<li>{escape(note)}</li>" for note in self.notes)
        behind = f"<ul class=notes>{notes}</ul>" if notes else ""
        return f"{title}{opening}{thead}<tbody>{body}</tbody></table>{behind}"

    def _html_cell(self, column: Column, place: int, sortable: bool, least: int) -> str:
        record = self.records[place]
        said, value = escape(column.say(record)), record.get(column.name)
        of = record.get(f"{column.name}_of")
        about = record.get(column.about) or ""
        attributes = _left(column) + _attribute("title", about)
        if column.ends and of and of < least:
            attributes = f' class=few title="of {of}"'
        if sortable and not isinstance(value, str):
            attributes += f' data-v="{-1 if value is None else round(value, 4):g}"'
        if (place, column.name) in self.bold:
            said = f"<b>{said}</b>"
        low, high = (record.get(f"{column.name}_{end}") for end in ("low", "high"))
        if column.ends and low is not None and high is not None:
            said += f"<small>{low:.1f}\u2013{high:.1f}</small>"
            if column.bar:
                place_of = f"left:{low:.1f}%;width:calc({high:.1f}% - {low:.1f}%)"
                said += f'<span class=interval><i style="{place_of}"></i></span>'
        return f"<td{attributes}>{said}</td>"


def of_lines(
    head: Sequence[str],
    lines: Iterable[Sequence[Any]],
    *,
    left: int = 1,
    title: str = "",
    own: bool = False,
) -> Table:
    """A table of what is said already, cell by cell.

    Args:
        head: headings, all different.
        lines: cells of each row.
        left: this many first columns are aligned to the left.
        title: stands above it.
        own: what the other columns say is the author's own.
    """
    columns = [Column(word, left=i < left, own=own and i >= left) for i, word in enumerate(head)]
    return Table(columns, [dict(zip(head, line, strict=True)) for line in lines], title=title)


def replace_forms(columns: Iterable[Column], form: Form) -> list[Column]:
    """The columns with another form."""
    return [replace(c, form=form, none="") for c in columns]


def document(parts: Iterable[Table | str]) -> str:
    """Tables and sentences as Markdown that ends in a newline; tables without records are left out."""
    kept = (p if isinstance(p, str) else p.md() for p in parts if isinstance(p, str) or p.records)
    return "\n\n".join(filter(None, kept)) + "\n"


def json_text(data: Any) -> str:
    """The data as JSON that ends in a newline and holds no NaN."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


# Markdown


def _aligned(headings: Sequence[str], lines: Sequence[Sequence[str]], left: Sequence[bool]) -> str:
    """The table; wider than a terminal it loses its outer pipes, and if it is still too wide also the spaces around the inner
    ones."""
    widths = [max(3, *(len(line[i]) for line in (headings, *lines))) for i in range(len(headings))]
    sides = [str.ljust if is_left else str.rjust for is_left in left]

    def text(cells: Sequence[str], between: str) -> str:
        return between.join(side(c, w) for side, c, w in zip(sides, cells, widths, strict=True))

    def rule(space: int) -> str:
        return "|".join(
            "-" * (w + space) if is_left else "-" * (w + space - 1) + ":"
            for is_left, w in zip(left, widths, strict=True)
        )

    wide = [f"| {text(headings, ' | ')} |", f"|{rule(2)}|"]
    wide += [f"| {text(line, ' | ')} |" for line in lines]
    if len(wide[0]) <= TERMINAL:
        return "\n".join(wide)
    if len(wide[0]) - 4 <= TERMINAL:
        return "\n".join(line[2:-2] for line in wide)
    return "\n".join([text(headings, "|"), rule(0), *(text(line, "|") for line in lines)])


def plain(text: str) -> str:
    """A name as Markdown shows it: nothing in it is markup or HTML, and a pipe ends no cell."""
    return re.sub(
        r"[\\|<`*~\[]|&(?=#?\w+;)|(?<![^\W_])_|_(?![^\W_])", lambda found: "\\" + found[0], text
    )


def notes_list(notes: Iterable[str]) -> str:
    """Notes as a Markdown list in lines of at most `NOTE` characters."""
    how: Any = {"initial_indent": "- ", "subsequent_indent": "  ", "break_long_words": False}
    words = (" ".join(note.split()) for note in notes)
    return "\n".join(textwrap.fill(w, NOTE, break_on_hyphens=False, **how) for w in words)


# LaTeX: the widths fit an IEEE page (252 pt a column, 516 pt the text); tests/report/test_latex.py compiles them.

PACKAGES = r"\usepackage{booktabs,siunitx}"

_FIT = 11
"""Columns of Table I as the paper has them, and one share."""

_NUMBER = re.compile(r"([+-]?)(\d+)(?:\.(\d+))?")

_TEX = {c: "\\" + c for c in "&%$#_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}


def tex(text: str) -> str:
    """Text as LaTeX prints it. Characters beyond ASCII need an engine and a font that have them."""
    return "".join(_TEX.get(c, c) for c in text)


def tex_comments(notes: Iterable[str]) -> list[str]:
    """What a tabular needs, and notes, as LaTeX comments. No note can end its comment: line ends go."""
    return [f"% {' '.join(line.split())}" for line in (f"needs {PACKAGES}", *notes)]


def _tex_kind(column: Column, records: Iterable[Record]) -> str:
    """The column's type: numbers are aligned at the point; bold ones (`\\bfseries 1.2`) stay aligned."""
    numbers = [n for n in (_NUMBER.fullmatch(column.say(r)) for r in records) if n]
    if column.left or not numbers:
        return "l" if column.left else "c"
    sign = "+" if any(n[1] for n in numbers) else ""
    digits, decimals = (max(len(n[k] or "") for n in numbers) for k in (2, 3))
    return f"S[table-format={sign}{digits}.{decimals},detect-weight,mode=text]"


def _tex_head(columns: Sequence[Column]) -> list[str]:
    """Lines of the head: groups over their columns, then the headings."""
    lines, rules, cells = [], [], []
    if any(c.group for c in columns):
        first = 0
        while first < len(columns):
            group, last = columns[first].group, first + 1
            while group and last < len(columns) and columns[last].group == group:
                last += 1
            wide = rf"\multicolumn{{{last - first}}}{{c}}{{{group}}}"
            cells.append(wide if last - first > 1 else f"{{{group}}}" if group else "")
            if last - first > 1:
                rules.append((first + 1, last))
            first = last
        lines.append(" & ".join(cells) + r" \\")
        ends = ["(lr)" if last < len(columns) else "(l)" for _, last in rules]
        drawn = (f"{{{a}-{b}}}" for a, b in rules)
        lines.append("".join(rf"\cmidrule{e}{d}" for e, d in zip(ends, drawn, strict=True)))
    heads = [(c.tex or tex(c.head)).split("\n") for c in columns]
    for k in range(max(map(len, heads))):
        shown = [h[k] if k < len(h) else "" for h in heads]
        lines.append(
            " & ".join(
                word if c.left or not word else f"{{{word}}}"
                for c, word in zip(columns, shown, strict=True)
            )
            + r" \\"
        )
    return [line for line in lines if line]


# HTML


def _left(column: Column) -> str:
    return " class=l" if column.left else ""


def _attribute(name: str, value: str) -> str:
    return f' {name}="{escape(value)}"' if value else ""
