"""Functions that users are promised say what each argument is (the first line of a docstring says what comes out).

Promised are the names in `__all__` of the package, its rooms and their folders; what docs/reference/python.md shows; and what
the docs import from a room. Of a class: its public methods, and its constructor unless it is a dataclass (there each field has
its own string)."""

import importlib
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
IMPORTED = re.compile(r"^\s*from (r2h_batch[\w.]*) import ([\w, ]+?)(?:  #.*)?$", re.MULTILINE)
SHOWN = re.compile(r"^::: ([\w.]+)", re.MULTILINE)
ENTRY = re.compile(r"^    (\*{0,2}\w+(?:, \*{0,2}\w+)*)(?: \(.*\))?: ", re.MULTILINE)


def promised() -> dict[str, Any]:
    """Each promised object by its path."""
    found: dict[str, Any] = {}
    for file in sorted((ROOT / "r2h_batch").rglob("__init__.py")):
        module = importlib.import_module(".".join(file.parent.relative_to(ROOT).parts))
        found |= {f"{module.__name__}.{n}": getattr(module, n) for n in getattr(module, "__all__", ())}
    for text in (page.read_text(encoding="utf-8") for page in DOCS):
        for path in SHOWN.findall(text):
            found[path] = named(path)
        for module_name, names in IMPORTED.findall(text):
            for name in re.findall(r"\w+", names.partition(" as ")[0]):
                found[f"{module_name}.{name}"] = named(f"{module_name}.{name}")
    return found


def named(path: str) -> Any:
    """A module, or what one has under this name."""
    module, _, name = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except AttributeError:
        return importlib.import_module(path)


def functions(path: str, thing: Any) -> Iterator[tuple[str, Callable[..., Any], str]]:
    """Callables of a module, class or function: path, itself, its words. A class may say its constructor's."""
    if isinstance(thing, ModuleType):
        for name, value in vars(thing).items():
            if getattr(value, "__module__", None) == thing.__name__ and not name.startswith("_"):
                yield from functions(f"{path}.{name}", value)
    elif inspect.isclass(thing):
        for name, value in vars(thing).items():
            made_here = name == "__init__" and not is_dataclass(thing)
            method = value.__func__ if isinstance(value, classmethod | staticmethod) else value
            if inspect.isfunction(method) and (made_here or not name.startswith("_")):
                words = inspect.getdoc(method) or ""
                yield f"{path}.{name}", method, (inspect.getdoc(thing) or "") + f"\n\n{words}" if made_here else words
    elif inspect.isfunction(thing):
        yield path, thing, inspect.getdoc(thing) or ""


def section(docstring: str, title: str) -> str:
    """The indented lines below `title:`; empty without them."""
    found = re.search(rf"^{title}:\n((?: +.*\n|\n)*)", docstring + "\n", re.MULTILINE)
    return found[1] if found else ""


def what_lacks(function: Callable[..., Any], words: str) -> list[str]:
    """Arguments that `Args` does not name, and names in it that are no argument."""
    said = {n.strip(" *") for names in ENTRY.findall(section(words, "Args")) for n in names.split(",")}
    takes = [n for n in inspect.signature(function).parameters if n not in ("self", "cls") and not n.startswith("_")]
    return [n for n in takes if n not in said] + [f"no argument: {n}" for n in sorted(said) if n not in takes]


@pytest.mark.check
def test_promised_functions_say_what_each_argument_is() -> None:
    known: dict[Any, tuple[str, str]] = {}
    for path, thing in promised().items():
        for name, function, words in functions(path, thing):
            known.setdefault(function, (name, words))
    lacking = {name: lacks for function, (name, words) in known.items() if (lacks := what_lacks(function, words))}
    assert len(known) > 150 and lacking == {}


def _taught(first: int, second: str) -> int:
    """A sum.

    Args:
        first: metres.
        third: seconds.
    """
    return first + len(second)


def test_a_missing_argument_and_a_wrong_name_are_found() -> None:
    assert what_lacks(_taught, inspect.getdoc(_taught) or "") == ["second", "no argument: third"]
