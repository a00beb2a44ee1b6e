"""The weight that friction carries: a linear program over the contacts of an object in a closed gripper.

Statics alone, beside the simulation: no solver's friction, no step. Coulomb's cone, and a patch that withstands turning
about the normal.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray
from scipy.optimize import linprog

from r2h_batch.closed_loop.transfer.model import Places

Array = NDArray[np.float64]

CLOSING_AXIS = 1
"""Pads move along y of the gripper, the left one to +y."""
TANGENTS, TWISTS = 24, 9
"""The cone of friction and torsion is an ellipsoid: these many directions of the tangent, and angles between it and the
torsion. The inscribed polytope is smaller by 1 to 3 %."""
ARM_M = 0.05
"""Moments count over this arm, so that all rows of the program have one size."""
MOST_WEIGHTS = 50.0
"""The program looks no farther."""
LEAST_N = 0.05
"""A pad that presses with less does not touch."""


@dataclass(frozen=True, eq=False)
class PadContacts:
    """K contacts of two pads with an object, frame gripper, float64.

    Attributes:
        side: (K,) 0: left pad, 1: right pad.
        at: (K, 3) where, m.
        normal: (K, 3) unit vector into the object.
        force: (K, 3) of the pad on the object, N.
    """

    side: Int64[NDArray[np.int64], " k"]
    at: Float64[Array, "k 3"]
    normal: Float64[Array, "k 3"]
    force: Float64[Array, "k 3"]

    @staticmethod
    def of(m: mujoco.MjModel, d: mujoco.MjData, places: Places) -> "PadContacts":
        """The contacts that the simulation has now. It computes the forces of this state.

        Args:
            m, d: of `model.transfer_spec`, d as a step left it.
            places: of the model.
        """
        mujoco.mj_forward(m, d)
        rows, wrench = [], np.zeros(6)
        for k, contact in enumerate(d.contact):
            if contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(m, d, k, wrench)
            # MuJoCo's normal points from the first geom to the second
            into = -1.0 if m.geom_bodyid[contact.geom1] == places.object_body else 1.0
            frame = into * contact.frame.reshape(3, 3)
            side = int(places.pads[1] in (contact.geom1, contact.geom2))
            rows.append(np.r_[side, contact.pos, frame[0], frame.T @ wrench[:3]])
        found = np.array(rows, np.float64).reshape(-1, 10)
        return PadContacts(found[:, 0].astype(np.int64), found[:, 1:4], found[:, 4:7], found[:, 7:])

    def pads(self) -> int:
        """How many pads press on the object."""
        normal = (self.force * self.normal).sum(1)
        return sum(bool(normal[self.side == s].sum() > LEAST_N) for s in (0, 1))

    def squeeze_n(self) -> float:
        """Force of a pad along the closing axis, mean of both, N."""
        along = self.force[:, CLOSING_AXIS]
        return float(np.mean([abs(along[self.side == s].sum()) for s in (0, 1)]))


def carried(
    contacts: PadContacts,
    com: Float64[Array, " 3"],
    weight: Float64[Array, " 3"],
    *,
    friction: float,
    torsion_m: float,
) -> float:
    """The largest multiple of the weight that contact forces balance, `MOST_WEIGHTS` at most.

    The pads press with the simulated force along the closing axis, in sum. Forces lie in the cones of the contacts.

    Args:
        contacts: of the settled posture.
        com: (3,) centre of mass, frame gripper, m.
        weight: (3,) N, frame gripper.
        friction: Coulomb's.
        torsion_m: radius of the patch that withstands turning.

    Returns:
        The multiple; 1 and more: friction carries the object. NaN: nothing up to the weight is balanced, not even the
        squeeze alone, or a pad does not touch.
    """
    if contacts.pads() < 2:
        return float("nan")
    edges = [
        _edges(at - com, normal, friction, torsion_m)
        for at, normal in zip(contacts.at, contacts.normal, strict=True)
    ]
    columns = np.concatenate(edges, 1)
    side = np.repeat(contacts.side, [e.shape[1] for e in edges])
    press = np.where(side == 0, 1.0, -1.0) * columns[CLOSING_AXIS]
    balance = np.concatenate([columns, press[None]])
    A = np.column_stack([balance, np.r_[weight, 0.0, 0.0, 0.0, 0.0]])
    b = np.r_[np.zeros(6), 2 * contacts.squeeze_n()]
    bounds = [(0.0, None)] * columns.shape[1] + [(-MOST_WEIGHTS, MOST_WEIGHTS)]
    ends = []
    for sign in (1.0, -1.0):
        cost = np.zeros(A.shape[1])
        cost[-1] = sign
        found = linprog(cost, A_eq=A, b_eq=b, bounds=bounds)
        if not found.success:
            return float("nan")
        ends.append(float(found.x[-1]))
    least, most = ends
    return most if least <= 1.0 else float("nan")


def _edges(
    arm: Float64[Array, " 3"], normal: Float64[Array, " 3"], friction: float, torsion_m: float
) -> Float64[Array, "6 m"]:
    """Forces and moments (over `ARM_M`) of a contact with 1 N along its normal."""
    helper = np.eye(3)[np.abs(normal).argmin()]
    u = np.cross(normal, helper)
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    turn = 2 * np.pi * np.arange(TANGENTS) / TANGENTS
    between = np.linspace(-np.pi / 2, np.pi / 2, TWISTS)[1:-1]
    twists, turns = (x.ravel() for x in np.meshgrid(between, turn, indexing="ij"))
    twists, turns = np.r_[twists, -np.pi / 2, np.pi / 2], np.r_[turns, 0.0, 0.0]
    slide = np.outer(np.cos(turns), u) + np.outer(np.sin(turns), v)
    force = normal + friction * np.cos(twists)[:, None] * slide
    moment = np.cross(arm, force) + friction * torsion_m * np.sin(twists)[:, None] * normal
    return np.asarray(np.concatenate([force, moment / ARM_M], 1).T)
