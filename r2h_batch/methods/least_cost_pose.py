"""Contact-Handover's orientation: of a fan of handover poses above a palm, the one of least
collision cost with the hand."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Float32, Int32, Int64
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import launch_trials
from r2h_batch.judge.grasp import gripper_poses
from r2h_batch.kernels.methods import pose_cost as kernels
from r2h_batch.methods.box_grasps import half_sides
from r2h_batch.methods.gate import Gate, let_through, passing
from r2h_batch.methods.placing import (
    HOME_X,
    Anchor,
    approach_frames,
    home_x,
    least,
    placed_above_palm,
    roll_angles,
    rolled,
)
from r2h_batch.methods.predictors import TargetHand
from r2h_batch.scene.grasp_tables import gripper_tables
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import Scene

DIRECTIONS = 32
"""Approach directions that are tried, spread over the half sphere that faces the palm: neighbours
25 degrees apart."""

ROLLS = 8
"""Turns about each approach direction."""

ZONE_M = 0.03
"""Hand points nearer than this to gripper or object cost: about twice the estimate's error of 12 mm
an axis."""

HAND_POINTS = 128
"""Points of the hand's skin that are looked at, spread evenly: about 1 cm apart."""


def least_cost_pose(
    scene: Scene,
    object_index: Int32[Tensor, " b"],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    opening_m: Float32[Tensor, " b"],
    target: TargetHand,
    height_m: float,
    *,
    directions: int = DIRECTIONS,
    rolls: int = ROLLS,
    zone_m: float = ZONE_M,
    hand_points: int = HAND_POINTS,
    gate: Gate = "ik",
    clearance_m: float = 0.0,
    at: Anchor = "gripper",
) -> Float32[Tensor, "b 4 4"]:
    """T_world_ee with `at` `height_m` above each palm and the least cost of the poses that pass.

    Of equal costs the approach nearest to straight into the palm, then the roll nearest to home.

    Args:
        scene: objects, hands and robot.
        object_index: (b,) of the objects.
        T_obj_ee: (b, 4, 4) their grasps, m.
        opening_m: (b,) of the gripper.
        target: the estimated hands.
        height_m: how far what `at` names stands above the palm.
        directions: approach directions that are tried.
        rolls: turns about each.
        zone_m: points of the hand nearer than this cost.
        hand_points: points of the hand that the cost counts.
        gate: what a pose must pass; where none does: `gate.let_through`.
        clearance_m: distance that gate "hand" demands.
        at: what stands above the palm.
    """
    R = approach_fan(target.palm_normal, directions, rolls, home_x(scene))
    T_world_ee = placed_above_palm(scene, R, T_obj_ee, object_index, target, height_m, at)
    points = target.vertices[:, hand_sample(scene, hand_points)].contiguous()
    held = object_index, T_obj_ee, opening_m
    cost = collision_cost(scene, *held, T_world_ee, points, zone_m=zone_m)
    passes, reached = passing(
        scene,
        T_world_ee,
        opening_m[:, None].expand(cost.shape),
        target.vertices,
        clearance_m,
        gate=gate,
    )
    every = torch.ones_like(passes)
    best = least(cost, let_through(passes, reached, every), every)
    return T_world_ee[torch.arange(len(best), dtype=torch.int64, device=best.device), best]


def approach_fan(
    palm_normal: Float[Tensor, "b 3"],
    directions: int,
    rolls: int,
    home: Float32[Tensor, "3"] | None = None,
) -> Float[Tensor, "b r 3 3"]:
    """Frames whose z axes spread over the half sphere about -n_h, nearest to it first, each in
    `rolls` rolls from `home` (the gripper's x axis there)."""
    k = np.arange(directions) + 0.5
    z = 1.0 - k / directions
    turn, ring = np.pi * (3.0 - np.sqrt(5.0)) * k, np.sqrt(1.0 - z * z)
    lattice = np.round(np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1), 12)
    if home is None:
        home = torch.tensor(HOME_X, dtype=torch.float32, device=palm_normal.device)
    home = home.to(palm_normal.device, torch.float64)
    into = approach_frames(-palm_normal, home)
    fan = torch.from_numpy(lattice).to(palm_normal.device)
    approach = se3.rotate(into[:, None], fan[None])
    frames = approach_frames(approach, home).reshape(-1, 3, 3)
    return rolled(frames, roll_angles(rolls)).reshape(len(palm_normal), directions * rolls, 3, 3)


