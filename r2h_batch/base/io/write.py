"""Output files: written whole or not at all, never over an existing file unless --overwrite says
so, never over the files of a run folder.

A command calls `check_output_file` or `check_output_folder` before its work starts, so that no work
is lost. All writing goes through `atomic_path`. Python functions replace an existing file, as
`open(..., "w")` does.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import stat
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

from r2h_batch.base.errors import FileError, MachineError
from r2h_batch.base.io.read import printable

RUN_FOLDERS = ("shards", "methods", "benchmark")
"""Folders that a run folder may contain."""


def run_folder_of(path: Path) -> Path | None:
    """The run folder that contains the path at any depth; None where there is none."""
    for folder in Path(os.path.abspath(path)).parents:
        if os.path.lexists(folder / "run.json") and os.path.isdir(folder / "methods"):
            return folder
    return None


def check_output_file(
    path: Path, *, overwrite: bool = False, flag: str = "--out", endings: Sequence[str] = ()
) -> None:
    """Refuse an output file that a command may not write.

    Args:
        path: the file.
        overwrite: whether it may replace a file with content.
        flag: the command's flag, for the message.
        endings: the allowed endings; none allows all.

    Raises:
        FileError: the path is impossible, belongs to a run folder, is not a plain file, or exists.
        MachineError: no file can be written there.
    """
    shown = f"{flag} {printable(path)}"
    if endings and path.suffix.lower() not in endings:
        raise FileError(f"{shown}: its ending must be {' or '.join(endings)}")
    found = _found(path, shown)
    if found is None:
        return
    regular = stat.S_ISREG(found.st_mode)
    if not regular and not stat.S_ISLNK(found.st_mode):
        raise FileError(f"{shown}: is not a plain file; give a file's name")
    if not overwrite and (found.st_size or not regular):  # an empty file loses nothing
        how = "give another name, or add --overwrite to replace it"
        raise FileError(f"{shown}: is there already; {how}")


def check_output_folder(path: Path, *, overwrite: bool | None = False, flag: str = "--out") -> None:
    """Refuse an output folder that a command may not write into.

    Args:
        path: the folder.
        overwrite: whether it may contain files; None for commands that have no such flag.
        flag: the command's flag, for the message.

    Raises:
        FileError: the path is impossible, belongs to a run folder, is not a folder, or is not empty.
        MachineError: no file can be written there.
    """
    shown = f"{flag} {printable(path)}"
    if _found(path, shown) is None:
        return
    if not path.is_dir():
        raise FileError(f"{shown}: is not a folder; give a new or empty one")
    if not overwrite and any(path.iterdir()):
        how = "" if overwrite is None else ", or add --overwrite to write into this one"
        raise FileError(f"{shown}: is not empty; give a new or empty folder{how}")


def _found(path: Path, shown: str) -> os.stat_result | None:
    """`lstat` of the path, None if nothing is there. A path that a run folder may use is
    refused, and one below a folder that takes no file: before the work, and not after it."""
    if (folder := run_folder_of(path)) is not None:
        inside = Path(os.path.abspath(path)).relative_to(folder)
        own = inside.parts[0] in RUN_FOLDERS or inside.parts[0].startswith(".")
        if own or (len(inside.parts) == 1 and inside.suffix in (".json", ".txt")):
            where = f"the run folder {printable(folder)} may store a file there"
            raise FileError(f"{shown}: {where}; write elsewhere")
    try:
        return os.lstat(path)
    except FileNotFoundError:
        above = next(p for p in Path(os.path.abspath(path)).parents if p.exists())
        try:
            tempfile.TemporaryFile(dir=above).close()
        except OSError as error:
            why = error.strerror or error
            raise MachineError(
                f"{shown}: no file can be written in {printable(above)} ({why})"
            ) from None
        return None
    except OSError as error:
        why = error.strerror or error
        raise FileError(f"{shown}: no path that can be written ({why})") from None


@contextmanager
def naming(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """An `OSError` from inside that names no file, or a temporary one, names `path`, and its reason is the system's."""
    try:
        yield
    except OSError as error:
        if error.filename is None or str(error.filename) == str(temporary):
            if error.errno and (error.strerror or "").startswith("Error "):  # Arrow's sentence
                error.strerror = os.strerror(error.errno)
            error.filename = str(path)
        error.filename2 = None
        raise


