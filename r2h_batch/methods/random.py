"""The lower bound: a random candidate, the TCP anywhere near the palm's ball, any orientation
(spec: baselines.md)."""

import numpy as np
import torch
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.methods.candidates import candidates_in, check_candidates, stacked
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Trials

BALL_M = 0.20
"""Radius of the ball around c_h that holds the TCP."""

_CANDIDATE, _POSE = 0, 1  # purposes of the random counters


def predict(trials: Trials, scene: Scene, *, seed: int = 0) -> Predictions:
    """A random grasp candidate, and a TCP pose uniform in a ball about c_h and in orientation.

    Args:
        trials: N trials.
        scene: objects, hands and robot: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.

    Returns:
        `T_obj_ee` (N, 4, 4) and `T_world_ee` (N, 4, 4), m.
    """
    check_candidates(scene, trials.object_index)
    key = rng.key_of(f"random {seed}")
    ids = trials.trial_id.cpu().numpy()
    object_index = trials.object_index.cpu().numpy().astype(np.int64)
    grasps, first, count = stacked(candidates_in(scene))
    (u,) = rng.uniforms(key, ids, 1, purpose=_CANDIDATE)
    T_obj_ee = grasps[first[object_index] + rng.choice(u, count[object_index])]

    def propose(
        rows: NDArray[np.int64], attempt: int
    ) -> tuple[NDArray[np.bool_], tuple[NDArray[np.float64], ...]]:
        u = rng.uniforms(key, ids[rows], 7, purpose=_POSE, attempt=attempt)
        x, y, z = 2.0 * u[:3] - 1.0
        turned, R = rng.rotation(u[3:])
        fits = turned & (x * x + y * y + z * z <= 1.0)
        return fits, (R[fits], BALL_M * np.stack([x, y, z], 1)[fits])

    R, offset = np.zeros((len(ids), 3, 3)), np.zeros((len(ids), 3))
    rng.accepted(len(ids), propose, R, offset)
    _, _, center = scene.palm(trials.hand_index, trials.T_world_hand)
    T_world_ee = np.zeros((len(ids), 4, 4))
    T_world_ee[:, :3, :3] = R
    T_world_ee[:, :3, 3] = center.cpu().numpy().astype(np.float64) + offset
    T_world_ee[:, 3, 3] = 1.0
    device = trials.trial_id.device
    return Predictions(
        trial_id=trials.trial_id,
        T_obj_ee=torch.from_numpy(T_obj_ee).to(device),
        T_world_ee=torch.from_numpy(T_world_ee.astype(np.float32)).to(device),
        method="random",
    )
