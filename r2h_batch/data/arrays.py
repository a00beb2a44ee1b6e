"""Other people's files and arrays: those of a folder, numbers of a known shape, rigid poses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.log import LOG
from r2h_batch.base.io.read import printable

F64 = NDArray[np.float64]
MAX_FRAMES = MAX_FILES = 200_000


def rigid(turn: F64, place: F64) -> F64:
    """(N, 4, 4) poses of N rotation matrices and places (N, 3)."""
    T = np.tile(np.eye(4), (len(place), 1, 1))
    T[:, :3, :3] = turn
    T[:, :3, 3] = place
    return T


def numbers(value: Any, shape: tuple[int | None, ...], what: str, *, most: float = 1e6) -> F64:
    """The array as float64 if it has this shape (None: any length, at most 200,000) and finite
    numbers of at most `most`."""
    listed = isinstance(value, list) and _size(value) <= 48 * MAX_FRAMES
    try:
        value = np.asarray(value) if listed or isinstance(value, (np.ndarray, np.generic)) else None
    except ValueError:  # lists of different lengths
        value = None
    fits = value is not None and value.dtype.kind in "biuf" and value.ndim == len(shape)
    if (
        value is None
        or not fits
        or any(n is not None and n != m for n, m in zip(shape, value.shape))
    ):
        have = "missing or no numbers" if value is None else f"{value.shape} of {value.dtype}"
        raise FileError(
            f"{what} is {have}; need {' x '.join('any' if n is None else str(n) for n in shape)}"
        )
    if value.size and (
        (value.ndim and len(value) > MAX_FRAMES)
        or not np.isfinite(value).all()
        or np.abs(value).max() > most
    ):
        raise FileError(f"{what} has too many frames or numbers that are not finite")
    return value.astype(np.float64)


def _size(value: Any) -> int:
    """How many numbers a list would have as an array: it may hold one large array many times."""
    if isinstance(value, list):
        return sum(_size(v) for v in value)
    return value.size if isinstance(value, np.ndarray) else 1


def files_below(folder: Path, pattern: str) -> list[Path]:
    """Files of the pattern below the folder, sorted; links that lead out of it are left out. Raises
    if there is none."""
    base = folder.resolve()
    if not base.is_dir():
        raise FileError(f"{printable(folder)}: no such folder")
    found: list[Path] = []
    outside = 0
    for path in base.glob(pattern):
        if not path.resolve().is_relative_to(base):
            outside += 1
            continue
        found.append(path)
        if len(found) > MAX_FILES:
            raise FileError(f"{printable(folder)}: more than {MAX_FILES} files {pattern}")
    links = f"{outside} {pattern} {'is a link that leads' if outside == 1 else 'are links that lead'} out of the folder"
    if not found and outside:
        raise FileError(
            f"{printable(folder)}: {links} (not followed); give the folder that holds the files"
        )
    if not found:
        raise FileError(f"{printable(folder)}: holds no {pattern}; is it the right folder?")
    if outside:
        LOG.info(f"{printable(folder)}: {links}, left out")
    return sorted(found)
