"""Grasps of one object by anybody, in the robot's own ee frame: one type, one file format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.arrays import Spec, check_arrays, check_poses
from r2h_batch.base.io.read import printable, read_npz
from r2h_batch.scene.arrays import arrays_digest

ANY_PART = -1
MAX_GRASPS = 100_000
WIDEST_M = 10.0
SPECS: dict[str, Spec] = {
    "T_obj_ee": ("f", ("N", 4, 4)), "width": ("fiu", ("N",)), "score": ("fiu", ("N",)), "part": ("iu", ("N",)),
}  # fmt: skip
DEFAULTS = {"width": 0.0, "score": 1.0, "part": ANY_PART}
"""What arrays that a file may leave out are full of."""


@dataclass(frozen=True, eq=False)
class GraspSet:
    """N grasps of an object."""

    T_obj_ee: NDArray[np.float32]
    """(N, 4, 4) ee in the object's frame: between the finger pads at half stroke, z out of the
    gripper, y closing"""
    width: NDArray[np.float32]
    """(N,) m, what the source calls the grasp's width"""
    score: NDArray[np.float32]
    """(N,) higher is better"""
    part: NDArray[np.int32]
    """(N,) index into the object's `part_names`, -1: not said"""
    gripper: str = "2f-85"
    """which gripper they were made for; any other's are seated anew"""

    def __len__(self) -> int:
        return len(self.width)

    @cached_property
    def digest(self) -> str:
        """sha256 over the grasps and their gripper."""
        return arrays_digest({**self.arrays(), "gripper": np.array(self.gripper)})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays of the file."""
        return {k: getattr(self, k) for k in SPECS}

    def turned(self, R: NDArray[np.float64]) -> GraspSet:
        """The grasps in a frame of the object that is turned by R (3, 3)."""
        T = self.T_obj_ee.astype(np.float64)
        T[:, :3] = R @ T[:, :3]
        return GraspSet(**{**self.arrays(), "T_obj_ee": T.astype(np.float32)}, gripper=self.gripper)

    def rows(self, rows: Any) -> GraspSet:
        """The selected grasps."""
        return GraspSet(**{k: v[rows] for k, v in self.arrays().items()}, gripper=self.gripper)


def read_grasps(path: str | Path) -> GraspSet:
    """An .npz file with T_obj_ee (N, 4, 4), and width, score, part (N,) where they
    are known.

    Missing ones are 0, 1 and -1. An .npz may name its `gripper`. Raises `FileError`, one line.
    """
    path, where = Path(path), printable(path)
    if path.suffix != ".npz":
        raise FileError(f"{where}: grasps are an .npz file; make one with r2h-batch import grasps")
    found = read_npz(path)
    gripper = found.pop("gripper", np.array("2f-85"))
    if gripper.shape != () or gripper.dtype.kind != "U" or len(str(gripper)) > 64:
        raise FileError(f"{where}: gripper is not a name")
    return checked_grasps(found, where, str(gripper))


def checked_grasps(found: Mapping[str, Any], where: str, gripper: str) -> GraspSet:
    """The set of these arrays; `FileError` where they are not grasps."""
    n = len(np.atleast_1d(found.get("T_obj_ee", ())))
    columns = {**{k: np.full(n, v) for k, v in DEFAULTS.items()}, **found}
    check_arrays(columns, SPECS, where, optional=tuple(DEFAULTS), only=True)
    _check_values(columns, where)
    return GraspSet(
        columns["T_obj_ee"].astype(np.float32), columns["width"].astype(np.float32),
        columns["score"].astype(np.float32), columns["part"].astype(np.int32), gripper,
    )  # fmt: skip


def _check_values(columns: Mapping[str, NDArray[Any]], where: str) -> None:
    """Refuses numbers that no grasps have, in arrays of the right form."""
    T, width, part = columns["T_obj_ee"], columns["width"], columns["part"]
    n = len(T)
    if not 1 <= n <= MAX_GRASPS:
        raise FileError(f"{where}: {n} grasps; 1 to {MAX_GRASPS} are allowed")
    if ((width < 0) | (width > WIDEST_M)).any():
        row = int(((width < 0) | (width > WIDEST_M)).argmax())
        allowed = f"0 to {WIDEST_M:g} m are allowed"
        raise FileError(f"{where}: width of grasp {row} is {width[row]:g}; {allowed}")
    check_poses(f"{where}: T_obj_ee", T)
    if part.min() < ANY_PART or part.max() > 255:
        raise FileError(f"{where}: part is an index into the object's parts, or -1")
