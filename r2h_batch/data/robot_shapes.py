"""Shapes that cover a mesh: capsules, cylinders, boxes, hulls; distances, samples, overshoot. Planes cut
the mesh where the volumes of hulls or boxes fall most.

Everything is float64 NumPy and deterministic.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from r2h_batch.scene.bounds import inner_ball

Array = NDArray[np.float64]
BOX, CYLINDER, CAPSULE, HULL = "box", "cylinder", "capsule", "hull"


@dataclass(frozen=True)
class Shape:
    """One primitive in the frame of its mesh; `R`'s columns are its axes, `size` as in MuJoCo."""

    kind: str
    pos: Array
    R: Array
    size: Array

    def signed_distance(self, points: Array) -> Array:
        """Distance of points (P, 3) from the shape's surface, negative inside; exact outside."""
        local = (points - self.pos) @ self.R
        if self.kind == BOX:
            over = np.abs(local) - self.size
        else:
            radial = np.hypot(local[:, 0], local[:, 1])
            if self.kind == CAPSULE:
                return (
                    np.hypot(radial, np.maximum(np.abs(local[:, 2]) - self.size[1], 0.0))
                    - self.size[0]
                )
            over = np.stack([radial - self.size[0], np.abs(local[:, 2]) - self.size[1]], axis=1)
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (P, 3) spread over the surface and the area (P,) that each stands for."""
        if self.kind == BOX:
            local, area = _box_surface(self.size, spacing)
        else:
            radius, half = map(float, self.size[:2])
            local, area = _round_surface(self.kind, radius, half, spacing)
        return local @ self.R.T + self.pos, area

    def triangles(self) -> Array:
        """Faces (F, 3, 3) of about the shape, none of them outside."""
        if self.kind == BOX:
            mesh = trimesh.creation.box(2 * self.size)
        else:
            radius, length = float(self.size[0]), 2 * float(self.size[1])
            if self.kind == CYLINDER:
                mesh = trimesh.creation.cylinder(radius, length, sections=48)
            else:
                mesh = trimesh.creation.capsule(length, radius, count=[48, 24])
                mesh.apply_translation(-mesh.bounds.mean(0))
        return np.asarray(mesh.triangles) @ self.R.T + self.pos

    def grown(self, amount: float) -> "Shape":
        """The shape with every size larger by `amount` (a capsule only in radius)."""
        size = self.size + (np.array([amount, 0.0]) if self.kind == CAPSULE else amount)
        return Shape(self.kind, self.pos, self.R, size)


def union_distance(shapes: list[Any], points: Array) -> Array:
    """Signed distance of points to the nearest shape: at most 0 where the union covers them."""
    return np.min([s.signed_distance(points) for s in shapes], axis=0)


def _least(shapes: list[Any], points: Array) -> Array:
    """`union_distance` where it is above 0; elsewhere the distance to one of the shapes that hold a point."""
    found = np.asarray(shapes[0].signed_distance(points))
    for shape in shapes[1:]:
        out = np.flatnonzero(found > 0)
        found[out] = np.minimum(found[out], shape.signed_distance(points[out]))
    return found


def exposed_surface(shapes: list[Any], spacing: float) -> tuple[Array, Array]:
    """Points and areas of the union's outer surface: those of each shape that lie inside no other shape."""
    points, areas = [], []
    for i, shape in enumerate(shapes):
        p, a = shape.surface(spacing)
        outside = np.ones(len(p), bool)
        for j, other in enumerate(shapes):
            if j != i:  # of two coincident faces the first counts
                outside &= other.signed_distance(p) > (1e-7 if j < i else -1e-7)
        points.append(p[outside])
        areas.append(a[outside])
    return np.concatenate(points), np.concatenate(areas)


def lattice(triangles: Array, spacing: float) -> Array:
    """Points on triangles (F, 3, 3), corners and edges included, at most `spacing` apart along the edges."""
    steps = _steps(triangles, spacing)
    points = []
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        keep = i + j <= n
        weights = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], axis=1) / n
        points.append(np.einsum("pk,fkd->fpd", weights, triangles[steps == n]).reshape(-1, 3))
    return np.concatenate(points)


