"""Data out of a stranger's pickle, without Python's unpickler: no import, no call, no object of a
foreign class.

A pickle is a program for a small stack machine. Here that machine only knows data: containers,
numbers, text, bytes, and descriptions of a few classes that the hand data sets use: numpy's arrays,
dtypes and scalars, scipy's csc and csr matrices, chumpy's `Ch` (an array in `x`) and `Select`
(`a.ravel()[idxs].reshape(preferred_shape)`), OrderedDict. Arrays are views of bytes that are in the
file, so nothing is allocated for a size that the file only claims.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.importers.pickle_machine import Machine, Made, Name, UnsafePickle, short

__all__ = ["MAX_BYTES", "UnsafePickle", "read_pickle"]

MAX_BYTES = 256 << 20
"""MANO's own files have 3.8 MB, a sequence of ARCTIC 1 MB."""
MAX_DEPTH = 32
MAX_DENSE = 1 << 24
"""Numbers that a sparse matrix may unfold to, and that all results together may hold beyond the
file's own bytes."""

_KINDS = "biufcSU"


STARTS = (b"\x80", b"(", b"c", b"}", b"]", b")")
"""First bytes of pickles; all pickles end with a full stop."""


def read_pickle(data: bytes, *, where: str = "pickle", max_bytes: int = MAX_BYTES) -> Any:
    """The data of one pickle: dicts, lists, tuples, str, bytes, numbers, and dense arrays for all
    array-like classes.

    Strings of Python 2 are read as latin-1. Raises `UnsafePickle`, one line that starts with
    `where`.
    """
    if len(data) > max_bytes:
        raise UnsafePickle(f"{where}: {len(data)} bytes; a pickle may have {max_bytes}")
    try:
        return _Unfold().of(Machine(data).run())
    except UnsafePickle as error:
        if data and data[:1] not in STARTS and not data.rstrip().endswith(b"."):
            what = f"no pickle (it begins with {data[:16]!r}); give the file as its owners give it"
            raise UnsafePickle(f"{where}: {what}") from None
        raise UnsafePickle(f"{where}: {error}") from None
    except (
        ValueError,
        IndexError,
        KeyError,
        TypeError,
        AttributeError,
        OverflowError,
        EOFError,
        RecursionError,
    ) as error:
        raise UnsafePickle(
            f"{where}: not a readable pickle ({type(error).__name__}: {short(error)})"
        ) from None


