"""Datasets of a stranger's HDF5 file, read in a process of their own: in a damaged file the library
goes in circles.

HDF5 can name other files. Every step of a path must lie in this file; datasets that keep their
numbers elsewhere, or are put together from others, are refused. `python -m
r2h_batch.data.hdf5` is the child.
"""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.child import answer_parent, read_in_child
from r2h_batch.base.io.read import open_file, printable

MOST = 64 << 20
MOST_CHUNK = 1 << 20
MOST_SECONDS = 20.0


def read_datasets(path: Path, most: Mapping[str, int], optional: str = "") -> dict[str, Any]:
    """The datasets of these names, each of at most this many numbers; text as NumPy's U; an empty
    array for the `optional` one where its group is missing.

    Raises:
        FileError: one line that names the file and the dataset.
    """
    if find_spec("h5py") is None:
        raise FileError("ACRONYM's .h5 needs h5py: pip install 'r2h_batch[import]'")
    where, child = printable(path), "r2h_batch.data.hdf5"
    with open_file(path, MOST) as file:
        try:
            arrays = read_in_child(
                child, file, {"most": dict(most), "optional": optional}, count=len(most), seconds=MOST_SECONDS,
                doing=f"{where}: reading",
            )  # fmt: skip
        except FileError as error:
            raise FileError(f"{where}: {error}") from None
    return dict(zip(most, arrays, strict=True))


def _read(data: bytes, options: dict[str, Any]) -> list[Any]:
    import h5py

    try:
        file = h5py.File(io.BytesIO(data), "r")
    except OSError as error:
        why = " ".join(printable(error).split())[:120]
        raise FileError(f"not a readable HDF5 file ({why})") from None
    with file:
        missing = options["optional"] if options["optional"].split("/")[0] not in file else ""
        return [
            np.zeros(0) if name == missing else _dataset(h5py, file, name, most)
            for name, most in options["most"].items()
        ]


def _dataset(h5py: Any, file: Any, name: str, most: int) -> Any:
    """A dataset that lies whole in this file."""
    at = file
    for step in name.split("/"):
        if not isinstance(at, h5py.Group):
            raise FileError(f"{name} is not there")
        link = at.get(step, getlink=True)
        if link is None:
            raise FileError(f"has no {name}")
        if not isinstance(link, h5py.HardLink):
            why = "is a link, perhaps to another file; only data in this file are read"
            raise FileError(f"{name} {why}")
        at = at[step]
    if not isinstance(at, h5py.Dataset) or at.external or at.is_virtual:
        raise FileError(f"{name} keeps its numbers elsewhere; only data in this file are read")
    if at.size is None or at.size > most or at.dtype.itemsize > 256:
        raise FileError(f"{name} has {at.size} numbers; at most {most} are allowed")
    # a chunk is unpacked whole
    if at.chunks is not None and math.prod(at.chunks) > max(MOST_CHUNK, at.size):
        chunk = math.prod(at.chunks)
        raise FileError(f"{name} lies in chunks of {chunk} numbers, more than it holds")
    if not h5py.check_string_dtype(at.dtype):
        return np.asarray(at[()])
    words = np.asarray(at.asstr("utf-8", errors="replace")[()], object)
    return np.array([str(w)[:100] for w in words.ravel()], "U100").reshape(words.shape)


if __name__ == "__main__":
    sys.exit(answer_parent(_read))
