"""Input and output of a contact predictor: an object's voxel grid in, a probability of contact per
voxel out.

A contact predictor is a callable: grid (K, 5, 64, 64, 64) float32 in, contact probability (K, 64,
64, 64) in [0, 1] out. The grid's axes are the object's x, y, z; its channels are occupancy, the
voxel centre's x, y, z in the box of the grid from -1 to 1, and the object's scale (half the grid's
side, in metres) in every voxel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from r2h_batch.scene.objects import VOXELS, ObjectModel

ContactPredictor = Callable[[Tensor], Tensor]
CHANNELS = 5


def contact_grids(objects: Sequence[ObjectModel]) -> Float32[Tensor, "o 5 64 64 64"]:
    """The network's input for each object."""
    axis = (torch.arange(VOXELS, dtype=torch.float32, device="cpu") + 0.5) * (2.0 / VOXELS) - 1.0
    place = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"))
    shape = (len(objects), CHANNELS, *place.shape[1:])
    grids = torch.empty(shape, dtype=torch.float32, device="cpu")
    for i, model in enumerate(objects):
        grids[i, 0] = torch.from_numpy(model.occupancy)
        grids[i, 1:4] = place
        grids[i, 4] = 0.5 * VOXELS * model.voxel_pitch
    return grids


def voxel_of_points(model: ObjectModel) -> Tensor:
    """(P, 3) voxel that each cloud point lies in."""
    at = np.floor((model.points - model.voxel_origin) / model.voxel_pitch).astype(np.int64)
    return torch.from_numpy(np.clip(at, 0, VOXELS - 1))
