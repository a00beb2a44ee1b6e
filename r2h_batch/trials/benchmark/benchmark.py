"""A benchmark in memory: two with one digest ask the same of a method and judge it alike."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from functools import cache, cached_property
from typing import Literal, Self

import numpy as np

from r2h_batch.base.registry import (
    DEFAULT_PROTOCOL,
    PROTOCOL_NAMES,
    RELEASE,
    WITH_BODIES,
    WITH_FAMILIES,
)
from r2h_batch.base.validate import instance_of, optional
from r2h_batch.config import EvalConfig, Thresholds, Workplace
from r2h_batch.data.people import ALL, People, built_in_people, people_hand_set
from r2h_batch.scene.hand import HandSet, load_hand_set, neutral_hand_set
from r2h_batch.scene.objects import (
    INSTANCE_NAMES,
    ObjectModel,
    checked_objects,
    load_objects,
    without_region,
)
from r2h_batch.scene.robot import Robot, load_robot
from r2h_batch.trials.benchmark.trials_file import LISTED, Labels
from r2h_batch.types import Trials

RELEASE_S0 = (
    *("bottle", "bowl", "can", "cup"),
    *("dispenser", "eyeglasses", "game_controller", "headphones"),
)
RELEASE_S1 = (
    *("binoculars", "power_drill", "hammer", "knife"),
    *("pliers", "scissors", "screwdriver", "toothbrush"),
)
"""The release's own assumption: the paper does not say which objects each split has."""

RELEASE_HOME_Q = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
RELEASE_TABLE_CENTER, RELEASE_TABLE_HALF = (0.35, 0.0, -0.05), (0.65, 0.55, 0.035)
"""Its home and the table of its CPU planner, m: 15 mm below the base, and under the receiver."""

