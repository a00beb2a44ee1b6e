"""Margins that can be differentiated: the evaluator's own numbers forward, first-order changes at the witnesses backward.

A margin is a distance between two points that the evaluator found. To first order it changes as these points are carried
along, without having to be found again (Danskin): each function here is that change as a function of the two poses, zero
at the poses themselves. docs/training_loop.md says what is behind each number and where it has kinks.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from r2h_batch import se3
from r2h_batch.kernels.witness import EMPTY, MATERIAL, STEP_HIGH, STEP_LOW

__all__ = ["Closing", "Contact", "attached", "closed", "with_gradient"]


@dataclass(frozen=True)
class Closing:
    """Between which points the pads stand, at the grasp `T_obj_ee`: 4 points are low, high as met, low, high as judged.

    `slope_*`: how far y follows a wall of the pads' prism that cuts the surface there; `lift`: how the pads rise per
    metre of opening. `state`: what the opening depends on, a code of kernels/witness.py.
    """

    T_obj_ee: Float[Tensor, "b 4 4"]
    point_obj: Float[Tensor, "b 4 3"]
    slope_x: Float[Tensor, "b 4"]
    slope_z: Float[Tensor, "b 4"]
    lift: Float[Tensor, " b"]
    state: Int32[Tensor, " b"]
    centred: Bool[Tensor, " b"]
    """the pads hold the object: closing has moved it to their middle"""


@dataclass(frozen=True)
class Closed:
    """First-order changes of width, opening and shift (m), zero at the poses of the witness."""

    width: Float[Tensor, " b"]
    opening: Float[Tensor, " b"]
    shift: Float[Tensor, " b"]


@dataclass(frozen=True)
class Contact:
    """A point of the object and the gripper primitive nearest to it, at an opening. Normal: ee frame, towards the object."""

    point_obj: Float[Tensor, "b 3"]
    normal_ee: Float[Tensor, "b 3"]
    finger: Float[Tensor, "b 3"]
    """velocity of the primitive's point, per metre of opening"""
    found: Bool[Tensor, " b"]


STEEPEST = 0.05
"""Least 1 - dw/dg: the opening moves by at most 20 times what the material does."""


def closed(T_obj_ee: Float[Tensor, "b 4 4"], c: Closing) -> Closed:
    """How width, opening and shift change with the grasp: the opening is the fixed point of width and pad height."""
    x0 = se3.apply(se3.inverse(c.T_obj_ee)[:, None], c.point_obj)
    d = se3.apply(se3.inverse(T_obj_ee)[:, None], c.point_obj) - x0
    y = d[..., 1] - c.slope_x * d[..., 0] - c.slope_z * d[..., 2]
    rise = c.slope_z * c.lift[:, None]
    zero = torch.zeros_like(c.lift)
    follows, step = c.state == MATERIAL, (c.state == STEP_LOW) | (c.state == STEP_HIGH)
    material = (y[:, 1] - y[:, 0]) / (1 - (rise[:, 1] - rise[:, 0])).clamp(min=STEEPEST)
    on_step = torch.where(c.state == STEP_LOW, d[:, 0, 2], d[:, 1, 2]) / torch.where(step, c.lift, torch.ones_like(zero))
    opening = torch.where(follows, material, torch.where(step, on_step, zero))
    y = y + rise * torch.where(follows, opening, zero)[:, None]
    return Closed(
        width=torch.where(c.state == EMPTY, zero, y[:, 3] - y[:, 2]),
        opening=torch.where(c.centred, opening, zero),
        shift=torch.where(c.centred, 0.5 * (y[:, 0] + y[:, 1]), zero),
    )


def attached(T_obj_ee: Float[Tensor, "b 4 4"], shift_m: Float[Tensor, " b"], change: Closed) -> Float[Tensor, "b 4 4"]:
    """`grasp.attach` with the shift's change: where the object is held after closing."""
    p = T_obj_ee[:, :3, 3] + T_obj_ee[:, :3, 1] * (shift_m + change.shift)[:, None]
    return se3.from_rotation(T_obj_ee[:, :3, :3], p)


def separation(
    T_obj_ee: Float[Tensor, "b 4 4"], T_obj_ee_0: Float[Tensor, "b 4 4"], opening: Float[Tensor, " b"], c: Contact
) -> Float[Tensor, " b"]:
    """Change of the distance between an object's point and a gripper primitive; `T_obj_ee` is the attachment."""
    x0 = se3.apply(se3.inverse(T_obj_ee_0), c.point_obj)
    moved = se3.apply(se3.inverse(T_obj_ee), c.point_obj) - x0 - c.finger * opening[:, None]
    return torch.where(c.found, dot(c.normal_ee, moved), torch.zeros_like(opening))


def approach(
    T_obj_ee: Float[Tensor, "b 4 4"],
    T_world_ee: Float[Tensor, "b 4 4"],
    point_obj: Float[Tensor, "b 3"],
    point_world: Float[Tensor, "b 3"],
    normal_world: Float[Tensor, "b 3"],
) -> Float[Tensor, " b"]:
    """How far a point of the held object has gone along `normal_world` from `point_world`; `T_obj_ee` is the attachment."""
    T_world_obj = se3.matmul(T_world_ee, se3.inverse(T_obj_ee))
    return dot(normal_world, se3.apply(T_world_obj, point_obj) - point_world)


def dot(a: Float[Tensor, "*b 3"], b: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Inner products, summed in a fixed order: the same bits at any batch size."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


class _WithGradient(torch.autograd.Function):
    """Value of the first, gradient of the second."""

    @staticmethod
    def forward(ctx: object, value: Tensor, change: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: object, *gradient: Tensor) -> tuple[None, Tensor]:
        return None, gradient[0]


def with_gradient(value: Float[Tensor, "*b"], change: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """`value`, bit for bit, with the gradient of `change`."""
    out: Tensor = _WithGradient.apply(value, change)  # type: ignore[no-untyped-call]
    return out
