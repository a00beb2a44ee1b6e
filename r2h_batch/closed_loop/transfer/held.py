"""Whether a closed gripper holds an object: it settles without weight, then its weight acts.

What a closing hand loses, and what slides out under its weight, are two things: the first is a question of the normals,
the second one of the force.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import mujoco
import numpy as np
from jaxtyping import Bool, Float64
from numpy.typing import NDArray

from r2h_batch.closed_loop.transfer.friction import PadContacts, carried
from r2h_batch.closed_loop.transfer.handed import Gripped
from r2h_batch.closed_loop.transfer.model import FREE_DAMPING, TICK_S, Places
from r2h_batch.closed_loop.transfer.worlds_mujoco import CLOSE_TICKS, Models
from r2h_batch.judge.grasp_physics import DROPPED_M, full_effort
from r2h_batch.trials.holding.held_out import G

Array = NDArray[np.float64]

HOLD_S = 1.0
"""The weight acts for so long."""
NEAR_M = 0.003
"""A slip this near to its limit is undecided."""
REST_M_S, REST_S, SETTLE_S = 0.001, 0.05, 1.0
"""An object stands once its centre of mass has been slower for so long; nobody waits longer than `SETTLE_S`."""
ALIKE_M = 0.005
"""An object that stands and moved by less is simulated once; the others with half the step too."""


class Lost(StrEnum):
    """When the gripper loses an object."""

    CLOSING = "closing"
    WEIGHT = "weight"


@dataclass(frozen=True, eq=False)
class Holds:
    """Results of N closed grippers, float64; NaN where it did not happen.

    Attributes:
        lost: of each `Lost`, None: it is held.
        undecided: within `NEAR_M` of a limit, or half the step says otherwise.
        failed: the simulation failed; `lost` says nothing then.
        settled: stood without weight within `SETTLE_S`.
        closing_m: how far the closing gripper moved the centre of mass.
        squeezed_m: how far it slipped after that, without weight, until it stood.
        slip_m, turn_deg: how far it slipped and the object turned from the settled posture, under its weight.
        carries: `friction.carried` on the settled posture.
    """

    lost: list[Lost | None]
    undecided: Bool[NDArray[np.bool_], " n"]
    failed: Bool[NDArray[np.bool_], " n"]
    settled: Bool[NDArray[np.bool_], " n"]
    closing_m: Float64[Array, " n"]
    squeezed_m: Float64[Array, " n"]
    slip_m: Float64[Array, " n"]
    turn_deg: Float64[Array, " n"]
    carries: Float64[Array, " n"]

    @property
    def held(self) -> Bool[NDArray[np.bool_], " n"]:
        """Which objects stay in the gripper."""
        return np.array([word is None for word in self.lost], bool) & ~self.failed


@dataclass(frozen=True)
class Hold:
    """One row of `Holds`, but for `undecided`."""

    lost: Lost | None
    failed: bool
    settled: bool
    closing_m: float
    squeezed_m: float
    slip_m: float
    turn_deg: float
    carries: float

    def near_limit(self) -> bool:
        """Whether a slip is within `NEAR_M` of what decides."""
        slips = np.array([self.squeezed_m, self.slip_m])
        return bool((np.abs(slips - DROPPED_M) < NEAR_M).any())

    def stands_still(self) -> bool:
        """Whether nothing about the row is near a change."""
        moved = max(self.squeezed_m, self.slip_m) >= ALIKE_M
        return self.lost is None and not self.failed and self.settled and not moved


def hold(models: Models, row: Gripped, *, weight: bool = True) -> Hold:
    """Closes the gripper of one row, waits until the object stands, and lets its weight act for `HOLD_S`.

    Args:
        models: of the objects.
        row: of length 1.
        weight: False: nothing acts for as long, so that `slip_m` is what the contacts drift.
    """
    m, d = models.ajar(row)
    places, steps = Places.of(m), models.setting.steps
    body, start = places.object_body, d.xipos[places.object_body].copy()
    d.ctrl[places.fingers] = full_effort(models.robot)
    mujoco.mj_step(m, d, CLOSE_TICKS * steps)
    closed = d.xipos[body].copy()
    m.dof_damping[places.slip_v] = FREE_DAMPING
    settled = _settle(m, d, body, steps)
    at, quat = d.xipos[body].copy(), d.xquat[body].copy()
    nan = float("nan")
    if not np.isfinite(d.qpos).all():
        return Hold(None, True, False, nan, nan, nan, nan, nan)
    closing, squeezed = (float(np.linalg.norm(v)) for v in (closed - start, at - closed))
    contacts = PadContacts.of(m, d, places)
    if contacts.pads() < 2 or squeezed >= DROPPED_M:
        return Hold(Lost.CLOSING, False, settled, closing, squeezed, nan, nan, nan)
    setting = models.setting
    pull = G * row.down[0] * float(m.body_mass[body])
    carries = carried(
        contacts, at, pull, friction=setting.pad_friction, torsion_m=setting.torsion_m
    )
    if weight:
        m.opt.gravity[:] = G * row.down[0]
    mujoco.mj_step(m, d, round(HOLD_S / TICK_S) * steps)
    if not np.isfinite(d.qpos).all():
        return Hold(None, True, settled, closing, squeezed, nan, nan, carries)
    slip = float(np.linalg.norm(d.xipos[body] - at))
    turn = float(np.rad2deg(2 * np.arccos(min(abs(float(d.xquat[body] @ quat)), 1.0))))
    lost = Lost.WEIGHT if slip >= DROPPED_M else None
    return Hold(lost, False, settled, closing, squeezed, slip, turn, carries)


def _settle(m: mujoco.MjModel, d: mujoco.MjData, body: int, steps: int) -> bool:
    """Goes on until the object stands; whether it does."""
    slow, last = 0, d.xipos[body].copy()
    for _ in range(round(SETTLE_S / TICK_S)):
        mujoco.mj_step(m, d, steps)
        speed = float(np.linalg.norm(d.xipos[body] - last)) / TICK_S
        last, slow = d.xipos[body].copy(), slow + 1 if speed < REST_M_S else 0
        if slow >= round(REST_S / TICK_S):
            return True
    return False


class Holding:
    """Asks what closed grippers hold; doubtful rows with half the step too.

    Args:
        models: of the objects.
    """

    def __init__(self, models: Models) -> None:
        self.models = models
        halved = replace(models.setting, steps=2 * models.setting.steps)
        self.finer = Models(models.robot, models.objects, halved)

    def __call__(self, gripped: Gripped) -> Holds:
        """Every row by itself.

        Args:
            gripped: N rows.
        """
        rows, doubtful = [], []
        for i in range(len(gripped)):
            one = hold(self.models, gripped[i : i + 1])
            doubt = one.near_limit()
            if not one.stands_still() and not doubt:
                other = hold(self.finer, gripped[i : i + 1])
                doubt = (other.lost, other.failed) != (one.lost, one.failed)
            rows.append(one)
            doubtful.append(doubt)

        def every(name: str) -> Array:
            return np.array([getattr(r, name) for r in rows], np.float64)

        return Holds(
            [r.lost for r in rows],
            np.array(doubtful, bool),
            np.array([r.failed for r in rows], bool),
            np.array([r.settled for r in rows], bool),
            *(every(k) for k in ("closing_m", "squeezed_m", "slip_m", "turn_deg", "carries")),
        )
