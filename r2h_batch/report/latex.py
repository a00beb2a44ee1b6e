"""Tables for print: booktabs and siunitx, one column of a page or both, where they come from as
comments.

A tabular alone: caption, label and table environment are the paper's. The widths are those of an
IEEE page (252 pt a column, 516 pt the text), which tests/report/test_latex.py compiles.
"""

from collections.abc import Mapping, Sequence

from r2h_batch.report.text import NA

__all__ = ["PACKAGES", "cell", "comments", "escaped", "number", "table", "text_column"]

PACKAGES = r"\usepackage{booktabs,siunitx}"

_TEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_TEX |= {c: "\\" + c for c in "&%$#_{}"} | {
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
}


def escaped(text: str) -> str:
    """Text as LaTeX prints it, whatever characters it holds; those beyond ASCII need an engine or
    font that has them."""
    return "".join(_TEX.get(c, c) for c in text)


def comments(origin: Mapping[str, str], notes: Sequence[str] = ()) -> list[str]:
    """Provenance and notes as comments: a % cannot end one, and no value holds a line end."""
    said = [f"{key}: {value}" for key, value in origin.items()]
    return [f"% {' '.join(line.split())}" for line in (f"needs {PACKAGES}", *said, *notes)]


def number(digits: int, decimals: int) -> str:
    r"""Column of numbers aligned at the point; bold ones (`\bfseries 1.2`) stay aligned."""
    return f"S[table-format={digits}.{decimals},detect-weight,mode=text]"


def text_column() -> str:
    return "l"


def cell(text: str, *, bold: bool = False) -> str:
    """A number for a `number` column; whatever is none stands in braces."""
    if text == NA or not text:
        return f"{{{text}}}"
    return rf"\bfseries {text}" if bold else text


def table(
    columns: Sequence[str],
    head: Sequence[str],
    groups: Sequence[Sequence[str]],
    top: Sequence[str] = (),
) -> list[str]:
    """Lines of a tabular: `top` above the headings, groups of rows with a rule between them; rows
    are LaTeX already."""
    spec = "@{}" + "".join(columns) + "@{}"
    lines = [rf"\begin{{tabular}}{{{spec}}}", r"\toprule", *top, " & ".join(head) + r" \\"]
    for rows in groups:
        lines += [r"\midrule", *rows]
    return [*lines, r"\bottomrule", r"\end{tabular}"]
