"""Binds a kernel's arguments by name: what a caller gives is checked against what the kernel
declares, then packed.

A Warp launch takes a list, and two arrays of one kind that change places run without a word. Here a
caller names them:

    launch_trials(kernel, n, inputs={"world": ..., "q": ...}, outputs={"distance": ...},
    device="cpu")

`q` fills the parameter `q_in`, `distance` the parameter `distance_out`. What a kernel writes ends
in `_out`, `_inout` (it is read too) or `_scratch` (never read afterwards) and goes to
`outputs`; all else, structs and tables included, to `inputs`.

Tensors and NumPy arrays are passed as they are: the kernel's own declaration says that (b, 4, 4)
float32 means `mat44`. The descriptor is built here, at about half the time that `wp.from_torch`
takes; no gradient goes along.
"""

import ctypes
import difflib
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import prod
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor
from warp.types import types_equal

_WRITTEN = ("_inout", "_out", "_scratch")

_FLOATS = (wp.float32, wp.float64)


def _tensor_guards() -> Any:
    try:
        from torch._C._dynamo.guards import TensorGuards
    except ImportError:  # another torch
        return None
    return TensorGuards


TENSOR_GUARDS = _tensor_guards()
"""torch's own check of many tensors at once (private, torch 2.13). None without it: then every
tensor is looked at in each call."""


class TensorLayoutGuard:
    """Knows tensors again by class, data type, device, shape and strides, and by whether they wait
    for a gradient.

    It may say no of tensors that are alike (in torch's inference mode), never yes of others. It
    keeps no tensor alive.
    """

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        places: dict[int, list[int]] = {}
        for i, x in enumerate(tensors):
            places.setdefault(id(x), []).append(i)
        # the guards refuse a tensor that is given twice; a kernel does not
        self._once = [same[0] for same in places.values()]
        self._twins = [(same[0], i) for same in places.values() for i in same[1:]]
        self._check: Callable[..., bool] | None = None
        if TENSOR_GUARDS is not None and tensors:
            once = (tensors[i] for i in self._once)
            self._check = TENSOR_GUARDS(
                *once, dynamic_dims_sizes=None, dynamic_dims_strides=None
            ).check

    def __call__(self, others: Sequence[object]) -> bool:
        """Whether these, as many as before, have the same layout each."""
        if self._check is None:
            return False
        if not self._twins:
            return self._check(*others)
        return all(others[i] is others[j] for i, j in self._twins) and self._check(
            *(others[i] for i in self._once)
        )


@dataclass(frozen=True)
class Parameter:
    """One parameter of a kernel; `label` is its name there, `name` what a caller calls it."""

    kernel: str
    label: str
    type: Any
    pack: Callable[["Parameter", Any, Any, int], Any]
    array: "Layout | None" = None

    @property
    def written(self) -> bool:
        return self.label.endswith(_WRITTEN)

    @property
    def name(self) -> str:
        return _name(self.label)


class Layout(NamedTuple):
    """How memory looks that may be passed for an array of the kernel."""

    ndim: int  # of the kernel's array
    item: tuple[int, ...]  # dimensions of one element: (3,) of vec3, (4, 4) of mat44, () of float
    numpy: Any  # data types of one number
    torch: Any
    bytes: int  # of one element
    descriptor: Any  # Warp's ctypes structure of an array


class Signature(NamedTuple):
    """A kernel's parameters but `first`, in its order: (name, is written, parameter)."""

    kernel: str
    parameters: tuple[tuple[str, bool, Parameter], ...]
    inputs: int
    outputs: int


def bind(
    kernel: Any,
    inputs: Mapping[str, Any],
    outputs: Mapping[str, Any],
    device: str,
    *,
    trials: int | None = None,
) -> list[Any]:
    """The arguments in the kernel's order, packed; without its leading `first`, which a kernel over
    `trials` must have.

    Raises TypeError for names (missing, unknown, on the wrong side) and kinds (data type,
    dimensions, contiguity, device, struct), ValueError for an output with fewer rows than trials;
    each names kernel, argument, what was given and declared.
    """
    signature = _signature(kernel, trials is not None)
    if len(inputs) != signature.inputs or len(outputs) != signature.outputs:
        raise _wrong_names(signature, inputs, outputs)
    place = wp.get_device(device)
    rows = trials or 0
    try:
        # both sides have as many names as the kernel: if all of its names are found, there is no
        # other
        return [
            p.pack(p, (outputs if written else inputs)[name], place, rows)
            for name, written, p in signature.parameters
        ]
    except KeyError:
        raise _wrong_names(signature, inputs, outputs) from None


