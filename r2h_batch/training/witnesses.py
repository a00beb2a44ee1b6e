"""Finds the points that decide each margin: one kernel launch per kind of margin, after the
evaluator has judged."""

from functools import lru_cache
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.config import FARTHEST_M
from r2h_batch.kernels.judge import reach as reach_kernels
from r2h_batch.kernels.witness import closing as closing_kernels
from r2h_batch.kernels.witness import posture as posture_kernels
from r2h_batch.kernels.witness import surface as kernels
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.training.first_order import Arm, Closing, Contact

DAMPING = 1e-3
"""Damping of the arm's inverse Jacobian (metres and radians alike): postures with smaller singular
values count as stuck there."""

SLACK_M = 3e-5
"""A witness may be this much nearer or farther than the evaluator's number, which is a certified
bound of it."""


def closing(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    width_m: Float32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
) -> Closing:
    """Points that the pads met, where the evaluator found them (width NaN: nothing); `T_obj_ee`
    before the object moved."""
    kernel, b = closing_kernels.closing_witness, len(T_obj_ee)
    tables, sizes = scene.grasp_tables, {"point": 4, "slope_x": 4, "slope_z": 4}
    made = over_trials(kernel, b, scene.device, sizes=sizes)(
        gripper=tables.gripper,
        surfaces=tables.surfaces,
        open_gap=scene.robot.open_gap_m,
        whole=int(scene.config.width == "whole"),
        T_obj_ee=T_obj_ee.contiguous(),
        object_index=object_index.contiguous(),
        width=width_m.contiguous(),
        opening=opening_m.contiguous(),
    )
    return Closing(
        T_obj_ee=T_obj_ee,
        point_obj=made.pop("point"),
        centred=(made["state"] > 0) & (width_m <= scene.robot.open_gap_m),
        **made,
    )


def fingers(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    distance_m: Float32[Tensor, " b"],
    wanted: Bool[Tensor, " b"],
    *,
    region: bool,
) -> Contact:
    """The point of the object (or of its receiver's region) nearest to or deepest in the gripper,
    where `wanted`.

    `distance_m`: the evaluator's distance. The fingers count for the region, the whole gripper for
    the object.
    """
    b, tables = len(T_obj_ee), scene.grasp_tables
    made = over_trials(kernels.surface_witness, b, scene.device)(
        gripper=tables.gripper,
        surfaces=tables.surfaces,
        surface_offset=tables.objects if region else 0,
        used=tables.moving if region else tables.every,
        T_obj_ee=T_obj_ee.contiguous(),
        object_index=object_index,
        opening=opening_m.contiguous(),
        bound=torch.where(wanted, distance_m + SLACK_M, -torch.inf),
    )
    return Contact(made["point"], made["normal"], made["finger"], made["part"] >= 0)


def nearest_to_point(
    scene: Scene,
    T_frame_obj: Float32[Tensor, "b 4 4"],
    point: Float32[Tensor, "b 3"],
    object_index: Int32[Tensor, " b"],
    meshes: wp.array,
) -> tuple[Float32[Tensor, "b 3"], Float32[Tensor, "b 3"]]:
    """The point of the object's mesh nearest to `point` of some frame (object frame), and the way there (that
    frame; zero inside)."""
    x = se3.apply(se3.inverse(T_frame_obj), point).contiguous()
    made = over_trials(reach_kernels.point_to_object, len(x), scene.device, chunk=256)(
        cap=FARTHEST_M,
        mesh=meshes,
        low=scene.grasp_tables.surfaces.low,
        high=scene.grasp_tables.surfaces.high,
        object=object_index,
        point=x,
    )
    distance, nearest = made["distance"], made["nearest"]
    away = se3.apply(T_frame_obj, nearest) - point
    outside = (distance > 0)[:, None]
    return nearest, torch.where(
        outside, away / torch.where(outside[:, 0], distance, 1.0)[:, None], 0.0
    )


def off_region(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    wanted: Bool[Tensor, " b"],
) -> tuple[Float32[Tensor, "b 3"], Float32[Tensor, "b 3"]]:
    """The object's surface point nearest to the ee origin that is not in the receiver's region, and
    the way there (ee frame).

    Among the object's 2048 sample points; the way is zero where not wanted, or where all of the
    object is region.
    """
    points, free = _sample_points(scene)
    x = T_obj_ee[:, :3, 3].clone(memory_format=torch.contiguous_format)
    made = over_trials(kernels.nearest_of_points, len(x), scene.device, chunk=256)(
        point=points, counts=free, object_index=object_index, wanted=wanted.contiguous(), x=x
    )
    nearest, found = made["nearest"], made["found"]
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
    body_poses: BodyPoses,
    q: Float32[Tensor, "b j"],
    body: Int32[Tensor, " b"],
    distance_m: Float32[Tensor, " b"],
) -> tuple[Bool[Tensor, " b"], Float32[Tensor, "b 3"], Float32[Tensor, "b 3"]]:
    """Where robot `body` (-1: none) is nearest to the hand's mesh at posture `q`: found, the hand's
    point, normal (world).

    `distance_m`: the evaluator's. The normal points from the robot to the hand: that way the
    distance grows.
    """
    kernel = scene.sized(posture_kernels.hand_witness)
    made = over_trials(kernel, len(body), scene.device, chunk=64)(
        world=scene.world,
        mesh=scene.hand_mesh,
        bodies=body_poses.bodies,
        q=q.contiguous(),
        body=body.contiguous(),
        distance=distance_m.contiguous(),
    )
    return made["found"], made["point"], made["normal"]


def finger_motion(
    scene: Scene,
    part: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    point_ee: Float32[Tensor, "b 3"],
) -> Float32[Tensor, "b 3"]:
    """How points of gripper primitives (-1: none) move per metre of opening, ee frame."""
    made = over_trials(posture_kernels.finger_velocities, len(part), scene.device, chunk=256)(
        gripper=scene.grasp_tables.gripper,
        part=part.contiguous(),
        opening=opening_m.contiguous(),
        point=point_ee.contiguous(),
    )
    return made["velocity"]


def arm_at(
    scene: Scene,
    q: Float32[Tensor, "b j"],
) -> Arm:
    """The arm's joint axes at a posture, and its damped inverse Jacobian: of a redundant arm the
    pseudo-inverse, with joints held that stand at a limit."""
    joints = q.shape[1]
    joint_R, joint_p = _chain(scene.robot, scene.device)
    sizes: dict[str, Any] = {"axis": joints, "origin": joints, "inverse": (joints, 6)}
    made = over_trials(
        scene.sized(posture_kernels.arm_jacobian), len(q), scene.device, sizes=sizes, chunk=256
    )(
        damping=DAMPING,
        joint_R=joint_R,
        joint_p=joint_p,
        lower=scene.world.lower,
        upper=scene.world.upper,
        q=q.contiguous(),
    )
    return Arm(made["axis"], made["origin"], made["inverse"], made["ee"])


@lru_cache(maxsize=4)
def _chain(robot: Robot, device: str) -> tuple[Any, Any]:
    """The arm's joint frames at q = 0, the last from the last link to ee, float64."""
    T = np.stack([*robot.T_parent_joint, robot.T_wrist3_flange @ robot.T_flange_ee])
    R, p = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    return wp.array(R, dtype=wp.mat33d, device=device), wp.array(p, dtype=wp.vec3d, device=device)
