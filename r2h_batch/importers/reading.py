"""Other people's files with Python objects in them: pickles, and arrays of dictionaries; only data
comes out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from r2h_batch.importers.safe_pickle import MAX_BYTES, UnsafePickle, read_pickle
from r2h_batch.io import read as files
from r2h_batch.io.read import FileError, printable, read_file

__all__ = ["ImportRefused", "read_npy", "read_object", "read_pickle_file"]


class ImportRefused(FileError):
    """A file that is not imported: one line that names it, what was found and what is allowed."""


def read_pickle_file(path: Path) -> Any:
    """The data of a pickle, as `safe_pickle.read_pickle`."""
    return read_object(read_file(path, MAX_BYTES), printable(path))


def read_npy(path: Path) -> Any:
    """What an .npy file holds, dictionaries and lists of arrays too, as ARCTIC stores them."""
    return files.read_npy(path, objects=read_object)


def read_object(data: bytes, where: str) -> Any:
    """The data of a pickled array: what `io.read.read_npz` takes as `objects`."""
    try:
        return read_pickle(data, where=where)
    except UnsafePickle as error:
        raise ImportRefused(str(error)) from None
