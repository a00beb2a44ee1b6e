"""Shape of a solid as each of its points sees it, in numbers that no frame changes: how thick it is there and around, how long
and flat its surroundings are, how far its ends are, and how this end differs from the other one.

The main axes have no sign here: a point's own end is the one on its side of the centre. So what is learned of one end of a thing
is learned of the other as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import log

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

NEAR_M = (0.006, 0.012, 0.024, 0.048)
"""Surroundings of a point: weights of a normal distribution with these deviations. A hand's width is 0.08 m."""
SLICES = 32
"""Across each of the two longest main axes the solid is cut into so many slices."""
LEAST_M = 1e-3
"""Added to lengths before their logarithm is taken: thinner is one voxel or less."""
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_MASS = (2 * torch.pi) ** 1.5


def shape_features(
    grid: Float32[Tensor, "5 n n n"],
) -> tuple[Float32[Tensor, "v f"], Int64[Tensor, "v 3"]]:
    """Features of each full voxel.

    Args:
        grid: a contact predictor's input of one object (`grid.contact_grids`), with a full voxel.

    Returns:
        The features of the full voxels, and which voxels these are.
    """
    full = grid[0] > 0.5
    half = float(grid[4, 0, 0, 0])
    pitch = 2 * half / full.shape[0]
    place = (grid[1:4] * half)[:, full].T.double()  # m
    deep = depth(full)[full] * pitch
    out = Columns(len(place))
    centre = place.mean(0)
    spread, axes = torch.linalg.eigh((place - centre).T @ (place - centre) / len(place))
    around = _around(
        out,
        grid[1:4] * half - centre.float()[:, None, None, None],
        full,
        deep,
        pitch,
        axes[:, 2].float(),
    )
    longest = [_along(out, place - centre, axes, k, deep, pitch) for k in (2, 1)]
    sd = spread.clamp_min(0).sqrt().tolist()
    volume = len(place) * pitch**3
    for value in (
        log(longest[0]), sd[1] / sd[2], sd[0] / sd[2], log(volume / (40 * max(sd[0] * sd[1] * sd[2], 1e-12))),
        log(float(deep.mean()) + LEAST_M), log(float(deep.max()) + LEAST_M),
    ):  # fmt: skip
        out.add(torch.full((len(place),), value, dtype=torch.float32, device=place.device))
    for values in around:
        out.add(torch.argsort(torch.argsort(values, stable=True)) / len(place))
    far = (place - centre).norm(dim=1)
    out.add(far / far.max())
    out.add(far)
    return torch.stack(out.columns, 1), torch.nonzero(full)


def depth(full: Bool[Tensor, "n n n"]) -> Float32[Tensor, "n n n"]:
    """Distance of each voxel's centre to the nearest empty voxel's, in voxels; outside of the grid all is empty."""
    n = full.shape[0] + 2
    squared = torch.zeros(n, n, n, dtype=torch.float32, device=full.device)
    squared[1:-1, 1:-1, 1:-1] = torch.where(full, 1e6, 0.0)
    i = torch.arange(n, dtype=torch.float32, device=full.device)
    apart = (i[:, None] - i[None]) ** 2
    for axis in range(3):  # Felzenszwalb and Huttenlocher 2012: the squared distance is separable
        rows = squared.movedim(axis, -1)
        found = torch.stack([(row[:, None, :] + apart).amin(-1) for row in rows])
        squared = found.movedim(-1, axis)
    return squared[1:-1, 1:-1, 1:-1].sqrt()


def blurred(fields: Float32[Tensor, "c n n n"], deviation: float) -> Float32[Tensor, "c n n n"]:
    """Sums over all voxels, weighed by exp(-r^2 / 2 s^2) of their distance r; s in voxels."""
    i = torch.arange(fields.shape[-1], dtype=torch.float32, device=fields.device)
    weight = torch.exp(-0.5 * ((i[:, None] - i[None]) / deviation) ** 2)
    for axis in (1, 2, 3):
        fields = (fields.movedim(axis, -1) @ weight).movedim(-1, axis)
    return fields


class Columns:
    """Features of the full voxels, one after the other."""

    def __init__(self, rows: int) -> None:
        self.rows = rows
        self.columns: list[Tensor] = []

    def add(self, values: Tensor) -> Tensor:
        """Keeps a feature, (rows,), and gives it back in single precision."""
        if values.shape != (self.rows,):
            raise ValueError(f"a feature has shape {tuple(values.shape)}; need ({self.rows},)")
        self.columns.append(values.float())
        return self.columns[-1]


