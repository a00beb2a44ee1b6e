"""DexYCB (Chao et al. 2021): DATE-subject-XX/TIME/{meta.yml,pose.npz}, betas in
calibration/mano_*/mano.yml, 30 Hz.

As its own toolkit reads it: `pose_m` rows of 3 turn + 45 principal components about MANO's mean
hand + 3 translation (all 0: no hand), `pose_y` rows of a quaternion (xyzw) and a place for every
object, in the master camera's frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.hand import LEFT, RIGHT
from r2h_batch.importers.arrays import numbers, rigid
from r2h_batch.importers.mano import ManoHand
from r2h_batch.importers.sequences import HandMotion, ManoParameters, files_below, motion
from r2h_batch.io.read import FileError, path_within, read_npz, read_yaml

__all__ = ["find", "read"]

RATE_HZ = 30.0


def find(folder: Path) -> list[Path]:
    """The sequences below the folder."""
    return files_below(folder, "*-subject-*/*/pose.npz")


def read(path: Path, hand: ManoHand | None) -> list[HandMotion]:
    """The hand of one sequence, in the frames where there is one."""
    root, where = path.parents[2], f"dexycb:{path.parent.parent.name}/{path.parent.name}"
    meta = read_yaml(path.parent / "meta.yml")
    sides, calibration = (meta.get(k) for k in ("mano_sides", "mano_calib"))
    grasped, objects = meta.get("ycb_grasp_ind"), meta.get("ycb_ids")
    if (
        sides not in (["right"], ["left"])
        or not isinstance(calibration, list)
        or len(calibration) != 1
    ):
        raise FileError(f"{where}: meta.yml names no single hand with its mano_calib")
    if not isinstance(objects, list) or type(grasped) is not int or not 0 <= grasped < len(objects):
        raise FileError(f"{where}: meta.yml does not say which of ycb_ids is grasped")
    side = RIGHT if sides == ["right"] else LEFT
    betas = read_yaml(path_within(root / "calibration", f"mano_{calibration[0]}/mano.yml"))
    shape = numbers(betas.get("betas"), (10,), f"{where} betas")
    found = read_npz(path)
    hands = numbers(found.get("pose_m"), (None, 1, 51), f"{where} pose_m")[:, 0]
    places = numbers(found.get("pose_y"), (len(hands), len(objects), 7), f"{where} pose_y")[
        :, grasped
    ]
    seen = np.flatnonzero((hands != 0).any(1))
    if not len(seen):
        raise FileError(f"{where}: no frame has a hand")
    mine, places = hands[seen], places[seen]
    if (np.abs(np.linalg.norm(places[:, :4], axis=1) - 1) > 1e-2).any():
        raise FileError(f"{where}: pose_y holds quaternions that are no rotations")
    T = rigid(Rotation.from_quat(places[:, :4]), places[:, 4:])
    given = ManoParameters(
        mine[:, :3], mine[:, 48:], mine[:, 3:48], shape, side, flat_hand_mean=False, components=True
    )
    name = f"ycb {objects[grasped]}"
    return [motion(where, hand, given, rate_hz=RATE_HZ, object_name=name, T_world_object=T)]