def _steps(triangles: Array, spacing: float) -> NDArray[np.int64]:
    """Into how many parts `lattice` divides the edges of each triangle."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    return np.maximum(1, np.ceil(edges / spacing)).astype(np.int64)


def few_at_once(triangles: Array, spacing: float) -> list[Array]:
    """The triangles in groups whose lattices have at most `POINTS_AT_ONCE` points; one alone may have more."""
    steps = _steps(triangles, spacing)
    before = np.cumsum((steps + 1) * (steps + 2) // 2)
    return np.split(triangles, 1 + np.flatnonzero(np.diff(before // POINTS_AT_ONCE)))


def thinned(points: Array, cell: float) -> Array:
    """One of the points per cubic cell, in a fixed order."""
    cells = np.round(points / cell).astype(np.int64)
    cells -= cells.min(0)
    _, first = np.unique(np.ravel_multi_index(tuple(cells.T), cells.max(0) + 1), return_index=True)
    return points[np.sort(first)]


def disc(center: Array, normal: Array, radius: float, spacing: float) -> Array:
    """Points on a flat disc."""
    _, _, axes = np.linalg.svd(normal[None])
    grid = np.arange(-radius, radius + spacing, spacing)
    u, v = (g.ravel() for g in np.meshgrid(grid, grid))
    keep = np.hypot(u, v) <= radius
    return center + np.outer(u[keep], axes[1]) + np.outer(v[keep], axes[2])


PROTRUSION_SPACING_M = 0.4e-3
DENSE_M, MOST_DENSE = 0.5e-3, 600_000
"""Cell of a mesh's face samples, and about how many there may be: the cells of a larger mesh are larger."""
REPORT_M, MOST_REPORTED = 1.0e-3, 100_000
"""The same for the samples of bodies that the figures of a report are of."""
NEAREST_WITHIN = 0.02
"""Relative error of a distance to the nearest face sample: exact ones take ten times as long far from the mesh."""
POINTS_AT_ONCE = 1_000_000
"""Most points of a lattice that is looked at for what sticks out: some 100 MB."""


class Target:
    """A mesh to be covered: `dense` are its face samples, `surface` (with mouths) is what overshoot is measured to."""

    def __init__(self, triangles: Array, mouths: list[Array]) -> None:
        self.triangles = triangles
        self.cell = max(DENSE_M, float(np.sqrt(_area(triangles) / MOST_DENSE)))
        parts = few_at_once(triangles, 2 * self.cell)
        self.dense = np.concatenate([thinned(lattice(t, 2 * self.cell), self.cell) for t in parts])
        self.surface = np.concatenate([self.dense, *mouths])
        self.tree = _tree(self.surface)
        self.bare = _tree(self.dense) if mouths else self.tree
        self.mouth_first = len(self.dense)

    def protrusion(self, shapes: list[Any]) -> float:
        """How far the mesh sticks out of the shapes (m): of all its corners and a finer lattice than the fit has seen."""
        # hulls hold what their planes cut the triangles into
        spacing = 2e-3 if all(s.kind == HULL for s in shapes) else PROTRUSION_SPACING_M
        # a shape is convex: it holds the triangles whose corners it holds
        corners = self.triangles.reshape(-1, 3)
        inside = [(s.signed_distance(corners).reshape(-1, 3) <= 0).all(1) for s in shapes]
        left = self.triangles[~np.any(inside, axis=0)]
        worst = [float(_least(shapes, corners).max())]
        if len(left):
            parts = few_at_once(left, spacing)
            worst += [float(_least(shapes, lattice(p, spacing)).max()) for p in parts]
        return max(worst)

    def mean_overshoot_mm(self, shapes: list[Any]) -> float:
        """The mean, on samples 3 mm apart."""
        points, areas = exposed_surface(shapes, 3.0e-3)
        return 1e3 * float((_away(self.tree, points)[0] * areas).sum() / areas.sum())

    def report(self, shapes: list[Any]) -> dict[str, Any]:
        """The committed figures, on dense samples."""
        low, high = box_of(self.triangles)
        sides = high - low
        around = 2 * float(sides @ np.roll(sides, 1))
        spacing = max(REPORT_M, float(np.sqrt(around / MOST_REPORTED)))
        points, areas = exposed_surface(shapes, spacing)
        overshoot, nearest = _away(self.tree, points)
        order = np.argsort(overshoot)
        share = np.cumsum(areas[order]) / areas.sum()
        return {
            "primitives": len(shapes),
            "mean_mm": 1e3 * float((overshoot * areas).sum() / areas.sum()),
            "p95_mm": 1e3 * float(overshoot[order][np.searchsorted(share, 0.95)]),
            "max_mm": 1e3 * float(overshoot.max()),
            "mean_without_mouths_mm": 1e3
            * float((_away(self.bare, points)[0] * areas).sum() / areas.sum()),
            "worst_protrusion_mm": 1e3 * self.protrusion(shapes),
            "surface_m2": float(areas.sum()),
            "mouth_share": float(areas[nearest >= self.mouth_first].sum() / areas.sum()),
            "face_samples": len(self.dense),
        }


