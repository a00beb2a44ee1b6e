"""The error model of the default predictors: how far what a method sees is from what is true."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float32
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch import rng, se3
from r2h_batch.bodies.hand import rotation_from_axis_angle

__all__ = ["PredictorNoise", "normals", "perturbed"]


@dataclass(frozen=True)
class PredictorNoise:
    """Standard deviations, per axis for rotations and translations. Sources: docs/receiving.md."""

    receiving_rotation_deg: float = 8.0
    """receiver's hand on the object: turn about its palm"""
    receiving_translation_m: float = 0.010
    target_rotation_deg: float = 6.0
    """target hand in the world: turn about its palm"""
    target_translation_m: float = 0.012
    border_m: float = 0.006
    """shift of the border between two labelled parts along the surface"""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{f.name} is {value}; it must be a number, 0 (exact) or more")

    def scaled(self, factor: float) -> PredictorNoise:
        """All deviations times a factor; 0 is exact: the oracle."""
        if not (np.isfinite(factor) and factor >= 0):
            raise ValueError(
                f"the predictors' noise factor is {factor}; it must be 0 (oracle) or more, 1 is the default"
            )
        return replace(self, **{f.name: factor * getattr(self, f.name) for f in fields(self)})


def normals(key: tuple[int, int], ids: NDArray[np.int64], count: int, *, purpose: int) -> NDArray[np.float64]:
    """(count, n) nearly normal numbers: sums of 12 uniform ones, less 6; the same bits in any batch, on any machine."""
    u = rng.uniforms(key, ids, 12 * count, purpose=purpose).reshape(12, count, len(ids))
    total = u[0] - 6.0
    for k in range(1, 12):
        total = total + u[k]
    return total


def perturbed(
    T: Float32[Tensor, "n 4 4"],
    pivot: Float32[Tensor, "n 3"],
    ids: NDArray[np.int64],
    key: tuple[int, int],
    *,
    purpose: int,
    rotation_deg: float,
    translation_m: float,
) -> Float32[Tensor, "n 4 4"]:
    """T with a hand's error in its own frame: a turn about `pivot` (hand frame), then a shift. Exact for no deviation."""
    if rotation_deg == 0 and translation_m == 0:
        return T.clone()
    z = torch.from_numpy(normals(key, ids, 6, purpose=purpose)).to(T.device)
    R = rotation_from_axis_angle((np.pi / 180.0 * rotation_deg) * z[:3].T)
    about = pivot.double()
    E = se3.from_rotation(R, about)
    E[:, :3, 3] = (
        E[:, :3, 3] - se3.apply(se3.from_rotation(R, torch.zeros_like(about)), about) + translation_m * z[3:].T
    )
    return se3.matmul(T.double(), E).float()


def trial_ids(trial_id: Tensor) -> NDArray[np.int64]:
    """The ids as the counters take them."""
    return trial_id.cpu().numpy().astype(np.int64)
