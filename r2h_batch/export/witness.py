"""Which bodies are nearest to each other at a posture, where, and by how much: MuJoCo C on the
exported geoms."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.bodies.robot import Robot
from r2h_batch.export.mjcf import checked_pairs

Array = NDArray[np.float64]

FARTHEST_M = 0.5


@dataclass(frozen=True)
class Witness:
    """The nearest pair of collision geoms: their names, what kind of pair it is, the signed
    distance (m; negative: they overlap by that), and the points that attain it (world, m). Kind
    `unreachable`: no geoms, the line from the gripper to its target."""

    geoms: tuple[str, ...]
    kind: str
    distance_m: float
    line: Array  # (2, 3)

    @property
    def words(self) -> str:
        """One line: what meets what, in mm."""
        if self.kind == "unreachable":
            return f"the gripper stays {-1e3 * self.distance_m:.1f} mm from its target"
        a, b = map(_spoken, self.geoms)
        if self.distance_m < 0:
            return f"{a} and {b} overlap by {-1e3 * self.distance_m:.1f} mm"
        return f"{a} and {b} are {1e3 * self.distance_m:.1f} mm apart"


def shortfall(model: mujoco.MjModel, q: Array) -> Witness:
    """How far the gripper at posture q is from its target."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    line = np.stack([data.site("ee").xpos, data.site("target").xpos])
    return Witness((), "unreachable", -float(np.linalg.norm(line[1] - line[0])), line)


def nearest_pair(
    model: mujoco.MjModel, robot: Robot, q: Array, kinds: Sequence[str] = ()
) -> Witness | None:
    """The pair with the smallest distance at posture q, of the pairs that planning checks or of
    these kinds of them; None where all are farther apart than FARTHEST_M."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    of_body: dict[str, list[int]] = {}
    for i in np.flatnonzero((model.geom_contype != 0) & (model.geom_conaffinity != 0)):
        of_body.setdefault(model.body(int(model.geom_bodyid[i])).name, []).append(int(i))
    best, least, line, found = None, FARTHEST_M, np.zeros(6), ""
    for pair, kind in checked_pairs(robot).items():
        if kinds and kind not in kinds:
            continue
        one, two = sorted(pair)
        for a in of_body.get(one, ()):
            for b in of_body.get(two, ()):
                apart = float(np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b]))
                if apart - model.geom_rbound[a] - model.geom_rbound[b] > least:
                    continue
                ends = np.zeros(6)
                distance = mujoco.mj_geomDistance(model, data, a, b, FARTHEST_M, ends)
                if distance < least:
                    best, least, line, found = (a, b), distance, ends, kind
    if best is None:
        return None
    return Witness(
        (model.geom(best[0]).name, model.geom(best[1]).name),
        found,
        float(least),
        line.reshape(2, 3),
    )


def _spoken(geom: str) -> str:
    """robot/wrist_3_0: wrist 3; hand/index2: hand index 2; object/hull: object."""
    owner, _, part = geom.partition("/")
    if owner in ("object", "table"):
        return owner
    part = (
        re.sub(r"_\d+$", "", part) if owner == "robot" else re.sub(r"(?<=[a-z])(?=\d)", " ", part)
    )
    return f"{'' if owner == 'robot' else owner + ' '}{part.replace('_', ' ')}"
