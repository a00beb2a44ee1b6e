"""The UR5e with its 2F-85 as numbers: joint frames, primitives, finger linkage, lever bounds
(float64 NumPy)."""

import hashlib
import json
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

JOINTS = 6
JOINT_KEYS = ("T_parent_joint", "lower", "upper", "max_velocity", "max_torque")


class Kind(IntEnum):
    """Shape codes of the kernels. Sizes as in MuJoCo, along local z: [radius, half length], box
    half sides."""

    SPHERE = 0
    CAPSULE = 1
    CYLINDER = 2
    BOX = 3
    HULL = 4


@dataclass(frozen=True)
class Primitives:
    """N shapes in their carriers' frames: the arm's links, or the gripper frame with the fingers at
    drive angle 0."""

    names: tuple[str, ...]
    link: NDArray[np.int32]
    kind: NDArray[np.int32]
    T_link_prim: Array
    size: Array


@dataclass(frozen=True)
class Linkage:
    """The right (+y) finger's pivots in the gripper frame's (y, z) plane at drive angle 0; the left
    is its mirror."""

    driver_pivot_yz: Array
    pin_from_driver_yz: Array
    inner_knuckle_pivot_yz: Array
    pad_from_pin_yz: Array
    pad_half_size: Array
    drive_lower: float
    drive_upper: float

    @property
    def gap_offset_m(self) -> float:
        """The constant term of half the gap: driver pivot to pad face, without the pin vector."""
        return float(self.driver_pivot_yz[0] + self.pad_from_pin_yz[0] - self.pad_half_size[1])


@dataclass(frozen=True)
class Robot:
    """Everything in robot.json.

    T_world_link[i + 1] = T_world_link[i] @ T_parent_joint[i] @ Rz(q_i): the axis of joint i is z of
    link i + 1.
    """

    links: tuple[str, ...]
    joints: tuple[str, ...]
    T_parent_joint: Array
    lower: Array
    upper: Array
    max_velocity: Array
    max_torque: Array
    T_wrist3_flange: Array
    T_flange_ee: Array
    T_flange_gripper: Array
    arm: Primitives
    gripper: Primitives
    gripper_part: tuple[str, ...]
    gripper_motion: tuple[str, ...]
    gripper_side: NDArray[np.int32]  # -1 left (at -y), +1 right, 0 neither
    linkage: Linkage
    self_pairs: NDArray[np.int32]
    object_pairs: NDArray[np.int32]
    digest: str


@cache
def load_robot() -> Robot:
    """The robot of assets/robot/robot.json; `digest` is that file's sha256."""
    raw = (files("r2h_batch.assets") / "robot" / "robot.json").read_bytes()
    data: dict[str, Any] = json.loads(raw)
    if data["format"] != 1:
        raise ValueError(
            f"robot.json has format {data['format']}, this version reads format 1: rebuild it"
        )
    links = tuple(data["links"])
    joints, gripper = data["joints"], data["gripper_primitives"]
    linkage: dict[str, Any] = {
        k: _frozen(v) if isinstance(v, list) else float(v) for k, v in data["linkage"].items()
    }
    gripper_link = links.index("gripper")
    return Robot(
        links=links,
        joints=tuple(j["name"] for j in joints),
        **{k: _frozen([j[k] for j in joints]) for k in JOINT_KEYS},
        **{k: _frozen(data[k]) for k in ("T_wrist3_flange", "T_flange_ee", "T_flange_gripper")},
        arm=_primitives(
            data["arm_primitives"], [links.index(p["link"]) for p in data["arm_primitives"]]
        ),
        gripper=_primitives(gripper, [gripper_link] * len(gripper)),
        gripper_part=tuple(p["part"] for p in gripper),
        gripper_motion=tuple(p["motion"] for p in gripper),
        gripper_side=_frozen(
            [{"left": -1, "none": 0, "right": 1}[p["side"]] for p in gripper], np.int32
        ),
        linkage=Linkage(**linkage),
        self_pairs=_frozen(
            [[links.index(a), links.index(b)] for a, b in data["self_pairs"]], np.int32
        ),
        object_pairs=_frozen([links.index(a) for a in data["object_pairs"]], np.int32),
        digest=hashlib.sha256(raw).hexdigest(),
    )