def new_outputs(
    kernel: Any, n: int, device: Any, **sizes: int | tuple[int, ...]
) -> dict[str, Tensor]:
    """Memory of `n` rows for each array that a kernel over trials writes and does not read, by the
    names of `bind`.

    Args:
        kernel: its parameters that end in `_out` (zeros) or `_scratch` (no numbers yet).
        n: rows.
        device: of torch or by name.
        sizes: of each array with further dimensions, how large these are.
    """
    return {
        name: new(shape, dtype=dtype, device=device)
        for name, new, shape, dtype in written_shapes(kernel, n, sizes)
    }


def written_shapes(
    kernel: Any,
    n: int,
    sizes: Mapping[str, int | tuple[int, ...]],
    given: Container[str] = (),
) -> Iterator[tuple[str, Any, tuple[int, ...], torch.dtype]]:
    """The arrays that `new_outputs` makes, less those that are given: name, by which function of torch, shape, type of
    a number."""
    for name, new, further, item, dtype in _written(kernel):
        if name not in given:
            yield name, new, (n, *_dims(sizes[name] if further else ()), *item), dtype


def _dims(size: int | tuple[int, ...]) -> tuple[int, ...]:
    return size if isinstance(size, tuple) else (size,)


@cache
def _written(kernel: Any) -> tuple[tuple[str, Any, bool, tuple[int, ...], torch.dtype], ...]:
    """Each array that `new_outputs` makes: name, by which function, whether there is a second
    dimension, the dimensions of an element, type of a number."""
    return tuple(
        (
            p.name,
            torch.zeros if p.label.endswith("_out") else torch.empty,
            p.array.ndim > 1,
            p.array.item,
            p.array.torch,
        )
        for p in parameters(kernel)
        if p.array is not None and p.label.endswith(("_out", "_scratch"))
    )


def struct_of(kind: Any, tensors: Mapping[str, Tensor]) -> Any:
    """A `kind` (of wp.struct) whose arrays are these tensors' memory, which it keeps. They lie on
    one device.

    Raises TypeError where a tensor is not what the struct declares, KeyError where one is missing.
    """
    made = kind()
    descriptors, fields = made.__ctype__(), _fields(kind)
    values = tuple(tensors[name] for name, _ in fields)
    of_these, packed = _last_packed.get(kind, (None, b""))
    if of_these is not None and of_these(values):  # only addresses differ
        ctypes.memmove(ctypes.addressof(descriptors), packed, len(packed))
        for (name, _), value in zip(fields, values, strict=True):
            getattr(descriptors, name).data = value.data_ptr()
    else:
        place = wp.device_from_torch(values[0].device)
        for (name, p), value in zip(fields, values, strict=True):
            setattr(descriptors, name, _pack_array(p, value, place, 0))
        _last_packed[kind] = TensorLayoutGuard(values), bytes(descriptors)
    vars(made)["tensors"] = tensors
    return made


def struct_with(base: Any, kind: Any, tensors: Mapping[str, Tensor]) -> Any:
    """A copy of `base`, a `kind` (of wp.struct), with these tensors' memory in place of some of its arrays.

    It keeps the tensors, and in its own `tensors` also what it is a copy of.
    """
    made = kind()
    made.assign(base)  # the other arrays are shared
    for name, value in tensors.items():
        setattr(made, name, wp.from_torch(value, dtype=kind.vars[name].type.dtype))
    vars(made)["tensors"] = {"base": base, **tensors}
    return made


_last_packed: dict[Any, tuple[TensorLayoutGuard, bytes]] = {}
"""The layout of the tensors that `struct_of` packed last and the packed bytes, for each struct."""


@cache
def _fields(kind: Any) -> tuple[tuple[str, "Parameter"], ...]:
    """The arrays of a struct."""
    return tuple(
        (name, _parameter(kind.key, name, declared.type)) for name, declared in kind.vars.items()
    )


