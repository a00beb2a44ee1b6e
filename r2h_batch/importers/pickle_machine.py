"""The stack machine of a pickle's program, for data only: what it would call is written down, never
looked up."""

from __future__ import annotations

import codecs
import io
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

__all__ = ["MAX_OPCODES", "Machine", "Made", "Name", "UnsafePickle", "short"]

MAX_OPCODES = 4_000_000

_CHUMPY = {"chumpy.ch": ("Ch",), "chumpy.reordering": ("Select",), "chumpy": ("Ch", "Select")}
_ALLOWED = {
    **dict.fromkeys(
        ("numpy", "numpy.core.multiarray", "numpy._core.multiarray"), ("_reconstruct", "scalar")
    ),
    **dict.fromkeys(("numpy.core.numeric", "numpy._core.numeric"), ("_frombuffer",)),
    **dict.fromkeys(("scipy.sparse.csc", "scipy.sparse._csc", "scipy.sparse"), ("csc_matrix",)),
    **dict.fromkeys(("scipy.sparse.csr", "scipy.sparse._csr"), ("csr_matrix",)),
    **dict.fromkeys(("copy_reg", "copyreg"), ("_reconstructor",)),
    **dict.fromkeys(("__builtin__", "builtins"), ("object", "bytes")),
    "_codecs": ("encode",),
    "collections": ("OrderedDict",),
    **_CHUMPY,
}
_ALLOWED["numpy"] = ("ndarray", "dtype")
_ALLOWED["scipy.sparse"] = ("csc_matrix", "csr_matrix")


class UnsafePickle(ValueError):
    """The file holds more than data, or says what its bytes do not bear out."""


@dataclass(frozen=True)
class Name:
    """A class or function that the file names. It is never looked up."""

    name: str


class Made:
    """What the file says is made: a name, its arguments, the state set afterwards."""

    def __init__(self, name: str, arguments: tuple[Any, ...]) -> None:
        self.name, self.arguments, self.state = name, arguments, None
        self.items: dict[Any, Any] = {}


_MARK = object()
_CODES = {o.code: o for o in pickletools.opcodes}


def short(value: object) -> str:
    """A few words for a message; of containers the type only: one that repeats itself can be 2^40
    characters long."""
    if not isinstance(value, (str, int, float, BaseException)):
        return type(value).__name__
    return " ".join(str(value).split())[:120]


class Machine:
    """Runs the pickle's program over data only."""

    def __init__(self, data: bytes) -> None:
        self.stream = io.BytesIO(data)
        self.size = len(data)
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self) -> Any:
        for _ in range(MAX_OPCODES):
            code = self.stream.read(1)
            if not code:
                raise UnsafePickle("ends before its end mark")
            opcode = _CODES.get(code.decode("latin-1"))
            if opcode is None:
                raise UnsafePickle(
                    f"byte {code!r} at {self.stream.tell() - 1} is no pickle instruction"
                )
            if opcode.name == "STOP":
                if len(self.stack) != 1:
                    raise UnsafePickle(f"leaves {len(self.stack)} values; a pickle holds one")
                return self.stack[0]
            self._step(opcode)
        raise UnsafePickle(f"has more than {MAX_OPCODES} instructions")

    def _step(self, opcode: Any) -> None:
        name = opcode.name
        if name == "STRING":  # the library's reader takes ASCII only
            self.stack.append(_python2_string(self.stream.readline()))
            return
        argument = opcode.arg.reader(self.stream) if opcode.arg is not None else None
        if name in _PUSHES_ARGUMENT:
            self.stack.append(argument)
        elif name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name]())
        elif name in ("PROTO", "FRAME"):
            if name == "PROTO" and int(argument or 0) > 5:
                raise UnsafePickle(f"protocol {argument}; known are 0 to 5")
        elif name in _ACTIONS:
            _ACTIONS[name](self, argument)
        else:
            raise UnsafePickle(f"instruction {name} is not allowed")

    def pop(self) -> Any:
        if not self.stack or self.stack[-1] is _MARK:
            raise UnsafePickle("takes a value that is not there")
        return self.stack.pop()

    def top(self, kind: type | tuple[type, ...]) -> Any:
        if not self.stack or not isinstance(self.stack[-1], kind):
            raise UnsafePickle("adds to something that takes no items")
        return self.stack[-1]

    def since_mark(self) -> list[Any]:
        at = next((i for i in range(len(self.stack) - 1, -1, -1) if self.stack[i] is _MARK), None)
        if at is None:
            raise UnsafePickle("takes values up to a mark that is not there")
        items = self.stack[at + 1 :]
        del self.stack[at:]
        return items

    def take(self, count: int) -> tuple[Any, ...]:
        return tuple(reversed([self.pop() for _ in range(count)]))

    def name(self, module: Any, name: Any) -> None:
        if (
            not isinstance(module, str)
            or not isinstance(name, str)
            or name not in _ALLOWED.get(module, ())
        ):
            raise UnsafePickle(
                f"asks for {short(module)}.{short(name)}; only arrays are read, nothing is called"
            )
        kind = "chumpy." + name if module in _CHUMPY else name
        self.stack.append(Name(kind))

    def make(self) -> None:
        arguments, name = self.pop(), self.pop()
        if not isinstance(name, Name) or not isinstance(arguments, tuple):
            raise UnsafePickle("calls something that has no allowed name")
        if name.name == "_reconstructor":  # copyreg: (class, base, state)
            if not arguments or not isinstance(arguments[0], Name):
                raise UnsafePickle("calls something that has no allowed name")
            name, arguments = arguments[0], ()
        self.stack.append(Made(name.name, arguments))

    def build(self) -> None:
        state = self.pop()
        made = self.top(Made)
        if made.state is not None:
            raise UnsafePickle("sets the state of one object twice")
        made.state = state

    def set_items(self, items: list[Any]) -> None:
        target = self.top((dict, Made))
        into = target.items if isinstance(target, Made) else target
        if len(items) % 2:
            raise UnsafePickle("has a key without a value")
        for key, value in zip(items[::2], items[1::2]):
            if not isinstance(key, (str, bytes, int, float, bool)):
                raise UnsafePickle(f"has a key of type {type(key).__name__}")
            into[key] = value


