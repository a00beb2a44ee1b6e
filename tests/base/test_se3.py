"""Transforms against NumPy, and what counts as a pose."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from r2h_batch.base import se3


def poses(n: int, seed: int = 0) -> torch.Tensor:
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, random_state=seed).as_matrix().reshape(n, 3, 3) if n else T[:, :3, :3]
    T[:, :3, 3] = np.random.default_rng(seed).normal(size=(n, 3))
    return torch.from_numpy(T.astype(np.float32))


@pytest.mark.parametrize("n", [0, 1, 2, 33])
def test_products_inverses_and_points_agree_with_numpy(n: int) -> None:
    a, b = poses(n, 1), poses(n, 2)
    p = torch.from_numpy(np.random.default_rng(3).normal(size=(n, 3)).astype(np.float32))
    A, B = a.double().numpy(), b.double().numpy()
    np.testing.assert_allclose(se3.matmul(a, b).numpy(), A @ B, atol=1e-6)
    np.testing.assert_allclose(se3.inverse(a).numpy(), np.linalg.inv(A) if n else A, atol=1e-6)
    homogeneous = np.concatenate([p.numpy(), np.ones((n, 1))], 1)
    np.testing.assert_allclose(se3.apply(a, p).numpy(), np.einsum("nij,nj->ni", A, homogeneous)[:, :3], atol=1e-6)


def test_only_rigid_transforms_are_poses() -> None:
    T = poses(9)
    T[1, 0, 0] = torch.nan
    T[2, 0, 3] = torch.inf
    T[3, :3, 0] *= -1  # a reflection
    T[4, :3, :3] *= 1.01
    T[5, :3, :3] = 0
    T[6, 3] = torch.tensor([0.0, 0, 0, 2])
    T[7, :3, :3] *= 1 + 4e-4  # R R^T - I of 8e-4: rounding of somebody's file format
    T[8, 2, 3] = 5e3
    assert se3.is_pose(T).tolist() == [True, False, False, False, False, False, False, True, False]


def test_orthonormalise_repairs_small_errors_and_keeps_the_approach_axis() -> None:
    T = poses(20)
    bent = T.clone()
    bent[:, :3, :3] += 3e-4 * torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(0))
    fixed = se3.orthonormalise(bent)
    R = fixed[:, :3, :3].double()
    assert (R @ R.transpose(1, 2) - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-6
    z = bent[:, :3, 2] / bent[:, :3, 2].norm(dim=1, keepdim=True)
    assert (fixed[:, :3, 2] - z).abs().max() < 1e-6
    assert (fixed - T).abs().max() < 2e-3


def test_orthonormal_axes_have_the_quotients_and_roots_of_ieee_754() -> None:
    T = poses(5000)
    T[:, :3, :3] += 3e-4 * torch.randn(5000, 3, 3, generator=torch.Generator().manual_seed(1))
    y, z = T[:, :3, 1].numpy().T, T[:, :3, 2].numpy().T
    z = z / np.sqrt(z[0] * z[0] + z[1] * z[1] + z[2] * z[2])
    y = y - z * (y[0] * z[0] + y[1] * z[1] + y[2] * z[2])
    y = y / np.sqrt(y[0] * y[0] + y[1] * y[1] + y[2] * y[2])
    assert y.dtype == z.dtype == np.float32
    fixed = se3.orthonormalise(T).numpy()
    assert np.array_equal(fixed[:, :3, 1].T, y) and np.array_equal(fixed[:, :3, 2].T, z)