@cache
def _machine() -> str:
    """8 hexadecimal digits of this machine's start and namespace of processes, in which a number is one process."""
    said = [socket.gethostname()]
    for read in (
        lambda: Path("/proc/sys/kernel/random/boot_id").read_text(),
        lambda: os.readlink("/proc/self/ns/pid"),
    ):
        with suppress(OSError):
            said.append(read())
    return hashlib.sha256("\n".join(said).encode()).hexdigest()[:8]


def writers_name() -> str:
    """32 hexadecimal digits for the name of a temporary file, which no other has: `writer_is_gone` knows who writes it."""
    return f"{_machine()}{os.getpid():08x}{uuid4().hex[:16]}"


def writer_is_gone(name: str) -> bool:
    """Whether the process that took a name from `writers_name` has ended; False where that is not known: on another machine.

    Args:
        name: 32 hexadecimal digits.
    """
    if name[:8] != _machine():
        return False
    try:
        os.kill(int(name[8:16], 16), 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # somebody else's process
        return False
    return False


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name that becomes `path` when the block ends without an error.

    A link at `path` is replaced, not followed. A missing folder is made. An `OSError` from inside
    names `path`.
    """
    temporary = path.with_name(f".{writers_name()}.tmp{path.suffix}")
    try:
        with naming(path, temporary):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            os.replace(temporary, path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write text in UTF-8, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


JSON_WIDTH = 150


def packed_json(data: Any, indent: int = 0) -> str:
    """JSON in lines of about `JSON_WIDTH` characters: as many entries in a line as fit.

    Raises:
        ValueError: for NaN and infinity.
    """
    whole = json.dumps(data, allow_nan=False)
    if len(whole) + indent <= JSON_WIDTH or not isinstance(data, (dict, list)):
        return whole
    if isinstance(data, dict):
        first, last = "{}"
        entries = [f"{json.dumps(k)}: {packed_json(v, indent + 1)}" for k, v in data.items()]
    else:
        entries, (first, last) = [packed_json(v, indent + 1) for v in data], "[]"
    lines = [entries[0]]
    for entry in entries[1:]:
        joined = f"{lines[-1]}, {entry}"
        if "\n" in joined or len(joined) + indent >= JSON_WIDTH:
            lines[-1] += ","
            lines.append(entry)
        else:
            lines[-1] = joined
    pad = " " * (indent + 1)
    return "\n".join([first, *(pad + line for line in lines), " " * indent + last])


def write_json(path: Path, data: Any) -> None:
    """Write JSON, whole or not at all; ValueError for NaN and infinity."""
    write_text(path, packed_json(data) + "\n")


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays by name, whole or not at all. A list of arrays is written one after the other, as
    their concatenation that memory never holds."""
    import numpy as np

    whole = {name: value for name, value in arrays.items() if not isinstance(value, list)}
    with atomic_path(path) as temporary:
        with temporary.open("wb") as stream:
            np.savez(stream, **whole)
        with zipfile.ZipFile(temporary, "a") as archive:
            for name in [n for n in arrays if n not in whole]:
                parts = arrays[name]
                shape = (sum(map(len, parts)), *parts[0].shape[1:])
                header = np.lib.format.header_data_from_array_1_0(parts[0]) | {"shape": shape}
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    for part in parts:
                        member.write(np.ascontiguousarray(part).tobytes())


def csv_cell(value: object) -> object:
    """A value for a CSV cell. Text that a spreadsheet would run as a formula gets an apostrophe."""
    if not isinstance(value, str) or not value.lstrip().startswith(("=", "+", "-", "@")):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
