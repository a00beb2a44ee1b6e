"""A benchmark: everything that decides what is asked of a method and how the answer is judged.

Two benchmarks with one digest ask the same and judge alike. `load_benchmark` makes the named ones and those of files.
"""

from __future__ import annotations

import hashlib
import json
import pickle
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import torch
from jaxtyping import Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.gone import gone
from r2h_batch.base.io.progress import busy
from r2h_batch.base.registry import LISTED
from r2h_batch.base.schedule import SEED, trial_ids
from r2h_batch.base.validate import (
    instance_of,
    integer,
    number,
    one_of,
    optional,
    sequence_of,
    suggest_names,
)
from r2h_batch.base.validate_tensors import check_tensor
from r2h_batch.config import MOST_HEAD_CLEARANCE_M, PRESENTED_M, EvalConfig, Thresholds, Workplace
from r2h_batch.data.people import People, people_hand_set
from r2h_batch.plugins import Registry
from r2h_batch.scene.hand import HandSet, load_hand_set
from r2h_batch.scene.objects import ObjectModel, checked_objects, load_objects
from r2h_batch.scene.person import MADE_OF
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.robot_file import DEFAULT_ROBOT, load_robot
from r2h_batch.trials.certified import (
    DRAWN_BEFORE,
    Answers,
    Certified,
    certified_of,
    load_certified,
)
from r2h_batch.trials.draw.rule import Given, Rule
from r2h_batch.trials.trials_file import Labels, listed_with_ids
from r2h_batch.types import Trials
from r2h_batch.verdicts import ASKED_NAMES, MAY_ASK, SPLITS, UNTIL

TRIALS = 500
"""Trials of a split in the published tables; more are the same rule run further."""
MOST_TRIALS = 10**9

DECIDES = (
    *("name", "split", "instruction", "vertices", "faces", "face_part", "part_names"),
    *("receiver_face", "mass", "com", "inertia"),
)
"""Fields of an object from which its other fields follow. The convex pieces are not here: a sweep
makes them only where it needs them."""


CERTIFIED_BY = ("pick", "received")
"""The criteria beside `CRITERIA` that the name of certificates knows: those of the first search. One that came later changes no
trial; answers that failed it were searched again."""

SEARCH: Registry[Callable[[Benchmark, NDArray[np.int64]], Certified]] = Registry(
    "search", modules=("r2h_batch.methods.certify",), names=("oracle",), light=True
)
"""Searches that certify trials of a benchmark, by name: (benchmark, ids ascending) -> `Certified`. A trial's certificate
depends on its own id alone. Trials know no method: the search's module is imported when a trial is asked for that no file
knows."""

WITH_PEOPLE = "r2h-v1 or r2h-v2"
"""Named benchmarks whose receivers have bodies, for messages."""


