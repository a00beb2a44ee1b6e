"""Primitives (capsules, cylinders, boxes) that cover a mesh closely: distances, samples, overshoot, and the search.

Everything is float64 NumPy and deterministic.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
BOX, CYLINDER, CAPSULE = "box", "cylinder", "capsule"


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
                return np.hypot(radial, np.maximum(np.abs(local[:, 2]) - self.size[1], 0.0)) - self.size[0]
            over = np.stack([radial - self.size[0], np.abs(local[:, 2]) - self.size[1]], axis=1)
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (P, 3) spread over the surface and the area (P,) that each stands for."""
        if self.kind == BOX:
            local, area = _box_surface(self.size, spacing)
        else:
            local, area = _round_surface(self.kind, float(self.size[0]), float(self.size[1]), spacing)
        return local @ self.R.T + self.pos, area

    def grown(self, amount: float) -> "Shape":
        """The shape with every size larger by `amount` (a capsule only in radius)."""
        size = self.size + (np.array([amount, 0.0]) if self.kind == CAPSULE else amount)
        return Shape(self.kind, self.pos, self.R, size)


def union_distance(shapes: list[Shape], points: Array) -> Array:
    """Signed distance of points to the nearest shape: at most 0 where the union covers them."""
    return np.min([s.signed_distance(points) for s in shapes], axis=0)


def exposed_surface(shapes: list[Shape], spacing: float) -> tuple[Array, Array]:
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
    _, first = np.unique(np.round(points / cell).astype(np.int64), axis=0, return_index=True)
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

    def __init__(self, triangles: Array, mouths: list[Array], area: float) -> None:
        self.triangles = triangles
        self.dense = thinned(lattice(triangles, 1.0e-3), 0.5e-3)
        self.surface = np.concatenate([self.dense, *mouths])
        self.tree = cKDTree(self.surface)
        self.bare = cKDTree(self.dense) if mouths else self.tree
        self.mouth_first = len(self.dense)
        self.area = area
        self.spacing = float(np.clip(np.sqrt(area / 2000.0), 1.0e-3, 8.0e-3))
        self.coarse = thinned(self.dense, self.spacing)
        self._low = self.dense.min(axis=0) - 0.03
        self._cell = float(np.clip(self.spacing / 2.0, 1.0e-3, 3.0e-3))
        shape = np.ceil((self.dense.max(axis=0) + 0.03 - self._low) / self._cell).astype(int) + 1
        axes = [self._low[k] + self._cell * np.arange(shape[k]) for k in range(3)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        near = cKDTree(thinned(self.surface, 0.7 * self._cell))
        self._grid = near.query(grid.reshape(-1, 3))[0].reshape(shape)

    def quick_overshoot(self, points: Array) -> Array:
        """Interpolated distance to the surface; beyond the grid its edge value."""
        return map_coordinates(self._grid, ((points - self._low) / self._cell).T, order=1, mode="nearest")

    def protrusion(self, shapes: list[Shape]) -> float:
        """How far the mesh sticks out of the shapes (m): of all its corners and a finer lattice than the fit has seen."""
        parts = np.array_split(self.triangles, max(1, len(self.triangles) // 2000))
        return max(float(union_distance(shapes, lattice(p, PROTRUSION_SPACING_M)).max()) for p in parts)

    def report(self, shapes: list[Shape]) -> dict[str, Any]:
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
            "mean_without_mouths_mm": 1e3 * float((self.bare.query(points)[0] * areas).sum() / areas.sum()),
            "worst_protrusion_mm": 1e3 * self.protrusion(shapes),
            "surface_m2": float(areas.sum()),
            "mouth_share": float(areas[nearest >= self.mouth_first].sum() / areas.sum()),
            "face_samples": len(self.dense),
        }


def cost(target: Target, shapes: list[Shape], extra: Array) -> float:
    """What the search minimises: mean overshoot in mm, its square, and a steep price for samples left outside."""
    if min(float(s.size.min()) for s in shapes) < 5e-4:
        return 1e6
    points, areas = exposed_surface(shapes, target.spacing)
    if len(points) == 0:
        return 1e6
    overshoot = 1e3 * target.quick_overshoot(points)
    outside = 1e3 * np.maximum(union_distance(shapes, extra), 0.0)
    return float(
        ((overshoot + overshoot**2 / 20.0) * areas).sum() / target.area + 30.0 * outside.mean() + 3.0 * outside.max()
    )


def cmaes(function: Any, start: Array, sigma: Array, rounds: int, seed: int) -> tuple[Array, float]:
    """Best point and value of a covariance matrix adaptation (Hansen's defaults); first steps have size `sigma`."""
    rng = np.random.default_rng(seed)
    n = len(start)
    lam = 4 + int(3 * np.log(n)) + 4
    mu = lam // 2
    w = np.log(mu + 0.5) - np.log(np.arange(1, mu + 1))
    w /= w.sum()
    mueff = 1.0 / (w**2).sum()
    cc, cs = (4 + mueff / n) / (n + 4 + 2 * mueff / n), (mueff + 2) / (n + mueff + 5)
    c1 = 2 / ((n + 1.3) ** 2 + mueff)
    cmu = min(1 - c1, 2 * (mueff - 2 + 1 / mueff) / ((n + 2) ** 2 + mueff))
    damps = 1 + 2 * max(0.0, np.sqrt((mueff - 1) / (n + 1)) - 1) + cs
    chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
    mean, step, C, pc, ps = np.zeros(n), 1.0, np.eye(n), np.zeros(n), np.zeros(n)
    best, best_value = start, float(function(start))
    for _ in range(rounds):
        values, vectors = np.linalg.eigh(C)
        scale = np.sqrt(np.maximum(values, 1e-12))
        y = (rng.standard_normal((lam, n)) * scale) @ vectors.T
        x = mean + step * y
        f = np.array([function(start + sigma * row) for row in x])
        order = np.argsort(f, kind="stable")
        if f[order[0]] < best_value:
            best, best_value = start + sigma * x[order[0]], float(f[order[0]])
        chosen = y[order[:mu]]
        y_mean = w @ chosen
        mean = mean + step * y_mean
        ps = (1 - cs) * ps + np.sqrt(cs * (2 - cs) * mueff) * (vectors @ ((vectors.T @ y_mean) / scale))
        step *= float(np.exp((cs / damps) * (np.linalg.norm(ps) / chi - 1)))
        pc = (1 - cc) * pc + np.sqrt(cc * (2 - cc) * mueff) * y_mean
        C = (1 - c1 - cmu) * C + c1 * np.outer(pc, pc) + cmu * (chosen.T * w) @ chosen
        if step * scale.max() < 2e-3:
            break
    return np.asarray(best), best_value


def covered(target: Target, shapes: list[Shape], margin: float) -> list[Shape]:
    """The shapes, grown as little as needed until every dense face sample is inside by `margin`."""
    for _ in range(200):
        distance = np.array([s.signed_distance(target.dense) for s in shapes])
        worst = int(distance.min(axis=0).argmax())
        need = float(distance[:, worst].min())
        if need <= -margin:
            return shapes
        nearest = int(distance[:, worst].argmin())
        shapes = [s.grown(need + margin + 1e-6) if i == nearest else s for i, s in enumerate(shapes)]
    raise RuntimeError("growing the primitives did not cover the mesh")


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
                (np.sqrt(radius**2 - hi**2), sign * (half + hi), 2 * np.pi * radius * (radius / m) / n) for hi in h
            ]
    points = np.concatenate([np.column_stack([r * ring, np.full(n, height)]) for r, height, _ in profile])
    return points, np.repeat([a for _, _, a in profile], n)