def forward_kinematics(robot: Robot, q: ArrayLike) -> Array:
    """T_world_link (..., 8, 4, 4) in the order of `robot.links`; the last is the gripper frame. q
    (..., 6) in rad."""
    q = np.asarray(q, dtype=np.float64)
    if q.shape[-1:] != (JOINTS,):
        raise ValueError(f"q has shape {q.shape}, allowed is (..., {JOINTS})")
    T = np.zeros((*q.shape[:-1], len(robot.links), 4, 4))
    T[..., 0, :, :] = np.eye(4)
    for i in range(JOINTS):
        T[..., i + 1, :, :] = T[..., i, :, :] @ robot.T_parent_joint[i] @ _rotation(2, q[..., i])
    T[..., JOINTS + 1, :, :] = T[..., JOINTS, :, :] @ robot.T_wrist3_flange @ robot.T_flange_gripper
    return T


def ee_pose(robot: Robot, q: ArrayLike) -> Array:
    """T_world_ee (..., 4, 4)."""
    T_wrist3_ee = robot.T_wrist3_flange @ robot.T_flange_ee
    return np.asarray(forward_kinematics(robot, q)[..., JOINTS, :, :] @ T_wrist3_ee)


def gap_from_drive(drive: ArrayLike) -> Array:
    """Distance between the pad faces in m at a drive angle in rad."""
    link, q = load_robot().linkage, np.asarray(drive, dtype=np.float64)
    a, b = link.pin_from_driver_yz
    return np.asarray(2.0 * (link.gap_offset_m + a * np.cos(q) - b * np.sin(q)))


def drive_from_gap(gap_m: ArrayLike) -> Array:
    """Drive angle in rad for a gap in m; gaps outside the linkage's range (1.5 to 86.0 mm) give its
    nearest end."""
    link = load_robot().linkage
    a, b = link.pin_from_driver_yz
    cosine = (np.asarray(gap_m, dtype=np.float64) / 2.0 - link.gap_offset_m) / np.hypot(a, b)
    return np.clip(
        np.arccos(np.clip(cosine, -1.0, 1.0)) - np.arctan2(b, a), link.drive_lower, link.drive_upper
    )


def pad_center_z(drive: ArrayLike) -> Array:
    """z of the pads' centres in the gripper frame, m."""
    link, q = load_robot().linkage, np.asarray(drive, dtype=np.float64)
    a, b = link.pin_from_driver_yz
    return np.asarray(
        link.driver_pivot_yz[1] + link.pad_from_pin_yz[1] + b * np.cos(q) + a * np.sin(q)
    )


def gripper_primitives_at(robot: Robot, gap_m: ArrayLike) -> Array:
    """T_ee_prim (..., N, 4, 4) of `robot.gripper`'s shapes with the pads `gap_m` (...) apart."""
    drive = drive_from_gap(gap_m)
    T_ee_gripper = np.linalg.inv(robot.T_flange_ee) @ robot.T_flange_gripper
    T = np.empty((*drive.shape, len(robot.gripper.names), 4, 4))
    for n, (motion, side) in enumerate(zip(robot.gripper_motion, robot.gripper_side, strict=True)):
        T[..., n, :, :] = (
            T_ee_gripper
            @ finger_motion(robot, motion, int(side), drive)
            @ robot.gripper.T_link_prim[n]
        )
    return T


def finger_motion(robot: Robot, motion: str, side: int, drive: ArrayLike) -> Array:
    """How a finger part has moved from drive angle 0, in the gripper frame (..., 4, 4). side: -1
    left, +1 right."""
    link, q = robot.linkage, np.asarray(drive, dtype=np.float64)
    if motion == "fixed":
        return np.broadcast_to(np.eye(4), (*q.shape, 4, 4)).copy()
    if motion not in ("driver", "pin", "inner_knuckle"):
        raise ValueError(f"motion is {motion!r}, allowed are fixed, driver, pin, inner_knuckle")
    pivot = link.inner_knuckle_pivot_yz if motion == "inner_knuckle" else link.driver_pivot_yz
    T = _rotation(0, side * q)
    point = np.array([0.0, side * pivot[0], pivot[1]])
    T[..., :3, 3] = point - T[..., :3, :3] @ point
    # the parallelogram carries inner finger and pad along the pin's arc without turning them
    if motion == "pin":
        pin = point + np.array([0.0, side * link.pin_from_driver_yz[0], link.pin_from_driver_yz[1]])
        T[..., :3, 3] += T[..., :3, :3] @ pin - pin
        T[..., :3, :3] = np.eye(3)
    return T


def lever_bounds(robot: Robot) -> Array:
    """Upper bounds (6, N) in m on the distance from joint axis j to any point of arm primitive n,
    at any q."""
    arm = robot.arm
    columns = [
        _lever_column(robot, int(link), *_sweep_of_primitive(Kind(kind), T, size))
        for link, kind, T, size in zip(arm.link, arm.kind, arm.T_link_prim, arm.size, strict=True)
    ]
    return np.stack(columns, axis=1)


