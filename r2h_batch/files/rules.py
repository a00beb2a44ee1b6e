"""What a field must be, in words: pydantic's errors for people who did not write the schema."""

from collections.abc import Mapping
from typing import Any

from r2h_batch.files import printable

__all__ = ["rule_of"]

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
