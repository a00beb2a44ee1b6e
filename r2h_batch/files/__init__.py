"""What other people wrote: files opened with limits, archives looked through first, text made fit
for a terminal.

Every path that a user names is opened here, and nowhere else. Only regular files are: opening a
pipe waits for ever, reading a device has no end. Nothing is read before its size is known to be
allowed.
"""

import io
import os
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import BinaryIO

__all__ = [
    "DAMAGED_ARCHIVE",
    "FileError",
    "archive_members",
    "csv_cell",
    "kind_of",
    "open_archive",
    "open_file",
    "path_within",
    "printable",
    "read_file",
]

MAX_RATIO = 200
RATIO_FREE_BYTES = 1 << 20
"""Members declared smaller than this may compress as well as they like."""
MAX_DIRECTORY_BYTES = 1 << 20
"""Largest directory of an archive: some thousand names."""

_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe, which may never end",
    stat.S_IFCHR: "a device, which may never end",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFLNK: "a symbolic link",
    stat.S_IFREG: "a file",
}


def kind_of(mode: int) -> str:
    """What `os.lstat(...).st_mode` says: a file, a folder, a pipe, ..."""
    return _KINDS.get(stat.S_IFMT(mode), "of an unknown kind").partition(",")[0]


class FileError(ValueError):
    """A file that is not read: one line that names it, what was found and what is allowed."""


_UNSEEN = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u0600-\u0605\u061c\u06dd\u070f\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    "\ud800-\udfff\ufeff\ufff9-\ufffb\U000e0000-\U000e007f]"
)
"""Unicode's control and format characters, line separators and lone surrogates."""


def printable(text: object, keep: str = "") -> str:
    """The text fit for a terminal, in one line: control characters, line ends, bidi marks and lone
    halves of characters become escapes such as \\x1b (but for those to `keep`): no name from a file
    moves a cursor or hides what stands there."""
    return _UNSEEN.sub(
        lambda m: m[0] if m[0] in keep else m[0].encode("unicode_escape").decode("ascii"), str(text)
    )