class _Unfold:
    """Plain data from what the machine left: every object once, no circles, no depth beyond
    `MAX_DEPTH`."""

    def __init__(self) -> None:
        self.done: dict[int, Any] = {}
        self.open: set[int] = set()
        self.dense = 0

    def of(self, value: Any, depth: int = 0) -> Any:
        if not isinstance(value, (dict, list, tuple, Made, Name)):
            return value
        if id(value) in self.done:
            return self.done[id(value)]
        if id(value) in self.open:
            raise UnsafePickle("contains itself")
        if depth > MAX_DEPTH:
            raise UnsafePickle(f"is nested more than {MAX_DEPTH} deep")
        self.open.add(id(value))
        result = self._plain(value, depth + 1)
        self.open.remove(id(value))
        self.done[id(value)] = result
        return result

    def _plain(self, value: Any, depth: int) -> Any:
        if isinstance(value, Name):
            raise UnsafePickle(f"stores the name {value.name} itself")
        if isinstance(value, dict):
            return {k: self.of(v, depth) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return type(value)(self.of(v, depth) for v in value)
        made = {
            "_reconstruct": self._array, "ndarray": self._array, "_frombuffer": self._buffer, "scalar": self._scalar,
            "csc_matrix": self._sparse, "csr_matrix": self._sparse, "encode": self._bytes, "bytes": self._bytes,
            "chumpy.Ch": self._chumpy, "chumpy.Select": self._select, "OrderedDict": self._ordered,
        }.get(value.name)  # fmt: skip
        if made is None:
            raise UnsafePickle(f"stores a {value.name} where data should be")
        return made(value, depth)

    def _array(self, made: Made, depth: int) -> NDArray[Any]:
        if not isinstance(made.state, tuple) or len(made.state) != 5:
            raise UnsafePickle("has an array without its numbers")
        _, shape, dtype, fortran, raw = made.state
        if isinstance(dtype, Made) and _type_code(dtype) == "O8":
            return self._objects(shape, raw, depth)
        raw = self.of(raw, depth)
        if isinstance(raw, str):  # Python 2 kept bytes as text
            raw = raw.encode("latin-1")
        return _from_bytes(raw, _dtype(dtype), shape, bool(fortran))

    def _objects(self, shape: Any, items: Any, depth: int) -> NDArray[Any]:
        shape = _shape(shape)
        if not isinstance(items, list) or math.prod(shape) != len(items):
            raise UnsafePickle(
                f"has an array of shape {shape} with other than {math.prod(shape)} items"
            )
        result = np.empty(len(items), object)
        for i, item in enumerate(items):
            result[i] = self.of(item, depth)
        return result.reshape(shape)

    def _buffer(self, made: Made, depth: int) -> NDArray[Any]:
        raw, dtype, shape, order = made.arguments
        return _from_bytes(self.of(raw, depth), _dtype(dtype), shape, order == "F")

    def _scalar(self, made: Made, depth: int) -> Any:
        dtype, raw = made.arguments
        raw = self.of(raw, depth)
        raw = raw.encode("latin-1") if isinstance(raw, str) else raw
        return _from_bytes(raw, _dtype(dtype), (), False)[()]

    def _bytes(self, made: Made, depth: int) -> bytes:
        if not made.arguments:  # how old protocols say b""
            return b""
        text, encoding = made.arguments
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise UnsafePickle("encodes something else than latin-1 text")
        return text.encode("latin-1")

    def _state(self, made: Made, depth: int) -> dict[str, Any]:
        if not isinstance(made.state, dict):
            raise UnsafePickle(f"has a {made.name} without its numbers")
        return {str(k): self.of(v, depth) for k, v in made.state.items()}

    def _chumpy(self, made: Made, depth: int) -> NDArray[Any]:
        state = self._state(made, depth)
        if not isinstance(state.get("x"), np.ndarray):
            raise UnsafePickle("has a chumpy array without its numbers")
        return np.asarray(state["x"])

    def _select(self, made: Made, depth: int) -> NDArray[Any]:
        state = self._state(made, depth)
        source, index = state.get("a"), state.get("idxs")
        if (
            not isinstance(source, np.ndarray)
            or not isinstance(index, np.ndarray)
            or index.dtype.kind not in "iu"
        ):
            raise UnsafePickle("has a chumpy selection without its numbers")
        if index.size and (index.min() < 0 or index.max() >= source.size):
            raise UnsafePickle("has a chumpy selection that points outside its array")
        self._spend(index.size)
        taken = source.ravel()[index.ravel()]
        shape = state.get("preferred_shape")
        return taken if shape is None else _reshaped(taken, shape)

    def _sparse(self, made: Made, depth: int) -> NDArray[Any]:
        state = self._state(made, depth)
        rows, columns = _shape(state.get("_shape", state.get("shape")), 2)
        data, index, start = (np.asarray(state.get(k)) for k in ("data", "indices", "indptr"))
        major, minor = (columns, rows) if made.name == "csc_matrix" else (rows, columns)
        self._spend(rows * columns)
        numbers = data.ndim == index.ndim == start.ndim == 1 and data.dtype.kind in "biuf"
        if (
            not numbers
            or index.dtype.kind not in "iu"
            or start.dtype.kind not in "iu"
            or len(data) != len(index)
        ):
            raise UnsafePickle("has a sparse matrix without its numbers")
        start = start.astype(np.int64)
        if (
            len(start) != major + 1
            or start[0] != 0
            or start[-1] != len(index)
            or (np.diff(start) < 0).any()
        ):
            raise UnsafePickle(
                f"has a sparse matrix of {rows} x {columns} with other rows and columns than it says"
            )
        if len(index) and (index.min() < 0 or index.max() >= minor):
            raise UnsafePickle("has a sparse matrix that points outside itself")
        dense = np.zeros((major, minor), data.dtype)
        np.add.at(
            dense, (np.repeat(np.arange(major), np.diff(start)), index.astype(np.int64)), data
        )
        return dense.T if made.name == "csc_matrix" else dense

    def _ordered(self, made: Made, depth: int) -> dict[Any, Any]:
        pairs = self.of(made.arguments[0], depth) if made.arguments else []
        return {**dict(pairs), **{k: self.of(v, depth) for k, v in made.items.items()}}

    def _spend(self, numbers: int) -> None:
        self.dense += numbers
        if self.dense > MAX_DENSE:
            raise UnsafePickle(f"unfolds to {self.dense} numbers; {MAX_DENSE} are allowed")


def _shape(value: Any, axes: int | None = None) -> tuple[int, ...]:
    if isinstance(value, np.ndarray):
        value = tuple(value.tolist())
    value = (value,) if isinstance(value, int) else value
    if not isinstance(value, (tuple, list)) or not all(type(n) is int and n >= 0 for n in value):
        raise UnsafePickle(f"has an array of shape {short(value)}")
    if len(value) > 8 or (axes is not None and len(value) != axes):
        raise UnsafePickle(f"has an array with {len(value)} axes")
    return tuple(value)


def _reshaped(array: NDArray[Any], shape: Any) -> NDArray[Any]:
    shape = _shape(shape)
    if math.prod(shape) != array.size:
        raise UnsafePickle(f"has {array.size} numbers for an array of shape {shape}")
    return array.reshape(shape)


def _type_code(made: Made) -> Any:
    return made.arguments[0] if made.name == "dtype" and made.arguments else None


def _dtype(made: Any) -> np.dtype[Any]:
    """Plain numbers and text of either byte order; no objects, no fields."""
    code = _type_code(made) if isinstance(made, Made) else None
    if (
        not isinstance(code, str)
        or code[:1] not in _KINDS
        or not (code[1:].isascii() and code[1:].isdigit())
    ):
        raise UnsafePickle(f"has an array of type {short(code)}; only numbers and text are read")
    state = made.state
    if state is not None and (
        not isinstance(state, tuple) or len(state) < 8 or any(s is not None for s in state[2:5])
    ):
        raise UnsafePickle("has an array with fields; only numbers and text are read")
    dtype = np.dtype(code)
    return dtype.newbyteorder(">") if state is not None and state[1] == ">" else dtype


def _from_bytes(raw: Any, dtype: np.dtype[Any], shape: Any, fortran: bool) -> NDArray[Any]:
    shape = _shape(shape)
    if not isinstance(raw, bytes) or math.prod(shape) * dtype.itemsize != len(raw):
        held = len(raw) if isinstance(raw, bytes) else "no"
        raise UnsafePickle(f"has an array of shape {shape} and type {dtype} with {held} bytes")
    array = np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C")
    return array.astype(dtype.newbyteorder("="), copy=False)
