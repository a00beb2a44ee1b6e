"""Handover poses from a hand: directions, frames about an approach axis, rolls, and which of them
the arm can take.

Term by term in float64 with sqrt only: a row has the same bits in any batch.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from r2h_batch import se3
from r2h_batch.judge.ik import solve_ik

__all__ = [
    "approach_frames",
    "first_true",
    "least",
    "poses_at",
    "reachable",
    "roll_angles",
    "rolled",
    "turned_inward",
    "unit",
]

RIGHT, LEFT = 0, 1


def unit(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """v / |v|; zero stays zero."""
    length = se3.dot(v, v).sqrt()
    return v / torch.where(length > 0, length, 1.0)[..., None]


def approach_frames(
    z: Float[Tensor, "*b 3"], toward: Float[Tensor, "*#b 3"]
) -> Float[Tensor, "*b 3 3"]:
    """Rotations (columns x, y, z) with these z axes, and x as near to `toward` as that allows.

    Where z is (nearly) along `toward`, the world axis that is farthest from z stands in for it.
    """
    z = unit(z.double())
    toward = unit(toward.double().expand_as(z))
    across = toward - se3.dot(toward, z)[..., None] * z
    spare = torch.nn.functional.one_hot(z.abs().argmin(-1), 3).double()
    spare = spare - se3.dot(spare, z)[..., None] * z
    x = unit(torch.where((se3.dot(across, across) > 1e-12)[..., None], across, spare))
    return torch.stack([x, se3.cross(z, x), z], -1)


def roll_angles(count: int) -> tuple[float, ...]:
    """`count` evenly spaced angles in rad, the smallest turns first: 0, +d, -d, +2 d, ..."""
    step = 2 * math.pi / count
    return tuple(step * ((k + 1) // 2) * (1 if k % 2 else -1) for k in range(count))


def rolled(
    R: Float[Tensor, "b 3 3"], angles: Sequence[float], *, axis: int = 2
) -> Float[Tensor, "b r 3 3"]:
    """The frames turned about one of their own axes (default z) by each angle (rad)."""
    u, v = R[..., (axis + 1) % 3], R[..., (axis + 2) % 3]
    turned = []
    for angle in angles:
        c, s = round(math.cos(angle), 15), round(math.sin(angle), 15)
        columns = [R[..., axis]] * 3
        columns[(axis + 1) % 3], columns[(axis + 2) % 3] = c * u + s * v, c * v - s * u
        turned.append(torch.stack(columns, -1))
    return torch.stack(turned, 1)


def turned_inward(
    direction: Float[Tensor, "b 3"],
    palm_normal: Float[Tensor, "b 3"],
    side: Int[Tensor, " b"],
    angle_deg: float,
) -> Float[Tensor, "b 3"]:
    """`direction` laid into the palm plane and turned in it towards the thumb's side of the hand;
    unit vectors.

    n x fingers points to the little finger's side of a right hand, and to the thumb's side of a
    left hand.
    """
    n = unit(palm_normal.double())
    flat = direction.double()
    flat = unit(flat - se3.dot(flat, n)[..., None] * n)
    c, s = (
        round(math.cos(math.radians(angle_deg)), 15),
        round(math.sin(math.radians(angle_deg)), 15),
    )
    sign = torch.where(side.to(flat.device) == LEFT, 1.0, -1.0).double()
    return c * flat + (s * sign)[..., None] * se3.cross(n, flat)


def poses_at(R: Float[Tensor, "b r 3 3"], p: Float[Tensor, "*#b 3"]) -> Float[Tensor, "b r 4 4"]:
    """Float32 transforms with these rotations at p (b, 3) or (b, r, 3)."""
    p = p if p.ndim == 3 else p[:, None]
    return se3.from_rotation(R.double(), p.double().expand(*R.shape[:2], 3)).float().contiguous()


def reachable(
    T_world_ee: Float[Tensor, "b r 4 4"], *, threads: int | None = None
) -> Bool[Tensor, "b r"]:
    """Whether the arm has any joint solution for each pose (no collision is looked at)."""
    flat = T_world_ee.reshape(-1, 4, 4).contiguous()
    return solve_ik(flat, threads=threads).reachable.reshape(T_world_ee.shape[:2])


def first_true(passes: Bool[Tensor, "b r"]) -> Int[Tensor, " b"]:
    """Index of the first True of each row, 0 where there is none."""
    return passes.to(torch.int8).argmax(1)


def least(
    score: Float[Tensor, "b k"], allowed: Bool[Tensor, "b k"], usable: Bool[Tensor, "b k"]
) -> Int[Tensor, " b"]:
    """Index of each row's smallest score among the allowed, else among the usable; the first of
    equals."""
    pool = torch.where(allowed.any(1, keepdim=True), allowed & usable, usable)
    score = torch.where(pool, score.double(), torch.inf)
    low = score.amin(1, keepdim=True)
    return (score == low).to(torch.int8).argmax(1)
