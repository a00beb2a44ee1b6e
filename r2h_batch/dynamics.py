"""Masses, inertias and servo gains of the arm, and the MuJoCo model that moves it: no contacts, one attached object."""

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from r2h_batch.objects import ObjectModel
from r2h_batch.robot import JOINTS, Robot

Array = NDArray[np.float64]

# UniversalRobots/Universal_Robots_ROS2_Description, config/ur5e/physical_parameters.yaml: shoulder to wrist_3.
LINK_MASS_KG = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
LINK_COM_M = (
    (0.0, -0.00193, -0.02561), (-0.2125, 0.0, 0.11336), (-0.2422, 0.0, 0.0265),
    (0.0, -0.01634, -0.0018), (0.0, 0.01634, -0.0018), (0.0, 0.0, -0.001159),
)  # fmt: skip
LINK_INERTIA = (  # xx, xy, xz, yy, yz, zz (kg m^2) about the centre of mass, axes turned by LINK_ROLL about the link's x
    (0.00700210, 0.00000073, -0.00001053, 0.00648091, 0.00049994, 0.00657286),
    (0.01505885, -0.00005400, 0.00000563, 0.33388086, -0.00000181, 0.33247207),
    (0.00399632, -0.00001365, 0.00137272, 0.07879254, -0.00000660, 0.07848510),
    (0.00165491, -0.00000282, -0.00000438, 0.00135962, 0.00010157, 0.00126279),
    (0.00135617, -0.00000274, 0.00000444, 0.00127827, -0.00005048, 0.00096614),
    (0.00018694, 0.00000006, -0.00000017, 0.00018908, -0.00000092, 0.00025756),
)
LINK_ROLL = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)

GRIPPER_MASS_KG = 1.05  # 2F-85 with its coupling
GRIPPER_COM_M = (0.0, 0.0, 0.055)  # [choice] a box of the gripper's size, gripper frame
GRIPPER_BOX_M = (0.075, 0.15, 0.14)

ARMATURE = 0.1
"""Rotor inertia behind the gear, kg m^2 [choice]: MuJoCo Menagerie's value for this arm."""

KP = (10000.0, 10000.0, 10000.0, 2000.0, 2000.0, 2000.0)
SERVO_RATE = 100.0 / 3.0
"""Stiffness N m/rad and kp / kv in 1/s [choice]: the same rate for all joints, so that what lag there is leaves a straight
joint line straight. 10 kN m/rad on the large joints is what keeps an industrial arm within 0.1 mm while it moves."""


@dataclass(frozen=True)
class Payload:
    """A rigid object held by the gripper: its frame and its mass properties (kg, m, kg m^2 about the centre of mass)."""

    T_gripper_obj: Array
    mass: float
    com: Array
    inertia: Array

    @staticmethod
    def of(model: ObjectModel, T_gripper_obj: ArrayLike) -> "Payload":
        """The payload that an object of the scene is."""
        T = np.asarray(T_gripper_obj, np.float64)
        return Payload(T, float(model.mass), np.asarray(model.com, np.float64), np.asarray(model.inertia, np.float64))


