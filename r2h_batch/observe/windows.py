"""Windows of the sensor: square crops about the object and about the hand, as a detector gives them."""

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32
from torch import Tensor

from r2h_batch.base import se3
from r2h_batch.judge.object_errors import box_middle
from r2h_batch.observe.rig import Rig
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Trials

NEAREST_M = 0.05
"""Points nearer to a camera's plane than this have no place in its image."""


def middles(
    scene: Scene, trials: Trials, T_world_obj: Float32[Tensor, "n 4 4"]
) -> Float64[Tensor, "n 3"]:
    """Middles of the objects' boxes in the world, m."""
    own = np.stack([box_middle(scene.objects[i]) for i in trials.object_index.tolist()])
    T = T_world_obj.double()
    return se3.apply(T, torch.from_numpy(own).to(T.device))


def projected(
    rig: Rig, points: Float64[Tensor, "n 3"]
) -> tuple[Float64[Tensor, "n c 2"], Float64[Tensor, "n c"]]:
    """Where cameras see points: column and row on the sensor, pixels, and depth, m.

    Args:
        rig: C cameras.
        points: (N, 3) float64, world, m.
    """
    T_camera_world = se3.inverse(rig.T_world_camera.double().to(points.device))
    local = se3.apply(T_camera_world[None], points[:, None].expand(-1, len(rig.cameras), -1))
    z = local[..., 2]
    principal = 0.5 * torch.tensor(rig.sensor_px, dtype=torch.float64, device=points.device)
    return rig.focal_px * local[..., :2] / z.clamp(min=NEAREST_M)[..., None] + principal, z


def window_corners(
    rig: Rig, points: Float64[Tensor, "n 3"], side_px: int
) -> Int32[Tensor, "n c 2"]:
    """First pixels (column, row) of square windows about points, on the sensor and beyond it.

    Args:
        rig: C cameras.
        points: (N, 3) float64, world, m.
        side_px: side of the windows.
    """
    at, _ = projected(rig, points)
    return (at.round() - side_px // 2).clamp(-1e6, 1e6).to(torch.int32)


def intrinsics(rig: Rig, corner_px: Int32[Tensor, "n c 2"]) -> Float32[Tensor, "n c 3 3"]:
    """K of windows, pixels; the middle of the first pixel is at (0.5, 0.5).

    Args:
        rig: its focal length and sensor.
        corner_px: (N, C, 2) int32, of `window_corners`.
    """
    n, c = corner_px.shape[:2]
    K = torch.zeros((n, c, 3, 3), dtype=torch.float32, device=corner_px.device)
    principal = 0.5 * torch.tensor(rig.sensor_px, dtype=torch.float64, device=corner_px.device)
    K[..., 0, 0] = K[..., 1, 1] = rig.focal_px
    K[..., :2, 2] = (principal - corner_px).float()
    K[..., 2, 2] = 1.0
    return K
