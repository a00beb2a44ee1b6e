"""Bounded reading of files that other people wrote.

The package opens every path that a user names through this module. It opens regular files only:
opening a pipe may wait for ever, and reading a device has no end. It checks declared sizes before
it allocates memory. Every refusal is a `FileError` of one line: the file, what was found, what is
allowed.
"""

from __future__ import annotations

import gc
import json
import math
import os
import re
import stat
import struct
import sys
import warnings
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from io import BufferedReader, BytesIO
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from r2h_batch.base.errors import FileError

MAX_ARRAY_BYTES = 256 << 20
MAX_ARRAYS = 64
MAX_HEADER_BYTES = 1 << 20
"""Largest directory of an archive: some thousand names."""
MAX_RATIO, RATIO_FREE_BYTES = 200, 1 << 20
"""Largest compression ratio of an archive's member; smaller members may have any ratio."""
MAX_NAME, MAX_FOLDERS, MAX_SHOWN = 1000, 32, 80
"""Longest name of an archive's member, folders in it, letters of it that a message shows."""
MAX_YAML_BYTES, MAX_YAML_DEPTH = 1 << 20, 4
MAX_JSON_BYTES = 64 << 20  # a parsed JSON takes about 20 times its size

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
    """The kind of file that `os.lstat(...).st_mode` names: a file, a folder, a pipe, ..."""
    return _KINDS.get(stat.S_IFMT(mode), "of an unknown kind").partition(",")[0]


# Unicode's control and format characters, line separators and lone surrogates
_UNSEEN = re.compile(
    "[\x00-\x1f\x7f-\x9f\xad\u0600-\u0605\u061c\u06dd\u070f\u180e\u200b-\u200f\u2028-\u202e\u2060-\u206f"
    "\ud800-\udfff\ufeff\ufff9-\ufffb\U000e0000-\U000e007f]"
)


def printable(text: object, keep: str = "") -> str:
    """The text as one line that is safe in a terminal.

    Control characters, line ends, bidirectional marks and lone surrogates become escapes such as
    \\x1b. So a name from a file cannot move the cursor or hide other text.

    Args:
        text: anything; `str` is taken of it.
        keep: characters that stay as they are.
    """
    return _UNSEEN.sub(
        lambda m: m[0] if m[0] in keep else m[0].encode("unicode_escape").decode("ascii"), str(text)
    )


def open_file(path: str | Path, most: int) -> BinaryIO:
    """Open a regular file for binary reading. Links are followed.

    Args:
        path: the file.
        most: largest size that is allowed, bytes.

    Raises:
        FileError: it does not exist, is not a regular file, or is larger.
    """
    shown = printable(path)
    flags = os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0)
    try:
        # before open: opening alone may wait (a pipe) or act (a tape)
        _check_regular(os.stat(path), shown)
        handle = os.open(path, flags)
    except FileNotFoundError:
        raise FileError(f"{shown}: no such file") from None
    except OSError as error:
        raise FileError(f"{shown}: cannot be read ({error.strerror or error})") from None
    except FileError:
        raise
    except ValueError as error:
        raise FileError(f"{shown}: not a path ({error})") from None
    try:
        found = os.fstat(handle)  # another file may have taken the name since
        _check_regular(found, shown)
        if found.st_size > most:
            raise FileError(f"{shown}: {found.st_size} bytes; at most {most} are allowed")
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def _check_regular(found: os.stat_result, shown: str) -> None:
    if stat.S_ISREG(found.st_mode):
        return
    kind = _KINDS.get(stat.S_IFMT(found.st_mode), "of an unknown kind")
    is_folder = stat.S_ISDIR(found.st_mode)
    how = "give a file in it" if is_folder else "copy its content into a file and give that"
    raise FileError(f"{shown}: not a regular file but {kind}; {how}")


