"""The condition that a handover pose must meet before a method may choose it: the arm reaches it, the gripper is also clear of
the estimated hand, or nothing. One rule for all methods (docs/baselines.md)."""

from typing import Literal

import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor

from r2h_batch.judge.hand_clearance import gripper_clearance, posed_hand
from r2h_batch.judge.ik import solve_ik
from r2h_batch.methods.placing import check_choice, first_true
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene

Gate = Literal["hand", "ik", "none"]
"""Conditions on a pose. hand: the arm reaches it, and the gripper is clear of the estimated hand;
ik: the arm reaches it; none: nothing."""


def reachable(robot: Robot, T_world_ee: Float[Tensor, "b r 4 4"]) -> Bool[Tensor, "b r"]:
    """Whether IK has a solution for each pose (world frame). Collisions are not checked."""
    flat = T_world_ee.reshape(-1, 4, 4).contiguous()
    return solve_ik(flat, robot=robot).reachable.reshape(T_world_ee.shape[:2])


def passing(
    scene: Scene,
    T_world_ee: Float32[Tensor, "b r 4 4"],
    opening_m: Float32[Tensor, "b r"],
    hand_vertices: Float32[Tensor, "b v 3"],
    clearance_m: float = 0.0,
    *,
    gate: Gate,
) -> tuple[Bool[Tensor, "b r"], Bool[Tensor, "b r"]]:
    """Which poses pass, and which the arm reaches (all, where the gate asks nothing).

    Args:
        scene: with the robot and the hand's model.
        T_world_ee: (b, r, 4, 4) poses.
        opening_m: (b, r) of the gripper in each.
        hand_vertices: (b, V, 3) the estimated hand, world frame, metres.
        clearance_m: distance that gate "hand" demands.
        gate: what a pose must pass.

    Raises:
        ValueError: no such gate.
    """
    check_choice("gate", gate, Gate)
    b, r = T_world_ee.shape[:2]
    if gate == "none":
        every = torch.ones((b, r), dtype=torch.bool, device=T_world_ee.device)
        return every, every
    reached = reachable(scene.robot, T_world_ee)
    if gate == "ik":
        return reached, reached
    hand = posed_hand(scene.hands.model, hand_vertices, scene.device)
    row = torch.arange(b, dtype=torch.int64, device=T_world_ee.device) * r
    distance = gripper_clearance(
        scene.robot, hand, T_world_ee.reshape(-1, 4, 4), opening_m.reshape(-1), row, torch.full_like(row, r), r,
        cap_m=clearance_m + 1e-3
    )  # fmt: skip
    return reached & (distance > clearance_m), reached


def let_through(
    passes: Bool[Tensor, "b r"], reached: Bool[Tensor, "b r"], usable: Bool[Tensor, "b r"]
) -> Bool[Tensor, "b r"]:
    """The usable poses that a method may choose: those that pass; where none does, those that the
    arm reaches; where it reaches none, all."""
    allowed = usable & passes
    for more in (usable & reached, usable):
        allowed = torch.where(allowed.any(1, keepdim=True), allowed, more)
    return allowed


def first_fit(
    scene: Scene,
    T_world_ee: Float32[Tensor, "b r 4 4"],
    opening_m: Float32[Tensor, " b"],
    hand_vertices: Float32[Tensor, "b v 3"],
    clearance_m: float = 0.0,
    *,
    gate: Gate = "hand",
) -> Float32[Tensor, "b 4 4"]:
    """Choose each row's first pose that passes the gate.

    If none passes, it is the first that the arm reaches; if it reaches none, the first one.

    Args:
        scene: with the hand's model.
        T_world_ee: (b, r, 4, 4) poses in order of preference.
        opening_m: (b,) of the gripper.
        hand_vertices: (b, V, 3) world frame, metres.
        clearance_m: distance that gate "hand" demands.
        gate: what a pose must pass.

    Returns:
        (b, 4, 4) T_world_ee.
    """
    b, r = T_world_ee.shape[:2]
    opening = opening_m[:, None].expand(b, r)
    passes, reached = passing(scene, T_world_ee, opening, hand_vertices, clearance_m, gate=gate)
    at = first_true(let_through(passes, reached, torch.ones_like(passes)))
    return T_world_ee[torch.arange(b, dtype=torch.int64, device=at.device), at].contiguous()
