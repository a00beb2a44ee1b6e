"""Tables that people fill in: CSV as Excel, LibreOffice and pandas write it, read whole or refused
by line and column."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2h_batch.io.read import FileError, printable, read_file
from r2h_batch.study.stats import StudyError

__all__ = ["LINE", "Number", "Text", "read_table"]

MAX_BYTES = 64 << 20
MAX_CELL = 200
"""Characters of a cell that is read; no name of a person or a method is longer."""
LINE = "line"
"""Key of a row's line in the file, for errors that come later."""

_NUMBER = re.compile(r"[-+]?[0-9]{1,15}(\.[0-9]{0,15})?([eE][-+]?[0-9]{1,2})?")


@dataclass(frozen=True)
class Number:
    """A column of numbers from `low` to `high`."""

    low: float
    high: float
    whole: bool = False
    percent: bool = False
    """may have its sign, as spreadsheets write it; without one nobody can tell 0.85 for 85 % from
    0.85 %"""

    @property
    def allowed(self) -> str:
        if self.percent:
            return f"percent from {self.low:g} to {self.high:g}, 85 or 85% and not 0.85; what is 1 % or less has its sign"
        return f"{'whole ' if self.whole else ''}numbers from {self.low:g} to {self.high:g}"

    def read(self, cell: str) -> float | int:
        """The number, or a ValueError."""
        signed = self.percent and cell.endswith("%")
        cell = cell.removesuffix("%").rstrip() if signed else cell
        if not _NUMBER.fullmatch(cell):
            raise ValueError
        value = int(cell) if self.whole else float(cell)
        if self.percent and not signed and 0 < value <= 1:
            raise ValueError
        if not self.low <= value <= self.high:
            raise ValueError
        return value


@dataclass(frozen=True)
class Text:
    """A column of names."""

    allowed = f"1 to {MAX_CELL} visible characters"

    def read(self, cell: str) -> str:
        """The name, or a ValueError."""
        if not cell or not cell.isprintable():
            raise ValueError
        return cell


def read_table(path: Path, columns: Mapping[str, Number | Text]) -> list[dict[str, Any]]:
    """Rows of a CSV file with these columns (more are ignored) and their `LINE`; `#` lines are
    comments.

    UTF-8 with or without a mark, UTF-16 with one; commas, semicolons or tabs, as the first line
    shows; with the last two a comma may stand for the decimal point.
    """
    text = _text(path)
    lines = [
        (n, line)
        for n, line in enumerate(re.split(r"\r\n|\r|\n", text), start=1)
        if not line.startswith(("#", "sep="))
    ]
    lines = [(n, line) for n, line in lines if line.strip()]
    if not lines:
        raise StudyError(f"{path}: no rows; needed are the columns {', '.join(columns)}")
    head = lines[0][1]
    delimiter = max(",;\t", key=head.count)
    at = {"line": 0}  # of the row that is read; 0 before its first line

    def told() -> Iterator[str]:
        for number, line in lines:
            at["line"] = at["line"] or number
            yield f"{line}\n"

    before = csv.field_size_limit(
        len(text) + 1
    )  # a long cell is refused by its line and column, below
    try:
        reader = csv.reader(told(), delimiter=delimiter)
        names = [name.strip() for name in next(reader)]
        at["line"] = 0
        if missing := [c for c in columns if c not in names]:
            raise StudyError(f"{path}: no column {missing[0]!r}; needed are {', '.join(columns)}")
        if twice := [c for c in columns if names.count(c) > 1]:
            raise StudyError(f"{path}: column {twice[0]!r} is there twice; once is enough")
        return _rows(path, reader, names, columns, at, delimiter)
    except csv.Error as error:
        raise StudyError(f"{path}: line {at['line']}: no CSV ({printable(error)})") from None
    finally:
        csv.field_size_limit(before)


def _rows(
    path: Path,
    reader: Iterator[list[str]],
    names: list[str],
    columns: Mapping[str, Number | Text],
    at: dict[str, int],
    delimiter: str,
) -> list[dict[str, Any]]:
    rows = []
    for cells in reader:
        number, at["line"] = at["line"], 0
        if len(cells) > len(names):
            raise StudyError(
                f"{path}: line {number}: {len(cells)} cells under {len(names)} columns"
            )
        row: dict[str, Any] = {LINE: number}
        for name, kind in columns.items():
            place = names.index(name)
            cell = cells[place].strip() if place < len(cells) else ""
            try:
                if len(cell) > MAX_CELL:
                    raise ValueError
                if isinstance(kind, Number) and not kind.whole and delimiter != ",":
                    cell = cell.replace(",", ".")
                row[name] = kind.read(cell)
            except ValueError:
                shown = printable(cell[:40]) + ("..." if len(cell) > 40 else "") or "(empty)"
                raise StudyError(
                    f"{path}: line {number}, column {place + 1}: {name} {shown}; allowed are {kind.allowed}"
                ) from None
        rows.append(row)
    if not rows:
        raise StudyError(f"{path}: no rows under the column names")
    return rows


def _text(path: Path) -> str:
    try:
        data = read_file(path, MAX_BYTES)
    except FileError as error:
        raise StudyError(str(error)) from None
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise StudyError(
            f"{path}: line {line}: neither UTF-8 nor UTF-16 ({error.reason}); save it as 'CSV UTF-8'"
        ) from None
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise StudyError(
            f"{path}: line {line}: zero bytes, UTF-16 without its mark perhaps; save it as 'CSV UTF-8'"
        )
    return text