def _area(triangles: Array) -> float:
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return float(np.linalg.norm(across, axis=1).sum()) / 2


def _tree(points: Array) -> cKDTree:
    """Samples lie on grids: without medians a tree of them is made and asked several times faster."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _away(tree: cKDTree, points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Distance of points from the nearest sample, and its number."""
    found = tree.query(points, eps=NEAREST_WITHIN)
    return found[0], found[1]


# Sleeves of the visual meshes that the next link closes: centre, normal, radius in the link frame.
MOUTHS: dict[str, list[tuple[tuple[float, float, float], tuple[float, float, float], float]]] = {
    "upper_arm": [((-0.425, 0.0, 0.0602), (0.0, 0.0, 1.0), 0.058)],
    "forearm": [
        ((0.0, 0.0, 0.0604), (0.0, 0.0, 1.0), 0.058),
        ((-0.3922, 0.0, 0.0604), (0.0, 0.0, 1.0), 0.0375),
    ],
    "wrist_1": [
        ((0.0, 0.0, -0.0736), (0.0, 0.0, 1.0), 0.0375),
        ((0.0, -0.0536, 0.0), (0.0, 1.0, 0.0), 0.0375),
    ],
    "wrist_2": [
        ((0.0, 0.0, -0.0461), (0.0, 0.0, 1.0), 0.0375),
        ((0.0, 0.0531, 0.0), (0.0, 1.0, 0.0), 0.0375),
    ],
    "wrist_3": [((0.0, 0.0, -0.0458), (0.0, 0.0, 1.0), 0.0375)],
}


def mouths_for(name: str, box: Array, other: Array) -> list[Array]:
    """Discs in the sleeves of a link that the next link closes, stretched to the box of another mesh."""
    scale, found = (other[1] - other[0]) / (box[1] - box[0]), []
    for center, normal, radius in MOUTHS.get(name, []):
        at = other[0] + (np.array(center) - box[0]) * scale
        across = float(scale[np.array(normal) == 0].mean())
        found.append(disc(at, np.array(normal), radius * across, 4.0e-4))
    return found


def box_of(triangles: Array) -> Array:
    """Low and high corner (2, 3) of triangles (F, 3, 3)."""
    corners = triangles.reshape(-1, 3)
    return np.stack([corners.min(0), corners.max(0)])


def _spaced(half: float, spacing: float) -> tuple[Array, float]:
    """Midpoints of equal intervals over [-half, half], and the interval."""
    n = max(2, int(np.ceil(2 * half / spacing)))
    return np.asarray((np.arange(n) + 0.5) * (2 * half / n) - half, dtype=np.float64), 2 * half / n


def _box_surface(size: Array, spacing: float) -> tuple[Array, Array]:
    points, areas = [], []
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        (u, du), (v, dv) = _spaced(size[i], spacing), _spaced(size[j], spacing)
        grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        for sign in (-1.0, 1.0):
            face = np.empty((len(grid), 3))
            face[:, k], face[:, i], face[:, j] = sign * size[k], grid[:, 0], grid[:, 1]
            points.append(face)
            areas.append(np.full(len(grid), du * dv))
    return np.concatenate(points), np.concatenate(areas)


