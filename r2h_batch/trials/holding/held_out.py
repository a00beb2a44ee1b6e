"""Receiving grasps that judge whether a person can take an object, and that no predictor reads.

FC, Contact and Intent are shown hands drawn from `receiving.load_receiving`. A judge that used the same
grasps would find what it had shown. These are drawn by the same rules from other random numbers,
eight times as many; tests/methods/predictors and the import contracts keep them away from predictors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Int64
from numpy.typing import NDArray
from scipy.optimize import linprog
from torch import Tensor

from r2h_batch.base.io.cache import ArraySpec, cached, code_digest
from r2h_batch.base.io.progress import progress
from r2h_batch.data.people import people_hand
from r2h_batch.scene.arrays import stored_arrays
from r2h_batch.scene.hand import HandModel, load_hand
from r2h_batch.scene.objects import (
    ObjectModel,
    object_digest,
    stored_arrays_of,
)
from r2h_batch.trials.holding.hand_contact import PALM, ObjectSurface, palmar_region
from r2h_batch.trials.holding.receiving import CODE, FIELDS, FORM, VERSIONS, ReceivingGrasps
from r2h_batch.trials.holding.sampler import NoHoldError, sample_receiving

PER_SIDE = 256
SERIES = "held out "
MADE_BY = (*CODE, "r2h_batch.trials.holding.held_out")

CONTACT_M = 0.005
"""Palmar skin this near to the surface presses on it: what `receiving.CONTACT_M` says."""
FRICTION, CONE_EDGES = 0.6, 8
"""Between skin and object [choice], and edges of the pyramid inside the friction cone."""

G = 9.81

GRAVITY = np.concatenate([np.eye(3), -np.eye(3)])
"""(6, 3) directions of gravity in the object's frame for which the grip is computed."""

TURNS, SAME_M, SAME_SHARE = 12, 0.0015, 0.97
"""An object of revolution, turned by any of so many steps about its axis, has its surface where it was to
1.5 mm, and the receiver's region on this share of the surface."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """M receiving grasps and what they need to carry their object."""

    grasps: ReceivingGrasps
    grip_n: Float32[Tensor, "m 6"]
    """least force of the digit (or palm) that presses hardest, N, for gravity along each of
    `GRAVITY`; inf: friction cannot carry the object"""
    axis: Float32[Tensor, "o 3"]
    """unit axis of each object of revolution, frame obj; 0: the object is none"""
    axis_point: Float32[Tensor, "o 3"]
    """a point of the axis, frame obj, m"""
    first: Int64[Tensor, " o"]
    """row of each object's first grasp"""
    loaded: frozenset[int]
    """objects whose grasps are here; the others have no rows"""

    def only(self, objects: frozenset[int]) -> HeldOut:
        """The grasps of some of the loaded objects."""
        of = self.grasps.object_index.long()
        kept = torch.isin(of, torch.tensor(sorted(objects), dtype=torch.int64, device=of.device))
        number = torch.bincount(of[kept], minlength=len(self.first))
        first = torch.cumsum(number, 0) - number
        grasps, grip_n = self.grasps[kept], self.grip_n[kept]
        return replace(self, grasps=grasps, grip_n=grip_n, first=first, loaded=objects)


_NO_AXIS = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
"""Axis and point of an object that has none, as `HeldOut` holds them."""


