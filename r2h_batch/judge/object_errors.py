"""Where methods believe the object to be (`EvalConfig.object_errors`), and the grasp that the gripper takes because of it.

Methods answer in the object's frame as they see it. The gripper goes there; the object lies elsewhere. So the grasp that is
judged is `T_obj_seen T_seen_ee`: `T_seen_ee` is the answer, `T_obj_seen` the seen frame in the true one.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.config import ObjectErrors
from r2h_batch.scene.hand import rotation_from_axis_angle
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.trials.noise import perturbed, trial_ids
from r2h_batch.types import Trials

_POSE, _GROSS = 0, 1  # purposes of the random counters
COMPARED_POINTS = 512
"""Points of the cloud whose turned places are compared in `symmetry_axis` [choice]."""
COMPARED_DEG = (45, 90, 135, 180, 225, 270, 315)
"""Turns after which they are compared [choice]."""


def taken_grasps(
    errors: ObjectErrors,
    objects: Sequence[ObjectModel],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    trials: Trials,
) -> Float32[Tensor, "b 4 4"]:
    """The grasps in the true object's frame that the answers are in the frame that methods see.

    Args:
        errors: sizes and seed; without any the grasps come back as they are.
        objects: `Scene.objects`.
        T_obj_ee: the grasps that were asked for, m.
        trials: B trials.
    """
    if not errors.any:
        return T_obj_ee
    T_obj_seen = seen_frames(errors, objects, trials).to(T_obj_ee.device)
    return se3.matmul(T_obj_seen, T_obj_ee.double()).float()


def seen_frames(
    errors: ObjectErrors, objects: Sequence[ObjectModel], trials: Trials
) -> Float64[Tensor, "b 4 4"]:
    """T_obj_seen: the object's frame as methods see it, in the true one, m; drawn by (seed, trial id). On the CPU.

    A gross error is a turn about an axis of the object's box through its middle. The normal error follows: a turn about
    the same middle, then a shift, both along the object's axes.
    """
    ids, key = trial_ids(trials.trial_id), rng.key_of(f"object errors {errors.seed}")
    row = trials.object_index.cpu().long()
    middle = torch.from_numpy(np.stack([box_middle(o) for o in objects]))[row]
    eye = torch.eye(4, dtype=torch.float32, device="cpu").repeat(len(ids), 1, 1)
    T = perturbed(
        eye, middle.float(), ids, key, purpose=_POSE,
        rotation_deg=errors.rotation_deg, translation_m=errors.translation_m,
    ).double()  # fmt: skip
    if not errors.gross:
        return T
    hit, which, angle = rng.uniforms(key, ids, 3, purpose=_GROSS)
    if errors.gross_turn == "half":
        axis, angle = rng.choice(which, np.full(len(ids), 3)), np.full(len(ids), np.pi)
    else:
        needed = np.unique(row.numpy())
        of_object = np.zeros(len(objects), np.int64)
        of_object[needed] = [symmetry_axis(objects[i]) for i in needed]
        axis, angle = of_object[row.numpy()], 2 * np.pi * angle
    turn = np.where(hit < errors.gross, angle, 0.0)[:, None] * np.eye(3)[axis]
    R = rotation_from_axis_angle(torch.from_numpy(turn))
    return se3.matmul(T, se3.from_rotation(R, middle - se3.rotate(R, middle)))


def box_middle(model: ObjectModel) -> Float64[np.ndarray, " 3"]:
    """The middle of the object's box (axes of its frame), m."""
    hull = model.hull_vertices.astype(np.float64)
    middle: Float64[np.ndarray, " 3"] = 0.5 * (hull.min(0) + hull.max(0))
    return middle


@lru_cache(maxsize=1024)
def symmetry_axis(model: ObjectModel) -> int:
    """The axis (0, 1, 2) of the object's box about which turns change its surface least: the mean distance from a turned
    point to the nearest of the cloud, as in ADD-S (Xiang et al. 2018)."""
    cloud = model.points.astype(np.float64) - box_middle(model)
    # only gross errors of symmetric things need SciPy: a first verdict starts without it
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    tree, some = cKDTree(cloud), cloud[:: max(1, len(cloud) // COMPARED_POINTS)]
    angles = np.radians(COMPARED_DEG)
    turns = [[Rotation.from_rotvec(angle * axis) for angle in angles] for axis in np.eye(3)]
    moved = [np.mean([tree.query(R.apply(some))[0].mean() for R in of_axis]) for of_axis in turns]
    return int(np.argmin(moved))
