"""How much a receiving grasp withstands: the force and the moment along each axis at which the object slips in
the hand, for each newton of grip.

Linear programs over the skin points that touch the object. Like `HeldOut.grip_n`, the figures belong to the grasp
and not to a trial. Those of the built-in objects are stored with the grasps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import NDArray
from scipy.optimize import linprog

from r2h_batch.scene.hand import HandModel, load_hand
from r2h_batch.scene.objects import ObjectModel, stored_arrays_of, stored_key
from r2h_batch.trials.holding.hand_contact import ObjectSurface, palmar_region
from r2h_batch.trials.holding.held_out import (
    CONTACT_M,
    FRICTION,
    GRAVITY,
    G,
    HeldOut,
    friction_edges,
)

Array = NDArray[np.float64]

GRIP_BASE_N, GRIP_PER_WEIGHT = 10.0, 5.0
"""Normal forces of a grip, both sides together: 5 N a side and 2.5 times the weight a side [choice]. The giver
of the sample of Handovers@RPL holds 0.8 kg with 18.4 N a side."""
SAFETY, MOST_GRIP_N = 1.6, 120.0
"""A person grips this much firmer than friction demands at least, and no firmer than this [choice]."""
FIELDS = ("center", "point", "normal", "total_n", "capacity")
"""Arrays of an object in the stored file."""


@dataclass(frozen=True, eq=False)
class Grips:
    """How N persons hold an object with a receiving grasp, float64, frame obj.

    Attributes:
        center: (N, 3) mean of the contact points, m: where force and moment act.
        point: (N, 3) the contact point that faces the hand best, m.
        normal: (N, 3) the object's outward normal there.
        axes: (N, 3, 3) columns are the axes that capacities count by.
        total_n: (N,) sum of the normal forces of a usual grip that carries the object, N; 0: the hand cannot
            carry it.
        capacity: (N, 6) force along the axes (N) and moment about them (N m) at which the object slips, for each
            newton of `total_n`, less of both signs; 0 where the hand cannot carry it.
    """

    center: Float64[Array, "n 3"]
    point: Float64[Array, "n 3"]
    normal: Float64[Array, "n 3"]
    axes: Float64[Array, "n 3 3"]
    total_n: Float64[Array, " n"]
    capacity: Float64[Array, "n 6"]


def usual_grips(
    held_out: HeldOut,
    objects: Sequence[ObjectModel],
    grasp: Int64[NDArray[np.int64], " n"],
    down: Float64[Array, "n 3"],
) -> Grips:
    """How persons hold objects with held-out grasps.

    Args:
        held_out: what `load_held_out(objects)` gives.
        objects: of which. Where the figures are not stored, a grasp takes seven linear programs.
        grasp: (N,) rows of the grasps.
        down: (N, 3) unit vector of gravity, frame obj. The nearest of `held_out.GRAVITY` counts, as for `grip_n`.
    """
    index = held_out.grasps.object_index.numpy()[grasp]
    rows = []
    for g, k, d in zip(grasp.tolist(), index.tolist(), down, strict=True):
        model = objects[k]
        R = np.eye(3) if model.turn is None else model.turn.R_new_own
        j = int((d @ R @ GRAVITY.T).argmax())
        own = _stored_row(held_out, k, model, g, j) or _solved(held_out, model, g, j)
        center, point, normal, total, capacity = (np.asarray(x, np.float64) for x in own)
        rows.append((R @ center, R @ point, R @ normal, R, total, capacity))
    shapes = ((3,), (3,), (3,), (3, 3), (), (6,))
    columns = zip(*rows, strict=True) if rows else ([] for _ in shapes)
    pairs = zip(columns, shapes, strict=True)
    return Grips(*(np.array(list(x), np.float64).reshape(-1, *shape) for x, shape in pairs))


def _stored_row(
    held_out: HeldOut, index: int, model: ObjectModel, grasp: int, gravity: int
) -> tuple[NDArray[np.float32], ...] | None:
    own = model if model.turn is None else model.turn.own
    stored, key = stored_arrays_of("capacity.npz", "receiving"), stored_key(own)
    if held_out.grasps.hand is not load_hand() or f"{key}/capacity" not in stored:
        return None
    row = grasp - int((held_out.grasps.object_index < index).sum())
    every = {k: stored[f"{key}/{k}"][row] for k in FIELDS}
    return (*(every[k] for k in FIELDS[:3]), every["total_n"][gravity], every["capacity"][gravity])


@lru_cache(maxsize=4096)
def _solved(
    held_out: HeldOut, model: ObjectModel, grasp: int, gravity: int
) -> tuple[NDArray[np.float32], ...]:
    one = held_out.grasps[grasp : grasp + 1].vertices.numpy()
    if model.turn is not None:
        one = (one.astype(np.float64) @ model.turn.R_new_own).astype(np.float32)
    own = model if model.turn is None else model.turn.own
    made = capacities(own, one, held_out.grasps.hand, (gravity,))
    return (*(made[k][0] for k in FIELDS[:3]), made["total_n"][0, 0], made["capacity"][0, 0])


def capacities(
    model: ObjectModel,
    skin: NDArray[np.float32],
    hand: HandModel,
    gravities: Sequence[int] = range(len(GRAVITY)),
) -> dict[str, NDArray[np.float32]]:
    """Arrays of `FIELDS` of hands with these skins, as in `Grips`, for each of some gravities.

    Args:
        model: the object.
        skin: (M, V, 3) float32, frame obj, m.
        hand: whose skins.
        gravities: K rows of `GRAVITY`; total_n is (M, K), capacity (M, K, 6).
    """
    m, k = len(skin), len(gravities)
    shapes = ((m, 3), (m, 3), (m, 3), (m, k), (m, k, 6))
    out = {name: np.zeros(s, np.float32) for name, s in zip(FIELDS, shapes, strict=True)}
    weight, com = float(model.mass) * G, np.asarray(model.com, np.float64)
    for i, (points, normals) in enumerate(_contacts(model, skin, hand)):
        if not len(points):
            continue
        center, faces = points.mean(0), int((normals @ normals.mean(0)).argmax())
        out["center"][i], out["point"][i], out["normal"][i] = center, points[faces], normals[faces]
        for j, down in enumerate(GRAVITY[list(gravities)]):
            held = np.r_[-weight * down, np.cross(com - center, -weight * down)]
            total, capacity = capacity_of(points - center, normals, held, FRICTION)
            out["total_n"][i, j], out["capacity"][i, j] = total, capacity
    return out


def capacity_of(
    arm: Float64[Array, "n 3"],
    normal: Float64[Array, "n 3"],
    held: Float64[Array, " 6"],
    friction: float,
) -> tuple[float, Float64[Array, " 6"]]:
    """A grip that carries a load, and what it withstands beside it, for each newton of normal force.

    The least grip that carries the load is found first. The usual grip is firmer (`SAFETY`), and at least what
    people use for this weight. Along an axis it withstands t if forces within the friction cones, with normal
    forces that sum up to that grip, balance the load and t along the axis. The size of the load's own part along
    the axis is added, because the grip withstands it too.

    Args:
        arm: contact points from the centre, m.
        normal: outward unit normals of the object.
        held: force (N) and moment about the centre (N m) that the hand exerts to carry the object.
        friction: coefficient between skin and object.

    Returns:
        Sum of the normal forces, N (0: friction cannot carry the load), and the capacities, N/N and N m/N.
    """
    wrench = friction_edges(arm, -normal, friction)
    n, load = wrench.shape[1], held * MOMENT_SCALE
    least = _solve(np.ones(n), wrench, load)
    if least is None or least[1] > MOST_GRIP_N:
        return 0.0, np.zeros(6)
    usual = GRIP_BASE_N + GRIP_PER_WEIGHT * float(np.linalg.norm(held[:3]))
    total = min(max(usual, SAFETY * least[1]), MOST_GRIP_N)
    # the forces against t along the axis, those against -t, and t
    both = np.zeros((12, 2 * n + 1))
    both[:6, :n], both[6:, n:-1] = wrench, wrench
    sums = np.zeros((2, 2 * n + 1))
    sums[0, :n], sums[1, n:-1] = 1.0, 1.0
    push = np.zeros(2 * n + 1)
    push[-1] = -1.0
    capacity = np.zeros(6)
    for k in range(6):
        both[:, -1] = 0.0
        both[[k, k + 6], -1] = -1.0, 1.0
        found = _solve(push, both, np.tile(load, 2), sums, [total] * 2)
        if found is not None:
            capacity[k] = (found[0][-1] + abs(load[k])) / total
    return total, capacity / MOMENT_SCALE


MOMENT_SCALE = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
"""Moments in N times 0.1 m, as `friction_edges` has them: the programs' rows have one size."""


def _solve(
    cost: Array,
    A: Array,
    b: Array,
    A_most: Array | None = None,
    most: Sequence[float] | None = None,
) -> tuple[Array, float] | None:
    """x and cost of the program min cost x, A x = b, A_most x <= most, x >= 0; None: it has no solution."""
    made = linprog(
        cost, A_eq=A, b_eq=b, A_ub=A_most, b_ub=most, method="highs-ds", options={"presolve": False}
    )
    return (made.x, float(made.fun)) if made.status == 0 else None


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
