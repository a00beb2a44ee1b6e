"""Presented and Upright of a row, made again in float64 from the objects' triangles and the robot's primitives."""

from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from r2h_batch.scene.robot import Robot, gripper_primitives_at

Array = NDArray[np.float64]
SPHERE, CAPSULE, CYLINDER, BOX = range(4)
ROOM_M = {"S0": 0.075, "S1": 0.035}
SHARP = {"knife": "blade", "scissors": "blade", "screwdriver": "tip", "power_drill": "bit"}


class Again(NamedTuple):
    """What decides a row, m and degrees; `sharp` inf: nothing is; `tilt` NaN: no vessel."""

    in_ball: float
    wanted: float
    gripper: float
    sharp: float
    room: float
    tilt: float

    @property
    def margin(self) -> float:
        return min(self.in_ball, self.room + min(self.gripper, self.sharp) - self.wanted)

    @property
    def by(self) -> int:
        """0: the ball, 1: the gripper, 2: a sharp part."""
        if self.in_ball <= self.room + min(self.gripper, self.sharp) - self.wanted:
            return 0
        return 2 if self.sharp < self.gripper else 1


def to_triangles(triangles: Array, x: Array) -> float:
    """Distance of a point from a surface; inf without a triangle."""
    if not len(triangles):
        return np.inf
    nearest = trimesh.triangles.closest_point(triangles, np.tile(x, (len(triangles), 1)))
    return float(np.linalg.norm(nearest - x, axis=1).min())


def winding(triangles: Array, x: Array) -> float:
    """How often a closed surface goes around a point (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(triangles - x, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    return float(np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), below).sum() / (2 * np.pi))


def to_solid(triangles: Array, x: Array) -> float:
    return 0.0 if abs(winding(triangles, x)) > 0.5 else to_triangles(triangles, x)


def to_primitive(kind: int, size: Array, x: Array) -> float:
    """Distance of a point, in the primitive's frame, from it; 0 inside."""
    if kind == BOX:
        return float(np.linalg.norm(np.maximum(np.abs(x) - size, 0)))
    if kind == SPHERE:
        return max(float(np.linalg.norm(x)) - size[0], 0.0)
    if kind == CAPSULE:
        z = np.clip(x[2], -size[1], size[1])
        return max(float(np.linalg.norm(x - [0, 0, z])) - size[0], 0.0)
    assert kind == CYLINDER
    aside, along = max(np.hypot(x[0], x[1]) - size[0], 0.0), max(abs(x[2]) - size[1], 0.0)
    return float(np.hypot(aside, along))


def to_gripper(robot: Robot, opening_m: float, T_world_ee: Array, x: Array) -> float:
    T = T_world_ee @ gripper_primitives_at(robot, opening_m)
    prims = zip(robot.gripper.kind, robot.gripper.size, T, strict=True)
    return min(to_primitive(int(k), np.asarray(size), p[:3, :3].T @ (x - p[:3, 3])) for k, size, p in prims)


def again(scene: Any, trials: Any, asked: Any, scores: Any, row: int) -> Again:
    """The row, from the poses that were asked for and where the judge's pads closed (`grasp_shift_m`, `opening_m`)."""
    model = scene.objects[int(trials.object_index[row])]
    palm, _, ball = (
        x[0].double().numpy() for x in scene.palm(trials.hand_index[row : row + 1], trials.T_world_hand[row : row + 1])
    )
    T_obj_ee, T_world_ee = (T[row].double().numpy().copy() for T in (asked.T_obj_ee, asked.T_world_ee))
    T_obj_ee[:3, 3] += T_obj_ee[:3, 1] * float(scores.grasp_shift_m[row])
    T = T_world_ee @ np.linalg.inv(T_obj_ee)
    triangles = model.vertices.astype(float)[model.faces] @ T[:3, :3].T + T[:3, 3]
    part = np.array(model.part_names)[model.face_part]
    category = model.category or model.name
    if model.receiver_face.any():
        wanted = [to_triangles(triangles[model.receiver_face], x) for x in (ball, palm)]
    else:
        wanted = [to_solid(triangles, x) for x in (ball, palm)]
    tilt = np.nan
    if category in ("cup", "bowl", "wineglass"):
        area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
        low = "base" if category == "cup" else "foot"
        a, b = (np.average(triangles[part == p].mean(1), axis=0, weights=area[part == p]) for p in (low, "rim"))
        tilt = float(np.degrees(np.arccos((b - a)[2] / np.linalg.norm(b - a))))
    return Again(
        0.10 - wanted[0], wanted[1], to_gripper(scene.robot, float(scores.opening_m[row]), T_world_ee, palm),
        to_triangles(triangles[part == SHARP.get(category, "")], palm), ROOM_M[model.split], tilt,
    )  # fmt: skip
