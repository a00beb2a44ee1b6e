"""Hands that close on an object: sixty-four come down on it and bend their fingers in its distance
field; their skins follow by linear blend skinning in float32.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from r2h_batch.base.launch import over_trials
from r2h_batch.kernels.receiver import close_hand
from r2h_batch.scene.hand import HandModel
from r2h_batch.scene.solid import winding_of_nodes
from r2h_batch.trials.holding.hand_contact import REGIONS, THUMB, ObjectSurface

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
JOINTS = 16


@dataclass(frozen=True, eq=False)
class Skins:
    """K right hands at rest: posed in a tenth of `HandModel.pose`'s time, 1e-7 m beside it, not the
    same bits everywhere."""

    rest: F32
    """(K, V, 3) skins"""
    joints: F64
    """(K, 16, 3)"""
    weights: F32
    """(V, 16)"""
    parents: tuple[int, ...]
    pose_basis: F32 | None
    """(135, V * 3)"""

    @classmethod
    def of(cls, hand: HandModel, shape: F32) -> Skins:
        """Hands of these shapes (K, 10)."""
        plain = hand.pose(
            torch.zeros((len(shape), 48), dtype=torch.float32, device="cpu"),
            torch.from_numpy(shape),
        )
        weights = hand.weights.double().numpy()
        basis = None if hand.pose_basis is None else hand.pose_basis.numpy().reshape(-1, 135).T
        return cls(
            plain.vertices.numpy(),
            plain.joints.double().numpy(),
            np.ascontiguousarray(weights / weights.sum(1, keepdims=True), np.float32),
            tuple(int(p) for p in hand.parents),
            None if basis is None else np.ascontiguousarray(basis, np.float32),
        )

    def posed(self, which: NDArray[np.integer], turn: F64) -> tuple[F32, F32]:
        """Skins (n, V, 3) and joints (n, 16, 3), hand frame, of hands `which` (n,) with joints
        turned (n, 16, 3, 3)."""
        rest = self.joints[which]
        R, at = [turn[:, 0]], [rest[:, 0]]
        for j in range(1, JOINTS):
            p = self.parents[j]
            R.append(R[p] @ turn[:, j])
            at.append(np.einsum("nij,nj->ni", R[p], rest[:, j] - rest[:, p]) + at[p])
        world, joints = np.stack(R, 1), np.stack(at, 1)
        shift = joints - np.einsum("njik,njk->nji", world, rest)
        # (n, 12, 16): nine of the turn, three of the shift, of each joint; blended, a plane of each
        # for all of the skin
        moves = (
            np.concatenate([world.reshape(-1, JOINTS, 9), shift], 2)
            .transpose(0, 2, 1)
            .astype(np.float32)
        )
        blended = moves @ self.weights.T
        skin = self.rest[which].transpose(0, 2, 1)
        if self.pose_basis is not None:
            feature = (turn[:, 1:] - np.eye(3)).reshape(-1, 135).astype(np.float32)
            skin = skin + (feature @ self.pose_basis).reshape(len(which), -1, 3).transpose(0, 2, 1)
        out = np.empty((len(which), skin.shape[2], 3), np.float32)
        for i in range(3):
            out[:, :, i] = blended[:, 9 + i] + sum(
                blended[:, 3 * i + k] * skin[:, k] for k in range(3)
            )
        return out, joints.astype(np.float32)


FAMILIES = 64
"""Hands to close: shape, spread, thumb's place, and how the joints share the closing."""
STEP_RAD = float(np.radians(1.5))
DEEPEST_M = 0.0005
PITCH_M, MARGIN_M = 0.0015, 0.02
EXACT_M, STRIDE = 0.009, 4
SEEN_M = PITCH_M + 2 * DEEPEST_M
"""Between two nodes that lie a wall's two sides the distance reaches half a pitch less half the
wall's thickness: at this thickness -`DEEPEST_M`, at which fingers stop."""
CLUSTER = 10

