"""Convex pieces of a solid: cut by planes, merged, inflated to cover its surface. Needs manifold3d."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from manifold3d import Manifold, Mesh64
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

MOST_PARTS = 64
"""Parts at most, before those that cost the least are joined again."""
FULL = 0.02
"""A solid is cut no further when its parts' hulls have this share more volume than it, or less."""
AT = (0.5, 0.35, 0.65, 0.2, 0.8, 0.08, 0.92)
"""Where along a direction a part may be cut, as shares of its extent."""
WORTH = 0.3
"""A plane is taken for what it saves when that is this share of what there is to save, or more."""
SHORTEST_M = 2e-3
"""A part this small is not cut, and no part is cut along a direction in which it is half as
long."""
SAME = 1e-6
"""Volumes of hulls that differ by this share or less are compared to their last bits."""
ABOVE, BELOW = "above", "below"
NEIGHBOURS = 8
"""Pieces that one may be joined with: the nearest, by the gap between bounding boxes, then between
middles."""

F64 = NDArray[np.float64]


def cut_apart(solid: trimesh.Trimesh) -> list[F64]:
    """The corners (n, 3) of at most 64 parts, whose hulls together are not much larger than the
    solid; m.

    Of all parts that with the most volume between it and its hull is cut next: by the plane, across
    the axes or the principal directions of its surface, that leaves the two sides' hulls the least
    volume; or, where no plane saves much, in the middle of its length. So a ring, which no one cut
    brings nearer to its hulls, is halved until cuts do.
    """
    whole = Manifold(
        Mesh64(
            np.array(solid.vertices, np.float64, order="C"),
            np.array(solid.faces, np.uint64, order="C"),
        )
    )
    if whole.is_empty():  # nothing that manifold3d takes for a solid
        return [np.array(solid.vertices, np.float64)]
    parts = [_Part(body) for body in whole.decompose()]
    done: list[_Part] = []
    enough = FULL * sum(part.volume for part in parts)
    while (
        parts
        and len(parts) + len(done) < MOST_PARTS
        and sum(p.excess for p in [*parts, *done]) > enough
    ):
        worst = max(range(len(parts)), key=lambda k: parts[k].excess)
        part = parts.pop(worst)
        halves = part.halves()
        if len(halves) > 1:
            parts += halves
        else:
            done.append(part)
    return [part.points for part in (*parts, *done)]


class _Part:
    """A part of the solid: what manifold3d holds, its corners (n, 3), and how much larger (m^3) its
    hull is."""

    def __init__(self, solid: Manifold) -> None:
        mesh: Any = solid.to_mesh64()
        self.solid = solid
        self.points: F64 = np.asarray(mesh.vert_properties, np.float64)[:, :3]
        self.faces = np.asarray(mesh.tri_verts, np.int64)
        self.volume = float(solid.volume())
        self.hull = float(solid.hull().volume())
        self.excess = max(0.0, self.hull - self.volume)
        corner = self.points[self.faces]
        side, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        self.double_area: F64 = np.cross(side, other)

    def halves(self) -> list[_Part]:
        """Parts that the best plane leaves, each connected body a part; fewer than two: nothing to
        cut."""
        edges = np.concatenate([self.faces[:, k] for k in ([0, 1], [1, 2], [2, 0])])
        edges = edges[edges[:, 0] < edges[:, 1]]
        least, best, longest = np.inf, (np.zeros(3), 0.0), (np.zeros(3), 0.0)
        length = SHORTEST_M
        enough, slack = self.hull - WORTH * self.excess, SAME * self.hull
        for n in self._directions():
            along = self.points @ n
            low, extent = float(along.min()), float(np.ptp(along))
            if extent > 1.001 * length:
                length, longest = extent, (n, low + extent / 2)
            if extent <= SHORTEST_M / 2:
                continue
            sides = _Sides(self, n, along, [low + share * extent for share in AT])
            for k, at in enumerate(sides.cuts):
                left = self._both_hulls(k, sides, edges, min(least, enough) + slack)
                if left < least:
                    least, best = left, (n, at)
        if not longest[0].any():
            return []
        n, at = best if self.hull - least > WORTH * self.excess else longest
        return [
            _Part(body) for side in self.solid.split_by_plane(n, at) for body in side.decompose()
        ]

    def _both_hulls(self, k: int, sides: _Sides, edges: NDArray[np.int64], most: float) -> float:
        """Volume of the two sides' hulls after cut k: of their corners, and where the plane meets edges.

        Infinite where that is `most` or more, as far as is known before both hulls are made."""
        if sides.least(k) >= most:
            return np.inf
        s = sides.along - sides.cuts[k]
        p, a, b = self.points, s[edges[:, 0]], s[edges[:, 1]]
        cross = (a > 0) != (b > 0)
        t = (a[cross] / (a[cross] - b[cross]))[:, None]
        rim = p[edges[cross, 0]] * (1 - t) + p[edges[cross, 1]] * t
        above = s > 0
        volume = 0.0
        for side in (ABOVE, BELOW) if 2 * np.count_nonzero(above) > len(s) else (BELOW, ABOVE):
            corners = p[above if side == ABOVE else ~above]
            hull = float(Manifold.hull_points(np.concatenate([corners, rim])).volume())
            volume += hull
            sides.learn(k, side, hull)
            if sides.least(k) >= most:
                return np.inf
        return volume

    def _directions(self) -> F64:
        """(6, 3) unit vectors: the principal directions of the surface, and the axes."""
        area = np.linalg.norm(self.double_area, axis=1)
        middle = self.points[self.faces].mean(axis=1)
        middle = middle - np.average(middle, axis=0, weights=area + 1e-30)
        return np.concatenate([np.linalg.eigh((middle * area[:, None]).T @ middle)[1].T, np.eye(3)])


