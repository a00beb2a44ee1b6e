"""A method with options of its own: `--method contact,gate=ik,height_m=0.12`. What may be said is
in its function's signature."""

from __future__ import annotations

import inspect
import math
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal

from r2h_batch.command_line import UsageError, nearest

__all__ = ["base_of", "options_of", "said_options"]

GIVEN = ("trials", "scene", "seed", "evaluator", "noise", "predictor", "seen", "instructions")
"""Arguments of a method that a sweep gives it: no options."""

_WORDS = {"true": True, "false": False}


def base_of(method: str) -> str:
    """The method's name without its options."""
    return method.partition(",")[0]


def said_options(method: str) -> str:
    """What stands after the name, for tables and run folders: `gate=ik, height_m=0.12`; empty
    without options."""
    return ", ".join(part.strip() for part in method.split(",")[1:])


def options_of(method: str, function: Callable[..., Any], *, known: bool) -> dict[str, Any]:
    """The options that are said after a method's name, checked against its function; `UsageError`
    in one line.

    `known`: types must be given (built-in methods); a user's parameter without one takes the text
    as a number where it is one.
    """
    base, *parts = method.split(",")
    if not parts:
        return {}
    allowed = _allowed(function)
    found: dict[str, Any] = {}
    for part in parts:
        name, equals, text = (x.strip() for x in part.partition("="))
        if name not in allowed:
            takes = f"allowed are {', '.join(allowed)}" if allowed else "it takes none"
            raise UsageError(
                f"--method {base}: unknown option {name!r}{nearest(name, list(allowed))}; {takes}"
            )
        if not equals or not text:
            raise UsageError(f"--method {base}: option {name} has no value; say {name}=VALUE")
        if name in found:
            raise UsageError(f"--method {base}: option {name} is given twice; once is enough")
        found[name] = _value(base, name, text, allowed[name], known)
    return found


def _allowed(function: Callable[..., Any]) -> dict[str, Any]:
    """Option -> its type (None: not said)."""
    hints: Mapping[str, Any]
    try:
        hints = typing.get_type_hints(function)
    except (NameError, TypeError):  # a user's annotations may name what is not there when it runs
        hints = {}
    takes = inspect.signature(function).parameters.values()
    keywords = [p for p in takes if p.kind is p.KEYWORD_ONLY and p.name not in GIVEN]
    return {p.name: hints.get(p.name) for p in keywords}


def _value(method: str, name: str, text: str, kind: Any, known: bool) -> Any:
    """The text as the option's type."""
    if typing.get_origin(kind) is Literal:
        words = typing.get_args(kind)
        if text not in words:
            raise UsageError(
                f"--method {method}: {name} is {text!r}{nearest(text, words)}; allowed are {', '.join(words)}"
            )
        return text
    if kind is bool:
        if text not in _WORDS:
            raise UsageError(f"--method {method}: {name} is {text!r}; allowed are true, false")
        return _WORDS[text]
    if kind in (int, float):
        try:
            number = kind(text)
        except ValueError:
            number = math.nan
        if not math.isfinite(number):
            what = "a whole number" if kind is int else "a number"
            raise UsageError(f"--method {method}: {name} is {text!r}; it must be {what}")
        return number
    if kind is None and not known:
        try:
            return int(text) if text.lstrip("-").isdigit() else float(text)
        except ValueError:
            return text
    return text