# Degrees. What a finger opens to, then its limits; the thumb's place is drawn, its limits are
# anatomical.
OPEN = (((-12, 12), (4, 26), (2, 14)), ((-14, 4), (-8, 4), (-8, 8)))
LIMITS = ((88.0, 105.0, 72.0), (44.0, 58.0, 78.0))
FAN = (1.0, 0.2, -1.2, -0.6)


@dataclass(frozen=True, eq=False)
class Families:
    """Fields of `ClosingHands`, and the same as numbers: shape (K, 10), turns (K, 16, 3) in
    degrees, skins at rest."""

    tables: Any
    shape: F32
    turns: F64
    skins: Skins


def posture(hand: HandModel, turns: F64, flexion: F32) -> tuple[F32, F64]:
    """(n, 48) axis-angle poses: a family's turns with the flexion that closing found; and these as
    matrices (n, 16, 3, 3)."""
    axes = hand.joint_axes.double().numpy()
    turns = turns.copy()
    turns[:, 1:, 0] = np.degrees(flexion.reshape(len(flexion), 15))
    local = (
        Rotation.from_euler("XYZ", turns.reshape(-1, 3), degrees=True)
        .as_matrix()
        .reshape(-1, 16, 3, 3)
    )
    turned = axes @ local @ axes.transpose(0, 2, 1)
    return Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 48).astype(
        np.float32
    ), turned


@lru_cache(maxsize=2)
def load_families(model: HandModel) -> Families:
    """The 64 hands to close, on this hand model."""
    rng = np.random.Generator(np.random.Philox(key=0x52324852))
    shape = np.clip(0.6 * rng.standard_normal((FAMILIES, 10)), -1.5, 1.5).astype(np.float32)
    turns, rate = np.zeros((FAMILIES, 16, 3)), np.zeros((FAMILIES, 16))
    limit = np.zeros(16)
    for k in range(FAMILIES):
        common = rng.random(3)
        spread = -2 + 10 * rng.random()
        share = np.array([1.0, 0.5 + rng.random(), 0.3 + 0.6 * rng.random()])
        for f in range(4):
            for j in range(3):
                low, high = OPEN[0][j]
                turns[k, 1 + 3 * f + j, 0] = low + (high - low) * (
                    0.7 * common[j] + 0.3 * rng.random()
                )
                rate[k, 1 + 3 * f + j] = share[j]
            turns[k, 1 + 3 * f, 1] = FAN[f] * spread
        for j in range(3):
            low, high = OPEN[1][j]
            turns[k, 13 + j, 0] = low + (high - low) * rng.random()
        turns[k, 13, 1:] = [-22 + 48 * rng.random(), 28 * rng.random()]
        rate[k, 13:16] = [1.0, 0.4 + 0.8 * rng.random(), 0.2 + 0.8 * rng.random()]
    for f in range(5):
        limit[1 + 3 * f : 4 + 3 * f] = np.radians(LIMITS[int(f == THUMB)])
    return Families(_tables(model, shape, turns, rate, limit), shape, turns, Skins.of(model, shape))


