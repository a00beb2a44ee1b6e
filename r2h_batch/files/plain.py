"""What people type, read plainly: numbers in decimal digits, ~ for the home folder."""

import math
import os
import re

from r2h_batch.files import FileError, printable

__all__ = ["at_home", "number", "whole_number"]

_WHOLE = re.compile(r"[-+]?[0-9]{1,30}")
_DECIMAL = re.compile(r"[-+]?([0-9]{1,30}(\.[0-9]{0,30})?|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?")


def number(text: str) -> float:
    """The finite number that plain decimal digits say, as 0.1, -2 or 1e-3; else a ValueError.

    Python itself also reads 1_0 as ten, other scripts' digits, nan and infinity.
    """
    if not _DECIMAL.fullmatch(text) or not math.isfinite(float(text)):
        raise ValueError(
            f"{printable(text)[:40]!r} is no plain number; write decimal digits, such as 0.1"
        )
    return float(text)


def whole_number(text: str) -> int:
    """The whole number that plain decimal digits say; else a ValueError."""
    if not _WHOLE.fullmatch(text):
        raise ValueError(
            f"{printable(text)[:40]!r} is no whole number; write decimal digits, such as 10"
        )
    return int(text)


def at_home(text: str) -> str:
    """The text with ~ or ~USER written out where a path begins: at its beginning, and behind the =
    of --flag= and NAME=.

    A shell does the former alone. Raises `FileError` where nobody is called so.
    """
    return "=".join(map(_written_out, text.split("=")))


def _written_out(path: str) -> str:
    if not re.match(r"~[^/:]*(/|$)", path):
        return path
    written = os.path.expanduser(path)
    if written.startswith("~"):
        raise FileError(
            f"{printable(path)}: nobody has this home; write the path out, or ./~ for a folder called so"
        )
    return written
