"""A robot as numbers: arm and gripper, joint frames, primitives, finger linkage, masses, lever
bounds (float64 NumPy)."""

import hashlib
import json
from dataclasses import dataclass
from enum import IntEnum
from functools import cache, cached_property
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from r2h_batch.config import HOME_Q, OPEN_GAP_M, EvalConfig

Array = NDArray[np.float64]

JOINTS = 6
DEFAULT_ROBOT = "ur5e_2f85"
JOINT_KEYS = ("T_parent_joint", "lower", "upper", "max_velocity", "max_torque")


# UniversalRobots/Universal_Robots_ROS2_Description, config/ur5e/physical_parameters.yaml: shoulder
# to wrist_3.
LINK_MASS_KG = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
LINK_COM_M = (
    (0.0, -0.00193, -0.02561), (-0.2125, 0.0, 0.11336), (-0.2422, 0.0, 0.0265),
    (0.0, -0.01634, -0.0018), (0.0, 0.01634, -0.0018), (0.0, 0.0, -0.001159),
)  # fmt: skip
# xx, xy, xz, yy, yz, zz (kg m^2) about the centre of mass, axes turned by LINK_ROLL about the
# link's x
LINK_INERTIA = (
    (0.00700210, 0.00000073, -0.00001053, 0.00648091, 0.00049994, 0.00657286),
    (0.01505885, -0.00005400, 0.00000563, 0.33388086, -0.00000181, 0.33247207),
    (0.00399632, -0.00001365, 0.00137272, 0.07879254, -0.00000660, 0.07848510),
    (0.00165491, -0.00000282, -0.00000438, 0.00135962, 0.00010157, 0.00126279),
    (0.00135617, -0.00000274, 0.00000444, 0.00127827, -0.00005048, 0.00096614),
    (0.00018694, 0.00000006, -0.00000017, 0.00018908, -0.00000092, 0.00025756),
)
LINK_ROLL = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)

ARMATURE = 0.1
"""Rotor inertia behind the gear, kg m^2 [choice]: MuJoCo Menagerie's value for this arm."""

KP = (10000.0, 10000.0, 10000.0, 2000.0, 2000.0, 2000.0)
SERVO_RATE = 100.0 / 3.0
"""Stiffness N m/rad and kp / kv in 1/s [choice]: 10 kN m/rad on the large joints is what keeps an
industrial arm within 0.1 mm while it moves."""


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
class Dynamics:
    """Masses of the arm's moving links (kg, m and kg m^2 about the centre of mass, link frames) and
    what its servos do."""

    mass: Array  # (6,)
    com: Array  # (6, 3)
    inertia: Array  # (6, 3, 3)
    armature: float
    """rotor inertia behind the gear, kg m^2"""
    stiffness: Array  # (6,) kp, N m/rad
    servo_rate: float
    """kp / kv in 1/s, the same for all joints: what lag there is leaves a straight joint line
    straight"""


@dataclass(frozen=True, eq=False)
class Robot:
    """An arm and a gripper: all that the package knows of them. Equal digests are one robot.

    T_world_link[i + 1] = T_world_link[i] @ T_parent_joint[i] @ Rz(q_i): the axis of joint i is z of
    link i + 1.
    """

    name: str
    """in rows, tables and file names"""
    home_q: tuple[float, ...]
    """the posture at the start of a trial unless a benchmark has another one, rad"""
    open_gap_m: float
    """gap between the pads of the open gripper"""
    table_from: int
    """links from this on are checked against the table: those before stand on it"""
    visuals: str
    """the arm of airo-models whose meshes show it"""
    dynamics: Dynamics
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

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Robot) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def fitted(self, config: EvalConfig) -> EvalConfig:
        """The configuration with this robot's home and speed where it has the UR5e's."""
        return config.for_robot(self.home_q, float(self.max_velocity.min()))

    @property
    def closed_gap_m(self) -> float:
        """Gap between the pads of the closed gripper, whose linkage is at its stop."""
        return float(gap_from_drive(self, self.linkage.drive_upper))

    @cached_property
    def T_wrist3_ee(self) -> Array:
        """The tool: ee in the last link's frame."""
        return np.asarray(self.T_wrist3_flange @ self.T_flange_ee)


@cache
def load_robot(name: str = DEFAULT_ROBOT) -> Robot:
    """A robot by name; `digest` is its file's sha256."""
    if name != DEFAULT_ROBOT:
        raise ValueError(f"no robot is called {name!r}; built in is {DEFAULT_ROBOT}")
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
        name=name,
        home_q=HOME_Q,
        open_gap_m=OPEN_GAP_M,
        table_from=links.index("upper_arm"),
        visuals="ur5e",
        dynamics=Dynamics(
            mass=_frozen(LINK_MASS_KG),
            com=_frozen(LINK_COM_M),
            inertia=_frozen(
                [rolled(i, roll) for i, roll in zip(LINK_INERTIA, LINK_ROLL, strict=True)]
            ),
            armature=ARMATURE,
            stiffness=_frozen(KP),
            servo_rate=SERVO_RATE,
        ),
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


def gap_from_drive(robot: Robot, drive: ArrayLike) -> Array:
    """Distance between the pad faces in m at a drive angle in rad."""
    link, q = robot.linkage, np.asarray(drive, dtype=np.float64)
    a, b = link.pin_from_driver_yz
    return np.asarray(2.0 * (link.gap_offset_m + a * np.cos(q) - b * np.sin(q)))


def drive_from_gap(robot: Robot, gap_m: ArrayLike) -> Array:
    """Drive angle in rad for a gap in m; gaps outside the linkage's range (2F-85: 1.5 to 86.0 mm)
    give its nearest end."""
    link = robot.linkage
    a, b = link.pin_from_driver_yz
    cosine = (np.asarray(gap_m, dtype=np.float64) / 2.0 - link.gap_offset_m) / np.hypot(a, b)
    return np.clip(
        np.arccos(np.clip(cosine, -1.0, 1.0)) - np.arctan2(b, a), link.drive_lower, link.drive_upper
    )


def pad_center_z(robot: Robot, drive: ArrayLike) -> Array:
    """z of the pads' centres in the gripper frame, m."""
    link, q = robot.linkage, np.asarray(drive, dtype=np.float64)
    a, b = link.pin_from_driver_yz
    return np.asarray(
        link.driver_pivot_yz[1] + link.pad_from_pin_yz[1] + b * np.cos(q) + a * np.sin(q)
    )


def gripper_primitives_at(robot: Robot, gap_m: ArrayLike) -> Array:
    """T_ee_prim (..., N, 4, 4) of `robot.gripper`'s shapes with the pads `gap_m` (...) apart."""
    drive = drive_from_gap(robot, gap_m)
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


def rolled(tensor: ArrayLike, roll: float) -> Array:
    """Inertia tensor of (xx, xy, xz, yy, yz, zz), in axes turned by `roll` about x."""
    xx, xy, xz, yy, yz, zz = np.asarray(tensor, np.float64)
    c, s = np.cos(roll), np.sin(roll)
    R = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return np.asarray(R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T)


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