def parameters(kernel: Any) -> tuple[Parameter, ...]:
    """The kernel's declared arguments in its order, without `first`."""
    return tuple(
        p for _, _, p in _signature(kernel, kernel.adj.args[0].label == "first").parameters
    )


@cache
def _signature(kernel: Any, over_trials: bool) -> Signature:
    labels = [a.label for a in kernel.adj.args]
    if (labels[:1] == ["first"]) != over_trials:
        raise TypeError(
            f"kernel {kernel.key} {'lacks' if over_trials else 'has'} a leading parameter `first`: "
            f"use {'launch' if over_trials else 'launch_trials'}"
        )
    found = [_parameter(kernel.key, a.label, a.type) for a in kernel.adj.args[over_trials:]]
    written = sum(p.written for p in found)
    return Signature(
        kernel.key, tuple((p.name, p.written, p) for p in found), len(found) - written, written
    )


def _name(label: str) -> str:
    for suffix in ("_inout", "_out", "_in", "_scratch"):
        if label.endswith(suffix):
            return label.removesuffix(suffix)
    return label


def _parameter(kernel: str, label: str, declared: Any) -> Parameter:
    if isinstance(declared, wp.array):
        return Parameter(kernel, label, declared, _pack_array, _layout(declared))
    if hasattr(declared, "vars"):  # of wp.struct
        return Parameter(kernel, label, declared, _pack_struct)
    if _elements(declared)[1]:  # a vector or a matrix
        return Parameter(kernel, label, declared, _pack_value)
    return Parameter(kernel, label, declared, _pack_float if declared in _FLOATS else _pack_integer)


def _layout(declared: Any) -> Layout:
    number, item = _elements(declared.dtype)
    return Layout(
        declared.ndim,
        item,
        number,
        getattr(torch, number.name),
        number.itemsize * prod(item),
        _descriptor(),
    )


@cache
def _elements(kind: Any) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """The numbers that an array's element consists of, and their shape: (3,) of a vec3."""
    empty = wp.empty(0, dtype=kind, device="cpu").numpy()
    return empty.dtype, empty.shape[1:]


@cache
def _descriptor() -> Any:
    """The type that `wp.from_torch(..., return_ctype=True)` returns; Warp exports it under no
    name."""
    return type(wp.empty(0, dtype=wp.float32, device="cpu").__ctype__())


def _pack_array(p: Parameter, value: Any, place: Any, rows: int) -> Any:
    """The array, or a descriptor of the tensor's memory (`array_t`, which Warp passes on as it
    is)."""
    layout = p.array
    assert layout is not None
    if isinstance(value, wp.array):
        if value.ndim != layout.ndim or not types_equal(value.dtype, p.type.dtype):
            raise _wrong_kind(p, value, place)
        if not value.is_contiguous or value.device is not place:
            raise _wrong_kind(p, value, place)
        shape, packed = value.shape, value
    else:
        if isinstance(value, np.ndarray):  # trimesh's arrays are of a class of their own
            if value.dtype != layout.numpy or not value.flags.c_contiguous or not place.is_cpu:
                raise _wrong_kind(p, value, place)
            pointer = value.ctypes.data
        elif hasattr(value, "data_ptr"):
            # asked by flag and number: `device` builds an object each time
            same_device = value.is_cpu if place.is_cpu else value.get_device() == place.ordinal
            if value.dtype is not layout.torch or not value.is_contiguous() or not same_device:
                raise _wrong_kind(p, value, place)
            pointer = value.data_ptr()
        else:
            raise _wrong_kind(p, value, place)
        shape = tuple(value.shape)
        if len(shape) != layout.ndim + len(layout.item) or shape[layout.ndim :] != layout.item:
            raise _wrong_kind(p, value, place)
        shape = shape[: layout.ndim]
        packed = layout.descriptor(pointer, 0, layout.ndim, shape, _strides(shape, layout.bytes))
    if p.written and shape[0] < rows:
        raise ValueError(
            f"kernel {p.kernel}: {_which(p)} has {shape[0]} rows; {rows} trials write {rows} or more"
        )
    return packed


