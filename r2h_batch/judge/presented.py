"""Presented: does the wanted part come to the hand first, before gripper and sharp parts? And Upright: does a vessel stand?

The wanted part is the receiver's region in S1, the object in S0. With c_h the middle of the receiver's ball and p_h the palm,

    margin = min(r_h - dist(c_h, wanted), t + min(dist(p_h, gripper), dist(p_h, sharp)) - dist(p_h, wanted))

A criterion where a benchmark asks for it, and a column everywhere.
"""

from dataclasses import dataclass

from jaxtyping import Float32, Int8
from torch import Tensor

from r2h_batch.base.launch import over_trials
from r2h_batch.config import FARTHEST_M, PRESENTED_M, Thresholds
from r2h_batch.judge.attach import AttachedBatch
from r2h_batch.judge.reach import Reached
from r2h_batch.kernels.judge import presented as kernels
from r2h_batch.scene.scene import Scene
from r2h_batch.verdicts import Nearer


@dataclass(frozen=True)
class Presented:
    """How the object is presented in B trials."""

    margin_m: Float32[Tensor, " b"]
    """NaN in rows that are not judged"""
    by: Int8[Tensor, " b"]
    """`Nearer`: what the margin is about; -1 in these rows"""
    tilt_deg: Float32[Tensor, " b"]
    """of a vessel: between its opening and the world's up; NaN of other objects"""

    @property
    def fields(self) -> dict[str, Tensor]:
        """Those of `Scores` that it is."""
        return {
            "presented_margin_m": self.margin_m,
            "presented_by": self.by,
            "tilt_deg": self.tilt_deg,
        }


def presented(
    scene: Scene,
    held: AttachedBatch,
    reach: Reached,
    thresholds: Thresholds,
) -> Presented:
    """What comes to the hand first in each trial, and how vessels stand.

    Args:
        scene: with surfaces, regions, sharp parts and palms.
        held: B trials with the object in the gripper.
        reach: where the solids are nearest to the balls' middles.
        thresholds: with `reach_radius_m`.
    """
    regions, sharp, bodies = scene.regions, scene.sharp, held.body_poses
    point, _ = scene.palms
    made = over_trials(kernels.present, len(held.active), scene.device, chunk=64)(
        cap=FARTHEST_M,
        reach_radius=thresholds.reach_radius_m,
        nearer_free=PRESENTED_M["S0"],
        nearer_region=PRESENTED_M["S1"],
        surfaces=scene.grasp_tables.surfaces,
        mesh=scene.object_mesh_ids,
        regions=regions.surfaces,
        region_offset=regions.offset,
        region_mesh=regions.mesh_ids,
        sharp=sharp.surfaces,
        sharp_mesh=sharp.mesh_ids,
        up=scene.openings,
        gripper=scene.grasp_tables.gripper,
        palm_point=point,
        active=held.active,
        object=held.objects,
        hand=held.hands,
        attached=held.attached,
        T_world_ee=held.T_world_ee,
        T_world_hand=held.T_world_hand,
        R_wrist_grip=bodies.R_wrist_grip,
        p_wrist_grip=bodies.p_wrist_grip,
        R_wrist_obj=bodies.R_wrist_obj,
        p_wrist_obj=bodies.p_wrist_obj,
        ball=held.ball,
        reach=reach.distance_m,
        nearest=reach.nearest,
    )
    return Presented(made["margin"], made["by"], made["tilt"])


if [n.value for n in Nearer] != [kernels.BY_BALL, kernels.BY_GRIPPER, kernels.BY_SHARP]:
    raise ValueError("verdicts.Nearer has the codes of kernels/judge/presented.py")
