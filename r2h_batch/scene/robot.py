"""A robot as numbers: arm and gripper, joint frames, primitives, finger linkage, masses, kinematics, lever
bounds (float64 NumPy)."""

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from r2h_batch.config import EvalConfig

Array = NDArray[np.float64]

GRIPPER_MASS_KG = 1.05
"""2F-85 with its coupling."""

TABLE_ROWS = 8
"""Different motions of one finger's parts, at most."""
MOTIONS = ("fixed", "driver", "pin", "inner_knuckle", *(f"table_{k}" for k in range(TABLE_ROWS)))
"""How a part of the gripper moves: the kernels' codes count these (tests/kernels/test_codes.py).
`table_K`: by row K of `Linkage.table`; the pads move by row 0."""


class ShapeKind(IntEnum):
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
    drive angle 0.

    A hull (arm only) has its corners in `corners`, and as size `hull_size` of them.
    """

    names: tuple[str, ...]
    link: NDArray[np.int32]
    kind: NDArray[np.int32]
    T_link_prim: Array
    size: Array
    corners: tuple[Array, ...] = ()
    """of each shape (V, 3), in its frame; V is 0 but for hulls. Empty: no hulls"""


@dataclass(frozen=True)
class Linkage:
    """The right (+y) finger's pivots in the gripper frame's (y, z) plane at drive 0; the left is its
    mirror.

    With a `table` in place of the four-bar linkage the drive is minus half the gap (m), so that a
    larger one closes; of the pivots `pad_from_pin_yz` alone says where the pads are.
    """

    driver_pivot_yz: Array
    pin_from_driver_yz: Array
    inner_knuckle_pivot_yz: Array
    pad_from_pin_yz: Array
    pad_half_size: Array
    drive_lower: float
    drive_upper: float
    table: Array | None = None
    """(K, S, 3) where the K parts of the right finger are at S gaps, evenly from the closed to the open
    one, linear in between: moved along y and z (m) after a turn about x (rad) through ee's origin"""
    mass_kg: float = GRIPPER_MASS_KG
    """of the whole gripper"""
    jaw_mass_kg: float = 0.0
    """of each finger that a table moves"""

    @property
    def moved(self) -> Array:
        """Which of y, z and turn change in each row of the table (K, 3), bool."""
        assert self.table is not None
        return np.ptp(self.table, axis=1) > 1e-9

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
    """gap between the pads of the open gripper, m"""
    table_from: int
    """links from this on are checked against the table: those before stand on it"""
    visuals: str
    """the arm of airo-models whose meshes show it"""
    dynamics: Dynamics
    links: tuple[str, ...]
    joints: tuple[str, ...]
    """names of the joints, in the order of every posture"""
    T_parent_joint: Array
    lower: Array
    """(J,) lower limits of the joints, rad"""
    upper: Array
    """(J,) upper limits, rad"""
    max_velocity: Array
    """(J,) limits of speed, rad/s"""
    max_torque: Array
    T_wrist3_flange: Array
    T_flange_ee: Array
    """(4, 4) the ee (the TCP between the pads) in the flange's frame, m"""
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
    ik_missed: tuple[int, int] | None = None
    """random reachable poses that the import solved, and how many of them it found no posture for"""
    payload_kg: float | None = None
    """what the arm carries at its flange by its data sheet, gripper included; no verdict asks for it"""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Robot) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:  # one line: a dataclass would print its arrays
        return f"Robot({self.name}: {len(self.joints)} joints, digest {self.digest[:12]})"

    def fitted(self, config: EvalConfig) -> EvalConfig:
        """The configuration with this robot's home and speed where it has the UR5e's.

        Args:
            config: what it says of home and speed stays where it is not the UR5e's.
        """
        return config.for_robot(self.home_q, float(self.max_velocity.min()))

    @cached_property
    def joint_weight(self) -> Array:
        """Weight of a radian of each joint when a motion is timed: the slowest joint's limit of
        speed over its own, 1 at most (J,)."""
        return frozen(self.max_velocity.min() / self.max_velocity)

    @property
    def closed_gap_m(self) -> float:
        """Gap between the pads of the closed gripper, whose linkage is at its stop."""
        return float(gap_from_drive(self, self.linkage.drive_upper))

    @property
    def carries_kg(self) -> float:
        """The heaviest object that the payload leaves room for beside the gripper; inf where none is given."""
        return np.inf if self.payload_kg is None else self.payload_kg - self.linkage.mass_kg

    @cached_property
    def family(self) -> Literal["ur", "numerical"]:
        """`ur`: of a UR's structure, whose inverse kinematics has a closed form."""
        try:
            ur_lengths(self)
        except ValueError:
            return "numerical"
        return "ur"

    @cached_property
    def reach_m(self) -> float:
        """From the shoulder to the wrist of the stretched arm. Without a UR's structure: from the
        second joint to the last but one, in whatever posture within limits takes it farthest."""
        if self.family == "ur":
            lengths = ur_lengths(self)
            return lengths.a2 + lengths.a3

        from scipy.optimize import minimize  # 0.2 s, and a UR needs none

        def apart(q: Array) -> float:
            T = forward_kinematics(self, q)
            return -float(np.linalg.norm(T[-3, :3, 3] - T[2, :3, 3]))

        limits = list(zip(self.lower, self.upper, strict=True))
        starts = np.linspace(self.lower, self.upper, 7)[1:-1]
        return -min(float(minimize(apart, q, bounds=limits).fun) for q in starts)

    @cached_property
    def T_wrist3_ee(self) -> Array:
        """The tool: ee in the last link's frame."""
        return np.asarray(self.T_wrist3_flange @ self.T_flange_ee)


