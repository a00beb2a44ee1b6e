"""Where a person would touch an object: a network's probability on its voxel grid, read at the
cloud's points.

What such a network takes and returns: `r2h_batch.methods.predictors.grid`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float32
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.io.cache import ArraySpec, cached, code_digest
from r2h_batch.methods.predictors.external_predictions import Observations
from r2h_batch.methods.predictors.grid import ContactPredictor, contact_grids, voxel_of_points
from r2h_batch.methods.predictors.principal_axes import InPrincipalAxes, load_axes_network
from r2h_batch.methods.predictors.unseen import LEFT_OUT, FromShape, load_unseen
from r2h_batch.methods.predictors.voxnet import load_voxnet
from r2h_batch.scene.arrays import stored_arrays
from r2h_batch.scene.objects import (
    OBJECT_NAMES,
    VOXELS,
    ObjectModel,
    object_digest,
)
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

CONTACT_THRESHOLD = 0.4
"""Probability from which a point counts as touched (Contact-Handover)."""

Contacts = Literal["left-out", "other-categories", "all"]
"""Which built-in weights answer for an object. left-out: those that never saw it. other-categories: those that never saw
an object of its category (`scene.objects.Who`), whatever its frame: `predictors.unseen`. all: those trained on
everything, on the sixteen objects of r2h-v1 too."""

_cached: dict[tuple[Any, ...], Tensor] = {}


def predict_contacts(
    trials: Trials,
    scene: Scene,
    *,
    predictor: ContactPredictor | None = None,
    seen: Observations | None = None,
    contacts: Contacts = "left-out",
) -> Float32[Tensor, "n p"]:
    """Probability that a person touches each cloud point (`ObjectModel.points`).

    The network runs once for each object and predictor; trials only look up.

    Args:
        trials: N trials.
        scene: objects: `Evaluator.scene`.
        predictor: the network; None: the built-in VoxNet.
        seen: answers of your own network instead.
        contacts: which of the built-in weights answer (`Contacts`).

    Returns:
        (N, P) probabilities.
    """
    if seen is not None and seen.contacts is not None:
        return seen.contacts.of(trials)["probability"].to(trials.trial_id.device)
    found = _of_objects(scene, predictor, contacts)
    return found.to(trials.trial_id.device)[trials.object_index.long()]


def _of_objects(
    scene: Scene, predictor: ContactPredictor | None, contacts: Contacts
) -> Float32[Tensor, "o p"]:
    key = (scene.objects, predictor, contacts)
    if key not in _cached:
        if len(_cached) >= 8:
            _cached.clear()
        rows = []
        for o in scene.objects:
            network = _network_for(o, contacts) if predictor is None else predictor
            if isinstance(network, Slow):
                rows.append(_kept(o, network))
            else:
                rows.append(_of_object(o, network, contact_grids([o])))
        _cached[key] = torch.stack(rows)
    return _cached[key]


def _network_for(model: ObjectModel, contacts: Contacts) -> ContactPredictor:
    """The built-in network for an object: the objects of r2h-v1 and r2h-release are shown to weights that know how these
    lie, in whatever frame; any other to the network that no frame decides. `other-categories` shows all to networks of which
    that is true."""
    frozen, own = model.who.has_frozen_frame, model.who.own
    if contacts == "other-categories":
        return load_unseen(
            own.name if frozen else model.who.category
        )  # r2h-v1 has one object of each
    if not frozen:
        return load_axes_network()
    model = own
    return load_voxnet(model.name if contacts != "all" and model.name in OBJECT_NAMES else "")


def never_seen(scene: Scene) -> list[str]:
    """Names of the objects of no category that the built-in networks learned from; of an object without a category nobody
    knows it."""
    known = {category for group in LEFT_OUT for category in group}
    return [
        o.name for o in scene.objects if not o.who.has_frozen_frame and o.who.category not in known
    ]


CODE = (
    *("r2h_batch.methods.predictors.contacts", "r2h_batch.methods.predictors.grid"),
    *("r2h_batch.methods.predictors.principal_axes", "r2h_batch.methods.predictors.voxnet"),
    *("r2h_batch.methods.predictors.shape_features", "r2h_batch.methods.predictors.unseen"),
)
Slow = InPrincipalAxes | FromShape
"""Networks that take 0.4 s of a core or more for an object, and say which weights they have (`digest`)."""
VERSIONS = ("numpy", "torch")
"""Modules and distributions that make a prediction. Another of them makes every one again."""


SHIPPED_FILE = "contacts.npz"
"""Answers of the network of `load_axes_network` for the shipped instances, with the digest of its weights."""


@lru_cache(maxsize=1)
def shipped_answers() -> Mapping[str, NDArray[Any]]:
    """Instance -> (P,) probabilities, and `network` -> the digest of the weights that gave them; empty before they are built."""
    return stored_arrays("families", SHIPPED_FILE)


def _kept(model: ObjectModel, network: Slow) -> Float32[Tensor, " p"]:
    """The network's answer for an object: shipped, or kept on disk."""
    shipped = shipped_answers()
    known = model.name in shipped and model.who.key == model.name
    if known and shipped["network"].item() == network.digest:
        return torch.from_numpy(shipped[model.name].copy())

    def make() -> dict[str, NDArray[np.float32]]:
        return {"probability": _of_object(model, network, contact_grids([model])).numpy()}

    made_of = f"{object_digest(model)} {network.digest} {code_digest(CODE, VERSIONS)}"
    key = hashlib.sha256(made_of.encode()).hexdigest()
    form = {"probability": ArraySpec("float32", (len(model.points),))}
    return torch.from_numpy(cached("contacts", key, make, form)["probability"].copy())


def _of_object(
    model: ObjectModel, predictor: ContactPredictor, grid: Tensor
) -> Float32[Tensor, " p"]:
    """One object at a time: its result cannot depend on the others."""
    with torch.no_grad():
        found = predictor(grid)
    name = getattr(predictor, "__name__", type(predictor).__name__)
    if not isinstance(found, Tensor) or found.shape != (1, VOXELS, VOXELS, VOXELS):
        tensor = isinstance(found, Tensor)
        what = f"shape {tuple(found.shape)}" if tensor else f"a {type(found).__name__}"
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
