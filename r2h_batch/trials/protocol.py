"""Protocols r2h-v0, r2h-v1, r2h-v2 and r2h-release: which object is handed to which hand, and where
that stands.

Trial i of S0 has the id 2 i, of S1 the id 2 i + 1. Objects of the split take turns, hands alternate
right and left, and the hand's pose is drawn from the reachable set by rejection with counters
(protocol, trial id, attempt): a trial is the same alone or among a million, on any machine. In
r2h-v0 the hand floats and its roll is free; in r2h-v1 it is that of a person who reaches for the
object (receivers.py), in the same set; in r2h-v2 it and the body are one of the built-in people's
(people.py); in r2h-release its palm lies in the box of the authors' release (palms.py).
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.registry import DEFAULT_PROTOCOL, PROTOCOL_NAMES, RELEASE, WITH_BODIES
from r2h_batch.base.schedule import assign_hands, assign_objects, trial_ids
from r2h_batch.base.validate import instance_of, integer, one_of, optional, sequence_of
from r2h_batch.base.validate_tensors import check_tensor
from r2h_batch.config import EvalConfig, Workplace
from r2h_batch.data.people import People
from r2h_batch.scene.bounds import capsule_of_shape
from r2h_batch.scene.hand import HandSet, palm_frame
from r2h_batch.scene.objects import ObjectModel, checked_objects
from r2h_batch.scene.robot import DEFAULT_ROBOT, Robot, ee_pose, forward_kinematics, load_robot
from r2h_batch.trials import palms, receivers, recorded
from r2h_batch.trials.benchmark.benchmark import Benchmark, built_in
from r2h_batch.trials.benchmark.build import read_benchmark
from r2h_batch.trials.benchmark.trials_file import listed_with_ids
from r2h_batch.trials.distance import from_box, from_segment, from_segments
from r2h_batch.trials.own_torso import off_the_torso
from r2h_batch.trials.people import draw_people, owners
from r2h_batch.types import PERSON, Trials
from r2h_batch.verdicts import SPLITS

TRIALS = 500
"""Trials of a split in the benchmark; more are the same generator run further."""
MOST_TRIALS = 10**9

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

_POSE = 1  # purpose of the random counters; `schedule` has 0
_ROWS = 16384  # trials drawn at once
_NEAR_ROWS = 256  # hands whose every vertex is looked at, at once: 2.7 MB an array
Array = NDArray[np.float64]


def make_trials(
    splits: Sequence[str] = SPLITS,
    trials: int = TRIALS,
    *,
    objects: Sequence[ObjectModel] | None = None,
    hand_set: HandSet | None = None,
    robot: Robot | None = None,
    config: EvalConfig | None = None,
    benchmark: Benchmark | str | Path | None = None,
    protocol: str | None = None,
) -> Trials:
    """The first trials of each split, split by split, on the CPU.

    Args:
        splits: `S0` (free), `S1` (functional), or both.
        trials: number of trials of each split.
        objects: what `object_index` counts; those of a split take turns. None: the 16 built-in ones.
        hand_set: what `hand_index` counts; None: the built-in hands.
        robot: hands stand within its reach; None: the UR5e.
        config: ball, table and home, which the hands must suit; None: the default.
        benchmark: a file, or what `read_benchmark` returned, in place of the four above.
        protocol: `r2h-v1` (with `Trials.receiver`), `r2h-v2` (also with `Trials.person`), `r2h-v0` (hands
            alone) or `r2h-release`, the last three with objects and hands of their own; None: the benchmark's,
            else r2h-v1.

    Raises:
        TypeError, ValueError: an argument is none of these, or no hand fits table and home.
    """
    splits = sequence_of(str, f"of {', '.join(SPLITS)}")(
        "splits", [splits] if isinstance(splits, str) else splits
    )
    for split in splits:
        one_of(*SPLITS)("splits", split)
    if len(set(splits)) != len(splits):
        raise ValueError(f"splits are {', '.join(splits)}; each may be given once")
    trials = integer(0, MOST_TRIALS)("trials", trials)
    optional(one_of(*PROTOCOL_NAMES))("protocol", protocol)
    people = None
    if benchmark is not None:
        instance_of((Benchmark, str, Path), "a file, or read_benchmark(FILE)")(
            "benchmark", benchmark
        )
        if not all(x is None for x in (objects, hand_set, robot, config)):
            raise ValueError(
                "benchmark says objects, hands, robot and limits; give it alone, or the others without it"
            )
        found = read_benchmark(benchmark) if isinstance(benchmark, (str, Path)) else benchmark
        if found.listed is not None:
            return _listed(found.listed, splits, trials).named(found.objects)
        placed = _for_persons(found)
        objects, hand_set, robot = placed.objects, placed.hand_set, placed.robot
        config, protocol, people = placed.config(), protocol or found.drawn, placed.people
    plan = dict.fromkeys(splits, trials)
    ids = trial_ids(plan, 0, sum(plan.values()))
    return trials_with_ids(
        torch.from_numpy(ids),
        objects=objects,
        hand_set=hand_set,
        robot=robot,
        config=config,
        protocol=protocol or DEFAULT_PROTOCOL,
        people=people,
    )


def _listed(listed: Trials, splits: Sequence[str], trials: int) -> Trials:
    """The first `trials` of a benchmark's own trials of each split, or as many as there are."""
    rows = [torch.nonzero(listed.trial_id % 2 == SPLITS.index(s))[:trials, 0] for s in splits]
    return listed[torch.cat(rows)]


