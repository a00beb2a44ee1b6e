"""When the gripper lets go: policies that see the wrist's force sensor 120 times a second.

A policy is a class that is made for a batch of transfers, `Policy(robot)`, and then called with an observation at
each tick. It says an `Action` for every row. The built-in ones compute each row by itself, so that a row does not
depend on its batch.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.plugins import Registry
from r2h_batch.trials.holding.held_out import G

POLICIES: Registry[Any] = Registry("release policy")
"""By their names in commands: classes of this file, and of packages that name `release_policy.NAME`."""

TARE_TICKS = 12
"""Readings whose mean is the load before anybody touches: 0.1 s."""
SMOOTH_TICKS = 6


@dataclass(frozen=True, eq=False)
class RobotSide:
    """The robot's knowledge before a transfer.

    Attributes:
        weight_n: (N,) weight of each object as the robot was told, N.
        tick_s: time between two observations.
    """

    weight_n: Float64[Tensor, " n"]
    tick_s: float


@dataclass(frozen=True, eq=False)
class Observation:
    """The robot's sensors at a tick, world axes.

    Attributes:
        time_s: since the first tick.
        force: (N, 3) load on the wrist, N, with the sensor's noise and latency; z is minus the weight while
            nobody touches the object.
        shifted: (N, 3) how far the robot's hand is from the handover pose, m.
    """

    time_s: float
    force: Float64[Tensor, "n 3"]
    shifted: Float64[Tensor, "n 3"]


@dataclass(frozen=True, eq=False)
class Action:
    """The gripper's and the arm's motion.

    Attributes:
        open: (N,) let go now; the first True counts.
        surplus_n: (N,) by how much the readings exceed what lets go, N; negative: they fall short of it. It marks what hangs
            on the sensor's noise (`simulate.Transfers.undecided`); None: the policy does not say, and no row is
            undecided for how near its decision was.
        squeeze: (N,) effort of the fingers until then, share of the largest, 0 to 1; None: 1.
        shift: (N, 3) where the robot moves its hand, from the handover pose, world axes, m; None: nowhere.
    """

    open: Bool[Tensor, " n"]
    squeeze: Float64[Tensor, " n"] | None = None
    shift: Float64[Tensor, "n 3"] | None = None
    surplus_n: Float64[Tensor, " n"] | None = None


class Tared:
    """A policy that reads the change of the load: the mean of the last `SMOOTH_TICKS` readings less that of the
    first `TARE_TICKS`.

    Args:
        robot: what the robot knows of N transfers; kept as `robot`.
    """

    def __init__(self, robot: RobotSide) -> None:
        self.robot = robot
        self.no = torch.zeros_like(robot.weight_n, dtype=torch.bool)
        self._tare = torch.zeros((), dtype=torch.float64, device=self.no.device)
        self._last: list[Tensor] = []
        self._ticks = 0

    def change(self, force: Float64[Tensor, "n 3"]) -> Float64[Tensor, "n 3"] | None:
        """The smoothed change of the load, N; None: still taring.

        Args:
            force: (N, 3) this tick's reading, N.
        """
        self._ticks += 1
        if self._ticks <= TARE_TICKS:
            self._tare = self._tare + force / TARE_TICKS
            return None
        self._last = [*self._last[-(SMOOTH_TICKS - 1) :], force.clone()]
        total = self._last[0]
        for reading in self._last[1:]:
            total = total + reading
        return total / len(self._last) - self._tare


class Lasting:
    """The least surplus over some time, row by row: what is positive has been so all the while."""

    def __init__(self, ticks: int, like: Float64[Tensor, " n"]) -> None:
        self.ticks, self._none = ticks, torch.full_like(like, -torch.inf)
        self._last: list[Tensor] = []

    def __call__(self, surplus_n: Float64[Tensor, " n"]) -> Float64[Tensor, " n"]:
        """The least of this tick's surplus and of those of the `ticks` before; -inf: fewer are known."""
        self._last = [*self._last[-self.ticks :], surplus_n]
        if len(self._last) <= self.ticks:
            return self._none
        return torch.stack(self._last).amin(0)


def size(v: Float64[Tensor, "n 3"]) -> Float64[Tensor, " n"]:
    """Length of vectors, with the same bits in any batch.

    Args:
        v: (N, 3) vectors, any unit.
    """
    return (v[:, 0] * v[:, 0] + v[:, 1] * v[:, 1] + v[:, 2] * v[:, 2]).sqrt()


@POLICIES("never")
class Never:
    """Never lets go: a bound."""

    def __init__(self, robot: RobotSide) -> None:
        self.no = torch.zeros_like(robot.weight_n, dtype=torch.bool)

    def __call__(self, seen: Observation) -> Action:
        return Action(self.no)


