"""Receiving grasps of an object: an open hand comes down on it, its fingers close, and the exact
meshes say what holds.

A left hand is sampled as a right hand on the mirrored object: nothing about it is assumed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from r2h_batch.base.errors import UserError
from r2h_batch.base.launch import init_warp
from r2h_batch.base.launch.threads import one_torch_thread
from r2h_batch.scene.hand import HandModel, load_hand
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.trials.holding.hand_closing import (
    DEEPEST_M,
    FAMILIES,
    close,
    come_down,
    distance_field,
    field_distance,
    load_families,
    mirrored,
    posture,
)
from r2h_batch.trials.holding.hand_contact import (
    PALM,
    THUMB,
    Contact,
    ObjectSurface,
    hand_depth,
    measure_contact,
)
from r2h_batch.trials.holding.instructions import intents_of
from r2h_batch.verdicts import SIDES

PER_SIDE = 32
PROPOSALS, ROUNDS, ENOUGH, ENOUGH_OF_PART = 600, 20, 160, 16
"""Proposals of a round, rounds, and the holds with which the choice begins: in all, and of one
part. The last two are for `PER_SIDE`, and in proportion for more."""
HOPELESS = 6
"""Rounds after which an object that nothing seemed to hold is given up: one of 3,600 proposals
would be three of all."""
STANDOFF_M = 0.25

CONTACT_M = 0.004
DEPTH_M, BACK_DEPTH_M, THIN_DEPTH_M = 0.004, 0.001, 0.004
"""Stricter than the promise of 5 mm each: float32, and another measure, may disagree by a
little."""
LOOKED_AT_M = 0.006
"""Skin that the field says is farther off than this touches nothing: 4 mm off a surface it
overshoots by 0.2 mm at most."""
DIGITS_RADIUS_M = 0.0075
CROSSING_M = 0.003
ON_REGION = 0.6
"""Share of an S1 hold's contacts that lie on the receiver's region."""

BEST = 0.7
"""Share of a pool, best scores first, that the choice is made from where it is large enough."""

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class NoHoldError(UserError):
    """An object that neither hand can hold, as far as was found."""


@threadpool_limits.wrap(1, user_api="blas")
@one_torch_thread("cpu")
def sample_receiving(
    model: ObjectModel,
    *,
    hand: HandModel | None = None,
    per_side: int = PER_SIDE,
    series: str = "",
    sides: Sequence[int] = (0, 1),
    enough: int = ENOUGH,
) -> dict[str, NDArray[Any]]:
    """Arrays as in `receiving.FIELDS`: up to `per_side` right-hand and left-hand holds; the same
    object and `series`, the same holds.

    Each holds with thumb and a finger from opposite sides and with three regions of the hand or
    more. `sides`: 0 right, 1 left. `enough`: holds with which the choice begins. Raises `NoHoldError` where an object has none
    at all.
    """
    init_warp()
    hand = load_hand() if hand is None else hand
    field = distance_field(ObjectSurface(model.vertices, model.faces))
    found = [_holds(model, hand, side == 1, field, per_side, series, enough) for side in sides]
    if not sum(len(held["side"]) for held in found):
        none = ", ".join(f"0 {SIDES[side]}" for side in sides)
        raise NoHoldError(
            f"{model.name}: {none} receiving grasps found, {per_side} of a side wanted; "
            "a hand must be able to hold the receiver's region (S1) or some part (S0) between thumb and fingers"
        )
    return {k: np.concatenate([held[k] for held in found]) for k in found[0]}


def _holds(
    model: ObjectModel,
    hand: HandModel,
    mirror: bool,
    field: Any,
    count: int,
    series: str,
    wanted: int,
) -> dict[str, NDArray[Any]]:
    flip = np.array([-1.0 if mirror else 1.0, 1.0, 1.0], np.float32)
    side = _Side(model, hand, flip, mirrored(field) if mirror else field)
    pool: list[dict[str, NDArray[Any]]] = []
    known: dict[int, bool] = {}
    digest = hashlib.sha256(
        f"{series}receiving {model.name} {'left' if mirror else 'right'}".encode()
    ).digest()
    key = int.from_bytes(digest[:8], "little")
    more = max(1, count // PER_SIDE)
    for turn in range(more * ROUNDS):
        rng = np.random.Generator(np.random.Philox(key=np.array([key, turn], np.uint64)))
        pool.append(_try(side, rng))
        held = np.concatenate([p["part"] for p in pool])
        enough = len(held) >= more * wanted and all(
            np.isin(held, i.labels).sum() >= ENOUGH_OF_PART for i in intents_of(model)
        )
        last = turn + 1 == more * ROUNDS or (turn + 1 >= HOPELESS and not len(held))
        if not (enough or last):
            continue
        every = {k: np.concatenate([p[k] for p in pool]) for k in pool[0]}
        chosen = _diverse(side, every, count, known)
        if last or len(chosen) == count:
            break
    return _as_arrays(hand, every, chosen, flip)


@dataclass(frozen=True, eq=False)
class _Side:
    """One side's hands on an object: a left hand is a right hand on the object mirrored by
    `flip`."""

    model: ObjectModel
    hand: HandModel
    flip: F32
    field: Any

    @cached_property
    def surface(self) -> ObjectSurface:
        faces = self.model.faces if self.flip[0] > 0 else self.model.faces[:, ::-1]
        return ObjectSurface(self.model.vertices * self.flip, faces)

    @cached_property
    def points(self) -> F32:
        """Points of the object that may lie inside a hand."""
        return np.concatenate([self.model.points * self.flip, self.surface.vertices])

    def holds(self, skin: F32, about: F32) -> bool:
        """Whether a hand with this skin (V, 3), which seems to hold, does so: measured on the exact
        meshes of both.

        `about` (V,): the field's distances, which are the true ones or less."""
        looked_at = about[None] < LOOKED_AT_M
        contact = measure_contact(self.surface, skin[None], hand=self.hand, measured=looked_at)
        if not _holds_well(self.model, contact)[0]:
            return False
        deep = hand_depth(self.points, skin[None], 0, hand=self.hand, least=THIN_DEPTH_M)
        return bool(deep[0] <= THIN_DEPTH_M)


