"""Where a person would touch an object: a network's probability on its voxel grid, read at the
cloud's points.

What such a network takes and returns: `r2h_batch.predictors.grid`.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch.bodies.objects import OBJECT_NAMES, VOXELS, ObjectModel, stored_key
from r2h_batch.predictors.external_predictions import Observations
from r2h_batch.predictors.grid import ContactPredictor, contact_grids, voxel_of_points
from r2h_batch.predictors.voxnet import load_voxnet
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

__all__ = ["CONTACT_THRESHOLD", "predict_contacts"]

CONTACT_THRESHOLD = 0.4
"""Probability from which a point counts as touched (Contact-Handover)."""

_cached: dict[tuple[Any, ...], Tensor] = {}


def predict_contacts(
    trials: Trials,
    scene: Scene,
    *,
    predictor: ContactPredictor | None = None,
    seen: Observations | None = None,
    left_out: bool = True,
) -> Float32[Tensor, "n p"]:
    """Probability that a person touches each cloud point (`ObjectModel.points`); default: the
    built-in VoxNet.

    The network runs once for each object and predictor; trials only look up. `seen`: a network's
    answers instead. `left_out`: a built-in object is shown to the weights that never saw it; else,
    as any other object, to those of all.
    """
    if seen is not None and seen.contacts is not None:
        return seen.contacts.of(trials)["probability"].to(trials.trial_id.device)
    device = trials.trial_id.device
    return _of_objects(scene.objects, predictor, left_out).to(device)[trials.object_index.long()]


def _of_objects(
    objects: tuple[ObjectModel, ...], predictor: ContactPredictor | None, left_out: bool
) -> Float32[Tensor, "o p"]:
    key = (objects, predictor, left_out)
    if key not in _cached:
        if len(_cached) >= 8:
            _cached.clear()
        networks = (
            load_voxnet(o.name if left_out and stored_key(o) and o.name in OBJECT_NAMES else "")
            if predictor is None
            else predictor
            for o in objects
        )
        _cached[key] = torch.stack(
            [_of_object(o, n) for o, n in zip(objects, networks, strict=True)]
        )
    return _cached[key]


def _of_object(model: ObjectModel, predictor: ContactPredictor) -> Float32[Tensor, " p"]:
    """One object at a time: its result cannot depend on the others."""
    with torch.no_grad():
        found = predictor(contact_grids([model]))
    name = getattr(predictor, "__name__", type(predictor).__name__)
    if not isinstance(found, Tensor) or found.shape != (1, VOXELS, VOXELS, VOXELS):
        what = (
            f"shape {tuple(found.shape)}"
            if isinstance(found, Tensor)
            else f"a {type(found).__name__}"
        )
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