@POLICIES("timer")
class Timer(Tared):
    """Lets go a while after something touches the object: a bound."""

    TOUCH_N, AFTER_S = 1.5, 0.5

    def __init__(self, robot: RobotSide) -> None:
        super().__init__(robot)
        self.since = torch.zeros_like(robot.weight_n, dtype=torch.int64)

    def __call__(self, seen: Observation) -> Action:
        change = self.change(seen.force)
        if change is None:
            return Action(self.no)
        surplus_n = size(change) - self.TOUCH_N
        self.since = self.since + ((self.since > 0) | (surplus_n > 0.0)).long()
        return Action(self.since * self.robot.tick_s > self.AFTER_S, surplus_n=surplus_n)


@POLICIES("threshold")
class Threshold(Tared):
    """Lets go once the load has changed by more than 5 N for 50 ms: what most robots do."""

    FORCE_N, HOLD_S = 5.0, 0.05

    def __init__(self, robot: RobotSide) -> None:
        super().__init__(robot)
        self.lasting = Lasting(round(self.HOLD_S / robot.tick_s), robot.weight_n)

    def __call__(self, seen: Observation) -> Action:
        change = self.change(seen.force)
        if change is None:
            return Action(self.no)
        surplus_n = self.lasting(size(change) - self.FORCE_N)
        return Action(surplus_n > 0.0, surplus_n=surplus_n)


@POLICIES("load-share")
class LoadShare(Tared):
    """The grip follows what the robot still carries, and opens when the person has carried 90 % of the weight for
    50 ms (Chan et al. 2012, 2013)."""

    SHARE, HOLD_S, LEAST_SQUEEZE, LEAST_N = 0.9, 0.05, 0.35, 0.6
    """`LEAST_N`: a lighter object counts as one of this weight, because its own is within the sensor's noise
    [choice]."""

    def __init__(self, robot: RobotSide) -> None:
        super().__init__(robot)
        self.lasting = Lasting(round(self.HOLD_S / robot.tick_s), robot.weight_n)
        self.weight = robot.weight_n.clamp(min=self.LEAST_N)

    def __call__(self, seen: Observation) -> Action:
        change = self.change(seen.force)
        if change is None:
            return Action(self.no)
        share = change[:, 2] / self.weight
        squeeze = (1.0 - (1.0 - self.LEAST_SQUEEZE) * share).clamp(self.LEAST_SQUEEZE, 1.0)
        surplus_n = self.lasting((share - self.SHARE) * self.weight)
        return Action(surplus_n > 0.0, squeeze, surplus_n=surplus_n)


