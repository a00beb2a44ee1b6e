"""Presented: does the receiver's region face the palm, and lie where the hand reaches? No part of
the verdict."""

from dataclasses import dataclass

from jaxtyping import Bool, Float32
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import FARTHEST_M, Thresholds
from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.kernels.judge import presented as kernels
from r2h_batch.scene.scene import Scene

FACING_DEG = 90.0
"""The region faces the palm up to this angle: its centre is on the palm's side of the grasp."""


@dataclass(frozen=True)
class Presented:
    """How the region is presented in B trials; NaN and False where the object has no region or the
    row is not judged."""

    angle_deg: Float32[Tensor, " b"]
    """at the TCP, between the directions to the region's centre and to the palm's"""
    distance_m: Float32[Tensor, " b"]
    """from the ball's centre c_h to the region's nearest point"""
    presented: Bool[Tensor, " b"]


def presented(
    scene: Scene,
    held: AttachedBatch,
    thresholds: Thresholds,
) -> Presented:
    """Where each trial's receiver's region is when the object is handed over: facing, and within
    the ball's radius of c_h.

    Args:
        scene: with regions and palms.
        held: B trials with the object in the gripper.
        thresholds: with `reach_radius_m`.
    """
    regions = scene.regions
    point, _ = scene.palms
    made = over_trials(kernels.region_presented, len(held.active), scene.device, chunk=64)(
        cap=FARTHEST_M,
        facing_deg=FACING_DEG,
        reach_radius=thresholds.reach_radius_m,
        surfaces=regions.surfaces,
        region_offset=regions.offset,
        mesh=regions.mesh_ids,
        center=regions.centers,
        palm_point=point,
        active=held.active,
        object=held.objects,
        hand=held.hands,
        attached=held.attached,
        T_world_ee=held.T_world_ee,
        T_world_hand=held.T_world_hand,
        ball=held.ball,
    )
    return Presented(made["angle"], made["distance"], made["presented"])
