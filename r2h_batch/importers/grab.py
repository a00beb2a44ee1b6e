"""GRAB (Taheri et al. 2020): grab/s*/OBJECT_ACTION_N.npz, 120 Hz, both hands of a whole body.

As its own tools read it: full postures about the flat hand (`fullpose`), a hand shape that is a
mesh of the subject (here: shape 0), the object's turn applied as `vertices @ R + t`, so that
T_world_object has R transposed. The world's z points up. SMPL-X' chest points along z of its root's
frame, which gives the facing direction.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.hand import LEFT, RIGHT
from r2h_batch.importers.arrays import numbers, rigid
from r2h_batch.importers.mano import ManoHand
from r2h_batch.importers.safe_pickle import read_pickle
from r2h_batch.importers.sequences import HandMotion, ManoParameters, files_below, motion
from r2h_batch.io.read import FileError, read_npz

__all__ = ["find", "read"]

NEEDED = ("rhand", "lhand", "object", "body", "obj_name", "motion_intent", "framerate")
MOST = 2 << 30
"""Largest file: it also holds contact labels of every vertex, of which nothing is read."""


def find(folder: Path) -> list[Path]:
    """The sequences below the folder."""
    return files_below(folder, "**/s*/*_*.npz")


def read(path: Path, hand: ManoHand | None) -> list[HandMotion]:
    """Right and left hand of one sequence."""
    where = f"grab:{path.parent.name}/{path.stem}"
    found = read_npz(path, objects=read_pickle, only=NEEDED, most=MOST)
    if missing := [k for k in NEEDED if k not in found]:
        raise FileError(f"{where}: has no {missing[0]}; it is no sequence of GRAB")
    name, intent = str(found["obj_name"]), str(found["motion_intent"])
    rate = float(numbers(found["framerate"], (), f"{where} framerate"))
    turn, place = (
        _parameter(found["object"], k, 3, f"{where} object") for k in ("global_orient", "transl")
    )
    T = rigid(Rotation.from_rotvec(turn).inv(), place)
    body = Rotation.from_rotvec(
        _parameter(found["body"], "global_orient", 3, f"{where} body")
    ).as_matrix()
    hands = []
    for key, side in (("rhand", RIGHT), ("lhand", LEFT)):
        columns = {k: _parameter(found[key], k, n, f"{where} {key}") for k, n in
                   (("global_orient", 3), ("transl", 3), ("fullpose", 45))}  # fmt: skip
        if len({len(turn), len(body), *map(len, columns.values())}) != 1:
            raise FileError(f"{where}: {key}, body and object have different numbers of frames")
        given = ManoParameters(
            columns["global_orient"], columns["transl"], columns["fullpose"], np.zeros(10), side,
            flat_hand_mean=True, components=False,
        )  # fmt: skip
        hands.append(
            motion(where, hand, given, rate_hz=rate, instruction=f"{intent} the {name}", object_name=name,
                   T_world_object=T, facing=body[:, :, 2], up=np.array([0.0, 0.0, 1.0]))
        )  # fmt: skip
    return hands


def _parameter(found: Any, name: str, width: int, where: str) -> np.ndarray:
    parameters = found.get("params") if isinstance(found, Mapping) else None
    if not isinstance(parameters, Mapping) or name not in parameters:
        raise FileError(f"{where}: has no params/{name}")
    return numbers(parameters[name], (None, width), f"{where} {name}")
