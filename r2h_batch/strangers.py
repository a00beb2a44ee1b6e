"""Code of strangers (methods, plug-ins) in this process. Standard library only.

    with stranger("method mine.py:predict", of="mine"):
        answer = function(trials, scene)

What such code changes of the process is put back behind it, and is there again when code of the same module is called again:
a method that wants float64 has it. What it prints goes to stderr. It cannot end the process: `os._exit` raises `Ended`. A
child that it forked ends where the block ends. Code in C that ends the process ends it: nothing runs after that.
"""

import atexit
import builtins
import gc
import io
import json
import locale
import logging
import operator
import os
import resource
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import FrameType, TracebackType
from typing import Any, NamedTuple, NoReturn

GRACE_S = 2.0
"""So long a process that is done waits for threads that strangers left."""


MOST_PRINTED = 10_000
"""Characters of what one block printed that people are told."""


class Ended(SystemExit):
    """Raised in the place of what would have ended this process, or replaced it, without a word."""


def _on_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


say: Callable[[str], None] = _on_stderr
"""Tells people one line; `base.io.log` sets it."""


def words_of(error: BaseException) -> str:
    """An error of a stranger's code in one line, whose `__str__` may raise as well.

    Args:
        error: as it was caught.
    """
    try:
        text = str(error)
    except Exception:
        text = "an error whose text cannot be had"
    return f"{type(error).__name__}: {' '.join(text.split())}"[:300]


class _Setting(NamedTuple):
    """A setting of the process that is read and put back by a call."""

    name: str
    read: Callable[[], Any]
    write: Callable[[Any], Any]


def _folder() -> str | None:
    try:
        return os.getcwd()
    except OSError:
        return None  # it is gone, and nobody can go back to it


def _to_folder(folder: str | None) -> None:
    if folder:
        os.chdir(folder)


def _mask() -> int:
    found = os.umask(0o22)
    os.umask(found)
    return found


def _to_logging(root: tuple[int, list[logging.Handler]]) -> None:
    logging.root.setLevel(root[0])
    logging.root.handlers[:] = root[1]


_PYTHON = (
    _Setting("working directory", _folder, _to_folder),
    _Setting("file mode mask", _mask, os.umask),
    _Setting("sys.excepthook", lambda: sys.excepthook, lambda hook: setattr(sys, "excepthook", hook)),
    _Setting("sys.unraisablehook", lambda: sys.unraisablehook, lambda hook: setattr(sys, "unraisablehook", hook)),
    _Setting("threading.excepthook", lambda: threading.excepthook, lambda hook: setattr(threading, "excepthook", hook)),
    _Setting("sys.settrace", sys.gettrace, sys.settrace),
    _Setting("sys.setprofile", sys.getprofile, sys.setprofile),
    _Setting("garbage collection", gc.isenabled, lambda on: gc.enable() if on else gc.disable()),
    _Setting("logging.disable", lambda: logging.root.manager.disable, logging.disable),
    _Setting("logging", lambda: (logging.root.level, logging.root.handlers[:]), _to_logging),
    _Setting("locale", lambda: locale.setlocale(locale.LC_ALL), partial(locale.setlocale, locale.LC_ALL)),
)  # fmt: skip


def _of_torch() -> tuple[_Setting, ...]:
    import torch

    def device() -> str:
        return str(torch.empty(0, dtype=None, device=None).device)

    def to_device(name: str) -> None:
        torch.set_default_device(None)
        if device() != name:
            torch.set_default_device(name)

    return (
        _Setting("default device", device, to_device),
        _Setting("default dtype", torch.get_default_dtype, torch.set_default_dtype),
        _Setting("gradients", torch.is_grad_enabled, torch.set_grad_enabled),
        _Setting("matmul precision", torch.get_float32_matmul_precision, torch.set_float32_matmul_precision),
        _Setting("deterministic algorithms", torch.are_deterministic_algorithms_enabled, torch.use_deterministic_algorithms),
    )  # fmt: skip


def _of_numpy() -> tuple[_Setting, ...]:
    import numpy as np

    return (_Setting("numpy.seterr", np.geterr, lambda kinds: np.seterr(**kinds)),)


_LATER = {"torch": _of_torch, "numpy": _of_numpy}
_AS_IMPORTED: dict[str, tuple[Any, ...]] = {
    "torch": ("cpu", None, True, "highest", False),
    "numpy": ({"divide": "warn", "over": "warn", "under": "ignore", "invalid": "warn"},),
}
"""Values right after the import, for strangers who bring the library; None: see `_settings`."""

_known: dict[str, tuple[_Setting, ...]] = {"": _PYTHON}


def _settings(library: str) -> tuple[_Setting, ...]:
    if library not in _known and library in sys.modules:
        _known[library] = _LATER[library]()
        values = _AS_IMPORTED[library]
        if None in values:  # a dtype has no name without torch
            dtype = sys.modules[library].float32
            _AS_IMPORTED[library] = tuple(dtype if v is None else v for v in values)
    return _known.get(library, ())


_WHOLE = tuple(vars(m) for m in (builtins, json, time))
"""Names of modules that are put back, every one."""
_CLASSES = (json.JSONEncoder, json.JSONDecoder)
_OF_OS = vars(os)
_USED = (
    "_exit access chdir close closerange cpu_count dup dup2 environ execv execve fork fsdecode fsencode fspath fstat"
    " fsync ftruncate getcwd getpid kill link listdir lstat makedirs mkdir open path pread putenv pwrite read remove rename"
    " replace rmdir sched_getaffinity scandir stat unlink umask urandom utime write"
)
"""Functions of os that others stand for below, or that judging and storing call."""
_OS = tuple(name for name in _USED.split() if hasattr(os, name))
_of_os = operator.itemgetter(*_OS)
_TIMERS = (signal.ITIMER_REAL, signal.ITIMER_VIRTUAL, signal.ITIMER_PROF)

# as they were before any stranger came
_leave, _getpid = os._exit, os.getpid
_close, _closerange, _dup, _register = os.close, os.closerange, os.dup, atexit.register
_signal, _setrlimit = signal.signal, resource.setrlimit

_c: dict[str, Callable[[None], int]] = {}
_lock = threading.RLock()
_inside: "list[stranger]" = []
_left: dict[str, "_Left"] = {}
"""Module -> what its code left when it was run last."""
_threads: list[tuple[threading.Thread, str]] = []
"""Threads that strangers left, and whose they are."""


class _Left(NamedTuple):
    """What a stranger's code had changed when it returned."""

    settings: dict[tuple[str, int], Any]
    names: list[tuple[dict[str, Any], dict[str, Any]]]
    filters: Any  # a list, or None
    recursion: int | None


def _asks() -> "stranger | None":
    """The block whose code calls, if it is a stranger's and in this process."""
    me = threading.get_ident()
    if _inside and _getpid() == _inside[-1].pid and me not in _inside[-1].ours:
        return _inside[-1]
    return None


def _of_left_thread() -> bool:
    return any(t.ident == threading.get_ident() for t, _ in _threads)


def _no_exit(status: int) -> None:
    if _of_left_thread():
        raise SystemExit  # the end of that thread alone
    if _asks() is None:
        _leave(status)
    raise Ended(f"os._exit({status}) ends the process; return an answer")


def _no_end(name: str, real: Callable[..., Any], *arguments: Any) -> None:
    if _asks() is None:
        real(*arguments)
    raise Ended(f"os.{name} ends the process; return an answer")


_CLOSES = "closes descriptors of files that are not its own; they stay open"


def _close_own(handle: int) -> None:
    asks = _asks()
    if asks is not None and str(handle) in asks.handles and handle not in asks.opened:
        asks.tell(_CLOSES)
        raise OSError(9, "Bad file descriptor")
    _close(handle)


def _open_own(real: Callable[..., Any], *arguments: Any, **more: Any) -> Any:
    """A descriptor that was closed meanwhile may come back as the stranger's own."""
    found = real(*arguments, **more)
    if (asks := _asks()) is not None:
        asks.opened.update(found if isinstance(found, tuple) else (found,))
    return found


def _close_own_range(low: int, high: int) -> None:
    asks = _asks()
    ours = set(map(int, asks.handles)) - asks.opened if asks is not None else set()
    kept = sorted(h for h in ours if low <= h < high)
    if asks is not None and kept:
        asks.tell(_CLOSES)
    for first, last in zip([low, *(h + 1 for h in kept)], [*kept, high], strict=True):
        if first < last:  # of an empty range some systems close all
            _closerange(first, last)


