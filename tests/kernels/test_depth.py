"""Penetration depth from below: never more than Qhull has from the whole Minkowski difference, and close to it."""

import numpy as np
import warp as wp
from convex_twin import core_of, penetration_depth
from scipy.spatial.transform import Rotation

from r2h_batch.base.launch import init_warp, launch
from r2h_batch.kernels.geometry.depth import core_depth
from r2h_batch.kernels.geometry.shape import Shape
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.scene.robot import ShapeKind

wp.set_module_options(OPTIONS)
init_warp()
COUNT = 240


@wp.kernel
def depths(
    kind: wp.array2d(dtype=int), size: wp.array2d(dtype=wp.vec3), start: wp.array2d(dtype=int), count: wp.array2d(dtype=int),
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), points: wp.array(dtype=wp.vec3), depth_out: wp.array(dtype=float),
):  # fmt: skip
    i = wp.tid()
    a = Shape()
    b = Shape()
    a.kind = kind[i, 0]
    a.size = size[i, 0]
    a.start = start[i, 0]
    a.count = count[i, 0]
    b.kind = kind[i, 1]
    b.size = size[i, 1]
    b.start = start[i, 1]
    b.count = count[i, 1]
    depth_out[i] = core_depth(a, R[i], p[i], points, b, points)


def test_the_depth_of_cores_is_from_below_and_within_two_per_cent() -> None:
    rng = np.random.default_rng(4)
    kinds = rng.choice([ShapeKind.CAPSULE, ShapeKind.CYLINDER, ShapeKind.BOX, ShapeKind.HULL], (COUNT, 2))
    size = np.exp(rng.uniform(np.log(0.004), np.log(0.15), (COUNT, 2, 3))).astype(np.float32)
    clouds = [
        (rng.normal(size=(n, 3)) * 0.5 * size[i, k]).astype(np.float32)
        for i in range(COUNT)
        for k, n in enumerate(rng.integers(5, 60, 2))
    ]
    count = np.array([len(c) for c in clouds], np.int32)
    R = Rotation.random(COUNT, random_state=5).as_matrix().astype(np.float32)
    R[::5] = np.eye(3)  # faces that are parallel
    p = (rng.normal(size=(COUNT, 3)) * size.min((1, 2))[:, None] * rng.choice([0.1, 1.0, 3.0], (COUNT, 1))).astype(
        np.float32
    )
    found = np.full(COUNT, np.nan, np.float32)
    inputs = {
        "kind": kinds.astype(np.int32), "size": size, "start": (np.cumsum(count) - count).astype(np.int32).reshape(-1, 2),
        "count": count.reshape(-1, 2), "R": R, "p": p, "points": np.concatenate(clouds),
    }  # fmt: skip
    launch(depths, COUNT, inputs=inputs, outputs={"depth": found}, device="cpu")
    true = np.empty(COUNT)
    for i in range(COUNT):
        a, b = (core_of(int(kinds[i, k]), size[i, k].astype(float), clouds[2 * i + k], sides=48)[0] for k in (0, 1))
        true[i] = penetration_depth(a @ R[i].T.astype(float) + p[i], b)
    assert (found <= true + 1e-7).all(), (found - true).max()
    deep = true > 1e-4
    assert deep.sum() > COUNT / 2 and (found[true == 0] == 0).all()
    short = 1 - found[deep] / true[deep]
    assert np.median(short) < 0.01 and (short < 0.02).mean() > 0.98 and short.max() < 0.2, (
        np.sort(short)[-8:],
        deep.sum(),
    )