def _strides(shape: tuple[int, ...], step: int) -> tuple[int, ...]:
    """Strides of contiguous memory, bytes. Torch may give other ones to empty tensors and to dimensions of
    1."""
    if len(shape) == 1:
        return (step,)
    strides = [step]
    for n in shape[:0:-1]:
        strides.append(strides[-1] * n)
    return tuple(reversed(strides))


def _pack_struct(p: Parameter, value: Any, place: Any, rows: int) -> Any:
    if type(value) is not p.type.instance_type:
        raise _wrong_kind(p, value, place)
    return value


def _pack_value(p: Parameter, value: Any, place: Any, rows: int) -> Any:
    if not types_equal(type(value), p.type):
        raise _wrong_kind(p, value, place)
    return value


def _pack_integer(p: Parameter, value: Any, place: Any, rows: int) -> Any:
    if type(value) is int or isinstance(value, (np.integer, p.type)):
        return value
    raise _wrong_kind(p, value, place)


def _pack_float(p: Parameter, value: Any, place: Any, rows: int) -> Any:
    """A whole number is taken too: 0 m is a length."""
    if type(value) is float or type(value) is int or isinstance(value, (np.floating, p.type)):
        return value
    raise _wrong_kind(p, value, place)


def _wrong_kind(p: Parameter, value: Any, place: Any) -> TypeError:
    return TypeError(
        f"kernel {p.kernel}: {_which(p)} is {_description(value)}; the kernel declares {_declared(p, place)}"
    )


def _which(p: Parameter) -> str:
    return f"{'output' if p.written else 'input'} `{p.name}` (parameter {p.label})"


def _description(value: Any) -> str:
    if isinstance(value, wp.array):
        whole = "" if value.is_contiguous else "non-contiguous "
        return f"a {whole}wp.array of {_type_name(value.dtype)} with shape {value.shape} on {value.device}"
    if isinstance(value, np.ndarray):
        whole = "" if value.flags.c_contiguous else "non-contiguous "
        return f"a {whole}NumPy array of {value.dtype} with shape {value.shape} on cpu"
    if hasattr(value, "data_ptr"):
        whole = "" if value.is_contiguous() else "non-contiguous "
        return f"a {whole}tensor of {str(value.dtype).removeprefix('torch.')} with shape {tuple(value.shape)} on {value.device}"
    if hasattr(value, "numpy_value"):  # of wp.struct
        return f"a struct {repr(value).partition('(')[0]}"
    return f"{value!r} ({type(value).__name__})"


def _declared(p: Parameter, place: Any) -> str:
    if p.array is None:
        return f"{'a struct ' if hasattr(p.type, 'vars') else ''}{_type_name(p.type)}"
    shape = ", ".join([*(["n"] * p.array.ndim), *map(str, p.array.item)])
    return (
        f"{p.array.ndim} dimension(s) of {_type_name(p.type.dtype)}: give a contiguous wp.array of that, or {p.array.numpy} "
        f"with shape ({shape}), on {place}"
    )


def _type_name(kind: Any) -> str:
    return str(getattr(kind, "key", None) or getattr(kind, "__name__", kind)).rsplit(".", 1)[-1]


def _wrong_names(
    signature: Signature, inputs: Mapping[str, Any], outputs: Mapping[str, Any]
) -> TypeError:
    wanted = {
        side: [n for n, written, _ in signature.parameters if written is side]
        for side in (False, True)
    }
    faults: list[str] = []
    for side, names in ((False, inputs), (True, outputs)):
        word, other = ("output", "input") if side else ("input", "output")
        missing = [n for n in wanted[side] if n not in names]
        for name in names:
            if name in wanted[side]:
                continue
            if name in wanted[not side]:
                faults.append(f"`{name}` is given as {word}, the kernel declares it as {other}")
            else:
                faults.append(
                    f"{word} `{name}` is unknown{_nearest(name, missing or wanted[side])}"
                )
        if missing:
            faults.append(f"{word} {', '.join(f'`{n}`' for n in missing)} missing")
    declared = (
        f"inputs {', '.join(wanted[False]) or 'none'}; outputs {', '.join(wanted[True]) or 'none'}"
    )
    return TypeError(f"kernel {signature.kernel}: {'; '.join(faults)}. It declares {declared}")


def _nearest(name: str, names: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(names), 1, 0.5)
    return f" (did you mean `{close[0]}`?)" if close else ""
