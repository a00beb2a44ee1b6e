"""Grasps of one object by anybody, in the robot's own ee frame: one type, one file format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.arrays import arrays_digest
from r2h_batch.io.read import FileError, printable, read_npz, read_safetensors

__all__ = ["ANY_PART", "GraspSet", "read_grasps"]

ANY_PART = -1
MAX_GRASPS = 100_000
RIGID = 1e-3
WIDEST_M = 10.0


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
        """What the file holds."""
        return {
            "T_obj_ee": self.T_obj_ee,
            "width": self.width,
            "score": self.score,
            "part": self.part,
        }

    def rows(self, rows: Any) -> GraspSet:
        """The selected grasps."""
        return GraspSet(**{k: v[rows] for k, v in self.arrays().items()}, gripper=self.gripper)


def read_grasps(path: str | Path) -> GraspSet:
    """An .npz or .safetensors file with T_obj_ee (N, 4, 4), and width, score, part (N,) where they
    are known.

    Missing ones are 0, 1 and -1. An .npz may name its `gripper`. Raises `FileError`, one line.
    """
    path, where = Path(path), printable(path)
    if path.suffix not in (".npz", ".safetensors"):
        raise FileError(
            f"{where}: grasps are an .npz or .safetensors file; r2h-batch import grasps makes one of others"
        )
    found = read_npz(path) if path.suffix == ".npz" else read_safetensors(path)[0]
    gripper = found.pop("gripper", np.array("2f-85"))
    if gripper.shape != () or gripper.dtype.kind != "U" or len(str(gripper)) > 64:
        raise FileError(f"{where}: gripper is no name")
    return checked_grasps(found, where, str(gripper))


def checked_grasps(found: Mapping[str, Any], where: str, gripper: str) -> GraspSet:
    """The set of these arrays; `FileError` where they are no grasps."""
    T = found.get("T_obj_ee")
    if (
        not isinstance(T, np.ndarray)
        or T.dtype.kind != "f"
        or T.shape[1:] != (4, 4)
        or not 1 <= len(T) <= MAX_GRASPS
    ):
        have = f"{T.shape} {T.dtype}" if isinstance(T, np.ndarray) else "missing"
        raise FileError(
            f"{where}: T_obj_ee is {have}; need N x 4 x 4 floats, N from 1 to {MAX_GRASPS}"
        )
    if unknown := sorted(set(found) - {"T_obj_ee", "width", "score", "part"}):
        raise FileError(
            f"{where}: unknown array {printable(unknown[0])!r}; allowed are T_obj_ee, width, score, part"
        )
    defaults = {
        "width": np.zeros(len(T)),
        "score": np.ones(len(T)),
        "part": np.full(len(T), ANY_PART),
    }
    columns = {k: found.get(k, v) for k, v in defaults.items()}
    for name, value in columns.items():
        kinds = "iu" if name == "part" else "fiu"
        if (
            value.shape != (len(T),)
            or value.dtype.kind not in kinds
            or not np.isfinite(value).all()
        ):
            raise FileError(
                f"{where}: {name} is {value.shape} {value.dtype}; need {len(T)} finite numbers"
            )
    if columns["width"].min() < 0 or columns["width"].max() > WIDEST_M:
        row = int(((columns["width"] < 0) | (columns["width"] > WIDEST_M)).argmax())
        raise FileError(
            f"{where}: width of grasp {row} is {columns['width'][row]:g}; 0 to {WIDEST_M:g} m are allowed"
        )
    R = T[:, :3, :3].astype(np.float64)
    rigid = (
        np.isfinite(T).all()
        and (np.abs(T[:, 3] - [0, 0, 0, 1]) < RIGID).all()
        and np.abs(T).max() < 100
    )
    if (
        not rigid
        or np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max() > RIGID
        or (np.linalg.det(R) < 0).any()
    ):
        raise FileError(f"{where}: T_obj_ee holds something else than rigid poses in metres")
    if columns["part"].min() < ANY_PART or columns["part"].max() > 255:
        raise FileError(f"{where}: part is an index into the object's parts, or -1")
    return GraspSet(
        T.astype(np.float32), columns["width"].astype(np.float32), columns["score"].astype(np.float32),
        columns["part"].astype(np.int32), gripper,
    )  # fmt: skip