class UrLengths(NamedTuple):
    """A UR's lengths in m: d and a of Denavit and Hartenberg 1955; `tool`: wrist centre to ee."""

    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    tool: float


def ur_lengths(robot: Robot) -> UrLengths:
    """The six lengths of a robot of a UR's structure; raises ValueError for any other."""
    T = [*robot.T_parent_joint, robot.T_wrist3_ee]
    if len(T) != 7:
        raise ValueError(f"{len(T) - 1} joints are not those of a UR arm")
    # T[i] takes joint i's frame to the one before. A UR's six lengths stand in known entries; what
    # else the frames hold must be quarter turns, or the closed form is that of another arm.
    d1, a2, a3 = T[0][2, 3], -T[2][0, 3], -T[3][0, 3]
    d4, d5, d6, tool = T[3][2, 3], -T[4][1, 3], T[5][1, 3], T[5][1, 3] + T[6][2, 3]
    straight, half = np.eye(3), np.diag([-1.0, -1.0, 1.0])
    up, down = (
        np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    )
    rotations = [half, up, straight, straight, up, down, straight]
    origins = [
        [0, 0, d1], [0, 0, 0], [-a2, 0, 0], [-a3, 0, d4], [0, -d5, 0], [0, d6, 0], [0, 0, tool - d6]
    ]  # fmt: skip
    for i, (R, p) in enumerate(zip(rotations, origins, strict=True)):
        if np.abs(T[i][:3, :3] - R).max() > 1e-9 or np.abs(T[i][:3, 3] - p).max() > 1e-9:
            raise ValueError(
                f"robot frame {i} is not that of a UR arm with a straight tool: the IK kernel cannot be used"
            )
    return UrLengths(*map(float, (d1, a2, a3, d4, d5, tool)))


def forward_kinematics(robot: Robot, q: ArrayLike) -> Array:
    """T_world_link (..., 8, 4, 4) in the order of `robot.links`; the last is the gripper frame. q
    (..., 6) in rad."""
    q = np.asarray(q, dtype=np.float64)
    n = len(robot.joints)
    if q.shape[-1:] != (n,):
        raise ValueError(f"q has shape {q.shape}, allowed is (..., {n})")
    T = np.zeros((*q.shape[:-1], len(robot.links), 4, 4))
    T[..., 0, :, :] = np.eye(4)
    for i in range(n):
        T[..., i + 1, :, :] = T[..., i, :, :] @ robot.T_parent_joint[i] @ _rotation(2, q[..., i])
    T[..., n + 1, :, :] = T[..., n, :, :] @ robot.T_wrist3_flange @ robot.T_flange_gripper
    return T


