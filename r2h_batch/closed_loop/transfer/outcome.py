"""How a transfer ends, and what is measured on the way."""

import math
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.closed_loop.transfer.model import GRIPPER_S, TICK_S
from r2h_batch.closed_loop.transfer.person import (
    BEGIN_S,
    FINGER_S,
    KEEP_S,
    LOST_DEG,
    LOST_M,
    Does,
    Hands,
)
from r2h_batch.closed_loop.transfer.worlds import Seen

FACTOR = 2.0
"""How far a thing slides or turns once friction has given way is known to this factor [choice]. An end at more than a `FACTOR`th
of its limit and less than `FACTOR` times of it is undecided."""
DROPPED_M = 0.03
"""An object that slips by more in the closed gripper, before anybody touches it, is dropped by the robot. It is watched until it
has slipped by `FACTOR` times as much, or somebody grips it."""
HELD_M, HELD_DEG = 0.02, 30.0
"""Taken: slipped and turned by less in the person's hand."""
FREE_TICKS = 4
"""The gripper is free when no pad has touched the object for so many ticks: 33 ms."""
SLIPPED_OFF_S, STUCK_S, AFTER_TOUCH_S = 0.3, 1.5, 0.3
SHARES = (0.1, 0.5, 0.9)


class Outcome(StrEnum):
    """How a transfer ends."""

    NOT_RECEIVED = "not_received"
    ROBOT_DROPPED = "robot_dropped"
    TAKEN = "taken"
    BADLY_HELD = "badly_held"
    DROPPED = "dropped"
    TORN_OUT = "torn_out"
    HAND_SLIPPED_OFF = "hand_slipped_off"
    NOT_RELEASED = "not_released"
    STUCK = "stuck"
    KEPT = "kept"
    FALSE_RELEASE = "false_release"
    EXPLODED = "exploded"


MEANINGS = {
    Outcome.NOT_RECEIVED: "reception found no grasp, so nobody takes it",
    Outcome.ROBOT_DROPPED: "slips by more than 3 cm in the closed gripper, untouched or touched by a finger",
    Outcome.TAKEN: "in the hand, slipped by less than 2 cm and turned by less than 30 degrees",
    Outcome.BADLY_HELD: "in the hand, but slipped or turned by more",
    Outcome.DROPPED: "the gripper let go, and the hand lost it",
    Outcome.TORN_OUT: "free although the policy did not let go",
    Outcome.HAND_SLIPPED_OFF: "the hand lost it, the gripper still holds it",
    Outcome.NOT_RELEASED: "the policy did not let go, the person gave up",
    Outcome.STUCK: "the policy let go, but the object is hooked on the fingers",
    Outcome.KEPT: "the robot kept it under a mere touch, or while nobody came",
    Outcome.FALSE_RELEASE: "the policy let go under a mere touch, or while nobody came",
    Outcome.EXPLODED: "the simulation failed; counts as no result",
}
"""Meaning of each outcome, in the order of the tables."""
_COS_LOST, _COS_HELD = (math.cos(math.radians(x / 2)) for x in (LOST_DEG, HELD_DEG))
_CODES = {outcome: k for k, outcome in enumerate(Outcome)}