DECIDES = (
    *("name", "split", "instruction", "vertices", "faces", "face_part", "part_names"),
    *("receiver_face", "mass", "com", "inertia"),
)
"""Fields of an object from which its other fields follow. The convex pieces are not here: a sweep
makes them only where it needs them."""


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Objects, hands, the robot, limits and the place."""

    objects: tuple[ObjectModel, ...]
    hand_set: HandSet
    thresholds: Thresholds = field(default_factory=Thresholds)
    workplace: Workplace = field(default_factory=Workplace)
    listed: Trials | None = None
    """trials of its own (`trials_file.py`); None: the protocol draws them"""
    labels: Labels | None = None
    """what the owner of listed trials calls them; judges nothing, so the digest leaves it out"""
    drawn: str = DEFAULT_PROTOCOL
    """the protocol that draws trials: of `registry.PROTOCOLS`"""
    robot: Robot = field(default_factory=load_robot)
    persons: Literal["for-robot", "as-for-ur5e"] = "for-robot"
    """where persons stand: as the protocol places them for the robot's home and reach, or for the
    UR5e's"""
    receiver: Literal["hand", "body"] = "hand"
    """what planning and Safe see of the receiver, as `EvalConfig.receiver`"""
    people: People | None = None
    """who the receivers are; None: the protocol's own"""

    @property
    def protocol(self) -> str:
        """Source of the trials: the rule that draws them, or `listed`."""
        return self.drawn if self.listed is None else LISTED

    @property
    def has_bodies(self) -> bool:
        """Whether its trials have receivers with arm and torso."""
        if self.listed is not None:
            return self.listed.receiver is not None
        return self.drawn in WITH_BODIES

    def __post_init__(self) -> None:
        checked_objects(self.objects)
        if not self.objects:
            raise ValueError("a benchmark needs at least one object")
        if self.drawn not in PROTOCOL_NAMES:
            raise ValueError(
                f"Benchmark.drawn is {self.drawn!r}; allowed are {', '.join(PROTOCOL_NAMES)}"
            )
        if self.receiver not in ("hand", "body"):
            raise ValueError(f"Benchmark.receiver is {self.receiver!r}; allowed are hand, body")
        if self.receiver == "body" and not self.has_bodies:
            raise ValueError(
                f"receiver is body, trials of {self.protocol} have none; take {' or '.join(WITH_BODIES)}"
            )

        if self.people is not None and self.protocol not in WITH_BODIES:
            raise ValueError(
                f"people is {self.people.name}, trials of {self.protocol} have no body; take {' or '.join(WITH_BODIES)}"
            )

    @cached_property
    def digest(self) -> str:
        """sha256 (hex) over everything that decides what is asked and how it is judged, whatever
        file said it."""
        digest = hashlib.sha256(f"{self.protocol}\n{self.hand_set.digest}\n".encode())
        if self.receiver != "hand":  # benchmarks without this field keep their digest
            digest.update(f"receiver {self.receiver}\n".encode())
        if self.people is not None:
            digest.update(f"people {self.people.digest}\n".encode())
        if self.robot != load_robot():  # a folder may give another one its name
            digest.update(f"robot {self.robot.digest} {self.persons}\n".encode())
        # it says how hands stand in these trials
        if self.protocol in WITH_BODIES and self.hand_set.in_body is not None:
            digest.update(self.hand_set.in_body.contiguous().numpy().tobytes())
        for part in (self.thresholds, self.workplace):
            digest.update(json.dumps(asdict(part), sort_keys=True).encode())
        for o in self.objects:
            for name in DECIDES:
                value = np.ascontiguousarray(getattr(o, name))
                digest.update(f"{name}:{value.dtype.str}:{value.shape}:".encode() + value.tobytes())
            fields = {
                "grasps": None if o.grasps is None else o.grasps.digest,
                "roles": None if o.roles is None else dict(o.roles),
                "words": None if o.words is None else asdict(o.words),
            }
            if o.receiver_boxes is not None:  # what there was before keeps its digest
                fields["receiver_boxes"] = o.receiver_boxes.tolist()
            digest.update(json.dumps(fields, sort_keys=True).encode())
        if self.listed is not None:
            for name in ("trial_id", "object_index", "hand_index", "T_world_hand"):
                digest.update(getattr(self.listed, name).contiguous().numpy().tobytes())
        return digest.hexdigest()

    def on(self, robot: Robot, persons: Literal["for-robot", "as-for-ur5e"] = "for-robot") -> Self:
        """The same benchmark for another robot, which starts at its own home.

        With `persons` "for-robot" the table's sides are as long as that robot's reach asks for: it
        is to the UR5e's as the reaches are.
        """
        place = self.workplace
        if place.home_q == self.robot.home_q:
            place = replace(place, home_q=robot.home_q)
        if persons == "for-robot" and self.listed is None:
            place = place.scaled(robot.reach_m / self.robot.reach_m)
        return replace(self, robot=robot, persons=persons, workplace=place)

    def config(self, base: EvalConfig | None = None) -> EvalConfig:
        """`base` (default: `EvalConfig()`) with the benchmark's limits, table and home, and what it
        sees of the receiver.

        Raises ValueError where `base` has other limits or another place of its own: nobody could
        tell which were meant.
        """
        optional(instance_of(EvalConfig, "EvalConfig() or EvalConfig.preset(NAME)"))("config", base)
        base = self.robot.fitted(base or EvalConfig())
        usual = self.robot.fitted(EvalConfig())
        for name, own in (("thresholds", self.thresholds), ("workplace", self.workplace)):
            given = getattr(base, name)
            if given not in (getattr(usual, name), own):
                raise ValueError(f"config.{name} is {given}, the benchmark has {own}; say one")
        seen = base.receiver if self.receiver == "hand" else self.receiver
        return replace(base, thresholds=self.thresholds, workplace=self.workplace, receiver=seen)


@cache
def built_in(protocol: str = DEFAULT_PROTOCOL) -> Benchmark:
    """This package's own benchmark of a protocol.

    Args:
        protocol: `r2h-v0` and `r2h-v1`: 16 objects, 400 hands; `r2h-v2`: 96 instances of the same
            16 categories, 2,000 people with 400 hands of theirs; `r2h-release`: objects, two hands,
            table and home of the authors' release (docs/release.md).
    """
    if protocol in WITH_FAMILIES:
        # objects take turns in their order: categories first, then instances
        in_turn = sorted(INSTANCE_NAMES, key=lambda name: name.rpartition("_")[2])
        people = built_in_people(ALL)
        hands = people_hand_set(people)
        return Benchmark(load_objects(in_turn), hands, drawn=protocol, people=people)
    if protocol != RELEASE:
        return Benchmark(load_objects(), load_hand_set(), drawn=protocol)
    free = tuple(map(without_region, load_objects(RELEASE_S0)))
    place = Workplace(RELEASE_HOME_Q, RELEASE_TABLE_CENTER, RELEASE_TABLE_HALF)
    objects = (*free, *load_objects(RELEASE_S1))
    return Benchmark(objects, neutral_hand_set(), workplace=place, drawn=protocol)