def trials_of(benchmark: Benchmark, trial_id: Int64[Tensor, " n"]) -> Trials:
    """The trials of these ids in a benchmark, in this order."""
    instance_of(Benchmark, "read_benchmark(FILE)")("benchmark", benchmark)
    if benchmark.listed is not None:
        return listed_with_ids(benchmark.listed, trial_id).named(benchmark.objects)
    benchmark = _for_persons(benchmark)
    return trials_with_ids(
        trial_id,
        objects=benchmark.objects,
        hand_set=benchmark.hand_set,
        robot=benchmark.robot,
        config=benchmark.config(),
        protocol=benchmark.drawn,
        people=benchmark.people,
    )


def _for_persons(benchmark: Benchmark) -> Benchmark:
    """The benchmark whose robot says where persons stand."""
    if benchmark.persons == "for-robot":
        return benchmark
    return benchmark.on(load_robot(DEFAULT_ROBOT), benchmark.persons)


def trials_with_ids(
    trial_id: Int64[Tensor, " n"],
    *,
    objects: Sequence[ObjectModel] | None = None,
    hand_set: HandSet | None = None,
    robot: Robot | None = None,
    config: EvalConfig | None = None,
    protocol: str = DEFAULT_PROTOCOL,
    people: People | None = None,
) -> Trials:
    """The trials of these ids, in this order, on the CPU.

    Args:
        trial_id: (N,) int64: 2 i is trial i of S0, 2 i + 1 of S1.
        objects: as in `make_trials`, like the next three.
        hand_set: what `hand_index` counts.
        robot: hands stand within its reach.
        config: ball, table and home.
        protocol: of `registry.PROTOCOLS`.
        people: receivers of a protocol with bodies, such as `built_in_people("children")`, with a hand set of
            theirs (`people_hand_set`); None: the protocol's own.

    Raises:
        TypeError, ValueError: an argument is none of these, or an id is negative.
    """
    trial_id = check_tensor("trial_id", trial_id, "a torch tensor (N,) of torch.int64")
    if trial_id.ndim != 1 or trial_id.dtype != torch.int64:
        raise TypeError(
            f"trial_id is {trial_id.dtype} {tuple(trial_id.shape)}; it must be a torch tensor (N,) of torch.int64"
        )
    ids = trial_id.cpu().numpy().copy()
    if len(ids) and ids.min() < 0:
        raise ValueError(f"trial id {ids.min()} is negative; ids are 2 i (S0) and 2 i + 1 (S1)")
    one_of(*PROTOCOL_NAMES)("protocol", protocol)
    optional(instance_of(EvalConfig, "EvalConfig() or EvalConfig.preset(NAME)"))("config", config)
    optional(instance_of(HandSet, "such as load_hand_set(FILE)"))("hand_set", hand_set)
    with_people, defaults = protocol in WITH_BODIES, built_in(protocol)
    objects = defaults.objects if objects is None else checked_objects(objects)
    robot = defaults.robot if robot is None else robot
    config = defaults.config() if config is None else config
    given = defaults.hand_set if hand_set is None else hand_set
    people = defaults.people if people is None else people
    hands = _hands(given)
    if people is not None and not with_people:
        how = f"take protocol {' or '.join(WITH_BODIES)}, or no people"
        raise ValueError(f"people is {people.name}, receivers of {protocol} have no body; {how}")
    object_index, side = assign_objects(ids, [o.split for o in objects])
    hand_index = np.zeros(len(ids), np.int64)
    T_world_hand = np.zeros((len(ids), 4, 4), np.float32)
    receiver = np.zeros((len(ids) if with_people else 0, 5, 4), np.float32)
    person = np.zeros((0 if people is None else len(ids), len(PERSON)), np.float32)
    for first in range(0, len(ids), _ROWS):
        rows = slice(first, first + _ROWS)
        hand_index[rows] = assign_hands(ids[rows], side[rows], hands.side, protocol)
        try:
            place = Place(hands, robot, config, objects)
            key = rng.key_of(protocol)
            if people is not None:
                T_world_hand[rows], receiver[rows], hand_index[rows], person[rows] = draw_people(
                    key, ids[rows], side[rows], hand_index[rows], owners(people, given),
                    partial(_placing_people, place=place), _table_edge_m(config),
                )  # fmt: skip
                continue
            T_world_hand[rows], bodies = _DRAWS[protocol](
                key, ids[rows], hand_index[rows], object_index[rows], place
            )
            if bodies is not None:
                receiver[rows] = bodies
        except rng.NothingFits as error:
            raise ValueError(
                f"no place for a hand where {protocol} draws them: {error}. Table (center {config.workplace.table_center}, half "
                f"{config.workplace.table_half} m), arm at home or reach_offset_m leave none; change these, or list trials"
            ) from None
    return Trials(
        trial_id=torch.from_numpy(ids),
        object_index=torch.from_numpy(object_index.astype(np.int32)),
        hand_index=torch.from_numpy(hand_index.astype(np.int32)),
        T_world_hand=torch.from_numpy(T_world_hand),
        receiver=torch.from_numpy(receiver) if with_people else None,
        person=None if people is None else torch.from_numpy(person),
    ).named(objects)


