"""Bodies of links in bounded time: samples, cuts and covers against trimesh, and what is kept of a mesh."""

import numpy as np
import pytest
import trimesh
from rounds import each
from scipy.spatial import ConvexHull

from r2h_batch.data import robot_bodies, robot_shapes
from r2h_batch.data.robot_bodies import bodies_of
from r2h_batch.data.robot_links import Link
from r2h_batch.data.robot_shapes import Target, fit_hulls

ELBOW = np.concatenate(
    [
        np.asarray(trimesh.creation.box([0.3, 0.05, 0.05]).triangles),
        np.asarray(trimesh.creation.box([0.05, 0.05, 0.3]).triangles) + [0.125, 0.0, 0.125],
    ]
)


def link(triangles: np.ndarray = ELBOW, **more) -> Link:
    return Link(
        **{"name": "elbow", "triangles": triangles, "meshed": len(triangles), "shapes": (), "collides": ()} | more
    )


def test_overshoot_is_the_mean_distance_of_the_hulls_surface_from_the_mesh():
    hulls = [robot_shapes.Hull(ELBOW.reshape(-1, 3)[ConvexHull(ELBOW.reshape(-1, 3)).vertices])]
    found = Target(ELBOW, []).mean_overshoot_mm(hulls)
    mesh = trimesh.Trimesh(ELBOW.reshape(-1, 3), np.arange(3 * len(ELBOW)).reshape(-1, 3))
    points, _ = trimesh.sample.sample_surface(trimesh.convex.convex_hull(hulls[0].points), 4000, seed=1)
    expected = 1e3 * mesh.nearest.on_surface(points)[1].mean()
    assert found == pytest.approx(expected, rel=0.04)


def test_what_sticks_out_of_hulls_is_measured_between_the_corners_of_triangles_too():
    one = robot_shapes.Hull(np.asarray(trimesh.creation.box([0.1, 0.1, 0.1]).vertices) - [0.1, 0, 0])
    other = robot_shapes.Hull(np.asarray(trimesh.creation.box([0.1, 0.1, 0.1]).vertices) + [0.1, 0, 0])
    across = np.array([[[-0.14, 0.0, 0.0], [0.14, 0.0, 0.0], [0.14, 0.001, 0.0]]])
    assert Target(across, []).protrusion([one, other]) == pytest.approx(0.05, abs=1e-3)
    inside = across / [5.0, 1.0, 1.0] - [0.1, 0.0, 0.0]
    assert Target(inside, []).protrusion([one, other]) <= 0


def test_a_plane_that_would_leave_a_flat_part_is_not_taken():
    flag = np.array([[[0.0, 0.0, 0.0], [0.0, 0.04, 0.0], [0.3, 0.02, 0.0]]])  # a flat fin beside a block
    triangles = np.concatenate([np.asarray(trimesh.creation.box([0.05, 0.05, 0.05]).triangles), flag])
    hulls = fit_hulls(Target(triangles, []), lambda _: False, 4)
    assert len(hulls) >= 1 and Target(triangles, []).protrusion(hulls) <= 1e-6


def test_bodies_of_a_mesh_are_kept_by_its_digest(monkeypatch, tmp_path):
    monkeypatch.setenv("R2H_BATCH_CACHE", str(tmp_path))
    first, row = bodies_of(link(), [], 6)
    with monkeypatch.context() as patch:
        patch.setattr(robot_bodies, "fit_hulls", lambda *_: pytest.fail("fitted again"))
        again, same = bodies_of(link(), [], 6)
        assert same == row and all((a.points == b.points).all() for a, b in zip(first, again, strict=True))
        for other in each([link(ELBOW * 1.001), link(ELBOW[::-1])]):
            with pytest.raises(pytest.fail.Exception, match="fitted again"):
                bodies_of(other, [], 6)
        with pytest.raises(pytest.fail.Exception, match="fitted again"):
            bodies_of(link(), [], 1)


def test_a_link_gets_no_further_body_after_its_seconds(monkeypatch):
    monkeypatch.setenv("R2H_BATCH_CACHE", "off")
    bars = [
        np.asarray(trimesh.creation.box([0.2, 0.01, 0.01]).triangles) + [0, y, z] for y in (0, 0.1) for z in (0, 0.1)
    ]
    grid = link(np.concatenate(bars))
    assert len(bodies_of(grid, [], 6)[0]) > 2
    monkeypatch.setattr(robot_bodies, "MOST_CUT_S", -1.0)
    assert len(bodies_of(grid, [], 6)[0]) == 1
