"""How far the executed handover is off what the method asked for (`EvalConfig.execution_error`, `EvalConfig.object_errors`)."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.config import EvalConfig
from r2h_batch.judge.object_errors import taken_grasps
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.trials.noise import perturbed, trial_ids
from r2h_batch.types import Trials

_CAMERA, _OBJECT = 0, 1  # purposes of the random counters


def executed_poses(
    config: EvalConfig,
    objects: Sequence[ObjectModel],
    T_obj_ee: Float32[Tensor, "b 4 4"],
    T_world_ee: Float32[Tensor, "b 4 4"],
    trials: Trials,
) -> tuple[Float32[Tensor, "b 4 4"], Float32[Tensor, "b 4 4"]]:
    """The grasp and the handover pose that a robot with these errors carries out.

    The grasp is first taken as it is in the true object's frame (`object_errors.taken_grasps`). Then the execution errs.
    The camera's error turns and shifts the handover pose about the origin of the trial's hand, along
    the world's axes. The object's turns and shifts the gripper about the TCP, in ee. Each is drawn
    by trial id, so that all methods and all candidates of a trial meet the same.

    Args:
        config: its `object_errors` and `execution_error`; without any the poses come back as they are.
        objects: `Scene.objects`.
        T_obj_ee: the grasp that was asked for, m.
        T_world_ee: the handover pose that was asked for, m.
        trials: B trials.
    """
    error = config.execution_error
    T_obj_ee = taken_grasps(config.object_errors, objects, T_obj_ee, trials)
    if not error.any:
        return T_obj_ee, T_world_ee
    ids, key = trial_ids(trials.trial_id), rng.key_of(f"execution error {error.seed}")
    hand = se3.translation(trials.T_world_hand[:, :3, 3])
    T_world_ee = se3.matmul(
        perturbed(
            hand,
            torch.zeros_like(hand[:, :3, 3]),
            np.zeros_like(ids) if error.camera_drawn == "run" else ids,
            key,
            purpose=_CAMERA,
            rotation_deg=error.camera_deg,
            translation_m=error.camera_m,
        ),
        se3.matmul(se3.inverse(hand), T_world_ee),
    )
    T_obj_ee = perturbed(
        T_obj_ee,
        torch.zeros_like(T_obj_ee[:, :3, 3]),
        ids,
        key,
        purpose=_OBJECT,
        rotation_deg=error.object_deg,
        translation_m=error.object_m,
    )
    return T_obj_ee, T_world_ee