def arm_model(robot: Robot, *, step_s: float, payload_known: bool = True) -> mujoco.MjModel:
    """The UR5e with gripper and a placeholder object, as position servos.

    force = kp (ctrl - q) - kv qd: with ctrl = q_ref + qd_ref kv / kp that is a position and velocity servo. Weight is
    compensated, as the real controller does, and counts against the torque limits; the object's too where its mass is
    known to the controller. No geoms: paths are certified free, the first touch already decides a trial, and the motion
    after it must not depend on it. NaN is left where it appears (no automatic reset).
    """
    spec = mujoco.MjSpec()
    spec.compiler.autolimits, spec.compiler.degree = True, False
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-9, 1e-12
    spec.option.timestep = step_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    body = spec.worldbody.add_body(name="base")
    for i in range(JOINTS):
        inertia = _rolled(LINK_INERTIA[i], LINK_ROLL[i])
        body = _add_body(body, robot.links[i + 1], robot.T_parent_joint[i], LINK_MASS_KG[i], LINK_COM_M[i], inertia)
        torque = float(robot.max_torque[i])
        body.add_joint(
            name=robot.joints[i], type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=ARMATURE,
            range=[robot.lower[i], robot.upper[i]], actfrcrange=[-torque, torque], actgravcomp=True,
        )  # fmt: skip
        spec.add_actuator(
            name=robot.joints[i], target=robot.joints[i], trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            gainprm=[KP[i], *[0] * 9], biasprm=[0, -KP[i], -KP[i] / SERVO_RATE, *[0] * 7],
        )  # fmt: skip
    x, y, z = np.square(GRIPPER_BOX_M) * GRIPPER_MASS_KG / 12
    box = np.diag([y + z, x + z, x + y])
    T = robot.T_wrist3_flange @ robot.T_flange_gripper
    body = _add_body(body, "gripper", T, GRIPPER_MASS_KG, GRIPPER_COM_M, box)
    # turned and shifted inertia: with a plain one the compiler would mark the frames as equal, for all payloads
    tilted = _rolled((1.0, 0.1, 0.2, 2.0, 0.3, 2.5), 0.3) * 1e-4
    body = _add_body(body, "object", _transform((0.1, 0.2, 0.3), 0.4), 0.1, (0.01, 0.02, 0.03), tilted)
    body.gravcomp = float(payload_known)
    return spec.compile()


def loaded_model(model: mujoco.MjModel, payload: Payload, data: mujoco.MjData) -> mujoco.MjModel:
    """A copy of the arm's model that holds this payload; `data` is scratch."""
    model = copy.copy(model)
    load(model, payload, data)
    return model


def load(model: mujoco.MjModel, payload: Payload, data: mujoco.MjData) -> None:
    """Puts a payload into the model itself, whatever it held before; `data` is scratch."""
    i = model.nbody - 1
    inertia, axes = np.linalg.eigh(payload.inertia)
    axes[:, 2] *= np.linalg.det(axes)
    model.body_pos[i] = payload.T_gripper_obj[:3, 3]
    model.body_quat[i] = _quat(payload.T_gripper_obj[:3, :3])
    model.body_ipos[i] = payload.com
    model.body_iquat[i] = _quat(axes)
    model.body_mass[i] = payload.mass
    model.body_inertia[i] = np.maximum(inertia, 1e-12)
    mujoco.mj_setConst(model, data)  # subtree masses, which the centres of mass are divided by


def _add_body(
    parent: mujoco.MjsBody, name: str, T: Array, mass: float, com: ArrayLike, inertia: Array
) -> mujoco.MjsBody:
    xx, yy, zz, xy, xz, yz = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return parent.add_body(
        name=name, pos=T[:3, 3], quat=_quat(T[:3, :3]), explicitinertial=True, mass=mass, ipos=com,
        fullinertia=[xx, yy, zz, xy, xz, yz], gravcomp=1.0,
    )  # fmt: skip


def _quat(R: ArrayLike) -> Array:
    quat_wxyz = np.empty(4)
    mujoco.mju_mat2Quat(quat_wxyz, np.asarray(R, np.float64).ravel())
    return quat_wxyz


def _transform(p: ArrayLike, roll: float) -> Array:
    T = np.eye(4)
    c, s = np.cos(roll), np.sin(roll)
    T[:3, :3], T[:3, 3] = [[1, 0, 0], [0, c, -s], [0, s, c]], p
    return T


def _rolled(tensor: ArrayLike, roll: float) -> Array:
    xx, xy, xz, yy, yz, zz = np.asarray(tensor, np.float64)
    R = _transform((0, 0, 0), roll)[:3, :3]
    return np.asarray(R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T)
