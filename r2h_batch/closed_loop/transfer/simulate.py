"""The transfer, tick by tick: sensor, policy, person and gripper, on any engine."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import rng
from r2h_batch.closed_loop.transfer.model import GRIPPER_S, TICK_S
from r2h_batch.closed_loop.transfer.outcome import (
    DROPPED_M,
    FACTOR,
    HELD_DEG,
    HELD_M,
    SHARES,
    STUCK_S,
    Book,
    Outcome,
)
from r2h_batch.closed_loop.transfer.person import BEGIN_S, KEY, LOST_DEG, LOST_M, Hands
from r2h_batch.closed_loop.transfer.release import Action, Observation, RobotSide
from r2h_batch.closed_loop.transfer.worlds import Seen, Told, Worlds

NOISE_N = 0.5
"""Noise of the wrist's sensor, one sigma an axis [choice]; a UR5e's own sensor is coarser."""
NEAR_N = NOISE_N
"""A decision by less than this, one sigma of a reading, is undecided."""
SLIDES_M = 0.002
"""An object that slides by more under a finger is simulated with half the step too."""
SENSOR_TICKS = 1
"""The policy sees the force this late."""
BACK = (0.2, 0.15, 0.10)
"""The robot backs off once the fingers have opened for so long (s), at this speed (m/s) and by so far (m): they stay
hooked in headphones otherwise."""
MOST_TICKS = 1200
"""No transfer lasts longer: 10 s. A soft arm that pulls a heavy object twice has given up before."""
POLL_TICKS = 32
"""On another device than the CPU the host asks this often whether all transfers are over."""
_UNIFORMS = 4


@dataclass(frozen=True, eq=False)
class Transfers:
    """Results of N transfers; NaN where something did not happen.

    Attributes:
        outcome: `Outcome` of each.
        other_end: half the step ends otherwise; False: it does not, or the row is not `halved`.
        surplus_n: by how much the policy's readings exceeded what lets go, the most of them until the fingers moved
            (`release.Action`). Also NaN: it let go while the hand had not pulled with its largest force yet.
        decided_s: from the beginning of the person's grip until the policy let go.
        release_share: share of the weight that the person carried when the policy let go.
        transfer_s: from the beginning of the person's grip until the gripper was free.
        share_s: (N, 3) when the share first passed 10, 50 and 90 %, from the beginning of the grip.
        pull_n: largest force of the person's arm along the pull, less what carries the weight, until the gripper was free.
        grip_n: largest grip of the person, one side.
        hand_n: largest force of the arm on the hand.
        slip_m: how far the object slipped in the hand, from the grip to the end.
        turn_deg: how far it turned.
        robot_slip_m: how far it slipped in the gripper before anybody gripped it.
        untouched_slip_m: the same before a hand or a finger touched it.
        time_s: simulated.
    """

    outcome: list[str]
    other_end: Bool[NDArray[np.bool_], " n"]
    surplus_n: Float64[NDArray[np.float64], " n"]
    decided_s: Float64[NDArray[np.float64], " n"]
    release_share: Float64[NDArray[np.float64], " n"]
    transfer_s: Float64[NDArray[np.float64], " n"]
    share_s: Float64[NDArray[np.float64], "n 3"]
    pull_n: Float64[NDArray[np.float64], " n"]
    grip_n: Float64[NDArray[np.float64], " n"]
    hand_n: Float64[NDArray[np.float64], " n"]
    slip_m: Float64[NDArray[np.float64], " n"]
    turn_deg: Float64[NDArray[np.float64], " n"]
    robot_slip_m: Float64[NDArray[np.float64], " n"]
    untouched_slip_m: Float64[NDArray[np.float64], " n"]
    time_s: Float64[NDArray[np.float64], " n"]

    @property
    def undecided(self) -> Bool[NDArray[np.bool_], " n"]:
        """Which outcomes hang on less than the model knows: half the step ends otherwise, or `near_limit`."""
        return self.other_end | self.near_limit

    @property
    def halved(self) -> Bool[NDArray[np.bool_], " n"]:
        """Which transfers are simulated with half the step too: after somebody had touched it, and did not grip, the object slid
        by more than `SLIDES_M` in the closed gripper, and nothing is `near_limit`."""
        slid = self.robot_slip_m - self.untouched_slip_m > SLIDES_M
        return slid & ~self.near_limit

    @property
    def near_limit(self) -> Bool[NDArray[np.bool_], " n"]:
        """Which outcomes hang on a number that is near its limit.

        A slip or a turn decides, and it is between a `FACTOR`th and `FACTOR` times of its limit. Or the policy let go, or did
        not, by less than `NEAR_N`: not where a hand had not pulled with its largest force yet, which would have gone on. Or the
        object hung on the opening fingers for a `FACTOR`th of `STUCK_S` or longer.
        """
        ends = np.array(self.outcome)
        held = [
            (self.slip_m < HELD_M * by) & (self.turn_deg < HELD_DEG * by)
            for by in (1 / FACTOR, FACTOR)
        ]
        in_hand = np.isin(ends, [Outcome.TAKEN, Outcome.BADLY_HELD]) & (held[0] != held[1])
        kept = np.isin(ends, [Outcome.BADLY_HELD, Outcome.NOT_RELEASED, Outcome.TORN_OUT])
        lost = np.isin(ends, [Outcome.DROPPED, Outcome.HAND_SLIPPED_OFF])
        far = (self.slip_m > LOST_M / FACTOR) | (self.turn_deg > LOST_DEG / FACTOR)
        out_of_hand = (kept & far) | (lost & (self.slip_m < LOST_M * FACTOR))
        hooked = self.transfer_s - self.decided_s > STUCK_S / FACTOR
        return np.asarray(
            _near(self.robot_slip_m, DROPPED_M)
            | _near(self.untouched_slip_m, DROPPED_M)
            | (np.abs(self.surplus_n) < NEAR_N)
            | in_hand
            | out_of_hand
            | hooked
            | (ends == Outcome.STUCK)
        )


def _near(x: Float64[NDArray[np.float64], " n"], limit: float) -> Bool[NDArray[np.bool_], " n"]:
    return (x > limit / FACTOR) & (x < limit * FACTOR)


def noise_of(
    trial_id: NDArray[np.int64], person: int, seed: int
) -> Float64[NDArray[np.float64], "t n 3"]:
    """Noise of the wrist's sensor at each tick, N: the same for every method, policy and batch.

    Sums of four uniforms: nearly normal, and the same bits on every machine.
    """
    count = MOST_TICKS * 3 * _UNIFORMS
    u = rng.uniforms(KEY, trial_id, count, purpose=2 + seed, attempt=person)
    sums = u.reshape(_UNIFORMS, MOST_TICKS, 3, len(trial_id)).sum(0) - _UNIFORMS / 2
    return np.ascontiguousarray(np.moveaxis(sums, 2, 1)) * (NOISE_N * np.sqrt(12 / _UNIFORMS))


def simulate(
    worlds: Worlds,
    hands: Hands,
    policy: Any,
    *,
    R_world_gripper: Float64[Tensor, "n 3 3"],
    com_closed: Float64[Tensor, "n 3"],
    noise: Float64[NDArray[np.float64], "t n 3"],
) -> Transfers:
    """Runs N transfers to their ends.

    Args:
        worlds, hands, R_world_gripper, com_closed, noise: as of `Running`.
        policy: makes the release policy, as a class of `release.POLICIES` does, or `own_release.maker_of`.
    """
    running = Running(
        worlds, hands, R_world_gripper=R_world_gripper, com_closed=com_closed, noise=noise
    )
    decides = policy(running.robot_side)
    while (seen := running.observe()) is not None:
        running.act(decides(seen))
    return _transfers(running.book)


class Running:
    """N transfers, tick by tick: `observe`, then `act`.

    Attributes:
        book: what has happened.
        robot_side: what release policies are made with.
    """

    def __init__(
        self,
        worlds: Worlds,
        hands: Hands,
        *,
        R_world_gripper: Float64[Tensor, "n 3 3"],
        com_closed: Float64[Tensor, "n 3"],
        noise: Float64[NDArray[np.float64], "t n 3"],
    ) -> None:
        """Args:
        worlds: with the gripper closed and the weight acting.
        hands: the persons.
        R_world_gripper: (N, 3, 3) orientation of the gripper.
        com_closed: (N, 3) centre of mass when the gripper had closed, frame gripper, m.
        noise: of the sensor, world axes, N.
        """
        seen = worlds.seen()
        self.worlds, self.hands = worlds, hands
        self.noise = torch.from_numpy(noise).to(seen.load)
        self.asks = 1 if seen.load.device.type == "cpu" else POLL_TICKS
        self.book = Book(seen, com_closed.to(seen.load), hands)
        self.robot_side = RobotSide(hands.weight, TICK_S)
        self._fingers = _Robot(R_world_gripper.to(seen.load))

    def observe(self) -> Observation | None:
        """The observation of release policies at this tick; None: all transfers are over."""
        seen, tick = self.worlds.seen(), self._fingers.tick
        if tick == MOST_TICKS:
            return None
        self.book.look(seen)
        if tick % self.asks == 0 and not bool(self.book.running.any()):
            return None
        return self._fingers.observes(seen, self.noise[tick])

    def act(self, action: Action) -> None:
        """Robots and persons act, and the worlds go on by a tick."""
        book, seen = self.book, self.worlds.seen()
        book.decide(action.open, action.surplus_n)
        acts = self.hands.act(seen, book.released, book.lost)
        effort, shift = self._fingers.moves(action, book)
        told = Told(effort, shift, acts.hand, acts.friction, acts.push)
        self.worlds.step(told, book.running)


class _Robot:
    """Sensor, gripper and wrist of N robots."""

    def __init__(self, R_world_gripper: Float64[Tensor, "n 3 3"]) -> None:
        self.R, self.tick = R_world_gripper, 0
        self.late: list[Tensor] = []

    def observes(self, seen: Seen, noise: Float64[Tensor, "n 3"]) -> Observation:
        """The policies' observation now."""
        force = _rotate(self.R, seen.load) + noise
        self.late = [*self.late[-SENSOR_TICKS:], force]
        now = Observation(self.tick * TICK_S, self.late[0], _rotate(self.R, seen.shifted))
        self.tick += 1
        return now

    def moves(
        self, action: Action, book: Book
    ) -> tuple[Float64[Tensor, " n"], Float64[Tensor, "n 3"]]:
        """Effort of the fingers, and shift of the wrist in the gripper's frame."""
        since = book.time_s - book.decided_s - GRIPPER_S  # -inf: not decided
        squeeze = torch.ones_like(since) if action.squeeze is None else action.squeeze
        opens = since >= 0.0
        effort = torch.where(opens, -1.0, squeeze.clamp(0.0, 1.0))
        back = ((since - BACK[0]) * BACK[1]).clamp(0.0, BACK[2])
        shift = torch.zeros_like(self.R[:, 0])
        if action.shift is not None:
            shift = torch.where(opens[:, None], 0.0, _rotate(self.R.transpose(1, 2), action.shift))
        shift[:, 2] = torch.where(opens, -back, shift[:, 2])
        return effort, shift


def _rotate(R: Float64[Tensor, "n 3 3"], v: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3"]:
    return R[:, :, 0] * v[:, :1] + R[:, :, 1] * v[:, 1:2] + R[:, :, 2] * v[:, 2:]


def _transfers(book: Book) -> Transfers:
    def happened(when: Tensor) -> NDArray[np.float64]:
        return here(torch.where(when.isfinite(), when, torch.nan))

    def here(x: Tensor) -> NDArray[np.float64]:
        return x.cpu().numpy()

    return Transfers(
        book.outcomes(),
        np.zeros(len(book.code), bool),
        happened(book.surplus_n),
        happened(book.decided_s - BEGIN_S),
        here(book.release_share),
        happened(book.released_s - BEGIN_S),
        np.stack([happened(book.passed_s[k]) for k in range(len(SHARES))], 1),
        here(book.pull_n),
        here(book.grip_n),
        here(book.hand_n),
        here(book.slip_m),
        np.array(book.turn_deg()),
        here(book.robot_slip_m),
        here(book.untouched_slip_m),
        here(book.ended_s),
    )
