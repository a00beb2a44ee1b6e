"""Checks of tensors that public functions take: type, layout, shape, device.

No check waits for a GPU: values are looked at on a CPU only.
"""

import operator
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, ParamSpec, SupportsIndex, TypeVar

import numpy as np
import torch
from torch import Tensor

from r2h_batch.base.validate import Rule, check_arguments, describe_value

_INTEGERS = (torch.int8, torch.int16, torch.int32, torch.int64, torch.uint8)

FEW = 64
"""So many numbers Python compares faster than torch starts to."""

P = ParamSpec("P")
R = TypeVar("R")


def check_tensor_arguments(**rules: Rule) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """`validate.check_arguments` for functions that torch.compile traces: it checks nothing there."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        checked = check_arguments(**rules)(function)

        @wraps(function)
        def either(*args: P.args, **kwargs: P.kwargs) -> R:
            compiling = torch.compiler.is_compiling()
            return function(*args, **kwargs) if compiling else checked(*args, **kwargs)

        return either

    return decorate


def check_tensor(name: str, value: Any, words: str) -> Tensor:
    """The tensor, if it is a plain one in memory, for kernels that read its memory.

    Args:
        name: the argument's name.
        value: the argument.
        words: what it must be, for the message.

    Returns:
        The tensor with the negative and the conjugate bit resolved: its memory holds its values.

    Raises:
        TypeError: it is not a tensor, not strided, wrapped by torch.func, or its memory is missing
            or smaller than its shape says.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is {describe_value(value)}; it must be {words}")
    if value.layout != torch.strided or value.is_nested:
        layout = "nested" if value.is_nested else str(value.layout).removeprefix("torch.")
        found = f"{name} is a tensor of layout {layout}"
        raise TypeError(f"{found}; it must be {words}: call .to_dense()")
    if torch.compiler.is_compiling():
        return value
    try:
        address = value.data_ptr()
    except RuntimeError:  # tensors that torch.func wraps have no memory of their own
        found = f"{name} is inside torch.func (vmap, grad, jvp), which cannot look into kernels"
        how = "give all rows in one call, and take gradients with torch.autograd"
        raise TypeError(f"{found}; it must be {words}: {how}") from None
    if value.numel():
        last = sum((n - 1) * step for n, step in zip(value.shape, value.stride(), strict=True))
        end = (value.storage_offset() + last + 1) * value.element_size()
        if not address or end > value.untyped_storage().nbytes():  # fake, meta, freed, shrunk
            raise TypeError(f"{name} has no memory for its numbers; it must be {words}")
    return value.resolve_conj().resolve_neg()


def as_numbers(name: str, value: Any, words: str, device: str | torch.device) -> Tensor:
    """A tensor of float32 or float64 from anything that holds real numbers.

    One rule for all arguments that hold measures: a torch tensor, a NumPy array, or nested lists
    of numbers. Whole numbers become float64; half precision (steps of 0.5 mm at 1 m) is refused.

    Args:
        name: the argument's name.
        value: the argument.
        words: what it must be, for the message.
        device: where arrays and lists are copied to; a tensor stays where it is.

    Raises:
        TypeError: it does not hold real numbers, some of them are masked, or it is not a plain tensor in
            memory (`check_tensor`).
    """
    words = f"{words} (or a NumPy array, or nested lists)"
    if not isinstance(value, Tensor):
        parts = value if isinstance(value, (list, tuple)) else (value,)
        if any(np.ma.is_masked(part) for part in parts):  # a tensor has no masks
            how = "call .filled(numpy.nan), which makes their rows invalid"
            raise TypeError(f"{name} holds masked numbers; it must be {words}: {how}")
        try:
            if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, np.ndarray)):
                raise TypeError
            found = np.asarray(value)
            if found.dtype.kind not in "fiu" or (
                found.dtype.itemsize < 4 and found.dtype.kind == "f"
            ):
                raise TypeError
            value = torch.tensor(found.astype(np.float64), dtype=torch.float64, device=device)
        except (TypeError, ValueError):
            raise TypeError(f"{name} is {describe_value(value)}; it must be {words}") from None
    value = check_tensor(name, value, words)
    if value.dtype in _INTEGERS:
        value = value.double()
    if value.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} is {value.dtype}; it must be {words}: call .float()")
    return value