class _Sides:
    """Lower bounds of the hulls of a part's two sides, for planes across one direction.

    When a side grows by a slab, its hull grows by the slab's volume or more, because the old hull
    ends where the slab begins. So the volume between a side and its hull never shrinks as it grows.
    """

    def __init__(self, part: _Part, n: F64, along: F64, cuts: Sequence[float]) -> None:
        """Nothing is known of hulls yet.

        Args:
            part: what is cut.
            n: (3,) the direction.
            along: (corners,) heights of its corners along the direction, m.
            cuts: heights of the planes, in the order of `AT`, m.
        """
        self.along, self.cuts, self._volume = along, cuts, part.volume
        below = _below(part, n, along, np.array(cuts))
        self._own = {BELOW: below, ABOVE: part.volume - below}
        self._excess = {BELOW: np.zeros(len(cuts)), ABOVE: np.zeros(len(cuts))}
        self._share = np.array(AT)

    def learn(self, k: int, side: str, hull: float) -> None:
        """Take the volume (m^3) of the hull of a side of plane k into the bounds."""
        larger = self._share >= AT[k] if side == BELOW else self._share <= AT[k]
        excess = self._excess[side]
        excess[larger] = np.maximum(excess[larger], hull - self._own[side][k])

    def least(self, k: int) -> float:
        """Least volume (m^3) that the hulls of both sides of plane k have together."""
        return float(self._volume + self._excess[BELOW][k] + self._excess[ABOVE][k])


def _below(part: _Part, n: F64, along: F64, cuts: F64) -> F64:
    """Volumes (C,) of the part below planes across a direction n (3,) at heights `cuts` (C,); m^3.

    By the divergence theorem, of n times the depth below the plane: that is 0 on the plane, so each face
    counts, with its area as n sees it, times the mean depth of what of it lies below.
    """
    x, y, z = (along[part.faces[:, k]] for k in range(3))
    low, high = np.minimum(x, y), np.maximum(x, y)
    mid = np.maximum(low, np.minimum(high, z))
    low, high = np.minimum(low, z), np.maximum(high, z)
    area, mean = part.double_area @ n, (x + y + z) / 3
    whole = (high[:, None] <= cuts).astype(np.float64)
    volume = cuts * (area @ whole) - (area * mean) @ whole
    f, k = np.nonzero((low[:, None] < cuts) & (high[:, None] > cuts))
    at, low, mid, high = cuts[k], low[f], mid[f], high[f]
    tip = at <= mid  # a corner lies below, else one lies above
    end, rise = np.where(tip, at - low, high - at), np.where(tip, mid - low, high - mid)
    cone = end * end * end / (3 * rise * (high - low))
    depth = np.where(tip, cone, at - mean[f] + cone)
    return -(volume + np.bincount(k, area[f] * depth, len(cuts))) / 2


def merge_hulls(parts: Sequence[F64], most: int, spare: float = -np.inf) -> list[F64]:
    """At most `most` point sets, each the corners of a convex piece: (n, 3) of some of `parts`
    together.

    Two are joined again and again, those whose common hull adds the least volume to theirs (Mamou
    and Ghorbel 2009, whose cost is another), of each and its nearest neighbours; also when there
    are few enough, while that adds less than `spare` (m^3).
    """
    # what is flat holds nothing
    hulls = [hull for part in parts if (hull := Manifold.hull_points(part)).volume() > 0]
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


def inflate_to_cover(
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
        # edge k: from corner k to the next
        edge = np.linalg.norm(rest - np.roll(rest, -1, axis=1), axis=2)
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
        out = _outside(of, triangles[rows].reshape(-1, 3)).reshape(-1, 3)
        held[rows] = (out <= allowed).all(axis=1)
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
