"""Numbers out of somebody's CSV or JSON, row by row, each checked before it is stored: no line of a
table is trusted."""

import csv
import io
import json
import re
from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.files import FileError, open_file, printable, read_file

__all__ = ["MAX_CSV_BYTES", "MAX_JSON_BYTES", "read_csv_arrays", "read_json_arrays"]

MAX_CSV_BYTES = 1 << 30
MAX_JSON_BYTES = 64 << 20
"""A parsed JSON takes some twenty times its size."""
MAX_LINE = 10_000
MAX_ROWS = 10_000_000

MOST_DIGITS = 400
WHOLE = "a whole number, 0 or more, of at most 18 digits"
UTF_16 = (b"\xff\xfe", b"\xfe\xff")
"""How a file in UTF-16 begins."""

_NUMBER = re.compile(
    r"[-+]?([0-9]{1,30}(\.[0-9]{0,30})?|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?|[-+]?(nan|inf)",
    re.I | re.A,
)
_WHOLE = re.compile(r"[0-9]{1,18}", re.A)

Widths = Mapping[str, int]
Arrays = dict[str, NDArray[Any]]


def read_csv_arrays(path: Path, widths: Widths, optional: tuple[str, ...] = ()) -> Arrays:
    """Arrays (N,) or (N, width) by name; the first of `widths` is a whole number, int64, the others
    float64.

    The first line names the columns, in any order: NAME, or NAME_0 to NAME_(width - 1). An empty
    cell of an `optional` column is NaN. Raises `FileError`: file, line, column, what was found and
    what is allowed.
    """
    where, key = printable(path), next(iter(widths))
    with open_file(path, MAX_CSV_BYTES) as stream:
        if stream.read(2) in UTF_16:
            raise FileError(f"{where}: is in UTF-16; save it in UTF-8 (in Excel: CSV UTF-8)")
    with (
        open_file(path, MAX_CSV_BYTES) as stream,
        io.TextIOWrapper(stream, encoding="utf-8-sig", errors="strict", newline="") as text,
    ):
        try:
            lines = csv.reader(_bounded(text, where), strict=True)
            names = next(lines, [])
            places = _places(names, widths, optional, where)
            ids, values = array("q"), {name: array("d") for name in places if name != key}
            for row in lines:
                if not row:
                    continue
                _add(row, lines.line_num, len(names), places, key, ids, values, optional, where)
                if len(ids) > MAX_ROWS:
                    raise FileError(f"{where}: more than {MAX_ROWS} rows")
        except (csv.Error, UnicodeDecodeError) as error:
            raise FileError(
                f"{where}: no readable CSV in UTF-8 ({printable(error)[:200]})"
            ) from None
    found: Arrays = {key: np.array(ids, np.int64)}
    for name, data in values.items():
        found[name] = np.array(data, np.float64).reshape(
            (-1, widths[name]) if widths[name] > 1 else -1
        )
    return found


def _bounded(text: Any, where: str) -> Any:
    """Lines of a length that a row can have."""
    number = 0
    while line := text.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise FileError(f"{where}: line {number} is longer than {MAX_LINE} characters")
        yield line


def _places(
    names: list[str], widths: Widths, optional: tuple[str, ...], where: str
) -> dict[str, list[int]]:
    """Column numbers of each array."""
    wanted = {
        name: [name] if w == 1 else [f"{name}_{i}" for i in range(w)] for name, w in widths.items()
    }
    known = [c for columns in wanted.values() for c in columns]
    stripped = [n.strip() for n in names]
    if len(names) == 1 and any(c in names[0] for c in ";\t"):
        what = "semicolons" if ";" in names[0] else "tabs"
        raise FileError(
            f"{where}: line 1: columns are separated by {what}; write commas between, and points in numbers"
        )
    shown = ", ".join(n if w == 1 else f"{n}_0 to {n}_{w - 1}" for n, w in widths.items())
    for n in stripped:
        if n not in known:
            raise FileError(
                f"{where}: line 1: unknown column {printable(n)[:60]!r}; needed are {shown}, with commas between"
            )
        if stripped.count(n) > 1:
            raise FileError(f"{where}: line 1: column {n} is given twice")
    found = {}
    for name, columns in wanted.items():
        missing = [c for c in columns if c not in stripped]
        if missing and not (name in optional and len(missing) == len(columns)):
            raise FileError(f"{where}: line 1: column {missing[0]} is missing; needed are {shown}")
        if not missing:
            found[name] = [stripped.index(c) for c in columns]
    return found