class _Loaded:
    """The grasps of some objects on a hand, which grow with the objects that are asked for."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.held_out: HeldOut | None = None


@lru_cache(maxsize=8)
def _loaded(objects: tuple[ObjectModel, ...], hand: HandModel) -> _Loaded:
    return _Loaded()


def _load(objects: tuple[ObjectModel, ...], hand: HandModel, only: frozenset[int]) -> HeldOut:
    every = []
    with progress("receiving grasps (kept on disk)", len(only), "objects") as advance:
        for k, o in enumerate(objects):
            every.append(_of_object(o, hand) if k in only else _no_grasps())
            advance(int(k in only))
    number = [len(e["side"]) for e in every]
    index = np.repeat(np.arange(len(objects), dtype=np.int32), number)
    columns = {
        k: torch.from_numpy(np.concatenate([e[k] for e in every])) for k in (*FIELDS, "grip_n")
    }
    grip = columns.pop("grip_n")
    grasps = ReceivingGrasps(
        torch.from_numpy(index),
        **columns,
        instruction=torch.zeros(len(index), dtype=torch.int32, device="cpu"),
        hand=hand,
    )
    of_revolution = [revolution_axis(o) if k in only else None for k, o in enumerate(objects)]
    lines = np.array([axis or _NO_AXIS for axis in of_revolution], np.float32)
    axis, point = (torch.from_numpy(lines[:, k].copy()) for k in (0, 1))
    first = torch.from_numpy(np.cumsum([0, *number[:-1]]))
    return HeldOut(grasps, grip, axis, point, first, only)


def load_held_out(
    objects: Sequence[ObjectModel],
    hand: HandModel | None = None,
    only: Iterable[int] | None = None,
) -> HeldOut:
    """The held-out receiving grasps of these objects, `object_index` counting them in order.

    Args:
        objects: whose grasps. Those of built-in objects on the built-in hand are stored, and on the built-in people's those
            of r2h-v1's and r2h-v2's objects; others are sampled once, half a CPU minute each, and kept on disk
            (`io.cache`).
        hand: whose hands; None: the built-in one.
        only: indices of the objects that are needed; None: all. Grasps of others are there if an
            earlier call needed them.

    Returns:
        Up to 256 grasps a side and object; none of an object that no hand can hold.
    """
    hand, every = load_hand() if hand is None else hand, range(len(objects))
    needed = frozenset(every if only is None else map(int, only))
    loaded = _loaded(tuple(objects), hand)
    with loaded.lock:
        before = loaded.held_out
        if before is None or not needed <= before.loaded:
            known = frozenset() if before is None else before.loaded
            loaded.held_out = _load(tuple(objects), hand, needed | known)
        assert loaded.held_out is not None
        return loaded.held_out


@lru_cache(maxsize=256)
def _of_object(model: ObjectModel, hand: HandModel) -> dict[str, NDArray[Any]]:
    if (turn := model.who.turn) is not None:
        own = _of_object(turn.own, hand)
        return {**own, "T_obj_hand": turn.poses(own["T_obj_hand"])}
    stored = stored_of_hand("held_out.npz", hand)
    if f"{(key := model.who.key)}/side" in stored:
        return {k: stored[f"{key}/{k}"] for k in (*FIELDS, "grip_n")}
    made_of = (
        f"{object_digest(model)} {hand.digest} {code_digest(MADE_BY, VERSIONS)} {SERIES}{PER_SIDE}"
    )
    key = hashlib.sha256(made_of.encode()).hexdigest()
    form = {**FORM, "grip_n": ArraySpec("float32", ("holds", 6))}
    return cached("held-out", key, lambda: sample_held_out(model, hand=hand), form)


def _no_grasps() -> dict[str, NDArray[Any]]:
    return {
        **{k: spec.none() for k, spec in FORM.items()},
        "grip_n": np.zeros((0, len(GRAVITY)), np.float32),
    }


@lru_cache(maxsize=4)
def stored_of_hand(name: str, hand: HandModel) -> dict[str, NDArray[Any]]:
    """OBJECT/FIELD -> array of a shipped file about this hand's held-out grasps; nothing of another than the built-in hands."""
    if hand is load_hand():
        return stored_arrays("receiving", name)
    return stored_arrays_of(name, "people") if hand is people_hand() else {}


def sample_held_out(
    model: ObjectModel, *, hand: HandModel | None = None
) -> dict[str, NDArray[Any]]:
    """Arrays as in `receiving.FIELDS`, and `grip_n` as in `HeldOut`."""
    hand = load_hand() if hand is None else hand
    try:
        found = sample_receiving(model, hand=hand, per_side=PER_SIDE, series=SERIES)
    except NoHoldError:
        found = {k: v for k, v in _no_grasps().items() if k in FIELDS}
    none = torch.zeros(len(found["side"]), dtype=torch.int32, device="cpu")
    skin = ReceivingGrasps(
        none, **{k: torch.from_numpy(found[k]) for k in FIELDS}, instruction=none, hand=hand
    ).vertices.numpy()
    return {**found, "grip_n": grip_forces(model, skin, hand)}


