"""Random handover poses worth a label: the object's middle above the palm, the gripper behind it, any roll. About half of
them pass the pose stage."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.methods.placing import approach_frames, unit

TILT_DEG = 70.0
"""Largest angle between the approach and the direction that it is drawn about."""
HEIGHT_M = (-0.03, 0.07)
"""Where the middle stands along the palm's normal, from the ball's centre."""
NUMBERS = 5
"""Uniform numbers of a pose."""


def propose(
    middle: Float[Tensor, "n 3"],
    ball_center: Float[Tensor, "n 3"],
    palm_normal: Float[Tensor, "n 3"],
    T_obj_ee: Float[Tensor, "n k 4 4"],
    u: Float[Tensor, "n k 5"],
) -> Float[Tensor, "n k 4 4"]:
    """Handover poses T_world_ee (N, K, 4, 4), float32.

    Args:
        middle: the point of each object that is brought to the palm, frame obj, m.
        ball_center: c_h of the hand, world.
        palm_normal: n_h, world.
        T_obj_ee: the grasp of each pose.
        u: uniform numbers in (0, 1), float64.
    """
    center, normal = ball_center.double()[:, None], palm_normal.double()[:, None]
    outward = unit(center * center.new_tensor([1.0, 1.0, 0.0]))  # the robot stands at the origin
    mix = u[..., 0:1]
    about = approach_frames(mix * outward - (1 - mix) * normal, outward)
    cos = 1 - u[..., 1] * (1 - math.cos(math.radians(TILT_DEG)))
    sin, turn, roll = (1 - cos * cos).sqrt(), 2 * math.pi * u[..., 2], 2 * math.pi * u[..., 3]
    tilted = torch.stack([sin * turn.cos(), sin * turn.sin(), cos], -1)
    z = se3.rotate(about, tilted)
    frame = approach_frames(z, outward)
    x = roll.cos()[..., None] * frame[..., 0] + roll.sin()[..., None] * frame[..., 1]
    R = torch.stack([x, se3.cross(z, x), z], -1)
    grasp = T_obj_ee.double()
    held = se3.rotate(
        grasp[..., :3, :3].transpose(-1, -2), middle.double()[:, None] - grasp[..., :3, 3]
    )
    low, high = HEIGHT_M
    target = center + (low + (high - low) * u[..., 4:5]) * normal
    T = torch.zeros_like(grasp)
    T[..., :3, :3], T[..., 3, 3] = R, 1.0
    T[..., :3, 3] = target - se3.rotate(R, held)
    return T.float()