def _around(
    out: Columns, place: Tensor, full: Tensor, deep: Tensor, pitch: float, longest: Tensor
) -> Sequence[Tensor]:
    """How much solid is near each voxel, how thick, on which side, how long and how flat; the columns that are also ranked."""
    solid = full.float()
    depths = torch.zeros_like(solid)
    depths[full] = deep
    fields = torch.stack(
        [solid, depths, *(solid * place), *(solid * place[a] * place[b] for a, b in _PAIRS)]
    )
    here = place[:, full].T
    outward = here / here.norm(dim=1, keepdim=True).clamp_min(1e-6)
    out.add((deep + LEAST_M).log())
    volume, thick = [], []
    for near in NEAR_M:
        sums = blurred(fields, near / pitch)[:, full]
        mass = sums[0].clamp_min(1e-6)
        volume.append(out.add((mass * pitch**3 / (_MASS * near**3)).log()))
        thick.append(out.add((sums[1] / mass + LEAST_M).log()))
        mean = (sums[2:5] / mass).T
        out.add((here - mean).norm(dim=1) / near)
        if near == NEAR_M[0]:
            continue
        second = sums[5:11] / mass
        covariance = torch.empty(len(here), 3, 3, dtype=torch.float32, device=here.device)
        for k, (a, b) in enumerate(_PAIRS):
            covariance[:, a, b] = covariance[:, b, a] = second[k] - mean[:, a] * mean[:, b]
        spread, axes = torch.linalg.eigh(covariance)
        for k in (2, 1, 0):
            out.add(spread[:, k].clamp_min(0).sqrt() / near)
        out.add((axes[:, :, 2] * outward).sum(1).abs())
        out.add((axes[:, :, 2] @ longest).abs())
    return thick[1], thick[2], volume[2], volume[3]


def _along(out: Columns, place: Tensor, axes: Tensor, k: int, deep: Tensor, pitch: float) -> float:
    """Where each voxel is along main axis k, and how the solid's slices on its side differ from the others; the length."""
    t = place @ axes[:, k]
    low, high = float(t.min()), float(t.max())
    length = max(high - low, pitch)
    ahead = t >= 0
    own = torch.where(ahead, high, -low)
    for values in (
        t.abs() / length,
        own / length,
        t.abs() / own.clamp_min(1e-6),
        own - t.abs(),
        t.abs(),
    ):
        out.add(values)
    slot = ((t - low) / length * SLICES).long().clamp(0, SLICES - 1)
    middle = min(max(int(-low / length * SLICES), 1), SLICES - 1)
    others = [j for j in (0, 1, 2) if j != k]
    count = _per_slice(slot, torch.ones_like(t))
    wide = [_width(slot, place @ axes[:, j]) for j in others]
    broad, narrow = torch.maximum(*wide), torch.minimum(*wide)
    area = count * pitch**3 / (length / SLICES)
    for profile in (
        (area / torch.pi).clamp_min(1e-8).sqrt(),
        broad,
        narrow,
        _per_slice(slot, deep.double()) / count.clamp_min(1),
    ):
        out.add((profile[slot] + LEAST_M).log())
        above, below = profile[middle:], profile[:middle]
        for figure in (_log_mean, _log_most, _unevenness):
            a, b = figure(above), figure(below)
            mine = torch.where(ahead, a, b)
            out.add(mine)
            out.add(torch.where(ahead, b, a) - mine)
    share = ahead.double().mean()
    out.add(torch.where(ahead, share, 1 - share))
    beside = (place - t[:, None] * axes[:, k]).norm(dim=1)
    out.add(beside / broad[slot].clamp_min(LEAST_M))
    out.add(beside)
    return length


def _per_slice(slot: Tensor, values: Tensor) -> Tensor:
    """Sum of the values in each slice."""
    return torch.zeros(SLICES, dtype=values.dtype, device=values.device).index_add_(0, slot, values)


def _width(slot: Tensor, values: Tensor) -> Tensor:
    """Largest less least value of each slice; 0 for an empty one."""
    most = torch.full((SLICES,), -torch.inf, dtype=values.dtype, device=values.device)
    least = most.neg().scatter_reduce(0, slot, values, "amin")
    wide = most.scatter_reduce(0, slot, values, "amax") - least
    return torch.where(wide.isfinite(), wide, 0.0)


def _log_mean(profile: Tensor) -> Tensor:
    return (profile.mean() + LEAST_M).log()


def _log_most(profile: Tensor) -> Tensor:
    return (profile.max() + LEAST_M).log()


def _unevenness(profile: Tensor) -> Tensor:
    return profile.std(unbiased=False) / (profile.mean() + 1e-4)
