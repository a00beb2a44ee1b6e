"""Tables that people fill in, as CSV. An error names the line and the column."""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_file
from r2h_batch.base.validate import parse_number, parse_whole_number

MAX_BYTES = 64 << 20
MAX_CELL = 200
"""Characters of a cell; no name of a person or a method is longer."""
LINE = "line"
"""Key of a row's line in the file, for errors that come later."""


class Column(NamedTuple):
    """Type of a column's cells: `read` gives a value, or raises ValueError."""

    allowed: str
    read: Callable[[str], Any]


def _name(cell: str) -> str:
    if not cell or not cell.isprintable():
        raise ValueError
    return cell


NAME = Column(f"1 to {MAX_CELL} visible characters", _name)


def number(low: float, high: float, *, whole: bool = False) -> Column:
    """Numbers from `low` to `high`."""

    def read(cell: str) -> float:
        value = parse_whole_number(cell) if whole else parse_number(cell)
        if not low <= value <= high:
            raise ValueError
        return value

    return Column(f"{'whole ' if whole else ''}numbers from {low:g} to {high:g}", read)


def _percent(cell: str) -> float:
    value = parse_number(cell.removesuffix("%").rstrip())
    if not 0 <= value <= 100 or (0 < value <= 1 and not cell.endswith("%")):
        raise ValueError
    return value


PERCENT = Column(
    "percent from 0 to 100, 85 or 85% and not 0.85; what is 1 % or less has its sign", _percent
)
"""A percentage may have its sign, as spreadsheets write it. Up to 1 it must have it: without the sign,
0.85 can mean 85 % or 0.85 %."""


def words(allowed: Sequence[str]) -> Column:
    """One of these words."""

    def read(cell: str) -> str:
        if cell not in allowed:
            raise ValueError
        return cell

    return Column(", ".join(allowed), read)


def optional(column: Column) -> Column:
    """A cell of this column, or an empty one, which reads as None."""
    return Column(f"{column.allowed}, or nothing", lambda cell: column.read(cell) if cell else None)


def columns_of(path: Path) -> tuple[str, ...]:
    """Names of the columns of a CSV file.

    Raises:
        FileError: it is no readable CSV.
    """
    records = _records(path)
    return tuple(name.strip() for name in records[0][1]) if records else ()


def read_table(path: Path, columns: Mapping[str, Column]) -> list[dict[str, Any]]:
    """Read a CSV file in UTF-8: commas between the cells, points in numbers, comments after #.

    Args:
        path: of the file.
        columns: name -> what its cells hold; other columns are ignored.

    Returns:
        Rows with these columns and their `LINE`.

    Raises:
        FileError: in one line, with the file, the line, the column and what is allowed.
    """
    records = _records(path)
    names = [name.strip() for name in records[0][1]] if records else []
    for c in columns:
        if names.count(c) != 1:
            what = f"column {c!r} is there twice" if c in names else f"no column {c!r}"
            raise FileError(f"{path}: {what}; needed are {', '.join(columns)}, each once")
    if not records[1:]:
        raise FileError(f"{path}: no rows under the column names")
    rows = []
    for line, cells in records[1:]:
        if len(cells) > len(names):
            raise FileError(f"{path}: line {line}: {len(cells)} cells under {len(names)} columns")
        row: dict[str, Any] = {LINE: line}
        for name, kind in columns.items():
            place = names.index(name)
            cell = cells[place].strip() if place < len(cells) else ""
            try:
                if len(cell) > MAX_CELL:
                    raise ValueError
                row[name] = kind.read(cell)
            except ValueError:
                shown = printable(cell[:40]) + ("..." if len(cell) > 40 else "") or "(empty)"
                raise FileError(
                    f"{path}: line {line}, column {place + 1}: {name} {shown}; allowed are {kind.allowed}"
                ) from None
        rows.append(row)
    return rows


def _records(path: Path) -> list[tuple[int, list[str]]]:
    """Lines that have something, with their numbers in the file."""
    try:
        text = read_file(path, MAX_BYTES).decode("utf-8-sig")
        # comments become empty lines, so that the reader counts the lines of the file
        lines = ["" if line.startswith("#") else line for line in text.splitlines()]
        reader = csv.reader(lines, strict=True)
        records = [(reader.line_num, cells) for cells in reader if any(map(str.strip, cells))]
    except (UnicodeDecodeError, csv.Error) as error:
        why = printable(error)[:200]
        raise FileError(f"{path}: no readable CSV ({why}); save it as 'CSV UTF-8'") from None
    head = records[0][1] if records else []
    for sign, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(head) == 1 and sign in head[0]:
            raise FileError(
                f"{path}: has {name} between the cells; save it with commas between them, and with points in numbers"
            )
    return records
