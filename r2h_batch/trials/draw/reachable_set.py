"""Where a hand may stand: the set of ball centres and palm normals that the robot can be asked to reach, and
the room that hand and arm keep from table, arm and TCP at home."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from r2h_batch.base import se3
from r2h_batch.config import Workplace
from r2h_batch.scene.bounds import capsule_of_shape
from r2h_batch.scene.hand import HandSet, palm_frame
from r2h_batch.scene.robot import Robot, ee_pose, forward_kinematics
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot
from r2h_batch.trials.draw import receivers
from r2h_batch.trials.draw.distance import from_box, from_segment, from_segments

NEAREST_M, FARTHEST_M = 0.45, 0.80
"""Horizontal distance of the ball centre c_h from the axis of joint 1 [choice]."""
LOWEST_M, HIGHEST_M = 0.10, 0.60
"""Height of c_h above the table [choice]. These four are the UR5e's; of another robot the ring and
the height above LOWEST_M are to these as the reaches are (`Room`)."""
SECTOR_DEG, CONE_DEG, TURNED_AWAY_DEG = 50.0, 75.0, 120.0
"""c_h within +-50 degrees of +x; palm normal within 75 degrees of the direction to the robot or of
up, never more than 120 degrees from the former [choice]."""
TCP_ROOM_M, TABLE_ROOM_M, ROBOT_ROOM_M = 0.20, 0.005, 0.005
"""Least distance of the hand's vertices, with the robot at home: the TCP, the table, the arm
[choice]."""

_NEAR_ROWS = 256  # hands whose every vertex is looked at, at once: 2.7 MB an array
Array = NDArray[np.float64]


class Room(NamedTuple):
    """Where ball centres may lie: distances from the axis of joint 1, and the height, m."""

    nearest_m: float
    farthest_m: float
    highest_m: float

    @staticmethod
    @lru_cache(maxsize=8)
    def of(robot: Robot) -> "Room":
        """In proportion to the robot's reach; a micrometre is the unit."""
        factor = robot.reach_m / load_robot(DEFAULT_ROBOT).reach_m
        lengths = (
            NEAREST_M * factor,
            FARTHEST_M * factor,
            LOWEST_M + (HIGHEST_M - LOWEST_M) * factor,
        )
        return Room(*(round(x, 6) for x in lengths))


class PosedHands:
    """The hands of a set as float64 arrays in their own frames."""

    def __init__(self, hand_set: HandSet) -> None:
        geometry = hand_set.geometry
        point, normal = palm_frame(geometry.joints.double(), hand_set.side)
        self.palm_point, self.palm_normal = point.numpy(), normal.numpy()
        joints = geometry.joints.double().numpy()
        # to the middle finger's root, in the palm's plane
        self.wrist, along = joints[:, 0], joints[:, 4] - joints[:, 0]
        along = along - se3.dot(along, self.palm_normal)[:, None] * self.palm_normal
        self.along = along / np.sqrt(se3.dot(along, along))[:, None]
        # (3, H, V)
        self.vertices = np.ascontiguousarray(geometry.vertices.double().numpy().transpose(2, 0, 1))
        low, high = self.vertices.min(2), self.vertices.max(2)
        self.center = ((low + high) / 2).T
        offset = self.vertices - self.center.T[:, :, None]
        self.radius = np.sqrt((offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2).max(1)) + 1e-6
        self.side = hand_set.side.numpy()
        self.in_body = None if hand_set.in_body is None else hand_set.in_body.numpy()


@lru_cache(maxsize=2)
def posed_hands(hand_set: HandSet) -> PosedHands:
    """The same for every shard of a sweep."""
    return PosedHands(hand_set)


def in_set(center: Array, room: "Room") -> NDArray[np.bool_]:
    """Whether ball centres (n, 3) lie in the sector of a ring that r2h-v0 draws them from."""
    slope = round(math.tan(math.radians(SECTOR_DEG)), 12)
    x, y, z = center[:, 0], center[:, 1], center[:, 2]
    square = x * x + y * y
    ring = (square >= room.nearest_m**2) & (square <= room.farthest_m**2)
    ring &= np.abs(y) <= slope * x
    return np.asarray(ring & (z >= LOWEST_M) & (z <= room.highest_m))


def arm_is_clear(people: receivers.Person, robot: Robot, at: Workplace) -> NDArray[np.bool_]:
    """Whether upper arm and forearm keep off table, arm and TCP at home, asked at points along
    them."""
    tcp, ends, radius = home_bodies(robot, at.home_q)
    low, high = (
        np.round(np.array(at.table_center) + sign * np.array(at.table_half), 6) for sign in (-1, 1)
    )
    low, high = low - TABLE_ROOM_M, high + TABLE_ROOM_M
    clear = np.ones(len(people.wrist), bool)
    for points, thick in receivers.limbs(people):
        rows = np.flatnonzero(clear)
        x = points[rows].reshape(-1, 3)
        thick = np.repeat(np.broadcast_to(thick, len(clear))[rows], points.shape[1])
        free = from_box(low, high, x) >= thick**2
        free &= from_segment(tcp, tcp, x) >= TCP_ROOM_M**2
        for (a, b), r in zip(ends, radius, strict=True):
            free &= from_segment(a, b, x) >= (r + thick + ROBOT_ROOM_M) ** 2
        clear[rows] = free.reshape(-1, points.shape[1]).all(1)
    return clear