def read_file(path: str | Path, most: int) -> bytes:
    """All bytes of a regular file of at most `most` bytes, also where its size is not known first
    (it grows, or it lies in /proc)."""
    shown = printable(path)
    with open_file(path, most) as file:
        try:
            data = file.read(most + 1)
        except OSError as error:
            raise FileError(f"{shown}: cannot be read ({error.strerror or error})") from None
    if len(data) > most:
        raise FileError(f"{shown}: more than {most} bytes; at most {most} are allowed")
    return data


def path_within(folder: str | Path, name: str) -> Path:
    """The path of `name` inside `folder`, where `name` comes from a user's file.

    Raises:
        FileError: the name is absolute, contains `..`, a drive or an address, or is a link that
            leads outside.
    """
    shown, parts = repr(printable(name)), PurePosixPath(name.replace("\\", "/"))
    if ":" in name and "://" not in name and name[1:2] != ":":
        words = "contains a colon, which is not allowed in this name"
        raise FileError(f"{shown}: {words}; rename the file")
    if not name or ".." in parts.parts or parts.is_absolute() or ":" in name or "\0" in name:
        raise FileError(f"{shown}: points outside the folder; give a plain name beside the file")
    base = Path(folder).resolve()
    path = (base / parts).resolve()
    if not path.is_relative_to(base):
        raise FileError(f"{shown}: a link that leads outside the folder; put the file itself there")
    return path


# ---- archives and arrays

_DAMAGED_ARCHIVE = (
    *(zipfile.BadZipFile, zlib.error, EOFError, OSError, struct.error),
    *(NotImplementedError, RuntimeError, UnicodeDecodeError, OverflowError),
)
"""Exceptions that zipfile raises for a damaged archive."""


class _SmallReads(BufferedReader):
    """A file that refuses one read above `limit` bytes. zipfile reads an archive's directory at
    once, with the length that the archive declares."""

    limit: int | None = MAX_HEADER_BYTES

    def read(self, size: int | None = -1, /) -> bytes:
        if size is None or size < 0:
            size = max(os.fstat(self.fileno()).st_size - self.tell(), 0)
        if self.limit is not None and size > self.limit:
            raise zipfile.BadZipFile(f"a directory of more than {self.limit} bytes")
        return super().read(size)


@contextmanager
def open_archive(path: str | Path, most: int) -> Iterator[zipfile.ZipFile]:
    """A zip archive in a regular file of at most `most` bytes. A damaged one is a `FileError`."""
    with _SmallReads(open_file(path, most).detach()) as careful:  # type: ignore[attr-defined]
        try:
            with zipfile.ZipFile(careful) as archive:
                careful.limit = None
                yield archive
        except _DAMAGED_ARCHIVE as error:
            what = f"truncated or damaged archive ({printable(error)})"
            raise FileError(f"{printable(path)}: {what}; write or copy it again") from error


def archive_members(
    archive: zipfile.ZipFile,
    path: str | Path,
    *,
    count: int,
    size: int,
    only: Collection[str] | None = None,
) -> list[zipfile.ZipInfo]:
    """The members of an archive whose directory is honest, or those of these names.

    Members may not overlap. Those that are returned have a bounded compression ratio. So no file
    unpacks to more than 200 times its size, except for members below 1 MiB.

    Args:
        archive: from `open_archive`.
        path: for messages.
        count: largest number of members.
        size: largest sum of the uncompressed sizes of the members that are returned, bytes.
        only: names of the members to return; None returns all.
    """
    shown, members = printable(path), archive.infolist()
    if len(members) > count:
        raise FileError(f"{shown}: {len(members)} members; at most {count} are allowed")
    names = [m.orig_filename for m in members]
    read = [m for m, name in zip(members, names, strict=True) if only is None or name in only]
    for m in read:
        if what := _wrong_member(m):
            raise FileError(f"{shown}: member {m.orig_filename[:MAX_SHOWN]!r} {what}")
    if len(set(names)) != len(names):
        twice = max(names, key=names.count)
        raise FileError(
            f"{shown}: duplicate member {twice[:MAX_SHOWN]!r}; every name may appear once"
        )
    if (total := sum(m.file_size for m in read)) > size:
        raise FileError(f"{shown}: declares {total} bytes; at most {size} are allowed: split it")
    end = archive.start_dir
    for m in sorted(members, key=lambda m: m.header_offset, reverse=True):
        header = zipfile.sizeFileHeader + len(m.orig_filename)  # type: ignore[attr-defined]
        if m.header_offset + header + m.compress_size > end:
            name = m.orig_filename
            raise FileError(
                f"{shown}: member {name[:MAX_SHOWN]!r} overlaps another; write the archive again"
            )
        end = m.header_offset
    return read


