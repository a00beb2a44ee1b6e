"""The built-in contact predictor: a small VoxNet with a decoder, trained on the built-in receiving
grasps."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float32, Int64
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor, nn

from r2h_batch.base.errors import FileError
from r2h_batch.base.io.read import printable, read_file
from r2h_batch.methods.predictors.grid import CHANNELS

WIDTHS = (8, 20, 40)
MIDDLE_M, SPREAD_M = 0.1, 0.05
"""Scales of objects that fit a hand."""

_PLAIN: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}
"""Type of the stored weights, whatever default the caller's program has set."""


class VoxNet(nn.Module):
    """Contact probability of every voxel; 64^3 goes down to 8^3 and back up, with what each size
    saw beside it."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c = WIDTHS
        self.down1 = _block(CHANNELS, a, stride=2)
        self.down2 = _block(a, b, stride=2)
        self.down3 = _block(b, c, stride=2)
        self.deep = _block(c, c)
        self.up2 = _block(c + b, b)
        mixing = nn.Conv3d(b + a, 2 * a, kernel_size=1, **_PLAIN)
        self.up1 = nn.Sequential(mixing, nn.LeakyReLU(0.1))
        self.out = nn.Conv3d(2 * a + CHANNELS, 1, kernel_size=1, **_PLAIN)
        for layer in self.modules():
            if isinstance(layer, nn.Conv3d) and layer is not self.out:
                nn.init.kaiming_normal_(layer.weight, a=0.1, nonlinearity="leaky_relu")
                nn.init.constant_(layer.bias, 0.0)  # type: ignore[arg-type]  # there is one

    def features(self, grid: Float32[Tensor, "k 5 64 64 64"]) -> Float32[Tensor, "k f 32 32 32"]:
        """Features of each block of 2 x 2 x 2 voxels."""
        x1 = self.down1(_centred(grid))
        x2 = self.down2(x1)
        x3 = self.deep(self.down3(x2))
        x2 = self.up2(torch.cat([_doubled(x3), x2], 1))
        return self.up1(torch.cat([_doubled(x2), x1], 1))

    def logits(self, grid: Float32[Tensor, "k 5 64 64 64"]) -> Float32[Tensor, "k 64 64 64"]:
        """Log odds of contact."""
        return self.out(torch.cat([_doubled(self.features(grid)), _centred(grid)], 1))[:, 0]

    def logits_at(
        self, grid: Float32[Tensor, "k 5 64 64 64"], voxel: Int64[Tensor, "k p 3"]
    ) -> Float32[Tensor, "k p"]:
        """The same at some voxels only: for training, where most of a grid is empty."""
        at = (2 * voxel + 1).float() / grid.shape[-1] - 1  # voxel centres, from -1 to 1
        sampled = nn.functional.grid_sample(
            self.features(grid),
            at.flip(-1)[:, :, None, None],
            padding_mode="border",
            align_corners=False,
        )
        i, j, k = voxel.unbind(-1)
        row = torch.arange(len(grid), dtype=torch.int64, device=grid.device)[:, None]
        given = _centred(grid)[row, :, i, j, k].transpose(1, 2)[..., None, None]
        return self.out(torch.cat([sampled, given], 1))[:, 0, :, 0, 0]

    def forward(self, grid: Float32[Tensor, "k 5 64 64 64"]) -> Float32[Tensor, "k 64 64 64"]:
        """Probability of contact; what it says of empty voxels means nothing."""
        return torch.sigmoid(self.logits(grid))


MAX_BYTES = 1 << 30


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv3d(inputs, outputs, kernel_size=3, stride=stride, padding=1, **_PLAIN),
        nn.LeakyReLU(0.1),
    )


def _centred(grid: Tensor) -> Tensor:
    """The grid with the objects' scale (metres) brought to about -1 to 1, like the other
    channels."""
    return torch.cat([grid[:, :4], (grid[:, 4:] - MIDDLE_M) / SPREAD_M], 1)


def _doubled(x: Tensor) -> Tensor:
    return nn.functional.interpolate(x, scale_factor=2.0, mode="trilinear", align_corners=False)


STORED_FILE, LEFT_OUT_FILE = "voxnet.safetensors", "voxnet_left_out.safetensors"
"""Weights trained on all built-in objects; and on all but one, for each of them (OBJECT/WEIGHT,
float16)."""


def halved(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights in float16, as those without an object are stored: sixteen networks in 3.3 MB."""
    return {k: v.half() for k, v in weights.items()}


@lru_cache(maxsize=32)
def load_voxnet(left_out: str = "") -> VoxNet:
    """The network trained on all built-in objects; or, by the name of one, the network that never
    saw that object.

    How they were made: `r2h_batch.assets.receiving.train_voxnet`.
    """
    if not left_out:
        with resources.as_file(_asset(STORED_FILE)) as path:
            return read_voxnet(path)
    net = VoxNet()
    net.load_state_dict({k: v.float() for k, v in _left_out()[left_out].items()})
    return net.eval()


def _asset(name: str) -> Traversable:
    return resources.files("r2h_batch.assets.receiving") / name


@lru_cache(maxsize=1)
def _left_out() -> dict[str, dict[str, Tensor]]:
    """Object -> weights of the network that never saw it."""
    with resources.as_file(_asset(LEFT_OUT_FILE)) as path:
        stored = load(read_file(path, MAX_BYTES))
    found: dict[str, dict[str, Tensor]] = {}
    for key, value in stored.items():
        name, _, weight = key.partition("/")
        found.setdefault(name, {})[weight] = value
    return found


def read_voxnet(path: str | Path) -> VoxNet:
    """A VoxNet with the weights of a .safetensors file."""
    return voxnet_of(path, read_file(path, MAX_BYTES))


def voxnet_of(path: str | Path, data: bytes) -> VoxNet:
    """A VoxNet with the weights that a .safetensors file of this name holds."""
    net = VoxNet()
    try:
        found = load(data)
    except SafetensorError as error:
        raise FileError(
            f"predictor {path}: not a readable .safetensors file ({printable(error)})"
        ) from error
    wanted = net.state_dict()
    wrong = [k for k in wanted if k not in found or found[k].shape != wanted[k].shape]
    extra = [k for k in found if k not in wanted]
    if wrong or extra:
        name = (wrong or extra)[0]
        shape = tuple(found[name].shape) if name in found else "nothing"
        need = tuple(wanted[name].shape) if name in wanted else "no such weight"
        raise FileError(
            f"predictor {path}: weight {name!r} is {shape}, VoxNet needs {need}; another network"
            " must come as ONNX (.onnx) or as package.module:function"
        )
    for name, weight in found.items():
        what = ""
        if weight.dtype != wanted[name].dtype:
            what = f"is {weight.dtype}, VoxNet needs {wanted[name].dtype}; convert it"
        elif not bool(weight.isfinite().all()):
            what = "holds NaN or infinite numbers; train it again, or copy it again"
        if what:
            raise FileError(f"predictor {path}: weight {name!r} {what}")
    net.load_state_dict(found)
    return net.eval()