def collision_cost(
    scene: Scene,
    object_index: Int32[Tensor, " b"],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    opening_m: Float32[Tensor, " b"],
    T_world_ee: Float32[Tensor, "b r 4 4"],
    hand_points: Float32[Tensor, "b h 3"],
    *,
    zone_m: float = ZONE_M,
) -> Float32[Tensor, "b r"]:
    """Mean over the hand's points (world) of max(0, zone - signed distance to gripper and held
    object), m."""
    b, r = T_world_ee.shape[:2]
    if hand_points.shape[1] > kernels.MOST_POINTS:
        raise ValueError(
            f"{hand_points.shape[1]} hand points; the kernel takes {kernels.MOST_POINTS} at most"
        )
    out = torch.zeros((b, r), dtype=torch.float32, device=scene.device)
    if b == 0:
        return out
    low, high = _boxes(scene)
    axis_low, axis_high, axis_radius = gripper_capsule(scene.robot)
    launch_trials(
        kernels.pose_cost,
        b,
        inputs={
            "gripper": gripper_tables(scene.robot, scene.device),
            "zone": zone_m,
            "axis_low": axis_low,
            "axis_high": axis_high,
            "axis_radius": axis_radius,
            "mesh": scene.object_mesh_ids,
            "low": low,
            "high": high,
            "object": object_index.contiguous(),
            "opening": opening_m.contiguous(),
            "T_obj_ee": T_obj_ee.contiguous(),
            "T_world_ee": T_world_ee.contiguous(),
            "hand": hand_points.contiguous(),
        },
        outputs={"cost": out},
        device=scene.device,
        chunk=2,
        width=r,
    )
    return out


@KeptWith
def hand_sample(scene: Scene, count: int) -> Int64[Tensor, " h"]:
    """Vertices spread over the hand's skin: each the farthest from those before (flat hand), the
    first at the wrist."""
    skin: NDArray[np.float64] = scene.hands.model.vertices.double().numpy()
    taken = [int(np.argmin((skin**2).sum(1)))]
    apart = ((skin - skin[taken[0]]) ** 2).sum(1)
    while len(taken) < min(count, len(skin)):
        taken.append(int(np.argmax(apart)))
        apart = np.minimum(apart, ((skin - skin[taken[-1]]) ** 2).sum(1))
    return torch.tensor(taken, dtype=torch.int64, device=scene.device)


@lru_cache(maxsize=4)
def gripper_capsule(robot: Robot) -> tuple[float, float, float]:
    """Low and high end on ee's z axis, and radius, of a capsule that holds the gripper at any
    opening (m)."""
    slack = 1e-3  # what parts move between two of the openings looked at
    gaps = torch.linspace(0.0, robot.open_gap_m, 61, dtype=torch.float32, device="cpu")
    R, p = (x.double().numpy() for x in gripper_poses(robot, gaps))
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T[:, None] * half_sides(
        robot
    )
    points = (p[:, :, None] + np.einsum("ngij,cgj->ngci", R, corners)).reshape(-1, 3)
    radius = float(np.hypot(points[:, 0], points[:, 1]).max()) + slack
    return float(points[:, 2].min()) - slack, float(points[:, 2].max()) + slack, radius


@KeptWith
def _boxes(scene: Scene) -> tuple[Any, Any]:
    low, high = (
        np.stack([corner(o.vertices, 0) for o in scene.objects]).astype(np.float32)
        for corner in (np.min, np.max)
    )
    return (
        wp.array(low, dtype=wp.vec3, device=scene.device),
        wp.array(high, dtype=wp.vec3, device=scene.device),
    )