def ee_pose(robot: Robot, q: ArrayLike) -> Array:
    """T_world_ee (..., 4, 4)."""
    T_wrist3_ee = robot.T_wrist3_flange @ robot.T_flange_ee
    return np.asarray(forward_kinematics(robot, q)[..., -2, :, :] @ T_wrist3_ee)


def gap_from_drive(robot: Robot, drive: ArrayLike) -> Array:
    """Distance between the pad faces in m at a drive angle in rad."""
    link, q = robot.linkage, np.asarray(drive, dtype=np.float64)
    if link.table is not None:
        return np.asarray(-2.0 * q)
    a, b = link.pin_from_driver_yz
    return np.asarray(2.0 * (link.gap_offset_m + a * np.cos(q) - b * np.sin(q)))


def drive_from_gap(robot: Robot, gap_m: ArrayLike) -> Array:
    """Drive angle in rad for a gap in m; gaps outside the linkage's range (2F-85: 1.5 to 86.0 mm)
    give its nearest end."""
    link = robot.linkage
    if link.table is not None:
        gap = np.asarray(gap_m, dtype=np.float64)
        return np.clip(-gap / 2.0, link.drive_lower, link.drive_upper)
    a, b = link.pin_from_driver_yz
    cosine = (np.asarray(gap_m, dtype=np.float64) / 2.0 - link.gap_offset_m) / np.hypot(a, b)
    return np.clip(
        np.arccos(np.clip(cosine, -1.0, 1.0)) - np.arctan2(b, a), link.drive_lower, link.drive_upper
    )


def pad_center_z(robot: Robot, drive: ArrayLike) -> Array:
    """z of the pads' centres in the gripper frame, m."""
    link, q = robot.linkage, np.asarray(drive, dtype=np.float64)
    if link.table is not None:
        return np.asarray(link.pad_from_pin_yz[1] + table_at(link, q)[0, ..., 1])
    a, b = link.pin_from_driver_yz
    height = link.driver_pivot_yz[1] + link.pad_from_pin_yz[1]
    return np.asarray(height + b * np.cos(q) + a * np.sin(q))


