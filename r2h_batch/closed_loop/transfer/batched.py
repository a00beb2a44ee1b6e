"""Transfers in batched MuJoCo-Warp worlds, with MuJoCo C as the judge of their contacts.

The worlds' contact list says when a gripper is free, and so how a transfer ends. MuJoCo C looks at the postures of
every transfer again. Where its own contacts say another tick, MuJoCo C simulates the transfer, and that result
counts. The same holds for a slip or turn that is near a limit, where float32 may decide, and for a world that lost
contacts or exploded.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import TypeVar

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float32
from numpy.typing import NDArray

from r2h_batch.closed_loop.transfer.cases import (
    Case,
    Simulator,
    Transferred,
    persons_of,
    transferred,
)
from r2h_batch.closed_loop.transfer.handed import Gripped, Handed
from r2h_batch.closed_loop.transfer.held import Holds
from r2h_batch.closed_loop.transfer.model import TICK_S, Setting
from r2h_batch.closed_loop.transfer.outcome import (
    DROPPED_M,
    HELD_DEG,
    HELD_M,
    Outcome,
    free_at,
)
from r2h_batch.closed_loop.transfer.person import LOST_DEG, LOST_M, Persons
from r2h_batch.closed_loop.transfer.simulate import Transfers
from r2h_batch.closed_loop.transfer.worlds_mjwarp import Batch, Standing, WarpWorlds
from r2h_batch.closed_loop.transfer.worlds_mujoco import TOUCH_M
from r2h_batch.judge.motion.simulation import warnings_unwritten
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot

MOST_WORLDS = {"cpu": 128, "cuda": 4096}
"""Handovers at a time."""

NEAR_M, NEAR_DEG = 0.003, 3.0
"""A slip or turn this near to a limit of the outcomes is doubtful: the engines differ by up to 2.1 mm and 2.4
degrees in 300 transfers (bench/transfer.py)."""

Doubtful = Bool[NDArray[np.bool_], " n"]
Rows = TypeVar("Rows", Transfers, Persons)


class BatchedSimulator:
    """Simulates transfers in MuJoCo-Warp.

    Args:
        robot: whose gripper.
        objects: that `Handed.object_index` counts.
        setting: what a study varies.
        seed: of the sensor's noise.
        device: cpu, cuda or cuda:N.
    """

    def __init__(
        self,
        robot: Robot,
        objects: Sequence[ObjectModel],
        setting: Setting,
        seed: int,
        device: str = "cpu",
    ) -> None:
        self.exact = Simulator(robot, objects, setting, seed)
        self.device, self.rows = device, MOST_WORLDS[torch.device(device).type]
        self._batch: tuple[tuple[list[int], int], Batch] | None = None

    def __call__(self, handed: Handed, cases: Sequence[Case]) -> list[Transferred]:
        """Every row in every case; where the worlds are doubtful, as MuJoCo C has it, which also knows half the step."""
        made = [self._decided(handed, made, doubt) for made, doubt in self.worlds(handed, cases)]
        return self.exact.marked(handed, made)

    def worlds(self, handed: Handed, cases: Sequence[Case]) -> list[tuple[Transferred, Doubtful]]:
        """Every row in every case as the worlds have it, and whether MuJoCo C has to simulate it."""
        n = len(handed)
        if not n:
            return [(made, np.zeros(0, bool)) for made in self.exact.once(handed, cases)]
        worlds = (
            1 << (n - 1).bit_length()
        )  # a few sizes only: worlds stand from one group to the next
        full = handed[np.minimum(np.arange(worlds), n - 1)]
        with warnings_unwritten():
            batch = self._standing(full)
            standing = batch.close(full)
            return [self._one(batch, standing, case, n) for case in cases]

    def hold(self, gripped: Gripped) -> Holds:
        """As `Simulator.hold`, in MuJoCo C."""
        return self.exact.hold(gripped)

    def _standing(self, handed: Handed) -> Batch:
        key = sorted(set(handed.object_index.tolist())), len(handed)
        if self._batch is None or self._batch[0] != key:
            self._batch = None  # its memory first
            self._batch = key, Batch(self.exact.models, *key, self.device)
        return self._batch[1]

    def _one(
        self, batch: Batch, standing: Standing, case: Case, n: int
    ) -> tuple[Transferred, Doubtful]:
        """The first n rows of one case."""
        handed = standing.handed
        setting, seed = self.exact.setting, self.exact.seed
        persons = persons_of(handed, case, setting)
        worlds = WarpWorlds(batch, standing, torch.from_numpy(persons.arm_n_m))
        made = transferred(
            worlds, standing.com_closed, handed, case, persons, setting, seed
        ).transfers
        ends = np.rint(made.time_s / TICK_S).astype(np.int64)
        lost = worlds.overflowed.cpu().numpy()
        lost |= np.array([o == Outcome.EXPLODED for o in made.outcome], bool)
        lost |= _near_limits(made)
        touched = torch.stack(worlds.touched).cpu().numpy()
        postures = torch.stack(worlds.postures).cpu().numpy()
        for i in np.flatnonzero(~lost[:n]).tolist():
            theirs = touched[: ends[i] + 1, i]
            ours = touching(standing.models[i], postures[: ends[i] + 1, i])
            lost[i] = np.ptp(free_at(np.column_stack([theirs, ours]))) > 0
        first = slice(0, n)
        return Transferred(case, _rows(made, first), _rows(persons, first)), lost[first]

    def _decided(self, handed: Handed, made: Transferred, doubt: Doubtful) -> Transferred:
        if not doubt.any():
            return made
        (exact,) = self.exact.once(handed[doubt], [made.case])
        outcome = list(made.transfers.outcome)
        for i, ours in zip(np.flatnonzero(doubt).tolist(), exact.transfers.outcome, strict=True):
            outcome[i] = ours
        numbers = {f.name for f in fields(Transfers)} - {"outcome"}
        found = {name: getattr(made.transfers, name).copy() for name in numbers}
        for name, values in found.items():
            values[doubt] = getattr(exact.transfers, name)
        return replace(made, transfers=Transfers(outcome=outcome, **found))


def touching(
    m: mujoco.MjModel, postures: Float32[NDArray[np.float32], "t nq"]
) -> Bool[NDArray[np.bool_], " t"]:
    """Whether MuJoCo C finds a contact of pads and object.

    Args:
        m: the model of a row.
        postures: (T, nq) of it.
    """
    d, found = mujoco.MjData(m), np.zeros(len(postures), bool)
    for k, q in enumerate(postures):
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_collision(m, d)
        found[k] = (d.contact.dist < TOUCH_M).any()
    return found


def _near_limits(made: Transfers) -> Doubtful:
    pairs = (
        (made.robot_slip_m, (DROPPED_M,), NEAR_M),
        (made.slip_m, (HELD_M, LOST_M), NEAR_M),
        (made.turn_deg, (HELD_DEG, LOST_DEG), NEAR_DEG),
    )
    near = [np.abs(x - limit) < margin for x, limits, margin in pairs for limit in limits]
    return np.logical_or.reduce(near)


def _rows(of: Rows, rows: slice) -> Rows:
    return type(of)(*(getattr(of, f.name)[rows] for f in fields(of)))
