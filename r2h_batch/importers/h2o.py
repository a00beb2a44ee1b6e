"""H2O, the two-hands data set (Kwon et al. 2021): SUBJECT/PLACE/NUMBER/cam4/hand_pose_MANO/*.txt,
30 Hz.

One text file a frame: per hand 1 (annotated or not) + 3 translation + 48 pose + 10 shape, left then
right, camera frame, postures about the flat hand (as Text2HOI reads it). obj_pose_rt: 1 + 16,
cam_pose: 16, camera to world. The human-human data set that the paper cites under this name has no
released format.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.hand import LEFT, RIGHT
from r2h_batch.importers.arrays import numbers
from r2h_batch.importers.mano import ManoHand
from r2h_batch.importers.sequences import HandMotion, ManoParameters, files_below, motion
from r2h_batch.io.read import FileError, printable, read_file

__all__ = ["find", "read"]

RATE_HZ = 30.0
MOST = 16 << 10
MAX_FRAMES = 20_000


def find(folder: Path) -> list[Path]:
    """The sequences below the folder: those of cam4, the head's camera, where there are several."""
    folders = files_below(folder, "**/hand_pose_[mM][aA][nN][oO]")
    return [f for f in folders if f.parent.name == "cam4"] or folders


def read(path: Path, hand: ManoHand | None) -> list[HandMotion]:
    """Right and left hand of one sequence, the frames in which each is annotated; `path` is its
    hand_pose_MANO folder."""
    sequence = path.parent
    where = "h2o:" + "/".join(sequence.parts[-4:])
    files = sorted(path.glob("*.txt"))[:MAX_FRAMES]
    beside = {p.name.lower(): p for p in sequence.iterdir()}  # obj_pose_rt, or obj_pose_RT
    if not files or (missing := {"cam_pose", "obj_pose_rt"} - beside.keys()):
        lacks = f"{path.name}/*.txt" if not files else min(missing)
        raise FileError(f"{printable(sequence)}: holds no {lacks}")
    rows = np.stack([_numbers(f, 124) for f in files])
    camera = np.stack([_numbers(beside["cam_pose"] / f.name, 16).reshape(4, 4) for f in files])
    objects = np.stack([_numbers(beside["obj_pose_rt"] / f.name, 17) for f in files])
    if np.abs(camera[:, :3, :3] @ camera[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max() > 1e-2:
        raise FileError(f"{where}: cam_pose holds something else than rigid poses")
    T_world_object = camera @ objects[:, 1:].reshape(-1, 4, 4)
    hands = []
    for side, columns in ((RIGHT, rows[:, 62:]), (LEFT, rows[:, :62])):
        seen = np.flatnonzero(columns[:, 0] == 1)
        if not len(seen):
            continue
        mine = columns[seen]
        R = camera[seen, :3, :3] @ Rotation.from_rotvec(mine[:, 4:7]).as_matrix()
        given = ManoParameters(
            mine[:, 4:7],
            mine[:, 1:4],
            mine[:, 7:52],
            mine[:, 52:].mean(0),
            side,
            flat_hand_mean=True,
            components=False,
        )
        in_camera = motion(where, hand, given)
        T = camera[seen] @ in_camera.T_world_hand
        T[:, :3, :3] = R
        kind = int(objects[seen[0], 0])
        hands.append(
            HandMotion(where, side, T, in_camera.fingers, in_camera.shape, rate_hz=RATE_HZ,
                       object_name=f"object {kind}", T_world_object=T_world_object[seen])
        )  # fmt: skip
    if not hands:
        raise FileError(f"{where}: no frame is annotated")
    return hands


def _numbers(path: Path, count: int) -> np.ndarray:
    try:
        words = read_file(path, MOST).decode("ascii").split()
        values = np.array([float(w) for w in words])
    except FileError:
        raise
    except (UnicodeDecodeError, ValueError):
        raise FileError(f"{path}: holds something else than numbers") from None
    return numbers(values, (count,), str(path))
