"""Convex pieces made fewer by joining those that cost the least volume, and grown until they hold
what they were cut from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

__all__ = ["covering", "fewer"]

NEIGHBOURS = 8
"""Pieces that one may be joined with: the nearest, by the gap between bounding boxes, then between
middles."""

F64 = NDArray[np.float64]


def fewer(parts: Sequence[F64], most: int, spare: float = -np.inf) -> list[F64]:
    """At most `most` point sets, each the corners of a convex piece: (n, 3) of some of `parts`
    together.

    Two are joined again and again, those whose common hull adds the least volume to theirs (Mamou
    and Ghorbel 2009, whose cost is another), of each and its nearest neighbours; also when there
    are few enough, while that adds less than `spare` (m^3).
    """
    hulls = [
        hull for part in parts if (hull := Manifold.hull_points(part)).volume() > 0
    ]  # what is flat holds nothing
    corners = [_corners(hull) for hull in hulls]
    volume = [float(hull.volume()) for hull in hulls]
    boxes = [np.stack([_low(c), _high(c)]) for c in corners]
    alive = list(range(len(corners)))
    cost: dict[tuple[int, int], float] = {}

    def compare(k: int, others: list[int]) -> None:
        for a in _nearest(boxes, k, others):
            pair = (min(a, k), max(a, k))
            if pair not in cost:
                both = Manifold.hull_points(np.concatenate([corners[a], corners[k]]))
                cost[pair] = float(both.volume()) - volume[a] - volume[k]

    for k in alive:
        compare(k, [a for a in alive if a != k])
    while cost:
        i, j = min(cost, key=lambda pair: (cost[pair], pair))
        if len(alive) <= most and cost[i, j] > spare:
            break
        hull = Manifold.hull_points(np.concatenate([corners[i], corners[j]]))
        corners.append(_corners(hull))
        volume.append(float(hull.volume()))
        boxes.append(np.stack([_low(corners[-1]), _high(corners[-1])]))
        alive = [a for a in alive if a not in (i, j)]
        for pair in [p for p in cost if i in p or j in p]:
            del cost[pair]
        compare(len(corners) - 1, alive)
        alive.append(len(corners) - 1)
    return [corners[a] for a in alive]


def covering(
    parts: Sequence[F64],
    points: F64,
    triangles: NDArray[np.int64],
    allowed: float,
    apart: float = np.inf,
) -> list[F64]:
    """The pieces, grown until each triangle (T, 3) of `points` (N, 3) lies in one of them, up to
    `allowed` (m) outside.

    A triangle is in a convex piece when its corners are; so nothing of the surface is outside, not
    only none of the points. Each that is in no piece is halved until its edges are `apart` (m) or
    shorter; what is then still in none goes whole into the piece that its farthest corner is
    nearest to, of those whose bounding box is `apart` from it or nearer, if any is.
    """
    found = list(parts) or [points]
    planes = [ConvexHull(part).equations for part in found]
    rest, small = points[triangles], []
    while len(rest):
        rest = rest[~_held(found, planes, rest, allowed)]
        edge = np.linalg.norm(
            rest - np.roll(rest, -1, axis=1), axis=2
        )  # edge k: from corner k to the next
        longest = edge.argmax(axis=1)
        long = edge.max(axis=1, initial=0.0) > apart
        small.append(rest[~long])
        rest = _halved(rest[long], longest[long])
    out = np.concatenate(small)
    depth = np.full((len(found), len(out)), np.inf)
    near = np.array(
        [((out >= _low(p) - apart) & (out <= _high(p) + apart)).all(axis=(1, 2)) for p in found]
    )
    near |= ~near.any(axis=0)
    for k, of in enumerate(planes):
        depth[k, near[k]] = _outside(of, out[near[k]].reshape(-1, 3)).reshape(-1, 3).max(axis=1)
    nearest = depth.argmin(axis=0)
    for k in np.unique(nearest).tolist():
        found[k] = _corners(
            Manifold.hull_points(np.concatenate([found[k], out[nearest == k].reshape(-1, 3)]))
        )
    return found


def _held(
    parts: Sequence[F64], planes: Sequence[F64], triangles: F64, allowed: float
) -> NDArray[np.bool_]:
    """(T,) whether triangles (T, 3, 3) lie in one of the pieces."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    held = np.zeros(len(triangles), bool)
    for part, of in zip(parts, planes, strict=True):
        box = (low >= _low(part) - allowed) & (high <= _high(part) + allowed)
        rows = np.flatnonzero(box.all(axis=1) & ~held)
        held[rows] = (
            (_outside(of, triangles[rows].reshape(-1, 3)) <= allowed).reshape(-1, 3).all(axis=1)
        )
    return held


def _halved(triangles: F64, edge: NDArray[np.int64]) -> F64:
    """(2 T, 3, 3) triangles (T, 3, 3) cut in two at the middle of an edge (T,): 0, 1 or 2, from
    that corner to the next."""
    row = np.arange(len(triangles))
    a, b, c = (triangles[row, (edge + k) % 3] for k in range(3))
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _outside(planes: F64, points: F64) -> F64:
    """(N,) how far points are outside a piece with these planes (P, 4); 0 or less: inside."""
    of = np.full(len(points), -np.inf)
    for first in range(0, len(planes), 64):  # a few at a time: (N, planes) of a large mesh is much
        some = planes[first : first + 64]
        of = np.maximum(of, (points @ some[:, :3].T + some[:, 3]).max(axis=1))
    return of


def _nearest(boxes: Sequence[F64], k: int, others: list[int]) -> list[int]:
    """Up to `NEIGHBOURS` of the others, whose bounding boxes are (low, high) (2, 3)."""
    if len(others) <= NEIGHBOURS:
        return others
    low, high = np.array([boxes[a] for a in others]).transpose(1, 0, 2)
    gap = np.maximum(np.maximum(low - boxes[k][1], boxes[k][0] - high), 0)
    between = np.linalg.norm((low + high - boxes[k][0] - boxes[k][1]) / 2, axis=1)
    order = np.argsort(np.linalg.norm(gap, axis=1) + 1e-3 * between, kind="stable")[:NEIGHBOURS]
    return [others[i] for i in order]


def _low(points: F64) -> F64:
    return np.asarray(points.min(axis=0))


def _high(points: F64) -> F64:
    return np.asarray(points.max(axis=0))


def _corners(hull: Manifold) -> F64:
    mesh: Any = hull.to_mesh64()
    return np.asarray(mesh.vert_properties, np.float64)[:, :3]