def table_at(link: Linkage, drive: ArrayLike) -> Array:
    """Rows of the table at drives (...): (K, ..., 3)."""
    assert link.table is not None
    drives = np.linspace(link.drive_upper, link.drive_lower, link.table.shape[1])
    return np.stack(
        [
            np.stack([np.interp(-np.asarray(drive), -drives, x) for x in row.T], -1)
            for row in link.table
        ]
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
    if motion not in MOTIONS:
        raise ValueError(f"motion is {motion!r}, allowed are {', '.join(MOTIONS)}")
    if motion.startswith("table_"):
        y, z, turn = np.moveaxis(table_at(link, q)[int(motion[6:])], -1, 0)
        tool = (np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee)[:3, 3]
        T = _rotation(0, side * turn)
        T[..., :3, 3] = tool - T[..., :3, :3] @ tool
        T[..., 1, 3] += side * y
        T[..., 2, 3] += z
        return T
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
    shapes = zip(arm.link, arm.kind, arm.T_link_prim, arm.size, corners_of(arm), strict=True)
    columns = [
        _lever_column(robot, int(link), *_sweep_of_primitive(ShapeKind(kind), T, size, corners))
        for link, kind, T, size, corners in shapes
    ]
    return np.stack(columns, axis=1)


def corners_of(shapes: Primitives) -> tuple[Array, ...]:
    """The corners (V, 3) of each shape in its frame; none but of hulls."""
    return shapes.corners or (np.zeros((0, 3)),) * len(shapes.kind)


def hull_size(corners: ArrayLike) -> Array:
    """Radius and half length (m) of the cylinder about the frame's z that holds a hull, and radius
    of the ball about the frame's origin in it (below 0: the origin is outside)."""
    from scipy.spatial import ConvexHull  # 0.4 s: only robots with hulls need it

    points = np.asarray(corners, np.float64)
    inner = -float(ConvexHull(points).equations[:, 3].max())
    radius, half = np.hypot(points[:, 0], points[:, 1]).max(), np.abs(points[:, 2]).max()
    return np.array([radius + 1e-6, half + 1e-6, inner - 1e-6])


def lever_bound_for_sphere(robot: Robot, link: int, center: ArrayLike, radius: float) -> Array:
    """The same bounds (6,) for a ball fixed to a link (its index; 6 = wrist_3), `center` in that
    link's frame."""
    last = len(robot.joints)
    if not 0 <= link <= last:
        raise ValueError(f"link is {link}, allowed are 0 (base) to {last} ({robot.links[last]})")
    x, y, z = np.asarray(center, dtype=np.float64)
    return _lever_column(robot, link, np.hypot(x, y) + radius, z - radius, z + radius)


def _lever_column(robot: Robot, link: int, radius: float, low: float, high: float) -> Array:
    """Bounds (6,) for a body inside the cylinder (radius, low <= z <= high) about the axis of the
    link's own joint.

    Turning that joint keeps the body in the cylinder; the cylinder, seen from the joint before,
    fits into one about that joint's axis, and so on to the base. A ball about the joint's origin is
    carried along and cuts what it can.
    """
    rho = np.zeros(len(robot.joints))
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


def _sweep_of_primitive(
    kind: ShapeKind, T: Array, size: Array, corners: Array
) -> tuple[float, float, float]:
    """The cylinder (radius, low, high) about z that holds the shape, whatever its turn about z."""
    center, axis = T[:3, 3], T[:3, 2]
    if kind == ShapeKind.CYLINDER:
        return _sweep_of_cylinder(center, axis, size[1], size[0])
    if kind == ShapeKind.CAPSULE:
        ends = center + np.outer([-size[1], size[1]], axis)
        margin = size[0]
    elif kind == ShapeKind.BOX:
        signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T
        ends = center + (signs * size) @ T[:3, :3].T
        margin = 0.0
    elif kind == ShapeKind.HULL:
        ends, margin = center + corners @ T[:3, :3].T, 1e-6
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
    extent_z = half * abs(float(axis[2])) + radius * tilt
    along = axis[:2] / tilt if tilt > 1e-9 else np.array([1.0, 0.0])
    u = abs(float(center[:2] @ along)) + half * tilt + radius * abs(float(axis[2]))
    v = abs(float(along[0] * center[1] - along[1] * center[0])) + radius
    ends = center[:2] + np.outer([-half, half], axis[:2])
    extent = min(float(np.hypot(u, v)), float(np.hypot(ends[:, 0], ends[:, 1]).max()) + radius)
    return extent, float(center[2]) - extent_z, float(center[2]) + extent_z


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


def frozen(value: Any, dtype: Any = np.float64) -> Any:
    """A copy as an array that nobody can write into."""
    array = np.array(value, dtype=dtype)
    array.setflags(write=False)
    return array


def slide_table(closed_gap_m: float, open_gap_m: float) -> Array:
    """The table (1, 2, 3) of jaws on slides whose shapes stand where the pads meet."""
    return np.array([[[closed_gap_m / 2, 0.0, 0.0], [open_gap_m / 2, 0.0, 0.0]]])


def table_motions(rows: ArrayLike, side: ArrayLike) -> tuple[str, ...]:
    """`gripper_motion` of parts that rows of a table move, where they are on a side."""
    pairs = zip(np.asarray(rows).tolist(), np.asarray(side).tolist(), strict=True)
    return tuple(f"table_{k}" if s else "fixed" for k, s in pairs)


def table_linkage(
    table: ArrayLike, closed_gap_m: float, open_gap_m: float, pad_half_size_m: ArrayLike, ee_z_m: float,
    mass_kg: float, jaw_mass_kg: float,
) -> Linkage:  # fmt: skip
    """The linkage of fingers that a table moves; `ee_z_m`: of the ee frame in the gripper's, where the
    pads are half open."""
    none, half, rows = frozen(np.zeros(2)), frozen(pad_half_size_m), frozen(table)
    link = Linkage(
        none, none, none, none, half, -open_gap_m / 2, -closed_gap_m / 2, rows, mass_kg, jaw_mass_kg
    )
    lift = float(table_at(link, -open_gap_m / 4)[0, 1])
    return replace(link, pad_from_pin_yz=frozen([half[1], ee_z_m - lift]))
