"""Files of a run folder: whole or not at all, one process at a time.

Every file is written under a temporary name, put on the disk and renamed. What the first writer
decides for the others (run.json, methods) gets its name by a hard link, which fails where the name is
taken. No stored file changes, so any number of processes can share a folder.
"""

import errno
import fcntl
import hashlib
import os
import re
import socket
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import kind_of, printable, read_file
from r2h_batch.base.io.write import naming, packed_json, writer_is_gone, writers_name

MOST_CLAIM_BYTES = 1000

_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EMLINK, errno.ENOSYS, errno.EXDEV)
"""What file systems without hard links answer."""

REMAINS_S = 3600.0
"""A temporary file that nobody has written to for so long has lost its writer."""

GO_ON = "shards that were complete are stored, run the same command to go on"


class RunError(FileError):
    """A run folder cannot be written or read: the message names the file and what to do."""


def sha256_of(path: Path) -> str:
    """sha256 (hex) of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def temporary_name(path: Path) -> Path:
    """A unique hidden name beside `path` that no reader takes for a finished file."""
    return path.with_name(f".{path.name}.{writers_name()}.tmp")


def sync_file(path: Path) -> None:
    """Put a file's bytes on the disk; a full disk or quota raises here at the latest."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def link_once(temporary: Path, final: Path) -> bool:
    """Give a finished temporary file its name; False if the name is taken."""
    try:
        os.link(temporary, final)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno in _NO_LINKS:
            words = "this file system has no hard links; put the run folder on one that has"
            raise OSError(error.errno, words, str(final)) from error
        raise
    sync_folder(final.parent)
    return True


def sync_folder(place: Path) -> None:
    """Put the names of a folder on the disk."""
    folder = os.open(place, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_json_once(path: Path, data: Mapping[str, Any]) -> bool:
    """Write a JSON file unless it exists; False if it does."""
    return bool(_write_json(path, data, link_once))


def replace_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write or replace a JSON file; a reader sees the old or the new one."""
    _write_json(path, data, os.replace)


def _write_json(
    path: Path, data: Mapping[str, Any], give_name: Callable[[Path, Path], bool | None]
) -> bool | None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        with naming(path, temporary):
            with temporary.open("w", encoding="utf-8") as file:
                file.write(packed_json(data) + "\n")
                file.flush()
                os.fsync(file.fileno())
            return give_name(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


_TEMPORARY = re.compile(r"\.(?:.+\.([0-9a-f]{32})\.tmp|([0-9a-f]{12}|[0-9a-f]{32})\.tmp(?:\.\w+)?)")


def drop_remains(*places: Path) -> list[str]:
    """Remove from folders the temporary files of writers that were killed: of processes that are gone, and on other machines
    once they are old (`REMAINS_S`).

    Returns:
        One line for each that was found and whose writer is not at work in this process.
    """
    lines = []
    for place in places:
        for path in sorted(place.glob(".*.tmp*")) if place.is_dir() else ():
            if (found := _TEMPORARY.fullmatch(path.name)) is None:
                continue
            with suppress(OSError):  # another process was faster, or the folder is read-only
                writer = found[1] or found[2]
                gone = len(writer) == 32 and writer_is_gone(writer)
                if gone or time.time() - path.lstat().st_mtime > REMAINS_S:
                    path.unlink()
                    lines.append(
                        f"{printable(path)}: half written by a process that is gone; removed"
                    )
    return lines


def _open_own(path: Path) -> int:
    """A descriptor of a plain file of the folder, created if missing; links and pipes raise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    words = "no plain file but a link or a pipe; take it away"
    try:
        handle = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO):
            raise
        raise OSError(error.errno, words, str(path)) from None
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, words, str(path))
    return handle


_locks: set[BinaryIO] = set()  # open files of this process that may hold a lock


# A fork shares its parent's locks, and would hold them after the parent's death.
os.register_at_fork(after_in_child=lambda: [_locks.pop().close() for _ in list(_locks)])