class _AtExit:
    """A function that a stranger wants called at the end of the process."""

    def __init__(self, name: str, function: Callable[..., Any]) -> None:
        self.name, self.function = name, function

    def __call__(self, *args: Any, **kwargs: Any) -> None:
        try:
            with stranger(self.name):
                self.function(*args, **kwargs)
        except BaseException as error:
            say(f"{self.name}: its function of atexit raised {words_of(error)}")

    def __eq__(self, other: object) -> bool:  # atexit.unregister asks
        return other is self or bool(other == self.function)

    __hash__ = None  # type: ignore[assignment]


def _register_own(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Callable[..., Any]:
    asks = _asks()
    _register(function if asks is None else _AtExit(asks.name, function), *args, **kwargs)
    return function


def _alarm(number: int, _: FrameType | None) -> NoReturn:
    raise Ended("its alarm (signal.alarm, setitimer) went off, which ends a process")


def _set_signal(number: int, handler: Any) -> Any:
    before = _signal(number, handler)
    if (asks := _asks()) is not None:
        asks.undo.append(partial(_signal, number, before))
    return before


def _set_timer_again(which: int, seconds: float, interval: float) -> None:
    signal.setitimer(which, seconds, interval)


def _set_timer(real: Callable[..., Any], *arguments: Any) -> Any:
    if (asks := _asks()) is not None:
        if signal.getsignal(signal.SIGALRM) is signal.SIG_DFL:
            _set_signal(signal.SIGALRM, _alarm)
        asks.undo += [
            partial(_set_timer_again, which, *signal.getitimer(which)) for which in _TIMERS
        ]
    return real(*arguments)


def _set_mask(real: Callable[..., Any], how: int, mask: Any) -> Any:
    before = real(how, mask)
    if (asks := _asks()) is not None:
        asks.undo.append(partial(real, signal.SIG_SETMASK, before))
    return before


def _set_limit(limit: int, values: tuple[int, int]) -> None:
    before = resource.getrlimit(limit)
    _setrlimit(limit, values)
    if (asks := _asks()) is not None:
        asks.undo.append(partial(_unlimit, asks, limit, before))


def _unlimit(asks: "stranger", limit: int, before: tuple[int, int]) -> None:
    try:
        _setrlimit(limit, before)
    except (OSError, ValueError):
        found = (
            n for n in dir(resource) if n.startswith("RLIMIT") and getattr(resource, n) == limit
        )
        most = resource.getrlimit(limit)[1]
        asks.tell(f"lowered {next(found)} of this process to {most}, which cannot be put back")
        with suppress(OSError, ValueError):
            _setrlimit(limit, (min(before[0], most) if before[0] >= 0 else most, most))


_REPLACED: tuple[tuple[dict[str, Any], dict[str, Any]], ...] = (
    (
        vars(os),
        {
            "_exit": _no_exit,
            "execv": partial(_no_end, "execv", os.execv),
            "execve": partial(_no_end, "execve", os.execve),
            "close": _close_own,
            "closerange": _close_own_range,
            **{name: partial(_open_own, getattr(os, name)) for name in ("open", "dup", "pipe")},
        },
    ),
    (
        vars(signal),
        {
            "signal": _set_signal,
            "alarm": partial(_set_timer, signal.alarm),
            "setitimer": partial(_set_timer, signal.setitimer),
            "pthread_sigmask": partial(_set_mask, signal.pthread_sigmask),
        },
    ),
    (vars(resource), {"setrlimit": _set_limit}),
    (vars(atexit), {"register": _register_own}),
)
"""Functions that others stand for while a stranger's code runs."""
_REAL = tuple((names, {name: names[name] for name in others}) for names, others in _REPLACED)


def _put_back_functions() -> None:
    """The functions that others stood for. A thread that a stranger left may call `os._exit` at any moment, so while one is
    alive the real one does not come back, not for a moment."""
    left = any(t.is_alive() for t, _ in _threads)
    for names, real in _REAL:
        names.update(real | {"_exit": _no_exit} if left and names is _OF_OS else real)


class stranger:
    """A block in which a stranger's code runs. In another thread than that of a block that runs already it does nothing.

    Args:
        name: whose code it is, for lines to people.
        of: the module that it lies in; what it has changed of the process is there again when it runs again. It may be set
            inside, where that is known late.
    """

    def __init__(self, name: str, of: str = "") -> None:
        self.name, self.of, self.pid, self._told = name, of, -1, set[str]()
        self.ours: frozenset[int | None] = frozenset()
        self.handles: frozenset[str] = frozenset()
        self.opened: set[int] = set()
        self.undo: list[Callable[[], Any]] = []

    def tell(self, what: str) -> None:
        """One line about what the code does, once; told when it has returned.

        Args:
            what: it does.
        """
        self._told.add(what)

    def __enter__(self) -> "stranger":
        self._mine = _lock.acquire(blocking=False)
        if not self._mine:
            return self
        me = threading.current_thread()
        self.pid = _getpid()
        self._alive = threading.enumerate()
        self.ours = frozenset(t.ident for t in self._alive if t is not me)
        self._recursion = sys.getrecursionlimit()
        self._names = [(names, names.copy()) for names in _WHOLE]
        self._classes = [vars(kind).copy() for kind in _CLASSES]
        self._open = _stdout_is_open()
        self._streams = sys.stdin, sys.stdout, sys.stderr
        self._path, self._finders = sys.path[:], sys.meta_path[:]
        self._modules = sys.modules.copy()
        self._filters = warnings.filters[:]
        self._values = {library: _read(library) for library in ("", *_LATER)}
        self._printed = sys.stdout = io.StringIO()
        handles = (
            _open_handles()
        )  # with that of the list itself, which is the number of the next one
        self._out, self._err = _stdout_to_stderr()
        self.handles = handles | {str(c) for c in (self._out, self._err) if c is not None}
        _inside.append(self)
        for names, others in _REPLACED:
            names.update(others)
        self._inside_os = _of_os(_OF_OS)
        self._brought = self.of in _left
        if self._brought:
            _bring(_left[self.of])
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if not self._mine:
            return
        left_recursion = sys.getrecursionlimit()
        sys.setrecursionlimit(self._recursion)
        if _getpid() != self.pid:  # a child that the code forked
            _leave(0 if kind is None else 1)
        names = self._put_back_names()
        self._note_threads()
        _inside.remove(self)
        if not _inside:
            _put_back_functions()
        sys.stdin, sys.stdout, sys.stderr = self._streams
        _put_back_stdout(self._out, self._err)
        for undo in reversed(self.undo):
            with suppress(OSError, ValueError, TypeError):
                undo()
        if self._open and not _stdout_is_open():
            self.tell("closed standard output")
        self._put_back_classes()
        settings = self._put_back_settings()
        self._put_back_imports()
        filters = None
        if warnings.filters != self._filters:
            filters = warnings.filters[:]
            with warnings.catch_warnings():  # tells Python that they are others now
                pass
            warnings.filters[:] = self._filters  # type: ignore[index]
        recursion = left_recursion if left_recursion != self._recursion else None
        if self.of and (settings or names or filters is not None or recursion):
            _left[self.of] = _Left(settings, names, filters, recursion)
        elif self._brought:
            del _left[self.of]
        _lock.release()
        self._say()

    def _put_back_names(self) -> list[tuple[dict[str, Any], dict[str, Any]]]:
        """Puts the functions of modules back; those that the code had put in their places."""
        was = [(names, before, names.copy()) for names, before in self._names]
        try:
            of_os = _of_os(_OF_OS)
        except KeyError:  # it deleted one
            of_os = tuple([_OF_OS.get(name) for name in _OS])
        for names, before in self._names:  # first of all: what follows calls them
            names.update(before)
        found = []
        for names, before, after in was:
            if len(after) == len(before) and all(
                map(operator.is_, after.values(), before.values())
            ):
                continue
            if other := {k: after[k] for k, v in before.items() if after.get(k, v) is not v}:
                found.append((names, other))
        if not all(map(operator.is_, of_os, self._inside_os)):
            pairs = zip(_OS, of_os, self._inside_os, strict=True)
            found.append((_OF_OS, {k: a for k, a, b in pairs if a is not b and a is not None}))
            _OF_OS.update(zip(_OS, self._inside_os, strict=True))
        return found

    def _put_back_classes(self) -> None:
        for kind, before in zip(_CLASSES, self._classes, strict=True):
            if vars(kind) != before:
                for name, value in before.items():
                    if vars(kind).get(name) is not value:
                        setattr(kind, name, value)

    def _put_back_settings(self) -> dict[tuple[str, int], Any]:
        found: dict[tuple[str, int], Any] = {}
        for library, before in self._values.items():
            after = _read(library)
            if after == before:
                continue
            for k, setting in enumerate(_settings(library)):
                was = before[k] if before else _AS_IMPORTED[library][k]
                if after[k] != was:
                    found[library, k] = after[k]
                    self._write(setting, was)
        return found

    def _write(self, setting: _Setting, value: Any) -> None:
        try:
            setting.write(value)
            wrong = setting.read() != value
        except Exception:
            wrong = True
        if wrong:
            self.tell(
                f"left another {setting.name}, which cannot be put back to {str(value)[:100]}"
            )

    def _put_back_imports(self) -> None:
        if not isinstance(sys.path, list):
            sys.path = []
        lists: tuple[tuple[list[Any], list[Any]], ...] = (
            (sys.path, self._path),
            (sys.meta_path, self._finders),
        )
        for now, before in lists:
            if now != before:  # what it has added stays: it may import more when it is called
                now += [place for place in before if place not in now]
        if len(sys.modules) < len(self._modules):
            sys.modules.update(self._modules | sys.modules)

    def _note_threads(self) -> None:
        # their number says nothing: one of before may have ended meanwhile
        _threads.extend((t, self.name) for t in threading.enumerate() if t not in self._alive)

    def _say(self) -> None:
        if not self._printed.closed and (text := self._printed.getvalue().rstrip()):
            say(f"{self.name} printed: {_shortened(text)}")
        for what in sorted(self._told):
            say(f"{self.name} {what}")


def _shortened(text: str) -> str:
    """The first and the last half of what is passed on of a text."""
    half = MOST_PRINTED // 2
    left = len(text) - 2 * half
    return text if left <= 0 else f"{text[:half]}\n[{left} characters left out]\n{text[-half:]}"


def _read(library: str) -> tuple[Any, ...]:
    return tuple([setting.read() for setting in _settings(library)])


def _bring(left: _Left) -> None:
    """What the code had left is there again, as far as it can be."""
    for (library, k), value in left.settings.items():
        with suppress(Exception):
            _settings(library)[k].write(value)
    for names, own in left.names:
        names.update(own)
    if left.filters is not None:
        with warnings.catch_warnings():
            pass
        warnings.filters[:] = left.filters  # type: ignore[index]
    if left.recursion:
        with suppress(RecursionError):
            sys.setrecursionlimit(left.recursion)


def _stdout_is_open() -> bool:
    return sys.__stdout__ is not None and not sys.__stdout__.closed


def _stdout_to_stderr() -> tuple[int | None, int | None]:
    """Copies of descriptors 1 and 2; until they are put back 1 is 2, for what prints past Python."""
    try:
        err = _dup(2)
    except OSError:
        return None, None
    try:
        out = _dup(1)
        os.dup2(2, 1)
    except OSError:
        return None, err
    return out, err


def _put_back_stdout(out: int | None, err: int | None) -> None:
    _flush_c()
    for copy, place in ((out, 1), (err, 2)):
        if copy is not None:
            with suppress(OSError):  # it closed the copy too
                os.dup2(copy, place)
                _close(copy)


def _flush_c() -> None:
    """Text that C code has printed and not yet written."""
    if "ctypes" in sys.modules and "fflush" not in _c:
        import ctypes

        _c["fflush"] = ctypes.CDLL(None).fflush
    if "fflush" in _c:
        _c["fflush"](None)


_PUT_BACK = frozenset("12")


def _open_handles() -> frozenset[str]:
    """Descriptors that are open now, less 1 and 2, which are put back."""
    try:
        return frozenset(os.listdir("/proc/self/fd")) - _PUT_BACK
    except OSError:
        return frozenset("0")


def end_without_threads(code: int) -> None:
    """Sees to it that a process that is done ends with this exit code, whatever threads strangers have left in it.

    Args:
        code: the exit code.
    """
    if _running():
        threading.Thread(target=_end, args=(code,), daemon=True).start()


def _running() -> list[tuple[threading.Thread, str]]:
    return [(t, name) for t, name in _threads if t.is_alive() and not t.daemon]


def _end(code: int) -> None:
    time.sleep(GRACE_S)
    if left := _running():
        for thread, name in left:
            say(f"{name} left the thread {thread.name!r} running; this process ends without it")
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):
                stream.flush()
        _leave(code)
