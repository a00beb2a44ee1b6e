"""Transfers in MuJoCo C, one after the other: the engine for CPUs.

The gripper closes on the object once for each row. Policies, scenarios and persons branch from there.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.closed_loop.transfer.handed import Gripped, Handed
from r2h_batch.closed_loop.transfer.model import (
    ARM_KG,
    BASE,
    CARRIED_DAMPING,
    DAMPING,
    FREE_DAMPING,
    Places,
    Setting,
    place,
    start_posture,
    transfer_spec,
)
from r2h_batch.closed_loop.transfer.worlds import Seen, Told
from r2h_batch.judge.grasp_physics import full_effort
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot
from r2h_batch.trials.holding.held_out import G

Array = NDArray[np.float64]

CLOSE_TICKS, SETTLE_TICKS = 15, 30
"""The gripper closes for 0.125 s, from `AJAR_M` wider; then the object's weight acts for 0.25 s."""
AJAR_M = 0.004
TOO_FAST = 300.0
TOUCH_M = 0.0005
"""A contact of MuJoCo's this near is one."""


@dataclass(frozen=True, eq=False)
class Closed:
    """A row with the gripper closed on the object, and its weight acting.

    Attributes:
        model: as `place` made it.
        data: its state.
        com_closed: (3,) centre of mass when the gripper had closed, m.
        quat_closed: (4,) orientation of the object then, w first.
        moved_m: how far closing moved it.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    com_closed: Array
    quat_closed: Array
    moved_m: float


class Models:
    """Compiled models of objects, each made once."""

    def __init__(self, robot: Robot, objects: Sequence[ObjectModel], setting: Setting) -> None:
        self.robot, self.objects, self.setting = robot, objects, setting
        self._made: dict[int, mujoco.MjModel] = {}

    def of(self, index: int) -> mujoco.MjModel:
        """The model of an object; do not change it."""
        if index not in self._made:
            spec = transfer_spec(self.robot, self.objects[index], self.setting)
            self._made[index] = spec.compile()
        return self._made[index]

    def ajar(self, row: Gripped) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The model of one row, with its own masses and damping, and the state before the gripper closes.

        Args:
            row: of length 1. Without a person, the open hand waits at the object's origin.
        """
        m = copy.copy(self.of(int(row.object_index[0])))
        places = Places.of(m)
        T_gripper_slip = row.T_gripper_slip if isinstance(row, Handed) else row.T_gripper_obj
        # the arm's stiffness is of no account until somebody grips
        place(m, places, T_gripper_slip[0], row.T_gripper_obj[0], arm_n_m=300.0)
        d = mujoco.MjData(m)
        d.qpos[:] = start_posture(m, self.robot, float(row.opening_m[0]) + AJAR_M)
        mass = m.body_mass[places.object_body]
        inertia = m.body_inertia[places.object_body].sum()
        m.dof_damping[places.slip_v] = np.repeat([mass, inertia], 3) * CARRIED_DAMPING
        mujoco.mj_forward(m, d)
        return m, d

    def close(self, row: Gripped) -> Closed:
        """Closes the gripper of one row.

        Args:
            row: as of `ajar`.
        """
        m, d = self.ajar(row)
        places = Places.of(m)
        start = d.xipos[places.object_body].copy()
        d.ctrl[places.fingers] = full_effort(self.robot)
        mujoco.mj_step(m, d, CLOSE_TICKS * self.setting.steps)
        closed, quat = d.xipos[places.object_body].copy(), d.xquat[places.object_body].copy()
        m.dof_damping[places.slip_v] = FREE_DAMPING
        m.opt.gravity[:] = G * row.down[0]
        mujoco.mj_step(m, d, SETTLE_TICKS * self.setting.steps)
        return Closed(m, d, closed, quat, float(np.linalg.norm(closed - start)))


