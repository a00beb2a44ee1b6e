"""Checks of arguments, configurations, fields of files and typed text, with one form of message:
what was given, what is allowed, what to do, in one line.

    @check_arguments(runs=sequence_of(Run, "load_run(FOLDER)"), draws=integer(1, 10**7))
    def compare(runs, *, draws=10_000): ...

A rule takes an argument's name and value and returns the value that the function works with: NumPy's
numbers become Python's. It raises TypeError for another kind of value and ValueError for a value out
of bounds. Tensors: `validate_tensors`.
"""

from __future__ import annotations

import inspect
import math
import operator
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, SupportsIndex, TypeVar, get_type_hints

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import printable

Rule = Callable[[str, Any], Any]
P = ParamSpec("P")
R = TypeVar("R")


# ---- arguments


def check_arguments(**rules: Rule) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator that applies a rule to each named argument that a call gives."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        assert set(rules) <= set(signature.parameters)
        names = [name for name in signature.parameters if name != "self"]

        @wraps(function)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            check_keywords(function.__qualname__, kwargs, names)
            bound = signature.bind(*args, **kwargs)
            for name, rule in rules.items():
                if name in bound.arguments:
                    bound.arguments[name] = rule(name, bound.arguments[name])
            return function(*bound.args, **bound.kwargs)

        return checked

    return decorate


