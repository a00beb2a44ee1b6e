"""Masses, inertias and servo gains of the arm, MuJoCo bodies made of them, and the payload.

`load` puts one payload into a model. `PayloadTables` finds the rows that `load` and mj_setConst
would write, for n payloads at once. The payload is the model's last body and rides on another. With
J(x) the Jacobian of that body at the model's reference posture, taken for a point x, m the
payload's mass, c its centre and I its inertia about c, the mass matrix is that of the rest plus

    m Jp(c)^T Jp(c) + Jr^T I Jr.

A constraint's weight (`invweight0`) is then the mean, over three directions, of the diagonal of
J M^-1 J^T at each body's centre of mass, and the diagonal of M^-1 for a joint (MuJoCo's
documentation, Computation, Constraint model).
"""

import copy
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import Robot, rolled

Array = NDArray[np.float64]

LEAST_INERTIA = 1e-12
"""kg m^2: MuJoCo refuses less."""


class MassProperties(NamedTuple):
    """Mass properties of n bodies: mass (kg), centre and principal axes (rotation matrices) in
    their frames, moments about these (kg m^2)."""

    mass: Array  # (n,)
    com: Array  # (n, 3)
    axes: Array  # (n, 3, 3)
    moments: Array  # (n, 3)


def principal(inertia: Array) -> tuple[Array, Array]:
    """Moments (..., 3) and right-handed axes (..., 3, 3) of inertia tensors (..., 3, 3)."""
    moments, axes = np.linalg.eigh(inertia)
    axes[..., 2] *= np.linalg.det(axes)[..., None]
    return np.maximum(moments, LEAST_INERTIA), axes


def quats_wxyz(R: Array) -> Array:
    """Quaternions (n, 4) of rotation matrices (n, 3, 3), as mju_mat2Quat orders and signs them."""
    d = R[:, [0, 1, 2], [0, 1, 2]]
    trace = d.sum(1)
    # the largest of the four comes from its square, the others from sums and differences over it
    x_is_largest = (d[:, 0] > d[:, 1]) & (d[:, 0] > d[:, 2])
    largest_axis = np.where(x_is_largest, 1, np.where(d[:, 1] > d[:, 2], 2, 3))
    cases = np.where(trace > 0, 0, largest_axis)
    signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])[cases]
    largest = 0.5 * np.sqrt(1.0 + (signs * d).sum(1))
    over = 0.25 / largest
    turn = (
        np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
        * over[:, None]
    )
    even = (
        np.stack([R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]], 1)
        * over[:, None]
    )
    w, (x, y, z), (xy, xz, yz) = largest, turn.T, even.T
    # (4, n, 4)
    all_cases = np.stack(
        [np.stack(q, 1) for q in ((w, x, y, z), (x, w, xy, xz), (y, xy, w, yz), (z, xz, yz, w))]
    )
    quat = all_cases[cases, np.arange(len(R))]
    return np.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True))