def _tables(model: HandModel, shape: F32, turns: F64, rate: F64, limit: F64) -> Any:
    """The `ClosingHands` of these families."""
    rest = model.pose(
        torch.zeros((FAMILIES, 48), dtype=torch.float32, device="cpu"), torch.from_numpy(shape)
    )
    segment = model.weights.argmax(1).numpy()
    local = rest.vertices.numpy() - rest.joints.numpy()[:, segment]
    # without the palm
    clusters = [_clusters(local[0], np.flatnonzero(segment == j)) if j else [] for j in range(16)]
    rows = [c for of_segment in clusters for c in of_segment]
    skin = local[:, np.concatenate(rows)]
    root_turn = Rotation.from_euler(
        "XYZ", (turns * [0, 1, 1]).reshape(-1, 3), degrees=True
    ).as_matrix()
    opened = model.pose(
        torch.from_numpy(posture(model, turns, np.radians(turns[:, 1:, 0]))[0]),
        torch.from_numpy(shape),
    )
    open_skin = opened.vertices.numpy()[:, ::2]
    open_rows = _clusters(open_skin[0], np.arange(open_skin.shape[1]))
    open_balls = np.stack([_ball(open_skin[:, c]) for c in open_rows], axis=1)
    open_skin = open_skin[:, np.concatenate(open_rows)]
    tables = close_hand.ClosingHands()
    tables.n_points, tables.n_open = skin.shape[1], open_skin.shape[1]
    tables.n_clusters, tables.n_open_balls = wp.int32(len(rows)), wp.int32(len(open_rows))
    balls = np.stack([_ball(local[:, c]) for c in rows], axis=1)
    values = {
        "joints": (rest.joints.numpy().reshape(-1, 3), wp.vec3),
        "axes": (model.joint_axes.numpy(), wp.mat33),
        "root_turn": (root_turn, wp.mat33),
        "flexion": (np.radians(turns[:, :, 0]).ravel(), wp.float32),
        "rate": (rate.ravel(), wp.float32),
        "limit": (limit, wp.float32),
        "skin": (skin.reshape(-1, 3), wp.vec3),
        "open_skin": (open_skin.reshape(-1, 3), wp.vec3),
        "open_ball": (open_balls.reshape(-1, 4), wp.vec4),
        "cluster": (balls.reshape(-1, 4), wp.vec4),
    }
    for name, (value, dtype) in values.items():
        array = np.ascontiguousarray(value, np.float32)
        setattr(tables, name, wp.array(array, dtype=dtype, device="cpu"))
    for name, counts in (
        ("cluster_first", map(len, rows)),
        ("segment_first", map(len, clusters)),
        ("open_first", map(len, open_rows)),
    ):
        first = np.cumsum([0, *counts]).astype(np.int32)
        setattr(tables, name, wp.array(first, dtype=wp.int32, device="cpu"))
    return tables


