"""Files of a run folder: whole or not at all, the first writer wins, one process at a time.

Every file gets a temporary name, fsync, a hard link and fsync of the folder. No stored file changes,
so any number of processes can share a folder.
"""

import errno
import fcntl
import hashlib
import os
import re
import socket
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import kind_of, printable, read_file
from r2h_batch.base.io.write import packed_json

MOST_CLAIM_BYTES = 1000

GO_ON = "shards that were complete are stored, run the same command to go on"


class RunError(FileError):
    """A run folder cannot be written or read: the message names the file and what to do."""


def sha256_of(path: Path) -> str:
    """sha256 (hex) of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def temporary_name(path: Path) -> Path:
    """A unique hidden name beside `path` that no reader takes for a finished file."""
    return path.with_name(f".{path.name}.{uuid4().hex}.tmp")


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
        if error.errno in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
            words = "this file system has no hard links; put the run folder on one that has"
            raise OSError(error.errno, words, str(final)) from error
        raise
    folder = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
    return True


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
        with temporary.open("w", encoding="utf-8") as file:
            file.write(packed_json(data) + "\n")
            file.flush()
            os.fsync(file.fileno())
        return give_name(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def drop_second_names(folder: Path) -> None:
    """Remove temporary names of finished files: their writer was killed between the two names."""
    for temporary in folder.glob(".*.tmp") if folder.is_dir() else ():
        try:
            if temporary.lstat().st_nlink > 1:
                temporary.unlink()
        except OSError:  # its writer lives and was faster, or the folder is read-only
            continue


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


@dataclass(frozen=True)
class Claim:
    """A file that this process alone has locked: a dot for each process that died while it held the
    file, then who holds it."""

    handle: int

    @property
    def deaths(self) -> int:
        """How many processes died at the work."""
        return _dots(os.pread(self.handle, MOST_CLAIM_BYTES, 0).decode(errors="replace"))

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Around the work: a process that dies inside adds a death, an exception does not."""
        before = self.deaths
        self.note(before + 1)
        try:
            yield
        except BaseException:  # stopped, refused or a full disk
            self.note(before)
            raise
        self.note(0)

    def note(self, deaths: int) -> None:
        """Write the file."""
        words = b"." * deaths + f"process {os.getpid()} on {socket.gethostname()}".encode()
        os.pwrite(self.handle, words, 0)
        os.ftruncate(self.handle, len(words))


@contextmanager
def claim(path: Path) -> Iterator[Claim | None]:
    """The claim of a file, until the block ends or the process dies; None if another process has it.

    A claim saves double work; hard links decide who stores first. So a file system without locks
    gives the claim to every process.
    """
    with open(_open_own(path), "r+b", buffering=0) as lock:
        _locks.add(lock)
        try:
            own = True
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                own = error.errno in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)
                if not own and not isinstance(error, BlockingIOError):
                    raise
            found = Claim(lock.fileno())
            if own:
                with suppress(OSError):  # a full disk: only the name is missing
                    found.note(found.deaths)
            yield found if own else None
        finally:
            _locks.discard(lock)


def deaths_of(path: Path) -> int:
    """How many processes died at the work of a claim, held or not."""
    return _dots(_claim_text(path))


def set_deaths(path: Path, deaths: int) -> None:
    """Write the number of deaths of a claim, held or not."""
    handle = _open_own(path)
    try:
        Claim(handle).note(deaths)
    finally:
        os.close(handle)


def owner_of(path: Path) -> str:
    """Who holds a claim, or did last: `process 7 on HOST`; empty if that is not known."""
    return _claim_text(path).lstrip(".")


def _claim_text(path: Path) -> str:
    with suppress(OSError, FileError):
        return printable(read_file(path, MOST_CLAIM_BYTES).decode(errors="replace"))
    return ""


def _dots(text: str) -> int:
    return len(text) - len(text.lstrip("."))


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
