"""The object in the closed gripper: which rows are poses at all, what closing does, and where every
body then sits."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, Int8, Int32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.base.launch import over_trials
from r2h_batch.config import EvalConfig
from r2h_batch.judge.grasp import CUT_CAP_M, Grasp, close_pads, open_clearance
from r2h_batch.kernels.judge import rows as row_kernels
from r2h_batch.scene.person import with_person
from r2h_batch.scene.scene import BodyPoses, Scene
from r2h_batch.trials.noise import PredictorNoise, estimated_hand
from r2h_batch.types import Trials

ROWS_CHUNK = 4096
"""Rows a thread takes at a time where a row costs tens of nanoseconds."""


@dataclass(frozen=True)
class AttachedBatch:
    """B trials with the object in the gripper: clean poses, the grasp, and where all bodies sit.

    Rows that are not `active` have the identity for every pose; the stages pass over them.
    """

    active: Bool[Tensor, " b"]
    T_obj_ee: Float32[Tensor, "b 4 4"]  # the grasp before the pads close
    T_world_ee: Float32[Tensor, "b 4 4"]
    T_world_hand: Float32[Tensor, "b 4 4"]
    hands: Int32[Tensor, " b"]
    objects: Int32[Tensor, " b"]
    grasp: Grasp
    margin_kind: Int8[Tensor, " b"]  # MarginKind of the grasp's margin; NONE: the clearance says it
    squeezed_m: Float32[Tensor, " b"]  # opening of the fingers that hold (`judge.grasp.squeezed`)
    attached: Float32[Tensor, "b 4 4"]  # T_obj_ee once the pads have met the object
    ball: Float32[Tensor, "b 3"]  # centre of the receiver's ball in the object's frame
    body_poses: BodyPoses
    # what planning uses: with the estimated hand if plan.hand is "estimated", with arm, torso and
    # head if receiver is "body"
    planner_poses: BodyPoses


def usable_rows(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    T_world_ee: Float32[Tensor, "b 4 4"],
    trials: Trials,
) -> dict[str, Tensor]:
    """Which rows are `active`: all three poses are poses, of an object and a hand of the scene. And these poses and numbers,
    clean, by the names of `row_kernels.usable_rows`; the identity and 0 in rows that are not.

    Args:
        scene: objects and hands.
        T_obj_ee: (B, 4, 4) float32, m.
        T_world_ee: (B, 4, 4) float32, m; or another pose in the world.
        trials: B trials.
    """
    poses = [
        (T.detach() if T.requires_grad else T).contiguous()
        for T in (T_obj_ee, T_world_ee, trials.T_world_hand)
    ]
    # On a CPU objects and hands outside the scene were refused before any work; on CUDA looking at
    # them would have waited.
    found: dict[str, Tensor] = over_trials(
        row_kernels.usable_rows, len(poses[0]), scene.device, chunk=ROWS_CHUNK
    )(
        objects=len(scene.objects),
        hands=len(scene.hands.set),
        T_obj_ee=poses[0],
        T_world_ee=poses[1],
        T_world_hand=poses[2],
        object=trials.object_index.contiguous(),
        hand=trials.hand_index.contiguous(),
    )
    return found


def attach_object(
    scene: Scene,
    T_obj_ee: Float32[Tensor, "b 4 4"],
    T_world_ee: Float32[Tensor, "b 4 4"],
    trials: Trials,
    config: EvalConfig,
) -> AttachedBatch:
    """B trials with the gripper closed on the object; rows with an invalid transform, or an
    unknown object or hand, are not active.

    Args:
        scene: robot, objects and hands.
        T_obj_ee: (B, 4, 4) float32 grasps, m.
        T_world_ee: (B, 4, 4) float32 handover poses, m.
        trials: B trials.
        config: limits, and what the planner sees of the person.
    """
    usable = usable_rows(scene, T_obj_ee, T_world_ee, trials)
    active, objects, hands = (usable[k] for k in ("active", "object", "hand"))
    T_obj_ee, T_world_ee, T_world_hand = (
        usable[k] for k in ("T_obj_ee", "T_world_ee", "T_world_hand")
    )
    limits = config.thresholds
    width, opening, shift, empty = close_pads(
        scene.grasp_tables, T_obj_ee, objects, mode=config.width
    )
    cut, _ = open_clearance(scene.grasp_tables, T_obj_ee, objects, cap_m=CUT_CAP_M)
    point, normal = scene.palms
    made = over_trials(row_kernels.close_rows, len(active), scene.device, chunk=ROWS_CHUNK)(
        w_max=limits.w_max_m,
        w_min=limits.w_min_m,
        pad_squeeze=limits.pad_squeeze_m,
        reach_offset=limits.reach_offset_m,
        palm_point=point,
        palm_normal=normal,
        T_obj_ee=T_obj_ee,
        T_world_ee=T_world_ee,
        T_world_hand=T_world_hand,
        hand=hands,
        width=width,
        opening=opening,
        shift=shift,
        empty=empty,
        cut=cut,
    )
    grasp = Grasp(width, opening, shift, empty, cut, made["margin"])
    attached = made["attached"]
    body_poses = scene.body_poses(objects, hands, attached, T_world_hand, opening)
    planner_poses = body_poses
    if config.plan.hand == "estimated":
        T = _estimated(scene, trials, hands, active, config)
        planner_poses = scene.body_poses(objects, hands, attached, T, opening)
    if config.receiver == "body":
        assert trials.receiver is not None  # `inputs.check_receiver` has asked
        planner_poses = with_person(scene, planner_poses, trials.receiver, hand=True)
    return AttachedBatch(
        active,
        T_obj_ee,
        T_world_ee,
        T_world_hand,
        hands,
        objects,
        grasp,
        made["kind"],
        made["squeezed"],
        attached,
        made["ball"],
        body_poses,
        planner_poses,
    )


def _estimated(
    scene: Scene, trials: Trials, hands: Tensor, active: Tensor, config: EvalConfig
) -> Float32[Tensor, "b 4 4"]:
    """Where the planner sees the hands stand, the identity where a row is not active."""
    estimate = config.estimate
    noise = PredictorNoise(target_errors=estimate.errors).scaled(estimate.factor)
    T_world_hand = trials.T_world_hand.detach()
    T = estimated_hand(scene, trials.trial_id, hands, T_world_hand, seed=estimate.seed, noise=noise)
    eye = torch.eye(4, dtype=T.dtype, device=T.device)
    return se3.orthonormalise(torch.where(active[:, None, None], T, eye)).contiguous()
