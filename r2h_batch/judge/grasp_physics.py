"""Closing and shaking in physics: the 2F-85's linkage, or two jaws, close on the object until they
stop; then the grasp is tried.

A check of the geometric width (grasp.py), and a friction grasp on request. Everything
stands in the gripper frame: weight and shaking are accelerations of that frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.launch import cpu_threads, thread_pool
from r2h_batch.judge.motion.simulation import warnings_unwritten
from r2h_batch.scene.dynamics import add_servo, quat_wxyz
from r2h_batch.scene.model_parts import FingerFrames, add_mesh, tie
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot, drive_from_gap, table_at

Array = NDArray[np.float64]

STEP_S = 0.0005
CLOSING_M_S = 0.15
"""Speed at which the gap closes: the 2F-85's largest."""
TORQUE_NM = 1.5
"""At the drivers: about 30 N between the pads, a light grasp of a hand that may squeeze with 235
N."""
FORCE_N, JAW_ARMATURE_KG, JAW_GAINS = 25.0, 0.3, (30_000.0, 600.0)
"""Force, armature and gains of jaws on slides, N, kg, N/m and N s/m, as the linkage has them at its
pads."""
SETTLE_S = 0.35
FRICTION = 0.8
"""Rubber pads on plastic or metal [choice]."""
TORSION_M = 0.005
"""Radius of the patch whose friction withstands turning about the normal: by Hertz a pad of 3 MPa that presses a
radius of 35 mm with 25 N has 2.6 mm [choice]."""
ROLL_M, CONDIM = 0.0001, 4
"""Rolling friction, and the dimensions of a contact: normal, two tangents, torsion."""
LINK, ARMATURES = (0.05, 1e-5), (1e-3, 1e-4)
"""Mass (kg) and inertia about each axis (kg m^2) of a driver and of a pad; armatures of their joints, kg m^2 [choice].
Centres of mass: of a driver half way to its pin, of a pad in the pad's middle [choice]. Say them: a body with a mass and no
such place gets its `pos` once more from MuJoCo's compiler."""
ROOM = (0.05, 0.002)
"""How much farther than the linkage goes a driver (rad) or a jaw (m) may be pushed."""
TIE_IMPEDANCE = (0.99, 0.99, 0.001, 0.5, 2.0)
"""MuJoCo's solimp of the ties between a finger's joints. With its default, pads that press lean by 12 mrad, with this by 2.
With an impedance that grows within 0.1 mrad MuJoCo-Warp's float32 is farther from MuJoCo C."""
IMPRATIO, TOLERANCE = 100.0, 1e-12
"""How much harder friction is regularised than normal forces: with 10 light objects creep by centimetres. MuJoCo's solver has
to converge for that: with its own 1e-8 postures are off by 0.6 mm after a second, and steps take longer."""
SHAKE_M_S2, SHAKE_HZ, SHAKE_S = 5.0, 4.0, 0.5
"""Per axis: a sine of half the weight's size, two periods [choice]."""
G = 9.81
FINGERS = ("left", "right")
"""Names of joint, body, motor and pad of each finger."""
HINGE, SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
DROPPED_M = 0.02


SOLREF, SOLIMP = (0.0056, 1.0), (0.99, 0.99, 0.001, 0.5, 2.0)
"""How MuJoCo regularises the contacts of pads and objects: time constant (s) and damping ratio; impedance at no and at full
depth, that depth (m), midpoint and power.

Friction inside of the cone slides at R f / b: f the friction force, b = 2 / (0.95 time constant), and R falls with
(1 - impedance) / impedance and with 1 / impratio. The time constant is in seconds, not in steps: else half the step is
another material."""
CONTACT: dict[str, Any] = {
    "friction": [FRICTION, TORSION_M, ROLL_M], "condim": CONDIM, "solref": SOLREF, "solimp": SOLIMP,
}  # fmt: skip
"""Arguments of a geom that others touch."""


@dataclass(frozen=True)
class Closed:
    """How B grasps ended: gap at rest (m), how far the object moved while closing and, if its weight
    acted, slipped after (m)."""

    opening_m: Float[Array, " b"]
    moved_m: Float[Array, " b"]
    slip_m: Float[Array, " b"]


