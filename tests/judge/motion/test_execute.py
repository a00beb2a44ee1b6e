"""The time law against numerical integration of the phase plane, and its limits by finite differences."""

import numpy as np
import pytest
import torch
from rounds import each
from scipy.integrate import quad

from r2h_batch.config import ExecConfig
from r2h_batch.judge.motion.time_law import Motion, time_at, time_path

LAW = ExecConfig()
V, A = LAW.scale * LAW.max_velocity_rad_s, LAW.scale * LAW.max_acceleration_rad_s2


def phase_plane_time(distance: float, upto: float, v: float = V, a: float = A) -> float:
    """Time to cover `upto` of a rest-to-rest motion over `distance`: the integral of ds / min(v, what a allows)."""

    def slowness(s: float) -> float:
        return 1.0 / min(v, np.sqrt(2 * a * s), np.sqrt(2 * a * (distance - s)))

    # s = u^2 near the start and distance - u^2 near the end take the poles away
    half = min(upto, distance / 2)
    knee = [np.sqrt(min(v * v / (2 * a), half))]
    t = quad(lambda u: 2 * u * slowness(u * u), 0.0, np.sqrt(half), points=knee)[0]
    if upto > distance / 2:
        low, high = np.sqrt(distance - upto), np.sqrt(distance / 2)
        knee = [np.clip(np.sqrt(v * v / (2 * a)), low, high)]
        t += quad(lambda u: 2 * u * slowness(distance - u * u), low, high, points=knee)[0]
    return float(t)


def made_paths(rng: np.random.Generator, n: int, width: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
    """Random polylines of 0 or 2 to `width` waypoints with long and very short segments; rubbish beyond their ends."""
    step = rng.normal(size=(n, width, 6)) * 10.0 ** rng.uniform(-4, 0.3, size=(n, width, 1))
    length = rng.choice([0, *range(2, width + 1)], n)
    path = np.cumsum(step, 1).astype(np.float32)
    path[np.arange(width) >= length[:, None]] = 1e3
    return torch.from_numpy(path), torch.from_numpy(length.astype(np.int32))


def passing_times(
    path: torch.Tensor, length: torch.Tensor, motion: Motion, row: int, fractions: np.ndarray, config=LAW
):
    """Times (S, F) at which a row's path passes fractions of its segments."""
    n = int(length[row]) - 1
    k = n * len(fractions)
    timed = Motion(motion.time_s[row].expand(k, -1), motion.t_exec_s[row].expand(k))
    segment = torch.arange(n, dtype=torch.int32).repeat_interleave(len(fractions))
    fraction = torch.from_numpy(np.tile(fractions, n).astype(np.float32))
    at = time_at(path[row].expand(k, -1, -1), length[row].expand(k), timed, segment, fraction, config)
    return at.numpy().reshape(n, len(fractions))


def test_waypoint_times_add_up_and_rows_without_a_path_have_none():
    rng = np.random.default_rng(0)
    path, length = made_paths(rng, 33)
    motion = time_path(path, length, LAW)
    assert (length == 0).any() and (length > 1).sum() > 10
    for row in range(33):
        n = int(length[row])
        if n == 0:
            assert torch.isnan(motion.t_exec_s[row])
            continue
        d = np.abs(np.diff(path[row, :n].double().numpy(), axis=0)).max(1)
        expected = np.concatenate([[0], np.cumsum([phase_plane_time(x, x) for x in d])])
        np.testing.assert_allclose(motion.time_s[row, :n].numpy(), expected, rtol=3e-6, atol=1e-6)
        assert (motion.time_s[row, n:] == motion.t_exec_s[row]).all()
        assert motion.t_exec_s[row] == motion.time_s[row, n - 1]


@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_time_at_is_when_the_integrated_motion_passes_a_point(scale):
    config = ExecConfig(scale=scale)
    law = scale * config.max_velocity_rad_s, scale * config.max_acceleration_rad_s2
    path, length = made_paths(np.random.default_rng(1), 12)
    motion = time_path(path, length, config)
    fractions = np.array([0.0, 1e-4, 0.01, 0.2, 0.5, 0.73, 0.99, 1.0], np.float32)
    for row in each(np.flatnonzero(length.numpy() > 0)):
        at = passing_times(path, length, motion, row, fractions, config)
        d = np.abs(np.diff(path[row, : int(length[row])].double().numpy(), axis=0)).max(1)
        for k, whole in enumerate(d):
            start = float(motion.time_s[row, k])
            expected = [start + phase_plane_time(whole, float(f) * whole, *law) for f in fractions]
            np.testing.assert_allclose(at[k], expected, rtol=2e-6, atol=2e-5)
        assert np.array_equal(at[:, 0], motion.time_s[row, : len(d)].numpy())
        assert (np.diff(at, axis=1) >= 0).all()