def trials_digest(trials: Trials, *, objects: Sequence[ObjectModel] | None = None) -> str:
    """sha256 (hex) over protocol, ids, object names, hand indices, and the bytes of the hand poses
    and of the receivers.

    `objects` is what `object_index` counts; by default the built-in ones, and a number for what
    comes after them.
    """
    instance_of(Trials, "make_trials(...)")("trials", trials)
    names = dict(enumerate(o.name for o in checked_objects(objects)))
    digest = hashlib.sha256(b"r2h-v0\n" if trials.receiver is None else b"r2h-v1\n")
    digest.update(trials.trial_id.cpu().numpy().astype("<i8").tobytes())
    digest.update(
        "\n".join(names.get(i, f"object {i}") for i in trials.object_index.tolist()).encode()
    )
    digest.update(trials.hand_index.cpu().numpy().astype("<i4").tobytes())
    digest.update(trials.T_world_hand.cpu().contiguous().numpy().astype("<f4").tobytes())
    if trials.receiver is not None:
        digest.update(trials.receiver.cpu().contiguous().numpy().astype("<f4").tobytes())
    return digest.hexdigest()


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


class _Hands:
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
def _hands(hand_set: HandSet) -> _Hands:
    return _Hands(hand_set)


@dataclass(frozen=True)
class Place:
    """The things among which hands are placed."""

    hands: _Hands
    robot: Robot
    config: EvalConfig
    objects: Sequence[ObjectModel]


