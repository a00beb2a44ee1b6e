"""Formats of a table: Markdown that also reads as plain text, LaTeX, CSV and JSON."""

import csv
import io
import json
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from r2h_batch.base.io.write import csv_cell
from r2h_batch.report.statistics.aggregate import wilson_interval

NA = "n/a"
"""A cell in which nothing is defined."""

TERMINAL = 100
"""Characters in a line of a terminal."""

NOTE = 98
"""Characters in a line of a note."""

SHORT = 16
"""Characters of a short method name: `Contact-Handover` has as many."""
SHORT_FOLDER = 9
"""Characters of its run's folder, where that stands before it: `baselines` has as many."""


def short_names(methods: Sequence[str]) -> dict[str, str]:
    """Shorten the names of methods for tables.

    A name first loses what it says in brackets (the stand-in of a network, the noise), then its
    middle; a run's folder before it loses its end. If it then equals another one, it gets a number.

    Args:
        methods: names; one may stand there several times.

    Returns:
        Full name -> a name of at most `SHORT` characters, or FOLDER/NAME with at most `SHORT_FOLDER` for the folder.
        All short names differ.
    """
    names: dict[str, str] = {}
    for method in dict.fromkeys(methods):
        plain_name = method.partition(" (")[0].strip() or method
        folder, slash, own = (
            plain_name.rpartition("/") if len(plain_name) > SHORT else ("", "", plain_name)
        )
        before = (
            folder if len(folder) <= SHORT_FOLDER else f"{folder[: SHORT_FOLDER - 2]}.."
        ) + slash
        short = before + (own if len(own) <= SHORT else f"{own[:9]}..{own[-5:]}")
        for number in range(2, len(methods) + 2):
            if short not in names.values():
                break
            short = f"{before}{own[: SHORT - 1 - len(str(number))]}#{number}"
        names[method] = short
    return names


def legend(names: Mapping[str, str]) -> list[str]:
    """`short: full name` of every name that was shortened."""
    return [f"{short}: {method}" for method, short in names.items() if short != method]


def percent_text(hits: np.ndarray) -> str:
    """Share of the true ones in percent; `-` of none."""
    return f"{100 * float(hits.mean()):.1f}" if len(hits) else "-"


def rate_text(hits: np.ndarray) -> str:
    """`percent_text` with its 95 % Wilson interval."""
    if not len(hits):
        return "-"
    low, high = wilson_interval(hits.sum(), len(hits))
    return f"{percent_text(hits)} [{100 * float(low):.1f}, {100 * float(high):.1f}]"


def aligned(headings: Sequence[str], lines: Sequence[Sequence[str]], left: int) -> str:
    """A Markdown table that also reads well as plain text.

    A table that is wider than a terminal loses its outer pipes. If it is still too wide, it also
    loses the spaces around the inner ones.

    Args:
        headings: one for each column.
        lines: cells of each row.
        left: this many first columns are aligned to the left, the others to the right.
    """
    widths = [max(3, *(len(line[i]) for line in (headings, *lines))) for i in range(len(headings))]

    def text(cells: Sequence[str], between: str) -> str:
        return between.join(
            c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths))
        )

    def rule(space: int) -> str:
        return "|".join(
            "-" * (w + space) if i < left else "-" * (w + space - 1) + ":"
            for i, w in enumerate(widths)
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


def csv_text(records: Sequence[Mapping[str, Any]]) -> str:
    """Records with the same keys as CSV; `None` is written as `n/a`."""
    text = io.StringIO()
    if records:
        writer = csv.DictWriter(text, list(records[0]), lineterminator="\n")
        writer.writeheader()
        for record in records:
            writer.writerow({k: NA if v is None else csv_cell(v) for k, v in record.items()})
    return text.getvalue()


def json_text(data: Any) -> str:
    """The data as JSON that ends in a newline and holds no NaN."""
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


# LaTeX: tabulars with booktabs and siunitx. Caption, label and table environment are the paper's.
# The widths fit an IEEE page (252 pt a column, 516 pt the text); tests/report/test_latex.py
# compiles them.

PACKAGES = r"\usepackage{booktabs,siunitx}"

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


def short_digests(text: str) -> str:
    """The text with the first 12 of the 64 digits of each sha256: run.json and the other formats have them all."""
    return re.sub(r"\b([0-9a-f]{12})[0-9a-f]{52}\b", r"\1", text)


def tex_comments(origin: Mapping[str, str], notes: Iterable[str]) -> list[str]:
    """Provenance and notes as LaTeX comments. No value can end its comment: line ends go."""
    lines = [f"needs {PACKAGES}", *(f"{key}: {value}" for key, value in origin.items()), *notes]
    return [f"% {' '.join(line.split())}" for line in lines]


def tex_number(digits: int, decimals: int) -> str:
    r"""A column of numbers aligned at the point; bold ones (`\bfseries 1.2`) stay aligned."""
    return f"S[table-format={digits}.{decimals},detect-weight,mode=text]"


def tex_cell(text: str, *, bold: bool = False) -> str:
    """A cell of a `tex_number` column; what is not a number stands in braces."""
    if text == NA or not text:
        return f"{{{text}}}"
    return rf"\bfseries {text}" if bold else text


FIT = 11
"""Columns of Table I as the paper has them, and one share."""


def tex_table(
    columns: Sequence[str],
    head: Sequence[str],
    groups: Iterable[Sequence[str]],
    top: Sequence[str] = (),
) -> list[str]:
    """Lines of a tabular.

    Args:
        columns: LaTeX column types.
        head: headings.
        groups: rows as LaTeX; a rule separates the groups.
        top: rows above the headings.
    """
    # columns stand nearer than LaTeX's 12 pt: eleven fit the width of two columns of a paper, more of them nearly
    nearer = 3 if len(columns) <= FIT else 7
    spec = rf"@{{\extracolsep{{-{nearer}pt}}}}" + "".join(columns) + "@{}"
    lines = [rf"\begin{{tabular}}{{{spec}}}", r"\toprule", *top, " & ".join(head) + r" \\"]
    for rows in groups:
        lines += [r"\midrule", *rows]
    return [*lines, r"\bottomrule", r"\end{tabular}"]
