"""Bounds that are asked of all capsules or all faces at once: whoever is near keeps its bit, hardly anybody else does."""

import numpy as np
import pytest
import torch
import warp as wp
from convex_twin import point_to_segment

from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.geometry.balls import balls_in_reach, capsules_within
from r2h_batch.kernels.geometry.shape import BOX, CAPSULE, CYLINDER, SPHERE
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

COUNT = 400


@wp.kernel
def _capsules(
    first: int, count: int, reach: float,
    end0_in: wp.array(dtype=wp.vec3), end1_in: wp.array(dtype=wp.vec3), radius_in: wp.array(dtype=float),
    c0_in: wp.array(dtype=wp.vec3), c1_in: wp.array(dtype=wp.vec3), around_in: wp.array(dtype=float),
    low_out: wp.array(dtype=int), high_out: wp.array(dtype=int),
):  # fmt: skip
    i = first + wp.tid()
    bits = capsules_within(end0_in, end1_in, radius_in, count, c0_in[i], c1_in[i], around_in[i], reach)
    low_out[i] = int(bits & wp.uint64(0xFFFFFFFF))
    high_out[i] = int(bits >> wp.uint64(32))


@wp.kernel
def _balls(
    first: int, start: int, count: int, kind: int, size: wp.vec3, radius: float, limit: float, beyond: float, known: float,
    ball_in: wp.array(dtype=wp.vec4), R_in: wp.array(dtype=wp.mat33), p_in: wp.array(dtype=wp.vec3),
    n_in: wp.array(dtype=wp.vec3), low_out: wp.array(dtype=int), high_out: wp.array(dtype=int),
):  # fmt: skip
    i = first + wp.tid()
    bits = balls_in_reach(
        ball_in, start, count, kind, size, radius, R_in[i], p_in[i], limit, n_in[i], beyond, known
    )  # fmt: skip
    low_out[i] = int(bits & wp.uint64(0xFFFFFFFF))
    high_out[i] = int(bits >> wp.uint64(32))


def _asked(kernel: wp.Kernel, inputs: dict) -> np.ndarray:
    """(COUNT, 64) bits."""
    low, high = torch.empty((2, COUNT), dtype=torch.int32).unbind(0)
    tensors = {
        k: torch.from_numpy(np.ascontiguousarray(v, dtype=np.float32)) if isinstance(v, np.ndarray) else v
        for k, v in inputs.items()
    }
    launch_trials(kernel, COUNT, inputs=tensors, outputs={"low": low, "high": high}, device="cpu")
    words = np.stack([low.numpy(), high.numpy()], 1).astype(np.int64) & 0xFFFFFFFF
    return (words[:, :, None] >> np.arange(32) & 1 == 1).reshape(COUNT, 64)


def _segments(a0: np.ndarray, a1: np.ndarray, b0: np.ndarray, b1: np.ndarray) -> np.ndarray:
    """Distance of segments: at an end of one of them, or inside both, where it is square to both."""
    a0, a1, b0, b1 = np.broadcast_arrays(a0, a1, b0, b1)
    at_an_end = [(a0, b0, b1), (a1, b0, b1), (b0, a0, a1), (b1, a0, a1)]
    least = np.min([point_to_segment(*x) for x in at_an_end], 0)
    u, v, r = a1 - a0, b1 - b0, a0 - b0
    uu, vv, uv, ur, vr = ((x * y).sum(-1) for x, y in ((u, u), (v, v), (u, v), (u, r), (v, r)))
    denom = np.maximum(uu * vv - uv * uv, 1e-30)
    s, t = (uv * vr - ur * vv) / denom, (uu * vr - uv * ur) / denom
    inside = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    return np.where(inside, np.linalg.norm(r + s[..., None] * u - t[..., None] * v, axis=-1), least)