class PayloadTables:
    """Fields of one model that depend on the payload, for any number of payloads."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        last = model.nbody - 1
        self.carrier = int(model.body_parentid[last])
        bare = copy.copy(model)
        bare.body_mass[last], bare.body_inertia[last] = 0.0, 0.0
        data = mujoco.MjData(bare)
        # subtree masses without it; the data stand at the reference posture
        mujoco.mj_setConst(bare, data)
        self.subtreemass = bare.body_subtreemass.copy()
        data.qpos[:] = bare.qpos0
        mujoco.mj_kinematics(bare, data)
        mujoco.mj_comPos(bare, data)
        mujoco.mj_crb(bare, data)
        self.mass = np.zeros((bare.nv, bare.nv))
        mujoco.mj_fullM(bare, data, self.mass)
        self.R = data.xmat[self.carrier].reshape(3, 3).copy()
        self.p = data.xpos[self.carrier].copy()
        # at each body's centre of mass; the last: at the carrier's origin
        self.jacobians = np.zeros((bare.nbody, 6, bare.nv))
        for body in range(bare.nbody - 1):
            j = self.jacobians[body]
            mujoco.mj_jacBodyCom(bare, data, j[:3], j[3:], body)
        j = self.jacobians[last]
        mujoco.mj_jac(bare, data, j[:3], j[3:], self.p, self.carrier)
        self.above = np.zeros(bare.nbody, bool)  # bodies that carry the payload
        body = last
        while body:
            self.above[body] = True
            body = int(model.body_parentid[body])
        self.above[0] = True
        # bodies that no joint moves
        self.fixed = np.array([not np.any(self.jacobians[b]) for b in range(bare.nbody)])

    def rows(self, T_carrier: Array, held: MassProperties) -> dict[str, Array]:
        """Fields of the model by name: of the last body alone (n, ...) where only it changes, else
        of all bodies or joints.

        `T_carrier` (n, 4, 4): the payloads' frames in the body that carries them.
        """
        R, p = T_carrier[:, :3, :3], T_carrier[:, :3, 3]
        center = self.p + ((R @ held.com[:, :, None])[..., 0] + p) @ self.R.T  # world
        axes = self.R @ R @ held.axes
        at = self._moved(center)  # (n, 6, nv)
        turned = np.swapaxes(axes, 1, 2) @ at[:, 3:]  # angular velocity in the principal axes
        mass = self.mass + held.mass[:, None, None] * (np.swapaxes(at[:, :3], 1, 2) @ at[:, :3])
        mass = mass + np.swapaxes(turned, 1, 2) @ (held.moments[:, :, None] * turned)
        inverse = np.linalg.inv(mass)
        weight = np.zeros((len(T_carrier), self.model.nbody, 2))
        bodies = np.flatnonzero(~self.fixed)[:-1]
        j = self.jacobians[bodies].reshape(-1, mass.shape[1])
        diagonal = ((j @ inverse) * j).sum(2).reshape(len(T_carrier), -1, 2, 3)
        weight[:, bodies] = diagonal.mean(3)
        weight[:, -1] = ((at @ inverse) * at).sum(2).reshape(-1, 2, 3).mean(2)
        return {
            "body_pos": p,
            "body_quat": quats_wxyz(R),
            "body_ipos": held.com,
            "body_iquat": quats_wxyz(held.axes),
            "body_mass": held.mass,
            "body_inertia": held.moments,
            "body_subtreemass": self.subtreemass + np.where(self.above, held.mass[:, None], 0.0),
            "body_invweight0": weight,
            "dof_invweight0": np.diagonal(inverse, axis1=1, axis2=2).copy(),
        }

    def _moved(self, point: Array) -> Array:
        """The carrier's Jacobian (n, 6, nv) for points (n, 3) that ride on it: v(x) = v(p) + w x (x
        - p)."""
        j = np.broadcast_to(self.jacobians[-1], (len(point), *self.jacobians.shape[1:])).copy()
        j[:, :3] += np.cross(j[:, 3:], (point - self.p)[:, :, None], axis=1)
        return j


GRIPPER_COM_M = (0.0, 0.0, 0.055)  # [choice] a box of the gripper's size, gripper frame
GRIPPER_BOX_M = (0.075, 0.15, 0.14)

FINGER_MASS_KG = {
    "outer_knuckle": 0.00853,
    "outer_finger": 0.02261,
    "inner_finger": 0.0104,
    "inner_knuckle": 0.02712,
}
"""airo-models, robotiq_2f_85.urdf; a pad is part of its inner finger."""


@dataclass(frozen=True)
class Payload:
    """A rigid object held by the gripper: its frame and its mass properties (kg, m, kg m^2 about
    the centre of mass)."""

    T_gripper_obj: Array
    mass: float
    com: Array
    inertia: Array

    @staticmethod
    def of(model: ObjectModel, T_gripper_obj: ArrayLike) -> "Payload":
        """The payload that an object of the scene is."""
        T, com, inertia = (
            np.asarray(x, np.float64) for x in (T_gripper_obj, model.com, model.inertia)
        )
        return Payload(T, float(model.mass), com, inertia)


def arm_model(robot: Robot, *, step_s: float, payload_known: bool = True) -> mujoco.MjModel:
    """The arm with gripper and a placeholder object, as position servos: no geoms, the gripper
    rigid.

    scene_model.py builds the whole scene around the same arm.
    """
    spec = new_spec(step_s)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    gripper = add_gripper(add_arm(spec, robot, spec.worldbody)[-1], robot, robot.linkage.mass_kg)
    add_object(gripper, payload_known=payload_known)
    return spec.compile()


def new_spec(step_s: float) -> mujoco.MjSpec:
    """An empty model with the project's integrator. NaN is left where it appears (no automatic
    reset)."""
    spec = mujoco.MjSpec()
    spec.compiler.autolimits, spec.compiler.degree = True, False
    spec.compiler.boundmass, spec.compiler.boundinertia = 1e-9, 1e-12
    spec.option.timestep = step_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    return spec


def add_arm(spec: mujoco.MjSpec, robot: Robot, parent: mujoco.MjsBody) -> list[mujoco.MjsBody]:
    """The arm's bodies, base to the last, each with its mass, joint and servo.

    force = kp (ctrl - q) - kv qd: with ctrl = q_ref + qd_ref kv / kp that is a position and
    velocity servo. Weight is compensated, as the real controller does, and counts against the
    torque limits.
    """
    dynamics, bodies = robot.dynamics, [parent.add_body(name=robot.links[0])]
    for i in range(len(robot.joints)):
        link, mass = robot.links[i + 1], float(dynamics.mass[i])
        T = robot.T_parent_joint[i]
        body = add_body(bodies[-1], link, T, mass, dynamics.com[i], dynamics.inertia[i])
        torque = float(robot.max_torque[i])
        body.add_joint(
            name=robot.joints[i], type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=dynamics.armature,
            range=[robot.lower[i], robot.upper[i]], actfrcrange=[-torque, torque], actgravcomp=True,
        )  # fmt: skip
        add_servo(
            spec,
            robot.joints[i],
            dynamics.stiffness[i],
            dynamics.stiffness[i] / dynamics.servo_rate,
        )
        bodies.append(body)
    return bodies


def add_servo(spec: mujoco.MjSpec, joint: str, kp: float, kv: float) -> None:
    """force = kp (ctrl - q) - kv qd at a joint."""
    spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE, gainprm=[kp, *[0] * 9], biasprm=[0, -kp, -kv, *[0] * 7],
    )  # fmt: skip


def add_gripper(wrist: mujoco.MjsBody, robot: Robot, mass: float) -> mujoco.MjsBody:
    """The gripper's body: a box of its size, of what mass the moving parts leave."""
    x, y, z = np.square(GRIPPER_BOX_M) * mass / 12
    T = robot.T_wrist3_flange @ robot.T_flange_gripper
    return add_body(wrist, robot.links[-1], T, mass, GRIPPER_COM_M, np.diag([y + z, x + z, x + y]))


