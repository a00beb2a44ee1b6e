"""Contact predictors for categories that they never saw. They are boosted trees that read the shape as each point sees it
(`shape_features`).

Four groups of the sixteen categories are left out in turn. The trees of a group learned from instances of the other twelve
categories and of things outside of the sixteen (`r2h_batch.assets.families.other_things`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from importlib import resources

import torch
from jaxtyping import Float32
from safetensors.torch import load
from torch import Tensor, nn

from r2h_batch.base.io.read import read_file
from r2h_batch.methods.predictors.grid import CHANNELS
from r2h_batch.methods.predictors.shape_features import blurred, shape_features

LEFT_OUT = (
    ("hammer", "bottle", "toothbrush", "cup"),
    ("screwdriver", "scissors", "binoculars", "bowl"),
    ("pliers", "knife", "headphones", "wineglass"),
    ("power_drill", "trigger_sprayer", "eyeglasses", "game_controller"),
)
"""Categories that are left out together."""
STORED_FILE = "unseen.safetensors"
FILLED_VOXELS = 2.0
"""An empty voxel has the answer of the full ones around it, weighed by a normal distribution of this deviation."""
MAX_BYTES = 1 << 24


class FromShape(nn.Module):
    """A contact predictor: the sum of small regression trees over the features of a point.

    Args:
        trees: `feature`, `threshold`, `left`, `right` and `value` of T trees with up to N nodes, (T, N)
            each, the root first; a leaf is its own left and right; `start` (1,): what the trees' values are added to.
    """

    def __init__(self, trees: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.stored = dict(trees)
        self.trees = {
            k: v.long() if k in ("feature", "left", "right") else v.float()
            for k, v in trees.items()
        }

    @cached_property
    def digest(self) -> str:
        """sha256 (hex) of the trees."""
        digest = hashlib.sha256()
        for name, value in sorted(self.trees.items()):
            digest.update(name.encode() + value.contiguous().numpy().tobytes())
        return digest.hexdigest()

    def of_features(self, features: Float32[Tensor, "p f"]) -> Float32[Tensor, " p"]:
        """Probability of contact of points with these features."""
        total = self.trees["start"].expand(len(features)).clone()
        every = torch.arange(len(features), dtype=torch.int64, device=features.device)
        tables = (self.trees[k] for k in ("feature", "threshold", "left", "right", "value"))
        for feature, threshold, left, right, value in zip(*tables, strict=True):
            node = torch.zeros(len(features), dtype=torch.int64, device=features.device)
            while True:
                below = features[every, feature[node]] <= threshold[node]
                after = torch.where(below, left[node], right[node])
                if torch.equal(after, node):
                    break
                node = after
            total += value[node]
        return total.clamp(0.0, 1.0)

    def forward(self, grid: Float32[Tensor, "k 5 n n n"]) -> Float32[Tensor, "k n n n"]:
        """Probability of contact of every voxel."""
        return torch.stack([self._of_object(one) for one in grid])

    def _of_object(self, grid: Float32[Tensor, "5 n n n"]) -> Float32[Tensor, "n n n"]:
        full = grid[0] > 0.5
        if grid.shape[0] != CHANNELS or not bool(full.any()):
            return torch.zeros_like(grid[0])
        features, voxel = shape_features(grid)
        found = torch.zeros_like(grid[0])
        found[tuple(voxel.T)] = self.of_features(features)
        near, weight = blurred(torch.stack([found, full.float()]), FILLED_VOXELS)
        around = torch.where(weight > 1e-6, near / weight.clamp_min(1e-6), 0.0)
        return torch.where(full, found, around).clamp(0.0, 1.0)


def mean_of(sets: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """Trees whose sum is the mean of the sums of these."""
    most = max(t["value"].shape[1] for t in sets)
    found = {
        k: torch.cat([nn.functional.pad(t[k], (0, most - t[k].shape[1])) for t in sets])
        for k in ("feature", "threshold", "left", "right", "value")
    }
    found["value"] = found["value"] / len(sets)
    return found | {"start": torch.stack([t["start"] for t in sets]).mean(0)}


@lru_cache(maxsize=8)
def load_unseen(category: str | None) -> FromShape:
    """The predictor that never saw a category: the one that left it out; of none of the sixteen, or None: the mean of all four.

    How they were made: `r2h_batch.assets.families.train_unseen`.
    """
    stored = _stored()
    for k, group in enumerate(LEFT_OUT):
        if category in group:
            return FromShape(stored[str(k)])
    return FromShape(mean_of([stored[str(k)] for k in range(len(LEFT_OUT))]))


@lru_cache(maxsize=1)
def _stored() -> Mapping[str, Mapping[str, Tensor]]:
    """Group -> trees."""
    with resources.as_file(resources.files("r2h_batch.assets.families") / STORED_FILE) as path:
        stored = load(read_file(path, MAX_BYTES))
    found: dict[str, dict[str, Tensor]] = {}
    for key, value in stored.items():
        group, _, name = key.partition("/")
        found.setdefault(group, {})[name] = value
    return found
