"""A solid cut by planes, again and again, until its parts fill their hulls."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from manifold3d import Manifold, Mesh64
from numpy.typing import NDArray

__all__ = ["cut_apart"]

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

    def halves(self) -> list[_Part]:
        """What the best plane leaves, bodies apart as parts of their own; less than two: nothing to
        cut."""
        edges = np.concatenate(
            [self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]
        )
        edges = edges[edges[:, 0] < edges[:, 1]]
        least, best, longest = np.inf, (np.zeros(3), 0.0), (np.zeros(3), 0.0)
        length = SHORTEST_M
        for n in self._directions():
            along = self.points @ n
            low, extent = float(along.min()), float(np.ptp(along))
            if extent > 1.001 * length:
                length, longest = extent, (n, low + extent / 2)
            if extent <= SHORTEST_M / 2:
                continue
            for share in AT:
                at = low + share * extent
                if (left := self._both_hulls(along - at, edges, least)) < least:
                    least, best = left, (n, at)
        if not longest[0].any():
            return []
        n, at = best if self.hull - least > WORTH * self.excess else longest
        return [
            _Part(body) for side in self.solid.split_by_plane(n, at) for body in side.decompose()
        ]

    def _both_hulls(self, s: F64, edges: NDArray[np.int64], most: float) -> float:
        """Volume of the two sides' hulls after a cut at s (n,) = 0: of their corners, and where the
        plane meets edges.

        Of the larger one alone where that is `most` already, or more."""
        p, a, b = self.points, s[edges[:, 0]], s[edges[:, 1]]
        cross = (a > 0) != (b > 0)
        t = (a[cross] / (a[cross] - b[cross]))[:, None]
        rim = p[edges[cross, 0]] * (1 - t) + p[edges[cross, 1]] * t
        above, below = s > 0, s <= 0
        sides = (above, below) if 2 * np.count_nonzero(above) > len(s) else (below, above)
        volume = [0.0, 0.0]
        for k, side in enumerate(sides):
            if volume[0] < most:
                volume[k] = Manifold.hull_points(np.concatenate([p[side], rim])).volume()
        return volume[0] + volume[1]

    def _directions(self) -> F64:
        """(6, 3) unit vectors: the principal directions of the surface, and the axes."""
        corner = self.points[self.faces]
        area = np.linalg.norm(
            np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
        )
        middle = corner.mean(axis=1)
        middle = middle - np.average(middle, axis=0, weights=area + 1e-30)
        return np.concatenate([np.linalg.eigh((middle * area[:, None]).T @ middle)[1].T, np.eye(3)])