def grip_forces(
    model: ObjectModel, skin: NDArray[np.float32], hand: HandModel
) -> NDArray[np.float32]:
    """(M, 6) `HeldOut.grip_n` of hands with these skins (M, V, 3), frame obj.

    A linear program for each direction: every palmar skin point within `CONTACT_M` of the surface may
    press and rub. The forces balance weight and moment about the centre of mass, and the largest sum of
    normal forces of one region (five digits and the palm) is as small as can be. Points that lie close
    together share a region's force: an area carries what a point could not.
    """
    region = palmar_region(hand)
    palmar = np.flatnonzero(region >= 0)
    surface = ObjectSurface(model.vertices, model.faces)
    com, weight = np.asarray(model.com, np.float64), float(model.mass) * G
    out = np.full((len(skin), len(GRAVITY)), np.inf, np.float32)
    for i, points in enumerate(skin[:, palmar]):
        distance, normal, _ = surface.distance(points, CONTACT_M)
        touches = distance < CONTACT_M
        if not touches.any():
            continue
        wrench = friction_edges(
            points[touches].astype(np.float64) - com,
            -normal[touches].astype(np.float64),
            FRICTION,
        )
        of = np.repeat(region[palmar][touches], CONE_EDGES)
        presses = (of == np.arange(PALM + 1)[:, None]).astype(np.float64)
        n = wrench.shape[1]
        for j, down in enumerate(GRAVITY):
            found = linprog(
                np.r_[np.zeros(n), 1.0],
                A_ub=np.c_[presses, -np.ones(len(presses))],
                b_ub=np.zeros(len(presses)),
                A_eq=np.c_[wrench, np.zeros(6)],
                b_eq=np.r_[-down, np.zeros(3)],  # of a weight of 1 N
                method="highs",
            )
            if found.status == 0:
                out[i, j] = weight * found.fun
    return out


def friction_edges(
    arm: NDArray[np.float64], inward: NDArray[np.float64], friction: float
) -> NDArray[np.float64]:
    """(6, n * CONE_EDGES) force and moment of the friction pyramids' edges, each with 1 N along the
    normal; moments in N times 0.1 m.

    Args:
        arm: (n, 3) contact points from where moments are taken, m.
        inward: (n, 3) inward normals of the object, of any length.
        friction: coefficient.
    """
    inward = inward / np.linalg.norm(inward, axis=1, keepdims=True)
    helper = np.where(np.abs(inward[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    u = np.cross(helper, inward)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(inward, u)
    turn = 2 * np.pi * np.arange(CONE_EDGES) / CONE_EDGES
    force = inward[:, None] + friction * (
        np.cos(turn)[:, None] * u[:, None] + np.sin(turn)[:, None] * v[:, None]
    )
    moment = np.cross(arm[:, None], force) / 0.1
    return np.concatenate([force, moment], 2).reshape(-1, 6).T


@lru_cache(maxsize=256)
def revolution_axis(model: ObjectModel) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
    """Unit axis and a point of it (frame obj, m), if the object and the receiver's region are the same
    when turned about it; None if not.

    Only axes through the centre of mass along a principal direction of the surface can be one.
    """
    corner = model.vertices[model.faces].astype(np.float64)
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    middle = corner.mean(1)
    center = area @ middle / area.sum()
    off = middle - center
    spread, axes = np.linalg.eigh((off * area[:, None]).T @ off)
    order = np.argsort([abs(spread[(k + 1) % 3] - spread[(k + 2) % 3]) for k in range(3)])
    axis = axes[:, order[0]]
    surface = ObjectSurface(model.vertices, model.faces)
    rng = np.random.Generator(np.random.Philox(key=7))
    face = rng.choice(len(area), 2000, p=area / area.sum())
    share = rng.dirichlet(np.ones(3), len(face))
    points = np.einsum("nk,nkd->nd", share, corner[face]) - center
    for step in range(1, TURNS):
        c, s = np.cos(2 * np.pi * step / TURNS), np.sin(2 * np.pi * step / TURNS)
        turned = (
            c * points + s * np.cross(axis, points) + (1 - c) * (points @ axis)[:, None] * axis
        ) + center
        distance, _, nearest = surface.distance(turned.astype(np.float32), 0.05)
        if np.abs(distance).max() > SAME_M:
            return None
        if (model.receiver_face[nearest] == model.receiver_face[face]).mean() < SAME_SHARE:
            return None
    return tuple(axis.tolist()), tuple(center.tolist())