def checked_device(device: str | torch.device) -> str:
    """The device's name as tensors give it (`cpu`, `cuda:0`).

    Raises:
        ValueError: the device does not exist.
    """
    allowed = "allowed are cpu, cuda, cuda:N"
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"device is {describe_value(device)}; {allowed}") from error
    if found.type == "cpu":
        return "cpu"
    if found.type != "cuda":
        raise ValueError(f"device is {str(found)!r}; {allowed}")
    if not torch.cuda.is_available():
        raise ValueError(f"device is {str(found)!r}, torch sees no CUDA device; use device='cpu'")
    number = torch.cuda.current_device() if found.index is None else found.index
    if number >= torch.cuda.device_count():
        last = torch.cuda.device_count() - 1
        raise ValueError(f"device is {str(found)!r}; torch sees cuda:0 to cuda:{last}")
    return f"cuda:{number}"


def check_indices(name: str, index: Any, n: int | None, count: int, what: str) -> None:
    """Refuse what is no (n,) tensor of indices below `count`.

    Args:
        name: the argument's name.
        index: the argument.
        n: its length; None allows any.
        count: number of things it indexes.
        what: what these are in, for the message.

    Raises:
        TypeError: it is not a tensor of whole numbers.
        ValueError: its shape or, on a CPU, its range is wrong.
    """
    words = f"a torch tensor ({'N' if n is None else n},) of whole numbers"
    check_tensor(name, index, words)
    if index.dtype not in _INTEGERS:
        raise TypeError(f"{name} is {describe_value(index)}; it must be {words}")
    if index.ndim != 1 or (n is not None and len(index) != n):
        raise ValueError(f"{name} is {describe_value(index)}; it must be {words}")
    check_range(name, index, count, what)


def check_range(name: str, index: Tensor, count: int, what: str) -> None:
    """Refuse indices outside 0 to count - 1 with ValueError; only on a CPU."""
    if not index.is_cpu or not len(index) or torch.compiler.is_compiling():
        return
    if len(index) <= FEW:
        numbers = index.tolist()
        low, high = min(numbers), max(numbers)
    else:
        low, high = (int(x) for x in torch.aminmax(index))
    if low < 0 or high >= count:
        raise ValueError(f"{name} runs from {low} to {high}; {what} has 0 to {count - 1}")


def row_index(rows: Any, n: int) -> slice | Tensor:
    """The index that selects rows of tensors of n rows, and keeps the dimension of rows.

    Args:
        rows: a row's number, a slice, whole numbers, or a mask.
        n: number of rows.

    Raises:
        TypeError, ValueError: it is none of these.
        IndexError: a row does not exist.
    """
    if isinstance(rows, slice):
        ends = (rows.start, rows.stop, rows.step)
        if not all(end is None or isinstance(end, SupportsIndex) for end in ends):
            raise _no_rows(rows, n)
        compiling = torch.compiler.is_compiling()
        if rows.step is not None and not compiling and operator.index(rows.step) < 1:
            raise ValueError(f"rows is {rows!r}; its step must be 1 or more")
        return rows
    if isinstance(rows, (bool, np.bool_, tuple, str, bytes)):
        raise _no_rows(rows, n)
    if isinstance(rows, SupportsIndex) and not isinstance(rows, (Tensor, np.ndarray)):
        row = operator.index(rows)
        if not -n <= row < n:
            raise IndexError(f"row {row} of {n} rows; allowed are {-n} to {n - 1}")
        return slice(row % n, row % n + 1)
    index = rows
    if not isinstance(rows, Tensor):
        if not isinstance(rows, (Sequence, np.ndarray)):
            raise _no_rows(rows, n)
        try:
            found = np.asarray(rows)
            empty = not found.size and found.ndim == 1
            index = torch.from_numpy(found.astype(np.int64 if empty else found.dtype))
        except (TypeError, ValueError):
            raise _no_rows(rows, n) from None
    if index.ndim == 0:
        index = index[None]
    if index.dtype == torch.bool:
        if len(index) != n:
            raise IndexError(f"rows is a mask of {len(index)} rows; it must be one of {n}")
        return index
    if index.dtype not in _INTEGERS:
        raise _no_rows(rows, n)
    index = index.long()  # torch takes uint8 for a mask
    if index.device.type == "cpu" and index.numel() and not torch.compiler.is_compiling():
        low, high = (int(x) for x in torch.aminmax(index))
        if not -n <= low <= high < n:
            row = low if low < -n else high
            raise IndexError(f"row {row} of {n} rows; allowed are {-n} to {n - 1}")
    return index


def _no_rows(rows: Any, n: int) -> TypeError:
    allowed = f"it must be a row's number, a slice, whole numbers or a mask of the {n} rows"
    return TypeError(f"rows is {describe_value(rows)}; {allowed}")
