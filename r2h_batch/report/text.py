"""Tables and notes as Markdown that also reads well as plain text."""

from collections.abc import Sequence

NA = "n/a"
"""A cell in which nothing is defined."""

TERMINAL = 120
"""Width in characters above which a table loses its outer pipes."""


def aligned(headings: Sequence[str], lines: Sequence[Sequence[str]], left: int) -> str:
    """A Markdown table that also reads well as plain text; the first `left` columns are left-aligned.

    The pipes at the edges go where the table would otherwise be wider than a terminal.
    """
    widths = [max(3, *(len(line[i]) for line in (headings, *lines))) for i in range(len(headings))]

    def text(cells: Sequence[str]) -> str:
        padded = [c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(cells, widths))]
        return f"| {' | '.join(padded)} |"

    rule = "|" + "|".join("-" * (w + 2) if i < left else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    table = [text(headings), rule, *map(text, lines)]
    return "\n".join(table if len(rule) <= TERMINAL else [line[2:-2] for line in table])


def plain(method: str) -> str:
    """A method's name inside a Markdown table: pipes do not end the cell."""
    return method.replace("|", "\\|")


def wrapped(note: str, width: int = 118) -> str:
    """A note as a Markdown list item on lines of at most `width` characters."""
    lines, line = [], "-"
    for word in note.split():
        if len(line) + 1 + len(word) > width:
            lines.append(line)
            line = " "
        line += " " + word
    return "\n".join([*lines, line])