class Book:
    """Keeps what happens to N transfers, and says how they end.

    Attributes:
        running: (N,) bool, not yet decided.
        released: (N,) bool, the gripper no longer holds the object.
        lost: (N,) bool, the object is out of the hand.
        slipping: (N,) bool, slipped by more than `DROPPED_M` in the gripper.
        decided_s: (N,) when the policy let go; inf: not yet.
    """

    def __init__(self, seen: Seen, com_closed: Float64[Tensor, "n 3"], hands: Hands) -> None:
        self.hands = hands
        self.com_closed = com_closed
        no = torch.zeros_like(seen.touching)
        self.running = ~no
        self.code = torch.full_like(no, -1, dtype=torch.int64)
        self.apart = torch.zeros_like(self.code)
        self.released, self.lost, self.slipping = (no.clone() for _ in range(3))
        never = torch.full_like(no, torch.inf, dtype=torch.float64)
        self.decided_s, self.released_s, self.lost_s = (never.clone() for _ in range(3))
        self.passed_s = [never.clone() for _ in SHARES]
        zero = torch.zeros_like(never)
        self.pull_n, self.hand_n, self.grip_n = (zero.clone() for _ in range(3))
        self.slip_m, self.robot_slip_m, self.ended_s = (zero.clone() for _ in range(3))
        self.untouched_slip_m = zero.clone()
        self.turn_cos = zero + 1.0
        """Cosine of half the turn: an arc cosine would not have the same bits in every batch."""
        self.release_share = torch.full_like(zero, torch.nan)
        self.surplus_n = -never
        self.slip_before = seen.slip.clone()
        self.tick = 0

    @property
    def time_s(self) -> float:
        """Since the weight acts and nobody touches."""
        return self.tick * TICK_S

    def look(self, seen: Seen) -> None:
        """Measures the state of a tick, and decides what is over."""
        t, hands, run = self.time_s, self.hands, self.running
        grips = run & (hands.does >= int(Does.GRIPS))
        touched = t >= BEGIN_S
        if not touched:
            self.slip_before = seen.slip.clone()
        if not touched or not hands.scenario.grips:
            slipped = _distance(seen.com - seen.shifted, self.com_closed)
            before = run & self.decided_s.isinf() if touched else run
            self.robot_slip_m = torch.where(before, slipped, self.robot_slip_m)
            if not touched:
                self.untouched_slip_m = self.robot_slip_m
            self.slipping = self.slipping | (before & (slipped > DROPPED_M))
        self._share = 1.0 + _dot(seen.load, hands.up) / hands.weight
        for share, when in zip(SHARES, self.passed_s, strict=True):
            new = grips & (self._share > share) & when.isinf()
            when[new] = t - BEGIN_S
        slip = _distance(seen.slip[:, :3], self.slip_before[:, :3])
        turn_cos = _half_turn(seen.slip[:, 3:], self.slip_before[:, 3:])
        self.slip_m = torch.where(grips, slip, self.slip_m)
        self.turn_cos = torch.where(grips, turn_cos, self.turn_cos)
        pull = _dot(seen.arm - hands.support, hands.along)
        self.pull_n = torch.where(grips & ~self.released, self.pull_n.maximum(pull), self.pull_n)
        self.hand_n = torch.where(grips, self.hand_n.maximum(_size(seen.arm)), self.hand_n)
        self.grip_n = torch.where(grips, self.grip_n.maximum(hands.grip_n / 2), self.grip_n)
        self.apart = torch.where(seen.touching, 0, self.apart + 1)
        free = run & touched & (self.apart >= FREE_TICKS) & ~self.released
        self.released = self.released | free
        self.released_s[free] = t - (FREE_TICKS - 1) * TICK_S
        gripped = hands.scenario.grips & (t >= BEGIN_S + hands.load_s)
        gone = run & gripped & ((slip > LOST_M) | (turn_cos < _COS_LOST)) & ~self.lost
        self.lost = self.lost | gone
        self.lost_s[gone] = t
        self._end(seen)
        self.tick += 1

    def decide(
        self, opens: Bool[Tensor, " n"], surplus_n: Float64[Tensor, " n"] | None = None
    ) -> None:
        """Notes where the policy lets go at this tick, and by how much (`release.Action`)."""
        new = self.running & opens & self.decided_s.isinf()
        if surplus_n is not None:
            waits = self.running & (self.time_s - self.decided_s < GRIPPER_S)
            most = self.surplus_n.maximum(surplus_n)
            self.surplus_n = torch.where(waits, most, self.surplus_n)
            self.surplus_n[new & self.hands.pulls_on()] = torch.inf
        self.decided_s[new] = self.time_s
        self.release_share = torch.where(new, self._share, self.release_share)

    def _end(self, seen: Seen) -> None:
        t, does = self.time_s, self.hands.does
        decided = self.decided_s.isfinite()
        self._over(~seen.fine, Outcome.EXPLODED)
        far = self.robot_slip_m > DROPPED_M * FACTOR
        if t < BEGIN_S:
            self._over(far, Outcome.ROBOT_DROPPED)
            return
        if not self.hands.scenario.grips:
            over = torch.full_like(decided, t > BEGIN_S + FINGER_S + AFTER_TOUCH_S)
            self._over(self.slipping & (far | over | decided), Outcome.ROBOT_DROPPED)
            self._over(t - self.decided_s >= GRIPPER_S, Outcome.FALSE_RELEASE)
            self._over(self.released & ~decided, Outcome.ROBOT_DROPPED)
            self._over(over & ~decided, Outcome.KEPT)
            return
        self._over(self.slipping, Outcome.ROBOT_DROPPED)
        kept = self.released & (t - self.released_s > KEEP_S)
        gone = self.lost & (kept | (self.slip_m > LOST_M * FACTOR))
        self._over(self.released & gone, Outcome.DROPPED)
        well = (self.slip_m < HELD_M) & (self.turn_cos > _COS_HELD)
        self._over(kept & ~decided, Outcome.TORN_OUT)
        self._over(kept & well, Outcome.TAKEN)
        self._over(kept & ~well, Outcome.BADLY_HELD)
        alone = self.lost & ~decided & ~self.released
        self._over(alone & (t - self.lost_s > SLIPPED_OFF_S), Outcome.HAND_SLIPPED_OFF)
        waits = ~self.released & (t - self.decided_s > STUCK_S)
        self._over(waits, Outcome.STUCK)
        self._over((does == int(Does.GAVE_UP)) & ~decided & ~self.released, Outcome.NOT_RELEASED)

    def _over(self, when: Bool[Tensor, " n"], outcome: Outcome) -> None:
        new = self.running & when
        self.code[new] = _CODES[outcome]
        self.ended_s[new] = self.time_s
        self.running = self.running & ~when

    def turn_deg(self) -> list[float]:
        """How far the object has turned in the hand, of every transfer."""
        return [math.degrees(2.0 * math.acos(min(c, 1.0))) for c in self.turn_cos.tolist()]

    def outcomes(self) -> list[str]:
        """The outcome of every transfer."""
        names = [str(o) for o in Outcome]
        return [names[k] for k in self.code.tolist()]


def free_at(touching: Bool[NDArray[np.bool_], "t n"]) -> Int64[NDArray[np.int64], " n"]:
    """The tick at which `Book` finds N grippers free; T: never.

    Args:
        touching: (T, N) whether a pad touches the object.
    """
    before = np.ones_like(touching, shape=(FREE_TICKS - 1, touching.shape[1]))
    near = np.concatenate([before, touching])
    apart = sliding_window_view(~near, FREE_TICKS, axis=0).all(-1)
    free = apart & (np.arange(len(touching)) * TICK_S >= BEGIN_S)[:, None]
    return np.where(free.any(0), free.argmax(0), len(touching)).astype(np.int64)


def _dot(a: Tensor, b: Tensor) -> Float64[Tensor, " n"]:
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _size(v: Tensor) -> Float64[Tensor, " n"]:
    return _dot(v, v).sqrt()


def _half_turn(a: Tensor, b: Tensor) -> Float64[Tensor, " n"]:
    """Cosine of half the angle between quaternions."""
    return (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + (a[:, 2] * b[:, 2] + a[:, 3] * b[:, 3])).abs()


def _distance(a: Tensor, b: Tensor) -> Float64[Tensor, " n"]:
    return _size(a - b)
