"""Swept bounds against dense samples of the motion: never above where a body really goes, and tight to third order."""

import numpy as np
import pytest
import torch
import warp as wp

from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.geometry.shape import swept_support
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.joints import CHANGES, FIELDS, vecq
from r2h_batch.kernels.robot.world import World, bends, forward_kinematics, relative_acceleration, robot_shape, twists

wp.set_module_options(OPTIONS)

STEPS = 64


@wp.kernel
def bound_and_samples(
    first: int, world: World, body_in: wp.array(dtype=int), other_in: wp.array(dtype=int),
    q_in: wp.array2d(dtype=float), d_in: wp.array2d(dtype=float), n_in: wp.array(dtype=wp.vec3),
    bound_out: wp.array(dtype=float), least_out: wp.array(dtype=float), middle_out: wp.array(dtype=float),
    third_out: wp.array(dtype=float),
):  # fmt: skip
    """For an arm body seen from another link, which n is fixed to: the swept bound, and the least n . x of samples."""
    row = first + wp.tid()
    b = body_in[row]
    o = other_in[row]
    k = world.body_link[b]
    R = wp.zeros(shape=7, dtype=wp.mat33)
    p = wp.zeros(shape=7, dtype=wp.vec3)
    w = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    v = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    q = vecq()
    d = vecq()
    for j in range(6):
        q[j] = q_in[row, j]
        d[j] = d_in[row, j]
    eye = wp.identity(n=3, dtype=float)
    forward_kinematics(world, eye, wp.vec3(0.0, 0.0, 0.0), q, R, p)
    twists(d, R, p, w, v)
    shape = robot_shape(world, b)
    n = R[o] * n_in[row]
    second, third = bends(world.motion_radius, b, o, d)
    g, c = relative_acceleration(n, w[k], v[k], w[CHANGES + k], v[CHANGES + k], o, w, v)
    low = swept_support(
        shape, R[k] * world.body_R[b], R[k] * world.body_p[b] + p[k], world.points, n, w[k] - w[o], v[k] - v[o], g, c,
        second, third,
    )  # fmt: skip
    bound_out[row] = low - wp.dot(n, p[o])
    third_out[row] = third
    best = wp.float32(1.0e30)
    for i in range(2 * STEPS + 1):
        s = float(i - STEPS) / float(STEPS)
        forward_kinematics(world, eye, wp.vec3(0.0, 0.0, 0.0), q + s * d, R, p)
        n = R[o] * n_in[row]
        # a point set of length 0 in place of the shape: its own support, from a bound without motion
        at = swept_support(
            shape, R[k] * world.body_R[b], R[k] * world.body_p[b] + p[k], world.points, n, wp.vec3(0.0, 0.0, 0.0),
            wp.vec3(0.0, 0.0, 0.0), wp.vec3(0.0, 0.0, 0.0), 0.0, 0.0, 0.0,
        )  # fmt: skip
        at = at - wp.dot(n, p[o])
        best = wp.min(best, at)
        if i == STEPS:
            middle_out[row] = at
    least_out[row] = best


@pytest.mark.check
@pytest.mark.parametrize("reach_rad", [0.02, 0.3, 1.5])
def test_no_body_comes_lower_than_its_swept_bound_and_short_intervals_lose_little(scene, reach_rad: float) -> None:
    rng = np.random.default_rng(int(1000 * reach_rad))
    count = 4000
    link = scene.world.body_link.numpy()
    body = rng.integers(6, scene.world.n_arm, count).astype(np.int32)
    other = np.array([rng.integers(0, link[b]) for b in body], np.int32)
    q = rng.uniform(-np.pi, np.pi, (count, 6)).astype(np.float32)
    d = rng.normal(size=(count, 6))
    d = (d * reach_rad / np.abs(d).sum(1, keepdims=True)).astype(np.float32)
    n = rng.normal(size=(count, 3))
    n = (n / np.linalg.norm(n, axis=1, keepdims=True)).astype(np.float32)
    out = {name: torch.zeros(count) for name in ("bound", "least", "middle", "third")}
    inputs = {"world": scene.world, "body": body, "other": other, "q": q, "d": d, "n": n}
    launch_trials(bound_and_samples, count, inputs=inputs, outputs=out, device="cpu")
    bound, least, middle, third = (out[k].double().numpy() for k in ("bound", "least", "middle", "third"))
    assert (bound <= least + 5e-6).all()
    # What is lost: the third order at both ends, and the curvature, which is counted at its worst though not the middle's
    assert (least <= middle + 1e-6).all()
    lost = least - bound
    if reach_rad == 0.02:
        assert np.quantile(lost, 0.99) < 5e-5 and third.max() < 2e-5
    if reach_rad == 0.3:
        assert np.median(lost) < 0.012
