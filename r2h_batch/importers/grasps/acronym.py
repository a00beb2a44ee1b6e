"""ACRONYM (Eppner et al. 2021), an object's .h5: grasps/transforms (N, 4, 4),
grasps/qualities/flex/object_in_gripper.

Grasps are poses of the Panda's hand in the frame of the object's mesh, which has object/scale
applied; a grasp counts that held the object in simulation. HDF5 can name other files: every step of
a path must lie in this file, datasets that keep their numbers elsewhere, or are put together from
others, are refused.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from r2h_batch.bodies.grasp_set import MAX_GRASPS, GraspSet, checked_grasps
from r2h_batch.importers.grasps.grippers import T_gripper_ee
from r2h_batch.importers.sequences import numbers
from r2h_batch.io.read import FileError, printable, read_file

__all__ = ["read"]

MOST = 64 << 20
MOST_CHUNK = 1 << 20
GRIPPER = "acronym-panda"
TRANSFORMS, QUALITY, KIND = (
    "grasps/transforms",
    "grasps/qualities/flex/object_in_gripper",
    "gripper/type",
)


def read(path: Path) -> tuple[GraspSet, int]:
    """The grasps that held in simulation, and how many others there are."""
    try:
        import h5py
    except ImportError:
        raise FileError("ACRONYM's .h5 needs h5py: pip install 'r2h_batch[import]'") from None
    where = printable(path)
    data = read_file(path, MOST)
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            T = numbers(
                _read(h5py, file, TRANSFORMS, where, 16 * MAX_GRASPS),
                (None, 4, 4),
                f"{where} {TRANSFORMS}",
            )
            held = numbers(
                _read(h5py, file, QUALITY, where, MAX_GRASPS), (len(T),), f"{where} {QUALITY}"
            )
            kind = _read(h5py, file, KIND, where, 1) if "gripper" in file else "panda"
    except FileError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, OverflowError) as error:
        text = " ".join(printable(error).split())[:120]
        raise FileError(f"{where}: not a readable HDF5 file ({text})") from None
    if not isinstance(kind, (bytes, str)):
        raise FileError(f"{where}: {KIND} is no word; ACRONYM's is 'panda'")
    name = kind.decode("utf-8", "replace") if isinstance(kind, bytes) else kind
    if name != "panda":
        raise FileError(f"{where}: gripper {printable(name[:40])!r}; ACRONYM's is the panda")
    good = held > 0
    if not good.any():
        raise FileError(f"{where}: none of {len(T)} grasps held the object")
    arrays = {"T_obj_ee": T[good] @ T_gripper_ee(GRIPPER), "score": held[good]}
    return checked_grasps(arrays, where, GRIPPER), int((~good).sum())


def _read(h5py: Any, file: Any, name: str, where: str, most: int) -> Any:
    """A dataset of at most `most` numbers that lies whole in this file."""
    at = file
    for step in name.split("/"):
        if not isinstance(at, h5py.Group):
            raise FileError(f"{where}: {name} is not there")
        link = at.get(step, getlink=True)
        if link is None:
            raise FileError(f"{where}: has no {name}")
        if not isinstance(link, h5py.HardLink):
            raise FileError(
                f"{where}: {name} is a link, perhaps to another file; only data in this file are read"
            )
        at = at[step]
    if not isinstance(at, h5py.Dataset) or at.external or at.is_virtual:
        raise FileError(
            f"{where}: {name} keeps its numbers elsewhere; only data in this file are read"
        )
    if at.size is None or at.size > most or at.dtype.itemsize > 256:
        raise FileError(f"{where}: {name} has {at.size} numbers; at most {most} are allowed")
    # a chunk is unpacked whole
    if at.chunks is not None and math.prod(at.chunks) > max(MOST_CHUNK, at.size):
        raise FileError(
            f"{where}: {name} lies in chunks of {math.prod(at.chunks)} numbers, more than it holds"
        )
    return np.asarray(at[()]) if at.shape else at[()]
