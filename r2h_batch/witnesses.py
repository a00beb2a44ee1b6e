"""Finds the points that decide each margin: one kernel launch per kind of margin, after the evaluator has judged."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch import se3
from r2h_batch.first_order import Arm, Closing, Contact
from r2h_batch.grasp import OPEN_GAP_M
from r2h_batch.kernels import reach as reach_kernels
from r2h_batch.kernels import witness as kernels
from r2h_batch.kernels import witness_closing as closing_kernels
from r2h_batch.kernels import witness_posture as posture_kernels
from r2h_batch.launch import launch_trials
from r2h_batch.robot import load_robot
from r2h_batch.scene import Placed, Scene

__all__ = ["arm_at", "closing", "finger_motion", "fingers", "hand_contact", "nearest_to_point", "off_region"]

DAMPING = 1e-3
"""Of the arm's inverse Jacobian (metres and radians alike): postures with smaller singular values count as stuck there."""

SLACK_M = 3e-5
"""A witness may be this much nearer or farther than the evaluator's number, which is a certified bound of it."""


def closing(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    width_m: Float32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    *,
    threads: int | None = None,
) -> Closing:
    """What the pads met, where the evaluator found these (width NaN: nothing); `T_obj_ee` before the object moved."""
    b, device = len(T_obj_ee), T_obj_ee.device
    points = torch.zeros((b, 4, 3), device=device)
    slope_x, slope_z, lift = (
        torch.zeros((b, 4), device=device),
        torch.zeros((b, 4), device=device),
        torch.zeros(b, device=device),
    )
    state = torch.zeros(b, dtype=torch.int32, device=device)
    tables = scene.grasp_tables
    launch_trials(
        closing_kernels.closing_witness,
        b,
        [tables.gripper, tables.surfaces, OPEN_GAP_M, int(scene.config.width == "whole"), _mat44(T_obj_ee)]
        + [wp.from_torch(x.contiguous()) for x in (object_index, width_m, opening_m)]
        + [wp.from_torch(points, dtype=wp.vec3)]
        + [wp.from_torch(x) for x in (slope_x, slope_z, lift, state)],
        device=scene.device,
        threads=threads,
    )
    return Closing(T_obj_ee, points, slope_x, slope_z, lift, state, (state > 0) & (width_m <= OPEN_GAP_M))


def fingers(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    distance_m: Float32[Tensor, " b"],
    wanted: Bool[Tensor, " b"],
    *,
    region: bool,
    threads: int | None = None,
) -> Contact:
    """The point of the object (or of its receiver's region) nearest to or deepest in the gripper, where `wanted`.

    `distance_m`: the evaluator's distance. The fingers count for the region, the whole gripper for the object.
    """
    b, device, tables = len(T_obj_ee), T_obj_ee.device, scene.grasp_tables
    bound = torch.where(wanted, distance_m + SLACK_M, -torch.inf)
    part = torch.full((b,), -1, dtype=torch.int32, device=device)
    distance = torch.zeros(b, device=device)
    point, normal, finger = (torch.zeros((b, 3), device=device) for _ in range(3))
    launch_trials(
        kernels.surface_witness,
        b,
        [tables.gripper, tables.surfaces, tables.objects if region else 0, tables.moving if region else tables.every]
        + [_mat44(T_obj_ee), wp.from_torch(object_index), wp.from_torch(opening_m.contiguous()), wp.from_torch(bound)]
        + [wp.from_torch(part), wp.from_torch(distance)]
        + [wp.from_torch(x, dtype=wp.vec3) for x in (point, normal, finger)],
        device=scene.device,
        threads=threads,
    )
    return Contact(point, normal, finger, part >= 0)


def nearest_to_point(
    scene: Scene,
    T_frame_obj: Float32[Tensor, "b 4 4"],
    point: Float32[Tensor, "b 3"],
    object_index: Int32[Tensor, " b"],
    *,
    threads: int | None = None,
) -> tuple[Float32[Tensor, "b 3"], Float32[Tensor, "b 3"]]:
    """The object's point nearest to `point` of some frame (object frame), and the way there (that frame; zero inside)."""
    x = se3.apply(se3.inverse(T_frame_obj), point).contiguous()
    distance, nearest = torch.zeros(len(x), device=x.device), torch.zeros((len(x), 3), device=x.device)
    inputs = [
        10.0, scene.object_mesh_ids, wp.from_torch(object_index), wp.from_torch(x, dtype=wp.vec3),
        wp.from_torch(distance), wp.from_torch(nearest, dtype=wp.vec3),
    ]  # fmt: skip
    launch_trials(reach_kernels.point_to_object, len(x), inputs, device=scene.device, threads=threads, chunk=256)
    away = se3.apply(T_frame_obj, nearest) - point
    outside = (distance > 0)[:, None]
    return nearest, torch.where(outside, away / torch.where(outside[:, 0], distance, 1.0)[:, None], 0.0)


