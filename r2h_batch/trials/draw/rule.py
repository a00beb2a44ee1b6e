"""A rule that draws trials: which object is handed to which hand, and where that stands.

Trial i of S0 has the id 2 i, of S1 the id 2 i + 1. Objects of the split take turns, hands alternate right and left
(`base.schedule`), and the rule places the hand with random counters (rule, trial id, attempt): a trial is the same
alone or among a million, on any machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.base.schedule import assign_hands, assign_objects
from r2h_batch.config import Thresholds, Workplace
from r2h_batch.data.people import People
from r2h_batch.scene.hand import HandSet
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot
from r2h_batch.trials.draw.reachable_set import PosedHands, posed_hands
from r2h_batch.types import PERSON, Trials

POSE = 1
"""Purpose of the random counters of a hand's pose; `base.schedule` has 0, receivers and people 2 to 4."""
ROWS = 16384
"""Trials drawn at once."""


@dataclass(frozen=True, eq=False)
class Given:
    """What a rule draws from: fields of a `Benchmark` of these names."""

    objects: Sequence[ObjectModel]
    hand_set: HandSet
    people: People | None
    robot: Robot
    workplace: Workplace
    thresholds: Thresholds
    seed: str


@dataclass(frozen=True, eq=False)
class Batch:
    """Trials whose hands a rule is to place.

    Attributes:
        given: objects, hands, people, robot, table and home, limits.
        key: of the random counters.
        trial_id: (n,).
        side: (n,) sides of the hands that the schedule wants: 0 right, 1 left.
        hand_index: (n,) rows of the hand set.
        object_index: (n,) places among the objects.
    """

    given: Given
    key: tuple[int, int]
    trial_id: NDArray[np.int64]
    side: NDArray[np.int64]
    hand_index: NDArray[np.int64]
    object_index: NDArray[np.int64]

    @property
    def hands(self) -> PosedHands:
        """The hands as float64 arrays in their own frames."""
        return posed_hands(self.given.hand_set)


class Placed(NamedTuple):
    """Where the hands of a batch stand.

    Attributes:
        T_world_hand: (n, 4, 4), m.
        receiver: (n, 5, 4), as `Trials.receiver`; None: hands alone.
        hand_index: (n,) other hands than those of the batch; None: the same.
        person: (n, 6), as `Trials.person`; None: nobody of a table.
    """

    T_world_hand: NDArray[np.float32]
    receiver: NDArray[np.float32] | None = None
    hand_index: NDArray[np.int64] | None = None
    person: NDArray[np.float32] | None = None


def again(seed: str, redraws: int) -> str:
    """The seed of trials that were drawn again.

    Args:
        seed: of those that were not.
        redraws: how often.
    """
    return f"{seed} redraw {redraws}" if redraws else seed


@dataclass(frozen=True)
class Rule:
    """Draws the trials of a benchmark.

    Attributes:
        name: the `protocol` of stored runs.
        place: places the hands of a batch. A row may depend on nothing but its own trial. Raises `rng.NothingFits`
            where there is no place.
        bodies: whether receivers have arms and a torso.
        key: seeds the random counters together with `Benchmark.seed`, and stands in the benchmark's digest; empty: the name.
    """

    name: str
    place: Callable[[Batch], Placed]
    bodies: bool = False
    key: str = ""

    @property
    def draws_as(self) -> str:
        """What decides its draws: its key, or its name."""
        return self.key or self.name

    def draw(self, given: Given, trial_id: NDArray[np.int64], redraws: NDArray[np.int64]) -> Trials:
        """The trials of these ids, in this order, on the CPU.

        Args:
            given: objects, hands, people, robot and workplace.
            trial_id: (N,) int64, 0 or more.
            redraws: (N,) how often each trial was drawn again (`Benchmark.redraws`).

        Raises:
            ValueError: a trial's split has no object, or no hand fits table and home.
        """
        seed = f"{self.draws_as} {given.seed}" if given.seed else self.draws_as
        if not redraws.any():
            return self._drawn(given, trial_id, seed, 0)
        counts = np.unique(redraws).tolist()
        groups = [np.flatnonzero(redraws == k) for k in counts]
        parts = [
            self._drawn(given, trial_id[rows], again(seed, k), k)
            for k, rows in zip(counts, groups, strict=True)
        ]
        order = torch.from_numpy(np.argsort(np.concatenate(groups)))
        tensors = [p._tensors() for p in parts]
        return Trials(**{k: torch.cat([t[k] for t in tensors])[order] for k in tensors[0]})

    def _drawn(self, given: Given, trial_id: NDArray[np.int64], seed: str, redraws: int) -> Trials:
        """`draw` with the random counters of a seed; the object is as many turns on as there were redraws."""
        n, people = len(trial_id), given.people
        turn = trial_id + 2 * redraws  # of the same split
        object_index, side = assign_objects(turn, [o.split for o in given.objects])
        hand_index, sides = np.zeros(n, np.int64), posed_hands(given.hand_set).side
        T_world_hand = np.zeros((n, 4, 4), np.float32)
        receiver = np.zeros((n if self.bodies else 0, 5, 4), np.float32)
        person = np.zeros((0 if people is None else n, len(PERSON)), np.float32)
        for first in range(0, n, ROWS):
            rows = slice(first, first + ROWS)
            hand_index[rows] = assign_hands(trial_id[rows], side[rows], sides, seed)
            batch = Batch(
                given, rng.key_of(seed), trial_id[rows], side[rows], hand_index[rows], object_index[rows]
            )  # fmt: skip
            try:
                placed = self.place(batch)
            except rng.NothingFits as error:
                place = given.workplace
                raise ValueError(
                    f"no place for a hand where {self.name} draws them: {error}. Table (center {place.table_center}, half"
                    f" {place.table_half} m), arm at home or reach_offset_m leave none; change these, or list trials"
                ) from None
            T_world_hand[rows] = placed.T_world_hand
            for whole, part in (
                (receiver, placed.receiver), (hand_index, placed.hand_index), (person, placed.person),
            ):  # fmt: skip
                if part is not None:
                    whole[rows] = part
        return Trials(
            trial_id=torch.from_numpy(trial_id),
            object_index=torch.from_numpy(object_index.astype(np.int32)),
            hand_index=torch.from_numpy(hand_index.astype(np.int32)),
            T_world_hand=torch.from_numpy(T_world_hand),
            receiver=torch.from_numpy(receiver) if self.bodies else None,
            person=None if people is None else torch.from_numpy(person),
        )