Drawn = tuple[NDArray[np.float32], NDArray[np.float32] | None]
"""T_world_hand (n, 4, 4), and `Trials.receiver` (n, 5, 4) of a protocol whose receivers have bodies."""
Draw = Callable[
    [tuple[int, int], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Place], Drawn
]
"""Draws n trials: from a key of random counters, trial ids, hand and object indices (n,), and a place.
A row may depend on nothing but these: a trial is the same alone or among a million."""
_DRAWS: dict[str, Draw] = {}


def draws(protocol: str) -> Callable[[Draw], Draw]:
    """Register the function that draws a protocol's trials, under its name in `registry.PROTOCOLS`."""

    def register(function: Draw) -> Draw:
        _DRAWS[one_of(*PROTOCOL_NAMES)("protocol", protocol)] = function
        return function

    return register


@draws("r2h-v0")
def _draw_poses(
    key: tuple[int, int],
    ids: NDArray[np.int64],
    hand_index: NDArray[np.int64],
    object_index: NDArray[np.int64],
    place: Place,
) -> Drawn:
    """Hands alone: each the first proposal of its trial that lies in the reachable set."""
    hands, robot, config = place.hands, place.robot, place.config
    offset_m = config.thresholds.reach_offset_m

    def propose(
        rows: NDArray[np.int64], attempt: int | NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], tuple[NDArray[np.float32]]]:
        u = rng.uniforms(key, ids[rows], 7, purpose=_POSE, attempt=attempt)
        inside, center = _ball_center(u[:3], Room.of(robot))
        turned, R = rng.rotation(u[3:])
        kept = np.flatnonzero(inside & turned)
        hand, center, R = hand_index[rows[kept]], center[kept], R[kept]
        normal = se3.rotate(R, hands.palm_normal[hand])
        faces = _faces_robot_or_up(center, normal)
        kept, hand, center, R = kept[faces], hand[faces], center[faces], R[faces]
        normal = normal[faces]
        T = np.zeros((len(kept), 4, 4), np.float32)
        T[:, :3, :3] = R
        T[:, :3, 3] = center - offset_m * normal - se3.rotate(R, hands.palm_point[hand])
        T[:, 3, 3] = 1.0
        clear = _hand_is_clear(T.astype(np.float64), hand, hands, robot, config.workplace)
        fits = np.zeros(len(rows), bool)
        fits[kept[clear]] = True
        return fits, (T[clear],)

    T_world_hand = np.zeros((len(ids), 4, 4), np.float32)
    rng.accepted(len(ids), propose, T_world_hand)
    return T_world_hand, None


@draws(RELEASE)
def _draw_palms(
    key: tuple[int, int],
    ids: NDArray[np.int64],
    hand_index: NDArray[np.int64],
    object_index: NDArray[np.int64],
    place: Place,
) -> Drawn:
    """Palms in the release's box (`palms.draw_palms`)."""
    offset = np.array([palms.reference_offset(o) for o in place.objects])[object_index]
    world, palm = palms.draw_palms(key, ids, offset)
    hands = place.hands
    n, a = hands.palm_normal[hand_index], hands.along[hand_index]
    R = _from_frames(world, np.stack([a, np.cross(n, a), n], 2))
    T = np.zeros((len(ids), 4, 4), np.float32)
    T[:, :3, :3], T[:, 3, 3] = R, 1.0
    T[:, :3, 3] = palm - se3.rotate(R, hands.palm_point[hand_index])
    return T, None