def _try(side: _Side, rng: Any) -> dict[str, NDArray[Any]]:
    """One round of proposals, those kept: hand pose, posture, what they seem to touch, score."""
    hand = side.hand
    families = load_families(hand)
    family, R, start, direction, retreat = _proposals(side.model, side.flip, rng)
    travel = come_down(side.field, families, family, R, start, direction, farthest=2 * STANDOFF_M)
    near = travel < 2 * STANDOFF_M - 0.01
    family, R, start, direction = family[near], R[near], start[near], direction[near]
    travel, retreat = travel[near], retreat[near]
    p = start + (travel - retreat)[:, None] * direction
    rows, flexion, gap = close(side.field, families, family, R, p, CONTACT_M)
    held = ((gap[:, :THUMB] < CONTACT_M).sum(1) >= 1) & (gap.min(1) > -2 * DEEPEST_M)
    rows, flexion = rows[held], flexion[held]
    family, R, p = family[rows], R[rows], p[rows]
    pose, turn = posture(hand, families.turns[family], flexion)
    hand_skin, hand_joints = families.skins.posed(family, turn)
    skin = hand_skin @ R.transpose(0, 2, 1) + p[:, None]
    joints = hand_joints @ R.transpose(0, 2, 1) + p[:, None]
    about = field_distance(side.field, skin.reshape(-1, 3)).reshape(skin.shape[:2])
    contact = measure_contact(side.surface, skin, hand=hand, about=about)
    rows = np.flatnonzero(_holds_well(side.model, contact))
    rows = rows[_crossing(hand, joints[rows], skin[rows]) < CROSSING_M]
    touching = contact.gap[rows] <= CONTACT_M
    return {
        "family": family[rows], "R": R[rows], "p": p[rows], "pose": pose[rows], "joints": joints[rows],
        "skin": skin[rows], "about": about[rows],
        "part": _parts(side.model, contact.face[rows], touching),
        "score": _score(side.model, side.flip, contact, rows, touching, R[rows]),
    }  # fmt: skip


