"""Grasp candidates of one object as arrays, and the error of an object that has none."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.robot import Robot, load_robot

OWN_GRIPPER, OWN_ROBOT = "2f-85", "ur5e_2f85"
"""The gripper that stored candidates are for, and a robot that carries it."""


def carrier(robot: Robot | None) -> Robot:
    """The robot whose gripper candidates are for: all with the 2F-85 (None) are as good as one."""
    return load_robot(OWN_ROBOT) if robot is None or robot.linkage.table is None else robot


def widest_m(robot: Robot) -> float:
    """What a candidate may be wide: leaves the open pads 1.5 mm on each side."""
    return round(robot.open_gap_m - 0.003, 9)


F32 = NDArray[np.float32]


class NoGraspError(ValueError):
    """An object that the gripper cannot hold anywhere, as far as was found."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """K grasps, best score first: T_obj_ee (K, 4, 4), width (K,) m, score (K,), part (K,) index
    into `part_names`.

    `region_m`: distance of the closed fingers to the receiver's region, NaN without one.
    """

    T_obj_ee: F32
    width: F32
    score: F32
    part: NDArray[np.uint8]
    region_m: F32

    def rows(self, rows: Any) -> "Candidates":
        """The selected grasps."""
        return Candidates(
            self.T_obj_ee[rows],
            self.width[rows],
            self.score[rows],
            self.part[rows],
            self.region_m[rows],
        )

    def __len__(self) -> int:
        return len(self.width)


def joined(parts: Sequence[Candidates]) -> Candidates:
    """All grasps of several sets, in their order."""
    return Candidates(
        *(
            np.concatenate([getattr(c, name) for c in parts])
            for name in Candidates.__dataclass_fields__
        )
    )
