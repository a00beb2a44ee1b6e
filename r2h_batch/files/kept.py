"""What takes long to make, kept on disk under a name that says what it was made of. Safe with
several processes.

`R2H_BATCH_CACHE` names the folder (default: `$XDG_CACHE_HOME/r2h_batch`, else
`~/.cache/r2h_batch`); `off` keeps nothing. Files may be deleted at any time. A folder that cannot
be written costs the time again, nothing else.

An entry says which key it was made for, with a sha256 over its arrays; it is taken for what it says
only if both agree with what is asked for and the arrays are of the form that its readers count on.
Everything else is made again.
"""

import contextlib
import hashlib
import os
import stat
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from r2h_batch.command_line import tell
from r2h_batch.files import FileError
from r2h_batch.files.arrays import read_npz

__all__ = ["Column", "cache_folder", "code_of", "fits", "is_kept", "kept"]

Arrays = dict[str, NDArray[Any]]
SEAL = "made_of"
"""The array of an entry that says its kind, its key and its sha256."""
SAID_AFTER_S, ALONE_AFTER_S, LOOK_EVERY_S = 5.0, 900.0, 0.1
"""When it is said that another process is waited for, and when it is waited for no longer."""


@dataclass(frozen=True)
class Column:
    """What one array of an entry must be."""

    dtype: str
    """numpy's name; `text` for words of any length"""
    shape: tuple[int | str, ...] = ()
    """a word: any length, the same wherever the word stands"""
    below: str = ""
    """the word of a length that the values are indices into"""
    gaps: bool = False
    """whether NaN may stand in it"""


def fits(arrays: Mapping[str, NDArray[Any]], form: Mapping[str, Column]) -> bool:
    """Whether these are the arrays of a form: names, types, shapes, finite, indices within."""
    if set(arrays) != set(form):
        return False
    length: dict[str, int] = {}
    for name, column in form.items():
        a = arrays[name]
        if a.ndim != len(column.shape) or (
            a.dtype.kind if column.dtype == "text" else a.dtype.name
        ) != ("U" if column.dtype == "text" else column.dtype):
            return False
        if any(
            n != (length.setdefault(k, n) if isinstance(k, str) else k)
            for n, k in zip(a.shape, column.shape)
        ):
            return False
    return all(_within(arrays[name], column, length) for name, column in form.items())


def _within(a: NDArray[Any], column: Column, length: Mapping[str, int]) -> bool:
    if a.dtype.kind == "f":
        return not (np.isinf(a).any() if column.gaps else not np.isfinite(a).all())
    return (
        not column.below
        or not a.size
        or (int(a.min()) >= 0 and int(a.max()) < length[column.below])
    )


def cache_folder() -> Path | None:
    """Where things are kept; None: nowhere."""
    named = os.environ.get("R2H_BATCH_CACHE", "")
    if named == "off":
        return None
    above = os.environ.get("XDG_CACHE_HOME", "")
    try:
        if named:
            return Path(named).expanduser()
        return (Path(above).expanduser() if above else Path.home() / ".cache") / "r2h_batch"
    except RuntimeError:  # a user without a home
        if named:
            _useless(named, "no such user")
        return None


def is_kept(kind: str, key: str) -> bool:
    """Whether there is a file of this kind and key; it may still turn out to be damaged."""
    folder = cache_folder()
    return folder is not None and os.path.isfile(folder / kind / f"{key}.npz")


