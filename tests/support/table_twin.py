"""Episodes that begin at the table, looked at again in float64: MuJoCo C for convex bodies, `convex_twin` for the object's
surface, every step in dense samples.

Shared with the project: the trace (postures, phases), the numbers of the robot's file, and how the gripper closes.
A sample is looked at or not: what is found free here may touch between two samples, by no more than bodies move in between.
"""

from typing import Any

import numpy as np
from convex_twin import mesh_distance
from judge_twin import Fingers, World, rigid
from numpy.typing import NDArray
from oracle import Staged
from pick_twin import RestingWorld, _least

from r2h_batch.closed_loop.from_table import Phase

Array = NDArray[np.float64]
SAMPLES = 12
"""Postures of a step that are looked at."""


class TableTwin:
    """One row.

    Args:
        env: after its episodes.
        row: which.
        attached: T_obj_ee of the closed gripper.
        opening_m: its gap.
    """

    def __init__(self, env: Any, row: int, attached: Any, opening_m: float) -> None:
        self.scene, self.robot = env.scene, env.scene.robot
        trials = env.trials
        self.object, self.hand = int(trials.object_index[row]), int(trials.hand_index[row])
        self.T_rest, self.attached = rigid(env._T_rest[row]), rigid(attached)
        far = np.eye(4)
        far[0, 3] = 50.0  # nobody is about
        gap = self.robot.open_gap_m
        self.open = World(self.scene, Staged(self.object, self.hand, self.attached, far, gap))
        self.resting = RestingWorld(self.scene, Staged(self.object, self.hand, self.attached, self.T_rest, gap))
        self.closed = World(self.scene, Staged(self.object, self.hand, self.attached, far, opening_m))
        model = self.scene.objects[self.object]
        self.triangles = model.vertices.astype(np.float64)[model.faces]
        self.places = Fingers(self.robot).places(gap)

    def room_m(self, q0: Array, q1: Array, phase: int) -> float:
        """Smallest clearance in a step from one posture to another, as far as that phase may meet nothing; at most 1 cm."""
        way = np.linspace(q0, q1, SAMPLES + 1)
        if phase <= Phase.CLOSES:
            rooms = [
                _least(self.open, way, classes=("table", "self")),
                _least(self.resting, way, classes=("hand",), of="arm"),
                min(self._of_solid(q) for q in way),
            ]
        elif phase == Phase.LIFTS:
            low = min(self.low_m(q) for q in way) + self.scene.config.thresholds.pad_squeeze_m
            rooms = [_least(self.closed, way, classes=("table", "self", "object_robot")), low]
        else:
            rooms = [_least(self.closed, way, classes=("table", "self", "object_robot", "object_table"))]
        return float(min(rooms))

    def low_m(self, q: Array) -> float:
        """How far the lowest vertex of the held object is above the table."""
        T = self.open.ee(q) @ np.linalg.inv(self.attached)
        top = self.scene.config.workplace
        points = self.scene.objects[self.object].vertices.astype(np.float64)
        return float((points @ T[2, :3] + T[2, 3]).min() - top.table_center[2] - top.table_half[2])

    def _of_solid(self, q: Array) -> float:
        """Clearance of the open gripper from the object's surface, below 0 where it cuts."""
        T_obj_ee, best, g = np.linalg.inv(self.T_rest) @ self.open.ee(q), 0.01, self.robot.gripper
        for i, place in enumerate(self.places):
            best = min(
                best, mesh_distance(int(g.kind[i]), g.size[i], T_obj_ee @ place, self.triangles, cap=best + 0.01)
            )
        return float(best)
