"""Finds the points that decide each margin: one kernel launch per kind of margin, after the
evaluator has judged."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import CLEARANCE_CAP_M, FARTHEST_M, EvalConfig
from r2h_batch.judge.attach import ROWS_CHUNK, AttachedBatch
from r2h_batch.judge.goal import Goal
from r2h_batch.judge.grasp import CUT_CAP_M
from r2h_batch.judge.ik import home_posture
from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.judge import reach as reach_kernels
from r2h_batch.kernels.witness import change as change_kernels
from r2h_batch.kernels.witness import closing as closing_kernels
from r2h_batch.kernels.witness import posture as posture_kernels
from r2h_batch.kernels.witness import surface as kernels
from r2h_batch.scene.robot import Robot
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.types import CRITERIA, PlanReason

HELD_M = 3e-5
"""Fingers that overlap the region by their squeeze, give or take this, hold it."""

DAMPING = 1e-3
"""Damping of the arm's inverse Jacobian (metres and radians alike): postures with smaller singular
values count as stuck there."""

SLACK_M = 3e-5
"""A witness may be this much nearer or farther than the evaluator's number, which is a certified
bound of it."""


@dataclass(frozen=True)
class Witnesses:
    """The points that decide the margins of B poses: outputs of kernels, by their names."""

    decided: dict[str, Tensor]  # which witnesses count
    closing: dict[str, Tensor]  # the pads
    cut: dict[str, Tensor]  # object and open gripper
    region: dict[str, Tensor]  # the receiver's region and the fingers
    free: dict[str, Tensor]  # the nearest surface outside the region
    material: dict[str, Tensor]  # the object's point nearest to the ee origin
    palm: dict[str, Tensor]  # and to the receiver's ball
    hand: dict[str, Tensor]  # the hand's point at the goal
    arm: dict[str, Tensor]  # where Plan's bodies meet
    safe_arm: dict[str, Tensor]  # at the goal


def find(
    scene: Scene, config: EvalConfig, found: dict[str, Tensor], held: AttachedBatch, goal: Goal
) -> Witnesses:
    """The witnesses of B poses.

    Args:
        scene: robot, objects and hands.
        config: limits.
        found: fields of `Scores` of the poses.
        held: B trials.
        goal: their goals.
    """
    b, grasp, limits = len(held.active), held.grasp, config.thresholds
    joints = {"q_plan": goal.q.shape[1], "q_safe": goal.q.shape[1]}
    decided = over_trials(
        change_kernels.decided_by, b, scene.device, sizes=joints, chunk=ROWS_CHUNK
    )(
        open_gap=scene.robot.open_gap_m,
        w_max=limits.w_max_m,
        w_min=limits.w_min_m,
        cut_cap=CUT_CAP_M,
        clearance_cap=CLEARANCE_CAP_M,
        overlap=0.5 * limits.pad_squeeze_m,
        tolerance=HELD_M,
        slack=SLACK_M,
        safe_margin=limits.safe_margin_m,
        **{name: CRITERIA.index(name) for name in ("stability", "affordance", "safe")},
        unreachable=int(PlanReason.IK_UNREACHABLE),
        not_found=int(PlanReason.IK_NOT_FOUND),
        start=int(PlanReason.START_IN_COLLISION),
        home=_home(scene),
        active=held.active,
        margin=found["margin"],
        evaluated=found["evaluated"],
        cut=grasp.cut_m,
        width=grasp.width_m,
        empty=grasp.empty,
        T_obj_ee=held.T_obj_ee,
        reason=goal.reason,
        part=found["witness_part"],
        q=goal.q,
    )
    objects, x = held.objects, decided["ee_origin"]
    return Witnesses(
        decided,
        closing(scene, held.T_obj_ee, objects, grasp.width_m, grasp.opening_m),
        fingers(
            scene, held.T_obj_ee, objects, decided["opened"], decided["cut_bound"], region=False
        ),
        fingers(
            scene, held.attached, objects, held.squeezed_m, decided["region_bound"], region=True
        ),
        _off_region(scene, x, objects, decided["holds_region"]),
        _nearest_to_point(scene, x, objects, scene.grasp_tables.surfaces, scene.object_mesh_ids),
        _nearest_to_point(scene, held.ball, objects, scene.reach_surfaces, scene.reach_mesh_ids),
        _hand_contact(
            scene, held.body_poses, goal.q, decided["safe_body"], decided["safe_distance"]
        ),
        arm_at(scene, decided["q_plan"]),
        arm_at(scene, decided["q_safe"]),
    )


def closing(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    width_m: Float32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
) -> dict[str, Tensor]:
    """Points that the pads met, where the evaluator found them (width NaN: nothing); `T_obj_ee`
    before the object moved."""
    kernel, b = closing_kernels.closing_witness, len(T_obj_ee)
    tables, sizes = scene.grasp_tables, {"point": 4, "slope_x": 4, "slope_z": 4}
    made: dict[str, Tensor] = over_trials(kernel, b, scene.device, sizes=sizes)(
        gripper=tables.gripper,
        surfaces=tables.surfaces,
        open_gap=scene.robot.open_gap_m,
        whole=int(scene.config.width == "whole"),
        T_obj_ee=T_obj_ee.contiguous(),
        object_index=object_index.contiguous(),
        width=width_m.contiguous(),
        opening=opening_m.contiguous(),
    )
    return made


def fingers(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    object_index: Int32[Tensor, " b"],
    opening_m: Float32[Tensor, " b"],
    bound_m: Float32[Tensor, " b"],
    *,
    region: bool,
) -> dict[str, Tensor]:
    """The point of the object (or of its receiver's region) nearest to or deepest in the gripper,
    nearer than `bound_m` (-inf: none).

    The fingers count for the region, the whole gripper for the object.
    """
    tables = scene.grasp_tables
    made: dict[str, Tensor] = over_trials(kernels.surface_witness, len(T_obj_ee), scene.device)(
        gripper=tables.gripper,
        surfaces=tables.surfaces,
        surface_offset=tables.objects if region else 0,
        used=tables.moving if region else tables.every,
        T_obj_ee=T_obj_ee.contiguous(),
        object_index=object_index,
        opening=opening_m.contiguous(),
        bound=bound_m,
    )
    return made


def _nearest_to_point(
    scene: Scene,
    x: Float32[Tensor, "b 3"],
    object_index: Int32[Tensor, " b"],
    surfaces: Surfaces,
    meshes: wp.array,
) -> dict[str, Tensor]:
    """The point of the object's surface nearest to x (object frame), and its distance, 0 inside."""
    made: dict[str, Tensor] = over_trials(
        reach_kernels.point_to_object, len(x), scene.device, chunk=256
    )(
        cap=FARTHEST_M,
        surfaces=surfaces,
        mesh=meshes,
        object=object_index,
        point=x,
    )
    return made


def _off_region(
    scene: Scene,
    x: Float32[Tensor, "b 3"],
    object_index: Int32[Tensor, " b"],
    wanted: Bool[Tensor, " b"],
) -> dict[str, Tensor]:
    """The object's surface point nearest to x (object frame) that is not in the receiver's region,
    among its 2048 sample points. Not found where not wanted, or where all of the object is region."""
    points, free = _sample_points(scene)
    made: dict[str, Tensor] = over_trials(
        kernels.nearest_of_points, len(x), scene.device, chunk=256
    )(point=points, counts=free, object_index=object_index, wanted=wanted, x=x)
    return made


@lru_cache(maxsize=4)
def _sample_points(scene: Scene) -> tuple[Any, Any]:
    """Surface points of all objects, and which are not in the receiver's region."""
    points = np.stack([o.points for o in scene.objects]).astype(np.float32)
    free = np.stack([~o.receiver_face[o.point_face] for o in scene.objects])
    return (
        wp.array(points, dtype=wp.vec3, device=scene.device),
        wp.array(free, dtype=wp.bool, device=scene.device),
    )


def _hand_contact(
    scene: Scene,
    body_poses: BodyPoses,
    q: Float32[Tensor, "b j"],
    body: Int32[Tensor, " b"],
    distance_m: Float32[Tensor, " b"],
) -> dict[str, Tensor]:
    """Where robot `body` (-1: none) is nearest to the hand's mesh at posture `q`: found, the hand's
    point, normal (world).

    `distance_m`: the evaluator's. The normal points from the robot to the hand: that way the
    distance grows.
    """
    kernel = scene.sized(posture_kernels.hand_witness)
    made: dict[str, Tensor] = over_trials(kernel, len(body), scene.device, chunk=64)(
        world=scene.world,
        mesh=scene.hand_mesh,
        bodies=body_poses.bodies,
        q=q,
        body=body,
        distance=distance_m,
    )
    return made


def arm_at(scene: Scene, q: Float32[Tensor, "b j"]) -> dict[str, Tensor]:
    """The arm's joint axes and points on them at a posture (world frame), its ee pose, and the joint
    rates per motion of the ee frame: its damped inverse Jacobian, of a redundant arm the
    pseudo-inverse, with joints held that stand at a limit."""
    joints = q.shape[1]
    joint_R, joint_p = _chain(scene.robot, scene.device)
    sizes: dict[str, Any] = {"axis": joints, "origin": joints, "inverse": (joints, 6)}
    made: dict[str, Tensor] = over_trials(
        scene.sized(posture_kernels.arm_jacobian), len(q), scene.device, sizes=sizes, chunk=256
    )(
        damping=DAMPING,
        joint_R=joint_R,
        joint_p=joint_p,
        lower=scene.world.lower,
        upper=scene.world.upper,
        q=q.contiguous(),
    )
    return made


@lru_cache(maxsize=4)
def _home(scene: Scene) -> Float32[Tensor, " j"]:
    """Home's joint angles: the same tensor at each call."""
    return home_posture(scene.device, scene.config.workplace.home_q)[0]


@lru_cache(maxsize=4)
def _chain(robot: Robot, device: str) -> tuple[Any, Any]:
    """The arm's joint frames at q = 0, the last from the last link to ee, float64."""
    T = np.stack([*robot.T_parent_joint, robot.T_wrist3_flange @ robot.T_flange_ee])
    R, p = np.ascontiguousarray(T[:, :3, :3]), np.ascontiguousarray(T[:, :3, 3])
    return wp.array(R, dtype=wp.mat33d, device=device), wp.array(p, dtype=wp.vec3d, device=device)
