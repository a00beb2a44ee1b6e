"""OakInk-Shape (Yang et al. 2022): oakink_shape_v2/CATEGORY/OBJECT/TAG[/VIRTUAL]/hand_param.pkl,
right hands only.

As its own tools read it: `pose` 16 quaternions (wxyz) or axis-angle turns (48) about the flat hand,
`shape` 10, `tsl` the wrist joint, all in the object's frame. source.txt beside the tag names
STAGE/OBJECT_ACTION_SUBJECTS/TIME. Action 0004 is a handover, its subjects giver_receiver; a source
with `_alt` is the receiver's hand. Those hands are the receiving ones: the only data set here that
has hands which receive. Where there are none (`--frame` given), every grasp can be taken.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.hand import RIGHT
from r2h_batch.importers.arrays import numbers, rigid
from r2h_batch.importers.mano import ManoHand
from r2h_batch.importers.safe_pickle import read_pickle_file
from r2h_batch.importers.sequences import HandMotion, files_below
from r2h_batch.io.read import FileError, printable, read_file

__all__ = ["find", "read"]

SOURCE = re.compile(r"(.+)/(.{6})_(.{4})_([_0-9]+)/([\-0-9]+)")
RECEIVER = "_alt"
ACTIONS = {"0001": "use", "0002": "hold", "0003": "lift up", "0004": "hand over"}
HANDOVER = "0004"


def find(folder: Path, *, every: bool = False) -> list[Path]:
    """The receivers' hands below the folder; `every`: all grasps."""
    paths = files_below(folder, "**/hand_param.pkl")
    if every:
        return paths
    receivers = [p for p in paths if _receives(p)]
    if not receivers:
        raise FileError(
            f"{printable(folder)}: {len(paths)} grasps, none a receiver's (action 0004, _alt); --frame first takes all"
        )
    return receivers


def read(path: Path, hand: ManoHand | None) -> list[HandMotion]:
    """The one hand of a grasp."""
    text, match = _source(path)
    action = ACTIONS.get(match[3], "hold")
    category = next((p.name for p in path.parents if p.parent.name == "oakink_shape_v2"), "object")
    where = f"oakink:{text}"
    found = read_pickle_file(path)
    if not isinstance(found, Mapping):
        raise FileError(f"{printable(path)}: holds no dictionary; it is no grasp of OakInk")
    turns = found.get("pose")
    if isinstance(turns, np.ndarray) and turns.size == 48:
        turns = numbers(turns.reshape(16, 3), (16, 3), f"{where} pose")
        R = Rotation.from_rotvec(turns)
    else:
        turns = numbers(turns, (16, 4), f"{where} (48 turns or quaternions) pose")
        if (np.abs(np.linalg.norm(turns, axis=1) - 1) > 1e-2).any():
            raise FileError(f"{where}: pose holds quaternions that are no rotations")
        R = Rotation.from_quat(turns, scalar_first=True)
    T = rigid(R[:1], numbers(found.get("tsl"), (3,), f"{where} tsl")[None])
    verb = "receive" if match[3] == HANDOVER and RECEIVER in text else action
    return [
        HandMotion(
            where, RIGHT, T, R[1:].as_rotvec().reshape(1, 45), numbers(found.get("shape"), (10,), f"{where} shape"),
            instruction=f"{verb} the {category}", object_name=match[2], T_world_object=np.eye(4)[None],
        )
    ]  # fmt: skip


def _source(path: Path) -> tuple[str, re.Match[str]]:
    # a virtual object's grasp is one deeper
    beside = [p / "source.txt" for p in (path.parent, path.parent.parent)]
    file = next((p for p in beside if p.is_file()), beside[0])
    text = read_file(file, 4096).decode("utf-8", "replace").strip()
    match = SOURCE.search(text)
    if match is None:
        raise FileError(
            f"{printable(file)}: says {printable(text[:80])!r}; need STAGE/OBJECT_ACTION_SUBJECTS/TIME"
        )
    return text, match


def _receives(path: Path) -> bool:
    try:
        text, match = _source(path)
    except FileError:
        return True  # named and counted when it is read
    return match[3] == HANDOVER and RECEIVER in text
