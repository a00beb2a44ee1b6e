"""A hand's motion as every source gives it once it is read, and which of its frames is the
receiving one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.hand import HandModel, load_hand
from r2h_batch.command_line import tell
from r2h_batch.importers.arrays import rigid
from r2h_batch.importers.mano import ManoHand
from r2h_batch.io.read import FileError, printable

__all__ = [
    "HandMotion",
    "ManoParameters",
    "files_below",
    "motion",
    "receiving_frame",
]

F64 = NDArray[np.float64]

MOVED_M, TURNED_RAD = 0.005, float(np.radians(5.0))
"""An object is being carried once it is this far from where it began."""
REACH_S = 1.0
THUMB_TIP, INDEX_TIP = 15, 3
MAX_FILES = 200_000


@dataclass(frozen=True, eq=False)
class HandMotion:
    """One hand through F frames, metres, in the source's world frame; fingers as full turns about
    the flat hand."""

    source: str
    """which sequence of which data set: enough to find it again"""
    side: int
    """0 right, 1 left"""
    T_world_hand: F64
    """(F, 4, 4) wrist joint, turned as MANO's global orientation"""
    fingers: F64
    """(F, 45)"""
    shape: F64
    """(10,)"""
    rate_hz: float = 0.0
    """0: a single posture or unknown"""
    instruction: str = ""
    object_name: str = ""
    T_world_object: F64 | None = None
    """(F, 4, 4)"""
    facing: F64 | None = None
    """(F, 3) unit vector that the body's chest points along; None: the data do not know the body"""
    up: F64 | None = None
    """(3,) unit vector against gravity; None: unknown"""


@dataclass(frozen=True, eq=False)
class ManoParameters:
    """MANO's parameters as files hold them: turn (F, 3), place (F, 3), postures (F, n) or (F, 45),
    shape (10,)."""

    turn: F64
    transl: F64
    postures: F64
    shape: F64
    side: int
    flat_hand_mean: bool
    components: bool
    """whether `postures` are principal components"""


def motion(source: str, hand: ManoHand | None, given: ManoParameters, **more: Any) -> HandMotion:
    """The motion in our frames. Components, and postures about MANO's mean, need MANO's own file
    (`hand`)."""
    side = np.full(len(given.turn), given.side)
    fingers = given.postures
    if given.components or not given.flat_hand_mean:
        if hand is None:
            raise FileError(
                f"{source}: postures are {'principal components' if given.components else 'about the mean hand'};"
                " give MANO's file with --mano-right or --mano-left"
            )
        model, sides = hand.model, torch.from_numpy(side)
        if given.components:
            flat = given.flat_hand_mean
            fingers = (
                model.full_pose(torch.from_numpy(given.postures), sides, flat_hand_mean=flat)
                .double()
                .numpy()
            )
        else:
            assert model.pose_mean is not None
            fingers = given.postures + model.pose_mean.double().numpy()[given.side]
    shape = np.tile(given.shape, (len(side), 1))
    place = given.transl if hand is None else hand.wrist(given.transl, shape, side)
    T = rigid(Rotation.from_rotvec(given.turn), place)
    return HandMotion(source, given.side, T, fingers, given.shape, **more)


def receiving_frame(hand: HandMotion, rule: str | int, model: HandModel | None = None) -> int:
    """The frame in which this hand receives. `rule`: a frame's number, or aperture, first, middle, last.

    `aperture`, the default: of the last second before the object first moves by 5 mm or 5 degrees
    (of all frames where it never does, or where nothing is known of it), the one with the widest
    grip, thumb's last joint to index's. A hand that reaches for a thing opens widest shortly before
    it closes on it (Jeannerod 1984): the posture to receive with.
    """
    count = len(hand.fingers)
    if isinstance(rule, int):
        if not -count <= rule < count:
            raise FileError(f"{hand.source}: has {count} frames; frame {rule} is not one of them")
        return rule % count
    if rule != "aperture":
        return {"first": 0, "middle": count // 2, "last": count - 1}[rule]
    first, end = 0, count
    if (starts := _starts_to_move(hand.T_world_object)) is not None:
        end = max(starts, 1)
        first = max(0, end - max(1, round(REACH_S * hand.rate_hz))) if hand.rate_hz > 0 else 0
    grip = np.zeros((end - first, 48))
    grip[:, 3:] = hand.fingers[first:end]
    side = torch.full((len(grip),), hand.side, dtype=torch.int8, device="cpu")
    shape = torch.from_numpy(np.tile(hand.shape, (len(grip), 1)))
    joints = (
        (model or load_hand()).pose(torch.from_numpy(grip), shape, side).joints.double().numpy()
    )
    return first + int(np.linalg.norm(joints[:, THUMB_TIP] - joints[:, INDEX_TIP], axis=1).argmax())


def _starts_to_move(T_world_object: F64 | None) -> int | None:
    if T_world_object is None:
        return None
    far = np.linalg.norm(T_world_object[:, :3, 3] - T_world_object[0, :3, 3], axis=1) > MOVED_M
    turned = (
        Rotation.from_matrix(T_world_object[:, :3, :3] @ T_world_object[0, :3, :3].T).magnitude()
        > TURNED_RAD
    )
    moved = np.flatnonzero(far | turned)
    return int(moved[0]) if len(moved) else None


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
        tell(f"{printable(folder)}: {links}, left out")
    return sorted(found)
