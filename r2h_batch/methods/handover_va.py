"""Handover-VA (Lehotsky et al. 2023): grasp the part that works, present the handle; docs/baselines.md.

Grasp: the method's own top-down grasps of the functional part (`box_grasps.py`), the one with most summed finger room.
Pose: ICP of a handle-function template gives the utility axis (`utility_axis.py`); the handle points at the palm, its
centre at the ball centre c_h, the gripper behind it opposite the palm. Seven rotations about that axis, the first that
the arm reaches. Nothing else is checked, no collision: as published.
"""

import math

import torch
from jaxtyping import Float, Int32, UInt8
from torch import Tensor

from r2h_batch import se3
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods.batches import answers
from r2h_batch.methods.box_grasps import box_grasps, depth_steps
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.palm_pose import approach_frames, least, rolled
from r2h_batch.methods.part_roles import FUNCTION, GRASP, roles_of
from r2h_batch.methods.placing import first_fit, taken
from r2h_batch.methods.utility_axis import LABEL_M, align_templates
from r2h_batch.predictors import PredictorNoise, Seen, SeenParts, predict_parts, predict_target
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Trials

__all__ = ["predict"]

TITLE, STAND_IN = "Handover-VA", "oracle labels"
SEES = ("parts", "target")
"""What it is shown, of `predictors.Seen`."""

VOXEL_M, CROP_M = 0.02, 0.10
"""Grid of grasp points, and half side of the box of obstacles about one (published)."""

AZIMUTH_STEP = 0.05 * math.pi
"""Between two top-down orientations (published)."""

DEPTH_LOW_M, DEPTH_HIGH_M, DEPTH_STEP_M = -0.005, 0.05, 0.0025
"""Depths of the TCP below the grasp point (published)."""

ICP_STEPS, ICP_TOLERANCE_M = 100, 1e-5
"""At most so many steps, and the change of the mean distance that ends them (published)."""

ROTATIONS = 7
"""Turns about the handover axis, 2 pi / 7 apart (published)."""


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    evaluator: Evaluator | None = None,
    noise: PredictorNoise | None = None,
    seen: Seen | None = None,
    voxel_m: float = VOXEL_M,
    crop_m: float = CROP_M,
    azimuth_step: float = AZIMUTH_STEP,
    rotations: int = ROTATIONS,
    label_m: float = LABEL_M,
) -> Predictions:
    """One grasp and handover pose a trial; labels and target hand predicted with `noise`, drawn by (seed, trial id)."""
    threads = evaluator.threads if evaluator else None
    depths = depth_steps(DEPTH_LOW_M, DEPTH_HIGH_M, DEPTH_STEP_M)
    angles = [2 * math.pi * k / rotations for k in range(rotations)]
    table = candidate_table(scene)
    opening = torch.zeros(1, dtype=torch.float32, device=scene.device)  # collisions are not checked

    def choose(part: Trials, _: slice) -> tuple[Tensor, Tensor]:
        parts = predict_parts(part, scene, seed=seed, noise=noise, seen=seen)
        target = predict_target(part, scene, seed=seed, noise=noise, seen=seen)
        role = point_roles(scene, part.object_index, parts)
        own = box_grasps(
            scene, part.object_index, role,
            voxel_m=voxel_m, azimuth_step=azimuth_step, depths_m=depths, crop_m=crop_m, threads=threads,
        )  # fmt: skip
        best = least(-own.score, own.score > 0, torch.ones_like(own.used))
        T_obj_ee = own.T_obj_ee[torch.arange(len(part), dtype=torch.int64, device=best.device), best]
        rows, exists = table.rows(part.object_index)
        spare = table.T_obj_ee[taken(rows, least(-table.score[rows], exists, exists))]
        T_obj_ee = torch.where((own.score > 0).any(1)[:, None, None], T_obj_ee, spare)
        axis = align_templates(
            scene, part.object_index, role,
            iterations=ICP_STEPS, tolerance_m=ICP_TOLERANCE_M, label_m=label_m, threads=threads,
        )  # fmt: skip
        R_world_obj = presented(axis.R_obj_template, target.palm_normal, angles)
        T_world_ee = carried(R_world_obj, axis.handle, target.ball_center, T_obj_ee)
        return T_obj_ee, first_fit(scene, T_world_ee, opening.expand(len(part)), None, threads=threads)

    return answers(trials, scene, "handover-va", choose)


def point_roles(scene: Scene, object_index: Int32[Tensor, " b"], seen: SeenParts) -> UInt8[Tensor, "b p"]:
    """The role of every cloud point: GRASP in the receiver's region as seen (S1), else by its part as seen; by its part
    wherever the benchmark says the parts' roles; what a network says, where it says roles itself."""
    if seen.role is not None:
        return seen.role.to(scene.device)
    table = torch.from_numpy(roles_of(scene.objects)).to(scene.device)
    functional = torch.tensor(
        [o.split == "S1" and o.roles is None for o in scene.objects], dtype=torch.bool, device=scene.device
    )[object_index.long()]
    by_part = table[object_index.long()[:, None], seen.label.to(scene.device).long()]
    by_region = torch.where(seen.usage.to(scene.device), GRASP, FUNCTION).to(torch.uint8)
    return torch.where(functional[:, None], by_region, by_part)


def presented(
    R_obj_template: Float[Tensor, "b 3 3"], palm_normal: Float[Tensor, "b 3"], angles: list[float]
) -> Float[Tensor, "b r 3 3"]:
    """R_world_obj with the template's x axis (the handle) along -n_h, its z axis upwards, turned about x by `angles`."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=palm_normal.device)
    frame = approach_frames(-palm_normal, up)  # columns: up, across, handle
    R_world_template = torch.stack([frame[..., 2], -frame[..., 1], frame[..., 0]], -1)
    turned = rolled(R_world_template, angles, axis=0)
    back = R_obj_template.double().transpose(1, 2)[:, None]
    return torch.stack([se3.rotate(turned, back[..., k].expand(turned.shape[:3])) for k in range(3)], -1)


def carried(
    R_world_obj: Float[Tensor, "b r 3 3"],
    point_obj: Float[Tensor, "b 3"],
    target: Float[Tensor, "b 3"],
    T_obj_ee: Float[Tensor, "b 4 4"],
) -> Float[Tensor, "b r 4 4"]:
    """T_world_ee that carries the object turned so, with its point `point_obj` (frame obj) at `target` (world)."""
    R_obj_ee = T_obj_ee[:, :3, :3].double()[:, None]
    R = torch.stack([se3.rotate(R_world_obj, R_obj_ee[..., k].expand(R_world_obj.shape[:3])) for k in range(3)], -1)
    offset = (T_obj_ee[:, :3, 3].double() - point_obj.double())[:, None]
    p = target.double()[:, None] + se3.rotate(R_world_obj, offset.expand(R_world_obj.shape[:3]))
    T = torch.zeros((*R.shape[:2], 4, 4), dtype=torch.float32, device=R.device)
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R.float(), p.float(), 1.0
    return T
