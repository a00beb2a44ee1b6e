"""Stored arrays: reading an .npz of the assets, and the digest that names what is in it."""

import hashlib
from collections.abc import Mapping
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def arrays_digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """sha256 over names, types, shapes and bytes, sorted by name; the container's time stamps do
    not matter."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}:{value.dtype.str}:{value.shape}:".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()


def asset(folder: str, name: str) -> Traversable:
    """A file of the assets: `asset("hand", "hand.npz")`."""
    return resources.files(f"r2h_batch.assets.{folder}") / name


def read_arrays(file: str | Path | Traversable) -> dict[str, NDArray[Any]]:
    """All arrays of an .npz; pickled ones, which run code when read, are refused."""
    with (
        (Path(file) if isinstance(file, str) else file).open("rb") as stream,
        np.load(stream, allow_pickle=False) as data,
    ):
        return {name: data[name] for name in data.files}


def stored_arrays(folder: str, name: str) -> dict[str, NDArray[Any]]:
    """The arrays of an asset, none where it has not been built yet (its own build script imports
    its reader)."""
    file = asset(folder, name)
    return read_arrays(file) if file.is_file() else {}
