"""Twists: exponential and logarithm against scipy's matrix functions, derivatives, small and large angles."""

import numpy as np
import pytest
import scipy.linalg
import torch

from r2h_batch.base import se3, twist

DOUBLE = torch.float64


def twists(n: int, angle: float, seed: int = 0) -> torch.Tensor:
    """Twists whose turns have exactly this angle."""
    x = torch.from_numpy(np.random.default_rng(seed).normal(size=(n, 6)))
    x[:, 3:] *= angle / x[:, 3:].norm(dim=1, keepdim=True)
    return x


def matrix(xi: np.ndarray) -> np.ndarray:
    v, (x, y, z) = xi[:3], xi[3:]
    return np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])


@pytest.mark.parametrize("angle", [0.0, 0.099, 0.101, 5.0])
def test_exp_is_the_matrix_exponential(angle):
    xi = twists(20, angle)
    expected = np.stack([scipy.linalg.expm(matrix(x)) for x in xi.numpy()])
    np.testing.assert_allclose(twist.exp(xi).numpy(), expected, atol=1e-13)
    np.testing.assert_allclose(twist.exp(xi.float()).double().numpy(), expected, atol=2e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.099, 0.101, 3.1, np.pi - 1e-5])
def test_log_undoes_exp(angle):
    xi = twists(50, angle)
    np.testing.assert_allclose(twist.log(twist.exp(xi)).numpy(), xi.numpy(), atol=1e-9)
    if angle < 3.14:
        np.testing.assert_allclose(twist.log(twist.exp(xi.float())).numpy(), xi.numpy(), atol=3e-5)


@pytest.mark.parametrize("angle", [0.0, 0.0999, 2.5])
def test_exp_and_log_have_the_derivatives_of_finite_differences(angle):
    xi = twists(3, angle).requires_grad_()
    assert torch.autograd.gradcheck(twist.exp, xi)
    T = twist.exp(twists(3, angle, 1))
    zero = torch.zeros(3, 6, dtype=DOUBLE, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: twist.log(twist.retract(T, x)), zero)


def test_tangent_is_the_gradient_of_what_retract_does():
    T = twist.exp(twists(20, 1.3)).requires_grad_()
    weight = torch.from_numpy(np.random.default_rng(2).normal(size=(20, 4, 4)))
    weight[:, 3] = 0
    f = lambda T: (weight * T).sum() + (weight * se3.matmul(T, T)).square().sum()  # noqa: E731
    (gradient,) = torch.autograd.grad(f(T), T)
    xi = torch.zeros(20, 6, dtype=DOUBLE, requires_grad=True)
    (expected,) = torch.autograd.grad(f(twist.retract(T.detach(), xi)), xi)
    torch.testing.assert_close(twist.tangent(T.detach(), gradient), expected, atol=1e-12, rtol=1e-12)


def test_a_thousand_retractions_stay_poses_and_rows_do_not_depend_on_the_batch():
    T = twist.exp(twists(33, 1.0)).float()
    xi = 0.01 * twists(33, 1.0, 3).float()
    moved = twist.retract(T, xi)
    for i in (0, 7, 32):
        assert torch.equal(moved[i], twist.retract(T[i : i + 1], xi[i : i + 1])[0])
    for _ in range(1000):
        T = twist.retract(T, xi)
    assert se3.is_pose(T).all()
    assert twist.exp(torch.zeros(0, 6)).shape == (0, 4, 4) and twist.exp(torch.zeros(2, 3, 6)).shape == (2, 3, 4, 4)
