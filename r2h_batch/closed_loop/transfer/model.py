"""The transfer as a MuJoCo model: gripper with motor and wrist, object, and the person's hand on a compliant arm.

The object is a child of the hand: three slides and a ball at the centre of the contacts. Their dry friction is
the grasp. While it is 0 the object does not feel the hand. Fingers of the hand are not in the model: what the
contacts withstand comes from a linear program (`trials.holding.capacity`), and whether the hand meets the
gripper is reception's question. The world is the gripper's frame at the handover pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.judge.grasp_physics import (
    FINGERS,
    FRICTION,
    IMPRATIO,
    TOLERANCE,
    TORSION_M,
    Material,
    add_closing_fingers,
    add_motor,
    finger_posture,
    full_effort,
    opening_speed,
)
from r2h_batch.scene.dynamics import add_servo, quat_wxyz
from r2h_batch.scene.model_parts import add_mesh
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot

Array = NDArray[np.float64]

TICK_S = 1 / 120
"""Person, sensor and policy act this often: the rate of Handovers@RPL."""
GRIPPER_S = 0.06
"""From the policy's decision to the fingers' first move [choice]."""
STEPS = 6
"""Steps of the simulation in a tick: 1.39 ms each. docs/transfer.md says what half of it changes."""

BASE, WRIST_N_M = (4.0, 0.02), 60_000.0
"""The moving base of the gripper, its mass (kg) and inertia about each axis (kg m^2), and how stiffly the robot's arm
holds it [choice]. The force of that spring is what the wrist's sensor reads."""
ARM_KG, ARM_KG_M2, ARM_NM_RAD, DAMPING = 1.2, 0.005, 6.0, 0.9
"""Hand and what of the forearm moves with it, its stiffness against turning, and the share of critical damping
[choice]. The stiffness along the axes is the person's."""
SLIP = ("slip_x", "slip_y", "slip_z", "slip_turn")
HAND = ("hand_x", "hand_y", "hand_z", "hand_rx", "hand_ry", "hand_rz")
WRIST = ("wrist_x", "wrist_y", "wrist_z")
CARRIED_DAMPING, FREE_DAMPING = 50.0, 1e-5
"""Damping of the object while the gripper closes, per kg and kg m^2, and after that."""
TIES = (0.0056, 1.0)
"""MuJoCo's solref of the gripper's linkage: in seconds, so that half the step is no other gripper."""
GRASP_SOLREF, GRASP_SOLIMP = (0.0028, 1.0), (0.9995, 0.9999, 0.001, 0.5, 2.0)
"""MuJoCo's solref and solimp of the dry friction in the hand; the default impedance creeps by 40 mm."""
MEMORY = 2**21
"""Bytes for contacts and constraints: 30 times what transfers use. MuJoCo's own choice is 15 MB a world."""
LEAST_FRICTION = 1e-6
"""Dry friction of an open hand: rows of constraints must not come and go."""


@dataclass(frozen=True)
class Setting:
    """Numbers that a study varies; the defaults are the benchmark's.

    Attributes:
        steps: simulation steps in a tick.
        pad_friction: of the gripper's pads.
        torsion_m: radius of the pads' patches that withstand turning about the normal.
        skin_friction: of the hand, relative to 0.6, which the capacities were made with.
        mass: factor of the object's mass, which robot and person know.
        load_time: factor of the time in which persons grip and take the weight.
        grip, arm_n_m, pull_n, pause_s: factors of what persons are drawn with (`person.Persons`).
    """

    steps: int = STEPS
    pad_friction: float = FRICTION
    torsion_m: float = TORSION_M
    skin_friction: float = 1.0
    mass: float = 1.0
    load_time: float = 1.0
    grip: float = 1.0
    arm_n_m: float = 1.0
    pull_n: float = 1.0
    pause_s: float = 1.0


