"""Part labels of an object's point cloud as a segmentation network sees them (`trials.borders`)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int64, UInt8
from torch import Tensor

from r2h_batch.methods.predictors.external_predictions import Observations
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.borders import labels_with_borders
from r2h_batch.trials.noise import PredictorNoise
from r2h_batch.types import Trials


@dataclass(frozen=True, eq=False)
class SeenParts:
    """Labels of each trial's cloud (`ObjectModel.points`), in the object's order of points."""

    label: UInt8[Tensor, "n p"]
    """index into the object's `part_names`"""
    usage: Bool[Tensor, "n p"]
    """in the receiver's region; all False for S0 objects"""
    role: UInt8[Tensor, "n p"] | None = None
    """0 works, 1 grasp, 2 wrap-grasp, where a network says so itself; None: it follows from label
    and usage"""


def predict_parts(
    trials: Trials,
    scene: Scene,
    *,
    seed: int = 0,
    noise: PredictorNoise | None = None,
    seen: Observations | None = None,
    points: Int64[Tensor, " p"] | None = None,
) -> SeenParts:
    """Part label and region of every cloud point, borders shifted along the surface.

    Where two parts meet, the border moves by a smooth random field of deviation `border_m`: points
    on the side that shrinks get the other part's label. The region's border is one of them.

    Args:
        trials: N trials.
        scene: objects: `Evaluator.scene`.
        seed: key of the draws; a row depends on seed and trial id alone.
        noise: deviations of the error model; None: `PredictorNoise()`.
        seen: answers of your own network instead.
        points: numbers of the points of each cloud that are asked for; None: all.

    Returns:
        (N, P) labels, and whether each point belongs to the receiver's region.
    """
    noise = PredictorNoise() if noise is None else noise
    device = trials.trial_id.device
    if seen is not None and seen.parts is not None:
        some = slice(None) if points is None else points
        given = {k: v[:, some].to(device) for k, v in seen.parts.of(trials).items()}
        nothing = torch.zeros_like(next(iter(given.values())))
        usage = given.get("usage", nothing).to(torch.bool)
        return SeenParts(given.get("label", nothing), usage, given.get("role"))
    label = labels_with_borders(
        trials, scene.objects, seed=seed, border_m=noise.border_m, points=points
    )
    return SeenParts((label // 2).to(device), (label % 2).to(torch.bool).to(device))
