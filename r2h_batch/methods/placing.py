"""From a chosen grasp to a handover pose: the first of several poses that passes what a method
checks."""

from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch import se3
from r2h_batch.bodies.robot import ee_pose
from r2h_batch.config import HOME_Q
from r2h_batch.methods.candidates import CandidateTable
from r2h_batch.methods.hand_clearance import gripper_clearance, posed_hand
from r2h_batch.methods.palm_pose import first_true, poses_at, reachable
from r2h_batch.predictors import TargetHand
from r2h_batch.scene.scene import Scene

__all__ = [
    "HOME_X",
    "Anchor",
    "Gate",
    "above_palm",
    "candidates_clear_of",
    "centers_at",
    "check_choice",
    "first_fit",
    "home_x",
    "object_centers",
    "placed_above_palm",
    "taken",
]

Gate = Literal["hand", "ik", "none"]
"""What a roll must pass: the arm reaches it with the gripper clear of the estimated hand; the arm
reaches it; nothing."""

Anchor = Literal["gripper", "object"]
"""What stands on the palm's normal: the gripper's TCP, or the middle of the object's bounding
box."""


HOME_X = (-1.0, 0.0, 0.0)
"""The gripper's x axis at the default home (world), rounded."""


def home_x(scene: Scene) -> Float32[Tensor, "3"]:
    """The gripper's x axis at home (world): the first roll that is tried turns the wrist least from
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
    *,
    threads: int | None = None,
) -> Tensor:
    """(b, k) whether a candidate's closed gripper keeps more than `clearance_m` from a hand on the
    object (frame obj)."""
    hand = posed_hand(scene.hands.model, hand_vertices, scene.device, threads=threads)
    o = object_index.long()
    distance = gripper_clearance(
        hand, table.T_obj_ee, table.opening_m, table.first[o], table.count[o], table.most,
        cap_m=clearance_m + 1e-3, threads=threads,
    )  # fmt: skip
    return distance > clearance_m


def first_fit(
    scene: Scene,
    T_world_ee: Float32[Tensor, "b r 4 4"],
    opening_m: Float32[Tensor, " b"],
    hand_vertices: Float32[Tensor, "b v 3"] | None,
    clearance_m: float = 0.0,
    *,
    gate: Gate = "hand",
    threads: int | None = None,
) -> Float32[Tensor, "b 4 4"]:
    """Each row's first pose that the arm reaches with the gripper clear of the hand (world frame;
    None: any will do).

    Where none passes: the first that the arm reaches, else the first. `gate`: what is asked for at
    all.
    """
    check_choice("gate", gate, Gate)
    b, r = T_world_ee.shape[:2]
    if gate == "none":
        return T_world_ee[:, 0].contiguous()
    reached = reachable(T_world_ee, threads=threads)
    passes = reached
    if hand_vertices is not None and gate == "hand":
        hand = posed_hand(scene.hands.model, hand_vertices, scene.device, threads=threads)
        row = torch.arange(b, dtype=torch.int64, device=T_world_ee.device) * r
        distance = gripper_clearance(
            hand, T_world_ee.reshape(-1, 4, 4), opening_m.repeat_interleave(r), row, torch.full_like(row, r), r,
            cap_m=clearance_m + 1e-3, threads=threads,
        )  # fmt: skip
        passes = reached & (distance > clearance_m)
    at = torch.where(passes.any(1), first_true(passes), first_true(reached))
    return T_world_ee[torch.arange(b, dtype=torch.int64, device=at.device), at]


def check_choice(name: str, given: str, allowed: Any) -> None:
    """`ValueError` for a choice that is none of those of a `Literal`."""
    if given not in get_args(allowed):
        raise ValueError(f"{name} is {given!r}; allowed are {', '.join(get_args(allowed))}")


def above_palm(target: TargetHand, height_m: float) -> Float[Tensor, "b 3"]:
    """The points `height_m` above the target hands' palm centres, along their normals (world,
    float64)."""
    return target.palm_point.double() + height_m * target.palm_normal.double()


def placed_above_palm(
    scene: Scene,
    R_world_ee: Float[Tensor, "b r 3 3"],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Tensor,
    target: TargetHand,
    height_m: float,
    at: Anchor,
) -> Float32[Tensor, "b r 4 4"]:
    """T_world_ee with these rotations that put `at` at `height_m` above each palm's centre."""
    check_choice("at", at, Anchor)
    point = above_palm(target, height_m)
    if at == "gripper":
        return poses_at(R_world_ee, point)
    center = torch.from_numpy(object_centers(scene)).to(scene.device)[object_index.long()]
    return centers_at(R_world_ee, T_obj_ee, center, point)


def object_centers(scene: Scene) -> NDArray[np.float64]:
    """(O, 3) the middle of each object's bounding box, frame obj."""
    corners = [(o.vertices.min(0), o.vertices.max(0)) for o in scene.objects]
    return np.stack([(low.astype(np.float64) + high) / 2 for low, high in corners])


def centers_at(
    R_world_ee: Float[Tensor, "b r 3 3"],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    center_obj: Float[Tensor, "b 3"],
    target: Float[Tensor, "b 3"],
) -> Float32[Tensor, "b r 4 4"]:
    """T_world_ee with these rotations that put the object's point `center_obj` (frame obj) at
    `target` (world)."""
    R_ee_obj = T_obj_ee[:, :3, :3].double().transpose(1, 2)
    center_ee = se3.rotate(R_ee_obj, center_obj.double() - T_obj_ee[:, :3, 3].double())
    return poses_at(
        R_world_ee, target.double()[:, None] - se3.rotate(R_world_ee, center_ee[:, None])
    )


def taken(rows: Int64[Tensor, "b k"], chosen: Int64[Tensor, " b"]) -> Int64[Tensor, " b"]:
    """The row of the candidate table that each trial has chosen."""
    return rows[torch.arange(len(rows), dtype=torch.int64, device=rows.device), chosen.long()]
