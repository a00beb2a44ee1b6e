"""Transfers inside of a closed loop: each handover begins its own when the hand has come to the object, and goes on
by the loop's steps."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from r2h_batch.closed_loop.transfer.handed import Handed
from r2h_batch.closed_loop.transfer.model import TICK_S, Setting
from r2h_batch.closed_loop.transfer.outcome import Outcome
from r2h_batch.closed_loop.transfer.own_release import maker_of
from r2h_batch.closed_loop.transfer.person import SCENARIOS, Hands, draw_persons
from r2h_batch.closed_loop.transfer.release import Action, Observation, RobotSide
from r2h_batch.closed_loop.transfer.simulate import Running, noise_of
from r2h_batch.closed_loop.transfer.worlds_mujoco import Models, MujocoWorlds
from r2h_batch.judge.motion.simulation import warnings_unwritten
from r2h_batch.scene.scene import Scene

ASKED = "action"
"""The loop's policy says when the gripper opens, as the last number of its action."""
TICKS_A_S = round(1 / TICK_S)


class _Asked:
    """The release policy of a loop's action: it lets go when it is told to."""

    def __init__(self, robot: RobotSide) -> None:
        self.opens = torch.zeros_like(robot.weight_n, dtype=torch.bool)

    def __call__(self, seen: Observation) -> Action:
        return Action(self.opens)


@dataclass(eq=False)
class _Row:
    running: Running
    policy: Any
    steps: int = 0
    force: Tensor | None = None


class LoopTransfers:
    """The transfers of a loop's rows: persons who take, drawn as `results transfer` draws them."""

    def __init__(self, scene: Scene, release: str, rate_hz: int) -> None:
        """Args:
            scene: robot and objects.
            release: policy, as `release_of` takes it, or `ASKED`.
            rate_hz: steps of the loop a second.

        Raises:
            ImportError, TypeError: there is no such policy, or it is no class.
        """
        self.asked = release == ASKED
        self.policy = _Asked if self.asked else maker_of(release)
        self.scene, self.rate_hz = scene, rate_hz
        self.models = Models(scene.robot, tuple(scene.objects), Setting())
        self.rows: dict[int, _Row] = {}

    def begin(self, row: int, handed: Handed, seed: int) -> None:
        """The hand has come to the object of a row: the gripper's grasp settles, and the person begins to grip.

        Args:
            row: of the loop.
            handed: the handover, of length 1.
            seed: which person of the trial, with the sensor's noise that `results transfer` gives that person.
        """
        scenario = SCENARIOS["take"]
        persons = draw_persons(scenario, handed, seed, self.models.setting)
        with warnings_unwritten():
            closed = self.models.close(handed)
        worlds = MujocoWorlds([closed], persons.arm_n_m, self.scene.robot, self.models.setting)
        running = Running(
            worlds,
            Hands(handed, scenario, persons, self.models.setting),
            R_world_gripper=torch.from_numpy(handed.R_world_gripper),
            com_closed=torch.from_numpy(np.asarray(closed.com_closed)[None]),
            noise=noise_of(handed.trial_id, seed, 0),
        )
        self.rows[row] = _Row(running, self.policy(running.robot_side))

    def forget(self, row: int) -> None:
        """Ends the transfer of a row, if it has one."""
        self.rows.pop(row, None)

    def go_on(self, row: int, opens: bool) -> Outcome | None:
        """A step of the loop.

        Args:
            row: whose transfer began.
            opens: whether the gripper is told to open; once is enough. It counts with `ASKED`.

        Returns:
            The outcome, None while it goes on.
        """
        one = self.rows[row]
        one.steps += 1
        ticks = one.steps * TICKS_A_S // self.rate_hz - (one.steps - 1) * TICKS_A_S // self.rate_hz
        if isinstance(one.policy, _Asked):
            one.policy.opens |= opens
        with warnings_unwritten():
            for _ in range(ticks):
                seen = one.running.observe()
                if seen is None:
                    return Outcome(one.running.book.outcomes()[0])
                one.force = seen.force[0]
                one.running.act(one.policy(seen))
        return None

    def forces(self, count: int) -> Float64[Tensor, "b 3"]:
        """Load on the wrist as the sensor reads it, world axes, N; 0 before a row's transfer began.

        Args:
            count: B, rows of the loop.
        """
        found = torch.zeros((count, 3), dtype=torch.float64, device="cpu")
        for row, one in self.rows.items():
            if one.force is not None:
                found[row] = one.force
        return found

    def begun(self, count: int) -> Bool[Tensor, " b"]:
        """Whether rows have a transfer.

        Args:
            count: B, rows of the loop.
        """
        found = torch.zeros(count, dtype=torch.bool, device="cpu")
        found[list(self.rows)] = True
        return found
