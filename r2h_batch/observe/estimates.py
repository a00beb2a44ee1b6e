"""Estimates that a method is told beside images: where the hand is believed to be, and the object, if its model is known."""

import hashlib

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.config import ObjectErrors
from r2h_batch.judge.object_errors import seen_frames
from r2h_batch.observe.seen import Images, KnownObjects, Receiver
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.noise import PredictorNoise, estimated_hand
from r2h_batch.types import Trials


def believed_receiver(scene: Scene, trials: Trials, *, seed: int, noise: float) -> Receiver:
    """The hands as an estimator sees them: the error model of `PredictorNoise` (normal), drawn by (seed, trial).

    Args:
        scene: its hands.
        trials: N trials.
        seed: of the errors.
        noise: factor on their deviations; 0: the truth.
    """
    T = estimated_hand(
        scene,
        trials.trial_id,
        trials.hand_index,
        trials.T_world_hand,
        seed=seed,
        noise=PredictorNoise().scaled(noise),
    )
    palm, normal, _ = scene.palm(trials.hand_index, T)
    rows = trials.hand_index.long()
    along = scene.hands.directions.to(T.device)[rows, :, 0]
    side = scene.hands.set.side.to(T.device)[rows]
    return Receiver(palm, normal, se3.rotate(T[:, :3, :3].double(), along).float(), side > 0)


def believed_objects(
    scene: Scene, trials: Trials, T_world_obj: Float32[Tensor, "n 4 4"], errors: ObjectErrors
) -> KnownObjects:
    """The objects' models, and where an estimator of poses sees them.

    Args:
        scene: its objects.
        trials: N trials.
        T_world_obj: (N, 4, 4) float32, where the objects lie, m.
        errors: sizes and seed.
    """
    T_obj_seen = seen_frames(errors, scene.objects, trials).to(T_world_obj.device)
    rows, mesh = torch.unique(trials.object_index, return_inverse=True)
    models = [scene.objects[i] for i in rows.tolist()]
    return KnownObjects(
        se3.matmul(T_world_obj.double(), T_obj_seen).float(),
        mesh.long(),
        tuple(torch.from_numpy(np.array(m.vertices, np.float32)) for m in models),
        tuple(torch.from_numpy(np.array(m.faces, np.int32)) for m in models),
    )


def image_keys(*windows: Images) -> Int64[Tensor, " n"]:
    """A number of each trial's images: 63 bits of their digest, which says nothing of the trial's own number.

    Args:
        windows: of N trials each.
    """
    arrays = [x.cpu().numpy() for w in windows for x in (w.depth_m, w.label)]
    found = np.empty(len(arrays[0]), np.int64)
    for i in range(len(found)):
        digest = hashlib.blake2b(digest_size=8)
        for array in arrays:
            digest.update(np.ascontiguousarray(array[i]).data)
        found[i] = int.from_bytes(digest.digest(), "little") >> 1
    return torch.from_numpy(found).to(windows[0].depth_m.device)
