"""The farthest of points in blocks: the very point that a loop over them in float32 finds, of equal ones the first."""

import numpy as np
import pytest
import warp as wp

from r2h_batch.bodies.bounds import BLOCK_POINTS, point_blocks
from r2h_batch.kernels.geometry.body import farthest_in_blocks
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.launch import launch

wp.set_module_options(OPTIONS)


@wp.kernel
def farthest_points(
    points: wp.array(dtype=wp.vec3), start: wp.array(dtype=int), count: wp.array(dtype=int), d: wp.array(dtype=wp.vec3),
    point_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    i = wp.tid()
    point_out[i] = farthest_in_blocks(points, start[i], count[i], d[i])


@pytest.mark.parametrize("rough", [True, False])
def test_the_first_of_the_farthest_points_is_found(rough: bool) -> None:
    rng = np.random.default_rng(3)
    clouds = [rng.normal(size=(n, 3)).astype(np.float32) for n in (*range(1, 70), 200)]
    d = rng.normal(size=(len(clouds), 400, 3)).astype(np.float32)
    if rough:  # coordinates on a coarse grid: many products are equal, some are -0.0
        clouds, d = [np.round(x) for x in clouds], np.round(d)
    blocks = [point_blocks(x) for x in clouds]
    start = np.cumsum([0] + [len(b) for b in blocks])[:-1].astype(np.int32)
    count = np.array([len(x) for x in clouds], np.int32)
    n = d.shape[1]
    asked = {}
    for name, counts in (("points", count), ("blocks", -(-count // BLOCK_POINTS) * BLOCK_POINTS)):
        out = np.empty((len(clouds) * n, 3), np.float32)
        inputs = {
            "points": np.concatenate(blocks), "start": np.repeat(start, n), "count": np.repeat(counts, n),
            "d": d.reshape(-1, 3),
        }  # fmt: skip
        launch(farthest_points, len(out), inputs=inputs, outputs={"point": out}, device="cpu")
        asked[name] = out.reshape(len(clouds), n, 3)
    for i, x in enumerate(clouds):
        products = d[i, :, None] * x
        height = (products[..., 0] + products[..., 1]) + products[..., 2]
        first = x[height.argmax(1)]
        assert np.array_equal(asked["points"][i], first) and np.array_equal(asked["blocks"][i], first)
