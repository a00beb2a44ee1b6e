"""Tensors and rows that public functions may be given, told apart by type, shape and device alone:
nothing waits for a GPU."""

import operator
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ParamSpec, SupportsIndex, TypeVar

import numpy as np
import torch
from torch import Tensor

from r2h_batch.checks import Rule, given, takes

__all__ = [
    "check_indices",
    "check_range",
    "check_tensor",
    "checked_device",
    "rows_of",
    "takes_tensors",
]

_INTEGERS = (torch.int8, torch.int16, torch.int32, torch.int64, torch.uint8)


P = ParamSpec("P")
R = TypeVar("R")


def takes_tensors(**rules: Rule) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`checks.takes` for functions that torch.compile traces: there nothing is checked."""

    def held(function: Callable[P, R]) -> Callable[P, R]:
        checked = takes(**rules)(function)

        @wraps(function)
        def either(*args: P.args, **kwargs: P.kwargs) -> R:
            return (
                function(*args, **kwargs)
                if torch.compiler.is_compiling()
                else checked(*args, **kwargs)
            )

        return either

    return held


def check_tensor(name: str, value: Any, words: str) -> None:
    """TypeError where this is no plain tensor of numbers in memory; `words`: what it must be."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is {given(value)}; it must be {words}")
    if value.layout != torch.strided:
        layout = str(value.layout).removeprefix("torch.")
        raise TypeError(
            f"{name} is a tensor of layout {layout}; it must be {words}: call .to_dense()"
        )
    if not torch.compiler.is_compiling() and torch._C._functorch.is_functorch_wrapped_tensor(value):
        raise TypeError(
            f"{name} is inside torch.func (vmap, grad, jvp), which cannot look into kernels; it must be {words}: "
            "give all rows in one call, and take gradients with torch.autograd"
        )


def checked_device(device: str | torch.device) -> str:
    """The device as tensors on it call it (cuda:0); ValueError where it cannot be had."""
    allowed = "allowed are cpu, cuda, cuda:N"
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"device is {given(device)}; {allowed}") from error
    if found.type not in ("cpu", "cuda"):
        raise ValueError(f"device is {str(found)!r}; {allowed}")
    if found.type == "cpu":
        return "cpu"
    if not torch.cuda.is_available():
        raise ValueError(f"device is {str(found)!r}, torch sees no CUDA device; use device='cpu'")
    number = torch.cuda.current_device() if found.index is None else found.index
    if number >= torch.cuda.device_count():
        raise ValueError(
            f"device is {str(found)!r}; torch sees cuda:0 to cuda:{torch.cuda.device_count() - 1}"
        )
    return f"cuda:{number}"


def check_indices(name: str, index: Any, n: int | None, count: int, what: str) -> None:
    """TypeError or ValueError where this is no (n,) of indices from 0 to count - 1. The values are
    looked at on a CPU only: on a GPU the host would wait."""
    words = f"a torch tensor ({'N' if n is None else n},) of whole numbers"
    check_tensor(name, index, words)
    if index.dtype not in _INTEGERS:
        raise TypeError(f"{name} is {given(index)}; it must be {words}")
    if index.ndim != 1 or (n is not None and len(index) != n):
        raise ValueError(f"{name} is {given(index)}; it must be {words}")
    check_range(name, index, count, what)


def check_range(name: str, index: Tensor, count: int, what: str) -> None:
    """ValueError where indices are not from 0 to count - 1. They are looked at on a CPU only: on a
    GPU the host would wait."""
    if not index.is_cpu or not len(index) or torch.compiler.is_compiling():
        return
    low, high = (int(x) for x in torch.aminmax(index))
    if low < 0 or high >= count:
        raise ValueError(f"{name} runs from {low} to {high}; {what} has 0 to {count - 1}")


def rows_of(rows: Any, n: int) -> Any:
    """What a tensor of n rows is to be indexed by so that rows come out: a slice, whole numbers, or
    a mask."""
    allowed = f"it must be a row's number, a slice, whole numbers or a mask of the {n} rows"
    if isinstance(rows, (bool, np.bool_, tuple, str, bytes)) or rows is None or rows is Ellipsis:
        raise TypeError(f"rows is {given(rows)}; {allowed}")
    if isinstance(rows, slice):
        ends = (rows.start, rows.stop, rows.step)
        if not all(end is None or isinstance(end, SupportsIndex) for end in ends):
            raise TypeError(f"rows is {rows!r}; {allowed}")
        if (
            rows.step is not None
            and not torch.compiler.is_compiling()
            and operator.index(rows.step) < 1
        ):
            raise ValueError(f"rows is {rows!r}; its step must be 1 or more")
        return rows
    if isinstance(rows, SupportsIndex) and not isinstance(rows, (Tensor, np.ndarray)):
        row = operator.index(rows)
        if not -n <= row < n:
            raise IndexError(f"row {row} of {n} rows; allowed are {-n} to {n - 1}")
        return slice(row % n, row % n + 1)
    if isinstance(rows, Tensor):
        index = rows
    elif isinstance(rows, (Sequence, np.ndarray)):
        try:
            found = np.asarray(rows)
            index = torch.from_numpy(
                found.astype(np.int64 if not found.size and found.ndim == 1 else found.dtype)
            )
        except (TypeError, ValueError):
            raise TypeError(f"rows is {given(rows)}; {allowed}") from None
    else:
        raise TypeError(f"rows is {given(rows)}; {allowed}")
    if index.ndim == 0:
        index = index[None]
    if index.dtype == torch.bool:
        if len(index) != n:
            raise IndexError(f"rows is a mask of {len(index)} rows; it must be one of {n}")
        return index
    if index.dtype not in _INTEGERS:
        raise TypeError(f"rows is {given(rows)}; {allowed}")
    index = index.long()  # torch takes uint8 for a mask
    if index.device.type == "cpu" and index.numel() and not torch.compiler.is_compiling():
        low, high = (int(x) for x in torch.aminmax(index))
        if not -n <= low <= high < n:
            raise IndexError(
                f"row {low if low < -n else high} of {n} rows; allowed are {-n} to {n - 1}"
            )
    return index
