"""Files that appear whole or not at all: unique temporary name, fsync, link (the first writer
wins), fsync of the folder."""

import errno
import fcntl
import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from r2h_batch.files import kind_of, printable


def sha256_of(path: Path) -> str:
    """sha256 (hex) of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def temporary_name(path: Path) -> Path:
    """A unique hidden name beside `path` that no reader of `*.parquet` or `*.json` takes for a
    finished file."""
    return path.with_name(f".{path.name}.{uuid4().hex}.tmp")


def sync_file(path: Path) -> None:
    """The file's bytes are on the disk when this returns; an error of a full disk or a quota comes
    out here at last."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """The names in a folder are on the disk when this returns."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def link_once(temporary: Path, final: Path) -> bool:
    """Give a finished temporary file its name; False if the name is taken: the first writer
    wins."""
    try:
        os.link(temporary, final)
    except FileExistsError:
        return False
    except OSError as error:
        if error.errno in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
            raise OSError(
                error.errno,
                "this file system has no hard links; put the run folder on one that has",
                str(final),
            ) from error
        raise
    sync_folder(final.parent)
    return True


def write_json_once(path: Path, data: Mapping[str, Any]) -> bool:
    """Write a JSON file unless there is one; False if there was."""
    temporary = _json_file(path, data)
    try:
        return link_once(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def drop_second_names(folder: Path) -> None:
    """Remove temporary names of files that have their final name as well: their writer was killed
    between the two."""
    for temporary in folder.glob(".*.tmp") if folder.is_dir() else ():
        try:
            if temporary.lstat().st_nlink > 1:
                temporary.unlink()
        except OSError:  # its writer lives and was faster, or the folder is only for reading
            continue


def replace_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a JSON file in place of the one that may be there; readers see the old or the new
    one."""
    temporary = _json_file(path, data)
    try:
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _json_file(path: Path, data: Mapping[str, Any]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = temporary_name(path)
    try:
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(data, file, indent=1, allow_nan=False)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return temporary


def open_own(path: Path, flags: int) -> int:
    """A descriptor of a plain file of the folder, made where there is none; links and pipes are
    refused in one line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return os.open(
            path, flags | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666
        )
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.ENXIO):
            raise
        raise OSError(
            error.errno, "no plain file but a link or a pipe; take it away", str(path)
        ) from None


def trouble_in(folder: Path, error: OSError) -> str:
    """What an error while a run folder was written says: the folder, what in it (by its final
    name), what to do."""
    for name in (error.filename2, error.filename):
        place = (
            Path(os.path.abspath(os.fsdecode(name)))
            if isinstance(name, (str, bytes, os.PathLike))
            else None
        )
        if place is None or not place.is_relative_to(folder):
            continue
        place = place.with_name(re.sub(r"^\.(.+)\.[0-9a-f]{32}\.tmp$", r"\1", place.name))
        inside = place.relative_to(folder).parts
        for k in range(1, len(inside) + 1):
            is_folder = k < len(inside) or error.errno in (errno.EEXIST, errno.ENOTDIR)
            if what := in_the_way(folder.joinpath(*inside[:k]), folder=is_folder):
                return f"run folder {printable(folder)}: {what}"
        why = error.strerror or error
        return f"run folder {printable(folder)}: {printable(place.relative_to(folder))}: {why}; {GO_ON}"
    return ""


GO_ON = "shards that were complete are stored, run the same command to go on"


def in_the_way(path: Path, *, folder: bool = False) -> str:
    """What stands where a run has a file (or a folder) of its own and is none, and what to do;
    empty where nothing is wrong."""
    try:
        mode = path.lstat().st_mode
    except OSError:
        return ""
    if (stat.S_ISDIR if folder else stat.S_ISREG)(mode):
        return ""
    what = f"is {kind_of(mode)}, where the run has a {'folder' if folder else 'file'} of its own"
    return f"{printable(path)} {what}; move it away and run the same command again"


@contextmanager
def claim(path: Path) -> Iterator[bool]:
    """Whether this process alone works on what `path` stands for, until the block ends or the
    process dies.

    A claim only saves double work; `link_once` decides who wins. So a file system without locks
    says yes to everybody.
    """
    with open(open_own(path, os.O_RDWR), "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        except OSError as error:
            if error.errno not in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK):
                raise
        yield True
