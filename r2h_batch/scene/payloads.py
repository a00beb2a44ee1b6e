"""What n payloads make of one model, all at once: the rows that `dynamics.load` and mj_setConst
would write one by one.

The payload is the model's last body and rides on another. With J(x) the Jacobian of that body at
the model's reference posture, taken for a point x, m the payload's mass, c its centre and I its
inertia about c, the mass matrix is that of the rest plus

    m Jp(c)^T Jp(c) + Jr^T I Jr.

What constraints weigh (`invweight0`) is then the mean, over three directions, of the diagonal of J
M^-1 J^T at each body's centre of mass, and the diagonal of M^-1 for a joint (MuJoCo's
documentation, Computation, Constraint model).
"""

import copy
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEAST_INERTIA = 1e-12
"""kg m^2: MuJoCo refuses less."""


class MassProperties(NamedTuple):
    """Of n bodies: mass (kg), centre and principal axes (rotation matrices) in their frames,
    moments about these (kg m^2)."""

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
    cases = np.where(
        trace > 0,
        0,
        np.where((d[:, 0] > d[:, 1]) & (d[:, 0] > d[:, 2]), 1, np.where(d[:, 1] > d[:, 2], 2, 3)),
    )
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
    all_cases = np.stack(
        [np.stack(q, 1) for q in ((w, x, y, z), (x, w, xy, xz), (y, xy, w, yz), (z, xz, yz, w))]
    )  # (4, n, 4)
    quat = all_cases[cases, np.arange(len(R))]
    return np.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True))


class PayloadTables:
    """What depends on the payload in one model, for any number of them."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        last = model.nbody - 1
        self.carrier = int(model.body_parentid[last])
        bare = copy.copy(model)
        bare.body_mass[last], bare.body_inertia[last] = 0.0, 0.0
        data = mujoco.MjData(bare)
        mujoco.mj_setConst(
            bare, data
        )  # subtree masses without it; the data stand at the reference posture
        self.subtreemass = bare.body_subtreemass.copy()
        data.qpos[:] = bare.qpos0
        mujoco.mj_kinematics(bare, data)
        mujoco.mj_comPos(bare, data)
        mujoco.mj_crb(bare, data)
        self.mass = np.zeros((bare.nv, bare.nv))
        mujoco.mj_fullM(bare, data, self.mass)
        self.R, self.p = (
            data.xmat[self.carrier].reshape(3, 3).copy(),
            data.xpos[self.carrier].copy(),
        )
        self.jacobians = np.zeros(
            (bare.nbody, 6, bare.nv)
        )  # at each body's centre of mass; the last: at the carrier's origin
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
