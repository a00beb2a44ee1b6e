"""Arrays of a user's file, checked for kinds, shapes and rigid poses with one form of message."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError, nearest
from r2h_batch.base.io.read import printable

Spec = tuple[str, tuple[int | str, ...]]
"""The allowed `dtype.kind`, and the shape. A word stands for any length, the same one everywhere."""

RIGID = 1e-3
FARTHEST_M = 10.0
_KINDS = {"f": "floats (float32 or float64)", "iu": "whole numbers", "U": "text"}


def check_arrays(
    arrays: Mapping[str, Any],
    specs: Mapping[str, Spec],
    where: str,
    *,
    optional: Collection[str] = (),
    only: bool = False,
    gaps: Collection[str] = (),
    taken: Collection[str] = (),
) -> dict[str, int]:
    """Refuse arrays that are not as specified.

    Args:
        arrays: of a file, by name.
        specs: what they must be.
        where: the file, for messages.
        optional: names that may be missing.
        only: whether other names are refused.
        gaps: names whose numbers need not be finite.
        taken: further names that a file may have and that were read before.

    Returns:
        The lengths that words stand for.

    Raises:
        FileError: one line that names the array.
    """
    if only and (unknown := sorted(set(arrays) - set(specs))):
        shown = repr(printable(unknown[0])[:60])
        allowed = (*specs, *taken)
        hint = nearest(unknown[0], allowed)
        raise FileError(f"{where}: unknown array {shown}{hint}; allowed are {', '.join(allowed)}")
    lengths: dict[str, int] = {}
    for name, spec in specs.items():
        if name in arrays:
            check_array(f"{where}: {name}", arrays[name], spec, lengths, gaps=name in gaps)
        elif name not in optional:
            needed = ", ".join(n for n in specs if n not in optional)
            raise FileError(f"{where}: has no {name}; needed are {needed}")
    return lengths


def check_array(
    what: str, value: Any, spec: Spec, lengths: dict[str, int] | None = None, *, gaps: bool = False
) -> None:
    """Refuse one array that is not as specified; `lengths` receives what words stand for."""
    kinds, shape = spec
    lengths = {} if lengths is None else lengths
    expected = [lengths.get(n, n) if isinstance(n, str) else n for n in shape]
    is_array = isinstance(value, np.ndarray) and value.ndim == len(shape)
    if (
        not is_array
        or value.dtype.kind not in kinds
        or any(n != m for n, m in zip(expected, value.shape) if not isinstance(n, str))
    ):
        found = f"{value.shape} {value.dtype}" if isinstance(value, np.ndarray) else "no array"
        need = f"{' x '.join(map(str, expected)) or 'one'} {_KINDS.get(kinds, 'numbers')}"
        raise FileError(f"{what} is {found}; need {need}")
    lengths |= {n: m for n, m in zip(shape, value.shape) if isinstance(n, str)}
    if value.dtype.kind == "f" and not gaps and not np.isfinite(value).all():
        row = np.argwhere(~np.isfinite(value))[0]
        raise FileError(f"{what} holds a number that is not finite in row {int(row[0])}")


def not_rigid(T: NDArray[Any]) -> NDArray[np.bool_]:
    """(N,) whether (N, 4, 4) matrices are invalid transforms: some entry is off by more than
    `RIGID`."""
    with np.errstate(all="ignore"):
        R = T[:, :3, :3].astype(np.float64)
        error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
        last_row = np.abs(T[:, 3] - [0, 0, 0, 1]).max(1)
        return ~((error < RIGID) & (last_row < RIGID) & (np.linalg.det(R) > 0))


def check_poses(what: str, T: NDArray[Any]) -> None:
    """Refuse (N, 4, 4) invalid transforms, and translations beyond 10 m."""
    if (off := not_rigid(T)).any():
        raise FileError(f"{what} of row {int(off.argmax())} is not a rigid pose")
    far = np.abs(T[:, :3, 3]).max(1, initial=0.0) > FARTHEST_M
    if far.any():
        how = f"is more than {FARTHEST_M:g} m away; lengths are in metres"
        raise FileError(f"{what} of row {int(far.argmax())} {how}")
