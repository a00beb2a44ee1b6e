"""Estimates that a method is told beside images: where the hand is believed to be, the object if its model is known, and which
of its pixels a part labeller puts into the receiver's region."""

import hashlib
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64
from scipy.spatial import cKDTree
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.config import ObjectErrors
from r2h_batch.judge.object_errors import seen_frames
from r2h_batch.observe.seen import LABELS, Images, KnownObjects, Receiver
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.borders import labels_with_borders
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


def told_region(
    scene: Scene,
    trials: Trials,
    images: Images,
    T_world_camera: Float32[Tensor, "c 4 4"],
    T_world_obj: Float32[Tensor, "n 4 4"],
    *,
    seed: int,
    noise: float,
) -> Bool[Tensor, "n c h w"]:
    """Pixels of the object that a part labeller puts into the receiver's region.

    Methods that are told the truth get the same labels of the objects' clouds (`labels_with_borders`: the same draws misplace the
    borders). A pixel has the label of the point of the true cloud nearest to what was measured there. It is False where the mask
    shows no object, and where no depth was measured: nothing else of the object is told.

    Args:
        scene: its objects.
        trials: N trials.
        images: windows about the objects, with the sensor's and the masks' errors.
        T_world_camera: (C, 4, 4) float32, where the cameras stand in truth, m.
        T_world_obj: (N, 4, 4) float32, where the objects lie in truth, m.
        seed: of the borders' errors.
        noise: factor on their deviation.
    """
    border_m = PredictorNoise().scaled(noise).border_m
    label = labels_with_borders(trials, scene.objects, seed=seed, border_m=border_m).numpy()
    shown = (images.label == LABELS.index("object")) & (images.depth_m > 0)
    found = torch.zeros(shown.shape, dtype=torch.bool, device="cpu")
    depth, K = images.depth_m.double().cpu(), images.K.double().cpu()
    T_obj_camera = se3.matmul(
        se3.inverse(T_world_obj.double().cpu())[:, None].expand(*K.shape[:2], 4, 4),
        T_world_camera.double().cpu().expand(*K.shape[:2], 4, 4),
    )
    for i, k in enumerate(trials.object_index.tolist()):
        if not (label[i] % 2).any():
            continue
        for c in range(shown.shape[1]):
            v, u = shown[i, c].cpu().nonzero(as_tuple=True)
            z = depth[i, c, v, u]
            x = (u + 0.5 - K[i, c, 0, 2]) / K[i, c, 0, 0] * z
            y = (v + 0.5 - K[i, c, 1, 2]) / K[i, c, 1, 1] * z
            own = se3.apply(T_obj_camera[i, c][None], torch.stack([x, y, z], 1))
            _, nearest = _tree(scene.objects[k]).query(own.numpy())
            found[i, c, v, u] = torch.from_numpy(label[i][nearest] % 2 == 1)
    return found.to(images.label.device)


@lru_cache(maxsize=1024)
def _tree(model: ObjectModel) -> cKDTree:
    """The points of an object's cloud, for the nearest of them."""
    return cKDTree(model.points.astype(np.float64))


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
