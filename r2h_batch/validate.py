"""Text that people type, and pydantic's errors, in the form of this package's messages."""

import math
import os
import re
from collections.abc import Mapping
from typing import Any

from r2h_batch.io.read import FileError, printable

__all__ = ["expand_home", "parse_number", "parse_whole_number", "rule_of"]

_WHOLE = re.compile(r"[-+]?[0-9]{1,30}")
_DECIMAL = re.compile(r"[-+]?([0-9]{1,30}(\.[0-9]{0,30})?|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?")


def parse_number(text: str) -> float:
    """The finite number in decimal digits, such as 0.1, -2 or 1e-3; else ValueError.

    Python's `float` also reads 1_0, digits of other scripts, nan and infinity.
    """
    if not _DECIMAL.fullmatch(text) or not math.isfinite(float(text)):
        shown = repr(printable(text)[:40])
        raise ValueError(f"{shown} is no plain number; write decimal digits, such as 0.1")
    return float(text)


def parse_whole_number(text: str) -> int:
    """The whole number in decimal digits; else ValueError."""
    if not _WHOLE.fullmatch(text):
        shown = repr(printable(text)[:40])
        raise ValueError(f"{shown} is no whole number; write decimal digits, such as 10")
    return int(text)


def expand_home(text: str) -> str:
    """The text with ~ or ~USER replaced where a path begins: at its start, and after the = of
    --flag= and NAME=. A shell does the former alone.

    Raises:
        FileError: there is no such user.
    """
    return "=".join(map(_expanded, text.split("=")))


def _expanded(path: str) -> str:
    if not re.match(r"~[^/:]*(/|$)", path):
        return path
    found = os.path.expanduser(path)
    if found.startswith("~"):
        how = "write the path out, or ./~ for a folder of that name"
        raise FileError(f"{printable(path)}: there is no user with this home; {how}")
    return found


_KINDS = {
    "string_type": "it must be text",
    "int_type": "it must be a whole number",
    "int_from_float": "it must be a whole number",
    "float_type": "it must be a number",
    "bool_type": "it must be true or false",
    "list_type": "it must be a list",
    "tuple_type": "it must be a list",
    "dict_type": "it must hold fields (name: value)",
    "model_type": "it must hold fields (name: value)",
    "model_attributes_type": "it must hold fields (name: value)",
    "dataclass_type": "it must hold fields (name: value)",
    "none_required": "it must be empty",
    "finite_number": "it must be a finite number",
}
_BOUNDS = {
    "greater_than": "it must be above {gt}",
    "greater_than_equal": "it must be {ge} or more",
    "less_than": "it must be below {lt}",
    "less_than_equal": "it must be {le} or less",
    "too_short": "it must have {min_length} entries or more, it has {actual_length}",
    "too_long": "it may have {max_length} entries, it has {actual_length}",
    "string_too_short": "it must have {min_length} characters or more",
    "string_too_long": "it may have {max_length} characters",
    "literal_error": "allowed are {expected}",
    "value_error": "{error}",
    "string_pattern_mismatch": "it must be of the form {pattern}",
}


def rule_of(error: Mapping[str, Any]) -> str:
    """The rule that one of pydantic's errors (`ValidationError.errors()`) broke."""
    kind, context = str(error["type"]), error.get("ctx") or {}
    words = _KINDS.get(kind)
    if words is None and kind in _BOUNDS:
        words = _BOUNDS[kind].format(**context)
    if words is None:
        message = str(error["msg"])
        words = f"{message[:1].lower()}{message[1:]}"
    return printable(words)[:400]