def _from_frames(world: Array, local: Array) -> Array:
    """R = world local^T of frames (n, 3, 3), in sums of a fixed order."""
    R = world[:, :, None, 0] * local[:, None, :, 0]
    for k in (1, 2):
        R = R + world[:, :, None, k] * local[:, None, :, k]
    return np.asarray(R)


@draws("r2h-v1")
@draws("r2h-v2")
def _draw_people(
    key: tuple[int, int],
    ids: NDArray[np.int64],
    hand_index: NDArray[np.int64],
    object_index: NDArray[np.int64],
    place: Place,
) -> Drawn:
    """People who reach: the first proposal in r2h-v0's reachable set (ball centre and palm), whose hand
    is clear as there, and whose arm is clear of the table and of the robot at home."""
    side = place.hands.side[hand_index]
    return receivers.draw_receivers(
        key, ids, side, _placing(hand_index, place), _table_edge_m(place.config)
    )


def _table_edge_m(config: EvalConfig) -> float:
    """x of the table's front edge."""
    at = config.workplace
    return round(at.table_center[0] + at.table_half[0], 6)


def _placing(hand_index: NDArray[np.int64], place: Place) -> receivers.PlaceHand:
    """Whether a proposal of a trial with these hands (n,) fits, as `receivers.draw_receivers` takes it."""
    hands, robot, config = place.hands, place.robot, place.config
    offset_m, at = config.thresholds.reach_offset_m, config.workplace

    def place_hand(
        people: receivers.Person, rows: NDArray[np.int64], number: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float32], receivers.Person]:
        hand, palm, placed = hand_index[rows], people.palm, np.ones(len(rows), bool)
        n, a = hands.palm_normal[hand], hands.along[hand]
        local = np.stack([a, n, np.cross(a, n)], 2)
        world = np.stack([people.hand, people.palm, np.cross(people.hand, people.palm)], 2)
        R = _from_frames(world, local)
        # of hands that were recorded with a person the arm is one that can have them
        if hands.in_body is not None:
            in_body = hands.in_body[hand]
            recorded_hand = recorded.recorded_in_world(people.facing, np.nan_to_num(in_body))
            has_arm = np.isfinite(in_body[:, 0, 3:]).any(1)
            with_arm = has_arm & (number < recorded.GIVEN_UP)
            until = recorded.GIVEN_UP * np.where(has_arm, 2, 1)
            known = np.isfinite(in_body[:, 0, 0]) & (number < until)
            R = np.where(known[:, None, None], recorded_hand[:, :, :3], R)
            palm = np.where(known[:, None], se3.rotate(R, n), palm)
            can = recorded.arm_can(people, hands.side[hand], se3.rotate(R, a), palm)
            placed = ~known | with_arm | can
            people = recorded.with_arms(people, recorded_hand[:, :, 3:], with_arm)
        center = (
            people.wrist
            + se3.rotate(R, hands.palm_point[hand] - hands.wrist[hand])
            + offset_m * palm
        )
        kept = np.flatnonzero(placed & _in_set(center, Room.of(robot)))
        kept = kept[_faces_robot_or_up(center[kept], palm[kept])]
        kept = kept[receivers.clear_of_torso(people.rows(kept))]
        kept = kept[_arm_is_clear(people.rows(kept), robot, at)]
        T = np.zeros((len(kept), 4, 4), np.float32)
        T[:, :3, :3], T[:, 3, 3] = R[kept], 1.0
        T[:, :3, 3] = people.wrist[kept] - se3.rotate(R[kept], hands.wrist[hand[kept]])
        clear = _hand_is_clear(T.astype(np.float64), hand[kept], hands, robot, at)
        fits = np.zeros(len(rows), bool)
        fits[kept[clear]] = True
        return fits, T[clear], people

    return place_hand


