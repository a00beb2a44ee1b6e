"""Other grippers' frames: where their pads are, and so where our ee frame is when our pads take
their place.

    T_obj_ee = T_obj_gripper @ T_gripper_ee

`T_gripper_ee` turns their closing axis to our y and their approach to our z, and puts our
fingertips where theirs are: our pads' centre is 18.75 mm (half a 2F-85 pad) behind the tips.

| name | approach | closing | fingertips | source |
| acronym-panda | +z | x | z 0.11217 m | acronym_tools/acronym.py, create_gripper_marker |
| panda-hand | +z | y | z 0.1122 m | franka_description: fingers at z 0.0584, 0.0538 long, sliding
along y |
| graspnet | +x | y | x depth | graspnetAPI, plot_gripper_pro_max: fingers end at `depth` along x |
| 2f-85-base | +z | y | pads at half stroke | this package's robot: gripper's base link, without
coupling |
| ee | +z | y | our own frame | README |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.robot import drive_from_gap, pad_center_z
from r2h_batch.config import OPEN_GAP_M

__all__ = ["GRIPPERS", "PAD_HALF_M", "T_gripper_ee"]

F64 = NDArray[np.float64]
PAD_HALF_M = 0.01875
TIPS_M = {"acronym-panda": ("x", 0.11217), "panda-hand": ("y", 0.1122)}
GRIPPERS = (*TIPS_M, "2f-85-base", "ee")


def T_gripper_ee(name: str) -> F64:
    """(4, 4) our ee frame in the frame of a gripper of `GRIPPERS`."""
    T = np.eye(4)
    if name == "ee":
        return T
    if name == "2f-85-base":
        T[2, 3] = float(np.asarray(pad_center_z(drive_from_gap(np.array(OPEN_GAP_M / 2)))))
        return T
    closing, tips = TIPS_M[name]
    if closing == "x":
        T[:3, :3] = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # our y is their x
    T[2, 3] = tips - PAD_HALF_M
    return T