def ball_center(u: Array, room: "Room") -> tuple[NDArray[np.bool_], Array]:
    """c_h (n, 3) uniform in a box, and whether it lies in the sector of a ring that the box
    encloses."""
    x_low = round(room.nearest_m * math.cos(math.radians(SECTOR_DEG)), 12)
    y_high = round(room.farthest_m * math.sin(math.radians(SECTOR_DEG)), 12)
    x = x_low + (room.farthest_m - x_low) * u[0]
    y = y_high * (2.0 * u[1] - 1.0)
    z = LOWEST_M + (room.highest_m - LOWEST_M) * u[2]
    center = np.stack([x, y, z], axis=1)
    return in_set(center, room), center


def faces_robot_or_up(center: Array, normal: Array) -> NDArray[np.bool_]:
    """Whether palm normals (n, 3) lie in the two cones, and not too far from the direction to the
    robot."""
    cone, away = (round(math.cos(math.radians(a)), 12) for a in (CONE_DEG, TURNED_AWAY_DEG))
    x, y = center[:, 0], center[:, 1]
    to_robot = -(normal[:, 0] * x + normal[:, 1] * y) / np.sqrt(x * x + y * y)
    return ((to_robot >= cone) | (normal[:, 2] >= cone)) & (to_robot >= away)


def hand_is_clear(
    T_world_hand: Array, hand: NDArray[np.int64], hands: PosedHands, robot: Robot, at: Workplace
) -> NDArray[np.bool_]:
    """Whether no vertex is near TCP, table or arm at home: the hand's bounding sphere first,
    vertices where needed."""
    tcp, ends, radius = home_bodies(robot, at.home_q)
    center = se3.rotate(T_world_hand[:, :3, :3], hands.center[hand]) + T_world_hand[:, :3, 3]
    # to a micrometre: 0.475 - 0.025 is not 0.45 in binary
    low, high = (
        np.round(np.array(at.table_center) + sign * np.array(at.table_half), 6) for sign in (-1, 1)
    )
    low, high = low - TABLE_ROOM_M, high + TABLE_ROOM_M
    segments = [(tcp, tcp), *ends]
    squared = [from_box(low, high, center), *(from_segment(a, b, center) for a, b in segments)]
    room = np.array([0.0, TCP_ROOM_M, *(radius + ROBOT_ROOM_M)])
    near = np.stack(squared, 1) < (room + hands.radius[hand][:, None]) ** 2
    clear = np.ones(len(hand), bool)
    for k in range(near.shape[1]):
        rows = np.flatnonzero(near[:, k] & clear)
        for part in np.split(rows, range(_NEAR_ROWS, len(rows), _NEAR_ROWS)):
            R, p = T_world_hand[part, :3, :3], T_world_hand[part, :3, 3]
            local = hands.vertices[:, hand[part]]  # (3, n, V)
            if k == 0:
                turned = (sum(R[:, i, j, None] * local[j] for j in range(3)) for i in range(3))
                x, y, z = (v + p[:, i, None] for i, v in enumerate(turned))
                hit = (
                    (z < high[2])
                    & (z > low[2])
                    & (x < high[0])
                    & (x > low[0])
                    & (y < high[1])
                    & (y > low[1])
                )
            else:
                a, b = segments[k - 1]
                back = R.transpose(0, 2, 1)
                hit = (
                    from_segments(se3.rotate(back, a - p), se3.rotate(back, b - p), local)
                    < room[k] ** 2
                )
            clear[part] = ~hit.any(1)
    return clear


@lru_cache(maxsize=8)
def home_bodies(robot: Robot, home_q: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """TCP (3,), and the arm primitives' bounding capsules: ends (n, 2, 3), radii (n,), with the
    robot at home (world).

    Rounded to a nanometre, so that the last bits of a machine's sine cannot decide about a trial.
    """
    T = forward_kinematics(robot, home_q)[robot.arm.link] @ robot.arm.T_link_prim
    capsules = [capsule_of_shape(robot.arm, i) for i in range(len(T))]
    axes = np.stack([t[:3, :3] @ c[0] for t, c in zip(T, capsules, strict=True)])
    ends = np.stack([T[:, :3, 3] - axes, T[:, :3, 3] + axes], 1)
    return (
        np.round(ee_pose(robot, home_q)[:3, 3], 9),
        np.round(ends, 9),
        np.round([c[1] for c in capsules], 9),
    )
