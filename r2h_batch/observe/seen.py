"""Images and clouds of cameras: all that a method that sees is given. Imports nothing of the scene."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

LABELS = ("nothing", "table", "robot", "object", "hand", "forearm", "upper_arm", "torso")
"""Things that a pixel can show, by its label."""


@dataclass(frozen=True)
class Images:
    """Windows of N trials and C cameras, rows before columns.

    Attributes:
        depth_m: along the camera's z axis, m; 0 where nothing was measured.
        label: what each pixel shows, a number of `LABELS`.
        K: intrinsics of each window, pixels; the middle of the first pixel is at (0.5, 0.5).
    """

    depth_m: Float32[Tensor, "n c h w"]
    label: UInt8[Tensor, "n c h w"]
    K: Float32[Tensor, "n c 3 3"]


@dataclass(frozen=True)
class Observation:
    """The view of C cameras on N trials at the moment (`moments`).

    Attributes:
        object: windows about the object.
        hand: windows about the receiver's hand.
        T_world_camera: where the cameras are believed to stand (x along rows, y along columns, z forward), m.
    """

    object: Images
    hand: Images
    T_world_camera: Float32[Tensor, "n c 4 4"]

    def __len__(self) -> int:
        return len(self.T_world_camera)

    def cloud(
        self, points: int = 2048, *, label: str = "object"
    ) -> tuple[Float32[Tensor, "n p 3"], Bool[Tensor, "n p"]]:
        """Clouds of a fixed size: points that pixels with a label show, evenly taken from all that there are.

        Point k is that of pixel floor(k m / points) of the m pixels with the label and a depth, camera by camera, row by row.
        Fewer pixels than points: each comes once and the rest is masked.

        Args:
            points: of each trial.
            label: of `LABELS`; `hand` is taken from the windows about the hand, all else from those about the object.

        Returns:
            (N, P, 3) float32 in the world, m, 0 where masked; (N, P) whether there is a point.
        """
        images = self.hand if label == "hand" else self.object
        shown = (images.label == LABELS.index(label)) & (images.depth_m > 0)
        nth = shown.flatten(1).cumsum(1)  # pixel p is the nth[p]-th shown one, if it is shown
        count = nth[:, -1:]
        k = torch.arange(points, dtype=torch.int64, device=nth.device)
        mask = k < count
        take = torch.where(count > points, k * count // points, k)
        pixel = torch.searchsorted(nth, take + 1).clamp(max=nth.shape[1] - 1)
        h, w = shown.shape[-2:]
        camera, v, u = pixel // (h * w), pixel % (h * w) // w, pixel % w
        row = torch.arange(len(self), dtype=torch.int64, device=nth.device)[:, None]
        K, T = images.K[row, camera], self.T_world_camera[row, camera]
        z = images.depth_m[row, camera, v, u]
        x = (u + 0.5 - K[..., 0, 2]) / K[..., 0, 0] * z
        y = (v + 0.5 - K[..., 1, 2]) / K[..., 1, 1] * z
        found = torch.stack(
            [
                x * T[..., k, 0] + y * T[..., k, 1] + z * T[..., k, 2] + T[..., k, 3]
                for k in range(3)
            ],
            -1,
        )
        return torch.where(mask[..., None], found, torch.zeros_like(found)), mask
