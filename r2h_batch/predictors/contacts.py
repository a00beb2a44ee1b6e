"""Where a person would touch an object: a network's probability on its voxel grid, read at the cloud's points.

A contact predictor is a callable: grid (K, 5, 64, 64, 64) float32 in, contact probability (K, 64, 64, 64) in [0, 1] out.
The grid's axes are the object's x, y, z; its channels are occupancy, the voxel centre's x, y, z in the box of the grid
from -1 to 1, and the object's scale (half the grid's side, in metres) in every voxel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch.objects import VOXELS, ObjectModel
from r2h_batch.scene import Scene
from r2h_batch.types import Trials

__all__ = ["CHANNELS", "CONTACT_THRESHOLD", "ContactPredictor", "contact_grids", "predict_contacts", "voxel_of_points"]

ContactPredictor = Callable[[Tensor], Tensor]
CHANNELS = 5
CONTACT_THRESHOLD = 0.4
"""Probability from which a point counts as touched (Contact-Handover)."""

_cached: dict[tuple[Any, ...], Tensor] = {}


def predict_contacts(
    trials: Trials, scene: Scene, *, predictor: ContactPredictor | None = None
) -> Float32[Tensor, "n p"]:
    """Probability that a person touches each cloud point (`ObjectModel.points`); default: the built-in VoxNet.

    The network runs once for each object and predictor; trials only look up.
    """
    if predictor is None:
        from r2h_batch.predictors.voxnet import load_voxnet

        predictor = load_voxnet()
    device = trials.trial_id.device
    return _of_objects(scene.objects, predictor).to(device)[trials.object_index.long()]


def contact_grids(objects: Sequence[ObjectModel]) -> Float32[Tensor, "o 5 64 64 64"]:
    """The network's input for each object."""
    axis = (torch.arange(VOXELS, dtype=torch.float32) + 0.5) * (2.0 / VOXELS) - 1.0
    place = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"))
    grids = torch.empty((len(objects), CHANNELS, VOXELS, VOXELS, VOXELS))
    for i, model in enumerate(objects):
        grids[i, 0] = torch.from_numpy(model.occupancy)
        grids[i, 1:4] = place
        grids[i, 4] = 0.5 * VOXELS * model.voxel_pitch
    return grids


def voxel_of_points(model: ObjectModel) -> Tensor:
    """(P, 3) voxel that each cloud point lies in."""
    at = np.floor((model.points - model.voxel_origin) / model.voxel_pitch).astype(np.int64)
    return torch.from_numpy(np.clip(at, 0, VOXELS - 1))


def _of_objects(objects: tuple[ObjectModel, ...], predictor: ContactPredictor) -> Float32[Tensor, "o p"]:
    key = (objects, predictor)
    if key not in _cached:
        if len(_cached) >= 8:
            _cached.clear()
        _cached[key] = torch.stack([_of_object(o, predictor) for o in objects])
    return _cached[key]


def _of_object(model: ObjectModel, predictor: ContactPredictor) -> Float32[Tensor, " p"]:
    """One object at a time: its result cannot depend on the others."""
    with torch.no_grad():
        found = predictor(contact_grids([model]))
    name = getattr(predictor, "__name__", type(predictor).__name__)
    if not isinstance(found, Tensor) or found.shape != (1, VOXELS, VOXELS, VOXELS):
        what = f"shape {tuple(found.shape)}" if isinstance(found, Tensor) else f"a {type(found).__name__}"
        raise ValueError(
            f"contact predictor {name} returned {what} for a grid (1, 5, 64, 64, 64); need a tensor (1, 64, 64, 64)"
        )
    found = found.detach().cpu().float()
    if not bool(((found >= 0) & (found <= 1)).all()):
        raise ValueError(
            f"contact predictor {name} returned values from {float(found.min()):.3g} to {float(found.max()):.3g}; "
            "need probabilities in [0, 1] (apply a sigmoid to logits)"
        )
    i, j, k = voxel_of_points(model).T
    return found[0, i, j, k]