def close_in_physics(
    objects: Sequence[ObjectModel],
    object_index: Int[NDArray[np.int32], " b"],
    T_obj_ee: Float[Array, "b 4 4"],
    robot: Robot,
    *,
    shake: bool = False,
) -> Closed:
    """Closes the gripper on each object, standing as `T_obj_ee` says and free to move, until the
    fingers rest.

    With `shake`: then its weight (out of the gripper, as at home) and a shake along three axes.
    """

    def one(i: int) -> tuple[float, float, float]:
        model, T = objects[int(object_index[i])], np.asarray(T_obj_ee[i], np.float64)
        return _close(robot, model, T, shake)

    with warnings_unwritten():
        rows = list(thread_pool(cpu_threads()).map(one, range(len(object_index))))
    return Closed(*np.array(rows, np.float64).reshape(-1, 3).T)


def shake(
    objects: Sequence[ObjectModel],
    object_index: Int32[Tensor, " b"],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    rows: Bool[Tensor, " b"],
    robot: Robot,
) -> Float64[Tensor, " b"]:
    """How far each object slips in the shake (m), simulated on the CPU; NaN outside `rows`.

    A grasp takes seconds, so ask only for those that may pass. `T_obj_ee`: after closing.
    """
    slip = torch.full(rows.shape, torch.nan, dtype=torch.float64, device=rows.device)
    closed = close_in_physics(
        objects,
        object_index[rows].cpu().numpy(),
        T_obj_ee[rows].double().cpu().numpy(),
        robot,
        shake=True,
    )
    slip[rows] = torch.from_numpy(closed.slip_m).to(slip)
    return slip


def gripper_spec(robot: Robot, model: ObjectModel, T_obj_ee: Array) -> mujoco.MjSpec:
    """The fingers as parallelograms of their four-bars, or as jaws; pads as boxes, and the object's
    convex pieces as a free body."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep, spec.option.gravity = STEP_S, [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    spec.option.impratio, spec.option.tolerance = IMPRATIO, TOLERANCE
    add_closing_fingers(spec, robot)
    kp, kv = (100.0, 2.0) if robot.linkage.table is None else JAW_GAINS
    for name in FINGERS:
        add_servo(spec, name, kp, kv)
    T = np.linalg.inv(robot.T_flange_gripper) @ robot.T_flange_ee @ np.linalg.inv(T_obj_ee)
    add_object(spec, model, T)
    return spec


def add_object(spec: mujoco.MjSpec, model: ObjectModel, T_gripper_obj: Array) -> None:
    """Adds the object's convex pieces as a free body, the last joint of the model.

    Args:
        spec: with the fingers; its world is the gripper.
        model: the object.
        T_gripper_obj: (4, 4) where it is, m.
    """
    xx, yy, zz, xy, xz, yz = model.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    held = spec.worldbody.add_body(
        name="object", pos=T_gripper_obj[:3, 3], quat=quat_wxyz(T_gripper_obj[:3, :3]),
        explicitinertial=True, mass=float(model.mass), ipos=model.com,
        fullinertia=[xx, yy, zz, xy, xz, yz],
    )  # fmt: skip
    held.add_freejoint()
    for k, (vertices, faces) in enumerate(model.pieces):
        add_mesh(spec, f"piece_{k}", vertices.astype(np.float64), faces, convex=True)
        held.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"piece_{k}", contype=2, conaffinity=1,
            **CONTACT,
        )  # fmt: skip


def add_closing_fingers(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Adds two fingers that move together, as parallelograms of their four-bars or as jaws, each with a pad that
    objects touch. They have no motor yet.

    Args:
        spec: the model; its world is the gripper's frame.
        robot: whose linkage.
    """
    link, jaws = robot.linkage, robot.linkage.table is not None
    most, armature = (FORCE_N, JAW_ARMATURE_KG) if jaws else (TORQUE_NM, ARMATURES[0])
    low, high = (link.drive_lower, link.drive_upper) if jaws else (0.0, link.drive_upper)
    room = ROOM[jaws]
    rigid = {"solref": [4 * STEP_S, 1.0], "solimp": TIE_IMPEDANCE}
    for name, side in zip(FINGERS, (-1, 1), strict=True):
        frames = FingerFrames.of(robot, side)
        body = spec.worldbody.add_body(
            name=name, pos=frames.driver, explicitinertial=True, mass=LINK[0], inertia=[LINK[1]] * 3,
            ipos=frames.pad if jaws else frames.pin / 2,
        )  # fmt: skip
        body.add_joint(
            name=name, type=SLIDE if jaws else HINGE, axis=frames.axis, armature=armature,
            range=[low - room, high + room], limited=True, actfrcrange=[-most, most], actfrclimited=True,
        )  # fmt: skip
        finger = body
        if not jaws:
            finger = body.add_body(
                name=f"{name}_pad", pos=frames.pin, explicitinertial=True, mass=LINK[0],
                inertia=[LINK[1]] * 3, ipos=frames.pad,
            )  # fmt: skip
            finger.add_joint(
                name=f"{name}_pad", type=HINGE, axis=frames.axis, armature=ARMATURES[1]
            )
            # the four-bar is a parallelogram: the pad keeps upright
            tie(spec, f"{name}_pad", name, (0, -1), **rigid)
        elif (rise := pad_rise(robot)) is not None:
            body.add_joint(name=f"{name}_pad", type=SLIDE, axis=[0, 0, 1], armature=armature)
            tie(spec, f"{name}_pad", name, rise.tolist(), **rigid)
        finger.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=robot.linkage.pad_half_size, pos=frames.pad,
            contype=1, conaffinity=2, **CONTACT,
        )  # fmt: skip
    tie(spec, "left", "right", (0, 1), **rigid)


