"""isaac_grasp YAML 1.0 (Isaac Sim's Grasp Editor; GraspGen writes it): grasps/NAME with confidence,
position, orientation.

Position and orientation (w, xyz) are the gripper's frame in the object's. Which frame that is
stands nowhere a program could rely on (gripper_frame_link is ignored by Isaac Sim too): `gripper`
says it, one of `grippers.GRIPPERS`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r2h_batch.bodies.grasp_set import GraspSet, checked_grasps
from r2h_batch.importers.arrays import numbers
from r2h_batch.importers.grasps.grippers import T_gripper_ee
from r2h_batch.io.read import FileError, printable, read_yaml

__all__ = ["read"]

MOST, DEEPEST = 4 << 20, 8
MAX_GRASPS = 10_000


def read(path: Path, gripper: str) -> tuple[GraspSet, int]:
    """The file's grasps, and 0."""
    where, found = printable(path), read_yaml(path, most=MOST, deepest=DEEPEST)
    if found.get("format") != "isaac_grasp" or float(found.get("format_version") or 0) != 1.0:
        raise FileError(f"{where}: format is no isaac_grasp 1.0")
    grasps = found.get("grasps")
    if not isinstance(grasps, dict) or not 1 <= len(grasps) <= MAX_GRASPS:
        raise FileError(f"{where}: needs 1 to {MAX_GRASPS} named grasps")
    T, score = np.tile(np.eye(4), (len(grasps), 1, 1)), np.zeros(len(grasps))
    for i, (name, grasp) in enumerate(grasps.items()):
        at = f"{where}: {printable(name)[:40]}"
        turn = grasp.get("orientation") if isinstance(grasp, dict) else None
        if not isinstance(grasp, dict) or not isinstance(turn, dict):
            raise FileError(f"{at} has no orientation with w and xyz")
        q = numbers([*_list(turn.get("xyz")), *_list([turn.get("w")])], (4,), f"{at} orientation")
        if abs(np.linalg.norm(q) - 1) > 1e-2:
            raise FileError(f"{at} orientation is no rotation")
        T[i, :3, :3] = Rotation.from_quat(q).as_matrix()
        T[i, :3, 3] = numbers(grasp.get("position"), (3,), f"{at} position")
        score[i] = float(numbers([grasp.get("confidence", 1.0)], (1,), f"{at} confidence")[0])
    arrays = {"T_obj_ee": T @ T_gripper_ee(gripper), "score": score}
    return checked_grasps(arrays, where, "2f-85" if gripper in ("ee", "2f-85-base") else gripper), 0


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) and len(value) <= 4 else [None]
