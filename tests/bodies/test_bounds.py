"""Bounding capsules hold what they bound; direction cells never lose the farthest point."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from r2h_batch.bodies import bounds
from r2h_batch.bodies.objects import load_objects
from r2h_batch.bodies.robot import Kind


def surface_of(kind: Kind, size: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random points of a primitive."""
    u = rng.uniform(-1, 1, (4000, 3))
    if kind == Kind.BOX:
        return u * size
    angle, z = np.pi * u[:, 0], size[1] * u[:, 1]
    ring = np.stack([size[0] * np.cos(angle), size[0] * np.sin(angle), z], 1)
    if kind == Kind.CYLINDER:
        return ring
    ball = rng.normal(size=(4000, 3))
    ball *= size[0] / np.linalg.norm(ball, axis=1, keepdims=True)
    return np.concatenate([ring, ball + np.sign(u[:, 2:]) * np.array([0, 0, size[1]])])


def outside(points: np.ndarray, a: np.ndarray, b: np.ndarray, radius: float) -> float:
    d = b - a
    t = np.clip((points - a) @ d / max(d @ d, 1e-30), 0, 1)
    return float((np.linalg.norm(points - a - t[:, None] * d, axis=1) - radius).max())


@pytest.mark.parametrize("kind", [Kind.CAPSULE, Kind.CYLINDER, Kind.BOX])
def test_a_primitives_capsule_holds_it(kind: Kind) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        size = rng.uniform(0.005, 0.2, 3)
        axis, radius = bounds.capsule_of_primitive(int(kind), size)
        assert outside(surface_of(kind, size, rng), -axis, axis, radius) <= 1e-9


def test_capsules_of_balls_hold_them() -> None:
    rng = np.random.default_rng(1)
    for n in (1, 2, 7, 60):
        centers, radii = rng.normal(size=(n, 3)) * [0.3, 0.02, 0.05], rng.uniform(0, 0.05, n)
        a, b, radius = bounds.capsule_of_balls(centers, radii)
        direction = rng.normal(size=(n, 500, 3))
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        points = (centers[:, None] + radii[:, None, None] * direction).reshape(-1, 3)
        assert outside(points, a, b, radius) <= 0


@pytest.mark.check
def test_cells_never_lose_the_farthest_point() -> None:
    rng = np.random.default_rng(2)
    clouds = [o.hull_vertices.astype(np.float64) for o in load_objects(["hammer", "eyeglasses"])]
    clouds.append(rng.normal(size=(8, 3)))
    for points in clouds:
        points = points[ConvexHull(points).vertices]
        rows = bounds.support_cells(points)
        d = rng.normal(size=(20000, 3))
        d[:300] = np.round(d[:300])  # on cell borders
        d = d[np.linalg.norm(d, axis=1) > 0]
        axis = np.abs(d).argmax(1)
        i = np.arange(len(d))
        n = bounds.CELLS_PER_EDGE
        u, v = (
            np.clip((n / 2 * (1 + d[i, (axis + k) % 3] / np.abs(d[i, axis]))).astype(int), 0, n - 1) for k in (1, 2)
        )
        cell = ((2 * axis + (d[i, axis] < 0)) * n + u) * n + v
        first, count = rows[cell, 0].astype(int), rows[cell, 1].astype(int)
        k = bounds.BLOCK_POINTS
        blocks = [rows[f : f + k * -(-c // k)].reshape(-1, 3, k) for f, c in zip(first, count, strict=True)]
        kept = [b.transpose(0, 2, 1).reshape(-1, 3) for b in blocks]
        assert all((x[c:] == x[c - 1]).all() for x, c in zip(kept, count, strict=True))
        best = np.array([(x[:c] @ n).max() for x, c, n in zip(kept, count, d, strict=True)])
        np.testing.assert_allclose(best, (points @ d.T).max(0), atol=1e-9)
        assert count.mean() < 0.25 * len(points) or len(points) < 20