def _proposals(
    model: ObjectModel, flip: F32, rng: Any
) -> tuple[NDArray[np.int32], F32, F32, F32, F32]:
    """family (n,), R_obj_hand (n, 3, 3), start (n, 3), direction (n, 3), retreat (n,): over surface
    points, any turn.

    A spot of the hand, between palm and fingertips, is led along a direction between the palm's and
    the fingers' to a surface point, against its normal or up to 40 degrees beside it.
    """
    n = PROPOSALS
    wanted = model.receiver_face if model.receiver_face.any() else np.ones(len(model.faces), bool)
    corner = (model.vertices * flip)[model.faces].astype(np.float64)
    cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) * flip[0]
    area = np.linalg.norm(cross, axis=1) * wanted
    area /= area.sum()
    named = [area * np.isin(model.face_part, i.labels) for i in intents_of(model)]
    # small parts get their share of proposals
    area = area + np.sum([a / a.sum() for a in named], 0) / len(named)
    share = np.cumsum(area) / area.sum()
    face = np.minimum(np.searchsorted(share, (np.arange(n) + rng.random(n)) / n), len(share) - 1)
    target = corner[face].mean(1)
    normal = cross[face] / np.linalg.norm(cross[face], axis=1, keepdims=True)
    tilt = np.radians(40.0) * np.sqrt(rng.random(n))
    inward = -_tilted(normal, tilt, 2 * np.pi * rng.random(n))
    lean = np.radians(80.0) * rng.random(n)
    ahead = np.stack([-np.sin(lean), -np.cos(lean), np.zeros(n)], 1)
    roll = 2 * np.pi * rng.random(n)
    R = np.einsum("nij,nkj->nik", _frame(inward, roll), _frame(ahead, np.zeros(n)))
    spot = np.stack([-0.055 - 0.085 * rng.random(n), np.zeros(n), -0.02 + 0.05 * rng.random(n)], 1)
    start = target - np.einsum("nij,nj->ni", R, spot) - STANDOFF_M * inward
    retreat = np.where(rng.random(n) < 0.55, 0.0005, 0.06 * rng.random(n))
    family = rng.integers(0, FAMILIES, n)
    return (family.astype(np.int32), *(x.astype(np.float32) for x in (R, start, inward, retreat)))


def _holds_well(model: ObjectModel, contact: Contact) -> NDArray[np.bool_]:
    """Thumb against a finger or more, three regions in all, not too deep, nothing behind; S1: on
    the region."""
    touching = contact.gap <= CONTACT_M
    facing = np.einsum("nk,nfk->nf", contact.normal[:, THUMB], contact.normal[:, :THUMB])
    opposed = (touching[:, :THUMB] & (facing < 0)).any(1)
    good = touching[:, THUMB] & opposed & (touching.sum(1) >= 3)
    good &= (contact.depth <= DEPTH_M) & (contact.back_depth <= BACK_DEPTH_M)
    if model.receiver_face.any():
        on = model.receiver_face[np.maximum(contact.face, 0)] & touching
        good &= on.sum(1) >= ON_REGION * touching.sum(1)
    return good


def _score(
    model: ObjectModel,
    flip: F32,
    contact: Contact,
    rows: NDArray[np.int64],
    touching: NDArray[np.bool_],
    R: F32,
) -> F64:
    """More regions, more skin, thumb and fingers squarely opposed, thumb's side towards the working
    end."""
    facing = np.einsum("nk,nfk->nf", contact.normal[rows, THUMB], contact.normal[rows, :THUMB])
    opposed = np.where(touching[:, :THUMB], -facing, -1.0).max(1)
    digits = touching[:, :PALM].sum(1) / 5 + 0.25 * touching[:, PALM]
    skin = np.minimum(contact.touch[rows] / 0.35, 1.0)
    end = _working_direction(model) * flip
    towards_end = 0.6 * np.clip(R[:, :, 2] @ end, -1, 0.7)
    return digits + skin + 0.5 * opposed + towards_end - 40 * contact.depth[rows]


def _working_direction(model: ObjectModel) -> F64:
    """Unit vector from the receiver's region to the part that works; zero where an object has
    none."""
    if not model.receiver_face.any():
        return np.zeros(3)
    on = model.receiver_face[model.point_face]
    away = model.points[~on].mean(0, dtype=np.float64) - model.points[on].mean(0, dtype=np.float64)
    return away / np.linalg.norm(away)