def lever_bound_for_sphere(robot: Robot, link: int, center: ArrayLike, radius: float) -> Array:
    """The same bounds (6,) for a ball fixed to a link (its index; 6 = wrist_3), `center` in that
    link's frame."""
    if not 0 <= link <= JOINTS:
        raise ValueError(f"link is {link}, allowed are 0 (base) to {JOINTS} (wrist_3)")
    x, y, z = np.asarray(center, dtype=np.float64)
    return _lever_column(robot, link, np.hypot(x, y) + radius, z - radius, z + radius)


def _lever_column(robot: Robot, link: int, radius: float, low: float, high: float) -> Array:
    """Bounds (6,) for a body inside the cylinder (radius, low <= z <= high) about the axis of the
    link's own joint.

    Turning that joint keeps the body in the cylinder; the cylinder, seen from the joint before,
    fits into one about that joint's axis, and so on to the base. A ball about the joint's origin is
    carried along and cuts what it can.
    """
    rho = np.zeros(JOINTS)
    ball = float(np.hypot(radius, max(abs(low), abs(high))))
    for j in range(link - 1, -1, -1):
        rho[j] = radius
        T = robot.T_parent_joint[j]
        ball += float(np.linalg.norm(T[:3, 3]))
        center = T[:3, 3] + T[:3, 2] * (low + high) / 2.0
        radius, low, high = _sweep_of_cylinder(center, T[:3, 2], (high - low) / 2.0, radius)
        radius, low, high = min(radius, ball), max(low, -ball), min(high, ball)
        ball = min(ball, float(np.hypot(radius, max(abs(low), abs(high)))))
    return rho


def _sweep_of_primitive(kind: Kind, T: Array, size: Array) -> tuple[float, float, float]:
    """The cylinder (radius, low, high) about z that holds the shape, whatever its turn about z."""
    center, axis = T[:3, 3], T[:3, 2]
    if kind == Kind.CYLINDER:
        return _sweep_of_cylinder(center, axis, size[1], size[0])
    if kind == Kind.CAPSULE:
        ends = center + np.outer([-size[1], size[1]], axis)
        margin = size[0]
    elif kind == Kind.BOX:
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
        ends = center + (signs * size) @ T[:3, :3].T
        margin = 0.0
    else:
        raise ValueError(f"{kind.name} is not a shape of the arm")
    radius = float(np.hypot(ends[:, 0], ends[:, 1]).max())
    return radius + margin, float(ends[:, 2].min()) - margin, float(ends[:, 2].max()) + margin


def _sweep_of_cylinder(
    center: Array, axis: Array, half: float, radius: float
) -> tuple[float, float, float]:
    """The cylinder about z that holds a given cylinder: exact for axes parallel or perpendicular to
    z, else a bound."""
    tilt = float(np.hypot(axis[0], axis[1]))  # sine of the angle between the axes
    reach_z = half * abs(float(axis[2])) + radius * tilt
    along = axis[:2] / tilt if tilt > 1e-9 else np.array([1.0, 0.0])
    u = abs(float(center[:2] @ along)) + half * tilt + radius * abs(float(axis[2]))
    v = abs(float(along[0] * center[1] - along[1] * center[0])) + radius
    ends = center[:2] + np.outer([-half, half], axis[:2])
    reach = min(float(np.hypot(u, v)), float(np.hypot(ends[:, 0], ends[:, 1]).max()) + radius)
    return reach, float(center[2]) - reach_z, float(center[2]) + reach_z


def _rotation(axis: int, angle: Array) -> Array:
    """Turns by `angle` about x (0) or z (2) as (..., 4, 4)."""
    T = np.zeros((*np.shape(angle), 4, 4))
    T[..., range(4), range(4)] = 1.0
    i, j = {0: (1, 2), 2: (0, 1)}[axis]
    T[..., i, i] = T[..., j, j] = np.cos(angle)
    T[..., j, i] = np.sin(angle)
    T[..., i, j] = -T[..., j, i]
    return T


def _primitives(rows: list[dict[str, Any]], link: list[int]) -> Primitives:
    size = np.zeros((len(rows), 3))
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    for n, row in enumerate(rows):
        size[n, : len(row["size"])] = row["size"]
        w, x, y, z = np.array(row["quat_wxyz"]) / np.linalg.norm(row["quat_wxyz"])
        T[n, :3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        T[n, :3, 3] = row["pos"]
    kind = _frozen([Kind[row["kind"].upper()] for row in rows], np.int32)
    return Primitives(
        tuple(row["name"] for row in rows), _frozen(link, np.int32), kind, _frozen(T), _frozen(size)
    )


def _frozen(value: Any, dtype: Any = np.float64) -> Any:
    array = np.array(value, dtype=dtype)
    array.setflags(write=False)
    return array
