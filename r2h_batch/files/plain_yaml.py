"""The plainest YAML: words, lists of words, numbers in decimal digits. What a configuration or a
stranger's file may hold."""

import math
import re
from pathlib import Path
from typing import Any

import yaml

from r2h_batch.files import FileError, printable, read_file

__all__ = ["read_plain_yaml"]

MAX_BYTES = 1 << 20
MAX_DEPTH = 4
KINDS = ("str", "int", "float", "bool", "null")
NUMBER = re.compile(
    r"[-+]?(0|[1-9][0-9]{0,17})(\.[0-9]{0,30})?([eE][-+]?[0-9]{1,3})?|[-+]?\.[0-9]{1,30}"
)


class _Loader(yaml.SafeLoader):
    """Plain data only: no tags, no anchors (a small file could grow without end), no key twice,
    words as keys, numbers as they are written in decimal digits (YAML 1.1 reads 1:30 as 90 and 017
    as 15), nothing nested deeply."""

    depth, deepest = 0, MAX_DEPTH

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()
        if self.depth > self.deepest:
            raise _refused(event, "nested too deeply")
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise _refused(event, "anchors and aliases are not allowed")
        if getattr(event, "tag", None):
            raise _refused(event, f"tag {event.tag[:40]} is not allowed")
        self.depth += 1
        node: Any = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key, value in node.value:
            if key.tag != "tag:yaml.org,2002:str":
                what = repr(key.value[:40]) if isinstance(key.value, str) else "a list or mapping"
                raise _refused(key, f"{what} is a key; keys are words")
            if key.value in seen:
                raise _refused(key, f"{key.value[:40]} is given twice")
            seen.add(key.value)
            _check_value(key.value[:40], value)
        return super().construct_mapping(node, deep)


# YAML 1.1 takes 1e-3 for a word; everybody else for a number
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+\Z"),
    list("-+0123456789"),
)


def _check_value(field: str, node: Any) -> None:
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_value(field, item)
    elif isinstance(node, yaml.ScalarNode):
        kind, text = node.tag.rpartition(":")[2], str(node.value)
        if kind == "timestamp":
            node.tag = "tag:yaml.org,2002:str"  # a folder's name
        elif kind not in KINDS:
            raise _refused(
                node, f"{field} is {text[:40]!r}, to YAML a {kind}; put quotes around a word"
            )
        elif kind in ("int", "float") and not (
            NUMBER.fullmatch(text) and math.isfinite(float(text))
        ):
            raise _refused(node, f"{field} is {text[:40]!r}, no plain number; write decimal digits")


def _refused(where: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=where.start_mark)


def read_plain_yaml(
    path: Path, *, most: int = MAX_BYTES, deepest: int = MAX_DEPTH
) -> dict[str, Any]:
    """The fields of a file of at most `most` bytes, or a `FileError` that names the line."""
    loader = type("_Loader", (_Loader,), {"deepest": deepest})
    try:
        data = yaml.load(read_file(path, most).decode("utf-8"), loader)
    except FileError:
        raise
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        problem = printable(getattr(error, "problem", None) or error or "nested too deeply")
        raise FileError(f"{printable(path)}:{where} {problem[:300]}") from None
    if not isinstance(data, dict):
        found = (
            "it is empty"
            if data is None
            else f"not {'a list' if isinstance(data, list) else 'one word or number'}"
        )
        raise FileError(f"{printable(path)}: must hold fields, one `name: value` a line; {found}")
    return data
