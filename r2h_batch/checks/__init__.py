"""What public functions may be given: an error at the call names the argument, what was given and
what is allowed.

    @takes(runs=many(Run, "load_run(FOLDER)"), draws=whole(1, 10**7))
    def compare(runs, *, draws=10_000): ...

A rule takes an argument's name and value and returns the value as the function works with it:
numbers of NumPy become Python's, an array stays an array. What a rule refuses is a TypeError
(another kind of thing) or a ValueError (out of range).
"""

import inspect
import math
import operator
import os
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, SupportsIndex, TypeVar

import numpy as np

__all__ = [
    "Rule", "array", "flag", "given", "kind", "many", "number", "one_of", "optional", "path", "takes", "text", "whole",
]  # fmt: skip

Rule = Callable[[str, Any], Any]
P = ParamSpec("P")
R = TypeVar("R")


def takes(**rules: Rule) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Hold a function's arguments to these rules, those that were given and those that have a
    rule."""

    def held(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        assert set(rules) <= set(signature.parameters)

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            bound = signature.bind(*args, **kwargs)
            for name, rule in rules.items():
                if name in bound.arguments:
                    bound.arguments[name] = rule(name, bound.arguments[name])
            return function(*bound.args, **bound.kwargs)

        return checked

    return held


def given(value: object) -> str:
    """What was given, in words short enough for an error."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is not None and dtype is not None and not isinstance(value, np.generic):
        return f"a {type(value).__name__} of shape {tuple(shape)} and type {dtype}"
    words = " ".join(repr(value).split())
    return words if len(words) <= 80 else f"{words[:60]}... ({type(value).__name__})"


def _whole(value: object) -> int | None:
    if (
        type(value) is int
    ):  # asked at each launch; what else may be a whole number takes ten times as long to see
        return value
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, SupportsIndex):
        return None
    try:
        return operator.index(value)
    except TypeError:  # a tensor of floats, or of several numbers
        return None


def whole(low: int | None = None, high: int | None = None, what: str = "") -> Rule:
    """A whole number from `low` to `high`, NumPy's too."""
    ends = [f"{end:,}" for end in (low, high) if end is not None]
    bounds = (
        f", {ends[0]} or more"
        if high is None and ends
        else f" from {' to '.join(ends)}"
        if ends
        else ""
    )

    def rule(name: str, value: Any) -> int:
        found = _whole(value)
        if found is None:
            raise TypeError(f"{name} is {given(value)}; it must be a whole number{what}{bounds}")
        if (low is not None and found < low) or (high is not None and found > high):
            raise ValueError(f"{name} is {given(value)}; it must be a whole number{what}{bounds}")
        return found

    return rule


def number(
    low: float = -math.inf, high: float = math.inf, *, above: bool = False, what: str = ""
) -> Rule:
    """A finite number from `low` (with `above`: above it) to `high`, NumPy's too."""
    if high == math.inf:
        bounds = "" if low == -math.inf else f" above {low:g}" if above else f", {low:g} or more"
    else:
        bounds = f" above {low:g}, at most {high:g}" if above else f" from {low:g} to {high:g}"

    def rule(name: str, value: Any) -> float:
        if isinstance(value, (bool, np.bool_)) or not isinstance(
            value, (int, float, np.integer, np.floating)
        ):
            raise TypeError(f"{name} is {given(value)}; it must be a finite number{bounds}{what}")
        found = float(value)
        if not math.isfinite(found) or not (found > low if above else found >= low) or found > high:
            raise ValueError(f"{name} is {given(value)}; it must be a finite number{bounds}{what}")
        return (
            value if isinstance(value, int) else found
        )  # a whole number stays one, also in a file

    return rule


def one_of(*allowed: str) -> Rule:
    """One of these words."""

    def rule(name: str, value: Any) -> str:
        if not isinstance(value, str):
            raise TypeError(f"{name} is {given(value)}; allowed are {', '.join(allowed)}")
        if value not in allowed:
            raise ValueError(f"{name} is {given(value)}; allowed are {', '.join(allowed)}")
        return value

    return rule


def kind(type_: type | tuple[type, ...], how: str = "") -> Rule:
    """Something of this kind; `how`: where to get one."""
    names = " or ".join(k.__name__ for k in (type_ if isinstance(type_, tuple) else (type_,)))

    def rule(name: str, value: Any) -> Any:
        if not isinstance(value, type_):
            raise TypeError(
                f"{name} is {given(value)}; it must be {_article(names)}{f': {how}' if how else ''}"
            )
        return value

    return rule


def _article(name: str) -> str:
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def many(type_: type, how: str = "", *, least: int = 1) -> Rule:
    """A sequence of `least` or more things of this kind; a tuple comes out."""

    def rule(name: str, value: Any) -> tuple[Any, ...]:
        words = f"it must be a sequence of {type_.__name__}{f': {how}' if how else ''}"
        if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
            raise TypeError(f"{name} is {given(value)}; {words}")
        for i, one in enumerate(value):
            if not isinstance(one, type_):
                raise TypeError(f"{name}[{i}] is {given(one)}; {words}")
        if len(value) < least:
            raise ValueError(f"{name} is {given(value)}; {words}, {least} or more")
        return tuple(value)

    return rule


def array(
    kinds: str,
    ndim: int | None = None,
    words: str = "",
    *,
    low: float = -math.inf,
    high: float = math.inf,
) -> Rule:
    """Values of NumPy's `kinds` (b i u f, U: words) with so many dimensions, as an array; lists
    too."""

    def rule(name: str, value: Any) -> Any:
        allowed = f"it must be {words or 'numbers'}"
        if value is None or isinstance(value, (str, bytes)):
            raise TypeError(f"{name} is {given(value)}; {allowed}")
        try:
            found = np.asarray(value)
        except (TypeError, ValueError, RuntimeError):
            raise TypeError(f"{name} is {given(value)}; {allowed}") from None
        if found.size and found.dtype.kind not in kinds:
            raise TypeError(f"{name} is {given(value)}; {allowed}")
        if (
            found.size
            and found.dtype.kind in "iuf"
            and not ((found >= low) & (found <= high)).all()
            and low > -math.inf
        ):
            raise ValueError(f"{name} is {given(value)}; {allowed}")
        if ndim is not None and found.ndim != ndim:
            raise ValueError(f"{name} is {given(value)} with {found.ndim} dimensions; {allowed}")
        return found

    return rule


def flag(name: str, value: Any) -> bool:
    """True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} is {given(value)}; it must be True or False")
    return bool(value)


def text(name: str, value: Any) -> str:
    """Words."""
    if not isinstance(value, str):
        raise TypeError(f"{name} is {given(value)}; it must be text")
    return value


def path(name: str, value: Any) -> Path:
    """A path, as text or a Path; one that begins with ~ is in the home folder."""
    if not isinstance(value, (str, os.PathLike)) or isinstance(value, bytes):
        raise TypeError(f"{name} is {given(value)}; it must be a path, text or pathlib.Path")
    return Path(value).expanduser()


def optional(rule: Rule) -> Rule:
    """The rule, or None."""
    return lambda name, value: None if value is None else rule(name, value)