def _placing_people(hand_index: NDArray[np.int64], place: Place) -> receivers.PlaceHand:
    """`_placing` of people who do not overlap themselves: the receivers of r2h-v2, not those of r2h-v1, which is frozen."""
    hands = place.hands
    place_hand = _placing(hand_index, place)
    return off_the_torso(place_hand, hand_index, hands.vertices, hands.center, hands.radius)


def _in_set(center: Array, room: "Room") -> NDArray[np.bool_]:
    """Whether ball centres (n, 3) lie in the sector of a ring that r2h-v0 draws them from."""
    slope = round(math.tan(math.radians(SECTOR_DEG)), 12)
    x, y, z = center[:, 0], center[:, 1], center[:, 2]
    square = x * x + y * y
    ring = (square >= room.nearest_m**2) & (square <= room.farthest_m**2)
    ring &= np.abs(y) <= slope * x
    return np.asarray(ring & (z >= LOWEST_M) & (z <= room.highest_m))


def _arm_is_clear(people: receivers.Person, robot: Robot, at: Workplace) -> NDArray[np.bool_]:
    """Whether upper arm and forearm keep off table, arm and TCP at home, asked at points along
    them."""
    tcp, ends, radius = _home(robot, at.home_q)
    low, high = (
        np.round(np.array(at.table_center) + sign * np.array(at.table_half), 6) for sign in (-1, 1)
    )
    low, high = low - TABLE_ROOM_M, high + TABLE_ROOM_M
    clear = np.ones(len(people.wrist), bool)
    for points, thick in receivers.limbs(people):
        for k in range(points.shape[1]):
            x = points[:, k]
            clear &= from_box(low, high, x) >= thick**2
            clear &= from_segment(tcp, tcp, x) >= TCP_ROOM_M**2
            for (a, b), r in zip(ends, radius, strict=True):
                clear &= from_segment(a, b, x) >= (r + thick + ROBOT_ROOM_M) ** 2
    return clear


def _ball_center(u: Array, room: "Room") -> tuple[NDArray[np.bool_], Array]:
    """c_h (n, 3) uniform in a box, and whether it lies in the sector of a ring that the box
    encloses."""
    x_low = round(room.nearest_m * math.cos(math.radians(SECTOR_DEG)), 12)
    y_high = round(room.farthest_m * math.sin(math.radians(SECTOR_DEG)), 12)
    x = x_low + (room.farthest_m - x_low) * u[0]
    y = y_high * (2.0 * u[1] - 1.0)
    z = LOWEST_M + (room.highest_m - LOWEST_M) * u[2]
    center = np.stack([x, y, z], axis=1)
    return _in_set(center, room), center


def _faces_robot_or_up(center: Array, normal: Array) -> NDArray[np.bool_]:
    """Whether palm normals (n, 3) lie in the two cones, and not too far from the direction to the
    robot."""
    cone, away = (round(math.cos(math.radians(a)), 12) for a in (CONE_DEG, TURNED_AWAY_DEG))
    x, y = center[:, 0], center[:, 1]
    to_robot = -(normal[:, 0] * x + normal[:, 1] * y) / np.sqrt(x * x + y * y)
    return ((to_robot >= cone) | (normal[:, 2] >= cone)) & (to_robot >= away)


def _hand_is_clear(
    T_world_hand: Array, hand: NDArray[np.int64], hands: _Hands, robot: Robot, at: Workplace
) -> NDArray[np.bool_]:
    """Whether no vertex is near TCP, table or arm at home: the hand's bounding sphere first,
    vertices where needed."""
    tcp, ends, radius = _home(robot, at.home_q)
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
def _home(robot: Robot, home_q: tuple[float, ...]) -> tuple[Array, Array, Array]:
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


if set(_DRAWS) != set(PROTOCOL_NAMES):
    raise ValueError(
        f"registry.PROTOCOLS names {', '.join(PROTOCOL_NAMES)}; draws() must name each"
    )
