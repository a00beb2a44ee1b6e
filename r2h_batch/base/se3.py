"""Homogeneous transforms as (..., 4, 4) tensors, and vectors beside them: checks, inverse,
construction, products.

Sums over an axis of length 3 or 4 are written out term by term: a row has the same bits at any
batch size.
"""

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R R^T - I that is accepted (and then re-orthonormalised)."""


Array = TypeVar("Array", Tensor, NDArray[np.float64])
"""NumPy or torch."""


def dot(a: Array, b: Array) -> Array:
    """a . b, term by term.

    Args:
        a: (..., 3) vectors, torch or numpy.
        b: (..., 3), in the same frame.

    Returns:
        (...).
    """
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def cross(a: Float[Tensor, "*#b 3"], b: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3"]:
    """a x b, term by term.

    Args:
        a: (..., 3) vectors.
        b: (..., 3), in the same frame.
    """
    return torch.stack(
        [
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ],
        -1,
    )


def from_frames(world: NDArray[np.float64], local: NDArray[np.float64]) -> NDArray[np.float64]:
    """R = world local^T of frames, in sums of a fixed order.

    Args:
        world: (n, 3, 3) axes in the world as columns.
        local: (n, 3, 3) the same axes in the other frame.

    Returns:
        (n, 3, 3) `R_world_local`.
    """
    R = world[:, :, None, 0] * local[:, None, :, 0]
    for k in (1, 2):
        R = R + world[:, :, None, k] * local[:, None, :, k]
    return np.asarray(R)


def rotate(R: Array, v: Array) -> Array:
    """R v, term by term.

    Args:
        R: (..., 3, 3) `R_a_b`, torch or numpy.
        v: (..., 3) vectors in frame b.

    Returns:
        (..., 3) in frame a.
    """
    return R[..., 0] * v[..., 0, None] + R[..., 1] * v[..., 1, None] + R[..., 2] * v[..., 2, None]


def matmul(a: Float[Tensor, "*#b n n"], b: Float[Tensor, "*#b n n"]) -> Float[Tensor, "*b n n"]:
    """`a @ b` row by row: a torch matmul may round a row differently at another batch size, this
    cannot.

    Args:
        a: (..., n, n) `T_a_b`, or any square matrices.
        b: (..., n, n) `T_b_c`.

    Returns:
        (..., n, n) `T_a_c`.
    """
    total = a[..., :, 0, None] * b[..., None, 0, :]
    for k in range(1, a.shape[-1]):
        total = total + a[..., :, k, None] * b[..., None, k, :]
    return total


def apply(T: Float[Tensor, "*#b 4 4"], p: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3"]:
    """One point by each transform.

    Args:
        T: (..., 4, 4) `T_a_b`, m.
        p: (..., 3) points in frame b, m.

    Returns:
        (..., 3) in frame a, m.
    """
    return (
        T[..., :3, 0] * p[..., 0, None]
        + T[..., :3, 1] * p[..., 1, None]
        + T[..., :3, 2] * p[..., 2, None]
        + T[..., :3, 3]
    )


def inverse(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """The inverse of rigid transforms.

    Args:
        T: (..., 4, 4) `T_a_b`, m.

    Returns:
        (..., 4, 4) `T_b_a`.
    """
    out = torch.zeros_like(T)
    R_t = T[..., :3, :3].transpose(-1, -2)
    t = T[..., :3, 3]
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(
        R_t[..., 0] * t[..., 0, None]
        + R_t[..., 1] * t[..., 1, None]
        + R_t[..., 2] * t[..., 2, None]
    )
    out[..., 3, 3] = 1.0
    return out


def translation(p: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Transforms that only move.

    Args:
        p: (..., 3), m.

    Returns:
        (..., 4, 4), of the dtype of `p`.
    """
    T = torch.eye(4, dtype=p.dtype, device=p.device).expand(*p.shape[:-1], 4, 4).clone()
    T[..., :3, 3] = p
    return T


def from_rotation(R: Float[Tensor, "*b 3 3"], p: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Transforms from rotations and origins.

    Args:
        R: (..., 3, 3) `R_a_b`.
        p: (..., 3) origin of b in frame a, m.

    Returns:
        (..., 4, 4) `T_a_b`.
    """
    T = translation(p)
    T[..., :3, :3] = R
    return T


def is_pose(T: Float[Tensor, "*b 4 4"]) -> Bool[Tensor, "*b"]:
    """Whether transforms are rigid: finite, R R^T = I within 1e-3, det R > 0, bottom row (0, 0, 0, 1),
    within a kilometre.

    Args:
        T: (..., 4, 4), m.

    Returns:
        (...) bool.
    """
    finite = torch.isfinite(T).all(-1).all(-1)
    safe = torch.where(finite[..., None, None], T, torch.zeros_like(T))
    x, y, z = safe[..., :3, 0], safe[..., :3, 1], safe[..., :3, 2]
    gram = torch.stack(
        [
            (x * x).sum(-1) - 1,
            (y * y).sum(-1) - 1,
            (z * z).sum(-1) - 1,
            (x * y).sum(-1),
            (x * z).sum(-1),
            (y * z).sum(-1),
        ],
        -1,
    )
    det = (torch.linalg.cross(x, y) * z).sum(-1)
    # without a constant row: on CUDA copying one there would wait for the device
    bottom_ok = (safe[..., 3, :3].abs() <= 1e-6).all(-1) & ((safe[..., 3, 3] - 1.0).abs() <= 1e-6)
    # a kilometre away is a unit error, and float32 has lost the millimetre
    in_reach = (safe[..., :3, 3].abs() < 1e3).all(-1)
    return finite & (gram.abs() <= ROTATION_TOLERANCE).all(-1) & (det > 0) & bottom_ok & in_reach


def orthonormalise(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Exact rotations by Gram-Schmidt, row by row: z keeps its direction, then y, then x.

    Args:
        T: (..., 4, 4) poses, m, whose axes are nearly orthonormal (`is_pose`).
    """
    _, y, z, p = T[..., :3, :].unbind(-1)
    z = z / _length(z)
    y = y - z * (y * z).sum(-1, keepdim=True)
    y = y / _length(y)
    out = torch.zeros_like(T)
    out[..., :3, :] = torch.stack([torch.linalg.cross(y, z), y, z, p], -1)
    out[..., 3, 3] = 1.0
    return out


def _length(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 1"]:
    """Lengths; of float32 with the root that IEEE 754 asks for, on every processor.

    torch's float32 root on a CPU is MKL's, which has another last bit for one number in six. A
    float64 root that is off by as much still rounds to the right float32: no float32 has its root
    within four float64 of the middle between two float32.
    """
    return v.square().sum(-1, keepdim=True).double().sqrt().to(v.dtype)
