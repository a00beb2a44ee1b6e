"""Direction cells never lose the farthest point, the smallest ball holds all. Bounding capsules: tests/kernels/test_collision."""

from itertools import combinations

import numpy as np
import pytest
from rounds import each
from scipy.spatial import ConvexHull

from r2h_batch import load_benchmark
from r2h_batch.scene import bounds
from r2h_batch.scene.objects import BUILT_IN_NAMES, INSTANCE_NAMES, load_objects
from r2h_batch.scene.scene import Scene


@pytest.mark.check
def test_cells_never_lose_the_farthest_point() -> None:
    rng = np.random.default_rng(2)
    clouds = [o.hull_vertices.astype(np.float64) for o in load_objects(["hammer", "eyeglasses"])]
    clouds.append(rng.normal(size=(8, 3)))
    for points in each(clouds):
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


def test_the_smallest_ball_is_that_of_some_of_its_points() -> None:
    """Every ball through two, three or four of the points, by solving for its centre in their plane."""
    rng = np.random.default_rng(3)
    clouds = [rng.normal(size=(9, 3)) * scale for scale in (1.0, [1.0, 0.1, 0.02], [1.0, 1.0, 0.01])]
    for points in [*clouds, np.array([[0.0, 0, 0], [0.2, 0, 0], [0.1, 0.01, 0], [0.1, 0, 0.02]])]:
        best = np.inf
        for size in (2, 3, 4):
            for rows in combinations(range(len(points)), size):
                first, *others = points[list(rows)]
                away = np.array(others) - first
                center = first + np.linalg.pinv(2 * away) @ (away**2).sum(1)
                radius = np.linalg.norm(points - center, axis=1).max()
                best = min(best, radius)
        found = bounds.outer_ball(points)
        assert abs(found[3] - best) < 1e-7
        assert np.abs(np.linalg.norm(points - found[:3], axis=1).max() - found[3]) < 1e-12


def test_stored_balls_are_those_that_would_be_found() -> None:
    for model in each(load_objects((*BUILT_IN_NAMES, *INSTANCE_NAMES[::7]))):
        hull = model.hull_vertices.astype(np.float64)
        np.testing.assert_allclose(
            bounds.ball_inside(hull), bounds.inner_ball(hull), rtol=0, atol=1e-9, err_msg=model.name
        )


def test_shipped_objects_need_no_linear_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds, "inner_ball", lambda points: pytest.fail("an inner ball is not stored"))
    for model in each(load_objects((*BUILT_IN_NAMES, *INSTANCE_NAMES))):
        assert np.isfinite(bounds.ball_inside(model.hull_vertices.astype(np.float64))).all()


def test_a_second_scene_of_the_built_in_objects_makes_no_table_of_their_hulls_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[int] = []
    blocks = bounds.point_blocks
    benchmark = load_benchmark()
    assert Scene(benchmark).world is not None
    monkeypatch.setattr(bounds, "point_blocks", lambda *a: made.append(1) or blocks(*a))
    assert Scene(benchmark).world is not None
    assert len(made) < len(benchmark.objects) / 2  # those of the hands and of the arm