def _round_surface(kind: str, radius: float, half: float, spacing: float) -> tuple[Array, Array]:
    n = max(12, int(np.ceil(2 * np.pi * radius / spacing)))
    turn = 2 * np.pi * (np.arange(n) + 0.5) / n
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    z, dz = _spaced(half, spacing)
    profile = [(radius, height, 2 * np.pi * radius * dz / n) for height in z]
    m = max(3, int(np.ceil(radius / spacing)))
    for sign in (-1.0, 1.0):
        if kind == CYLINDER:
            r = radius * (np.arange(m) + 0.5) / m
            profile += [(ri, sign * half, 2 * np.pi * ri * (radius / m) / n) for ri in r]
        else:  # bands of equal height on a sphere have equal areas
            h = radius * (np.arange(m) + 0.5) / m
            band = 2 * np.pi * radius * (radius / m) / n
            profile += [(np.sqrt(radius**2 - hi**2), sign * (half + hi), band) for hi in h]
    rings = [np.column_stack([r * ring, np.full(n, height)]) for r, height, _ in profile]
    return np.concatenate(rings), np.repeat([a for _, _, a in profile], n)


SEARCH_CELL_M = 6.0e-3
"""The search for cuts sees one corner per cube of this size."""
FRACTIONS = (0.25, 0.4, 0.5, 0.6, 0.75)
"""Where a part may be cut, in parts of its extent."""
LEAST_M3 = 1.0e-12
"""Volume of a hull below which a part is flat."""
CORNERS = 96
"""Most corners of a hull. The kernels read 16 at a time."""
LOSS_M = 1.0e-4
"""Corners that lie this little outside the others' hull are left out; the hull grows by what they lie outside."""


Cuts = dict[int, tuple[Array, list[tuple[float, tuple[Array, float]]]]]
"""id of a part -> the part, and what planes (normal, height) that cut it save"""


@dataclass(frozen=True)
class Hull:
    """One convex hull in the frame of its mesh; the axes of its own frame are the mesh's."""

    points: Array  # (V, 3), all of them corners
    kind: str = field(default=HULL, init=False)

    def signed_distance(self, points: Array) -> Array:
        """How far points (P, 3) lie behind the farthest plane of a face: exact inside, and at most the distance outside."""
        planes = np.unique(np.round(ConvexHull(self.points).equations, 12), axis=0)
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
    parts: list[Array] = [target.triangles]
    known: Cuts = {}
    while True:
        hulls = [_hull(part.reshape(-1, 3)) for part in parts]
        if good(hulls) or len(parts) == most:
            return hulls
        before = len(parts)
        parts = _cut(
            parts,
            _hull_volume,
            lambda x: (*np.eye(3), *np.linalg.svd(x - x.mean(0), full_matrices=False)[2]),
            lambda half: _hull_volume(half.reshape(-1, 3)) > LEAST_M3,
            known,
        )
        if len(parts) == before:
            return hulls


def boxes_of(triangles: Array, most: int) -> list[Shape]:
    """At most `most` boxes along the axes that hold all of a mesh (F, 3, 3)."""
    parts: list[Array] = [triangles]
    known: Cuts = {}
    while len(parts) < most:
        cut = _cut(
            parts,
            lambda x: float(np.prod(np.ptp(x, 0))),
            lambda _: np.eye(3),
            lambda half: len(half) > 0,
            known,
        )
        if len(cut) == len(parts):
            break
        parts = cut
    boxes = []
    for part in parts:
        low, high = part.min((0, 1)), part.max((0, 1))
        boxes.append(Shape(BOX, (low + high) / 2, np.eye(3), (high - low) / 2 + 1e-6))
    return boxes


def _cut(
    parts: list[Array],
    volume: Callable[[Array], float],
    normals: Callable[[Array], Iterable[Array]],
    fits: Callable[[Array], bool],
    known: Cuts,
) -> list[Array]:
    """The parts (F, 3, 3) with the one cut in two, by a plane with one of `normals`, that saves most `volume`
    and leaves two parts that `fits` takes; the parts as they are where no plane does."""
    for part in parts:  # a part is kept with its cuts: another array may get its id
        if id(part) not in known:
            known[id(part)] = part, _cuts(part, volume, normals)
    cuts = [(gain, i, plane) for i, part in enumerate(parts) for gain, plane in known[id(part)][1]]
    for _, at, (axis, height) in sorted(cuts, key=lambda cut: -cut[0]):
        halves = [_above(parts[at], s * axis, s * height) for s in (1.0, -1.0)]
        if all(map(fits, halves)):
            return [*parts[:at], *halves, *parts[at + 1 :]]
    return parts


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
    """The part of triangles (F, 3, 3) above a plane, cut exactly."""
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
    if len(points) < 4:
        return 0.0
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