def finger_posture(robot: Robot, gap_m: float) -> Array:
    """Joint positions of the fingers of `add_closing_fingers` at a gap, (2 or 4,)."""
    drive, rise = float(drive_from_gap(robot, gap_m)), pad_rise(robot)
    second = -drive if rise is None else float(np.polyval(rise[::-1], drive))
    alone = robot.linkage.table is not None and rise is None
    return np.tile([drive] if alone else [drive, second], 2)


def pad_rise(robot: Robot) -> Array | None:
    """Coefficients of the polynomial of the drive, powers 0 to 4, that the pads of a table rise by;
    None: they keep their height, or the linkage lifts them."""
    link = robot.linkage
    if link.table is None or np.ptp(link.table[0, :, 1]) < 1e-9:
        return None
    drives = np.linspace(link.drive_upper, link.drive_lower, 65)
    z = table_at(link, drives)[0, :, 1]
    return np.asarray(np.polynomial.polynomial.Polynomial.fit(drives, z, 4).convert().coef)


def _close(
    robot: Robot, model: ObjectModel, T_obj_ee: Array, shaken: bool
) -> tuple[float, float, float]:
    """Gap at rest, how far the object moved while the fingers closed, and how far it slipped after, m."""
    m = gripper_spec(robot, model, T_obj_ee).compile()
    # nothing drifts off at a touch
    m.dof_damping[-6:] = [model.mass * 50] * 3 + [float(np.trace(model.inertia)) * 50] * 3
    data = mujoco.MjData(m)
    n = m.nq - 7
    data.qpos[:n] = finger_posture(robot, robot.open_gap_m)
    start = data.qpos[n : n + 3].copy()
    every = 10
    for k in range(round((robot.open_gap_m / CLOSING_M_S + SETTLE_S) / STEP_S / every)):
        data.ctrl[:] = drive_from_gap(
            robot, max(robot.open_gap_m - CLOSING_M_S * k * every * STEP_S, 0.0)
        )
        mujoco.mj_step(m, data, every)
    pads = data.geom("right").xpos - data.geom("left").xpos
    opening = float(pads[1] - 2 * robot.linkage.pad_half_size[1])
    moved = float(np.linalg.norm(data.qpos[n : n + 3] - start))
    if not shaken or not np.isfinite(data.qpos).all():
        return opening, moved, float("nan")
    m.dof_damping[-6:] = 0.0
    at = data.qpos[n : n + 3].copy()
    # weight alone first, then along x, y, z
    for t in np.arange(0.0, 0.3 + 3 * SHAKE_S, every * STEP_S):
        shake = np.zeros(3)
        if t >= 0.3:
            axis = min(int((t - 0.3) / SHAKE_S), 2)
            shake[axis] = SHAKE_M_S2 * np.sin(2 * np.pi * SHAKE_HZ * (t - 0.3))
        m.opt.gravity[:] = shake + [0.0, 0.0, G]
        mujoco.mj_step(m, data, every)
    return opening, moved, float(np.linalg.norm(data.qpos[n : n + 3] - at))