def suggest_names(function: Callable[P, R]) -> Callable[P, R]:
    """A decorator that answers a misspelt keyword argument with the nearest name (`TypeError`)."""
    parameters = inspect.signature(function).parameters.values()
    names = [p.name for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    known, shown = frozenset(names), [name for name in names if name != "self"]
    method = function.__qualname__

    @wraps(function)
    def named(*args: P.args, **kwargs: P.kwargs) -> R:
        for name in kwargs:  # a loop: torch.compile can trace it
            if name not in known:
                # whoever calls a constructor wrote the class's name, which may inherit it
                made = type(args[0]).__name__ if method.endswith(".__init__") else method
                check_keywords(made, kwargs, shown)
        return function(*args, **kwargs)

    return named


def check_keywords(call: str, given: Iterable[str], names: Sequence[str]) -> None:
    """`TypeError` for the first keyword argument that a call does not have."""
    for name in given:
        if name not in names:
            has = f"it has {', '.join(names)}"
            raise TypeError(f"{call}() has no argument {name!r}{nearest(name, names)}; {has}")


def describe_value(value: object) -> str:
    """A value in a few words, for a message."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape and dtype is not None:
        return f"a {type(value).__name__} of shape {tuple(shape)} and type {dtype}"
    try:
        words = " ".join(repr(value).split())
    except RecursionError:
        return f"a {type(value).__name__} of lists in lists, too deep to read"
    return words if len(words) <= 80 else f"{words[:60]}... ({type(value).__name__})"


def _refuse(kind: type[Exception], name: str, value: object, allowed: str) -> Exception:
    return kind(f"{name} is {describe_value(value)}; {allowed}")


def _is_bool(value: object) -> bool:
    import numpy as np

    return isinstance(value, (bool, np.bool_))


def _integer(value: object) -> int | None:
    if type(value) is int:  # first: launches call this, and the rest takes ten times as long
        return value
    if not isinstance(value, SupportsIndex) or _is_bool(value):
        return None
    try:
        return operator.index(value)
    except TypeError:  # a tensor of floats, or of several numbers
        return None


def integer(low: int | None = None, high: int | None = None, what: str = "") -> Rule:
    """A whole number from `low` to `high`."""
    bounds = "" if low is None else f", {low:,} or more"
    if low is not None and high is not None:
        bounds = f" from {low:,} to {high:,}"
    allowed = f"it must be a whole number{what}{bounds}"

    def rule(name: str, value: Any) -> int:
        found = _integer(value)
        if found is None:
            raise _refuse(TypeError, name, value, allowed)
        if (low is not None and found < low) or (high is not None and found > high):
            raise _refuse(ValueError, name, value, allowed)
        return found

    return rule


def number(
    low: float = -math.inf, high: float = math.inf, *, above: bool = False, what: str = ""
) -> Rule:
    """A finite number from `low` (with `above`: above it) to `high`. A whole number stays one."""
    bounds = "" if low == -math.inf else f" above {low:g}" if above else f" from {low:g}"
    bounds += "" if high == math.inf else f" to {high:g}"
    allowed = f"it must be a finite number{bounds}{what}"

    def rule(name: str, value: Any) -> float:
        import numpy as np

        if not isinstance(value, (int, float, np.integer, np.floating)) or _is_bool(value):
            raise _refuse(TypeError, name, value, allowed)
        found = float(value)
        if not math.isfinite(found) or not low <= found <= high or (above and found == low):
            raise _refuse(ValueError, name, value, allowed)
        return value if isinstance(value, int) else found

    return rule


def one_of(*words: str) -> Rule:
    """One of these words."""
    allowed = f"allowed are {', '.join(words)}"

    def rule(name: str, value: Any) -> str:
        if not isinstance(value, str):
            raise _refuse(TypeError, name, value, allowed)
        if value not in words:
            raise _refuse(ValueError, name, value, allowed)
        return value

    return rule


def instance_of(kinds: type | tuple[type, ...], how: str = "") -> Rule:
    """An instance of a class; `how` says where to get one."""
    names = " or ".join(k.__name__ for k in (kinds if isinstance(kinds, tuple) else (kinds,)))
    article = "an" if names[0] in "AEIOaeio" else "a"
    allowed = f"it must be {article} {names}{f': {how}' if how else ''}"

    def rule(name: str, value: Any) -> Any:
        if not isinstance(value, kinds):
            raise _refuse(TypeError, name, value, allowed)
        return value

    return rule


def sequence_of(kind: type, how: str = "", *, least: int = 1) -> Rule:
    """A sequence of at least `least` instances of a class; it becomes a tuple."""
    allowed = f"it must be a sequence of {kind.__name__}{f': {how}' if how else ''}"

    def rule(name: str, value: Any) -> tuple[Any, ...]:
        if isinstance(value, (str, bytes)) or not isinstance(value, Sequence):
            raise _refuse(TypeError, name, value, allowed)
        for i, one in enumerate(value):
            if not isinstance(one, kind):
                raise _refuse(TypeError, f"{name}[{i}]", one, allowed)
        if len(value) < least:
            raise _refuse(ValueError, name, value, f"{allowed}, {least} or more")
        return tuple(value)

    return rule


def array(
    kinds: str, ndim: int | None = None, words: str = "numbers", *,
    low: float = -math.inf, high: float = math.inf,
) -> Rule:  # fmt: skip
    """An array of NumPy's `kinds` (b i u f U), or what makes one.

    Args:
        kinds: the allowed `dtype.kind`.
        ndim: the number of dimensions; None allows any.
        words: what the array must be, for the message.
        low: smallest value.
        high: largest value.
    """
    allowed = f"it must be {words}"

    def rule(name: str, value: Any) -> Any:
        import numpy as np

        try:
            found = np.asarray(None if isinstance(value, (str, bytes)) else value)
        except (TypeError, ValueError, RuntimeError):
            raise _refuse(TypeError, name, value, allowed) from None
        if found.dtype.kind not in kinds and (found.size or found.dtype.kind == "O"):
            raise _refuse(TypeError, name, value, allowed)
        bounded = low > -math.inf and found.dtype.kind in "iuf"
        if bounded and not ((found >= low) & (found <= high)).all():
            raise _refuse(ValueError, name, value, allowed)
        if ndim is not None and found.ndim != ndim:
            raise _refuse(ValueError, name, value, f"{allowed}, with {ndim} dimensions")
        return found

    return rule


def boolean(name: str, value: Any) -> bool:
    """True or False."""
    if not _is_bool(value):
        raise _refuse(TypeError, name, value, "it must be True or False")
    return bool(value)


def text(name: str, value: Any) -> str:
    """Text."""
    if not isinstance(value, str):
        raise _refuse(TypeError, name, value, "it must be text")
    return value


def path(name: str, value: Any) -> Path:
    """A path, as text or `pathlib.Path`; ~ is the home folder."""
    if not isinstance(value, (str, os.PathLike)) or isinstance(value, bytes):
        raise _refuse(TypeError, name, value, "it must be a path, text or pathlib.Path")
    return Path(value).expanduser()


def optional(rule: Rule) -> Rule:
    """None, or what the rule allows."""
    return lambda name, value: None if value is None else rule(name, value)


# ---- fields of configurations and files, by pydantic

_KINDS = {
    "string_type": "it must be text",
    "int_type": "it must be a whole number",
    "int_from_float": "it must be a whole number",
    "float_type": "it must be a number",
    "bool_type": "it must be true or false",
    **dict.fromkeys(("list_type", "tuple_type"), "it must be a list"),
    **dict.fromkeys(
        ("dict_type", "model_type", "model_attributes_type", "dataclass_type"),
        "it must hold fields (name: value)",
    ),
    "dataclass_exact_type": "it must be a {class_name}",
    "none_required": "it must be empty",
}
_BOUNDS = {
    "finite_number": "it must be a finite number",
    "greater_than": "it must be above {gt}",
    "greater_than_equal": "it must be {ge} or more",
    "less_than": "it must be below {lt}",
    "less_than_equal": "it must be {le} or less",
    "too_short": "it must have {min_length} entries or more, it has {actual_length}",
    "too_long": "it may have {max_length} entries, it has {actual_length}",
    "unexpected_keyword_argument": "there is no such field",
    "string_too_short": "it must have {min_length} characters or more",
    "string_too_long": "it may have {max_length} characters",
    "literal_error": "allowed are {expected}",
    "value_error": "{error}",
    "string_pattern_mismatch": "it must be of the form {pattern}",
}


def rule_of(error: Mapping[str, Any]) -> str:
    """The rule that one of pydantic's errors (`ValidationError.errors()`) broke, in words."""
    kind = str(error["type"])
    words = (_KINDS | _BOUNDS).get(kind)
    if words is None:
        message = str(error["msg"])
        words = f"{message[:1].lower()}{message[1:]}"
    else:
        bounds = (error.get("ctx") or {}).items()
        words = words.format(**{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in bounds})
    return printable(words)[:400]


@cache
def _adapters(owner: Any) -> dict[str, tuple[Any, str]]:
    """For each field of a dataclass: what validates it, and its description."""
    from pydantic import TypeAdapter

    found = {}
    hints = get_type_hints(owner, include_extras=True)
    for field in fields(owner):
        metadata = getattr(hints[field.name], "__metadata__", ())
        words = [w for m in metadata if (w := getattr(m, "description", None))]
        found[field.name] = (TypeAdapter(hints[field.name]), "".join(f": {w}" for w in words))
    return found


def validate_fields(owner: Any) -> None:
    """Hold the fields of a frozen dataclass to their annotations (`Annotated[float, Field(gt=0)]`).

    NumPy's numbers become Python's, lists and arrays become tuples, so that a file can store them.
    Whole numbers stay whole, also where the annotation says float.
    """
    from pydantic import ValidationError

    for name, (adapter, words) in _adapters(owner.__class__).items():
        given = getattr(owner, name)
        value = _plain(given)
        try:
            found = adapter.validate_python(value, strict=True)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            place = "".join(f"[{p}]" for p in first["loc"])
            odd = first["input"] if place else given
            other = first["type"] == "literal_error" and not isinstance(odd, str)
            kind = TypeError if other or first["type"] in _KINDS else ValueError
            where = f"{type(owner).__name__}.{name}{place}"
            raise _refuse(kind, where, odd, rule_of(first) + words) from None
        object.__setattr__(owner, name, value if type(value) is int else found)


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's; lists as tuples."""
    import numpy as np

    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    return tuple(map(_plain, value)) if isinstance(value, (list, tuple)) else value


# ---- text that people type

_WHOLE = re.compile(r"[-+]?[0-9]{1,30}")
_DECIMAL = re.compile(r"[-+]?([0-9]{1,30}(\.[0-9]{0,30})?|\.[0-9]{1,30})([eE][-+]?[0-9]{1,3})?")


def parse_number(text: str) -> float:
    """The finite number in decimal digits, such as 0.1, -2 or 1e-3; else ValueError.

    Python's `float` also reads 1_0, digits of other scripts, nan and infinity.
    """
    if not _DECIMAL.fullmatch(text) or not math.isfinite(float(text)):
        shown = repr(printable(text)[:40])
        raise ValueError(f"{shown} is not a plain number; write decimal digits, such as 0.1")
    return float(text)


def parse_whole_number(text: str) -> int:
    """The whole number in decimal digits; else ValueError."""
    if not _WHOLE.fullmatch(text):
        shown = repr(printable(text)[:40])
        raise ValueError(f"{shown} is not a whole number; write decimal digits, such as 10")
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