def transfer_spec(robot: Robot, model: ObjectModel, setting: Setting) -> mujoco.MjSpec:
    """The model of one object, with the hand at the gripper's origin (`place` puts it right)."""
    step = TICK_S / setting.steps
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.memory = MEMORY
    option = spec.option
    option.timestep, option.gravity = step, [0, 0, 0]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio, option.tolerance = IMPRATIO, TOLERANCE
    option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    material = Material(torsion_m=setting.torsion_m)
    base = spec.worldbody.add_body(
        name="gripper", explicitinertial=True, mass=BASE[0], inertia=[BASE[1]] * 3
    )
    for name, axis in zip(WRIST, np.eye(3), strict=True):
        base.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        add_servo(spec, name, WRIST_N_M, 2 * np.sqrt(WRIST_N_M * BASE[0]))
    add_closing_fingers(
        spec, base, robot, stiff=TIES, material=material, friction=setting.pad_friction
    )
    for name in FINGERS:
        spec.geom(name).priority = 1  # the pads' material counts
        add_motor(spec, name, full_effort(robot) / opening_speed(robot))
    hand = spec.worldbody.add_body(
        name="hand", explicitinertial=True, mass=ARM_KG, inertia=[ARM_KG_M2] * 3
    )
    for k, name in enumerate(HAND):
        kind = mujoco.mjtJoint.mjJNT_SLIDE if k < 3 else mujoco.mjtJoint.mjJNT_HINGE
        hand.add_joint(name=name, type=kind, axis=np.eye(3)[k % 3])
        # the compiler's number: `place` sets the person's
        add_servo(spec, name, ARM_NM_RAD, 2 * DAMPING * np.sqrt(ARM_NM_RAD * 2 * ARM_KG_M2))
    grip = hand.add_body(name="grip")
    solver = {
        "solimp_friction": GRASP_SOLIMP,
        "solref_friction": GRASP_SOLREF,
        "frictionloss": LEAST_FRICTION,
    }
    for name, axis in zip(SLIP[:3], np.eye(3), strict=True):
        grip.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, **solver)
    grip.add_joint(name=SLIP[3], type=mujoco.mjtJoint.mjJNT_BALL, **solver)
    inertia = np.asarray(model.inertia, np.float64) * setting.mass
    xx, yy, zz, xy, xz, yz = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    held = grip.add_body(
        name="object", explicitinertial=True, mass=float(model.mass) * setting.mass, ipos=model.com,
        fullinertia=[xx, yy, zz, xy, xz, yz],
    )  # fmt: skip
    for k, (vertices, faces) in enumerate(model.pieces):
        add_mesh(spec, f"piece_{k}", vertices.astype(np.float64), faces, convex=True)
        held.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"piece_{k}", contype=2, conaffinity=1,
            **material.of_geom(setting.pad_friction),
        )  # fmt: skip
    for body in spec.bodies:
        body.gravcomp = float(body.name not in ("world", "object"))
    return spec


@dataclass(frozen=True)
class Places:
    """Where the model's joints, motors and bodies are in MuJoCo's arrays."""

    wrist_q: NDArray[np.int64]
    wrist_v: NDArray[np.int64]
    fingers: NDArray[np.int64]
    wrist: NDArray[np.int64]
    hand: NDArray[np.int64]
    slip_q: NDArray[np.int64]
    slip_v: NDArray[np.int64]
    pads: NDArray[np.int64]
    hand_body: int
    grip_body: int
    object_body: int

    @staticmethod
    def of(m: mujoco.MjModel) -> "Places":
        """The places of a model that `transfer_model` made: the same for every object."""
        joint = [m.joint(n).id for n in WRIST]
        q, v = int(m.jnt_qposadr[m.joint(SLIP[0]).id]), int(m.jnt_dofadr[m.joint(SLIP[0]).id])

        def motors(names: Sequence[str]) -> NDArray[np.int64]:
            return np.array([m.actuator(n).id for n in names])

        return Places(
            m.jnt_qposadr[joint].astype(np.int64),
            m.jnt_dofadr[joint].astype(np.int64),
            motors(FINGERS),
            motors(WRIST),
            motors(HAND),
            np.arange(q, q + 7),
            np.arange(v, v + 6),
            np.array([m.geom(n).id for n in FINGERS]),
            m.body("hand").id,
            m.body("grip").id,
            m.body("object").id,
        )


def place(
    m: mujoco.MjModel, places: Places, T_gripper_slip: Array, T_gripper_obj: Array, arm_n_m: float
) -> None:
    """Puts the hand at its grasp, the object into the gripper, and the person's stiffness into the arm."""
    T = np.linalg.inv(T_gripper_slip) @ T_gripper_obj
    m.body_pos[places.hand_body] = T_gripper_slip[:3, 3]
    m.body_quat[places.grip_body] = quat_wxyz(T_gripper_slip[:3, :3])
    m.body_pos[places.object_body] = T[:3, 3]
    m.body_quat[places.object_body] = quat_wxyz(T[:3, :3])
    damping = 2 * DAMPING * np.sqrt(arm_n_m * ARM_KG)
    m.actuator_gainprm[places.hand[:3], 0] = arm_n_m
    m.actuator_biasprm[places.hand[:3], 1] = -arm_n_m
    m.actuator_biasprm[places.hand[:3], 2] = -damping
    mujoco.mj_setConst(m, mujoco.MjData(m))


def start_posture(m: mujoco.MjModel, robot: Robot, gap_m: float) -> Array:
    """qpos with the fingers at a gap and everything else where the model has it."""
    q = m.qpos0.copy()
    names = ("left", "left_pad", "right", "right_pad")
    some = [m.joint(n).id for n in names if mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_JOINT, n) >= 0]
    q[m.jnt_qposadr[some]] = finger_posture(robot, min(gap_m, robot.open_gap_m))
    return q
