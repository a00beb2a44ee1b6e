"""ACRONYM (Eppner et al. 2021), an object's .h5: grasps/transforms (N, 4, 4),
grasps/qualities/flex/object_in_gripper.

Grasps are poses of the Panda's hand in the frame of the object's mesh, which has object/scale
applied; a grasp counts that held the object in simulation.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from r2h_batch.bodies.grasp_set import MAX_GRASPS, GraspSet, checked_grasps
from r2h_batch.importers.arrays import numbers
from r2h_batch.importers.grasps.grippers import T_gripper_ee
from r2h_batch.importers.grasps.hdf5 import read_datasets
from r2h_batch.io.read import FileError, printable

__all__ = ["read"]

GRIPPER = "acronym-panda"
TRANSFORMS, QUALITY, KIND = (
    "grasps/transforms",
    "grasps/qualities/flex/object_in_gripper",
    "gripper/type",
)


def read(path: Path) -> tuple[GraspSet, int]:
    """The grasps that held in simulation, and how many others there are."""
    where = printable(path)
    most = {TRANSFORMS: 16 * MAX_GRASPS, QUALITY: MAX_GRASPS, KIND: 1}
    found = read_datasets(path, most, optional=KIND)
    T = numbers(found[TRANSFORMS], (None, 4, 4), f"{where} {TRANSFORMS}")
    held = numbers(found[QUALITY], (len(T),), f"{where} {QUALITY}")
    kind = found[KIND] if found[KIND].size else np.array("panda")
    if kind.dtype.kind != "U" or kind.shape:
        raise FileError(f"{where}: {KIND} is no word; ACRONYM's is 'panda'")
    if kind != "panda":
        raise FileError(f"{where}: gripper {printable(kind)[:40]!r}; ACRONYM's is the panda")
    good = held > 0
    if not good.any():
        raise FileError(f"{where}: none of {len(T)} grasps held the object")
    arrays = {"T_obj_ee": T[good] @ T_gripper_ee(GRIPPER), "score": held[good]}
    return checked_grasps(arrays, where, GRIPPER), int((~good).sum())
