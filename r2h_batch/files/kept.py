"""What takes long to make, kept on disk under a name that says what it was made of. Safe with several processes.

`R2H_BATCH_CACHE` names the folder (default: `$XDG_CACHE_HOME/r2h_batch`, else `~/.cache/r2h_batch`); `off` keeps nothing.
Files may be deleted at any time. A folder that cannot be written costs the time again, nothing else.
"""

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from r2h_batch.files import FileError
from r2h_batch.files.arrays import read_npz

__all__ = ["cache_folder", "code_of", "is_kept", "kept"]

Arrays = dict[str, NDArray[Any]]


def cache_folder() -> Path | None:
    """Where things are kept; None: nowhere."""
    named = os.environ.get("R2H_BATCH_CACHE", "")
    if named == "off":
        return None
    if named:
        return Path(named)
    above = os.environ.get("XDG_CACHE_HOME", "")
    try:
        return (Path(above) if above else Path.home() / ".cache") / "r2h_batch"
    except RuntimeError:  # a user without a home
        return None


def is_kept(kind: str, key: str) -> bool:
    """Whether there is a file of this kind and key; it may still turn out to be damaged."""
    folder = cache_folder()
    return folder is not None and (folder / kind / f"{key}.npz").is_file()


def kept(kind: str, key: str, make: Callable[[], Mapping[str, NDArray[Any]]]) -> Arrays:
    """The arrays of a kind and a key (hex), made where they are not there yet: by one process, others wait for it.

    `key` must name everything that the arrays depend on, the code that makes them included. What is there is read as any
    file of somebody's is; what cannot be read is made again.
    """
    folder = cache_folder()
    if folder is None:
        return dict(make())
    path = folder / kind / f"{key}.npz"
    found = _read(path)
    if found is not None:
        return found
    with _alone(path.with_suffix(".lock")):
        found = _read(path)  # another process may have made it meanwhile
        if found is None:
            found = dict(make())
            _write(path, found)
        return found


@lru_cache(maxsize=8)
def code_of(packages: Sequence[str], distributions: Sequence[str]) -> str:
    """sha256 (hex) of the modules in these packages (not those below) and the versions of what they compute with."""
    digest = hashlib.sha256()
    for package in packages:
        for file in sorted(resources.files(package).iterdir(), key=lambda f: f.name):
            if file.name.endswith(".py"):
                digest.update(file.name.encode() + file.read_bytes())
    for name in distributions:
        with contextlib.suppress(metadata.PackageNotFoundError):
            digest.update(f"{name} {metadata.version(name)}".encode())
    return digest.hexdigest()


def _read(path: Path) -> Arrays | None:
    try:
        return read_npz(path)
    except (FileError, OSError):
        return None


def _write(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Nobody ever sees half a file: written beside it, then named."""
    partial = path.with_name(f".{path.name}.{uuid4().hex}")
    with contextlib.suppress(OSError):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as stream:
                np.savez(stream, **arrays)  # type: ignore[arg-type]
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """One process at a time, where the system can lock a file; the lock falls with its process."""
    try:
        import fcntl

        path.parent.mkdir(parents=True, exist_ok=True)
        stream = path.open("a")
    except (ImportError, OSError):
        yield
        return
    with stream:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield
