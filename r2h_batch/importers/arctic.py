"""ARCTIC (Fan et al. 2023): raw_seqs/sXX/OBJECT_ACTION_N.mano.npy, with .object.npy and .smplx.npy
beside it, 30 Hz.

As its own tools read it: postures about MANO's mean hand (flat_hand_mean=False), object rows of
[articulation rad, axis-angle, millimetres]. The body's facing is that of its SMPL-X root where
.smplx.npy is there.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.hand import LEFT, RIGHT
from r2h_batch.importers.arrays import numbers, rigid
from r2h_batch.importers.mano import ManoHand
from r2h_batch.importers.safe_pickle import read_npy
from r2h_batch.importers.sequences import HandMotion, ManoParameters, files_below, motion
from r2h_batch.io.read import FileError

__all__ = ["find", "read"]

RATE_HZ = 30.0


def find(folder: Path) -> list[Path]:
    """The sequences below the folder."""
    return files_below(folder, "**/s*/*.mano.npy")


def read(path: Path, hand: ManoHand | None) -> list[HandMotion]:
    """Right and left hand of one sequence."""
    stem = path.name.removesuffix(".mano.npy")
    where = f"arctic:{path.parent.name}/{stem}"
    found = read_npy(path)
    if not isinstance(found, Mapping):
        raise FileError(f"{where}: holds no dictionary; it is no sequence of ARCTIC")
    rows = numbers(read_npy(path.with_name(f"{stem}.object.npy")), (None, 7), f"{where} object")
    T = rigid(Rotation.from_rotvec(rows[:, 1:4]), rows[:, 4:] / 1000)
    facing, up = _body(path.with_name(f"{stem}.smplx.npy"), len(rows), where)
    name, _, action = stem.partition("_")
    hands = []
    for key, side in (("right", RIGHT), ("left", LEFT)):
        part = found.get(key)
        if not isinstance(part, Mapping):
            raise FileError(f"{where}: has no {key} hand")
        turn, place, postures = (
            numbers(part.get(k), (None, n), f"{where} {key} {k}")
            for k, n in (("rot", 3), ("trans", 3), ("pose", 45))
        )
        if len({len(turn), len(place), len(postures), len(rows)}) != 1:
            raise FileError(f"{where}: hand and object have different numbers of frames")
        shape = numbers(part.get("shape"), (10,), f"{where} {key} shape")
        given = ManoParameters(
            turn, place, postures, shape, side, flat_hand_mean=False, components=False
        )
        instruction = f"{action.partition('_')[0] or 'use'} the {name}"
        hands.append(
            motion(where, hand, given, rate_hz=RATE_HZ, instruction=instruction, object_name=name,
                   T_world_object=T, facing=facing, up=up)
        )  # fmt: skip
    return hands


def _body(path: Path, frames: int, where: str) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The chest's direction, and the world's axis that the body stands along."""
    if not path.is_file():
        return None, None
    found = read_npy(path)
    turn = numbers(
        found.get("global_orient") if isinstance(found, Mapping) else None,
        (None, 3),
        f"{where} body",
    )
    if len(turn) != frames:
        raise FileError(f"{where}: body and object have different numbers of frames")
    R = Rotation.from_rotvec(turn).as_matrix()
    spine = R[:, :, 1].mean(0)
    axis = int(np.abs(spine).argmax())
    return R[:, :, 2], np.sign(spine[axis]) * np.eye(3)[axis]
