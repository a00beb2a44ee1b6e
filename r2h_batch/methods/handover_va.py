"""Handover-VA (Lehotsky et al. 2023): grasp the part that works, present the handle;
docs/baselines.md.

Grasps: the method's own top-down grasps of the functional part (`box_grasps.py`), most summed
finger room first. Poses: ICP of a handle-function template gives the utility axis
(`utility_axis.py`), which points at the palm. Each grasp is tried at five distances in front of the
palm and in seven turns, added up as the original's program adds them; the first pose that the arm
reaches is taken (`gate`). Nothing else is checked, no collision: as published.
"""

import math
from collections.abc import Callable
from itertools import accumulate
from typing import Literal

import torch
from jaxtyping import Bool, Float, Float32, Int32, UInt8
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.judge.grasp import close_pads
from r2h_batch.methods.batches import answers
from r2h_batch.methods.box_grasps import BoxGrasps, box_grasps, depth_steps
from r2h_batch.methods.candidates import candidate_table
from r2h_batch.methods.from_table import best_picked
from r2h_batch.methods.gate import Gate, passing
from r2h_batch.methods.part_roles import FUNCTION, GRASP, WRAP, roles_of
from r2h_batch.methods.placing import (
    approach_frames,
    check_choice,
    first_true,
    least,
    rolled,
    taken,
)
from r2h_batch.methods.predictors import (
    Observations,
    PredictorNoise,
    SeenParts,
    TargetHand,
    predict_parts,
    predict_target,
)
from r2h_batch.methods.utility_axis import LABEL_M, Alignment, align_templates
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Trials

TITLE, STAND_IN = "Handover-VA", "oracle labels"

VOXEL_M, CROP_M = 0.02, 0.10
"""Grid of grasp points, and half side of the box of obstacles about one (published)."""

AZIMUTH_STEP = 0.05 * math.pi
"""Between two top-down orientations (published)."""

DEPTH_LOW_M, DEPTH_HIGH_M, DEPTH_STEP_M = -0.005, 0.05, 0.0025
"""Depths of the TCP below the grasp point (published)."""

ICP_STEPS, ICP_TOLERANCE_M = 100, 1e-5
"""Most steps, and the change of the mean distance that ends them (published)."""

ROTATIONS = 7
"""Turns, 2 pi / 7 apart (published)."""

DISTANCES, DISTANCE_STEP_M = 5, 0.08
"""Places along the line between the two, the nearest to the receiver first (published)."""

CLEARANCE_M = 0.0
"""Distance that gripper and estimated hand must keep with gate `hand`: the text asks for none."""

Loops = Literal["original", "one"]
"""original: grasps by score x five distances x seven turns that add up, about the axis of the
object's class. one: the best grasp, one distance, seven even turns about the handle."""

BodyPoses = Literal["gripper", "object", "handle"]
"""Point that stands on the palm's normal: the gripper's TCP; the aligned template's origin; the
handle's centre (all of the object's, where nothing is a handle)."""


