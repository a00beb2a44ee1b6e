"""The person's side: who takes the object, and what the hand does in each scenario.

A hand grips, takes the weight, pulls, waits, grips firmer and pulls again, and gives up. Every number here is an
input of the simulation, chosen from the sources of docs/transfer.md, and no finding.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng
from r2h_batch.closed_loop.transfer.handed import Handed
from r2h_batch.closed_loop.transfer.model import LEAST_FRICTION, TICK_S, Setting
from r2h_batch.closed_loop.transfer.worlds import Seen
from r2h_batch.trials.holding.capacity import AXES_SHARE, GRIP_BASE_N, GRIP_PER_WEIGHT

BEGIN_S = 0.15
"""Before that nobody touches the object, and policies tare."""
PRELOAD_S, LOAD_S, LOAD_S_PER_N = 0.15, 0.3, 0.046
"""The grip grows first alone, for `PRELOAD_S`; then the arm takes the weight while the grip grows on (people's rise side by
side: Johansson and Westling 1990). Either lasts `LOAD_S`, and longer for each newton of weight: with the sample of
Handovers@RPL, 0.8 kg taken from 10 to 90 % in 0.53 s [choice]."""
OLDER_FROM, OLDER_BY, OLDER_GRIP, OLDER_PAUSE_S = 50.0, 76.5, 2.0, 0.1
"""The grip grows firmer from this age, years, to so many times as firm at that age, and no further (Cole, Rotella and Harper
1999; twice, at 68 to 85 years: Cole and Beck 1994). The pause grows by so much (adjustments come 100 ms later: Cole, Rotella
and Harper 1999; to count them as a pause is a choice)."""
PULL_M_S, EARLY_PULL_M_S = 0.15, 0.3
PATIENCE_S, REST_S, BACK_FASTER, FIRMER, PULLS = 0.5, 0.4, 3.0, 1.25, 2
"""At the largest pull the person waits, then rests and lets the pull back, so many times as fast. Then the person grips
firmer by this factor and pulls again; after the last pull the person gives up."""
AWAY_M, KEEP_S = 0.25, 0.5
"""When the gripper lets go, the person goes on by so far. What then happens in the hand for so long decides."""
FELT_SHARE = 0.3
"""Share of the new reading that the felt force takes over in a tick."""
LOST_M, LOST_DEG = 0.05, 90.0
"""An object that slipped or turned by more in the hand is lost."""
FINGER_N_M, FINGER_S, FINGER_RAMP_S = 600.0, 0.7, 0.1
"""A finger that touches and does not grip: it comes forward by 1 cm and presses like a spring, so that it ends
where the object goes away. It stays for so long, and comes and goes within the ramp."""


Range: TypeAlias = tuple[float, float]
"""Ends of a uniform draw."""


@dataclass(frozen=True)
class Scenario:
    """A scenario: the person's behaviour, and the ranges that persons are drawn from (uniform).

    Attributes:
        grips: whether the hand grips; else a finger touches the object.
        finger_n: largest force of that finger, N; 0: nobody comes.
        early: whether the pull begins with the grip, not after the weight is taken.
        grip: factor of the usual grip and of its growth with the load.
        arm_n_m: stiffness of the arm, N/m (Mussa-Ivaldi et al. 1985: 100 to 400 at the hand).
        pull_n: largest pull, N.
        pause_s: between taking the weight and the pull, s, before an older person's is added.
        age: years, where the benchmark does not say it.
        most_grip_n: largest sum of normal forces, N: 40 N a side, as reception allows a digit.
    """

    grips: bool = True
    finger_n: float = 6.0
    early: bool = False
    grip: Range = (0.5, 2.0)
    arm_n_m: Range = (100.0, 600.0)
    pull_n: Range = (5.0, 25.0)
    pause_s: Range = (0.0, 0.5)
    age: Range = (18.0, 85.0)
    most_grip_n: float = 80.0


SCENARIOS = {
    "take": Scenario(),
    "touch": Scenario(grips=False),
    "nobody": Scenario(grips=False, finger_n=0.0),
    "pull-early": Scenario(early=True, pause_s=(0.0, 0.0)),
    "weak": Scenario(grip=(0.2, 0.5), pull_n=(3.0, 8.0), most_grip_n=30.0),
}
"""By their names in commands. weak: a hand without strength [choice]."""


@dataclass(frozen=True, eq=False)
class Persons:
    """N persons: one number of each for every transfer (`Scenario`)."""

    grip: Float64[NDArray[np.float64], " n"]
    arm_n_m: Float64[NDArray[np.float64], " n"]
    pull_n: Float64[NDArray[np.float64], " n"]
    pause_s: Float64[NDArray[np.float64], " n"]
    age: Float64[NDArray[np.float64], " n"]


def draw_persons(scenario: Scenario, handed: Handed, person: int, setting: Setting) -> Persons:
    """The persons of trials: the same draw for every method, policy and batch.

    Args:
        scenario: whose ranges.
        handed: N handovers. Ages that their benchmark says are not drawn.
        person: which person of each trial, 0, 1, ...
        setting: has factors of the ranges.
    """
    factors = {
        "grip": setting.grip,
        "arm_n_m": setting.arm_n_m,
        "pull_n": setting.pull_n,
        "pause_s": setting.pause_s,
        "age": 1.0,
    }
    u = rng.uniforms(KEY, handed.trial_id, len(factors), purpose=1, attempt=person)
    drawn = {}
    for (name, factor), x in zip(factors.items(), u, strict=True):
        low, high = getattr(scenario, name)
        drawn[name] = factor * (low + (high - low) * x)
    drawn["age"] = np.where(np.isnan(handed.age), drawn["age"], handed.age)
    return Persons(**drawn)


KEY = rng.key_of("transfer: persons and sensors")


class Does(IntEnum):
    """States of a person."""

    WAITS = 0
    GRIPS = 1
    PULLS = 2
    PERSISTS = 3
    RESTS = 4
    HAS = 5
    GAVE_UP = 6


@dataclass(frozen=True, eq=False)
class Acts:
    """Actions of N persons at a tick, frame gripper, float64.

    Attributes:
        hand: (N, 3) where the arm pulls the hand, from the grasp, m.
        friction: (N, 6) force (N) and moment (N m) at which the object slips in the hand.
        push: (N, 6) force of a finger that does not grip (N), and where it acts (m); None: the hand grips.
    """

    hand: Float64[Tensor, "n 3"]
    friction: Float64[Tensor, "n 6"]
    push: Float64[Tensor, "n 6"] | None


class Hands:
    """N persons' hands, tick by tick.

    Attributes:
        does: (N,) int64 `Does`.
        grip_n: (N,) sum of the normal forces of the grip now, N.
        support: (N, 3) the part of the arm's force that carries the weight, N.
        load_s: (N,) how long the arm takes to carry the weight, s.
        ready_s: (N,) when grip and load have grown, from the beginning of the grip, s.
    """

    def __init__(
        self,
        handed: Handed,
        scenario: Scenario,
        persons: Persons,
        setting: Setting,
        device: str = "cpu",
    ) -> None:
        """Args:
        handed: N handovers.
        scenario: what the persons do.
        persons: N persons.
        setting: what a study varies.
        device: of the tensors, the worlds' own.
        """

        def here(x: NDArray[np.float64]) -> Tensor:
            return torch.from_numpy(x).to(device)

        self.scenario = scenario
        older = ((persons.age - OLDER_FROM) / (OLDER_BY - OLDER_FROM)).clip(0.0, 1.0)
        self.arm_n_m, self.pull_n = here(persons.arm_n_m), here(persons.pull_n)
        self.grip = here(persons.grip * (1.0 + (OLDER_GRIP - 1.0) * older))
        self.pause_s = here(persons.pause_s + OLDER_PAUSE_S * older)
        self.weight = here(handed.weight_n * setting.mass)
        self.load_s = setting.load_time * (LOAD_S + LOAD_S_PER_N * self.weight)
        self.ready_s = PRELOAD_S + self.load_s
        self.up, self.along = here(-handed.down), here(handed.pull)
        self.usual = here(handed.total_n) * self.grip
        self.withstands = here(handed.capacity) * (AXES_SHARE * setting.skin_friction)
        R = np.swapaxes(handed.T_gripper_obj[:, :3, :3], 1, 2)
        off = handed.point - handed.T_gripper_obj[:, :3, 3]
        self.point, self.press = (here(np.einsum("nij,nj->ni", R, v)) for v in (off, handed.press))
        self.grip_n = torch.zeros_like(self.weight)
        self.support = torch.zeros_like(self.up)
        self.does = torch.zeros_like(self.weight, dtype=torch.int64)
        self.since, self.pulls = torch.zeros_like(self.does), torch.ones_like(self.does)
        self.firm = torch.ones_like(self.grip_n)
        self.pull_m, self.let_go_m, self.felt = (torch.zeros_like(self.grip_n) for _ in range(3))
        self.tick = 0
        self._met: Tensor | None = None

    def act(self, seen: Seen, released: Bool[Tensor, " n"], lost: Bool[Tensor, " n"]) -> Acts:
        """The persons' actions at this tick.

        Args:
            seen: the state.
            released: (N,) whether the gripper no longer holds the object.
            lost: (N,) whether the object is out of the hand.
        """
        if self.scenario.grips:
            self._decide(released)
            self._pull()
            made = Acts(self._target(lost), self._friction(seen, lost), None)
        else:
            still, slips = (
                torch.zeros_like(self.support),
                torch.full_like(self.withstands, LEAST_FRICTION),
            )
            made = Acts(still, slips, self._finger(seen))
        self.tick += 1
        return made

    def pulls_on(self) -> Bool[Tensor, " n"]:
        """(N,) whether a hand grips that has not pulled with its largest force yet: what it asks for still grows."""
        first = (self.does < int(Does.PERSISTS)) & (self.pulls == 1)
        return first & self.scenario.grips

    def _decide(self, released: Bool[Tensor, " n"]) -> None:
        """Goes on to the next state where it is time."""
        since_s = self.since * TICK_S
        most_m = self.pull_n / self.arm_n_m
        ready_s = 0.0 if self.scenario.early else self.ready_s + self.pause_s
        now, again = self.does, self.pulls < PULLS
        to = now.clone()

        def go(state: Does, when: Tensor, after: Does) -> None:
            to[(now == int(state)) & when] = int(after)

        go(Does.WAITS, since_s >= BEGIN_S - 1e-9, Does.GRIPS)
        go(Does.GRIPS, since_s >= ready_s, Does.PULLS)
        go(Does.PULLS, self.pull_m >= most_m, Does.PERSISTS)
        go(Does.PERSISTS, (since_s >= PATIENCE_S) & again, Does.RESTS)
        go(Does.PERSISTS, (since_s >= PATIENCE_S) & ~again, Does.GAVE_UP)
        go(Does.RESTS, since_s >= REST_S, Does.PULLS)
        holds = (now >= int(Does.GRIPS)) & (now <= int(Does.RESTS))
        to[holds & released] = int(Does.HAS)
        self.let_go_m = torch.where(holds & released, self.pull_m, self.let_go_m)
        firmer = (now == int(Does.RESTS)) & (to == int(Does.PULLS))
        self.firm = torch.where(firmer, self.firm * FIRMER, self.firm)
        self.pulls = self.pulls + firmer.long()
        self.since = torch.where(to == now, self.since + 1, 0)
        self.does = to

    def _pull(self) -> None:
        """Moves the arm's target along the pull."""
        step = (EARLY_PULL_M_S if self.scenario.early else PULL_M_S) * TICK_S
        most = torch.where(
            self.does == int(Does.HAS), self.let_go_m + AWAY_M, self.pull_n / self.arm_n_m
        )
        pulls = (self.does == int(Does.PULLS)) | (self.does == int(Does.HAS))
        rests = self.does == int(Does.RESTS)
        further = torch.minimum(self.pull_m + step, most)
        back = (self.pull_m - BACK_FASTER * step).clamp(min=0.0)
        self.pull_m = torch.where(pulls, further, torch.where(rests, back, self.pull_m))

    def _ramp(self, after_s: float) -> Float64[Tensor, " n"]:
        """0 to 1 while a person's grip is `after_s` to `after_s + load_s` old."""
        gripping = self.does >= int(Does.GRIPS)
        since_s = self.tick * TICK_S - BEGIN_S - after_s
        return torch.where(gripping, (since_s / self.load_s).clamp(0.0, 1.0), 0.0)

    def _target(self, lost: Bool[Tensor, " n"]) -> Float64[Tensor, "n 3"]:
        load = torch.where(lost, 0.0, self._ramp(PRELOAD_S))
        self.support = self.up * (load * self.weight)[:, None]
        return self.support / self.arm_n_m[:, None] + self.along * self.pull_m[:, None]

    def _friction(self, seen: Seen, lost: Bool[Tensor, " n"]) -> Float64[Tensor, "n 6"]:
        a = seen.arm
        force = (a[:, 0] * a[:, 0] + a[:, 1] * a[:, 1] + a[:, 2] * a[:, 2]).sqrt()
        self.felt = self.felt + FELT_SHARE * (force - self.felt)
        follows = (GRIP_BASE_N + GRIP_PER_WEIGHT * self.felt) * self.grip
        firm = (torch.maximum(self.usual, follows) * self.firm).clamp(max=self.scenario.most_grip_n)
        self.grip_n = torch.where(lost, 0.0, self._ramp(0.0) * firm)
        return (self.withstands * self.grip_n[:, None]).clamp(min=LEAST_FRICTION)

    def _finger(self, seen: Seen) -> Float64[Tensor, "n 6"]:
        """Force and place of a finger that presses like a spring on the object's point."""
        at = seen.p_obj + _turned(seen.R_obj, self.point)
        press = _turned(seen.R_obj, self.press)
        if self._met is None:
            self._met = at.clone()
        off = at - self._met
        gone = off[:, 0] * press[:, 0] + off[:, 1] * press[:, 1] + off[:, 2] * press[:, 2]
        age = self.tick * TICK_S - BEGIN_S
        share = min(max(min(age, FINGER_S - age) / FINGER_RAMP_S, 0.0), 1.0)
        force = (self.scenario.finger_n * share - FINGER_N_M * gone.clamp(min=0.0)).clamp(min=0.0)
        return torch.cat([press * force[:, None], at], 1)


def _turned(R: Float64[Tensor, "n 3 3"], v: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3"]:
    return R[:, :, 0] * v[:, :1] + R[:, :, 1] * v[:, 1:2] + R[:, :, 2] * v[:, 2:]