def _add(
    row: list[str], line: int, count: int, places: Mapping[str, list[int]], key: str, ids: "array[int]",
    values: "Mapping[str, array[float]]", optional: tuple[str, ...], where: str,
) -> None:  # fmt: skip
    if len(row) != count:
        raise FileError(f"{where}: line {line} has {len(row)} cells; the first line has {count}")
    cell = row[places[key][0]].strip()
    if not _WHOLE.fullmatch(cell):
        raise FileError(
            f"{where}: line {line}: {key} is {printable(cell)[:40]!r}; it must be {WHOLE}"
        )
    ids.append(int(cell))
    for name, data in values.items():
        for place in places[name]:
            cell = row[place].strip()
            if not cell and name in optional:
                data.append(float("nan"))
            elif _NUMBER.fullmatch(cell):
                data.append(float(cell))
            else:
                raise FileError(
                    f"{where}: line {line}: {name} has {printable(cell)[:40]!r}; it must be a number"
                )


def read_json_arrays(
    path: Path,
    widths: Widths,
    optional: tuple[str, ...] = (),
    *,
    rows: str = "predictions",
    words: tuple[str, ...] = (),
) -> tuple[Arrays, dict[str, str]]:
    """The same of `{WORD: text, rows: [{NAME: number or list, ...}, ...]}`, and the texts.

    A list may be flat or nested row by row. Raises `FileError`: file, row, name, what was found and
    what is allowed.
    """
    where, key = printable(path), next(iter(widths))
    try:
        text = _decoded(read_file(path, MAX_JSON_BYTES), where)
        data = json.loads(text, object_pairs_hook=_once, parse_int=_whole)
    except (ValueError, RecursionError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{where}: no readable JSON ({printable(error)[:200]})") from None
    if not isinstance(data, dict) or not isinstance(data.get(rows), list):
        raise FileError(f"{where}: must hold an object with a list {rows!r}")
    if unknown := [k for k in data if k not in (rows, *words)]:
        raise FileError(
            f"{where}: unknown field {printable(unknown[0])[:60]!r}; allowed are {', '.join((rows, *words))}"
        )
    if odd := [k for k in words if k in data and not isinstance(data[k], str)]:
        raise FileError(f"{where}: {odd[0]} must be text")
    ids, values = [], {name: array("d") for name in widths if name != key}
    for i, row in enumerate(data[rows]):
        at = f"{where}: {rows}.{i}"
        if not isinstance(row, dict):
            raise FileError(f"{at} must be an object of {', '.join(widths)}")
        if strange := [k for k in row if k not in widths]:
            raise FileError(
                f"{at}: unknown field {printable(strange[0])[:60]!r}; allowed are {', '.join(widths)}"
            )
        number = row.get(key)
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 1 << 63:
            raise FileError(f"{at}.{key} is {printable(repr(number))[:40]}; it must be {WHOLE}")
        ids.append(number)
        for name, part in values.items():
            given = row.get(name)
            flat = (
                [float("nan")] * widths[name]
                if given is None and name in optional
                else _flat(given)
            )
            if flat is None or len(flat) != widths[name]:
                told = _said(given) if flat is None else f"{len(flat)} numbers"
                raise FileError(
                    f"{at}.{name} is {told}; it must be {widths[name]} number{'s'[: widths[name] > 1]}"
                )
            part.extend(flat)
    found: Arrays = {key: np.array(ids, np.int64)}
    for name, part in values.items():
        found[name] = np.array(part, np.float64).reshape(
            (-1, widths[name]) if widths[name] > 1 else -1
        )
    return found, {k: data[k] for k in words if k in data}


def _decoded(data: bytes, where: str) -> str:
    if data[:2] in UTF_16:
        raise FileError(f"{where}: is in UTF-16; save it in UTF-8")
    return data.decode("utf-8-sig")


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits; ids have at most 18")
    return int(digits)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{max(names, key=names.count)!r} is given twice")
    return found


def _said(given: Any) -> str:
    """What stands where numbers should, in a few words."""
    what = printable(json.dumps(given, default=str))
    return what if len(what) <= 40 else f"{what[:40]}..."


def _flat(given: Any) -> list[float] | None:
    """The numbers of a number, a list or a list of lists; None where there is something else in
    it."""
    items = given if isinstance(given, list) else [given]
    items = [x for part in items for x in (part if isinstance(part, list) else [part])]
    if any(
        isinstance(x, bool) or not isinstance(x, (int, float)) or abs(x) > 1e300
        for x in items
        if x == x
    ):
        return None
    return [float(x) for x in items]