def predict(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
    T_world_obj: Float32[Tensor, "n 4 4"] | None = None,
    loops: Loops = "original",
    at: BodyPoses = "handle",
    gate: Gate = "ik",
    clearance_m: float = CLEARANCE_M,
    voxel_m: float = VOXEL_M,
    crop_m: float = CROP_M,
    azimuth_step: float = AZIMUTH_STEP,
    rotations: int = ROTATIONS,
    distances: int = DISTANCES,
    label_m: float = LABEL_M,
) -> Predictions:
    """One grasp and handover pose a trial.

    Args:
        trials: N trials.
        scene: objects, hands and robot: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: errors of what the method sees; None: `PredictorNoise()`.
        seen: answers of your own networks, in place of the stand-ins.
        T_world_obj: (N, 4, 4) where the objects rest when a trial begins on the table, m; the method then tries the best eight
            grasps that the arm can pick there. None: a trial begins with the object in the gripper.
        loops: what is tried, in which order.
        at: what is put opposite the palm.
        gate: what a pose must pass (`gate.Gate`).
        clearance_m: with gate `hand`: what gripper and estimated hand must keep.
        voxel_m: grid of grasp points.
        crop_m: half side of the box of obstacles about a grasp point.
        azimuth_step: angle between two top-down orientations, rad.
        rotations: turns of the object about its axis.
        distances: places in front of the palm.
        label_m: distance between two labels when templates are aligned.

    Returns:
        `T_obj_ee` (N, 4, 4) and `T_world_ee` (N, 4, 4), m.
    """
    check_choice("loops", loops, Loops)
    check_choice("at", at, BodyPoses)
    depths = depth_steps(DEPTH_LOW_M, DEPTH_HIGH_M, DEPTH_STEP_M)
    table = candidate_table(scene)

    def choose(part: Trials, rows_of: slice) -> tuple[Tensor, Tensor]:
        parts = predict_parts(part, scene, seed=seed, noise=noise, seen=seen)
        target = predict_target(part, scene, seed=seed, noise=noise, seen=seen)
        role = point_roles(scene, part.object_index, parts)
        own = box_grasps(
            scene, part.object_index, role,
            voxel_m=voxel_m, azimuth_step=azimuth_step, depths_m=depths, crop_m=crop_m
        )  # fmt: skip
        rows, exists = table.rows(part.object_index)
        spare = table.T_obj_ee[taken(rows, least(-table.score[rows], exists, exists))]
        grasps, feasible = by_score(own, spare)
        if T_world_obj is not None:
            grasps, feasible = best_picked(scene, part, T_world_obj[rows_of], grasps, feasible)
        axis = align_templates(
            scene, part.object_index, role,
            iterations=ICP_STEPS, tolerance_m=ICP_TOLERANCE_M, label_m=label_m
        )  # fmt: skip
        if loops == "one":
            about_z = torch.zeros(len(part), dtype=torch.bool, device=role.device)
            angles = [2 * math.pi * k / rotations for k in range(rotations)]
            places = in_front_of(target, 1)
            grasps, feasible = grasps[:, :1], feasible[:, :1]
        else:
            about_z = (role == WRAP).any(1)
            angles, places = added_turns(rotations), in_front_of(target, distances)
        R_world_obj = presented(axis.R_obj_template, target.palm_normal, angles, about_z)

        def passes(some: Tensor, grasp: Tensor, T: Tensor) -> tuple[Tensor, Tensor]:
            opening = close_pads(scene.grasp_tables, grasp, part.object_index[some])[1]
            hands = target.vertices[some]
            return passing(
                scene, T, opening[:, None].expand(T.shape[:2]), hands, clearance_m, gate=gate
            )

        return first_passing(passes, R_world_obj, places, axis, at, grasps, feasible)

    return answers(trials, scene, "handover-va", choose)


def added_turns(count: int) -> list[float]:
    """The turns that the original's loop comes by, in its order and each once, rad: it turns on
    from where the last one ended, by 0, 1, 2, ... parts of a whole turn. Of seven it sees 0, 1, 3
    and 6 parts; the rest repeat these."""
    seen = dict.fromkeys(total % count for total in accumulate(range(count)))
    return [2 * math.pi * k / count for k in seen]


def in_front_of(target: TargetHand, count: int) -> Float[Tensor, "b d 3"]:
    """`count` points on each palm's normal, c_h first, each 8 cm farther from the palm than the one
    before (world)."""
    center, normal = target.ball_center.double()[:, None], target.palm_normal.double()[:, None]
    steps = torch.arange(count, dtype=torch.float64, device=normal.device)[:, None]
    return center + DISTANCE_STEP_M * steps * normal


def by_score(
    own: BoxGrasps, spare: Float32[Tensor, "b 4 4"]
) -> tuple[Float32[Tensor, "b s 4 4"], Bool[Tensor, "b s"]]:
    """Each trial's feasible own grasps, best score first, and which of the rows those are; `spare`
    where it has none."""
    score, order = torch.sort(own.score, dim=1, descending=True, stable=True)
    T = own.T_obj_ee.gather(1, order[:, :, None, None].expand(-1, -1, 4, 4))
    feasible = score > 0
    none = ~feasible.any(1)
    T[:, 0] = torch.where(none[:, None, None], spare, T[:, 0])
    feasible[:, 0] |= none
    return T, feasible