def _parts(
    model: ObjectModel, face: NDArray[np.int32], touching: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """The part with the most contacts of each hold."""
    part = model.face_part[np.maximum(face, 0)]
    votes = np.stack([((part == k) & touching).sum(1) for k in range(len(model.part_names))], 1)
    return votes.argmax(1).astype(np.uint8)


def _crossing(hand: HandModel, joints: F32, skin: F32) -> F64:
    """(B,) how deep thumb and fingers, and fingers that are not joined, run into each other, as
    capsules."""
    tip = skin[:, hand.tip_vertices.numpy().astype(np.int64)]
    chain = [
        np.stack([joints[:, 1 + 3 * f], joints[:, 2 + 3 * f], joints[:, 3 + 3 * f], tip[:, f]], 1)
        for f in range(5)
    ]
    worst = np.full(len(joints), -1.0)
    for f, g in ((4, 0), (4, 1), (4, 2), (4, 3), (0, 1), (1, 3), (3, 2), (0, 3), (1, 2)):
        for i in range(3):
            for j in range(3):
                if (f, i) == (4, 0) or (f != 4 and i + j == 0):
                    continue  # joined by skin
                gap = _segment_distance(
                    chain[f][:, i], chain[f][:, i + 1], chain[g][:, j], chain[g][:, j + 1]
                )
                worst = np.maximum(worst, 2 * DIGITS_RADIUS_M - gap)
    return worst


def _segment_distance(a: F32, b: F32, c: F32, d: F32) -> F64:
    """Distance of segments a b and c d, (n, 3) each, sampled at 9 points each."""
    t = np.linspace(0, 1, 9)[None, :, None]
    p, q = a[:, None] + t * (b - a)[:, None], c[:, None] + t * (d - c)[:, None]
    return np.linalg.norm(p[:, :, None] - q[:, None], axis=3).min((1, 2))


def _diverse(
    side: _Side,
    every: dict[str, NDArray[Any]],
    count: int,
    known: dict[int, bool],
) -> NDArray[np.int64]:
    """Rows of the best scores that hold, none too like one already taken; that bar falls until
    `count` are found.

    Every part that instructions name gets its share first, as far as it can be held. `known`: what
    was measured of rows.
    """
    palm = every["joints"][:, [0, 1, 4, 7, 10]].mean(1)
    order = np.argsort(-every["score"], kind="stable")
    wanted = {i.part: i.labels for i in intents_of(side.model)}
    stages = [
        (np.isin(every["part"], labels), min(count // 4, count // len(wanted)))
        for labels in wanted.values()
    ]
    stages.append((np.ones(len(order), bool), count))
    taken: list[int] = []
    usable = np.ones(len(order), bool)
    usable[[i for i, holds in known.items() if not holds]] = False
    # the poorest where the best fail
    for allowed, number, share in ((a, n, s) for a, n in stages for s in (BEST, 1.0)):
        ranked = order[allowed[order]]
        ranked = ranked[: max(number, int(share * len(ranked)))]
        scale = 1.0
        while int(allowed[taken].sum()) < min(number, int(usable[ranked].sum())):
            for i in ranked.tolist():
                if int(allowed[taken].sum()) >= number:
                    break
                if i in taken or not usable[i]:
                    continue
                apart = np.linalg.norm(palm[taken] - palm[i], axis=1) / 0.04
                # 0 alike, 4/3 opposite
                turn = 1 - np.einsum("mij,ij->m", every["R"][taken], every["R"][i]) / 3
                if taken and (apart + 2 * turn).min() < scale:
                    continue
                if i not in known:  # measured only of those that are wanted: 10 ms each
                    known[i] = side.holds(every["skin"][i], every["about"][i])
                usable[i] = known[i]
                if usable[i]:
                    taken.append(i)
            scale *= 0.75
    return np.array(taken, np.int64)


def _as_arrays(
    hand: HandModel, every: dict[str, NDArray[Any]], rows: NDArray[np.int64], flip: F32
) -> dict[str, NDArray[Any]]:
    mirror = flip[0] < 0
    T = np.tile(np.eye(4, dtype=np.float32), (len(rows), 1, 1))
    T[:, :3, :3] = flip[:, None] * every["R"][rows] * flip
    T[:, :3, 3] = flip * every["p"][rows]
    axial = np.array([1, -1, -1] if mirror else [1, 1, 1], np.float32)
    pose = (every["pose"][rows].reshape(-1, 16, 3) * axial).reshape(-1, 48)
    return {
        "side": np.full(len(rows), int(mirror), np.int8),
        "T_obj_hand": T,
        "pose": pose.astype(np.float32),
        "shape": load_families(hand).shape[every["family"][rows]],
        "part": every["part"][rows],
    }


def _tilted(z: F64, angle: F64, turn: F64) -> F64:
    """Unit vectors at an angle from z."""
    F = _frame(z, turn)
    return np.sin(angle)[:, None] * F[:, :, 0] + np.cos(angle)[:, None] * F[:, :, 2]


def _frame(z: F64, roll: F64) -> F64:
    """(n, 3, 3) frames with these unit z axes, x turned by `roll` about them; columns x, y, z."""
    helper = np.where(np.abs(z[:, :1]) > 0.7, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    e = np.cross(helper, z)
    e /= np.linalg.norm(e, axis=1, keepdims=True)
    f = np.cross(z, e)
    x = np.cos(roll)[:, None] * e + np.sin(roll)[:, None] * f
    return np.stack([x, np.cross(z, x), z], 2)