def kept(
    kind: str,
    key: str,
    make: Callable[[], Mapping[str, NDArray[Any]]],
    form: Mapping[str, Column],
    *,
    reads: Callable[[Arrays], object] | None = None,
) -> Arrays:
    """The arrays of a kind and a key (hex), made where they are not there yet: by one process,
    others wait for it.

    `key` must name everything that the arrays depend on, the code that makes them included. What is
    there is read as any file of somebody's is; what cannot be read, was made for another key, was
    changed since, is not of this `form` or makes `reads` raise is made again.
    """
    folder = cache_folder()
    if folder is None:
        return dict(make())
    path = folder / kind / f"{key}.npz"
    seal = f"{kind} {key}"
    found = _read(path, seal, form, reads)
    if found is not None:
        return found
    with _alone(path.with_suffix(".lock"), folder):
        found = _read(path, seal, form, reads)  # another process may have made it meanwhile
        if found is None:
            found = dict(make())
            _write(path, {**found, SEAL: np.array(f"{seal} {_sha256(found)}")})
        return found


@lru_cache(maxsize=8)
def code_of(packages: Sequence[str], distributions: Sequence[str]) -> str:
    """sha256 (hex) of the modules in these packages (not those below) and the versions of what they
    compute with."""
    digest = hashlib.sha256()
    for package in packages:
        for file in sorted(resources.files(package).iterdir(), key=lambda f: f.name):
            if file.name.endswith(".py"):
                digest.update(file.name.encode() + file.read_bytes())
    for name in distributions:
        with contextlib.suppress(metadata.PackageNotFoundError):
            digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.hexdigest()


def _sha256(arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        a = np.ascontiguousarray(arrays[name]).reshape(arrays[name].shape)
        digest.update(f"{name}:{a.dtype.str}:{a.shape}:".encode())
        digest.update(a.tobytes())
    return digest.hexdigest()


def _read(
    path: Path, seal: str, form: Mapping[str, Column], reads: Callable[[Arrays], object] | None
) -> Arrays | None:
    try:
        arrays = read_npz(path)
        if str(arrays.pop(SEAL, "")) != f"{seal} {_sha256(arrays)}" or not fits(arrays, form):
            return None
        if reads is not None:
            reads(dict(arrays))
        return arrays
    except (FileError, OSError, KeyError, TypeError, ValueError, AttributeError, IndexError):
        return None


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Nobody ever sees half a file: written beside it, then named."""
    partial = path.with_name(f".{path.name}.{uuid4().hex}")
    with contextlib.suppress(OSError):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("xb") as stream:
                np.savez(stream, **arrays)  # type: ignore[arg-type]
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _alone(path: Path, folder: Path) -> Iterator[None]:
    """One process at a time, where the system can lock a file; the lock falls with its process.

    What stands in the lock's place and is no plain file (a link, a pipe) is neither followed nor
    waited for: then there is no lock, and two processes may make the same.
    """
    try:
        import fcntl

        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
        handle = os.open(path, flags, 0o666)
    except ImportError:
        yield
        return
    except OSError as error:
        if not os.path.isdir(path.parent):
            _useless(str(folder), error.strerror or str(error))
        yield
        return
    with os.fdopen(handle, "r+b", buffering=0):
        if stat.S_ISREG(os.fstat(handle).st_mode):
            with contextlib.suppress(OSError):  # a file system without locks
                _lock(path, lambda: fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB))
        yield


def _lock(path: Path, take: Callable[[], None]) -> None:
    """Waits for the lock of a process that works, not for ever for one that was stopped."""
    start, said = time.monotonic(), False
    while True:
        try:
            return take()
        except BlockingIOError:
            waited = time.monotonic() - start
        if waited > ALONE_AFTER_S:
            return None
        if waited > SAID_AFTER_S and not said:
            said = True
            tell(
                f"{path}: another process is making this; waiting up to {ALONE_AFTER_S / 60:.0f} minutes for it"
            )
        time.sleep(LOOK_EVERY_S)


@lru_cache(maxsize=8)
def _useless(folder: str, why: str) -> None:
    """Said once for each folder."""
    shown = folder if len(folder) < 200 else f"{folder[:100]}...{folder[-20:]}"
    warnings.warn(
        f"{shown}: nothing can be kept there ({why}), what takes long is made again each time; "
        "set R2H_BATCH_CACHE to a folder that can be written, or to off",
        stacklevel=2,
    )