def _wrong_member(m: zipfile.ZipInfo) -> str:
    """The reason to refuse an archive's member; empty where there is none."""
    name, packed, size = m.orig_filename, m.compress_size, m.file_size
    parts = PurePosixPath(name.replace("\\", "/"))
    if ".." in parts.parts or parts.is_absolute() or name[1:2] == ":" or "\0" in name:
        return "points outside the archive; nothing is extracted"
    if len(name) > MAX_NAME or len(parts.parts) > MAX_FOLDERS:
        return (
            f"has a longer name than {MAX_NAME} letters or lies deeper than {MAX_FOLDERS} folders"
        )
    if stat.S_ISLNK(m.external_attr >> 16):
        return "is a symbolic link; only plain members are allowed"
    if m.flag_bits & 0x1:
        return "is encrypted; write the archive without a password"
    if m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        kind = zipfile.compressor_names.get(m.compress_type, str(m.compress_type))  # type: ignore[attr-defined]
        return f"is compressed as {kind}; allowed are stored and deflated"
    if m.compress_type == zipfile.ZIP_STORED and packed != size:
        return f"is stored as {packed} bytes but declares {size}"
    if size > RATIO_FREE_BYTES and size > MAX_RATIO * packed:
        return (
            f"declares {size} bytes from {packed}; at most {MAX_RATIO} times is allowed: store it"
            " without compression (np.savez instead of np.savez_compressed)"
        )
    return ""


Objects = Callable[[bytes, str], Any]
"""Reads a pickled array, given its bytes and its place in a file."""


def read_npy(path: Path, *, objects: Objects | None = None, most: int = MAX_ARRAY_BYTES) -> Any:
    """The array of an .npy file of at most `most` bytes.

    Args:
        path: the file.
        objects: reads arrays of Python objects; None refuses them.
        most: largest size, bytes.
    """
    return _array(read_file(path, most), printable(path), objects)


def read_npz(
    path: Path, *, objects: Objects | None = None, only: Collection[str] | None = None,
    most: int = MAX_ARRAY_BYTES, most_each: int = MAX_ARRAY_BYTES,
) -> dict[str, Any]:  # fmt: skip
    """The arrays of an .npz file, by name.

    Args:
        path: the file.
        objects: reads arrays of Python objects; None refuses them.
        only: names of the arrays to read; None reads all. Nothing is asked of the others.
        most: largest size of the file, and of all arrays that are read together, bytes.
        most_each: largest size of an array that is read, bytes.
    """
    found, shown = {}, printable(path)
    with open_archive(path, most) as archive:
        members = None if only is None else [f"{name}.npy" for name in only]
        for member in archive_members(archive, path, count=MAX_ARRAYS, size=most, only=members):
            name, size = member.orig_filename, member.file_size
            key = name.removesuffix(".npy")
            if name == key:
                words = "is not an .npy array (is this a pickle?)"
                if name.endswith(".xml"):
                    words = "is XML: a spreadsheet or document of an office program; save it as CSV UTF-8"
                raise FileError(f"{shown}: member {name!r} {words}")
            if size > most_each:
                raise FileError(f"{shown}: {name!r} has {size} bytes; {most_each} are allowed")
            with archive.open(member) as stream:
                data = stream.read(size + 1)
            if len(data) != size:
                raise FileError(f"{shown}: member {name!r} differs in length from the directory")
            found[key] = _array(data, f"{shown}: {name}", objects)
    return found