def _clusters(points: F32, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The rows in groups of `CLUSTER` at most, near each other: halves along the longest side,
    again and again."""
    if len(rows) <= CLUSTER:
        return [rows]
    axis = int(np.argmax(np.ptp(points[rows], axis=0)))
    rows = rows[np.argsort(points[rows, axis], kind="stable")]
    return _clusters(points, rows[: len(rows) // 2]) + _clusters(points, rows[len(rows) // 2 :])


def _ball(points: F32) -> F64:
    """(K, 4) a ball about each hand's points (K, n, 3): centre, radius."""
    center = (points.min(axis=1) + points.max(axis=1)) / 2
    radius = np.linalg.norm(points - center[:, None], axis=2).max(axis=1, keepdims=True)
    return np.concatenate([center, radius + 1e-6], axis=1).astype(np.float64)


def distance_field(surface: ObjectSurface) -> Any:
    """The object's signed distance at grid nodes: exact to `EXACT_M` from the surface, farther off
    a lower bound that is 1.5 mm short or less.

    Most nodes are far from the surface: they take what a grid of `STRIDE` times the pitch says,
    which is at most half a cell's diagonal off the distance; only those that may be near are asked.
    Second derivatives of a distance d are at most 1 / d, so that linear interpolation overshoots it
    by 3 h^2 / 8 d at most.

    A wall that is thinner than the grid's nodes are apart would be inside at none of them, and
    fingers would close through it: the field is that of a solid whose walls are as thick as is
    seen, `SEEN_M`.
    """
    low = surface.vertices.min(0) - MARGIN_M
    nodes = np.ceil((np.ptp(surface.vertices, axis=0) + 2 * MARGIN_M) / PITCH_M).astype(int) + 1
    cell = STRIDE * PITCH_M
    coarse = np.stack(
        np.meshgrid(*(np.arange((n - 2) // STRIDE + 2) for n in nodes), indexing="ij"), -1
    )
    value = surface.distance(low + cell * coarse.reshape(-1, 3), 1.0, quick=True)[0].reshape(
        coarse.shape[:3]
    )
    corners = surface.vertices[surface.faces].astype(np.float64)
    inside = winding_of_nodes(corners, low.astype(np.float64), cell, coarse.shape[:3]) > 0
    value = np.where(inside, -np.abs(value), np.abs(value))
    for axis, n in enumerate(nodes):
        first, share = np.divmod(np.arange(n, dtype=np.int64), STRIDE)
        above = np.take(value, np.minimum(first + 1, value.shape[axis] - 1), axis)
        weight = (
            (share / np.float32(STRIDE))
            .astype(np.float32)
            .reshape([-1 if k == axis else 1 for k in range(3)])
        )
        value = np.take(value, first, axis) * (1 - weight) + above * weight
    near = np.argwhere(np.abs(value) <= EXACT_M + cell * 3**0.5 / 2)
    exact, _, face = surface.distance(low + PITCH_M * near, EXACT_M, quick=True)
    short = value - np.float32(3 * cell**2 / (8 * EXACT_M))
    value = np.where(
        value > 0, np.maximum(short, np.float32(EXACT_M)), np.minimum(value, -np.float32(EXACT_M))
    )
    pairs = tuple(near[face >= 0].T)
    thinner = np.maximum(SEEN_M - surface.thickness(SEEN_M), 0.0) / 2
    value[pairs] = exact[face >= 0] - thinner[face[face >= 0]]
    return _field(value.reshape(-1), low, nodes)


def _field(value: F32, low: F32, nodes: NDArray[np.int64]) -> Any:
    field: Any = close_hand.Field()
    field.origin, field.pitch = wp.vec3(*low.tolist()), wp.float32(PITCH_M)
    field.nodes = wp.vec3i(*nodes.tolist())
    field.value = wp.array(value, dtype=wp.float32, device="cpu")
    return field


def mirrored(field: Any) -> Any:
    """The field of the object mirrored in x."""
    nodes = np.array(list(field.nodes))
    low = np.array(list(field.origin))
    low[0] = -(low[0] + PITCH_M * (nodes[0] - 1))
    return _field(
        np.ascontiguousarray(field.value.numpy().reshape(nodes)[::-1]).reshape(-1), low, nodes
    )


def come_down(
    field: Any,
    families: Families,
    family: NDArray[np.int32],
    R: F32,
    start: F32,
    direction: F32,
    *,
    farthest: float,
) -> F32:
    """How far each open hand moves from `start` along `direction` until it touches; `farthest` if
    it never does."""
    made = over_trials(close_hand.approach, len(family), "cpu")(
        field=field,
        hands=families.tables,
        farthest=farthest,
        hand=np.ascontiguousarray(family),
        R=np.ascontiguousarray(R),
        start=np.ascontiguousarray(start),
        direction=np.ascontiguousarray(direction),
    )
    travel: F32 = made["travel"].numpy()
    return travel


def close(
    field: Any, families: Families, family: Any, R: F32, p: F32, reach: float
) -> tuple[NDArray[np.int64], F32, F32]:
    """The rows whose thumb comes nearer than `reach`; of these flexion (n, 5, 3) in rad, and each
    digit's distance (n, 5)."""
    flexion, gap = np.empty((len(family), 5, 3), np.float32), np.empty((len(family), 5), np.float32)
    rows = np.arange(len(family))
    for wanted in (1 << THUMB, (1 << THUMB) - 1):
        bent, left = flexion[rows], gap[rows]
        found, digits = {"flexion": bent, "gap": left}, len(REGIONS) - 1
        over_trials(close_hand.close_fingers, len(rows), "cpu", outputs=found, width=digits)(
            field=field,
            hands=families.tables,
            step=STEP_RAD,
            deepest=DEEPEST_M,
            wanted=wanted,
            hand=np.ascontiguousarray(family[rows]),
            R=np.ascontiguousarray(R[rows]),
            p=np.ascontiguousarray(p[rows]),
        )
        flexion[rows], gap[rows] = bent, left
        rows = rows[gap[rows, THUMB] < reach]
    return rows, flexion[rows], gap[rows]


def field_distance(field: Any, points: F32) -> F32:
    """(n,) distances of points (n, 3) in the field: trilinear between its nodes."""
    made = over_trials(close_hand.field_distance, len(points), "cpu", chunk=4096)(
        field=field, point=np.ascontiguousarray(points, np.float32)
    )
    distance: F32 = made["distance"].numpy()
    return distance