@pytest.mark.parametrize("count", [3, 8, 21, 64])
def test_capsules_beside_a_capsule_are_found_all_at_once(count: int) -> None:
    rng = np.random.default_rng(count)
    b0 = rng.normal(0, 0.2, (count, 3)).astype(np.float32).astype(float)
    b1 = (b0 + rng.normal(0, 0.2, (count, 3))).astype(np.float32).astype(float)
    b1[::5] = b0[::5]  # balls
    a0 = rng.normal(0, 0.2, (COUNT, 3)).astype(np.float32).astype(float)
    a1 = (a0 + rng.normal(0, 0.2, (COUNT, 3))).astype(np.float32).astype(float)
    a1[::7] = a0[::7]
    a1[1::7] = (a0 + 0.7 * (b1[1] - b0[1]))[1::7]  # parallel to one of them
    ball, around, reach = rng.uniform(0.01, 0.1, count), rng.uniform(0.01, 0.1, COUNT), 0.03
    keeps = _asked(
        _capsules,
        {
            "count": count, "reach": reach, "end0": b0, "end1": b1, "radius": ball,
            "c0": a0, "c1": a1, "around": around,
        },
    )  # fmt: skip
    apart = _segments(a0[:, None], a1[:, None], b0[None], b1[None]) - ball - around[:, None]
    assert keeps[:, :count][apart < reach].all() and not keeps[:, count:].any()
    assert 0.02 < (apart < reach).mean() < 0.9
    u, v = (a1 - a0)[:, None], (b1 - b0)[None]
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    parallel = uu * vv - uv * uv < 1.1e-3 * uu * vv  # such ones keep their bit
    assert not (keeps[:, :count] & ~parallel & (apart > reach + 2e-5)).any()


@pytest.mark.parametrize("count", [1, 8, 27, 64])
@pytest.mark.parametrize("kind", [SPHERE, CAPSULE, CYLINDER, BOX])
@pytest.mark.parametrize("limit", [0.02, -0.002])
def test_balls_in_reach_of_a_primitive_are_found_all_at_once(count: int, kind: int, limit: float) -> None:
    rng = np.random.default_rng(count)
    start, size, known = 5, np.array([0.02, 0.03, 0.01]), 0.01
    radius = 0.02 if kind in (SPHERE, CAPSULE) else 0.0
    balls = np.concatenate([rng.normal(0, 0.04, (start + count, 3)), rng.uniform(0.001, 0.01, (start + count, 1))], 1)
    balls = balls.astype(np.float32).astype(float)
    R, p = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0], rng.normal(0, 0.02, (COUNT, 3))
    n = rng.normal(size=(COUNT, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    beyond = 0.03
    keeps = _asked(
        _balls,
        {
            "start": start, "count": count, "kind": int(kind), "size": wp.vec3(*size), "radius": radius, "limit": limit,
            "beyond": beyond, "known": known, "ball": balls, "R": R, "p": p, "n": n,
        },
    )  # fmt: skip
    mine = balls[start:]
    at = np.abs(np.einsum("nji,nkj->nki", R, mine[None, :, :3] - p[:, None]))
    ring = np.linalg.norm(at[..., :2], axis=-1)
    if kind == BOX:
        far = np.linalg.norm(np.maximum(at - size, 0), axis=-1)
    elif kind == CYLINDER:
        far = np.hypot(np.maximum(ring - size[0], 0), np.maximum(at[..., 2] - size[1], 0))
    else:
        beyond_end = at[..., 2] if kind == SPHERE else np.maximum(at[..., 2] - size[1], 0)
        far = np.maximum(np.hypot(ring, beyond_end) - radius, 0)
    behind = beyond - np.einsum("nj,kj->nk", n, mine[:, :3]) - mine[:, 3] - known  # above 0: settled by the plane
    room = np.maximum(far - mine[:, 3] - limit, behind)
    inside = far == 0  # a primitive's own distance says nothing there: the plane alone may settle it
    near = np.where(inside, behind < 0, room < 0)
    assert keeps[:, :count][near].all() and not keeps[:, count:].any()
    assert not (keeps[:, :count] & ~inside & (far > 2e-5) & (room > 2e-5)).any()
    assert near.any() and near.mean() < 0.95
