"""Transfers of many handovers on all cores: rows, cases, processes."""

import multiprocessing
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from r2h_batch.base.io.child import end_with
from r2h_batch.closed_loop.transfer.handed import Gripped, Handed
from r2h_batch.closed_loop.transfer.held import Holding, Holds
from r2h_batch.closed_loop.transfer.model import Setting
from r2h_batch.closed_loop.transfer.own_release import maker_of
from r2h_batch.closed_loop.transfer.person import SCENARIOS, Hands, Persons, draw_persons
from r2h_batch.closed_loop.transfer.simulate import Transfers, noise_of, simulate
from r2h_batch.closed_loop.transfer.worlds import Worlds
from r2h_batch.closed_loop.transfer.worlds_mujoco import Closed, Models, MujocoWorlds
from r2h_batch.judge.motion.simulation import warnings_unwritten
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot

ROWS = 32
"""Handovers that a process takes at a time."""
AHEAD = 2
"""Groups of rows that wait for each process: memory stays flat."""

Rows = TypeVar("Rows", bound=Gripped)
Found = TypeVar("Found")


class Case(NamedTuple):
    """One way to transfer every row: who decides to let go, what the person does, which person."""

    release: str
    scenario: str
    person: int


@dataclass(frozen=True, eq=False)
class Transferred:
    """N handovers in one case: what came of them, and the persons."""

    case: Case
    transfers: Transfers
    persons: Persons


class Simulator:
    """Simulates transfers in this process.

    Args:
        robot: whose gripper.
        objects: that `Handed.object_index` counts.
        setting: what a study varies.
        seed: of the sensor's noise.
        worlds: makes the worlds of a case, as `MujocoWorlds` is made.
    """

    def __init__(
        self,
        robot: Robot,
        objects: Sequence[ObjectModel],
        setting: Setting,
        seed: int,
        worlds: Callable[..., Worlds] = MujocoWorlds,
    ) -> None:
        self.robot, self.setting, self.seed = robot, setting, seed
        self.worlds, self.rows = worlds, ROWS
        self.models = Models(robot, objects, setting)
        self.holding = Holding(self.models)

    def __call__(self, handed: Handed, cases: Sequence[Case]) -> list[Transferred]:
        """Every row in every case, with half the step too where `Transfers.halved`."""
        return self.marked(handed, self.once(handed, cases))

    def once(self, handed: Handed, cases: Sequence[Case]) -> list[Transferred]:
        """Every row in every case at the step of the setting alone; the gripper closes once for each row."""
        with warnings_unwritten():
            closed = [self.models.close(handed[i : i + 1]) for i in range(len(handed))]
            return [self._one(self.models, handed, closed, c, self.worlds) for c in cases]

    def marked(self, handed: Handed, made: Sequence[Transferred]) -> list[Transferred]:
        """The same transfers, with the mark of those that half the step ends otherwise.

        Args:
            handed: N handovers.
            made: of these, in any engine.
        """
        closed: dict[int, Closed] = {}
        with warnings_unwritten():
            return [self._marked(handed, one, closed) for one in made]

    def _marked(self, handed: Handed, one: Transferred, closed: dict[int, Closed]) -> Transferred:
        """One case; grippers that are not among the closed ones yet close with half the step."""
        rows = np.flatnonzero(one.transfers.halved)
        if not len(rows):
            return one
        finer = self.holding.finer
        for i in set(rows.tolist()) - set(closed):
            closed[i] = finer.close(handed[i : i + 1])
        own = [closed[i] for i in rows.tolist()]
        half = self._one(finer, handed[rows], own, one.case, MujocoWorlds).transfers
        other = one.transfers.other_end.copy()
        other[rows] = np.array(half.outcome) != np.array(one.transfers.outcome)[rows]
        return replace(one, transfers=replace(one.transfers, other_end=other))

    def hold(self, gripped: Gripped) -> Holds:
        """Which objects the closed grippers hold."""
        with warnings_unwritten():
            return self.holding(gripped)

    def _one(
        self,
        models: Models,
        handed: Handed,
        closed: Sequence[Closed],
        case: Case,
        worlds: Callable[..., Worlds],
    ) -> Transferred:
        setting = models.setting
        persons = persons_of(handed, case, setting)
        made = worlds(closed, persons.arm_n_m, self.robot, setting)
        com_closed = torch.from_numpy(np.array([c.com_closed for c in closed]))
        return transferred(made, com_closed, handed, case, persons, setting, self.seed)


