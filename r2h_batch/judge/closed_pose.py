"""Where an object is once the gripper has closed on it: closing moves it by millimetres.

The geometric grasp (`grasp.py`) shifts the object along the closing axis alone. The pads' path, their size and friction
move and turn it further. `grasp_physics.close_in_physics` closes from the widest gap, for a second. Here the fingers
begin beside the object, as a transfer's do.
"""

from collections.abc import Sequence
from functools import lru_cache

import mujoco
import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray

from r2h_batch.base.launch import cpu_threads, thread_pool
from r2h_batch.judge.grasp_physics import (
    FINGERS,
    FRICTION,
    Material,
    add_closing_fingers,
    add_motor,
    add_object,
    finger_posture,
    full_effort,
    opening_speed,
)
from r2h_batch.judge.motion.simulation import warnings_unwritten
from r2h_batch.scene.dynamics import quat_wxyz
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot

Array = NDArray[np.float64]

STEP_S, CLOSE_S, AJAR_M = 1 / 960, 0.375, 0.004
"""The fingers close for so long, from so much wider than the object."""
IMPRATIO = 10.0
"""Contacts are those of `Material.of_steps`: nothing has to hold here."""
LOST_M = 0.03
"""An object that closing moves farther is not held as the geometry says, and stays where that puts it."""


def closed_poses(
    robot: Robot,
    objects: Sequence[ObjectModel],
    object_index: Int64[NDArray[np.int64], " n"],
    T_gripper_obj: Float64[Array, "n 4 4"],
    opening_m: Float64[Array, " n"],
) -> Float64[Array, "n 4 4"]:
    """T_gripper_obj after closing. A row does not depend on the others.

    Args:
        robot: whose gripper.
        objects: that `object_index` counts.
        object_index: which object each row holds.
        T_gripper_obj: where the geometric grasp has it, m.
        opening_m: gap of the squeezed fingers.
    """

    def one(i: int) -> Array:
        m = _model(robot, objects[int(object_index[i])])
        return _closed(m, robot, T_gripper_obj[i], float(opening_m[i]))

    with warnings_unwritten():
        rows = list(thread_pool(cpu_threads()).map(one, range(len(object_index))))
    return np.array(rows, np.float64).reshape(-1, 4, 4)


@lru_cache(maxsize=256)
def _model(robot: Robot, model: ObjectModel) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep, spec.option.gravity = STEP_S, [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, IMPRATIO
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    material = Material.of_steps(STEP_S)
    add_closing_fingers(
        spec, spec.worldbody, robot, stiff=material.solref, material=material, friction=FRICTION
    )
    for name in FINGERS:
        add_motor(spec, name, full_effort(robot) / opening_speed(robot))
    add_object(spec, model, np.eye(4), material)
    m = spec.compile()
    # nothing drifts off at a touch
    m.dof_damping[-6:] = np.repeat([float(model.mass), float(np.trace(model.inertia))], 3) * 50
    return m


def _closed(m: mujoco.MjModel, robot: Robot, T_gripper_obj: Array, opening_m: float) -> Array:
    d = mujoco.MjData(m)
    n = m.nq - 7
    d.qpos[:n] = finger_posture(robot, min(opening_m + AJAR_M, robot.open_gap_m))
    d.qpos[n : n + 3], d.qpos[n + 3 :] = T_gripper_obj[:3, 3], quat_wxyz(T_gripper_obj[:3, :3])
    d.ctrl[:] = full_effort(robot)
    mujoco.mj_step(m, d, round(CLOSE_S / STEP_S))
    moved = np.linalg.norm(d.body("object").xipos - _com(m, T_gripper_obj))
    if not np.isfinite(d.qpos).all() or moved > LOST_M:
        return T_gripper_obj
    made = np.eye(4)
    made[:3, 3], turn = d.qpos[n : n + 3], np.zeros(9)
    mujoco.mju_quat2Mat(turn, d.qpos[n + 3 :])
    made[:3, :3] = turn.reshape(3, 3)
    return made


def _com(m: mujoco.MjModel, T_gripper_obj: Array) -> Array:
    return np.asarray(T_gripper_obj[:3, :3] @ m.body("object").ipos + T_gripper_obj[:3, 3])