class MujocoWorlds:
    """N transfers in MuJoCo C (`worlds.Worlds`)."""

    def __init__(
        self, closed: Sequence[Closed], arm_n_m: Array, robot: Robot, setting: Setting
    ) -> None:
        """Args:
        closed: N rows; one may come several times.
        arm_n_m: (N,) stiffness of the persons' arms.
        """
        self.effort, self.steps = full_effort(robot), setting.steps
        self.models, self.data = [], []
        for row, k in zip(closed, arm_n_m.tolist(), strict=True):
            m = copy.copy(row.model)
            p = Places.of(m)
            m.actuator_gainprm[p.hand[:3], 0], m.actuator_biasprm[p.hand[:3], 1] = k, -k
            m.actuator_biasprm[p.hand[:3], 2] = -2 * DAMPING * np.sqrt(k * ARM_KG)
            self.models.append(m)
            self.data.append(copy.copy(row.data))
        self.places = p
        n = len(closed)
        sizes = {"load": 3, "shifted": 3, "com": 3, "p_obj": 3, "R_obj": 9, "slip": 7, "arm": 3}
        self._out = {k: np.zeros((n, size)) for k, size in sizes.items()}
        self._speed, self._wrist = np.zeros((n, m.nv)), np.zeros((2, n, 3))
        self._touching = np.zeros(n, bool)
        self._ctrl = np.zeros((n, m.nu))
        self._reads = [self._read(i) for i in range(n)]
        for i in range(n):
            self._look(i)

    def _read(self, i: int) -> list[tuple[Array, Array]]:
        """Where a world's numbers go, and MuJoCo's own arrays with them: indexing anew costs as much as a step."""
        d, p, out = self.data[i], self.places, self._out
        acc, force = self._wrist
        return [
            (acc[i], d.qacc[_span(p.wrist_v)]),
            (force[i], d.actuator_force[_span(p.wrist)]),
            (out["shifted"][i], d.qpos[_span(p.wrist_q)]),
            (out["com"][i], d.xipos[p.object_body]),
            (out["p_obj"][i], d.xpos[p.object_body]),
            (out["R_obj"][i], d.xmat[p.object_body]),
            (out["slip"][i], d.qpos[_span(p.slip_q)]),
            (out["arm"][i], d.actuator_force[_span(p.hand[:3])]),
            (self._speed[i], d.qvel),
        ]

    def seen(self) -> Seen:
        """The state now. The tensors are the worlds' own: valid until the next step."""
        acc, force = self._wrist
        self._out["load"][:] = BASE[0] * acc - force
        out = {k: torch.from_numpy(v) for k, v in self._out.items()}
        out["R_obj"] = out["R_obj"].view(-1, 3, 3)
        fine = np.abs(self._speed).max(1) < TOO_FAST  # not where one is NaN
        return Seen(**out, touching=torch.from_numpy(self._touching), fine=torch.from_numpy(fine))

    def step(self, told: Told, running: Bool[Tensor, " n"]) -> None:
        """Goes on by a tick where `running`."""
        p, ctrl = self.places, self._ctrl
        ctrl[:, p.fingers] = told.effort.numpy()[:, None] * self.effort
        ctrl[:, p.wrist], ctrl[:, p.hand[:3]] = told.shift.numpy(), told.hand.numpy()
        friction, slip_v = told.friction.numpy(), _span(p.slip_v)
        push = None if told.push is None else self._wrench(told.push.numpy())
        for i in torch.nonzero(running)[:, 0].tolist():
            m, d = self.models[i], self.data[i]
            d.ctrl[:] = ctrl[i]
            m.dof_frictionloss[slip_v] = friction[i]
            if push is not None:
                d.xfrc_applied[p.object_body] = push[i]
            mujoco.mj_step(m, d, self.steps)
            self._look(i)

    def _wrench(self, push: Array) -> Array:
        """Force and moment about the centre of mass of forces at points, (n, 6)."""
        force, at = push[:, :3], push[:, 3:]
        return np.concatenate([force, np.cross(at - self._out["com"], force)], 1)

    def _look(self, i: int) -> None:
        for to, of in self._reads[i]:
            to[:] = of
        d = self.data[i]
        # a contact is always one of a pad: no other geoms of the model can touch
        self._touching[i] = bool(d.ncon) and bool((d.contact.dist < TOUCH_M).any())


def _span(index: NDArray[np.int64]) -> slice:
    """The slice of neighbouring places: numpy then needs no copy."""
    return slice(int(index[0]), int(index[-1]) + 1)
