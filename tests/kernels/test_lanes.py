"""Bounds that are asked of eight boxes, points or triangles at a time: never too few of them, hardly ever too many."""

import ctypes
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp
from needs import needs
from rounds import each

from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.geometry.balls import balls_within
from r2h_batch.kernels.geometry.lanes import (
    LEAF_ROWS,
    TRIANGLE_ROWS,
    boxes_along,
    boxes_in_prism,
    boxes_near,
    cut_to_prism,
    first_lane,
    lane_point,
    leaf_in_prism,
    outside_runs,
    points_near,
    triangles_in_prism,
    triangles_near,
)
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

COUNT = 300
PRISM = (0.011, 0.02)  # half_x, half_z about the origin
REACH = 0.01


@wp.kernel
def _ask(
    first: int, half_x: float, half_z: float, reach: float,
    leaf_in: wp.array(dtype=float), triangle_in: wp.array(dtype=float), members_in: wp.array(dtype=int),
    R_in: wp.array(dtype=wp.mat33), t_in: wp.array(dtype=wp.vec3),
    low_in: wp.array(dtype=wp.vec3), high_in: wp.array(dtype=wp.vec3),
    run_low_in: wp.array(dtype=float), run_high_in: wp.array(dtype=float),
    center_in: wp.array(dtype=wp.vec3), radius_in: wp.array(dtype=float),
    found_out: wp.array2d(dtype=int), near_out: wp.array3d(dtype=int), cut_out: wp.array2d(dtype=float),
):  # fmt: skip
    i = first + wp.tid()
    R = R_in[i]
    t = t_in[i]
    n = members_in[i]
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    ry = wp.vec3(R[1, 0], R[1, 1], R[1, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    a = LEAF_ROWS * i
    b = TRIANGLE_ROWS * i
    near = wp.zeros(shape=8, dtype=int)
    corners = wp.zeros(shape=72, dtype=float)
    span = wp.zeros(shape=16, dtype=float)
    cut = wp.zeros(shape=16, dtype=float)
    found_out[i, 0] = boxes_in_prism(leaf_in, a, n, rx, rz, t[0], t[2], 0.0, half_x, 0.0, half_z)
    found_out[i, 1] = triangles_in_prism(
        triangle_in, b, n, rx, rz, t[0], t[2], -half_x, half_x, -half_z, half_z
    )  # fmt: skip
    boxes_along(leaf_in, a, ry, t[1], span)
    found_out[i, 2] = outside_runs(span, 255, 0.0, run_low_in, run_high_in, run_low_in.shape[0])
    found_out[i, 9] = leaf_in_prism(triangle_in, b, n, R, t, half_x, -half_z, half_z, corners, span)
    found_out[i, 3] = outside_runs(span, 255, 0.0, run_low_in, run_high_in, run_low_in.shape[0])
    found_out[i, 10] = cut_to_prism(corners, 254, half_x, -half_z, half_z, cut)
    for k in range(16):
        cut_out[i, k] = cut[k]
    found_out[i, 4] = boxes_near(leaf_in, a, n, R, t, reach, low_in, high_in, 5, near)
    for k in range(8):
        near_out[i, 0, k] = near[k]
    found_out[i, 5] = points_near(leaf_in, a, n, R, t, reach, low_in, high_in, 5, near)
    for k in range(8):
        near_out[i, 1, k] = near[k]
    found_out[i, 6] = triangles_near(triangle_in, b, n, R, t, high_in[2], reach)
    beside = balls_within(
        center_in, radius_in, 0, center_in.shape[0], low_in[0], high_in[0], t[1] * t[1], reach
    )  # fmt: skip
    found_out[i, 7] = int(beside)
    p = lane_point(triangle_in, b + 3, first_lane(1 << (i % 8)))
    found_out[i, 8] = int(p[2] == triangle_in[8 * (b + 5) + i % 8])


def _bits(found: np.ndarray, n: int = 8) -> np.ndarray:
    return (found[:, None] >> np.arange(n)) & 1 == 1


def _apart(low: np.ndarray, high: np.ndarray, center: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Distance of boxes (middle, half sides) to the box [low, high], all along the same axes."""
    return np.linalg.norm(np.maximum(np.maximum(low - center, center - high) - half, 0), axis=-1)


def _edges_in_prism(triangles: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Lowest and highest y of what triangles' edges (n, 3, 3) have in |x|, |z| <= limit; nan: none."""
    p, q = triangles, np.roll(triangles, -1, axis=1)
    d = q - p
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.stack([(s * limit - p[..., ::2]) / d[..., ::2] for s in (-1, 1)])  # two bounds, of x and z
    t0, t1 = np.maximum(t.min(0).max(-1), 0), np.minimum(t.max(0).min(-1), 1)
    y = np.where(t0 <= t1, p[..., 1] + np.stack([t0, t1]) * d[..., 1], np.nan)
    finite = np.isfinite(y).any((0, 2))
    out = np.full((len(triangles), 2), np.nan)
    out[finite] = np.stack([np.nanmin(y[:, finite], (0, 2)), np.nanmax(y[:, finite], (0, 2))], -1)
    return out


@pytest.fixture(scope="module")
def asked() -> SimpleNamespace:
    """Random groups of eight, what is asked of them, and what the kernel answers."""
    rng = np.random.default_rng(4)
    triangles = rng.normal(0, 0.02, (COUNT, 8, 1, 3)) + rng.normal(0, 0.004, (COUNT, 8, 3, 3))
    center = 0.5 * (triangles.min(2) + triangles.max(2))
    half = 0.5 * (triangles.max(2) - triangles.min(2))
    radius = np.linalg.norm(triangles - center[:, :, None], axis=-1).max(2)
    leaf = np.concatenate([center, half, radius[..., None]], -1).transpose(0, 2, 1)
    R, t = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0], rng.normal(0, 0.01, (COUNT, 3))
    members = rng.integers(1, 9, COUNT)
    low = np.array([[-0.03, -0.01, -0.01], [9, 9, 9], [-0.02, -0.02, -0.015]])
    high = np.array([[-0.01, 0.01, 0.02], [9, 9, 9], [0.02, 0.02, 0.015]])
    runs = np.array([[-0.02, -0.004], [0.001, 0.03]])
    balls, ball = rng.normal(0, 0.02, (27, 3)), rng.uniform(0.001, 0.01, 27)

    def tensor(x: np.ndarray, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(x)).to(dtype)

    found, near = torch.empty((COUNT, 11), dtype=torch.int32), torch.empty((COUNT, 2, 8), dtype=torch.int32)
    cut = torch.empty((COUNT, 16), dtype=torch.float32)
    lanes = triangles.reshape(COUNT, 8, 9).transpose(0, 2, 1)
    inputs = {
        "half_x": PRISM[0], "half_z": PRISM[1], "reach": REACH,
        "leaf": tensor(leaf.ravel()), "triangle": tensor(lanes.ravel()), "members": tensor(members, torch.int32),
        "R": tensor(R), "t": tensor(t), "low": tensor(low), "high": tensor(high),
        "run_low": tensor(runs[:, 0]), "run_high": tensor(runs[:, 1]), "center": tensor(balls), "radius": tensor(ball),
    }  # fmt: skip
    outputs = {"found": found, "near": near, "cut": cut}
    launch_trials(_ask, COUNT, inputs=inputs, outputs=outputs, device="cpu")
    return SimpleNamespace(**locals())


def test_what_is_near_is_found_among_eight(asked: SimpleNamespace) -> None:
    R, t, members, triangles, center, half, radius = (
        getattr(asked, name) for name in ["R", "t", "members", "triangles", "center", "half", "radius"]
    )
    low, high, runs, balls, ball = (getattr(asked, name) for name in ["low", "high", "runs", "balls", "ball"])
    got, of, cut = (asked.outputs[name].numpy() for name in ("found", "near", "cut"))
    member = np.arange(8) < members[:, None]

    # the same in float64; within 1 um of the border either answer is right
    at = np.einsum("nij,nkj->nki", R, center) + t[:, None]
    turned = np.einsum("nij,nkj->nki", np.abs(R), half)
    corner = np.einsum("nij,nkcj->nkci", R, triangles) + t[:, None, None]
    least, most = corner.min(2), corner.max(2)
    limit = np.array(PRISM)

    def agree(mine: np.ndarray, slack: np.ndarray, share: float = 0.02) -> None:
        """`slack`: by how much (m) it is in, negative out; `share`: how many are in, at least."""
        clear = np.abs(slack) > 1e-6
        assert (mine == (slack > 0))[clear].all()
        assert clear.mean() > 0.99 and share < mine.mean() < 0.98

    xz = [0, 2]
    agree(_bits(got[:, 0])[member], (limit - (np.abs(at[..., xz]) - turned[..., xz])).min(-1)[member])
    touches = np.minimum(limit - least[..., xz], most[..., xz] + limit).min(-1)
    agree(_bits(got[:, 1])[member], touches[member])
    agree(_bits(got[:, 1] >> 8), np.maximum(-limit - least[..., xz], most[..., xz] - limit).max(-1))
    assert (got[:, 9] == got[:, 1]).all(), "all of a leaf at once: the same answers"
    low_high = cut.reshape(-1, 2, 8).transpose(0, 2, 1).reshape(-1, 2)
    expected = _edges_in_prism(corner.reshape(-1, 3, 3), limit)
    some = low_high[:, 0] <= low_high[:, 1]
    assert (some == np.isfinite(expected[:, 0])).mean() > 0.999 and 0.2 < some.mean() < 0.8
    both = some & np.isfinite(expected[:, 0])
    assert np.abs(low_high - expected)[both].max() < 1e-5
    for i, (x, z) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
        at_corner = np.array([x, z]) * limit
        holds = np.minimum(at_corner - least[..., xz], most[..., xz] - at_corner).min(-1)
        agree(_bits(got[:, 10] >> 8 * i)[:, 1:], holds[:, 1:], 0.005)
        assert not (got[:, 10] >> 8 * i & 1).any(), "a lane that was not asked for"
    for column, bottom, top in (
        (2, at[..., 1] - turned[..., 1], at[..., 1] + turned[..., 1]),
        (3, least[..., 1], most[..., 1]),
    ):
        agree(_bits(got[:, column]), -np.minimum(bottom[..., None] - runs[:, 0], runs[:, 1] - top[..., None]).max(-1))
    boxed = np.stack([_apart(a, b, at, turned) for a, b in zip(low, high, strict=True)], -1)
    balled = np.stack([_apart(a, b, at, np.zeros(3)) for a, b in zip(low, high, strict=True)], -1)
    within = np.minimum(REACH - boxed, REACH + radius[..., None] - balled)
    for i, bit in ((0, 1), (2, 4)):
        agree((of[:, 0] & bit != 0), within[..., i])
        agree((of[:, 1] & bit != 0), REACH - balled[..., i])
    assert not (of & 2).any(), "a box that is not used"
    assert (_bits(got[:, 4]) == ((of[:, 0] != 0) & member)).all()
    assert (_bits(got[:, 5]) == ((of[:, 1] != 0) & member)).all()
    apart = _apart(-high[2], high[2], 0.5 * (least + most), 0.5 * (most - least))
    agree(_bits(got[:, 6])[member], (REACH - apart)[member])

    u = high[0] - low[0]
    s = np.clip((balls - low[0]) @ u / (u @ u), 0, 1)
    beside = np.linalg.norm(low[0] + s[:, None] * u - balls, axis=1) - ball
    keeps = _bits(got[:, 7], 27)
    slack = REACH + t[:, 1:2] ** 2 - beside
    assert keeps[slack > 0].all() and not keeps[slack < -4e-6].any()
    assert got[:, 8].all()


NATIVE = Path(__file__).resolve().parents[2] / "kernels" / "native"


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """native_lanes.cpp as a library, without Warp."""
    library = tmp_path_factory.mktemp("native") / "lanes.so"
    compiler = shutil.which("g++") or shutil.which("clang++") or pytest.fail("needs() lets no other machine in")
    options = ["-std=c++17", "-O1", "-Wall", "-Werror", "-ffp-contract=off", "-shared", "-fPIC", f"-I{NATIVE}"]
    source = Path(__file__).with_name("native_lanes.cpp")
    subprocess.run([compiler, *options, "-o", library, source], check=True)
    return ctypes.CDLL(str(library))


@needs("compiler")
def test_one_lane_at_a_time_has_the_bits_of_eight_at_once(asked: SimpleNamespace, compiled: ctypes.CDLL) -> None:
    """GCC builds the form that CUDA runs; Warp's kernels on a CPU run the other one."""
    inputs, outputs = asked.inputs, asked.outputs
    expected = [x.numpy().copy() for x in outputs.values()]
    got = [np.empty_like(x) for x in expected]
    order = ["leaf", "triangle", "members", "R", "t", "low", "high", "run_low", "run_high", "center", "radius"]
    arguments: list[object] = [COUNT, *(ctypes.c_float(inputs[name]) for name in ("half_x", "half_z", "reach"))]
    for name in order:
        arguments.append(ctypes.c_void_p(inputs[name].data_ptr()))
        if name in ("run_high", "radius"):
            arguments.append(len(inputs[name]))
    compiled.ask(*arguments, *(ctypes.c_void_p(x.ctypes.data) for x in got))
    for a, b in each(zip(expected, got, strict=True)):
        assert (a.view(np.int32) == b.view(np.int32)).all()