def persons_of(handed: Handed, case: Case, setting: Setting) -> Persons:
    """The persons who take the objects of N handovers."""
    return draw_persons(SCENARIOS[case.scenario], handed, case.person, setting)


def transferred(
    worlds: Worlds,
    com_closed: Float64[Tensor, "n 3"],
    handed: Handed,
    case: Case,
    persons: Persons,
    setting: Setting,
    seed: int,
) -> Transferred:
    """Runs N transfers of one case to their ends.

    Args:
        worlds: with closed grippers, in any simulator.
        com_closed: (N, 3) centre of mass when the gripper had closed, frame gripper, m.
        handed: N handovers.
        case: policy, scenario and person.
        persons: of `persons_of`.
        setting: what a study varies.
        seed: of the sensor's noise.
    """
    hands = Hands(handed, SCENARIOS[case.scenario], persons, setting, str(com_closed.device))
    made = simulate(
        worlds,
        hands,
        maker_of(case.release),
        R_world_gripper=torch.from_numpy(handed.R_world_gripper),
        com_closed=com_closed,
        noise=noise_of(handed.trial_id, case.person, seed),
    )
    return Transferred(case, made, persons)


class Simulates(Protocol):
    """Simulates transfers, in some engine.

    Attributes:
        rows: handovers that it takes at a time.
    """

    rows: int

    def __call__(self, handed: Handed, cases: Sequence[Case]) -> list[Transferred]:
        """Every row in every case."""
        ...

    def hold(self, gripped: Gripped) -> Holds:
        """Which objects the closed grippers hold."""
        ...


_simulator: Simulator | None = None


def _start(
    parent: int, robot: Robot, objects: Sequence[ObjectModel], setting: Setting, seed: int
) -> None:
    global _simulator
    end_with(parent)
    torch.set_num_threads(1)
    _simulator = Simulator(robot, objects, setting, seed)


def _transfer(handed: Handed, cases: Sequence[Case]) -> list[Transferred]:
    assert _simulator is not None
    return _simulator(handed, cases)


def _hold(gripped: Gripped) -> Holds:
    assert _simulator is not None
    return _simulator.hold(gripped)


class Processes:
    """Simulates in several processes, or in this one; rows come back in their order."""

    def __init__(self, simulator: Simulates, pool: ProcessPoolExecutor | None, count: int) -> None:
        self.simulator, self.pool, self.count = simulator, pool, count

    def __call__(
        self, handed: Iterable[Handed], cases: Sequence[Case]
    ) -> Iterator[tuple[Handed, list[Transferred]]]:
        """Groups of at most `simulator.rows` rows, each with all cases."""
        groups = _groups(handed, self.simulator.rows)
        if self.pool is None:
            return ((group, self.simulator(group, cases)) for group in groups)
        return self._ahead(self.pool, groups, partial(_transfer, cases=cases))

    def hold(self, gripped: Iterable[Gripped]) -> Iterator[tuple[Gripped, Holds]]:
        """Groups of at most `simulator.rows` rows, each with `Simulator.hold`."""
        groups = _groups(gripped, self.simulator.rows)
        if self.pool is None:
            return ((group, self.simulator.hold(group)) for group in groups)
        return self._ahead(self.pool, groups, _hold)

    def _ahead(
        self, pool: ProcessPoolExecutor, groups: Iterator[Rows], work: Callable[[Rows], Found]
    ) -> Iterator[tuple[Rows, Found]]:
        waiting = [(g, pool.submit(work, g)) for g in islice(groups, AHEAD * self.count)]
        while waiting:
            group, future = waiting.pop(0)
            found = future.result()
            waiting += [(g, pool.submit(work, g)) for g in islice(groups, 1)]
            yield group, found


def _groups(parts: Iterable[Rows], most: int) -> Iterator[Rows]:
    return (rows[i : i + most] for rows in parts for i in range(0, len(rows), most))


@contextmanager
def processes(simulator: Simulates, count: int) -> Iterator[Processes]:
    """Processes that simulate what `simulator` does. They end with this one, however that ends.

    Args:
        simulator: of MuJoCo C. Another has all its worlds in this process.
        count: how many; 1: this one.
    """
    if count == 1 or not isinstance(simulator, Simulator):
        yield Processes(simulator, None, 1)
        return
    like = simulator.robot, simulator.models.objects, simulator.setting, simulator.seed
    given = (os.getpid(), *like)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, context, initializer=_start, initargs=given) as pool:
        yield Processes(simulator, pool, count)