def csv_cell(value: object) -> object:
    """A value for a CSV cell: text that a spreadsheet would take for a formula has an apostrophe
    before it."""
    if not isinstance(value, str) or not value.lstrip().startswith(("=", "+", "-", "@")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def open_file(path: str | Path, most: int) -> BinaryIO:
    """A regular file of at most `most` bytes opened for reading in binary, or a `FileError`; links
    are followed."""
    shown = printable(path)
    flags = os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
    try:
        _regular(os.stat(path), shown)  # opening alone may wait (a pipe) or do something (a tape)
        handle = os.open(path, flags)
    except FileNotFoundError:
        raise FileError(f"{shown}: no such file") from None
    except OSError as error:
        raise FileError(f"{shown}: cannot be read ({error.strerror or error})") from None
    except ValueError as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{shown}: no path ({error})") from None
    try:
        found = os.fstat(handle)  # another file may have taken the name since
        _regular(found, shown)
        if found.st_size > most:
            raise FileError(f"{shown}: {found.st_size} bytes; at most {most} are allowed")
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def _regular(found: os.stat_result, shown: str) -> None:
    if not stat.S_ISREG(found.st_mode):
        kind = _KINDS.get(stat.S_IFMT(found.st_mode), "of an unknown kind")
        how = (
            "give a file in it"
            if stat.S_ISDIR(found.st_mode)
            else "copy its content into a file and give that"
        )
        raise FileError(f"{shown}: not a regular file but {kind}; {how}")


def read_file(path: str | Path, most: int) -> bytes:
    """All bytes of a regular file, at most `most` (also where the file grows, or says that it has 0
    as in /proc)."""
    with open_file(path, most) as file:
        try:
            data = file.read(most + 1)
        except OSError as error:
            raise FileError(
                f"{printable(path)}: cannot be read ({error.strerror or error})"
            ) from None
    if len(data) > most:
        raise FileError(f"{printable(path)}: more than {most} bytes; at most {most} are allowed")
    return data


def path_within(folder: str | Path, name: str) -> Path:
    """The file that `name` means inside `folder`, for names that stand in somebody's file; others
    are a `FileError`.

    Absolute names, names with `..`, with a drive or an address before them, and links that lead out
    are refused.
    """
    parts = PurePosixPath(name.replace("\\", "/"))
    if ":" in name and "://" not in name and name[1:2] != ":":
        raise FileError(
            f"{printable(name)!r}: has a colon, which no file beside another may have here; rename it"
        )
    if not name or ".." in parts.parts or parts.is_absolute() or ":" in name or "\0" in name:
        raise FileError(
            f"{printable(name)!r}: points outside the folder; a plain name beside the file is allowed"
        )
    base = Path(folder).resolve()
    path = (base / parts).resolve()
    if not path.is_relative_to(base):
        raise FileError(
            f"{printable(name)!r}: a link that leads outside the folder; put the file itself there"
        )
    return path


DAMAGED_ARCHIVE = (
    *(zipfile.BadZipFile, zlib.error, EOFError, OSError, struct.error),
    *(NotImplementedError, RuntimeError, UnicodeDecodeError, OverflowError),
)
"""What zipfile raises on an archive that is not as it should be."""


class _SmallReads(io.BufferedReader):
    """A file that refuses one read above `limit` bytes: an archive's directory is read whole,
    however long it says it is."""

    limit: int | None = MAX_DIRECTORY_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            size = max(os.fstat(self.fileno()).st_size - self.tell(), 0)
        if self.limit is not None and size > self.limit:
            raise zipfile.BadZipFile(f"a directory of more than {self.limit} bytes")
        return super().read(size)


@contextmanager
def open_archive(path: str | Path, most: int) -> Iterator[zipfile.ZipFile]:
    """The zip archive in a regular file of at most `most` bytes; whatever is wrong with it is one
    `FileError`."""
    with _SmallReads(open_file(path, most).detach()) as careful:  # type: ignore[attr-defined]
        try:
            with zipfile.ZipFile(careful) as archive:
                careful.limit = None
                yield archive
        except DAMAGED_ARCHIVE as error:
            raise FileError(
                f"{printable(path)}: truncated or damaged archive ({printable(error)}); write or copy it again"
            ) from error


def archive_members(
    archive: zipfile.ZipFile, path: str | Path, *, count: int, size: int
) -> list[zipfile.ZipInfo]:
    """The archive's members, at most `count` that unpack to at most `size` bytes, if its directory
    can be true.

    Every byte of the file may stand for one member only: then no small file unpacks to more than
    200 times itself.
    """
    shown, members = printable(path), archive.infolist()
    names = [m.orig_filename for m in members]
    if len(members) > count:
        raise FileError(f"{shown}: {len(members)} members; at most {count} are allowed")
    for m, name in zip(members, names):
        parts = PurePosixPath(name.replace("\\", "/"))
        if ".." in parts.parts or parts.is_absolute() or name[1:2] == ":" or "\0" in name:
            raise FileError(
                f"{shown}: member {name!r} points outside the archive; nothing is extracted"
            )
        if stat.S_ISLNK(m.external_attr >> 16):
            raise FileError(
                f"{shown}: member {name!r} is a symbolic link; only plain members are allowed"
            )
        if m.flag_bits & 0x1:
            raise FileError(f"{shown}: member {name!r} is encrypted")
        if m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            kind = zipfile.compressor_names.get(m.compress_type, str(m.compress_type))  # type: ignore[attr-defined]
            raise FileError(
                f"{shown}: member {name!r} is compressed as {kind}; allowed are stored and deflated"
            )
        if m.compress_type == zipfile.ZIP_STORED and m.compress_size != m.file_size:
            raise FileError(
                f"{shown}: member {name!r} is stored as {m.compress_size} bytes but says {m.file_size}"
            )
        if m.file_size > RATIO_FREE_BYTES and m.file_size > MAX_RATIO * m.compress_size:
            raise FileError(
                f"{shown}: member {name!r} declares {m.file_size} bytes from {m.compress_size}; at most {MAX_RATIO}"
                " times is allowed: store it without compression (np.savez instead of np.savez_compressed)"
            )
    if len(set(names)) != len(names):
        raise FileError(
            f"{shown}: duplicate member {max(names, key=names.count)!r}; every name may appear once"
        )
    if (total := sum(m.file_size for m in members)) > size:
        raise FileError(
            f"{shown}: declares {total} bytes; at most {size} are allowed: split it into several"
        )
    _apart(members, archive.start_dir, shown)
    return members


def _apart(members: Sequence[zipfile.ZipInfo], end: int, shown: str) -> None:
    """Refuse members that lie on one another: the same bytes unpacked many times are a bomb."""
    for m in sorted(members, key=lambda m: m.header_offset, reverse=True):
        last = m.header_offset + zipfile.sizeFileHeader + len(m.orig_filename) + m.compress_size  # type: ignore[attr-defined]
        if last > end:
            raise FileError(
                f"{shown}: member {m.orig_filename!r} overlaps what follows it; write the archive again"
            )
        end = m.header_offset
