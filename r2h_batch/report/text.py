"""Tables and notes as Markdown that also reads well as plain text."""

from collections.abc import Mapping, Sequence

NA = "n/a"
"""A cell in which nothing is defined."""

TERMINAL = 100
"""Characters in a line: a wider table loses its outer pipes, then the spaces around the inner
ones."""

SHORT = 16
"""Characters of a method's short name: `Contact-Handover` has as many."""


def short_names(methods: Sequence[str]) -> dict[str, str]:
    """Method -> a name of at most `SHORT` characters for tables; all differ.

    What a name says in brackets goes (the stand-in of a network, the noise), then its middle, then
    it gets a number.
    """
    names: dict[str, str] = {}
    for method in dict.fromkeys(methods):
        plain_name = method.partition(" (")[0].strip() or method
        short = plain_name if len(plain_name) <= SHORT else f"{plain_name[:9]}..{plain_name[-5:]}"
        for number in range(2, len(methods) + 2):
            if short not in names.values():
                break
            short = f"{plain_name[: SHORT - 1 - len(str(number))]}#{number}"
        names[method] = short
    return names


def legend(names: Mapping[str, str]) -> list[str]:
    """`short: full name` of every name that was shortened."""
    return [f"{short}: {method}" for method, short in names.items() if short != method]


def aligned(headings: Sequence[str], lines: Sequence[Sequence[str]], left: int) -> str:
    """A Markdown table that also reads well as plain text; the first `left` columns are
    left-aligned.

    Pipes at the edges and spaces around the others go where the table would otherwise be wider than
    a terminal.
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

    wide = [
        f"| {text(headings, ' | ')} |",
        f"|{rule(2)}|",
        *(f"| {text(line, ' | ')} |" for line in lines),
    ]
    if len(wide[0]) - 4 <= TERMINAL:
        return "\n".join(wide if len(wide[0]) <= TERMINAL else [line[2:-2] for line in wide])
    return "\n".join([text(headings, "|"), rule(0), *(text(line, "|") for line in lines)])


def plain(method: str) -> str:
    """A method's name inside a Markdown table: pipes do not end the cell."""
    return method.replace("|", "\\|")


def wrapped(note: str, width: int = 98) -> str:
    """A note as a Markdown list item on lines of at most `width` characters."""
    lines, line = [], "-"
    for word in note.split():
        if len(line) + 1 + len(word) > width:
            lines.append(line)
            line = " "
        line += " " + word
    return "\n".join([*lines, line])
