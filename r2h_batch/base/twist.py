"""Twists (v, w): six numbers that move a pose along SE(3), so that optimisers never leave it.

The first three numbers, v, are metres, the last three, w, radians. A twist is a motion in the pose's own frame:
`retract(T, xi) = T exp(xi)`, v along T's axes, w about them. All functions are differentiable, in float32 and float64, at zero
too.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from r2h_batch.base import se3

SMALL = 1e-2
"""Squared angle below which series stand in for sin, cos: their error is below 1e-16 there."""


def exp(twist: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
    """The rigid motion (..., 4, 4) of a twist.

    Args:
        twist: (..., 6): first v, three numbers in m, then w, three in rad.
    """
    v, w = twist[..., :3], twist[..., 3:]
    a, b, c = _coefficients((w * w).sum(-1))
    W, eye = _hat(w), torch.eye(3, dtype=twist.dtype, device=twist.device)
    R = eye + a[..., None, None] * W + b[..., None, None] * se3.matmul(W, W)
    p = (
        v
        + b[..., None] * torch.linalg.cross(w, v)
        + c[..., None] * torch.linalg.cross(w, torch.linalg.cross(w, v))
    )
    return se3.from_rotation(R, p)


def log(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 6"]:
    """The twist (..., 6) of a rigid motion: first v, three numbers in m, then w, three in rad.

    Args:
        T: (..., 4, 4), angle below pi; within 1e-3 rad of a half turn the axis is ill-conditioned.
    """
    w = _rotation_vector(T[..., :3, :3])
    v = T[..., :3, 3]
    square = (w * w).sum(-1)
    a, b, _ = _coefficients(square)
    # V^-1 = 1 - W / 2 + d W^2 with d = (1 - a / 2 b) / angle^2
    large = square > SMALL
    safe = torch.where(large, square, torch.ones_like(square))
    series = 1 / 12 + square / 720 + square**2 / 30240 + square**3 / 1209600
    d = torch.where(large, (1 - a / (2 * torch.where(large, b, torch.ones_like(b)))) / safe, series)
    turned = torch.linalg.cross(w, v)
    return torch.cat([v - 0.5 * turned + d[..., None] * torch.linalg.cross(w, turned), w], -1)


def retract(T: Float[Tensor, "*b 4 4"], twist: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
    """`T exp(twist)`: the pose moved along its own axes.

    Args:
        T: (..., 4, 4) poses, m.
        twist: (..., 6): first v, three numbers in m, then w, three in rad.
    """
    return se3.matmul(T, exp(twist))


def tangent(T: Float[Tensor, "*b 4 4"], gradient: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 6"]:
    """Gradient (..., 6) with respect to a twist at 0 in `retract(T, twist)`: three numbers per m, then three per rad.

    Args:
        T: (..., 4, 4) poses, m.
        gradient: (..., 4, 4), with respect to T's entries.
    """
    R, G = T[..., :3, :3], gradient[..., :3, :3]
    v = (R * gradient[..., :3, 3, None]).sum(-2)
    A = se3.matmul(R.transpose(-1, -2), G)
    w = torch.stack(
        [A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]], -1
    )
    return torch.cat([v, w], -1)


def _coefficients(square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin t / t, (1 - cos t) / t^2, (t - sin t) / t^3 of t^2."""
    large = square > SMALL
    t2 = torch.where(large, square, torch.ones_like(square))
    t = t2.sqrt()
    half = torch.sin(0.5 * t)
    s = square
    return (
        torch.where(large, torch.sin(t) / t, 1 - s / 6 + s**2 / 120 - s**3 / 5040 + s**4 / 362880),
        torch.where(
            large, 2 * half * half / t2, 0.5 - s / 24 + s**2 / 720 - s**3 / 40320 + s**4 / 3628800
        ),
        torch.where(
            large,
            (t - torch.sin(t)) / (t2 * t),
            1 / 6 - s / 120 + s**2 / 5040 - s**3 / 362880 + s**4 / 39916800,
        ),
    )


def _rotation_vector(R: Tensor) -> Tensor:
    """Axis times angle. Through the unit quaternion of the largest diagonal element: exact up to
    half a turn."""
    d = [R[..., i, i] for i in range(3)]
    x, y, z = (
        R[..., (i + 2) % 3, (i + 1) % 3] - R[..., (i + 1) % 3, (i + 2) % 3] for i in range(3)
    )
    xy, xz, yz = (R[..., i, j] + R[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    # 4 q q^T in terms of R; its row with the largest diagonal element is a quaternion (w, x, y, z)
    # up to scale
    rows = [
        [1 + d[0] + d[1] + d[2], x, y, z],
        [x, 1 + d[0] - d[1] - d[2], xy, xz],
        [y, xy, 1 - d[0] + d[1] - d[2], yz],
        [z, xz, yz, 1 - d[0] - d[1] + d[2]],
    ]
    Q = torch.stack([torch.stack(r, -1) for r in rows], -2)
    best = torch.stack([rows[i][i] for i in range(4)], -1).argmax(-1)
    q = Q.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    q = torch.where(q[..., :1] < 0, -q, q)
    w, v = q[..., 0], q[..., 1:]
    square = (v * v).sum(-1)
    tiny = square <= 1e-8 * w * w
    s = torch.where(tiny, torch.ones_like(square), square).sqrt()
    ratio = torch.where(
        tiny, 2 / torch.where(tiny, w, torch.ones_like(w)), 2 * torch.atan2(s, w) / s
    )
    third = square / torch.where(tiny, w, torch.ones_like(w)) ** 2 / 3
    return v * torch.where(tiny, ratio * (1 - third), ratio)[..., None]


def _hat(w: Tensor) -> Tensor:
    zero = torch.zeros_like(w[..., 0])
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