@POLICIES("probe")
class Probe:
    """Shakes the object by a few millimetres along each axis, and lets go when it feels a hand that carries.

    A hand that grips resists in two directions at least, a finger that presses resists in one, and an object alone only
    by its mass. The policy estimates the response to its own motion, a 3 x 3 matrix of complex stiffnesses. It is a
    Bayesian linear regression over the last `WINDOW_TICKS` readings: normal prior, normal noise, and a load that drifts
    as a parabola, so that a person who takes the weight or pulls does not spoil it. The matrix, less the object's own
    inertia, has three singular values. The second one says how stiffly a hand holds.

    Source: the idea of probing (Li, Shao and Hsu 2026, arXiv 2605.04610). The model is our own.
    """

    HZ, SHIFT_M, RAMP_S, WINDOW_TICKS = (4.0, 6.0, 8.0), 0.004, 0.1, 54
    NOISE_N, PRIOR_N_M, FINGERS_KG = 0.5, 2000.0, 0.2
    LOAD_PRECISION = 1e-6
    """Prior precision (1/N^2) of the load, its slope and its curvature over the window: nearly none."""
    LEAST_N_M, OWN_SHARE, SIGMAS, SHARE, HOLD_S = 200.0, 0.35, 3.0, 0.5, 0.1
    """A hand: the second singular value exceeds `LEAST_N_M` and `OWN_SHARE` of what the object's mass alone would give,
    by `SIGMAS` of the posterior, for `HOLD_S`, and the person carries `SHARE` of the weight [choice]."""

    def __init__(self, robot: RobotSide) -> None:
        self.robot, self.ticks = robot, 0
        self.no = torch.zeros_like(robot.weight_n, dtype=torch.bool)
        self.tare = torch.zeros_like(robot.weight_n)
        self.lasting = Lasting(round(self.HOLD_S / robot.tick_s), robot.weight_n)
        self.forces: list[Tensor] = []
        self.mass = robot.weight_n / G + self.FINGERS_KG
        self.omega = 2 * np.pi * np.array(self.HZ)

    def __call__(self, seen: Observation) -> Action:
        if self.ticks < TARE_TICKS:
            self.tare = self.tare + seen.force[:, 2] / TARE_TICKS
        now_s = (self.ticks - TARE_TICKS) * self.robot.tick_s
        self.ticks += 1
        shift = torch.from_numpy(self._moves(np.array([now_s]))[0][0]).to(self.tare)
        self.forces = [*self.forces[-(self.WINDOW_TICKS - 1) :], seen.force.clone()]
        if len(self.forces) < self.WINDOW_TICKS:
            return Action(self.no, shift=shift.expand(len(self.no), 3))
        surplus_n = self.lasting(self._surplus_n(now_s))
        return Action(surplus_n > 0.0, shift=shift.expand(len(self.no), 3), surplus_n=surplus_n)

    def _moves(self, at_s: Float64[NDArray[np.float64], " k"]) -> tuple[Any, Any]:
        """The shifts at some times, (K, 3), m, and the same a quarter of a period later."""
        size = self.SHIFT_M * (at_s / self.RAMP_S).clip(0.0, 1.0)[:, None]
        turn = at_s[:, None] * self.omega
        return size * np.sin(turn), size * np.cos(turn)

    def _surplus_n(self, now_s: float) -> Float64[Tensor, " n"]:
        """By how much each row's readings say that a hand holds and carries the object: the share's surplus, but no more
        than what the stiffness leaves at `SHIFT_M`, which is known in steps of `NOISE_N`."""
        # a reading is a tick late
        back = np.arange(self.WINDOW_TICKS, 0, -1, dtype=np.float64)
        at_s = np.asarray(now_s - self.robot.tick_s * back, np.float64)
        age = (at_s - at_s[-1]) / (self.WINDOW_TICKS * self.robot.tick_s)
        X = np.column_stack([np.ones_like(age), age, age**2, *self._moves(at_s)])
        precision = np.diag(np.repeat([self.LOAD_PRECISION, self.PRIOR_N_M**-2], [3, 6]))
        covariance = np.linalg.inv(X.T @ X / self.NOISE_N**2 + precision)
        weights = torch.from_numpy(covariance @ X.T / self.NOISE_N**2).to(self.tare)
        mean = torch.zeros((9, *self.forces[0].shape), dtype=torch.float64, device=self.tare.device)
        for k, force in enumerate(self.forces):  # one after the other: the same bits in every batch
            mean = mean + weights[:, k, None, None] * force
        weight = self.robot.weight_n.clamp(min=LoadShare.LEAST_N)
        share = (mean[0, :, 2] - self.tare) / weight
        own = torch.stack([self.mass * w**2 for w in self.omega])
        response = mean[3:6] - torch.diag_embed(own.T).movedim(0, 1), mean[6:]
        sure = self.SIGMAS * np.sqrt(covariance.diagonal()[3:].max())
        least = self.LEAST_N_M + self.OWN_SHARE * self.mass * self.omega[1] ** 2
        step = torch.arange(-1.0, 2.0, dtype=torch.float64, device=least.device)[:, None]
        exceeds = second_singular_exceeds(
            *response, (least + float(sure) + step * (self.NOISE_N / self.SHIFT_M)).clamp(min=0.0)
        )
        stiff = (exceeds.sum(0) - 1.5) * self.NOISE_N
        return torch.minimum((share - self.SHARE) * weight, stiff)


def second_singular_exceeds(
    re: Float64[Tensor, "3 n 3"], im: Float64[Tensor, "3 n 3"], least: Float64[Tensor, "*k n"]
) -> Bool[Tensor, "*k n"]:
    """Whether the second singular value of N complex 3 x 3 matrices A exceeds a number.

    It does where A^H A - least^2 has two positive eigenvalues. Their signs follow from the coefficients of the
    characteristic polynomial. Sums and products of single rows have the same bits in every batch, and no device waits.

    Args:
        re, im: (3, N, 3) parts of A, its columns first.
        least: (..., N) the number, or several.
    """

    def product(i: int, j: int) -> tuple[Tensor, Tensor]:
        """Row i, column j of A^H A, real and imaginary."""
        real = re[i] * re[j] + im[i] * im[j]
        imaginary = re[i] * im[j] - im[i] * re[j]
        return total(real), total(imaginary)

    def total(rows: Tensor) -> Tensor:
        return rows[:, 0] + rows[:, 1] + rows[:, 2]

    a, b, c = (product(i, i)[0] - least * least for i in range(3))
    (x, x_im), (y, y_im), (z, z_im) = (product(i, j) for i, j in ((0, 1), (0, 2), (1, 2)))
    xx, yy, zz = (u * u + v * v for u, v in ((x, x_im), (y, y_im), (z, z_im)))
    # the real part of x z conj(y)
    turned = (x * z - x_im * z_im) * y + (x * z_im + x_im * z) * y_im
    trace, minors = a + b + c, a * b + a * c + b * c - xx - yy - zz
    determinant = a * b * c + 2 * turned - a * zz - b * yy - c * xx
    return torch.where(determinant > 0, (minors > 0) & (trace > 0), ~((minors > 0) & (trace < 0)))