def first_passing(
    passes: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    R_world_obj: Float[Tensor, "b r 3 3"],
    places: Float[Tensor, "b d 3"],
    axis: Alignment,
    at: BodyPoses,
    grasps: Float32[Tensor, "b s 4 4"],
    feasible: Bool[Tensor, "b s"],
) -> tuple[Float32[Tensor, "b 4 4"], Float32[Tensor, "b 4 4"]]:
    """Grasp and pose: the first that passes, grasps outermost, then places, then turns; none: the
    first that the arm reaches; none: the first of all.

    Args:
        passes: (rows, their grasps, their poses (n, d r, 4, 4)) -> which poses pass, and which the
            arm reaches.
        R_world_obj: (b, r, 3, 3) how the object is turned.
        places: (b, d, 3) where it is held, m, world frame.
        axis: what was aligned.
        at: what is put there.
        grasps: (b, s, 4, 4) best first.
        feasible: (b, s) which of them are tried.
    """
    d, r = places.shape[1], R_world_obj.shape[1]
    R, place = R_world_obj.repeat(1, d, 1, 1), places.repeat_interleave(r, 1)
    T_obj_ee, T_world_ee = grasps[:, 0].clone(), torch.empty_like(grasps[:, 0])
    todo = torch.arange(len(grasps), dtype=torch.int64, device=grasps.device)
    some_reached = torch.zeros(len(grasps), dtype=torch.bool, device=grasps.device)
    for k in range(grasps.shape[1]):
        todo = todo[feasible[todo, k]]
        if not len(todo):
            break
        grasp = grasps[todo, k]
        T = carried(R[todo], _point(axis, at, grasp, todo), place[todo], grasp)
        passed, reached = passes(todo, grasp, T)
        found, better = passed.any(1), reached.any(1) & ~some_reached[todo]
        some_reached[todo] |= better
        taken_now = found | better | (k == 0)
        rows, chosen = todo[taken_now], first_true(torch.where(found[:, None], passed, reached))
        T_obj_ee[rows] = grasp[taken_now]
        T_world_ee[rows] = T[taken_now, chosen[taken_now]]
        todo = todo[~found]
    return T_obj_ee, T_world_ee


def _point(
    axis: Alignment, at: BodyPoses, T_obj_ee: Float32[Tensor, "b 4 4"], rows: Tensor
) -> Float[Tensor, "b 3"]:
    """The object's point (frame obj) that is put at a place."""
    if at == "gripper":
        return T_obj_ee[:, :3, 3].double()
    return (axis.p_obj_template if at == "object" else axis.handle)[rows].double()


def point_roles(
    scene: Scene, object_index: Int32[Tensor, " b"], seen: SeenParts
) -> UInt8[Tensor, "b p"]:
    """The role of every cloud point: GRASP in the receiver's region as seen (S1), else by its part
    as seen; by its part wherever the benchmark says the parts' roles; what a network says, where it
    says roles itself."""
    if seen.role is not None:
        return seen.role.to(scene.device)
    table = torch.from_numpy(roles_of(scene.objects)).to(scene.device)
    by_region_only = [o.split == "S1" and o.roles is None for o in scene.objects]
    functional = torch.tensor(by_region_only, dtype=torch.bool, device=scene.device)
    functional = functional[object_index.long()]
    by_part = table[object_index.long()[:, None], seen.label.to(scene.device).long()]
    by_region = torch.where(seen.usage.to(scene.device), GRASP, FUNCTION).to(torch.uint8)
    return torch.where(functional[:, None], by_region, by_part)


def presented(
    R_obj_template: Float[Tensor, "b 3 3"],
    palm_normal: Float[Tensor, "b 3"],
    angles: list[float],
    about_z: Bool[Tensor, " b"] | None = None,
) -> Float[Tensor, "b r 3 3"]:
    """R_world_obj with the template's x axis (the handle) along -n_h and its z axis upwards, turned
    by `angles` about x, or about z where `about_z`."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, device=palm_normal.device)
    frame = approach_frames(-palm_normal, up)  # columns: up, across, handle
    R_world_template = torch.stack([frame[..., 2], -frame[..., 1], frame[..., 0]], -1)
    turned = rolled(R_world_template, angles, axis=0)
    if about_z is not None:
        about = rolled(R_world_template, angles, axis=2)
        turned = torch.where(about_z[:, None, None, None], about, turned)
    return se3.matmul(turned, R_obj_template.double().transpose(1, 2)[:, None].expand_as(turned))


def carried(
    R_world_obj: Float[Tensor, "b r 3 3"],
    point_obj: Float[Tensor, "b 3"],
    target: Float[Tensor, "b r 3"],
    T_obj_ee: Float[Tensor, "b 4 4"],
) -> Float[Tensor, "b r 4 4"]:
    """T_world_ee that carries the object turned so, with its point `point_obj` (frame obj) at
    `target` (world)."""
    R = se3.matmul(R_world_obj, T_obj_ee[:, :3, :3].double()[:, None].expand_as(R_world_obj))
    offset = (T_obj_ee[:, :3, 3].double() - point_obj.double())[:, None]
    p = target.double() + se3.rotate(R_world_obj, offset.expand(R_world_obj.shape[:3]))
    return se3.from_rotation(R, p).float()
