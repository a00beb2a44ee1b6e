"""Arrays out of somebody's .npy, .npz and .safetensors, sizes first: nothing is allocated that only
a header claims."""

from __future__ import annotations

import io
import json
import math
import warnings
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.files import FileError, archive_members, open_archive, printable, read_file
from r2h_batch.files.output import whole

__all__ = ["MAX_BYTES", "read_npy", "read_npz", "read_safetensors", "write_npz"]

MAX_BYTES = 256 << 20
MAX_MEMBERS = 64

_SAFETENSORS: dict[str, np.dtype[Any]] = {
    **{
        "F64": np.dtype("<f8"),
        "F32": np.dtype("<f4"),
        "F16": np.dtype("<f2"),
        "U8": np.dtype("u1"),
        "I8": np.dtype("i1"),
    },
    **{"I16": np.dtype("<i2"), "I32": np.dtype("<i4"), "I64": np.dtype("<i8")},
}

Objects = Callable[[bytes, str], Any]
"""What reads a pickled array (its bytes, where it stands); None: such arrays are refused."""


def read_npy(path: Path, *, objects: Objects | None = None, most: int = MAX_BYTES) -> Any:
    """What an .npy file of at most `most` bytes holds. Raises `FileError`, one line."""
    return _array(read_file(path, most), printable(path), objects)


def read_npz(
    path: Path,
    *,
    objects: Objects | None = None,
    only: Collection[str] | None = None,
    most: int = MAX_BYTES,
) -> dict[str, Any]:
    """The arrays of an .npz file that unpacks to at most `most` bytes, by name. Raises `FileError`,
    one line.

    `only`: names of the arrays to read, at most `MAX_BYTES` each; others count for `most` but are
    left alone.
    """
    with open_archive(path, most) as archive:
        found = {}
        for member in archive_members(archive, path, count=MAX_MEMBERS, size=most):
            name = member.orig_filename
            if not name.endswith(".npy"):
                raise FileError(f"{printable(path)}: member {name!r} is no array")
            if only is not None and name.removesuffix(".npy") not in only:
                continue
            if member.file_size > MAX_BYTES:
                raise FileError(
                    f"{printable(path)}: {name!r} has {member.file_size} bytes; {MAX_BYTES} are allowed"
                )
            with archive.open(member) as stream:
                data = stream.read(member.file_size + 1)
            if len(data) != member.file_size:
                raise FileError(
                    f"{printable(path)}: member {name!r} is longer or shorter than the archive says"
                )
            found[name.removesuffix(".npy")] = _array(data, f"{printable(path)}: {name}", objects)
    return found


def read_safetensors(path: Path, *, most: int = MAX_BYTES) -> dict[str, Any]:
    """The arrays of a .safetensors file of at most `most` bytes, by name. Raises `FileError`, one
    line."""
    data, where = read_file(path, most), printable(path)
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > min(len(data) - 8, 1 << 20):
        raise FileError(
            f"{where}: damaged safetensors: a header of {length} bytes in a file of {len(data)}"
        )
    try:
        header = json.loads(data[8 : 8 + length])
        entries = {k: v for k, v in header.items() if k != "__metadata__"}
        found = {}
        for name, entry in entries.items():
            dtype, shape = _SAFETENSORS[entry["dtype"]], [int(n) for n in entry["shape"]]
            first, last = (8 + length + int(n) for n in entry["data_offsets"])
            size = math.prod(shape) * dtype.itemsize
            if (
                min([0, *shape]) < 0
                or not 8 + length <= first <= last <= len(data)
                or last - first != size
            ):
                raise FileError(
                    f"{where}: {printable(name)!r} of shape {shape} does not fit into its bytes"
                )
            found[name] = np.frombuffer(data[first:last], dtype).reshape(shape)
    except (
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
        json.JSONDecodeError,
        UnicodeDecodeError,
    ) as error:
        raise FileError(f"{where}: damaged safetensors header ({type(error).__name__})") from None
    if len(found) > MAX_MEMBERS:
        raise FileError(f"{where}: {len(found)} arrays; at most {MAX_MEMBERS} are allowed")
    return found


def _array(data: bytes, where: str, objects: Objects | None) -> Any:
    stream = io.BytesIO(data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a header that Python takes with a frown
            version = np.lib.format.read_magic(stream)
            one = version == (1, 0)
            read = (
                np.lib.format.read_array_header_1_0 if one else np.lib.format.read_array_header_2_0
            )
            shape, fortran, dtype = read(stream)
    except Exception as error:  # the header is Python text: its parser raises whatever it meets
        raise FileError(
            f"{where}: no readable .npy header ({' '.join(printable(error).split())[:80]})"
        ) from None
    rest = data[stream.tell() :]
    if dtype.hasobject:
        if objects is None or dtype != np.dtype(object):
            raise FileError(f"{where}: holds Python objects; numbers are allowed")
        value = objects(rest, where)
        whole = isinstance(value, np.ndarray) and value.dtype == object and value.shape == ()
        return value.item() if whole else value
    size = math.prod(int(n) for n in shape) * dtype.itemsize
    if dtype.kind not in "biufUS" or size != len(rest):
        raise FileError(
            f"{where}: {len(rest)} bytes of {dtype} for an array of shape {tuple(shape)}"
        )
    array: NDArray[Any] = np.frombuffer(rest, dtype)
    array = array.reshape(shape, order="F" if fortran else "C")
    return array.astype(dtype.newbyteorder("="), copy=False)


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the arrays; the name never stands for half a file, and its folder is made where it is
    missing."""
    with whole(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
