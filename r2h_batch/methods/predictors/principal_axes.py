"""A contact network that no frame decides: it sees an object in axes made from the object itself.

The x axis is the direction of the largest spread of the solid's voxels, y the next. x points away from the end that is
farther from the centre of the solid. The signs of y and z are left open, and the answer is the mean over the four choices.
"""

from __future__ import annotations

import hashlib
from functools import cached_property, lru_cache
from importlib import resources

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from r2h_batch.methods.predictors.grid import CHANNELS
from r2h_batch.methods.predictors.voxnet import VoxNet, read_voxnet

FILLED = 1.75
"""Longest side of the turned object in its grid, whose side is 2."""
OCCUPIED = 0.4
"""Share of a voxel, after the turn, from which it counts as full."""
FLIPS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))
STORED_FILE = "voxnet_axes.safetensors"


def principal_axes(
    occupied: Float32[Tensor, "n n n"],
) -> tuple[Float32[Tensor, "3 3"], Float32[Tensor, " 3"], float]:
    """The object's own axes.

    Args:
        occupied: voxels of the solid, 1 where full; coordinates go from -1 to 1.

    Returns:
        Rows are the axes; the point that becomes the middle of the turned grid; the zoom that fills it.
    """
    size = occupied.shape[0]
    place = (torch.nonzero(occupied > 0.5).double() + 0.5) * (2.0 / size) - 1.0
    mean = place.mean(0)
    spread = (place - mean).T @ (place - mean)
    _, axes = torch.linalg.eigh(spread)  # smallest first
    x, y = axes[:, 2], axes[:, 1]
    along = (place - mean) @ x
    if along.max() > -along.min():  # the end farther from the centre stands at -x
        x = -x
    frame = torch.stack([x, y, torch.linalg.cross(x, y)])
    turned = place @ frame.T
    low, high = turned.min(0).values, turned.max(0).values
    zoom = FILLED / float((high - low).max())
    return frame.float(), (frame.T @ ((low + high) / 2)).float(), zoom


def turned_grid(
    grid: Float32[Tensor, "5 n n n"], flip: tuple[float, float]
) -> tuple[Float32[Tensor, "5 n n n"], Float32[Tensor, "3 4"]]:
    """A grid in the object's own axes.

    Args:
        grid: the network's input of an object (`grid.contact_grids`).
        flip: signs of y and z.

    Returns:
        The turned input, and the affine map from the object's grid coordinates to the turned ones.
    """
    frame, middle, zoom = principal_axes(grid[0])
    A = zoom * (
        torch.diag(torch.tensor([1.0, *flip], dtype=frame.dtype, device=frame.device)) @ frame
    )
    back = torch.linalg.inv(A)
    occupied = _sampled(grid[None, :1], torch.cat([back, middle[:, None]], 1))[0, 0]
    turned = grid.clone()
    turned[0] = (occupied > OCCUPIED).float()
    turned[4] = grid[4] / zoom
    return turned, torch.cat([A, (-A @ middle)[:, None]], 1)


class InPrincipalAxes(nn.Module):
    """A contact predictor: the network's mean answer over the four choices of signs, in the object's own grid."""

    def __init__(self, network: VoxNet) -> None:
        super().__init__()
        self.network = network

    @cached_property
    def digest(self) -> str:
        """sha256 (hex) of the weights."""
        digest = hashlib.sha256()
        for name, value in sorted(self.network.state_dict().items()):
            digest.update(name.encode() + value.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def forward(self, grid: Float32[Tensor, "k 5 n n n"]) -> Float32[Tensor, "k n n n"]:
        """Probability of contact of every voxel."""
        return torch.stack([self._of_object(one) for one in grid])

    def _of_object(self, grid: Float32[Tensor, "5 n n n"]) -> Float32[Tensor, "n n n"]:
        if grid.shape[0] != CHANNELS or not bool((grid[0] > 0.5).any()):
            return torch.zeros_like(grid[0])
        total = torch.zeros_like(grid[0])
        for flip in FLIPS:
            turned, to_turned = turned_grid(grid, flip)
            answer = self.network(turned[None])[:, None]
            total += _sampled(answer, to_turned)[0, 0]
        return (total / len(FLIPS)).clamp(0.0, 1.0)


def _sampled(
    field: Float32[Tensor, "1 c n n n"], affine: Float32[Tensor, "3 4"]
) -> Float32[Tensor, "1 c n n n"]:
    """The field at affine(p) for every voxel centre p."""
    theta = torch.empty(1, 3, 4, dtype=field.dtype, device=field.device)
    theta[0, :, :3] = affine[:, :3].flip(0).flip(1)  # grid_sample's x is the last axis
    theta[0, :, 3] = affine[:, 3].flip(0)
    where = nn.functional.affine_grid(theta, list(field.shape), align_corners=False)
    return nn.functional.grid_sample(field, where, padding_mode="zeros", align_corners=False)


@lru_cache(maxsize=1)
def load_axes_network() -> InPrincipalAxes:
    """The network for objects that are not one of the sixteen of r2h-v1: trained on training instances of the families."""
    with resources.as_file(resources.files("r2h_batch.assets.families") / STORED_FILE) as path:
        return InPrincipalAxes(read_voxnet(path)).eval()
