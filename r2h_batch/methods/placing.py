"""Handover poses: frames and rolls about an approach axis, and where they stand above a hand.

Frames are computed term by term in float64 with sqrt only: a row has the same bits in any batch.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.config import HOME_Q
from r2h_batch.judge.hand_clearance import gripper_clearance, posed_hand
from r2h_batch.methods.candidates import CandidateTable
from r2h_batch.methods.predictors import TargetHand
from r2h_batch.scene.bounds import outer_ball
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.robot import ee_pose
from r2h_batch.scene.scene import Scene

Anchor = Literal["gripper", "object"]
"""Point that stands on the palm's normal: the gripper's TCP, or the centre of the object (`center_of`)."""

HEIGHT_M = 0.15
"""Height of the anchor above the estimated palm centre: the paper's figure for Contact-Handover;
the authors' release puts every method's object there (docs/baselines.md)."""


HOME_X = (-1.0, 0.0, 0.0)
"""The gripper's x axis at the default home (world), rounded."""

RIGHT, LEFT = 0, 1


def unit(v: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """v / |v|. A zero vector stays zero."""
    length = se3.dot(v, v).sqrt()
    return v / torch.where(length > 0, length, 1.0)[..., None]


def approach_frames(
    z: Float[Tensor, "*b 3"], toward: Float[Tensor, "*#b 3"]
) -> Float[Tensor, "*b 3 3"]:
    """Rotations with given z axes, and x as near to a direction as z allows.

    Args:
        z: (..., 3) approach axes.
        toward: (..., 3) directions for x. If z is (nearly) along one, the world axis that is
            farthest from z takes its place.

    Returns:
        (..., 3, 3) float64, columns x, y, z.
    """
    z = unit(z.double())
    toward = unit(toward.double().expand_as(z))
    across = toward - se3.dot(toward, z)[..., None] * z
    spare = torch.nn.functional.one_hot(z.abs().argmin(-1), 3).double()
    spare = spare - se3.dot(spare, z)[..., None] * z
    x = unit(torch.where((se3.dot(across, across) > 1e-12)[..., None], across, spare))
    return torch.stack([x, se3.cross(z, x), z], -1)


def roll_angles(count: int) -> tuple[float, ...]:
    """`count` evenly spaced angles in rad, the smallest first: 0, +d, -d, +2 d, ..."""
    step = 2 * math.pi / count
    return tuple(step * ((k + 1) // 2) * (1 if k % 2 else -1) for k in range(count))


def rolled(
    R: Float[Tensor, "b 3 3"], angles: Sequence[float], *, axis: int = 2
) -> Float[Tensor, "b r 3 3"]:
    """The frames (b, 3, 3) turned about one of their own axes by each of r angles in rad."""
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
    """A direction projected into the palm plane and turned there towards the thumb.

    Args:
        direction: (b, 3), such as from the wrist to the fingers.
        palm_normal: (b, 3) out of the palm.
        side: (b,) `RIGHT` or `LEFT`.
        angle_deg: of the turn.

    Returns:
        (b, 3) float64 unit vectors.
    """
    n = unit(palm_normal.double())
    flat = direction.double()
    flat = unit(flat - se3.dot(flat, n)[..., None] * n)
    c, s = (
        round(math.cos(math.radians(angle_deg)), 15),
        round(math.sin(math.radians(angle_deg)), 15),
    )
    # n x fingers points to the little finger of a right hand, and to the thumb of a left hand
    sign = torch.where(side.to(flat.device) == LEFT, 1.0, -1.0).double()
    return c * flat + (s * sign)[..., None] * se3.cross(n, flat)


def poses_at(R: Float[Tensor, "b r 3 3"], p: Float[Tensor, "*#b 3"]) -> Float[Tensor, "b r 4 4"]:
    """Transforms (B, R, 4, 4) float32 with these rotations and positions.

    Args:
        R: (B, R, 3, 3) rotations.
        p: (B, 3) or (B, R, 3) positions in the same frame, metres.
    """
    p = p if p.ndim == 3 else p[:, None]
    return se3.from_rotation(R.double(), p.double().expand(*R.shape[:2], 3)).float().contiguous()


def first_true(passes: Bool[Tensor, "b r"]) -> Int[Tensor, " b"]:
    """Index of the first True of each row; 0 if there is none."""
    return passes.to(torch.int8).argmax(1)


def in_order(
    pool: Bool[Tensor, "b k"], *keys: Float[Tensor, "b k"]
) -> tuple[Int64[Tensor, "b k"], Int64[Tensor, " b"]]:
    """Places of each row's values, the least first: those of the pool, by the first key, where that is equal by the next one,
    then by place. And how many the pool has."""
    order = torch.arange(pool.shape[1], dtype=torch.int64, device=pool.device).expand_as(pool)
    for key in (*reversed(keys), (~pool).double()):
        order = order.gather(1, key.double().gather(1, order).argsort(dim=1, stable=True))
    return order, pool.sum(1)


def allowed_else_usable(
    allowed: Bool[Tensor, "b k"], usable: Bool[Tensor, "b k"]
) -> Bool[Tensor, "b k"]:
    """The allowed and usable values of each row; the usable ones if no allowed one is there."""
    return torch.where(allowed.any(1, keepdim=True), allowed & usable, usable)


def least(
    score: Float[Tensor, "b k"], allowed: Bool[Tensor, "b k"], usable: Bool[Tensor, "b k"]
) -> Int[Tensor, " b"]:
    """Index of each row's smallest score, the first of equals: among the allowed and usable ones,
    or among the usable ones if no allowed one is there."""
    pool = allowed_else_usable(allowed, usable)
    score = torch.where(pool, score.double(), torch.inf)
    low = score.amin(1, keepdim=True)
    return (score == low).to(torch.int8).argmax(1)


def home_x(scene: Scene) -> Float32[Tensor, "3"]:
    """(3,) the gripper's x axis at home, world frame: the first roll turns the wrist least from
    there."""
    home = scene.config.workplace.home_q
    axis = HOME_X if home == HOME_Q else ee_pose(scene.robot, home)[:3, 0].tolist()
    return torch.tensor(axis, dtype=torch.float32, device=scene.device)


def candidates_clear_of(
    scene: Scene,
    table: CandidateTable,
    object_index: Tensor,
    hand_vertices: Float32[Tensor, "b v 3"],
    clearance_m: float,
) -> Tensor:
    """(b, k) whether a candidate's closed gripper keeps more than `clearance_m` from a hand (b, V, 3)
    on the object, frame obj."""
    hand = posed_hand(scene.hands.model, hand_vertices, scene.device)
    o = object_index.long()
    distance = gripper_clearance(
        scene.robot, hand, table.T_obj_ee, table.opening_m, table.first[o], table.count[o], table.most,
        cap_m=clearance_m + 1e-3
    )  # fmt: skip
    return distance > clearance_m


def check_choice(name: str, given: str, allowed: Any) -> None:
    """Raise `ValueError` unless the value is one of a `Literal`."""
    if given not in get_args(allowed):
        raise ValueError(f"{name} is {given!r}; allowed are {', '.join(get_args(allowed))}")


def placed_above_palm(
    scene: Scene,
    R_world_ee: Float[Tensor, "b r 3 3"],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Tensor,
    target: TargetHand,
    height_m: float,
    at: Anchor,
) -> Float32[Tensor, "b r 4 4"]:
    """(b, r, 4, 4) T_world_ee with these rotations that put `at` `height_m` above the palm, along
    its normal."""
    check_choice("at", at, Anchor)
    point = target.palm_point.double() + height_m * target.palm_normal.double()
    if at == "gripper":
        return poses_at(R_world_ee, point)
    centers = np.stack([center_of(o) for o in scene.objects])
    center_obj = torch.from_numpy(centers).to(scene.device)[object_index.long()]
    R_ee_obj = T_obj_ee[:, :3, :3].double().transpose(1, 2)
    center_ee = se3.rotate(R_ee_obj, center_obj - T_obj_ee[:, :3, 3].double())
    return poses_at(R_world_ee, point[:, None] - se3.rotate(R_world_ee, center_ee[:, None]))


@lru_cache(maxsize=256)
def center_of(model: ObjectModel) -> Float64[NDArray[Any], "3"]:
    """(3,) the point of an object that stands above a palm, frame obj, m.

    Of an object of r2h-v1 or r2h-release it is the centre of the box along the frame's axes. Of any other object it is the
    centre of the smallest ball that holds it, which turns with the object.
    """
    if model.who.has_frozen_frame:
        return (model.vertices.min(0).astype(np.float64) + model.vertices.max(0)) / 2
    ball = outer_ball(model.hull_vertices.astype(np.float64))
    return np.round(ball[:3], 6)  # the solver's last digits differ between machines


def taken(rows: Int64[Tensor, "b k"], chosen: Int64[Tensor, " b"]) -> Int64[Tensor, " b"]:
    """(b,) rows of the candidate table: the chosen one of each trial's k."""
    return rows[torch.arange(len(rows), dtype=torch.int64, device=rows.device), chosen.long()]
