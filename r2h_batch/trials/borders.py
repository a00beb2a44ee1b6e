"""Part labels of an object's point cloud as a segmentation network sees them: right, but for where
parts meet."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Int64, UInt8
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from r2h_batch.base import rng
from r2h_batch.scene.objects import ObjectModel
from r2h_batch.trials.noise import normals, trial_ids
from r2h_batch.types import Trials

WAVES = 12
WAVELENGTH_M = (0.03, 0.12)
"""Between a finger's width and a handle's length: a border is misplaced as a whole more than point
by point."""
_PARTS = 0
_CHUNK = 4096  # 32 MB an array


def labels_with_borders(
    trials: Trials,
    objects: tuple[ObjectModel, ...],
    *,
    seed: int,
    border_m: float,
    points: Int64[Tensor, " p"] | None = None,
) -> UInt8[Tensor, "n p"]:
    """2 part + 1 in the receiver's region, of the points of each trial's cloud (`ObjectModel.points`), on the CPU.

    Where two parts meet, the border moves by a smooth random field of deviation `border_m`: points
    on the side that shrinks get the other part's label. The region's border is one of them.

    Args:
        trials: N trials.
        objects: of the scene.
        seed: key of the draws; a row depends on seed and trial id alone.
        border_m: deviation of the borders' shift, m; 0: the truth.
        points: numbers of the points of each cloud that are asked for; None: all.
    """
    clouds = _clouds(objects)
    at = trials.object_index.cpu().long()
    if points is None:
        points = torch.arange(clouds.label.shape[1], dtype=torch.int64, device="cpu")
    if border_m == 0:
        return clouds.label[at[:, None], points]
    ids, key = trial_ids(trials.trial_id), rng.key_of(f"parts {seed}")
    z = torch.from_numpy(normals(key, ids, WAVES, purpose=_PARTS).astype(np.float32))
    z = z * (border_m * (2.0 / WAVES) ** 0.5)
    found = torch.empty((len(at), len(points)), dtype=torch.uint8, device="cpu")
    for first in range(0, len(at), _CHUNK):
        rows = slice(first, first + _CHUNK)
        found[rows] = _shifted(clouds, at[rows], z[:, rows], points)
    return found


def _shifted(clouds: _Clouds, at: Tensor, z: Tensor, points: Tensor) -> Tensor:
    """Labels of these points of objects `at` with the waves' amplitudes z (k, n) in metres."""

    def own(x: Tensor) -> Tensor:
        return x[:, points][at]

    shift = torch.zeros((len(at), len(points)), dtype=torch.float32, device="cpu")
    for k in range(WAVES):
        shift = shift + z[k][:, None] * own(clouds.wave[:, k])
    moved = own(clouds.offset) + own(clouds.sign) * shift < 0
    return torch.where(moved, own(clouds.other), own(clouds.label))


@dataclass(frozen=True, eq=False)
class _Clouds:
    """O objects, P points; labels are 2 part + 1 in the receiver's region."""

    label: UInt8[Tensor, "o p"]
    other: UInt8[Tensor, "o p"]
    """the nearest other label"""
    offset: Float32[Tensor, "o p"]
    """distance to the border with it"""
    sign: Float32[Tensor, "o p"]
    """+1 on the side of the lower label: a shift makes one side of a border larger and the other
    smaller"""
    wave: Float32[Tensor, "o k p"]
    """smooth random functions on the cloud, mean square 1/2"""


@lru_cache(maxsize=8)
def _clouds(objects: tuple[ObjectModel, ...]) -> _Clouds:
    rows = [_cloud(o) for o in objects]
    return _Clouds(*(torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True)))


def _cloud(model: ObjectModel) -> tuple[NDArray[np.generic], ...]:
    points = model.points.astype(np.float64)
    label = (2 * model.point_part + model.receiver_face[model.point_face]).astype(np.uint8)
    other, offset = _other(points, label)
    sign = np.where(label < other, 1.0, -1.0).astype(np.float32)
    draw = np.random.Generator(np.random.Philox(key=0x57415645))
    wave = np.zeros((WAVES, len(points)), np.float32)
    for k in range(WAVES):
        direction = draw.standard_normal(3)
        length = WAVELENGTH_M[0] + (WAVELENGTH_M[1] - WAVELENGTH_M[0]) * draw.random()
        phase = 2 * np.pi * draw.random()
        along = points @ (direction / np.linalg.norm(direction))
        wave[k] = np.cos(2 * np.pi * along / length + phase)
    return label, other, offset, sign, wave


def _other(
    points: NDArray[np.float64], label: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Nearest other label of each point, and the distance to the border: half a point's spacing
    before that label's."""
    other, offset = label.copy(), np.full(len(points), np.inf, np.float32)
    spacing = float(cKDTree(points).query(points, 2)[0][:, 1].mean())
    for part in np.unique(label):
        own, rest = label == part, label != part
        if rest.any():
            distance, nearest = cKDTree(points[rest]).query(points[own])
            other[own] = label[rest][nearest]
            offset[own] = np.maximum(distance - spacing / 2, 1e-5)
    return other, offset
