"""Kernel gjk: certified bounds against a float64 twin and against MuJoCo C, over all shapes and all kinds of placement."""

import itertools

import convex_twin
import mujoco
import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

from r2h_batch.base.launch import init_warp, launch
from r2h_batch.kernels.geometry import gjk as kernel
from r2h_batch.kernels.geometry import shape as shapes
from r2h_batch.kernels.geometry.closest import closest_on_triangle, from_point, from_segment
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.scene import bounds
from r2h_batch.scene.objects import OBJECT_NAMES, load_objects
from r2h_batch.scene.robot import ShapeKind

wp.set_module_options(OPTIONS)

ABOVE_TRUTH_M = 1e-7
"""The certified bound may be above the float64 distance by no more than this."""


@wp.func
def _body(kind: wp.array(dtype=int), size: wp.array(dtype=wp.vec3), start: wp.array(dtype=int), i: int):
    b = shapes.Shape()
    b.kind = kind[i]
    b.size = size[i]
    b.start = start[i]
    b.count = start[i + 1] - start[i]
    if b.kind <= 1:
        b.radius = b.size[0]
    return b


@wp.kernel
def pair_distance(
    needed: float, relative_gap: float, kind_a: wp.array(dtype=int), size_a: wp.array(dtype=wp.vec3),
    start_a: wp.array(dtype=int), points_a: wp.array(dtype=wp.vec3), R: wp.array(dtype=wp.mat33),
    p: wp.array(dtype=wp.vec3), kind_b: wp.array(dtype=int), size_b: wp.array(dtype=wp.vec3),
    start_b: wp.array(dtype=int), points_b: wp.array(dtype=wp.vec3), center_b: wp.array(dtype=wp.vec3),
    lower_out: wp.array(dtype=float), upper_out: wp.array(dtype=float), point_out: wp.array(dtype=wp.vec3),
    v_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    i = wp.tid()
    d = kernel.gjk(
        _body(kind_a, size_a, start_a, i), R[i], p[i], points_a, _body(kind_b, size_b, start_b, i), points_b, center_b[i],
        needed, relative_gap,
    )  # fmt: skip
    lower_out[i] = d.lower
    upper_out[i] = d.upper
    point_out[i] = d.point
    v_out[i] = d.v


@wp.kernel
def segments(
    a0: wp.array(dtype=wp.vec3), a1: wp.array(dtype=wp.vec3), b0: wp.array(dtype=wp.vec3), b1: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=float), point_out: wp.array(dtype=float),
):  # fmt: skip
    i = wp.tid()
    distance_out[i] = wp.length(from_segment(b0[i], b1[i], a0[i], a1[i]))
    point_out[i] = wp.length(from_point(a0[i], b0[i], b1[i]))


