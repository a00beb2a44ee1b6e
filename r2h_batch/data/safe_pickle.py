"""Data out of a stranger's pickle: Python's own unpickler in a process of its own, and it finds no name but those of arrays.

`find_class` is the documented way to restrict it. Each name that the hand data sets use stands for a class
of this module that keeps what the file says of an object: numpy's arrays, dtypes and scalars, scipy's csc
and csr matrices, chumpy's `Ch` (an array in `x`) and `Select` (`a.ravel()[idxs].reshape(preferred_shape)`).
So no code of another library runs on it, and no code of the file. Afterwards these become plain arrays, and
the process sends what it has to its parent. Its address space and its time are limited.

`python -m r2h_batch.data.safe_pickle` is the process.
"""

from __future__ import annotations

import io
import math
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io import read as files
from r2h_batch.base.io.child import StandingReader, answer_often
from r2h_batch.base.io.read import printable, read_file

MAX_BYTES = 256 << 20
"""MANO's own files have 3.8 MB, a sequence of ARCTIC 1 MB."""
MOST_SECONDS = 60.0
MADE_BYTES = 128 << 20
"""All arrays that are read may have this many bytes, and three times as many as the file."""
MAX_VALUES, MAX_DEPTH = 1 << 20, 32
_STARTS = (b"\x80", b"(", b"c", b"}", b"]", b")")
"""First bytes of pickles; all pickles end with a full stop."""
_reader = StandingReader("r2h_batch.data.safe_pickle", seconds=MOST_SECONDS)


def read_pickle_file(path: Path) -> Any:
    """The data of a pickle, as `read_pickle`."""
    return read_pickle(read_file(path, MAX_BYTES), printable(path))


def read_npy(path: Path) -> Any:
    """Content of an .npy file: arrays, and dictionaries and lists of arrays, as ARCTIC stores
    them."""
    return files.read_npy(path, objects=read_pickle)


def read_pickle(data: bytes, where: str = "pickle") -> Any:
    """The data of one pickle: dicts, lists (sets too), tuples, str, bytes, numbers, and dense arrays for
    all array-like classes. Strings of Python 2 are read as latin-1.

    Raises:
        FileError: one line that starts with `where`.
    """
    try:
        return pickle.loads(_reader.read(data)[0])  # our own pickle of plain data
    except FileError as error:
        what = str(error)
        if data and data[:1] not in _STARTS and not data.rstrip().endswith(b"."):
            what = f"no pickle (it begins with {data[:16]!r}); give the file as its owners give it"
        raise FileError(f"{where}: {what}") from None


# ---- in the child: what a name in the file stands for


class _Said:
    """An object as the file describes it: arguments, and the state set afterwards."""

    def __new__(cls, *arguments: Any) -> Any:
        said = super().__new__(cls)
        said.arguments, said.state = arguments, None
        return said

    arguments: tuple[Any, ...]
    state: Any

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def made(self) -> Any:
        """The plain value."""
        raise FileError(f"stores a {type(self).__name__.strip('_').lower()} where data should be")

    def array(self, name: str, kinds: str = "biuf") -> NDArray[Any]:
        """An array of the state."""
        found = self.state.get(name) if isinstance(self.state, dict) else None
        found = found.made() if isinstance(found, _Said) else found
        if not isinstance(found, np.ndarray) or found.dtype.kind not in kinds:
            raise FileError(f"has a {type(self).__name__.strip('_').lower()} without its numbers")
        return found


class _Dtype(_Said):
    def kind(self) -> np.dtype[Any]:
        """Plain numbers and text of either byte order; no objects, no fields."""
        code: Any = self.arguments[0] if self.arguments else None
        state: Any = self.state
        plain = isinstance(code, str) and len(code) <= 12 and code[:1] in tuple("biufcSU")
        if not plain or not (code[1:].isascii() and code[1:].isdigit()):
            raise FileError("has an array of another type; only numbers and text are read")
        if state is None:
            return np.dtype(code)
        if not isinstance(state, tuple) or len(state) < 8 or any(state[2:5]):
            raise FileError("has an array with fields; only numbers and text are read")
        return np.dtype(code).newbyteorder(">") if state[1] == ">" else np.dtype(code)


class _Bytes(_Said):
    def made(self) -> bytes:
        text, encoding = (*self.arguments, *("", "latin1")[len(self.arguments) :])[:2]
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise FileError("encodes something else than latin-1 text")
        return text.encode("latin-1")


class _Array(_Said):
    def made(self) -> NDArray[Any]:
        if not isinstance(self.state, tuple) or len(self.state) != 5:
            raise FileError("has an array without its numbers")
        _, shape, dtype, fortran, raw = self.state
        if not isinstance(dtype, _Dtype) or dtype.arguments[:1] != ("O8",):
            return _numbers(raw, dtype, shape, fortran=bool(fortran))
        if not isinstance(raw, list) or math.prod(_shape(shape)) != len(raw):
            raise FileError(f"has an array of shape {_shape(shape)} with other items")
        return _objects(raw, _shape(shape))


class _Buffer(_Said):
    def made(self) -> NDArray[Any]:
        raw, dtype, shape, order = self.arguments
        return _numbers(raw, dtype, shape, fortran=order == "F")


class _Scalar(_Said):
    def made(self) -> Any:
        dtype, raw = self.arguments
        return _numbers(raw, dtype, (), fortran=False)[()]


class _Sparse(_Said):
    """Compressed columns, or rows."""

    def made(self) -> NDArray[Any]:
        from scipy import sparse  # 0.2 s: only MANO's own files need it

        data, index, start = (
            self.array("data"),
            self.array("indices", "iu"),
            self.array("indptr", "iu"),
        )
        shape = _shape(self.state.get("_shape", self.state.get("shape")))
        if len(shape) != 2 or math.prod(shape) * data.itemsize > MADE_BYTES:
            raise FileError("makes far more bytes than it holds; save plain arrays as .npz")
        kind = sparse.csr_array if isinstance(self, _Rows) else sparse.csc_array
        matrix = kind((data, index, start), shape=shape)
        matrix.check_format(full_check=True)
        return np.asarray(matrix.toarray())


class _Rows(_Sparse):
    pass


class _Ch(_Said):
    def made(self) -> NDArray[Any]:
        return self.array("x", "biufcSU")


class _Select(_Said):
    def made(self) -> NDArray[Any]:
        source, index = self.array("a").ravel(), self.array("idxs", "iu").ravel()
        if index.size and (index.min() < 0 or index.max() >= source.size):
            raise FileError("has a chumpy selection that points outside its array")
        shape = self.state.get("preferred_shape")
        return np.asarray(source[index].reshape((index.size,) if shape is None else _shape(shape)))


class _Reconstructor(_Said):
    """copyreg's: (class, base, state)."""

    def __new__(cls, made: Any = None, *_: Any) -> Any:
        if not isinstance(made, type) or not issubclass(made, _Said):
            raise FileError("calls something that has no allowed name")
        return made.__new__(made)


_NAMES: dict[str, dict[str, Any]] = {
    **{f"numpy.{core}.multiarray": {"_reconstruct": _Array, "scalar": _Scalar} for core in ("core", "_core")},
    **{f"numpy.{core}.numeric": {"_frombuffer": _Buffer} for core in ("core", "_core")},
    "numpy": {"ndarray": _Array, "dtype": _Dtype},
    **{f"scipy.sparse{m}": {"csc_matrix": _Sparse, "csc_array": _Sparse} for m in (".csc", "._csc")},
    **{f"scipy.sparse{m}": {"csr_matrix": _Rows, "csr_array": _Rows} for m in (".csr", "._csr")},
    "scipy.sparse": {"csc_matrix": _Sparse, "csc_array": _Sparse, "csr_matrix": _Rows, "csr_array": _Rows},
    **{m: {"_reconstructor": _Reconstructor} for m in ("copy_reg", "copyreg")},
    **{m: {"object": object, "bytes": _Bytes, "set": list, "frozenset": list} for m in ("__builtin__", "builtins")},
    **{m: {"Ch": _Ch, "Select": _Select} for m in ("chumpy", "chumpy.ch", "chumpy.reordering")},
    "_codecs": {"encode": _Bytes},
    "collections": {"OrderedDict": dict},
}  # fmt: skip


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str, /) -> Any:
        if (found := _NAMES.get(module, {}).get(name)) is None:
            asked = f"{printable(module)[:60]}.{printable(name)[:60]}"
            raise FileError(f"asks for {asked}; only arrays are read, nothing is called")
        return found


