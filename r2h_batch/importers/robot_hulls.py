"""Convex hulls, or boxes, that cover a mesh closely: planes cut it where their volumes fall most.

Everything is float64 NumPy and deterministic.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from r2h_batch.bodies.bounds import inner_ball
from r2h_batch.importers.robot_fit import (
    BOX,
    HULL,
    Array,
    Shape,
    Target,
    lattice,
    thinned,
)

SEARCH_CELL_M = 6.0e-3
"""The search for cuts sees one corner per cube of this size."""
FRACTIONS = (0.25, 0.4, 0.5, 0.6, 0.75)
"""Where a part may be cut, in parts of its extent."""
CORNERS = 96
"""Of a hull. The kernels read 16 at a time."""
LOSS_M = 1.0e-4
"""Corners that lie this little outside the others' hull are left out; the hull grows by what they lie outside."""


@dataclass(frozen=True)
class Hull:
    """One convex hull in the frame of its mesh; the axes of its own frame are the mesh's."""

    points: Array  # (V, 3), all of them corners
    kind: str = field(default=HULL, init=False)

    def _planes(self) -> Array:
        return np.asarray(ConvexHull(self.points).equations)

    def signed_distance(self, points: Array) -> Array:
        """How far points (P, 3) lie behind the farthest plane of a face: exact inside, and at most the distance outside."""
        planes = np.unique(np.round(self._planes(), 12), axis=0)
        parts = np.array_split(points, max(1, len(points) * len(planes) // 5_000_000))
        return np.concatenate([(x @ planes[:, :3].T + planes[:, 3]).max(1) for x in parts])

    def frame(self) -> tuple[Array, Array]:
        """Axes (3, 3) and origin of a frame whose z lies along a thin cylinder that holds the hull;
        the origin is the middle of the largest ball in it."""
        middle = inner_ball(self.points)[:3]
        found = []
        for z in (*np.eye(3), *np.linalg.svd(self.points - middle, full_matrices=False)[2]):
            _, _, axes = np.linalg.svd(z[None])
            R = np.stack([axes[1], np.cross(z, axes[1]), z], 1)
            local = (self.points - middle) @ R
            volume = float((local[:, :2] ** 2).sum(1).max() * np.abs(local[:, 2]).max())
            found.append((volume, R))
        return min(found, key=lambda f: f[0])[1], middle

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (P, 3) spread over the surface and the area (P,) that each stands for."""
        found = trimesh.convex.convex_hull(self.points)
        count = max(500, int(found.area / spacing**2))
        points, _ = trimesh.sample.sample_surface(found, count, seed=0)
        return np.asarray(points), np.full(count, found.area / count)


def fit_hulls(target: Target, good: Callable[[list[Hull]], bool], most: int) -> list[Hull]:
    """Hulls that hold all of a mesh: as few as are `good`, at most `most`."""
    parts = [target.triangles]
    while True:
        hulls = [_hull(part.reshape(-1, 3)) for part in parts]
        if good(hulls) or len(parts) == most:
            return hulls
        parts = _cut(
            parts,
            _hull_volume,
            lambda x: (*np.eye(3), *np.linalg.svd(x - x.mean(0), full_matrices=False)[2]),
        )


def boxes_of(triangles: Array, most: int) -> list[Shape]:
    """`most` boxes along the axes that hold all of a mesh (F, 3, 3)."""
    parts = [triangles]
    while len(parts) < most:
        parts = _cut(parts, lambda x: float(np.prod(np.ptp(x, 0))), lambda _: np.eye(3))
    boxes = []
    for part in parts:
        low, high = part.min((0, 1)), part.max((0, 1))
        boxes.append(Shape(BOX, (low + high) / 2, np.eye(3), (high - low) / 2 + 1e-6))
    return boxes


def _cut(
    parts: list[Array],
    volume: Callable[[Array], float],
    normals: Callable[[Array], Iterable[Array]],
) -> list[Array]:
    """The parts (F, 3, 3) with the one cut in two, by a plane with one of `normals`, that saves most `volume`."""
    cuts = [
        (gain, i, plane)
        for i, part in enumerate(parts)
        for gain, plane in _cuts(part, volume, normals)
    ]
    _, at, (axis, height) = max(cuts, key=lambda cut: cut[0])
    halves = [_above(parts[at], s * axis, s * height) for s in (1.0, -1.0)]
    return [*parts[:at], *halves, *parts[at + 1 :]]


def _cuts(
    part: Array, volume: Callable[[Array], float], normals: Callable[[Array], Iterable[Array]]
) -> list[tuple[float, tuple[Array, float]]]:
    """Planes (normal, height) that cut a part, and the volume that this saves."""
    found = []
    coarse = thinned(lattice(part, SEARCH_CELL_M), SEARCH_CELL_M)
    whole = volume(coarse)
    for axis in normals(coarse):
        along = coarse @ axis
        low, high = along.min(), along.max()
        for f in FRACTIONS:
            height = low + f * (high - low)
            halves = coarse[along >= height - 2e-3], coarse[along <= height + 2e-3]
            volumes = [volume(half) if len(half) > 3 else 0.0 for half in halves]
            if min(volumes) > 0:
                found.append((whole - sum(volumes), (axis, height)))
    return found


def _above(triangles: Array, axis: Array, height: float) -> Array:
    """What of triangles (F, 3, 3) lies above a plane, cut exactly."""
    side = triangles @ axis - height
    count = (side > 0).sum(1)
    kept = [triangles[count == 3]]
    for n in (1, 2):  # corners above; the one that is alone on its side comes first
        cut, s = triangles[count == n], side[count == n]
        order = (np.argmax((s > 0) == (n == 1), 1)[:, None] + np.arange(3)) % 3
        cut, s = np.take_along_axis(cut, order[..., None], 1), np.take_along_axis(s, order, 1)
        alone, one, other = cut.transpose(1, 0, 2)
        with_one = alone + (s[:, :1] / (s[:, :1] - s[:, 1:2])) * (one - alone)
        with_other = alone + (s[:, :1] / (s[:, :1] - s[:, 2:])) * (other - alone)
        new = (
            [(alone, with_one, with_other)]
            if n == 1
            else [(with_one, one, other), (with_one, other, with_other)]
        )
        kept += [np.stack(corners, 1) for corners in new]
    return np.concatenate(kept)


def _hull_volume(points: Array) -> float:
    try:
        return float(ConvexHull(points).volume)
    except QhullError:  # they lie in a plane
        return 0.0


def _hull(points: Array) -> Hull:
    """A hull of at most CORNERS corners that holds the points: of their corners those that matter, grown from inside."""
    corners = np.asarray(points)[ConvexHull(points).vertices]
    ends = {int(i) for d in np.vstack([np.eye(3), -np.eye(3)]) for i in [np.argmax(corners @ d)]}
    chosen = sorted(ends)
    while len(chosen) < 5:  # of a thin part the ends may be few
        away = np.linalg.norm(corners[:, None] - corners[chosen], axis=2).min(1)
        chosen.append(int(away.argmax()))
    outside = Hull(corners[chosen]).signed_distance(corners)
    while len(chosen) < CORNERS and outside.max() > LOSS_M:
        chosen.append(int(outside.argmax()))
        outside = Hull(corners[chosen]).signed_distance(corners)
    kept = corners[chosen]
    kept = kept[ConvexHull(kept).vertices]
    for _ in range(50):
        planes = ConvexHull(kept).equations
        over = float((corners @ planes[:, :3].T + planes[:, 3]).max())
        if over <= 0:
            break
        middle = inner_ball(kept)[:3]  # that of the box may lie outside a thin hull
        inner = float(-(planes[:, :3] @ middle + planes[:, 3]).max())
        kept = middle + (kept - middle) * (1 + (over + 1e-6) / inner)
    kept = np.round(kept, 7)
    return Hull(kept)
