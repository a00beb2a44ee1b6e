"""Data out of a stranger's pickle, without Python's unpickler: no import, no call, no object of a
foreign class.

A pickle is a program for a small stack machine. Here that machine only knows data: containers,
numbers, text, bytes, and descriptions of a few classes that the hand data sets use: numpy's arrays,
dtypes and scalars, scipy's csc and csr matrices, chumpy's `Ch` (an array in `x`) and `Select`
(`a.ravel()[idxs].reshape(preferred_shape)`), OrderedDict, sets (read as lists: nothing is hashed).
Arrays are views of bytes that are in the file. Whatever else takes memory or time has a budget:

- `MAX_STEPS` instructions, and as many values in the result, shared ones counted each time;
- bytes of text, copies and sparse matrices: three times the file's, and `MADE_BYTES`;
- `MAX_NUMBER_KEYS` keys that are numbers: whoever chooses them can make all hashes collide. Python
  hashes text with a secret.
"""

from __future__ import annotations

import codecs
import io
import math
import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io import read as files
from r2h_batch.base.io.read import printable, read_file

MAX_BYTES = 256 << 20
"""MANO's own files have 3.8 MB, a sequence of ARCTIC 1 MB."""
MAX_STEPS = 1 << 20
MADE_BYTES = 128 << 20
MAX_NUMBER_KEYS = 4096
MAX_DEPTH = 32

_ALLOWED: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(
        ("numpy.core.multiarray", "numpy._core.multiarray"), ("_reconstruct", "scalar")
    ),
    **dict.fromkeys(("numpy.core.numeric", "numpy._core.numeric"), ("_frombuffer",)),
    "numpy": ("ndarray", "dtype"),
    **dict.fromkeys(("scipy.sparse.csc", "scipy.sparse._csc"), ("csc_matrix", "csc_array")),
    **dict.fromkeys(("scipy.sparse.csr", "scipy.sparse._csr"), ("csr_matrix", "csr_array")),
    "scipy.sparse": ("csc_matrix", "csr_matrix", "csc_array", "csr_array"),
    **dict.fromkeys(("copy_reg", "copyreg"), ("_reconstructor",)),
    **dict.fromkeys(("__builtin__", "builtins"), ("object", "bytes", "set", "frozenset")),
    **dict.fromkeys(("chumpy", "chumpy.ch", "chumpy.reordering"), ("Ch", "Select")),
    "_codecs": ("encode",),
    "collections": ("OrderedDict",),
}
_SPARSE = ("_shape", "shape", "data", "indices", "indptr")
_STATE = {
    "Ch": ("x",),
    "Select": ("a", "idxs", "preferred_shape"),
    **{f"cs{a}_{kind}": _SPARSE for a in "cr" for kind in ("matrix", "array")},
}
"""Keys that are read of an object's state; chumpy also keeps sets of names and caches there."""
_OPCODES = {o.code.encode("latin-1"): o for o in pickletools.opcodes}
_CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "EMPTY_SET": list,
}  # fmt: skip
_PUSHES_ARGUMENT = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE",
    "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
}  # fmt: skip
_STARTS = (b"\x80", b"(", b"c", b"}", b"]", b")")
"""First bytes of pickles; all pickles end with a full stop."""


def read_pickle_file(path: Path) -> Any:
    """The data of a pickle, as `read_pickle`."""
    return read_pickle(read_file(path, MAX_BYTES), printable(path))


def read_npy(path: Path) -> Any:
    """Content of an .npy file: arrays, and dictionaries and lists of arrays, as ARCTIC stores
    them."""
    return files.read_npy(path, objects=read_pickle)


def read_pickle(data: bytes, where: str = "pickle") -> Any:
    """The data of one pickle: dicts, lists, tuples, str, bytes, numbers, and dense arrays for all
    array-like classes. Strings of Python 2 are read as latin-1.

    Raises:
        FileError: one line that starts with `where`.
    """
    try:
        return _Reader(data).read()
    except (
        *(ValueError, IndexError, KeyError, TypeError, AttributeError),
        *(OverflowError, EOFError, RecursionError),
    ) as error:
        what = f"not a readable pickle ({type(error).__name__}: {_short(error)})"
        if isinstance(error, FileError):
            what = str(error)
        if data and data[:1] not in _STARTS and not data.rstrip().endswith(b"."):
            what = f"no pickle (it begins with {data[:16]!r}); give the file as its owners give it"
        raise FileError(f"{where}: {what}") from None


@dataclass(frozen=True)
class _Name:
    """A class or function that the file names. It is never looked up."""

    name: str