@dataclass
class Claim:
    """A file that this process alone has locked."""

    died: list[str] = field(default_factory=list)
    """who died while it held the file: `process 7 on HOST`, the first one first"""
    kept: bool = False
    """whether the file stays when the block ends: whoever looks later sees who died"""


@contextmanager
def claim(path: Path) -> Iterator[Claim | None]:
    """The claim of a file, until the block ends or the process dies; None if another process has it.

    The file has a line for each process that died while it held the claim, then one for the process
    that holds it. It goes with the end of the block, whatever ended that: only a process that dies
    leaves its line.

    A claim saves double work: rows of a shard are equal whoever writes them. So a file system without
    locks gives the claim to every process.
    """
    lock, own = _locked(path)
    try:
        found = Claim(_lines(os.pread(lock.fileno(), MOST_CLAIM_BYTES, 0))) if own else None
        if found is not None:
            with suppress(OSError):  # a full disk: only the name is missing
                me = f"process {os.getpid()} on {socket.gethostname()}"
                text = "".join(f"{line}\n" for line in [*found.died, me]).encode()
                os.ftruncate(lock.fileno(), os.pwrite(lock.fileno(), text, 0))
        try:
            yield found
        finally:
            if found is not None and not found.kept:
                path.unlink(missing_ok=True)
    finally:
        _locks.discard(lock)
        lock.close()


def _locked(path: Path) -> tuple[BinaryIO, bool]:
    """The open file, and whether this process has it for itself."""
    while True:
        lock = open(_open_own(path), "r+b", buffering=0)  # noqa: SIM115 (whoever asked closes it)
        _locks.add(lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if isinstance(error, BlockingIOError):
                return lock, False
            if error.errno in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK):
                return lock, True
            _locks.discard(lock)
            lock.close()
            raise
        with suppress(FileNotFoundError):
            if os.path.samestat(os.lstat(path), os.fstat(lock.fileno())):
                return lock, True
        _locks.discard(lock)  # its holder's block ended meanwhile, and the file went with it
        lock.close()


def is_held(path: Path) -> bool:
    """Whether a process has the claim of a file now. Nothing is written; a sweep that asks at this instant asks again."""
    with suppress(OSError):
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(handle)
    return False


def died_at(path: Path) -> list[str]:
    """The lines of a claim, held or not: who died with it, last of all who holds it."""
    with suppress(OSError, FileError):
        return _lines(read_file(path, MOST_CLAIM_BYTES))
    return []


def owner_of(path: Path) -> str:
    """Who holds a claim, or died with it: `process 7 on HOST`; empty if that is not known."""
    return (died_at(path) or [""])[-1]


def _lines(text: bytes) -> list[str]:
    return [printable(line) for line in text.decode(errors="replace").split("\n")[:-1]]


def in_the_way(path: Path, *, folder: bool = False) -> str:
    """The fault of a path that should be a file (or folder) of the run; empty if it has none."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return ""
    if (stat.S_ISDIR if folder else stat.S_ISREG)(mode):
        return ""
    what = f"is {kind_of(mode)}, where the run has a {'folder' if folder else 'file'} of its own"
    return f"{printable(path)} {what}; move it away and run the same command again"


def trouble_in(folder: Path, error: OSError) -> str:
    """One line about an error while the folder was written: the file and what to do; or empty."""
    names = [
        n for n in (error.filename2, error.filename) if isinstance(n, (str, bytes, os.PathLike))
    ]
    for place in (Path(os.path.abspath(os.fsdecode(name))) for name in names):
        if not place.is_relative_to(folder):
            continue
        place = place.with_name(re.sub(r"^\.(.+)\.[0-9a-f]{32}\.tmp$", r"\1", place.name))
        inside = place.relative_to(folder)
        for k in range(1, len(inside.parts) + 1):
            is_folder = k < len(inside.parts) or error.errno in (errno.EEXIST, errno.ENOTDIR)
            if what := in_the_way(folder.joinpath(*inside.parts[:k]), folder=is_folder):
                return f"run folder {printable(folder)}: {what}"
        why = error.strerror or error
        return f"run folder {printable(folder)}: {printable(inside)}: {why}; {GO_ON}"
    return ""