def off_region(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    wanted: Bool[Tensor, " b"],
    *,
    threads: int | None = None,
) -> tuple[Float32[Tensor, "b 3"], Float32[Tensor, "b 3"]]:
    """The object's surface point nearest to the ee origin that is not in the receiver's region, and the way there (ee frame).

    Among the object's 2048 sample points; the way is zero where not wanted, or where all of the object is region.
    """
    points, free = _sample_points(scene)
    x = T_obj_ee[:, :3, 3].clone(memory_format=torch.contiguous_format)
    nearest, found = torch.zeros_like(x), torch.zeros(len(x), dtype=torch.bool, device=x.device)
    inputs = [
        points, free, wp.from_torch(object_index), wp.from_torch(wanted.contiguous()), wp.from_torch(x, dtype=wp.vec3),
        wp.from_torch(found), wp.from_torch(nearest, dtype=wp.vec3),
    ]  # fmt: skip
    launch_trials(kernels.nearest_of_points, len(x), inputs, device=scene.device, threads=threads, chunk=256)
    way = se3.apply(se3.inverse(T_obj_ee), nearest)
    length = (way[:, 0].square() + way[:, 1].square() + way[:, 2].square()).sqrt()[:, None]
    return nearest, torch.where(found[:, None] & (length > 0), way / length.clamp(min=1e-9), 0.0)


@lru_cache(maxsize=4)
def _sample_points(scene: Scene) -> tuple[Any, Any]:
    """Surface points of all objects, and which are not in the receiver's region."""
    points = np.stack([o.points for o in scene.objects]).astype(np.float32)
    free = np.stack([~o.receiver_face[o.point_face] for o in scene.objects])
    return (
        wp.array(points, dtype=wp.vec3, device=scene.device),
        wp.array(free, dtype=wp.bool, device=scene.device),
    )


def hand_contact(
    scene: Scene,
    placed: Placed,
    q: Float32[Tensor, "b 6"],
    body: Int32[Tensor, " b"],
    distance_m: Float32[Tensor, " b"],
    *,
    threads: int | None = None,
) -> tuple[Bool[Tensor, " b"], Float32[Tensor, "b 3"], Float32[Tensor, "b 3"]]:
    """Where robot `body` (-1: none) is nearest to the hand's mesh at posture `q`: found, the hand's point, normal (world).

    `distance_m`: the evaluator's. The normal points from the robot to the hand: that way the distance grows.
    """
    b, device = len(body), body.device
    found = torch.zeros(b, dtype=torch.bool, device=device)
    point, normal = torch.zeros((b, 3), device=device), torch.zeros((b, 3), device=device)
    inputs = [
        scene.world, scene.hand_mesh, placed.bodies, wp.from_torch(q.contiguous()), wp.from_torch(body.contiguous()),
        wp.from_torch(distance_m.contiguous()), wp.from_torch(found), wp.from_torch(point, dtype=wp.vec3),
        wp.from_torch(normal, dtype=wp.vec3),
    ]  # fmt: skip
    launch_trials(posture_kernels.hand_witness, b, inputs, device=scene.device, threads=threads, chunk=64)
    return found, point, normal


def finger_motion(
    scene: Scene,
    part: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    point_ee: Float32[Tensor, "b 3"],
    *,
    threads: int | None = None,
) -> Float32[Tensor, "b 3"]:
    """How points of gripper primitives (-1: none) move per metre of opening, ee frame."""
    velocity = torch.zeros_like(point_ee)
    inputs = [
        scene.grasp_tables.gripper, wp.from_torch(part.contiguous()), wp.from_torch(opening_m.contiguous()),
        wp.from_torch(point_ee.contiguous(), dtype=wp.vec3), wp.from_torch(velocity, dtype=wp.vec3),
    ]  # fmt: skip
    launch_trials(posture_kernels.finger_velocities, len(part), inputs, device=scene.device, threads=threads, chunk=256)
    return velocity


def arm_at(scene: Scene, q: Float32[Tensor, "b 6"], *, threads: int | None = None) -> Arm:
    """The arm's joint axes at a posture, and its damped inverse Jacobian."""
    b, device = len(q), q.device
    axis, origin = torch.zeros((b, 6, 3), device=device), torch.zeros((b, 6, 3), device=device)
    inverse = torch.zeros((b, 6, 6), device=device)
    inputs = [
        wp.float64(DAMPING), *_chain(scene.device), wp.from_torch(q.contiguous()), wp.from_torch(axis, dtype=wp.vec3),
        wp.from_torch(origin, dtype=wp.vec3), wp.from_torch(inverse),
    ]  # fmt: skip
    launch_trials(posture_kernels.arm_jacobian, b, inputs, device=scene.device, threads=threads, chunk=256)
    return Arm(axis, origin, inverse)


@lru_cache(maxsize=4)
def _chain(device: str) -> tuple[Any, Any]:
    """The arm's joint frames at q = 0, the last from wrist_3 to ee, float64."""
    robot = load_robot()
    T = np.stack([*robot.T_parent_joint, robot.T_wrist3_flange @ robot.T_flange_ee])
    R, p = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    return wp.array(R, dtype=wp.mat33d, device=device), wp.array(p, dtype=wp.vec3d, device=device)


def _mat44(T: Tensor) -> Any:
    if len(T) == 0:  # Warp refuses the strides that torch gives some empty tensors
        T = torch.empty((0, 4, 4), dtype=torch.float32, device=T.device)
    return wp.from_torch(T.contiguous(), dtype=wp.mat44)