@dataclass(eq=False)
class _Made:
    """An object that the file describes: a name, its arguments, the state and items set
    afterwards."""

    name: str
    arguments: tuple[Any, ...]
    state: Any = None
    items: dict[Any, Any] = field(default_factory=dict)


def _short(value: object) -> str:
    """A few words for a message; of containers the type only: one that repeats itself can be 2^40
    characters long."""
    if not isinstance(value, (str, int, float, BaseException)):
        return type(value).__name__
    return " ".join(str(value)[:1000].split())[:120]


class _Reader:
    """Runs the program (`run`), then makes plain data of what it left (`plain`)."""

    def __init__(self, data: bytes) -> None:
        self.stream = io.BytesIO(data)
        self.stack: list[Any] = []
        self.below: list[list[Any]] = []
        """stacks below the marks"""
        self.memo: dict[int, Any] = {}
        self.bytes_left = 3 * len(data) + MADE_BYTES
        self.number_keys = 0
        self.values = 0
        self.done: dict[int, tuple[Any, int]] = {}
        self.open: set[int] = set()

    def read(self) -> Any:
        return self.plain(self.run())

    def spend(self, size: int) -> None:
        """Take bytes off the budget, before they are made."""
        self.bytes_left -= size
        if self.bytes_left < 0:
            raise FileError("makes far more bytes than it holds; save plain arrays as .npz")

    # ---- the stack machine

    def run(self) -> Any:
        for _ in range(MAX_STEPS):
            code = self.stream.read(1)
            if not code:
                raise FileError("ends before its end mark")
            opcode = _OPCODES.get(code)
            if opcode is None:
                at = self.stream.tell() - 1
                raise FileError(f"byte {code!r} at {at} is not a pickle instruction")
            if opcode.name == "STOP":
                if len(self.stack) != 1 or self.below:
                    raise FileError(f"leaves {len(self.stack)} values; a pickle holds one")
                return self.stack[0]
            if opcode.name == "STRING":  # the library's reader takes ASCII only
                argument: Any = _python2_string(self.stream.readline())
            else:
                argument = opcode.arg.reader(self.stream) if opcode.arg is not None else None
            self.step(opcode.name, argument)
        raise FileError(f"has more than {MAX_STEPS} instructions")

    def step(self, name: str, argument: Any) -> None:
        if name in _PUSHES_ARGUMENT:
            if isinstance(argument, (str, bytes, bytearray)):
                self.spend(argument.__sizeof__())
            self.stack.append(bytes(argument) if name == "BYTEARRAY8" else argument)
            return
        if name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name]())
            return
        match name:
            case "MARK":
                self.below.append(self.stack)
                self.stack = []
            case "PUT" | "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                self.memo[len(self.memo) if argument is None else int(argument)] = self.stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                self.stack.append(self.memo[int(argument)])
            case "POP":
                self.stack.pop() if self.stack else self.since_mark()
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                count = int(name[-1])
                self.stack.append(tuple([self.stack.pop() for _ in range(count)][::-1]))
            case "TUPLE" | "LIST" | "FROZENSET":
                items = self.since_mark()
                self.stack.append(tuple(items) if name == "TUPLE" else items)
            case "DICT":
                items = self.since_mark()
                self.stack.append({})
                self.set_items(items)
            case "APPEND" | "APPENDS" | "ADDITEMS":
                items = [self.stack.pop()] if name == "APPEND" else self.since_mark()
                self.top(list).extend(items)
            case "SETITEM" | "SETITEMS":
                one = name == "SETITEM"
                self.set_items(
                    [self.stack.pop(), self.stack.pop()][::-1] if one else self.since_mark()
                )
            case "GLOBAL":
                self.name(*argument.split(" ", 1))
            case "STACK_GLOBAL":
                word, module = self.stack.pop(), self.stack.pop()
                self.name(module, word)
            case "REDUCE" | "NEWOBJ":
                self.make()
            case "BUILD":
                state, made = self.stack.pop(), self.top(_Made)
                if made.state is not None:
                    raise FileError("sets the state of one object twice")
                made.state = state
            case "PROTO":
                if argument > 5:
                    raise FileError(f"protocol {argument}; known are 0 to 5")
            case "FRAME":
                pass
            case _:
                raise FileError(f"instruction {name} is not allowed")

    def top(self, kind: type | tuple[type, ...]) -> Any:
        if not self.stack or not isinstance(self.stack[-1], kind):
            raise FileError("adds to something that takes no items")
        return self.stack[-1]

    def since_mark(self) -> list[Any]:
        items, self.stack = self.stack, self.below.pop()
        return items

    def name(self, module: Any, name: Any) -> None:
        words = isinstance(module, str) and isinstance(name, str)
        if not words or name not in _ALLOWED.get(module, ()):
            full_name = f"{_short(module)}.{_short(name)}"
            raise FileError(f"asks for {full_name}; only arrays are read, nothing is called")
        self.stack.append(_Name(name))

    def make(self) -> None:
        arguments, name = self.stack.pop(), self.stack.pop()
        known = isinstance(name, _Name) and isinstance(arguments, tuple)
        if known and name.name == "_reconstructor":  # copyreg: (class, base, state)
            name, arguments = (arguments or (None,))[0], ()
        if not known or not isinstance(name, _Name):
            raise FileError("calls something that has no allowed name")
        self.stack.append(_Made(name.name, arguments))

    def set_items(self, items: list[Any]) -> None:
        target = self.top((dict, _Made))
        if len(items) % 2:
            raise FileError("has a key without a value")
        into = target.items if isinstance(target, _Made) else target
        self.fill(into, list(zip(items[::2], items[1::2])))

    def fill(self, into: dict[Any, Any], pairs: Any) -> None:
        for key, value in pairs:
            if not isinstance(key, (str, bytes)):
                number = isinstance(key, (int, float))
                if not number or (isinstance(key, int) and key.bit_length() > 63):
                    raise FileError(f"has a key of type {type(key).__name__}, or too large")
                self.number_keys += 1
                if self.number_keys > MAX_NUMBER_KEYS:
                    raise FileError(f"has more than {MAX_NUMBER_KEYS} keys that are numbers")
            into[key] = value

    # ---- plain data

    def plain(self, value: Any, depth: int = 0) -> Any:
        """Plain data of what the machine left: every object once, no circles, no depth beyond
        `MAX_DEPTH`."""
        self.values += 1
        if self.values > MAX_STEPS:
            raise FileError(f"unfolds to more than {MAX_STEPS} values")
        if not isinstance(value, (dict, list, tuple, _Made, _Name)):
            return value
        if id(value) in self.done:
            result, count = self.done[id(value)]
            self.values += count
            return result
        if id(value) in self.open:
            raise FileError("contains itself")
        if depth > MAX_DEPTH:
            raise FileError(f"is nested more than {MAX_DEPTH} deep")
        self.open.add(id(value))
        before = self.values
        result = self.unfolded(value, depth + 1)
        self.open.remove(id(value))
        self.done[id(value)] = result, self.values - before
        return result

    def unfolded(self, value: Any, depth: int) -> Any:
        if isinstance(value, dict):
            return {k: self.plain(v, depth) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return type(value)([self.plain(v, depth) for v in value])
        if isinstance(value, _Name):
            raise FileError(f"stores the name {value.name} itself")
        match value.name:
            case "_reconstruct" | "ndarray":
                return self.array(value, depth)
            case "_frombuffer":
                raw, dtype, shape, order = value.arguments
                return self.numbers(self.plain(raw, depth), dtype, shape, order == "F")
            case "scalar":
                dtype, raw = value.arguments
                return self.numbers(self.plain(raw, depth), dtype, (), False)[()]
            case "csc_matrix" | "csr_matrix" | "csc_array" | "csr_array":
                return self.sparse(value, depth)
            case "set" | "frozenset":
                return [self.plain(v, depth) for items in value.arguments[:1] for v in items]
            case "encode" | "bytes":
                return self.encoded(*value.arguments)
            case "Ch":
                return _need(self.state(value, depth).get("x"), "biufcSU", "a chumpy array")
            case "Select":
                return self.select(self.state(value, depth))
            case "OrderedDict":
                made: dict[Any, Any] = {}
                self.fill(made, self.plain(value.arguments[0], depth) if value.arguments else ())
                return made | {k: self.plain(v, depth) for k, v in value.items.items()}
        raise FileError(f"stores a {value.name} where data should be")

    def state(self, made: _Made, depth: int) -> dict[str, Any]:
        if not isinstance(made.state, dict):
            raise FileError(f"has a {made.name} without its numbers")
        kept = [k for k in _STATE[made.name] if k in made.state]
        return {k: self.plain(made.state[k], depth) for k in kept}

    def encoded(self, text: Any = "", encoding: Any = "latin1") -> bytes:
        if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
            raise FileError("encodes something else than latin-1 text")
        self.spend(len(text))
        return text.encode("latin-1")

    def array(self, made: _Made, depth: int) -> NDArray[Any]:
        if not isinstance(made.state, tuple) or len(made.state) != 5:
            raise FileError("has an array without its numbers")
        _, shape, dtype, fortran, raw = made.state
        if not (isinstance(dtype, _Made) and dtype.arguments and dtype.arguments[0] == "O8"):
            return self.numbers(self.plain(raw, depth), dtype, shape, bool(fortran))
        shape = _shape(shape)
        if not isinstance(raw, list) or math.prod(shape) != len(raw):
            count = math.prod(shape)
            raise FileError(f"has an array of shape {shape} with other than {count} items")
        result = np.empty(len(raw), object)
        for i, item in enumerate(raw):
            result[i] = self.plain(item, depth)
        return result.reshape(shape)

    def numbers(self, raw: Any, dtype: Any, shape: Any, fortran: bool) -> NDArray[Any]:
        """A view of the bytes; a copy in this machine's byte order where theirs is another."""
        kind, shape = _dtype(dtype), _shape(shape)
        if isinstance(raw, str):  # Python 2 kept bytes as text
            raw = self.encoded(raw)
        if not isinstance(raw, bytes) or math.prod(shape) * kind.itemsize != len(raw):
            held = len(raw) if isinstance(raw, bytes) else "no"
            raise FileError(f"has an array of shape {shape} and type {kind} with {held} bytes")
        found = np.frombuffer(raw, kind).reshape(shape, order="F" if fortran else "C")
        if kind.isnative:
            return found
        self.spend(len(raw))
        return found.astype(kind.newbyteorder("="))

    def select(self, state: dict[str, Any]) -> NDArray[Any]:
        source = _need(state.get("a"), "biuf", "a chumpy selection")
        index = _need(state.get("idxs"), "iu", "a chumpy selection")
        if index.size and (index.min() < 0 or index.max() >= source.size):
            raise FileError("has a chumpy selection that points outside its array")
        shape = state.get("preferred_shape")
        shape = (index.size,) if shape is None else _shape(shape)
        if math.prod(shape) != index.size:
            raise FileError(f"has {index.size} numbers for an array of shape {shape}")
        self.spend(source.nbytes + index.size * (source.itemsize + 8))
        return np.asarray(source.ravel()[index.ravel()].reshape(shape))

    def sparse(self, made: _Made, depth: int) -> NDArray[Any]:
        """The dense matrix of compressed columns, or rows."""
        from scipy import sparse  # 0.2 s: only MANO's own files need it

        state, what = self.state(made, depth), "a sparse matrix"
        shape = _shape(state.get("_shape", state.get("shape")), 2)
        data = _need(state.get("data"), "biuf", what)
        index, start = (_need(state.get(k), "iu", what) for k in ("indices", "indptr"))
        self.spend(math.prod(shape) * data.itemsize + 32 * (index.size + start.size))
        kind = sparse.csc_array if made.name.startswith("csc") else sparse.csr_array
        matrix = kind((data, index, start), shape=shape)
        matrix.check_format(full_check=True)
        return np.asarray(matrix.toarray())


def _python2_string(line: bytes) -> str:
    text = line.strip()
    if len(text) < 2 or text[:1] not in b"'\"" or text[:1] != text[-1:]:
        raise FileError("has a string without quotes")
    return codecs.escape_decode(text[1:-1])[0].decode("latin-1")


def _need(value: Any, kinds: str, what: str) -> NDArray[Any]:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in kinds:
        raise FileError(f"has {what} without its numbers")
    return value


def _shape(value: Any, axes: int | None = None) -> tuple[int, ...]:
    if isinstance(value, np.ndarray) and value.size <= 8:
        value = value.tolist()
    value = (value,) if type(value) is int else value
    if not isinstance(value, (tuple, list)):
        raise FileError(f"has an array of shape {_short(value)}")
    if len(value) > 8 or (axes is not None and len(value) != axes):
        raise FileError(f"has an array with {len(value)} axes")
    if not all(type(n) is int and n.bit_length() < 64 and n >= 0 for n in value):
        raise FileError(f"has an array of shape {_short(value)}")
    return tuple(value)


def _dtype(made: Any) -> np.dtype[Any]:
    """Plain numbers and text of either byte order; no objects, no fields."""
    named = isinstance(made, _Made) and made.name == "dtype" and bool(made.arguments)
    code: Any = made.arguments[0] if named else None
    state: Any = made.state if named else None
    plain = isinstance(code, str) and len(code) <= 12 and code[:1] in tuple("biufcSU")
    if not plain or not (code[1:].isascii() and code[1:].isdigit()):
        raise FileError(f"has an array of type {_short(code)}; only numbers and text are read")
    found = np.dtype(code)
    if state is None:
        return found
    if not isinstance(state, tuple) or len(state) < 8 or any(state[2:5]):
        raise FileError("has an array with fields; only numbers and text are read")
    return found.newbyteorder(">") if state[1] == ">" else found
