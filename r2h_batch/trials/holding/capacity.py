"""How much a receiving grasp withstands: the force and the moment along each axis at which the object slips in
the hand, for each newton of grip.

Linear programs over the skin points that touch the object. Like `HeldOut.grip_n`, the figures belong to the grasp
and not to a trial. They are stored with the grasps.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from r2h_batch.base.io.cache import ArraySpec, cached, code_digest
from r2h_batch.scene.hand import HandModel
from r2h_batch.scene.objects import ObjectModel, object_digest
from r2h_batch.trials.holding import held_out as sampled
from r2h_batch.trials.holding.contact_forces import ContactForces
from r2h_batch.trials.holding.hand_contact import ObjectSurface, palmar_region
from r2h_batch.trials.holding.held_out import (
    CONTACT_M,
    FRICTION,
    GRAVITY,
    G,
    friction_edges,
    load_held_out,
    stored_of_hand,
)
from r2h_batch.trials.holding.receiving import VERSIONS

Array = NDArray[np.float64]

GRIP_BASE_N, GRIP_PER_WEIGHT = 10.0, 5.0
"""Normal forces of a grip, both sides together: 5 N a side and 2.5 times the weight a side [choice]. The giver
of the sample of Handovers@RPL holds 0.8 kg with 18.4 N a side."""
SAFETY, MOST_GRIP_N = 1.6, 120.0
"""A person grips this much firmer than friction demands at least, and no firmer than this [choice]."""
AXES_SHARE = 0.7
"""Share of the capacity along each axis that acts: all six act together [choice]."""
FORM = {
    "center": ArraySpec("float32", ("holds", 3)),
    "total_n": ArraySpec("float32", ("holds", len(GRAVITY))),
    "capacity": ArraySpec("float32", ("holds", len(GRAVITY), 6)),
}
"""Arrays of an object in the stored file: those of `Withstood`."""
MADE_BY = (
    *sampled.MADE_BY,
    "r2h_batch.trials.holding.capacity",
    "r2h_batch.trials.holding.contact_forces",
)


@dataclass(frozen=True, eq=False)
class Withstood:
    """Loads that the M held-out grasps of O objects withstand, for gravity along each of `GRAVITY`, in the frame of the object
    as it is stored.

    Attributes:
        center: (M, 3) mean of the contact points, m: where force and moment act.
        total_n: (M, 6) sum of the normal forces of a usual grip that carries the object, N; 0: the hand cannot carry it.
        capacity: (M, 6, 6) force along the axes (N) and moment about them (N m) at which the object slips, for each
            newton of `total_n`, less of both signs; 0 where the hand cannot carry it.
        axes: (O, 3, 3) columns are the axes that capacities count by, in the object's frame.
    """

    center: Float32[NDArray[np.float32], "m 3"]
    total_n: Float32[NDArray[np.float32], "m 6"]
    capacity: Float32[NDArray[np.float32], "m 6 6"]
    axes: Float64[Array, "o 3 3"]

    @staticmethod
    def of(
        objects: Sequence[ObjectModel], hand: HandModel, only: frozenset[int] | None = None
    ) -> Withstood:
        """The held-out grasps of these objects (of those in `only`), in the order of `HeldOut`.

        Those of built-in objects are stored. Others are computed once, some seconds each, and kept on disk.
        """
        return _withstood(
            tuple(objects), hand, frozenset(range(len(objects))) if only is None else only
        )


@lru_cache(maxsize=8)
def _withstood(
    objects: tuple[ObjectModel, ...], hand: HandModel, only: frozenset[int]
) -> Withstood:
    own = [o.who.own for k, o in enumerate(objects) if k in only]
    each = [*(_of_object(o, hand) for o in own), {k: s.none() for k, s in FORM.items()}]
    columns = {k: np.concatenate([e[k] for e in each]) for k in FORM}
    axes = [np.eye(3) if (t := o.who.turn) is None else np.asarray(t.R_new_own) for o in objects]
    return Withstood(**columns, axes=np.array(axes, np.float64))


@lru_cache(maxsize=256)
def _of_object(model: ObjectModel, hand: HandModel) -> dict[str, NDArray[Any]]:
    stored = stored_of_hand("capacity.npz", hand)
    if f"{(key := model.who.key)}/capacity" in stored:
        return {k: stored[f"{key}/{k}"] for k in FORM}
    made_of = f"{object_digest(model)} {hand.digest} {code_digest(MADE_BY, VERSIONS)} capacity"
    key = hashlib.sha256(made_of.encode()).hexdigest()
    return cached("capacity", key, lambda: of_held_out(model, hand), FORM)


def of_held_out(model: ObjectModel, hand: HandModel) -> dict[str, NDArray[Any]]:
    """Arrays of `FORM` of the held-out grasps of an object, from the programs."""
    return capacities(model, load_held_out((model,), hand).grasps.vertices.numpy(), hand)


def capacities(
    model: ObjectModel, skin: NDArray[np.float32], hand: HandModel
) -> dict[str, NDArray[Any]]:
    """Arrays of `FORM` of hands with these skins.

    Args:
        model: the object.
        skin: (M, V, 3) float32, frame obj, m.
        hand: whose skins.
    """
    m, k = len(skin), len(GRAVITY)
    shapes = ((m, 3), (m, k), (m, k, 6))
    out = {name: np.zeros(shape, np.float32) for name, shape in zip(FORM, shapes, strict=True)}
    weight, com = float(model.mass) * G, np.asarray(model.com, np.float64)
    for i, (points, normals) in enumerate(_contacts(model, skin, hand)):
        if not len(points):
            continue
        out["center"][i] = center = points.mean(0)
        up = -weight * GRAVITY
        held = np.concatenate([up, np.cross(com - center, up)], 1)
        total, capacity = capacity_of(points - center, normals, held, FRICTION)
        out["total_n"][i], out["capacity"][i] = total, capacity
    return out


def capacity_of(
    arm: Float64[Array, "n 3"],
    normal: Float64[Array, "n 3"],
    held: Float64[Array, "k 6"],
    friction: float,
) -> tuple[Float64[Array, " k"], Float64[Array, "k 6"]]:
    """Grips that carry loads, and what they withstand beside them, for each newton of normal force.

    The least grip that carries a load is found first. The usual grip is firmer (`SAFETY`), and at least what
    people use for this weight. Along an axis it withstands t if forces within the friction cones, with normal
    forces that sum up to that grip, balance the load and t along the axis. The size of the load's own part along
    the axis is added, because the grip withstands it too.

    Args:
        arm: contact points from the centre, m.
        normal: outward unit normals of the object.
        held: forces (N) and moments about the centre (N m) that the hand exerts to carry the object.
        friction: coefficient between skin and object.

    Returns:
        Sums of the normal forces, N (0: friction cannot carry the load), and the capacities, N/N and N m/N.
    """
    contacts = ContactForces(friction_edges(arm, -normal, friction))
    load = held * MOMENT_SCALE
    least, basis = contacts.carry(load, MOST_GRIP_N)
    carries = np.isfinite(least)
    weight = np.linalg.norm(held[carries, :3], axis=1)
    usual = np.maximum(GRIP_BASE_N + GRIP_PER_WEIGHT * weight, SAFETY * least[carries])
    total, capacity = np.zeros(len(held)), np.zeros(held.shape)
    total[carries] = usual.clip(max=MOST_GRIP_N)
    further = contacts.withstand(load[carries], total[carries], basis[carries])
    capacity[carries] = (further + abs(load[carries])) / total[carries, None] / MOMENT_SCALE
    return total, capacity


MOMENT_SCALE = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
"""Moments in N times 0.1 m, as `friction_edges` has them: the programs' rows have one size."""


def _contacts(
    model: ObjectModel, skin: NDArray[np.float32], hand: HandModel
) -> list[tuple[Array, Array]]:
    """Points on the object's surface (n, 3) that the palmar skin of each hand touches, and their outward normals."""
    palmar = np.flatnonzero(palmar_region(hand) >= 0)
    surface = ObjectSurface(model.vertices, model.faces)
    found = []
    for vertices in skin[:, palmar]:
        distance, normal, face = surface.distance(vertices, CONTACT_M)
        # a point at the very cutoff has no normal
        touches = (face >= 0) & (np.linalg.norm(normal, axis=1) > 0.5)
        n = normal[touches].astype(np.float64)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        found.append((vertices[touches].astype(np.float64) - distance[touches, None] * n, n))
    return found
