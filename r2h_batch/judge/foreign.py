"""Criteria of other packages: asked with copies of the evidence, and their answers looked at before the judge reads them."""

import copy
import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from numbers import Real
from typing import Any, TypeVar

import torch
from torch import Tensor

from r2h_batch.base.user_code import raised
from r2h_batch.base.validate_tensors import check_tensor
from r2h_batch.config import EvalConfig
from r2h_batch.plugins import PackageError, PluginError
from r2h_batch.scene.scene import Scene
from r2h_batch.strangers import stranger
from r2h_batch.verdicts import CRITERION, CriterionEntry, MarginKind

T = TypeVar("T")


def ask(
    entry: CriterionEntry,
    function: Callable[[], Callable[[Any], Any]],
    evidence: Any,
    active: Tensor,
    answer: type[T],
) -> T:
    """What another package's criterion answers about B handovers.

    Args:
        entry: the criterion.
        function: gives its equation.
        evidence: that the equation gets a copy of; scene and configuration are the judge's own.
        active: (B,) bool on the evidence's device.
        answer: what the equation must return.

    Raises:
        PackageError: one line: the equation raised something, or a field of its answer is wrong.
    """
    whose = CRITERION.entry(entry.name)
    try:
        with stranger(whose, entry.equation[0]):
            found: Any = function()(_copied(evidence))
    except (KeyboardInterrupt, PluginError, torch.OutOfMemoryError, torch.AcceleratorError):
        raise
    except BaseException as error:  # SystemExit too: it would end the command without a word
        raise PackageError(f"{whose}: {raised(error)}") from error
    if not isinstance(found, answer):
        raise PackageError(
            f"{whose}: answers {type(found).__name__}; it must be a {answer.__name__}"
        )
    try:
        _check(found, active)
    except TypeError as error:
        raise PackageError(f"{whose}: its answer's {error}") from error
    return found


def _copied(value: Any) -> Any:
    """A value with tensors of its own."""
    if isinstance(value, Tensor):
        return value.clone()
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(_copied(v) for v in value))
    if not is_dataclass(value) or isinstance(value, (type, Scene, EvalConfig)):
        return value
    own = copy.copy(value)
    for field in fields(value):
        object.__setattr__(own, field.name, _copied(getattr(value, field.name)))
    return own


def _check(found: Any, active: Tensor) -> None:
    """Raises TypeError, whose text begins with the name of a field, unless the answer is as `judge.scores.verdict` reads it."""
    kinds = found.kind_of
    if not isinstance(kinds, tuple) or not all(k in set(MarginKind) for k in kinds):
        raise TypeError(f"kind_of is {kinds!r:.100}; it must be a tuple of MarginKind")
    for name in ("limit", "cap"):
        value = getattr(found, name)
        number = isinstance(value, Real) and not isinstance(value, bool)  # NumPy's too
        if not number or not math.isfinite(value) or (name == "cap" and value < 0):
            raise TypeError(f"{name} is {value!r:.100}; it must be a finite number")
    if not isinstance(found.below, bool):
        raise TypeError(f"below is {found.below!r:.100}; it must be True or False")
    types = {
        "number": torch.float32,
        "evaluated": torch.bool,
        "passed": torch.bool,
        "kind": torch.int32 if kinds else torch.int8,
    }
    for name, dtype in types.items():
        value = getattr(found, name)
        if value is None and name in ("passed", "kind"):
            continue
        words = f"a tensor ({len(active)},) of {dtype} on {active.device}"
        value = check_tensor(name, value, words)
        if value.dtype != dtype or value.shape != active.shape or value.device != active.device:
            shown = f"a tensor {tuple(value.shape)} of {value.dtype} on {value.device}"
            raise TypeError(f"{name} is {shown}; it must be {words}")
    if not active.is_cuda or not torch.cuda.is_current_stream_capturing():
        _check_values(found, len(kinds) or len(MarginKind))


def _check_values(found: Any, kinds: int) -> None:
    judged = found.evaluated
    if not found.cap and bool((judged & (found.margin == torch.inf)).any()):
        raise TypeError(
            "number gives a margin of +inf; a clearance needs a `cap`, up to which it counts"
        )
    if found.kind is not None:
        own = found.kind[judged]
        if len(own) and not 0 <= int(own.min()) <= int(own.max()) < kinds:
            shown = f"{int(own.min())} to {int(own.max())}"
            raise TypeError(
                f"kind is {shown}; it must be 0 to {kinds - 1} (MarginKind, or a place in kind_of)"
            )
