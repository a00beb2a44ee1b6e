"""Primitives (capsules, cylinders, boxes) that cover a mesh: distances, samples, overshoot.

Everything is float64 NumPy and deterministic.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
            local, area = _round_surface(
                self.kind, float(self.size[0]), float(self.size[1]), spacing
            )
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
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(edges / spacing)).astype(int)
    points = []
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        keep = i + j <= n
        weights = np.stack([i[keep], j[keep], n - i[keep] - j[keep]], axis=1) / n
        points.append(np.einsum("pk,fkd->fpd", weights, triangles[steps == n]).reshape(-1, 3))
    return np.concatenate(points)


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


class Target:
    """A mesh to be covered: `dense` are its face samples, `surface` (with mouths) is what overshoot is measured to."""

    def __init__(self, triangles: Array, mouths: list[Array]) -> None:
        self.triangles = triangles
        self.dense = thinned(lattice(triangles, 1.0e-3), 0.5e-3)
        self.surface = np.concatenate([self.dense, *mouths])
        self.tree = cKDTree(self.surface)
        self.bare = cKDTree(self.dense) if mouths else self.tree
        self.mouth_first = len(self.dense)

    def protrusion(self, shapes: list[Any]) -> float:
        """How far the mesh sticks out of the shapes (m): of all its corners and a finer lattice than the fit has seen."""
        parts = np.array_split(self.triangles, max(1, len(self.triangles) // 2000))
        # hulls hold what their planes cut the triangles into
        spacing = 2e-3 if all(s.kind == HULL for s in shapes) else PROTRUSION_SPACING_M
        return max(float(union_distance(shapes, lattice(p, spacing)).max()) for p in parts)

    def mean_overshoot_mm(self, shapes: list[Any]) -> float:
        """The mean, on samples 3 mm apart."""
        points, areas = exposed_surface(shapes, 3.0e-3)
        return 1e3 * float((self.tree.query(points)[0] * areas).sum() / areas.sum())

    def report(self, shapes: list[Any]) -> dict[str, Any]:
        """The committed figures, on dense samples."""
        points, areas = exposed_surface(shapes, 1.0e-3)
        overshoot, nearest = self.tree.query(points)
        order = np.argsort(overshoot)
        share = np.cumsum(areas[order]) / areas.sum()
        return {
            "primitives": len(shapes),
            "mean_mm": 1e3 * float((overshoot * areas).sum() / areas.sum()),
            "p95_mm": 1e3 * float(overshoot[order][np.searchsorted(share, 0.95)]),
            "max_mm": 1e3 * float(overshoot.max()),
            "mean_without_mouths_mm": 1e3
            * float((self.bare.query(points)[0] * areas).sum() / areas.sum()),
            "worst_protrusion_mm": 1e3 * self.protrusion(shapes),
            "surface_m2": float(areas.sum()),
            "mouth_share": float(areas[nearest >= self.mouth_first].sum() / areas.sum()),
            "face_samples": len(self.dense),
        }


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
            profile += [
                (
                    np.sqrt(radius**2 - hi**2),
                    sign * (half + hi),
                    2 * np.pi * radius * (radius / m) / n,
                )
                for hi in h
            ]
    points = np.concatenate(
        [np.column_stack([r * ring, np.full(n, height)]) for r, height, _ in profile]
    )
    return points, np.repeat([a for _, _, a in profile], n)