def _array(data: bytes, where: str, objects: Objects | None) -> Any:
    """The array of the bytes of an .npy file, without a copy."""
    import numpy as np

    stream = BytesIO(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy warns of headers that only Python 2 wrote
            form = np.lib.format
            one = form.read_magic(stream) == (1, 0)
            read = form.read_array_header_1_0 if one else form.read_array_header_2_0
            shape, fortran, dtype = read(stream)
    except Exception as error:  # the header is Python text, and its parser raises anything
        why = " ".join(printable(error).split())[:80]
        raise FileError(f"{where}: no readable .npy header ({why})") from None
    start = stream.tell()
    if dtype.hasobject:
        if objects is None or dtype != np.dtype(object):
            raise FileError(f"{where}: holds Python objects (a pickle); numbers are allowed")
        value = objects(data[start:], where)
        single = isinstance(value, np.ndarray) and value.dtype == object and value.shape == ()
        return value.item() if single else value
    if dtype.kind == "c":
        raise FileError(
            f"{where}: is {dtype}; complex numbers are not allowed: write the real part"
        )
    size = math.prod(int(n) for n in shape) * dtype.itemsize
    if dtype.kind not in "biufUS" or min([0, *shape]) < 0 or size != len(data) - start:
        held = len(data) - start
        raise FileError(f"{where}: {held} bytes of {dtype} for an array of shape {tuple(shape)}")
    if size == 0:
        return np.zeros(shape, dtype)
    found = np.frombuffer(data, dtype, offset=start).reshape(shape, order="F" if fortran else "C")
    found = found.astype(dtype.newbyteorder("="), copy=False)
    if dtype.kind == "U" and (np.frombuffer(found.tobytes(), "=u4") > sys.maxunicode).any():
        raise FileError(f"{where}: holds text that is not Unicode")  # str() of it would fail
    return found


# ---- JSON and YAML


_KEY = re.compile(rb'"\s*:')


def read_json(path: Path, *, most: int = MAX_JSON_BYTES) -> Any:
    """The value of a JSON file in UTF-8 of at most `most` bytes, in which no key stands twice."""
    from pydantic_core import from_json

    data, where = read_file(path, most), printable(path)
    _refuse_utf_16(data, where)
    data, collecting = data.removeprefix(b"\xef\xbb\xbf"), gc.isenabled()
    gc.disable()  # what is parsed has no cycles; looking for them takes longer than parsing
    try:
        found = from_json(data)
        # it takes the last of keys that are alike: ask the slow parser where more are written than found
        if len(_KEY.findall(data)) > _keys(found):
            json.loads(data, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        how = ""
        if re.search(rb"[\s:,\[]-?(?:nan|inf|Inf)\b", data):
            how = "; numbers that are not finite are written NaN, Infinity or -Infinity"
        elif re.search(rb"\}\s*\n\s*\{", data):
            how = "; it holds several values, one a line: write one object of lists"
        raise FileError(f"{where}: no readable JSON ({printable(error)[:200]}){how}") from None
    finally:
        if collecting:
            gc.enable()
    return found


def _refuse_utf_16(data: bytes, where: str) -> None:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise FileError(f"{where}: is in UTF-16; save it in UTF-8")


def _once(pairs: list[tuple[str, Any]]) -> None:
    names = [name for name, _ in pairs]
    if len(set(names)) != len(names):
        raise ValueError(f"duplicate key {max(names, key=names.count)!r}")


def _keys(value: Any) -> int:
    """How many keys a JSON value has, those in lists that do not begin with an object left out."""
    if isinstance(value, dict):
        return len(value) + sum(_keys(v) for v in value.values())
    listed = isinstance(value, list) and value and isinstance(value[0], dict)
    return sum(_keys(v) for v in value) if listed else 0


_DECIMAL = re.compile(
    r"[-+]?(0|[1-9][0-9]{0,17})(\.[0-9]{0,30})?([eE][-+]?[0-9]{1,3})?|[-+]?\.[0-9]{1,30}"
)


def read_yaml(
    path: Path, *, most: int = MAX_YAML_BYTES, deepest: int = MAX_YAML_DEPTH
) -> dict[str, Any]:
    """The fields of a YAML file that holds plain data: words, numbers, lists and mappings.

    Tags, anchors, aliases, duplicate keys and keys that are not words are refused. Numbers are
    decimal: YAML 1.1 would read 1:30 as 90 and 017 as 15.

    Args:
        path: the file.
        most: largest size, bytes.
        deepest: largest nesting of lists and mappings.

    Raises:
        FileError: the message names the line.
    """
    import yaml

    shown = printable(path)
    try:
        read = read_file(path, most)
        _refuse_utf_16(read, shown)
        text = read.decode("utf-8")
        data = _plain_loader(text, deepest).get_single_data()
    except FileError:
        raise
    except UnicodeDecodeError:
        raise FileError(f"{shown}: is no text in UTF-8; a YAML file in UTF-8 is allowed") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        problem = printable(getattr(error, "problem", None) or error or "nested too deeply")
        raise FileError(f"{shown}:{where} {problem[:300]}") from None
    if isinstance(data, dict):
        return data
    kind = "a list" if isinstance(data, list) else "one word or number"
    found = "it is empty" if data is None else f"it holds {kind}"
    raise FileError(f"{shown}: must hold fields, one `name: value` a line; {found}")


def _plain_loader(text: str, deepest: int) -> Any:
    """PyYAML's safe loader of a text, for plain data only."""
    import yaml

    def refused(where: Any, problem: str) -> yaml.MarkedYAMLError:
        return yaml.MarkedYAMLError(problem=problem, problem_mark=where.start_mark)

    def check_value(field: str, node: Any) -> None:
        if isinstance(node, yaml.SequenceNode):
            for item in node.value:
                check_value(field, item)
        elif isinstance(node, yaml.ScalarNode):
            kind, shown = node.tag.rpartition(":")[2], f"{field} is {str(node.value)[:40]!r}"
            if kind == "timestamp":
                node.tag = "tag:yaml.org,2002:str"  # the name of a folder
            elif kind not in ("str", "int", "float", "bool", "null"):
                raise refused(node, f"{shown}, to YAML a {kind}; put quotes around a word")
            elif kind in ("int", "float"):
                plain = _DECIMAL.fullmatch(str(node.value))
                if not plain or not math.isfinite(float(node.value)):
                    raise refused(node, f"{shown}, not a plain number; write decimal digits")

    class Loader(yaml.SafeLoader):
        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            event: Any = self.peek_event()
            if self.depth > deepest:
                raise refused(event, "nested too deeply")
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                raise refused(event, "anchors and aliases are not allowed")
            if getattr(event, "tag", None):
                raise refused(event, f"tag {event.tag[:40]} is not allowed")
            self.depth += 1
            node: Any = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            seen = set()
            for key, value in node.value:
                if key.tag != "tag:yaml.org,2002:str":
                    word = isinstance(key.value, str)
                    what = repr(key.value[:40]) if word else "a list or mapping"
                    raise refused(key, f"{what} is a key; keys are words")
                if key.value in seen:
                    raise refused(key, f"{key.value[:40]} is given twice")
                seen.add(key.value)
                check_value(key.value[:40], value)
            return super().construct_mapping(node, deep)

    # YAML 1.1 takes 1e-3 for a word, other readers take it for a number
    exponent = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+\Z")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", exponent, list("-+0123456789"))
    return Loader(text)
