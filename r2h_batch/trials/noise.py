"""The error model of the default predictors: how far what a method sees is from what is true."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from r2h_batch.base import rng, se3
from r2h_batch.base.validate import validate_fields
from r2h_batch.scene.arrays import stored_arrays
from r2h_batch.scene.hand import rotation_from_axis_angle
from r2h_batch.scene.scene import Scene

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, description="0 is exact")]
Errors = Literal["normal", "frames", "tails"]
"""Error models of the target hand. normal: the deviations below. frames: what published estimators
were off by in single frames, with their outliers and flipped hands
(assets/receiving/build_hand_errors.py). tails: both, one after the other."""
_TARGET, _FRAME = 2, 3  # purposes of the random counters; 0, 1: methods/predictors/hands.py


@dataclass(frozen=True)
class PredictorNoise:
    """Standard deviations, per axis for rotations and translations.

    Target hand: the mean shift is 19 mm, the mean turn 10 degrees. Depth estimators are off by 14 mm a
    joint (HANDS'19, Armagan et al. 2020) to 24-28 mm (with objects, Chao et al. 2021), and by 12-17 mm
    relative to the wrist before alignment, 8-11 degrees over 9 cm. Receiving hand: as large; no true
    hand exists to compare with. Border: affordance segmenters reach weighted F of 0.7-0.8
    (AffordanceNet, Do et al. 2018); here the mean IoU of parts is 0.76. From memory.
    """

    receiving_rotation_deg: NotNegative = 8.0
    """receiver's hand on the object: turn about its palm"""
    receiving_translation_m: NotNegative = 0.010
    target_rotation_deg: NotNegative = 6.0
    """target hand in the world: turn about its palm"""
    target_translation_m: NotNegative = 0.012
    border_m: NotNegative = 0.006
    """shift of the border between two labelled parts along the surface"""
    frame_factor: NotNegative = 1.0
    """on the errors of single frames, where `target_errors` asks for them"""
    target_errors: Errors = "normal"

    def __post_init__(self) -> None:
        validate_fields(self)

    def _numbers(self) -> dict[str, float]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "target_errors"}

    def scaled(self, factor: float) -> PredictorNoise:
        """All deviations and the errors of frames times a factor; 0 is exact: the oracle.

        Args:
            factor: 0 or more.
        """
        if not (np.isfinite(factor) and factor >= 0):
            raise ValueError(
                f"the predictors' noise factor is {factor}; it must be 0 (oracle) or more, 1 is the default"
            )
        return replace(self, **{name: factor * value for name, value in self._numbers().items()})  # type: ignore[arg-type]


def normals(
    key: tuple[int, int], ids: NDArray[np.int64], count: int, *, purpose: int
) -> NDArray[np.float64]:
    """(count, n) nearly normal numbers: sums of 12 uniform ones, less 6; the same bits in any
    batch, on any machine."""
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
    """T with a hand's error in its own frame: a turn about `pivot` (hand frame), then a shift.
    Exact for no deviation."""
    if rotation_deg == 0 and translation_m == 0:
        return T.clone()
    z = torch.from_numpy(normals(key, ids, 6, purpose=purpose)).to(T.device)
    R = rotation_from_axis_angle((np.pi / 180.0 * rotation_deg) * z[:3].T)
    about = pivot.double()
    E = se3.from_rotation(R, about)
    moved = se3.apply(se3.from_rotation(R, torch.zeros_like(about)), about)
    E[:, :3, 3] = E[:, :3, 3] - moved + translation_m * z[3:].T
    return se3.matmul(T.double(), E).float()


def as_in_a_frame(
    T: Float32[Tensor, "n 4 4"],
    pivot: Float32[Tensor, "n 3"],
    directions: Float64[Tensor, "n 3 3"],
    ids: NDArray[np.int64],
    key: tuple[int, int],
    *,
    purpose: int,
    factor: float,
) -> Float32[Tensor, "n 4 4"]:
    """T with the error of one frame of a published estimator, all frames equally likely: a turn
    about `pivot`, then a shift.

    `directions`: columns along the hand, out of its palm, to its thumb (hand frame; a left hand's
    are a mirrored frame, and the error is mirrored with it). Exact for factor 0.
    """
    if factor == 0:
        return T.clone()
    turns, shifts = _frames()
    (u,) = rng.uniforms(key, ids, 1, purpose=purpose)
    row = torch.from_numpy(rng.choice(u, np.full(len(ids), len(turns))))
    R = rotation_from_axis_angle(factor * turns[row]).to(T.device)
    shift = factor * shifts[row].to(T.device)
    B = directions.to(T.device)
    # B R B^T, in sums of a fixed order: an improper B mirrors the turn
    R = se3.matmul(se3.matmul(B, R), B.mT)
    about = pivot.double()
    E = se3.from_rotation(R, about - se3.rotate(R, about) + se3.rotate(B, shift))
    return se3.matmul(T.double(), E).float()


@lru_cache(maxsize=1)
def _frames() -> tuple[Tensor, Tensor]:
    """Rotation vectors (rad) and shifts (m) of single frames, (F, 3) each, in a hand's directions,
    float64."""
    stored = stored_arrays("receiving", "hand_errors.npz")
    turn, shift = (torch.from_numpy(stored[k].astype(np.float64)) for k in ("turn_rad", "shift_m"))
    return turn, shift


def trial_ids(trial_id: Tensor) -> NDArray[np.int64]:
    """The ids as the counters take them."""
    return trial_id.cpu().numpy().astype(np.int64)


def estimated_hand(
    scene: Scene,
    trial_id: Int64[Tensor, " n"],
    hand_index: Int32[Tensor, " n"],
    T_world_hand: Float32[Tensor, "n 4 4"],
    *,
    seed: int,
    noise: PredictorNoise,
) -> Float32[Tensor, "n 4 4"]:
    """Where an estimator sees the hands stand (world), with the error model; drawn by (seed, trial
    id)."""
    hands, row = scene.hands, hand_index.long()
    ids, key = trial_ids(trial_id), rng.key_of(f"target hand {seed}")
    pivot = hands.palm_point.to(row.device)[row]
    T = T_world_hand
    if noise.target_errors != "frames":
        T = perturbed(
            T, pivot, ids, key,
            purpose=_TARGET, rotation_deg=noise.target_rotation_deg, translation_m=noise.target_translation_m,
        )  # fmt: skip
    if noise.target_errors != "normal":
        B = hands.directions.to(row.device)[row]
        T = as_in_a_frame(T, pivot, B, ids, key, purpose=_FRAME, factor=noise.frame_factor)
    return T
