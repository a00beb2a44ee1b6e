"""Lifting in physics: fingers close on an object that rests on a table, then table and gripper part by the way up. A check of the
geometric Pick (pick.py). Everything stands in the gripper's frame, in which the table sinks."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from r2h_batch.base.launch import cpu_threads, thread_pool
from r2h_batch.judge.grasp_physics import (
    CLOSING_M_S,
    CONDIM,
    DROPPED_M,
    FRICTION,
    ROLL_M,
    SETTLE_S,
    STEP_S,
    TORSION_M,
    G,
    finger_posture,
    gripper_spec,
)
from r2h_batch.judge.motion.simulation import warnings_unwritten
from r2h_batch.judge.straight_way import WAY_M
from r2h_batch.scene.dynamics import quat_wxyz
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot, drive_from_gap

Array = NDArray[np.float64]

REST_S, LIFT_S, HOLD_S = 0.1, 0.5, 0.5
"""How long the object rests before fingers close, the way up takes, and the weight hangs after it [choice]."""
HALF_M = (0.6, 0.6, 0.05)
"""Half size of the table's piece below the object."""
EVERY = 10
"""Steps between two settings of motors and table."""


@dataclass(frozen=True)
class Lifted:
    """How B lifts ended.

    Attributes:
        moved_m: how far closing moved the object.
        slip_m: how far it then moved in the gripper, on the way up and while it hung there.
        T_world_obj: where it is in the end, the gripper being WAY_M above its grasp.
        held: it slipped by less than 2 cm.
    """

    moved_m: Float[Array, " b"]
    slip_m: Float[Array, " b"]
    T_world_obj: Float[Array, "b 4 4"]
    held: NDArray[np.bool_]


def lift_in_physics(
    objects: Sequence[ObjectModel],
    object_index: Int[NDArray[np.int32], " b"],
    T_obj_ee: Float[Array, "b 4 4"],
    T_world_obj: Float[Array, "b 4 4"],
    robot: Robot,
    *,
    table_m: float,
) -> Lifted:
    """Closes the open gripper on each object where it rests, and takes gripper and table apart along the vertical.

    The pads touch the object alone: what else the gripper meets is Pick's to judge.

    Args:
        objects: all objects.
        object_index: (B,) which one.
        T_obj_ee: (B, 4, 4) grasps, the ee in the object's frame, m.
        T_world_obj: (B, 4, 4) where the objects rest, m.
        robot: whose gripper.
        table_m: height of the table's top, m.
    """

    def one(i: int) -> tuple[float, float, Array]:
        grasp, rest = (np.asarray(T[i], np.float64) for T in (T_obj_ee, T_world_obj))
        return _lift(robot, objects[int(object_index[i])], grasp, rest, table_m)

    with warnings_unwritten():
        rows = list(thread_pool(cpu_threads()).map(one, range(len(object_index))))
    moved, slip = np.array([r[:2] for r in rows], np.float64).reshape(-1, 2).T
    ends = np.array([r[2] for r in rows], np.float64).reshape(-1, 4, 4)
    return Lifted(moved, slip, ends, np.isfinite(slip) & (slip < DROPPED_M))


def _lift(
    robot: Robot, model: ObjectModel, T_obj_ee: Array, T_world_obj: Array, table_m: float
) -> tuple[float, float, Array]:
    """How far closing moves it, how far it slips after (m), and where it is in the end."""
    T_gripper_ee = np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee
    T_world_gripper = T_world_obj @ T_obj_ee @ np.linalg.inv(T_gripper_ee)
    T_gripper_world = np.linalg.inv(T_world_gripper)
    spec = gripper_spec(robot, model, T_obj_ee)
    middle = np.array([*T_world_obj[:2, 3], table_m - HALF_M[2], 1.0])
    table = spec.worldbody.add_body(
        name="table", mocap=True, pos=(T_gripper_world @ middle)[:3], quat=quat_wxyz(T_gripper_world[:3, :3])
    )  # fmt: skip
    # it touches the object (2 and 1), not the pads (1 and 2)
    table.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=HALF_M, contype=1, conaffinity=2, condim=CONDIM,
        friction=[FRICTION, TORSION_M, ROLL_M],
    )  # fmt: skip
    m = spec.compile()
    up = T_gripper_world[:3, 2]
    m.opt.gravity[:] = -G * up
    data = mujoco.MjData(m)
    n = m.nq - 7
    data.qpos[:n] = finger_posture(robot, robot.open_gap_m)
    data.ctrl[:] = drive_from_gap(robot, robot.open_gap_m)
    mujoco.mj_step(m, data, round(REST_S / STEP_S))
    start = data.qpos[n : n + 3].copy()
    for k in range(round((robot.open_gap_m / CLOSING_M_S + SETTLE_S) / STEP_S / EVERY)):
        gap = max(robot.open_gap_m - CLOSING_M_S * k * EVERY * STEP_S, 0.0)
        data.ctrl[:] = drive_from_gap(robot, gap)
        mujoco.mj_step(m, data, EVERY)
    at, table_at = data.qpos[n : n + 3].copy(), data.mocap_pos[0].copy()
    for t in np.arange(0.0, LIFT_S + HOLD_S, EVERY * STEP_S):
        data.mocap_pos[0] = table_at - WAY_M * min(t / LIFT_S, 1.0) * up
        mujoco.mj_step(m, data, EVERY)
    end = np.eye(4)
    end[:3, 3] = data.qpos[n : n + 3]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, data.qpos[n + 3 : n + 7])
    end[:3, :3] = turn.reshape(3, 3)
    T_world_end = T_world_gripper @ end
    T_world_end[2, 3] += WAY_M
    moved, slip = (float(np.linalg.norm(x)) for x in (at - start, data.qpos[n : n + 3] - at))
    return moved, slip, T_world_end