@wp.kernel
def on_triangles(
    x: wp.array(dtype=wp.vec3), a: wp.array(dtype=wp.vec3), b: wp.array(dtype=wp.vec3), c: wp.array(dtype=wp.vec3),
    nearest_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    i = wp.tid()
    nearest_out[i] = closest_on_triangle(x[i], a[i], b[i], c[i])


class Pairs:
    """N pairs of bodies of given kinds, b at the origin; everything rounded to float32 so that both sides see the same."""

    def __init__(self, kinds_a, kinds_b, rng, *, smallest=2e-3, largest=0.12):
        n = len(kinds_a)
        self.kinds = (np.asarray(kinds_a), np.asarray(kinds_b))
        low, high = np.log(smallest), np.log(largest)
        self.sizes = [np.exp(rng.uniform(low, high, (n, 3))).astype(np.float32) for _ in range(2)]
        self.points = [[self._points(*x, rng) for x in zip(*both, strict=True)] for both in zip(self.kinds, self.sizes)]
        self.R = Rotation.random(n, random_state=rng).as_matrix().astype(np.float32)
        self.p = (rng.normal(size=(n, 3)) * 0.15).astype(np.float32)

    @staticmethod
    def _points(kind, size, rng):
        if kind != ShapeKind.HULL:
            return np.zeros((1, 3), np.float32)
        x = rng.normal(size=(rng.integers(4, 60), 3))
        x /= np.linalg.norm(x, axis=1)[:, None]
        return (x * size + rng.normal(size=3) * 0.02).astype(np.float32)

    def __len__(self):
        return len(self.p)

    def twin(self):
        n = len(self)
        T = np.tile(np.eye(4), (n, 1, 1))
        b = convex_twin.bodies(self.kinds[1], self.sizes[1], T, self.points[1])
        T[:, :3, :3], T[:, :3, 3] = self.R, self.p
        return convex_twin.bodies(self.kinds[0], self.sizes[0], T, self.points[0]), b

    def truth(self):
        return convex_twin.convex_distance(*self.twin())

    def put_at(self, gap):
        """Moves body a along the line between nearest points (or centres, when they meet) to the wanted gap."""
        for _ in range(3):
            a, b = self.twin()
            d, _ = convex_twin.convex_distance(a, b)
            line = self.p.astype(np.float64)
            line /= np.maximum(np.linalg.norm(line, axis=1), 1e-9)[:, None]
            self.p = (self.p + (gap - d)[:, None] * line).astype(np.float32)

    def run(self, needed=1e9, relative_gap=0.0, *, swap=False):
        """Kernel results: lower and upper bound, nearest point, and the vector between."""
        n = len(self)
        R, p = self.R, self.p
        first, second = 0, 1
        if swap:
            first, second = 1, 0
            R64 = self.R.astype(np.float64)
            R = np.ascontiguousarray(R64.transpose(0, 2, 1), np.float32)
            p = (-np.einsum("nji,nj->ni", R64, self.p)).astype(np.float32)
        center = np.stack([x.mean(0) for x in self.points[second]]).astype(np.float32)
        inputs = {"needed": needed, "relative_gap": relative_gap, "R": R, "p": p, "center_b": center}
        for side, k in (("a", first), ("b", second)):
            start = np.cumsum([0] + [len(x) for x in self.points[k]]).astype(np.int32)
            inputs |= {
                f"kind_{side}": wp.array(self.kinds[k].astype(np.int32), dtype=int),
                f"size_{side}": wp.array(self.sizes[k], dtype=wp.vec3), f"start_{side}": wp.array(start, dtype=int),
                f"points_{side}": wp.array(np.concatenate(self.points[k]), dtype=wp.vec3),
            }  # fmt: skip
        out = {"lower": wp.zeros(n, dtype=float), "upper": wp.zeros(n, dtype=float)}
        out |= {name: wp.zeros(n, dtype=wp.vec3) for name in ("point", "v")}
        launch(pair_distance, n, inputs=inputs, outputs=out, device="cpu")
        return [x.numpy() for x in out.values()]


@pytest.fixture(scope="module", autouse=True)
def _warp():
    init_warp()


def every_pair_of_kinds(each):
    both = np.array(list(itertools.product(range(5), repeat=2)))
    return np.repeat(both, each, axis=0).T


@pytest.mark.parametrize("smallest", [2e-3, 5e-5], ids=["solid", "thin"])
@pytest.mark.parametrize("gap", [None, 0.3, 1e-2, 1e-3, 1e-4, 1e-5, 0.0])
@pytest.mark.parametrize("each", [24, pytest.param(120, marks=pytest.mark.slow)])
def test_the_bound_is_never_above_the_truth_and_close_below_it_where_bodies_are_apart(gap, smallest, each):
    rng = np.random.default_rng(3)
    pairs = Pairs(*every_pair_of_kinds(each), rng, smallest=smallest)
    if gap is not None:
        pairs.put_at(gap)
    low, high = pairs.truth()
    lower, upper, _, _ = pairs.run()
    scale = 1 + np.linalg.norm(pairs.p, axis=1)  # float32 of a coordinate: 6e-8 of it
    above = (lower - np.maximum(high, 0.0)) / scale
    print(f"gap {gap} {smallest}: {len(pairs)} pairs, above truth by at most {above.max():.2e} m")
    assert above.max() <= ABOVE_TRUTH_M
    apart = low > 1e-6
    behind = (low - lower)[apart]
    if apart.any():
        print(f"behind it by at most {behind.max():.2e}, 99.9 %: {np.quantile(behind, 0.999):.2e} m")
        assert np.quantile(behind, 0.99) <= 4e-6 and behind.max() <= (1e-4 if smallest > 1e-3 else 1e-3)
        assert (upper[apart] - high[apart]).min() > -2e-6  # and the estimate is not below it


@pytest.mark.check
def test_bodies_that_overlap_never_have_a_positive_bound():
    rng = np.random.default_rng(4)
    for depth in (1e-4, 1e-2, 1.0):
        pairs = Pairs(*every_pair_of_kinds(40), rng)
        pairs.p = (pairs.p * (1e-3 if depth == 1.0 else 1.0)).astype(np.float32)
        if depth < 1.0:
            pairs.put_at(-depth)
        _, high = pairs.truth()
        lower, _, _, _ = pairs.run()
        met = high <= 0
        assert met.mean() > 0.4
        assert lower[met].max() <= 0.0


def test_solid_cores_that_overlap_have_the_distance_zero_and_no_direction():
    """The estimate too: a direction of rounding would be a gradient, and a small one a distance."""
    pairs = Pairs(
        *np.array(list(itertools.product((2, 3, 4), repeat=2))).repeat(40, axis=0).T, np.random.default_rng(14)
    )
    pairs.p = (pairs.p * 1e-3).astype(np.float32)  # the centres lie within each other
    a, b = pairs.twin()
    radii = a.ball + b.ball
    lower, upper, _, v = pairs.run()
    met = pairs.truth()[1] + radii <= 0.0
    assert met.mean() > 0.5
    assert not v[met].any() and np.abs(upper + radii)[met].max() <= 1e-7 and (lower <= -radii + 1e-7)[met].all()


def test_stopping_early_still_certifies_what_was_asked():
    rng = np.random.default_rng(5)
    pairs = Pairs(*every_pair_of_kinds(50), rng)
    low, high = pairs.truth()
    for needed in (0.0, 0.003, 0.05):
        for relative_gap in (0.0, 0.1):
            lower, _, _, _ = pairs.run(needed, relative_gap)
            assert (lower - np.maximum(high, 0)).max() <= 2 * ABOVE_TRUTH_M
            reached = lower >= needed
            assert (high[reached] >= needed - 2 * ABOVE_TRUTH_M).all()
            clearly = low > np.maximum(needed * 1.2, needed + 1e-4)
            assert reached[clearly].mean() > 0.999 or relative_gap > 0


def test_bounds_of_cores_differ_by_the_share_that_was_asked_for_and_by_more_than_if_none_was():
    pairs = Pairs(*every_pair_of_kinds(50), np.random.default_rng(15))
    pairs.put_at(0.03)
    apart = pairs.truth()[0] > 1e-3
    radii = sum(x.ball for x in pairs.twin())[apart]
    gaps = {}
    for share in (0.0, 0.05, 0.3):
        lower, upper, _, _ = (x[apart] for x in pairs.run(relative_gap=share))
        gaps[share] = upper - lower
        assert np.quantile(gaps[share] - share * (upper + radii), 0.999) <= 1e-5, share
    assert len(radii) > 1000 and gaps[0.3].mean() > 2 * gaps[0.05].mean() > 20 * gaps[0.0].mean()


def test_order_does_not_matter_and_repeating_gives_the_same_bits():
    rng = np.random.default_rng(6)
    pairs = Pairs(*every_pair_of_kinds(50), rng)
    first, again, turned = pairs.run(), pairs.run(), pairs.run(swap=True)
    for a, b in zip(first, again, strict=True):
        assert a.tobytes() == b.tobytes()
    apart = pairs.truth()[0] > 1e-5
    assert np.quantile(np.abs(first[0] - turned[0])[apart], 0.99) <= 5e-6


def test_the_nearest_points_are_points_of_the_bodies_at_that_distance():
    rng = np.random.default_rng(7)
    pairs = Pairs(*every_pair_of_kinds(60), rng)
    low, _ = pairs.truth()
    _, upper, point, v = pairs.run()
    a, b = pairs.twin()
    apart = low > 1e-4
    radii = a.ball + b.ball
    assert np.abs(np.linalg.norm(v, axis=1) - radii - upper)[apart].max() <= 1e-6
    for body, x in ((a, point), (b, point - v)):  # zero distance of a point to the body's core
        n = len(x)
        T = np.tile(np.eye(4), (n, 1, 1))
        T[:, :3, 3] = x
        core = convex_twin.Bodies(body.points, body.disc, np.zeros(n), body.R, body.p)
        _, off = convex_twin.convex_distance(convex_twin.bodies([0] * n, np.zeros((n, 3)), T), core)
        assert off[apart].max() <= 5e-6


@wp.kernel
def farthest(
    cells: int, points: wp.array(dtype=wp.vec3), count: int, d: wp.array(dtype=wp.vec3), height_out: wp.array(dtype=float)
):  # fmt: skip
    i = wp.tid()
    b = shapes.Shape()
    b.kind = wp.where(cells == 1, shapes.CELLS, shapes.HULL)
    b.count = count
    height_out[i] = wp.dot(shapes.support(b, points, d[i]), d[i])


@pytest.mark.parametrize("name", OBJECT_NAMES)
def test_the_farthest_point_by_direction_is_the_farthest_point(name):
    hull, rng = load_objects([name])[0].hull_vertices, np.random.default_rng(11)
    edges = np.linspace(-1, 1, shapes.CELLS_PER_EDGE + 1)
    d = rng.normal(size=(8_000, 3))
    d[:2000] = rng.choice(edges, (2000, 3)) + rng.choice([0, 1e-7, -1e-7], (2000, 3))
    d[2000:2006] = np.concatenate([np.eye(3), -np.eye(3)])
    d, heights = wp.array(d.astype(np.float32), dtype=wp.vec3), []
    for cells in (0, 1):
        points = bounds.support_cells(hull.astype(np.float64)) if cells else hull
        out = wp.zeros(len(d), dtype=float)
        inputs = {"cells": cells, "points": points.astype(np.float32), "count": len(points), "d": d}
        launch(farthest, len(d), inputs=inputs, outputs={"height": out}, device="cpu")
        heights.append(out.numpy())
    assert (heights[0] - heights[1] <= 1e-7).all()


def test_it_agrees_with_mujoco_c():
    """One model with two geoms per pair of kinds, posed anew for every pair."""
    rng = np.random.default_rng(8)
    kinds = np.array(list(itertools.product((1, 2, 3, 4), repeat=2)))
    worst, compared = 0.0, 0
    for ka, kb in kinds:
        pairs = Pairs(np.full(80, ka), np.full(80, kb), rng)
        for side in (0, 1):
            pairs.sizes[side][:] = pairs.sizes[side][0]
            pairs.points[side] = [pairs.points[side][0]] * 80
        spec = mujoco.MjSpec()
        spec.option.ccd_iterations, spec.option.ccd_tolerance = 500, 1e-9
        types = {1: mujoco.mjtGeom.mjGEOM_CAPSULE, 2: mujoco.mjtGeom.mjGEOM_CYLINDER, 3: mujoco.mjtGeom.mjGEOM_BOX}
        for side, kind in ((0, ka), (1, kb)):
            body = spec.worldbody.add_body(name=f"m{side}", mocap=True)
            if kind == ShapeKind.HULL:
                mesh = spec.add_mesh(name=f"h{side}", uservert=pairs.points[side][0].astype(np.float64).ravel())
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"h{side}")
            else:
                body.add_geom(type=types[int(kind)], size=pairs.sizes[side][0])
        model = spec.compile()
        data = mujoco.MjData(model)
        lower, _, _, _ = pairs.run()
        for i in range(len(pairs)):
            data.mocap_pos[0] = pairs.p[i]
            data.mocap_quat[0] = Rotation.from_matrix(pairs.R[i]).as_quat(scalar_first=True)
            mujoco.mj_kinematics(model, data)
            x = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None)
            if x > 1e-4:
                compared += 1
                worst = max(worst, abs(x - lower[i]))
            elif x < -1e-4:
                assert lower[i] <= 0, (ka, kb, i)
    print(f"{compared} pairs against MuJoCo C, largest difference {worst:.2e} m")
    assert compared > 600 and worst <= 2e-5


