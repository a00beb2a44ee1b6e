"""What a command was asked to write: whole or not at all, never over what is there unless that is
said, never over a run.

A command asks `check_file` (or `check_folder`) before its work starts, so that nothing is lost at
the end; whoever writes uses `whole`. What a Python program writes by a function is replaced, as by
`open(..., "w")`.
"""

import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from uuid import uuid4

from r2h_batch.files import FileError, printable

__all__ = ["check_file", "check_folder", "run_folder_of", "whole", "write_text"]

OWN = ("trials", "details", "poses", "paths", "failures", "manifest", "methods", "quarantine")
"""Folders that a run folder may have for its own."""


def run_folder_of(path: Path) -> Path | None:
    """The run folder that the path lies in, however deep; None where it lies in none."""
    for folder in Path(os.path.abspath(path)).parents:
        if os.path.lexists(folder / "run.json") and os.path.isdir(folder / "manifest"):
            return folder
    return None


def check_file(
    path: Path, *, overwrite: bool = False, flag: str = "--out", endings: Sequence[str] = ()
) -> None:
    """`FileError` where a command may not write this file, or its name has none of these `endings`.

    That is: a name that a run folder has for its own; a folder, a pipe, a device; a path that
    cannot be; and without `overwrite` anything that is there.
    """
    shown = f"{flag} {printable(path)}"
    if endings and path.suffix.lower() not in endings:
        raise FileError(f"{shown}: its ending must be {' or '.join(endings)}")
    _not_a_runs(path, shown)
    found = _found(path, shown)
    if found is None:
        return
    if not (stat.S_ISREG(found.st_mode) or stat.S_ISLNK(found.st_mode)):
        raise FileError(f"{shown}: is no plain file; give a file's name")
    if not overwrite and (
        found.st_size or not stat.S_ISREG(found.st_mode)
    ):  # an empty file loses nothing
        raise FileError(
            f"{shown}: is there already; give another name, or add --overwrite to replace it"
        )


def check_folder(path: Path, *, overwrite: bool | None = False, flag: str = "--out") -> None:
    """`FileError` where a command may not write into this folder: it is none, or without
    `overwrite` not empty.

    None: a command that writes into new or empty folders only.
    """
    shown = f"{flag} {printable(path)}"
    _not_a_runs(path, shown)
    found = _found(path, shown)
    if found is None:
        return
    if not path.is_dir():
        raise FileError(f"{shown}: is no folder; give a new or empty one")
    if not overwrite and any(path.iterdir()):
        how = "" if overwrite is None else ", or add --overwrite to write into this one"
        raise FileError(f"{shown}: is not empty; give a new or empty folder{how}")


def _not_a_runs(path: Path, shown: str) -> None:
    folder = run_folder_of(path)
    if folder is None:
        return
    inside = Path(os.path.abspath(path)).relative_to(folder)
    mine = inside.parts[0] in OWN or inside.parts[0].startswith(".")
    if mine or (len(inside.parts) == 1 and inside.suffix in (".json", ".txt")):
        raise FileError(
            f"{shown}: is what the run folder {printable(folder)} may store there; write elsewhere"
        )


def _found(path: Path, shown: str) -> os.stat_result | None:
    """What stands there, links as such; None: nothing."""
    try:
        return os.lstat(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise FileError(
            f"{shown}: no path that can be written ({error.strerror or error})"
        ) from None


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A name to write to, which becomes `path` when the block ends well; a link there is replaced,
    not followed.

    Its folder is made where it is missing. An `OSError` from inside names the file.
    """
    temporary = path.with_name(f".{uuid4().hex[:12]}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is None or str(error.filename) == str(temporary):
            error.filename = str(path)
        error.filename2 = None
        raise
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write the text in UTF-8, whole or not at all."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
