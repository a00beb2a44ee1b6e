"""Convex pieces made fewer by joining those that cost the least volume, and grown until they hold what they were cut from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

__all__ = ["covering", "fewer"]

NEIGHBOURS = 8
"""Pieces that one may be joined with: the nearest, by the gap between bounding boxes, then between middles."""

F64 = NDArray[np.float64]


def fewer(parts: Sequence[F64], most: int) -> list[F64]:
    """At most `most` point sets, each the corners of a convex piece: (n, 3) of some of `parts` together.

    Two are joined again and again, those whose common hull adds the least volume to theirs (Mamou and Ghorbel 2009, whose
    cost is another), of each and its nearest neighbours. Much cheaper than CoACD's own merging, which measures distances.
    """
    hulls = [(p, h) for p in parts if (h := _hull(p)) is not None]  # what is flat holds nothing
    corners = [p[h.vertices] for p, h in hulls]
    volume = [float(h.volume) for _, h in hulls]
    alive = list(range(len(corners)))
    cost: dict[tuple[int, int], float] = {}

    def compare(k: int, others: list[int]) -> None:
        for a in _nearest(corners, k, others):
            pair = (min(a, k), max(a, k))
            if pair not in cost:
                cost[pair] = float(ConvexHull(np.concatenate([corners[a], corners[k]])).volume) - volume[a] - volume[k]

    for k in alive:
        compare(k, [a for a in alive if a != k])
    while len(alive) > most:
        i, j = min(cost, key=lambda pair: (cost[pair], pair))
        both = np.concatenate([corners[i], corners[j]])
        hull = ConvexHull(both)
        corners.append(both[hull.vertices])
        volume.append(float(hull.volume))
        alive = [a for a in alive if a not in (i, j)]
        for pair in [p for p in cost if i in p or j in p]:
            del cost[pair]
        compare(len(corners) - 1, alive)
        alive.append(len(corners) - 1)
    return [corners[a] for a in alive]


def covering(parts: Sequence[F64], points: F64, triangles: NDArray[np.int64], allowed: float) -> list[F64]:
    """The pieces, grown until each triangle (T, 3) of `points` (N, 3) lies in one of them, up to `allowed` (m) outside.

    A triangle is in a convex piece when its corners are; so nothing of the surface is outside, not only none of the points.
    Each that is in no piece goes whole into the one that its farthest corner is nearest to.
    """
    found = list(parts) or [points]
    depth = np.stack([_outside(part, points)[triangles].max(axis=1) for part in found])  # (P, T)
    nearest = depth.argmin(axis=0)
    out = depth.min(axis=0) > allowed
    for k in np.unique(nearest[out]).tolist():
        mine = points[np.unique(triangles[out & (nearest == k)])]
        both = np.concatenate([found[k], mine])
        found[k] = both[ConvexHull(both).vertices]
    return found


def _outside(part: F64, points: F64) -> F64:
    """(N,) how far points are outside a piece, by its planes (0 or less: inside)."""
    planes, of = ConvexHull(part).equations, np.full(len(points), -np.inf)
    for first in range(0, len(planes), 64):  # a few at a time: (N, planes) of a large mesh is much
        some = planes[first : first + 64]
        of = np.maximum(of, (points @ some[:, :3].T + some[:, 3]).max(axis=1))
    return of


def _nearest(corners: Sequence[F64], k: int, others: list[int]) -> list[int]:
    """Up to `NEIGHBOURS` of the others."""
    if len(others) <= NEIGHBOURS:
        return others
    low, high = (np.array([f(corners[a]) for a in others]) for f in (_low, _high))
    gap = np.maximum(np.maximum(low - _high(corners[k]), _low(corners[k]) - high), 0)
    between = np.linalg.norm((low + high - _low(corners[k]) - _high(corners[k])) / 2, axis=1)
    order = np.argsort(np.linalg.norm(gap, axis=1) + 1e-3 * between, kind="stable")[:NEIGHBOURS]
    return [others[i] for i in order]


def _low(points: F64) -> F64:
    return np.asarray(points.min(axis=0))


def _high(points: F64) -> F64:
    return np.asarray(points.max(axis=0))


def _hull(points: F64) -> ConvexHull | None:
    """The hull; None of points in a plane."""
    try:
        return ConvexHull(points)
    except QhullError:
        return None