@dataclass(frozen=True, eq=False)
class Benchmark:
    """A frozen value: objects, hands, people, robot, workplace, thresholds, and the rule that draws trials.

    Attributes:
        objects: what `Trials.object_index` counts; those of a split take turns.
        hand_set: what `Trials.hand_index` counts.
        rule: draws the trials where none are listed.
        name: in messages and tables; the digest leaves it out.
        people: whose bodies and hands the receivers have; None: the rule's own.
        receiver: what planning and Safe see of the person: the hand, or arm, torso and head too.
        head_clearance_m: what robot and object keep from the head, m: planning, Safe and `body_m` see one that is larger by it.
            The person's own hand and arm may come nearer, also with the object. 0 where receiver is hand.
        robot: arm and gripper.
        persons: where persons stand: as the rule places them for the robot's home and reach, or for the UR5e's.
        thresholds: where a criterion turns from pass to fail.
        workplace: home and table.
        listed: trials of a file; None: the rule draws them.
        labels: what the owner of listed trials calls them; judges nothing, so the digest leaves it out.
        seed: 32 hexadecimal digits: the rule draws other trials. Empty: the published ones.
        asks: criteria beside those of all benchmarks: one of `MAY_ASK`. With pick the object rests on the table first; with
            presented the wanted part comes to the hand first; with received the person can take it in the end.
        certified: trials that were drawn again until they were known to have a whole way. Of another benchmark they say nothing.
    """

    objects: tuple[ObjectModel, ...]
    hand_set: HandSet
    rule: Rule
    name: str = "unnamed"
    people: People | None = None
    receiver: Literal["hand", "body"] = "hand"
    head_clearance_m: float = 0.0
    robot: Robot = field(default_factory=load_robot)
    persons: Literal["for-robot", "as-for-ur5e"] = "for-robot"
    thresholds: Thresholds = field(default_factory=Thresholds)
    workplace: Workplace = field(default_factory=Workplace)
    listed: Trials | None = None
    labels: Labels | None = None
    seed: str = ""
    asks: tuple[str, ...] = ()
    certified: Certified | None = None

    def __post_init__(self) -> None:
        instance_of(Rule, "a Rule of r2h_batch.trials.draw.rule")("rule", self.rule)
        instance_of(HandSet, "such as load_hand_set(FILE)")("hand_set", self.hand_set)
        instance_of(Robot, "such as load_robot(NAME)")("robot", self.robot)
        one_of("hand", "body")("receiver", self.receiver)
        object.__setattr__(self, "objects", checked_objects(self.objects))
        if not self.objects:
            raise ValueError("objects is empty; a benchmark needs at least one object")
        how = f"take a benchmark of people, such as {WITH_PEOPLE}"
        if self.receiver == "body" and not self.has_bodies:
            raise ValueError(f"receiver is body, trials of {self.protocol} have none; {how}")
        number(0, MOST_HEAD_CLEARANCE_M)("head_clearance_m", self.head_clearance_m)
        if self.receiver == "hand" and self.head_clearance_m:
            raise ValueError(
                f"head_clearance_m is {self.head_clearance_m:g} and receiver is hand, without a head; make it 0, or receiver body"
            )
        instance_of(str, "32 hexadecimal digits, or empty")("seed", self.seed)
        if self.seed and not re.fullmatch(SEED, self.seed):
            raise ValueError(
                f"seed is {self.seed!r:.60}; it must be 32 hexadecimal digits, or empty"
            )
        if self.seed and self.listed is not None:
            raise ValueError(
                "seed draws other trials, and these are listed; leave one of the two out"
            )
        allowed = f"some of {ASKED_NAMES} in this order, received with pick"
        instance_of(tuple, allowed)("asks", self.asks)
        if self.asks not in MAY_ASK:
            raise ValueError(f"asks is {self.asks!r:.60}; it must be {allowed}")
        if "received" in self.asks and not self.has_bodies:
            raise ValueError(
                f"asks names received, and trials of {self.protocol} have no body; {how}, or until('present')"
            )
        if self.people is not None and (self.listed is not None or not self.rule.bodies):
            raise ValueError(
                f"people is {self.people.name}, trials of {self.protocol} have no body; {how}"
            )

    @property
    def protocol(self) -> str:
        """Source of the trials: the rule that draws them, or `listed`."""
        return self.rule.name if self.listed is None else LISTED

    @property
    def has_bodies(self) -> bool:
        """Whether its trials have receivers with arm, torso and head."""
        return self.rule.bodies if self.listed is None else self.listed.receiver is not None

    @property
    def label(self) -> str:
        """`NAME@DIGEST`: what trials and predictions files carry."""
        return f"{self.name}@{self.digest}"

    @cached_property
    def digest(self) -> str:
        """sha256 (hex) over everything that decides what is asked and how it is judged, whatever
        file said it."""
        return self._redrawn(self._digest)

    def drawn_before(self) -> Self:
        """The same with its trials as r2h_batch 0.3 drew them."""
        name = DRAWN_BEFORE.get(self.protocol)
        if name is None or self.own_certified is None:
            return self
        return replace(self, certified=load_certified(name))

    def digests_before(self, asks: Sequence[str]) -> dict[str, tuple[str, ...]]:
        """The digests that earlier versions gave the trials of `drawn_before` -> what has changed since: `taken`, Received took
        the object where a simulated closing had put it; `head`, the person had none.

        Args:
            asks: what the benchmark asked for then; r2h_batch 0.3 knew a criterion more.
        """
        head = ("head",) if self._person_counts else ()
        found: dict[str, tuple[str, ...]] = {}
        then = replace(self.drawn_before(), head_clearance_m=0.0)
        if head:
            found[then._redrawn(then._digest_of(self._asks, person=""))] = head
        if "received" in self.asks:
            words = f"asks {' '.join(asks)}\n"
            found[then._redrawn(then._digest_of(words, person=""))] = ("taken", *head)
        return found

    def _redrawn(self, digest: str) -> str:
        """A digest of trials that are drawn once, with how often they were drawn again, and how the others are."""
        if (certified := self.own_certified) is None:
            return digest
        others = f" others {certified.search}" if certified.search else ""
        return hashlib.sha256(f"{digest} redrawn {certified.digest}{others}".encode()).hexdigest()

    @cached_property
    def undrawn_digest(self) -> str:
        """The digest of the same trials drawn once and judged by `CERTIFIED_BY`, with the objects as they lie in their own
        files: what certificates are for. It leaves out what a person is made of, which decides no draw."""
        own = tuple(o.who.own for o in self.objects)
        plain = replace(self, objects=own, asks=CERTIFIED_BY, certified=None, head_clearance_m=0.0)
        return plain._digest_of(plain._asks, person="")

    @cached_property
    def own_certified(self) -> Certified | None:
        """The certificates, where they are those of these trials."""
        certified = self.certified
        fits = certified is not None and certified.benchmark == self.undrawn_digest
        return certified if fits else None

    def _certified_of(self, trial_id: NDArray[np.int64]) -> Certified | None:
        """`own_certified`, with trials beyond it where they are searched for (`Certified.search`)."""
        own = self.own_certified
        if own is None or not own.search:
            return own
        return certified_of(
            own,
            trial_id[trial_id < 2 * MOST_TRIALS],  # a stream's trials are others
            head_clearance_m=self.head_clearance_m,
            search=lambda ids: SEARCH[own.search](self, ids),
        )

    def redraws(self, trial_id: NDArray[np.int64]) -> NDArray[np.int64]:
        """How often trials were drawn again until they were known to have a whole way. Where the benchmark searches trials
        that its file does not know, they are searched when they are asked for the first time.

        Args:
            trial_id: (n,) ids.

        Returns:
            (n,) 0 for trials that are as they were drawn first.
        """
        certified = self._certified_of(trial_id)
        return (
            np.zeros(len(trial_id), np.int64)
            if certified is None
            else certified.redraws_of(trial_id)
        )

    def certificates(self, trial_id: NDArray[np.int64]) -> Answers:
        """Answers that are known to solve trials, with the motion as planned; none where objects stand in other frames.

        Args:
            trial_id: (n,) ids.
        """
        certified = self._certified_of(trial_id)
        if certified is not None and not any(o.who.turn for o in self.objects):
            return certified.answers(trial_id)
        nothing = np.tile(np.eye(4, dtype=np.float32), (len(trial_id), 1, 1))
        return Answers(np.zeros(len(trial_id), bool), nothing, nothing)

    @cached_property
    def _digest(self) -> str:
        """`digest` of trials that are drawn once."""
        return self._digest_of(self._asks)

    @property
    def _person_counts(self) -> bool:
        """Whether verdicts depend on arm, torso and head: planning and Safe see them, or Received asks about them."""
        return self.receiver == "body" or "received" in self.asks

    @property
    def _asks(self) -> str:
        """What it asks for beside what all benchmarks ask, in the digest's words."""
        asks = f"asks {' '.join(self.asks)}\n" if self.asks else ""
        if "received" in self.asks:  # where it is held, by geometry
            asks += "received where it is held\n"
        if "presented" in self.asks:
            sharp = {o.name: o.sharp for o in self.objects if o.sharp}
            asks += f"presented {json.dumps([PRESENTED_M, sharp], sort_keys=True)}\n"
        return asks

    def _digest_of(self, asks: str, *, person: str | None = None) -> str:
        """`_digest` with what the benchmark asks for in these words, and with a person who is made of that; None: as today."""
        drawn = self.rule.draws_as if self.listed is None else LISTED
        digest = hashlib.sha256(f"{drawn}\n{self.hand_set.digest}\n".encode())
        if self.receiver != "hand":  # benchmarks without this field keep their digest
            digest.update(f"receiver {self.receiver}\n".encode())
        if self._person_counts:
            digest.update((MADE_OF if person is None else person).encode())
        if self.head_clearance_m:
            digest.update(f"head_clearance_m {float(self.head_clearance_m)!r}\n".encode())
        digest.update(asks.encode())
        if self.seed:
            digest.update(f"seed {self.seed}\n".encode())
        if self.people is not None:
            digest.update(f"people {self.people.digest}\n".encode())
        if self.robot != load_robot():  # a folder may give another one its name
            digest.update(f"robot {self.robot.digest} {self.persons}\n".encode())
        # it says how hands stand in these trials
        if self.listed is None and self.rule.bodies and self.hand_set.in_body is not None:
            digest.update(self.hand_set.in_body.contiguous().numpy().tobytes())
        for part in (self.thresholds, self.workplace):
            digest.update(json.dumps(asdict(part), sort_keys=True).encode())
        for o in self.objects:
            for name in DECIDES:
                value = np.ascontiguousarray(getattr(o, name))
                digest.update(f"{name}:{value.dtype.str}:{value.shape}:".encode() + value.tobytes())
            said = {
                "grasps": None if o.grasps is None else o.grasps.digest,
                "roles": None if o.roles is None else dict(o.roles),
                "words": None if o.words is None else asdict(o.words),
            }
            if o.receiver_boxes is not None:  # what there was before keeps its digest
                said["receiver_boxes"] = o.receiver_boxes.tolist()
            digest.update(json.dumps(said, sort_keys=True).encode())
        if self.listed is not None:
            for name in ("trial_id", "object_index", "hand_index", "T_world_hand"):
                digest.update(getattr(self.listed, name).contiguous().numpy().tobytes())
            if self.listed.receiver is not None and self._person_counts and person is None:
                digest.update(self.listed.receiver.contiguous().numpy().tobytes())
        return digest.hexdigest()

    @suggest_names
    def trials(self, trials: int = TRIALS, *, splits: Sequence[str] | str = SPLITS) -> Trials:
        """The first trials of each split, split by split, on the CPU.

        Args:
            trials: number of trials of each split; of listed trials at most as many as there are.
            splits: `S0` (free), `S1` (functional), or both.

        Returns:
            Trials that know the names of their objects and whose they are (`Trials.benchmark`).

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
        if self.listed is not None:
            of_split = (
                torch.nonzero(self.listed.trial_id % 2 == SPLITS.index(s))[:trials, 0]
                for s in splits
            )
            return self._own(self.listed[torch.cat([*of_split])])
        plan = dict.fromkeys(splits, trials)
        ids = trial_ids(plan, 0, sum(plan.values()))
        return self.trials_with_ids(torch.from_numpy(ids))

    @busy("drawing trials")
    def trials_with_ids(self, trial_id: Int64[Tensor, " n"]) -> Trials:
        """The trials of these ids, in this order, on the CPU.

        Args:
            trial_id: (N,) int64: 2 i is trial i of S0, 2 i + 1 of S1.

        Raises:
            TypeError, ValueError: no such tensor, an id is negative, or (listed trials) not there.
        """
        trial_id = check_tensor("trial_id", trial_id, "a torch tensor (N,) of torch.int64")
        if trial_id.ndim != 1 or trial_id.dtype != torch.int64:
            raise TypeError(
                f"trial_id is {trial_id.dtype} {tuple(trial_id.shape)}; it must be a torch tensor (N,) of torch.int64"
            )
        ids = trial_id.cpu().numpy().copy()
        if len(ids) and ids.min() < 0:
            raise ValueError(f"trial id {ids.min()} is negative; ids are 2 i (S0) and 2 i + 1 (S1)")
        if self.listed is not None:
            return self._own(listed_with_ids(self.listed, trial_id))
        placing = self
        if self.persons == "as-for-ur5e":
            placing = self.on(load_robot(DEFAULT_ROBOT), self.persons)
        given = Given(
            placing.objects, placing.hand_set, placing.people, placing.robot, placing.workplace, placing.thresholds, placing.seed
        )  # fmt: skip
        return self._own(self.rule.draw(given, ids, placing.redraws(ids)))

    def _own(self, trials: Trials) -> Trials:
        return trials.named(self.objects, benchmark=self.label)

    def on(self, robot: Robot, persons: Literal["for-robot", "as-for-ur5e"] = "for-robot") -> Self:
        """The same benchmark for another robot, which starts at its own home.

        Args:
            robot: such as `load_robot(NAME)`.
            persons: where persons stand. "for-robot": the table grows with the robot's reach, and they with it.
                "as-for-ur5e": where they stand for the UR5e.
        """
        instance_of(Robot, "such as load_robot(NAME)")("robot", robot)
        one_of("for-robot", "as-for-ur5e")("persons", persons)
        place = self.workplace
        if place.home_q == self.robot.home_q:
            place = replace(place, home_q=robot.home_q)
        if persons == "for-robot" and self.listed is None:
            place = place.scaled(robot.reach_m / self.robot.reach_m)
        return replace(self, robot=robot, persons=persons, workplace=place)

    def with_objects(self, objects: Sequence[ObjectModel]) -> Self:
        """The same benchmark with other objects.

        Args:
            objects: in the order of `Trials.object_index`.

        Raises:
            ValueError: none, or two of one name; or trials are listed, which index other objects.
        """
        if self.listed is not None:
            raise ValueError(f"{self.name} lists trials of its own objects; list trials of others")
        return replace(self, objects=checked_objects(objects))

    def with_seed(self, seed: str) -> Self:
        """The same benchmark with other trials of its rule.

        Args:
            seed: 32 hexadecimal digits; empty: the published trials.

        Raises:
            ValueError: it is something else, or trials are listed.
        """
        return replace(self, seed=seed)

    def until(self, stage: str) -> Self:
        """The same benchmark that ends earlier: nobody is asked to take the object. The trials are the same, the digest is
        another one.

        Args:
            stage: `present`: with the arm at rest; `received`: with the reception.

        Raises:
            ValueError: it is another word, or the benchmark does not ask for so much.
        """
        last = one_of(*UNTIL)("stage", stage) == UNTIL[-1]
        needs = ("pick", "received") if last else ("pick",)
        if not set(needs) <= set(self.asks):
            raise ValueError(
                f"{self.name} asks for {', '.join(self.asks) or 'none of these'}; until {stage!r} needs {', '.join(needs)}"
            )
        return replace(self, asks=tuple(a for a in self.asks if last or a != "received"))

    def with_people(self, people: People) -> Self:
        """The same benchmark with other receivers, and hands of theirs.

        Args:
            people: such as `built_in_people(WORD)`; the hand set is made of them.

        Raises:
            ValueError: its receivers have no body.
        """
        instance_of(People, "such as built_in_people(WORD)")("people", people)
        return replace(self, people=people, hand_set=people_hand_set(people))

    def config(self, base: EvalConfig | None = None) -> EvalConfig:
        """The configuration `base` with the benchmark's limits, table and home, and what it sees of the receiver.

        Args:
            base: how one judges: planning, motion, engine. None: `EvalConfig()`.

        Raises:
            ValueError: `base` has other limits or another place of its own: nobody could tell which were meant.
        """
        optional(instance_of(EvalConfig, "EvalConfig() or EvalConfig.preset(NAME)"))("base", base)
        base = self.robot.fitted(base or EvalConfig())
        usual = self.robot.fitted(EvalConfig())
        for name, own in (("thresholds", self.thresholds), ("workplace", self.workplace)):
            given = getattr(base, name)
            if given not in (getattr(usual, name), own):
                how = f"dataclasses.replace(benchmark, {name}=...) is a benchmark with others"
                raise ValueError(f"config.{name} is {given}, {self.name} has {own}; say one: {how}")
        seen = base.receiver if self.receiver == "hand" else self.receiver
        return replace(base, thresholds=self.thresholds, workplace=self.workplace, receiver=seen)

    def __repr__(self) -> str:
        counts = ", ".join(
            f"{sum(o.split == s for o in self.objects)} objects of {s}" for s in SPLITS
        )
        who = "hands alone" if not self.has_bodies else f"receiver {self.receiver}"
        return f"Benchmark({self.name}: {counts}, {len(self.hand_set)} hands, {who}, {self.robot.name})"

    if not TYPE_CHECKING:  # else any name would pass

        def __getattr__(self, name: str) -> Any:
            if told := gone(f"Benchmark.{name}"):
                raise AttributeError(told)
            return object.__getattribute__(self, name)  # says that there is none

    def __reduce__(self) -> tuple[Any, ...]:
        """Stored objects and the built-in hands travel by name, all else as bytes: torch sends a tensor to a loader's spawned
        worker by moving its memory, and then what was made of it here (views in numpy, tables of kernels) would read memory that
        is freed."""
        stored = {id(o): o.name for o in self.objects if o is _stored(o.name)}
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values["objects"] = tuple(stored.get(id(o), o) for o in self.objects)
        if self.hand_set is _hands_of(self.people):
            values["hand_set"] = None
        return _unpickled, (pickle.dumps((type(self), values)),)

    def __copy__(self) -> Self:
        """Itself: a benchmark does not change."""
        return self

    def __deepcopy__(self, memo: Any) -> Self:
        """Itself: a benchmark does not change."""
        return self


def _stored(name: str) -> ObjectModel | None:
    try:
        return load_objects([name])[0]
    except ValueError:
        return None


def _hands_of(people: People | None) -> HandSet:
    """The built-in hands of people, or of nobody in particular."""
    return load_hand_set() if people is None else people_hand_set(people)


def _unpickled(state: bytes) -> Benchmark:
    cls, values = pickle.loads(state)
    objects = (load_objects([o])[0] if isinstance(o, str) else o for o in values["objects"])
    hand_set = values["hand_set"] or _hands_of(values["people"])
    found: Benchmark = cls(**{**values, "objects": tuple(objects), "hand_set": hand_set})
    return found


def trials_digest(trials: Trials) -> str:
    """sha256 (hex) over ids, object names, hand indices, and the bytes of the hand poses and of the receivers."""
    instance_of(Trials, "benchmark.trials(...)")("trials", trials)
    digest = hashlib.sha256(b"r2h-v0\n" if trials.receiver is None else b"r2h-v1\n")
    digest.update(trials.trial_id.cpu().numpy().astype("<i8").tobytes())
    digest.update("\n".join(trials.object_names).encode())
    digest.update(trials.hand_index.cpu().numpy().astype("<i4").tobytes())
    digest.update(trials.T_world_hand.cpu().contiguous().numpy().astype("<f4").tobytes())
    if trials.receiver is not None:
        digest.update(trials.receiver.cpu().contiguous().numpy().astype("<f4").tobytes())
    return digest.hexdigest()