def test_segment_distance_is_never_above_the_truth_even_for_nearly_parallel_segments():
    rng = np.random.default_rng(9)
    n = 8_000
    a0, u = rng.normal(size=(n, 3)) * 0.1, rng.normal(size=(n, 3))
    u *= rng.uniform(0.01, 0.5, (n, 1)) / np.linalg.norm(u, axis=1)[:, None]
    bend = np.concatenate([np.zeros(n // 4), 10.0 ** rng.uniform(-7, 0, n - n // 4)])
    v = u + rng.normal(size=(n, 3)) * bend[:, None] * 0.3
    v *= rng.uniform(0.2, 2, (n, 1)) * rng.choice([-1, 1], (n, 1))
    b0 = a0 + rng.normal(size=(n, 3)) * 0.15
    ends = [x.astype(np.float32) for x in (a0, a0 + u, b0, b0 + v)]
    out = [wp.zeros(n, dtype=float) for _ in range(2)]
    inputs = dict(zip(("a0", "a1", "b0", "b1"), ends, strict=True))
    launch(segments, n, inputs=inputs, outputs={"distance": out[0], "point": out[1]}, device="cpu")
    T = np.tile(np.eye(4), (n, 1, 1))
    hull = lambda *x: convex_twin.bodies([4] * n, None, T, np.stack(x, 1))  # noqa: E731
    _, truth = convex_twin.convex_distance(hull(*ends[:2]), hull(*ends[2:]), gap=1e-9)
    _, point = convex_twin.convex_distance(hull(ends[0]), hull(*ends[2:]), gap=1e-9)
    print(f"segments: above truth by at most {(out[0].numpy() - truth).max():.2e} m")
    assert np.abs(out[1].numpy() - point).max() <= 1e-6
    assert (out[0].numpy() - truth).max() <= 2e-6
    assert np.quantile(np.abs(out[0].numpy() - truth), 0.99) <= 1e-6


def test_the_nearest_point_of_a_triangle_is_at_each_corner_edge_and_inside_where_trimesh_has_it():
    rng, n = np.random.default_rng(21), 3000
    a, b, c = ((0.1 * rng.normal(size=(n, 3))).astype(np.float32) for _ in range(3))
    x = (a + b + c) / 3 + (0.15 * rng.normal(size=(n, 3))).astype(np.float32)
    found = np.zeros((n, 3), np.float32)
    init_warp()
    launch(on_triangles, n, inputs={"x": x, "a": a, "b": b, "c": c}, outputs={"nearest": found}, device="cpu")
    corners = np.stack([a, b, c], 1).astype(np.float64)
    true = trimesh.triangles.closest_point(corners, x.astype(np.float64))
    assert np.abs(np.linalg.norm(found - x, axis=1) - np.linalg.norm(true - x, axis=1)).max() < 1e-6
    at = np.linalg.norm(true[:, None] - corners, axis=2) < 1e-9
    weights = trimesh.triangles.points_to_barycentric(corners, true)
    on_edge = (np.abs(weights) < 1e-9).sum(1) == 1
    assert at.sum(0).min() > 100 and on_edge.sum() > 300 and (weights > 1e-6).all(1).sum() > 100