def add_object(gripper: mujoco.MjsBody, *, payload_known: bool) -> mujoco.MjsBody:
    """The object's body with placeholders that `load` replaces; its weight is compensated where the
    controller knows it."""
    # turned and shifted inertia: with a plain one the compiler would mark the frames as equal, for
    # all payloads
    tilted = rolled((1.0, 0.1, 0.2, 2.0, 0.3, 2.5), 0.3) * 1e-4
    body = add_body(
        gripper, "object", _transform((0.1, 0.2, 0.3), 0.4), 0.1, (0.01, 0.02, 0.03), tilted
    )
    body.gravcomp = float(payload_known)
    return body


def load(model: mujoco.MjModel, payload: Payload, data: mujoco.MjData) -> None:
    """Puts a payload into the model itself (its last body) in place of an earlier one; `data` is
    scratch."""
    i = model.nbody - 1
    inertia, axes = principal(payload.inertia)
    model.body_pos[i] = payload.T_gripper_obj[:3, 3]
    model.body_quat[i] = quat_wxyz(payload.T_gripper_obj[:3, :3])
    model.body_ipos[i] = payload.com
    model.body_iquat[i] = quat_wxyz(axes)
    model.body_mass[i] = payload.mass
    model.body_inertia[i] = inertia
    mujoco.mj_setConst(model, data)  # subtree masses, which the centres of mass are divided by


def add_body(
    parent: mujoco.MjsBody, name: str, T: Array, mass: float, com: ArrayLike, inertia: Array
) -> mujoco.MjsBody:
    """A body at T in its parent, of the given mass properties, its weight compensated."""
    xx, yy, zz, xy, xz, yz = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return parent.add_body(
        name=name, pos=T[:3, 3], quat=quat_wxyz(T[:3, :3]), explicitinertial=True, mass=mass, ipos=com,
        fullinertia=[xx, yy, zz, xy, xz, yz], gravcomp=1.0,
    )  # fmt: skip


def quat_wxyz(R: ArrayLike) -> Array:
    """The quaternion of a rotation matrix, as MuJoCo orders it."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.asarray(R, np.float64).ravel())
    return quat


def _transform(p: ArrayLike, roll: float) -> Array:
    T = np.eye(4)
    c, s = np.cos(roll), np.sin(roll)
    T[:3, :3], T[:3, 3] = [[1, 0, 0], [0, c, -s], [0, s, c]], p
    return T
