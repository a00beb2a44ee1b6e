"""A disk cache of arrays that take long to make, safe with several processes.

`R2H_BATCH_CACHE` names the folder (default: `$XDG_CACHE_HOME/r2h_batch`, else
`~/.cache/r2h_batch`); `off` turns the cache off. Files may be deleted at any time. A folder that
cannot be written costs computing time, nothing else.

An entry holds its key and a sha256 of its arrays. It is used only if both agree with what was asked
for and the arrays match the given specification. Otherwise it is made again.
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
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import read_npz
from r2h_batch.base.io.write import write_npz

Arrays = dict[str, NDArray[Any]]
SEAL = "made_of"
"""Name of the array that holds an entry's kind, key and sha256."""
REPORT_AFTER_S, GIVE_UP_AFTER_S, POLL_S = 5.0, 900.0, 0.1
"""While another process makes an entry: when this is reported, when the wait ends, how often the
lock is tried."""


@dataclass(frozen=True)
class ArraySpec:
    """Type and shape that one array of an entry must have."""

    dtype: str
    """numpy's name; `text` for words of any length"""
    shape: tuple[int | str, ...] = ()
    """a word stands for any length, the same one in all arrays"""
    below: str = ""
    """the word whose length bounds the values: they are indices"""
    gaps: bool = False
    """whether NaN is allowed"""

    def none(self) -> NDArray[Any]:
        """The array of an entry that holds nothing."""
        return np.zeros([0 if isinstance(n, str) else n for n in self.shape], self.dtype)


def matches(arrays: Mapping[str, NDArray[Any]], specs: Mapping[str, ArraySpec]) -> bool:
    """Whether arrays have the names, types and shapes of the specification, no NaN but where it allows them, and
    indices within their bounds. Infinite numbers are values: a grip that no force is enough for."""
    if set(arrays) != set(specs):
        return False
    length: dict[str, int] = {}
    for name, spec in specs.items():
        a = arrays[name]
        kind = "text" if a.dtype.kind == "U" else a.dtype.name
        if kind != spec.dtype or a.ndim != len(spec.shape):
            return False
        for n, k in zip(a.shape, spec.shape, strict=True):
            if n != (length.setdefault(k, n) if isinstance(k, str) else k):
                return False
    for name, spec in specs.items():
        a = arrays[name]
        if a.dtype.kind == "f" and not spec.gaps and np.isnan(a).any():
            return False
        if spec.below and a.size and not (a.min() >= 0 and a.max() < length[spec.below]):
            return False
    return True


def cache_folder() -> Path | None:
    """The cache's folder; None where the cache is off."""
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
            _warn_useless(named, "no such user")
        return None


def is_cached(kind: str, key: str) -> bool:
    """Whether there is a file for this kind and key. Its content may still be damaged."""
    folder = cache_folder()
    return folder is not None and os.path.isfile(folder / kind / f"{key}.npz")


def cached(
    kind: str,
    key: str,
    make: Callable[[], Mapping[str, NDArray[Any]]],
    specs: Mapping[str, ArraySpec],
    *,
    reads: Callable[[Arrays], object] | None = None,
) -> Arrays:
    """The arrays of an entry, made where it is missing or wrong.

    One process makes an entry, the others wait for it.

    Args:
        kind: folder of the entry.
        key: its name, hex. It must cover everything that the arrays depend on, with the code.
        make: makes the arrays.
        specs: what the arrays must be.
        reads: a further check, which raises ValueError, TypeError, KeyError, IndexError or
            AttributeError for a wrong entry.
    """
    folder = cache_folder()
    if folder is None:
        return dict(make())
    path = folder / kind / f"{key}.npz"
    seal = f"{kind} {key}"
    found = _read(path, seal, specs, reads)
    if found is not None:
        return found
    with _locked(path.with_suffix(".lock"), folder):
        found = _read(path, seal, specs, reads)  # another process may have made it meanwhile
        if found is None:
            found = dict(make())
            try:
                write_npz(path, {**found, SEAL: np.array(f"{seal} {_sha256(found)}")})
            except OSError as error:  # a full disk too
                _warn_useless(str(folder), error.strerror or str(error))
        return found


@lru_cache(maxsize=8)
def code_files(code: Sequence[str]) -> list[Path]:
    """Files of modules, and the modules directly in packages, by dotted names, in the order given."""
    files = []
    for name in code:
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(f"no module {name}", name=name)
        file = Path(spec.origin)
        files += (
            [file] if spec.submodule_search_locations is None else sorted(file.parent.glob("*.py"))
        )
    return files


def code_digest(code: Sequence[str], distributions: Sequence[str]) -> str:
    """sha256 (hex) of the files of `code` (`code_files`) and of the versions of these distributions."""
    digest = hashlib.sha256()
    for file in code_files(code):
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
    path: Path,
    seal: str,
    specs: Mapping[str, ArraySpec],
    reads: Callable[[Arrays], object] | None,
) -> Arrays | None:
    try:
        arrays = read_npz(path)
        if str(arrays.pop(SEAL, "")) != f"{seal} {_sha256(arrays)}" or not matches(arrays, specs):
            return None
        if reads is not None:
            reads(dict(arrays))
        return arrays
    except (OSError, KeyError, TypeError, ValueError, AttributeError, IndexError):
        return None


@contextlib.contextmanager
def _locked(path: Path, folder: Path) -> Iterator[None]:
    """One process at a time, where the system can lock files. A lock ends with its process.

    A link or a pipe in the lock's place is neither followed nor waited for. Then two processes may
    make the same entry.
    """
    try:
        import fcntl

        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC
        handle = os.open(path, flags, 0o666)
    except (ImportError, OSError) as error:
        if isinstance(error, OSError) and not os.path.isdir(path.parent):
            _warn_useless(str(folder), error.strerror or str(error))
        yield
        return
    with os.fdopen(handle, "r+b", buffering=0):
        if stat.S_ISREG(os.fstat(handle).st_mode):
            with contextlib.suppress(OSError):  # a file system without locks
                _wait_for(path, lambda: fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB))
        yield


def _wait_for(path: Path, take: Callable[[], None]) -> None:
    """Wait for a lock, but not for ever: its process may have been stopped."""
    start, reported = time.monotonic(), False
    while (waited := time.monotonic() - start) <= GIVE_UP_AFTER_S:
        with contextlib.suppress(BlockingIOError):
            return take()
        if waited > REPORT_AFTER_S and not reported:
            reported, minutes = True, f"{GIVE_UP_AFTER_S / 60:.0f} minutes"
            LOG.info(f"{path}: another process is making this entry; waiting up to {minutes}")
        time.sleep(POLL_S)
    return None


@lru_cache(maxsize=8)
def _warn_useless(folder: str, why: str) -> None:
    """Warn once for each folder."""
    shown = folder if len(folder) < 200 else f"{folder[:100]}...{folder[-20:]}"
    warnings.warn(
        f"{shown}: the cache cannot be written there ({why}), so long computations are repeated; "
        "set R2H_BATCH_CACHE to a folder that can be written, or to off",
        stacklevel=2,
    )