def _python2_string(line: bytes) -> str:
    text = line.strip()
    if len(text) < 2 or text[:1] not in b"'\"" or text[:1] != text[-1:]:
        raise UnsafePickle("has a string without quotes")
    return codecs.escape_decode(text[1:-1])[0].decode("latin-1")


def _memoize(machine: Machine, index: Any) -> None:
    machine.memo[len(machine.memo) if index is None else int(index)] = machine.top(object)


def _get(machine: Machine, index: Any) -> None:
    if int(index) not in machine.memo:
        raise UnsafePickle(f"recalls value {index}, which was never kept")
    machine.stack.append(machine.memo[int(index)])


def _pair(machine: Machine, _: Any) -> None:
    value, key = machine.pop(), machine.pop()
    machine.set_items([key, value])


def _append(machine: Machine, _: Any) -> None:
    value = machine.pop()
    machine.top(list).append(value)


def _extend(machine: Machine, _: Any) -> None:
    items = machine.since_mark()
    machine.top(list).extend(items)


def _set_items(machine: Machine, _: Any) -> None:
    items = machine.since_mark()
    machine.set_items(items)


def _dict(machine: Machine, _: Any) -> None:
    items = machine.since_mark()
    machine.stack.append({})
    machine.set_items(items)


def _stack_name(machine: Machine, _: Any) -> None:
    name, module = machine.pop(), machine.pop()
    machine.name(module, name)


def _put_tuple(count: int) -> Callable[[Machine, Any], None]:
    return lambda m, _: m.stack.append(m.take(count))


_PUSHES_ARGUMENT = {
    "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
    "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8",
    "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
}  # fmt: skip
_CONSTANTS: dict[str, Callable[[], Any]] = {
    "NONE": lambda: None, "NEWTRUE": lambda: True, "NEWFALSE": lambda: False, "MARK": lambda: _MARK,
    "EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple,
}  # fmt: skip
_ACTIONS: dict[str, Callable[[Machine, Any], Any]] = {
    "TUPLE": lambda m, _: m.stack.append(tuple(m.since_mark())),
    "LIST": lambda m, _: m.stack.append(m.since_mark()),
    "DICT": _dict,
    "TUPLE1": _put_tuple(1),
    "TUPLE2": _put_tuple(2),
    "TUPLE3": _put_tuple(3),
    "BYTEARRAY8": lambda m, value: m.stack.append(bytes(value)),
    "APPEND": _append,
    "APPENDS": _extend,
    "SETITEM": _pair,
    "SETITEMS": _set_items,
    "POP": lambda m, _: m.stack.pop(),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _memoize),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _get),
    "GLOBAL": lambda m, text: m.name(*text.split(" ", 1)),
    "STACK_GLOBAL": _stack_name,
    "REDUCE": lambda m, _: m.make(),
    "NEWOBJ": lambda m, _: m.make(),
    "BUILD": lambda m, _: m.build(),
}