def _numbers(raw: Any, dtype: Any, shape: Any, *, fortran: bool) -> NDArray[Any]:
    """A view of the bytes; a copy in this machine's byte order where theirs is another."""
    if not isinstance(dtype, _Dtype):
        raise FileError("has an array without its type")
    kind, shape = dtype.kind(), _shape(shape)
    raw = raw.made() if isinstance(raw, _Bytes) else raw
    raw = raw.encode("latin-1") if isinstance(raw, str) else raw  # Python 2 kept bytes as text
    if not isinstance(raw, (bytes, bytearray)) or math.prod(shape) * kind.itemsize != len(raw):
        held = len(raw) if isinstance(raw, (bytes, bytearray)) else "no"
        raise FileError(f"has an array of shape {shape} and type {kind} with {held} bytes")
    found = np.frombuffer(raw, kind).reshape(shape, order="F" if fortran else "C")
    return found.astype(kind.newbyteorder("="), copy=False)


def _objects(items: list[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    found = np.empty(len(items), object)
    for i, item in enumerate(items):  # all at once, lists of one length would become further axes
        found[i] = item
    return found.reshape(shape)


def _shape(value: Any) -> tuple[int, ...]:
    value = value.made() if isinstance(value, _Said) else value
    value = value.tolist() if isinstance(value, np.ndarray) and value.size <= 8 else value
    value = (value,) if type(value) is int else value
    fits = isinstance(value, (tuple, list)) and len(value) <= 8
    if not fits or not all(type(n) is int and 0 <= n < 1 << 63 for n in value):
        raise FileError("has an array whose shape is not up to 8 whole numbers")
    return tuple(value)


class _Plain:
    """Makes plain data of what the unpickler left; what is shared is made once."""

    def __init__(self, most: int) -> None:
        self.bytes_left, self.values_left = most, MAX_VALUES
        self.done: dict[int, Any] = {}

    def of(self, value: Any, depth: int = 0) -> Any:
        """Containers, numbers, text, bytes and arrays, whatever `value` holds."""
        if id(value) in self.done:
            return self.done[id(value)]
        if depth > MAX_DEPTH:
            raise FileError(f"is nested more than {MAX_DEPTH} deep")
        self.values_left -= 1
        if self.values_left < 0:
            raise FileError(f"unfolds to more than {MAX_VALUES} values")
        made = self.made(value.made() if isinstance(value, _Said) else value, depth + 1)
        if isinstance(value, (_Said, dict, list, tuple)):
            self.done[id(value)] = made
        return made

    def made(self, value: Any, depth: int) -> Any:
        if isinstance(value, np.ndarray) and value.dtype == object:
            return _objects([self.of(v, depth) for v in value.ravel()], value.shape)
        if isinstance(value, (np.ndarray, np.generic, bytes, bytearray)):
            self.bytes_left -= len(value) if isinstance(value, (bytes, bytearray)) else value.nbytes
            if self.bytes_left < 0:
                raise FileError("makes far more bytes than it holds; save plain arrays as .npz")
            return bytes(value) if isinstance(value, bytearray) else value
        if isinstance(value, dict):
            if not all(isinstance(k, (str, bytes, int, float)) for k in value):
                raise FileError("has a key that is neither text nor a number")
            return {k: self.of(v, depth) for k, v in value.items()}
        if isinstance(value, (list, tuple, set, frozenset)):
            kind = tuple if isinstance(value, tuple) else list
            return kind([self.of(v, depth) for v in value])
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        raise FileError("stores a name where data should be")


def _answer(data: bytes) -> list[NDArray[Any]]:
    """A pickle's data as plain data, in a pickle of our own."""
    try:
        made = _Plain(3 * len(data) + MADE_BYTES).of(
            _Unpickler(io.BytesIO(data), encoding="latin1").load()
        )
    except (FileError, MemoryError):
        raise
    except Exception as error:  # whatever numpy, scipy or the unpickler say
        words = " ".join(printable(error).split())[:120]
        raise FileError(f"not a readable pickle ({type(error).__name__}: {words})") from None
    return [np.frombuffer(pickle.dumps(made, 5), np.uint8)]


if __name__ == "__main__":
    sys.exit(answer_often(_answer))
