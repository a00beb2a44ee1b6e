"""GraspNet-1Billion (Fang et al. 2020), graspnetAPI's .npy of N x 17: [score, width, height, depth,
R (9), t (3), object].

R's columns are approach, closing axis and their normal; t lies `depth` before the fingertips. Poses
are in the frame that the network saw: `T_obj_source` takes them to the object's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.grasp_set import MAX_GRASPS, GraspSet, checked_grasps
from r2h_batch.importers.arrays import numbers, rigid
from r2h_batch.importers.grasps.grippers import PAD_HALF_M
from r2h_batch.io.read import FileError, printable, read_npy

__all__ = ["read"]


def read(
    path: Path, *, object_id: int | None = None, T_obj_source: NDArray[np.float64] | None = None
) -> tuple[GraspSet, int]:
    """The grasps of one object, and how many are others'."""
    where = printable(path)
    rows = numbers(read_npy(path, most=MAX_GRASPS * 17 * 8 + 4096), (None, 17), where)
    if not len(rows):
        raise FileError(f"{where}: holds no grasp (0 x 17)")
    if (odd := rows[:, 16] != np.round(rows[:, 16])).any():
        row = int(odd.argmax())
        raise FileError(
            f"{where}: object {rows[row, 16]:g} of row {row}; objects are whole numbers"
        )
    mine = np.ones(len(rows), bool) if object_id is None else rows[:, 16] == object_id
    if not mine.any():
        ids = sorted({int(i) for i in rows[:, 16]})[:10]
        raise FileError(
            f"{where}: no grasp of object {object_id}; there are objects {', '.join(map(str, ids))}"
        )
    if object_id is None and len(np.unique(rows[:, 16])) > 1:
        many = len(np.unique(rows[:, 16]))
        raise FileError(
            f"{where}: grasps of {many} objects; choose one with --object-id of r2h-batch import grasps"
        )
    rows = rows[mine]
    R = rows[:, 4:13].reshape(-1, 3, 3)
    approach, closing = R[:, :, 0], R[:, :, 1]
    R = np.stack([np.cross(closing, approach), closing, approach], axis=2)
    T = rigid(R, rows[:, 13:16] + (rows[:, 3] - PAD_HALF_M)[:, None] * approach)
    T = T if T_obj_source is None else T_obj_source @ T
    arrays = {"T_obj_ee": T, "width": rows[:, 1], "score": rows[:, 0]}
    return checked_grasps(arrays, where, "graspnet"), int((~mine).sum())
