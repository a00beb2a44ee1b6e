"""Handover-VA's utility axis: ICP of a handle-function template onto the labelled cloud; the
template's x is the handle."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Float64, Int32, UInt8
from numpy.typing import NDArray
from torch import Tensor

from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.methods import label_icp as kernels
from r2h_batch.methods.part_roles import FUNCTION, GRASP, WRAP
from r2h_batch.scene.kept import KeptWith
from r2h_batch.scene.scene import Scene

LABEL_M = 1.0
"""Distance between two labels: more than any object is long, so labels are matched first, as with
colours to 255."""


@dataclass(frozen=True)
class Alignment:
    """The scaled template in the object's frame, mean distance (m, labels included), ICP steps; the
    handle's centre."""

    R_obj_template: Float64[Tensor, "b 3 3"]
    p_obj_template: Float64[Tensor, "b 3"]
    error_m: Float64[Tensor, " b"]
    steps: Int32[Tensor, " b"]
    scale: Float32[Tensor, " b"]
    handle: Float32[Tensor, "b 3"]


def handle_template() -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points (80, 3) and roles: 15 handle sections from x = 0.5 in steps of -0.02, 5 of the
    function from x = -0.2."""
    corners = [(h, d) for h in (0.02, -0.02) for d in (0.02, -0.02)]
    handle = [(0.5 - 0.02 * i, h, d) for i in range(15) for h, d in corners]
    function = [(-0.2 - 0.02 * j, h, d) for j in range(5) for h, d in corners]
    roles = [GRASP] * len(handle) + [FUNCTION] * len(function)
    return np.array(handle + function), np.array(roles, np.uint8)


def wrap_template() -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points (240, 3) and roles: 15 rings of 16 points about x, from x = -0.4 in steps of 0.05,
    radii 0.08 + 0.01 i."""
    angle = np.pi * np.arange(16) / 8
    rings = [
        np.stack([np.full(16, -0.4 + 0.05 * i), r * np.sin(angle), r * np.cos(angle)], 1)
        for i, r in enumerate(0.08 + 0.01 * np.arange(15))
    ]
    return np.concatenate(rings), np.full(240, WRAP, np.uint8)


def align_templates(
    scene: Scene,
    object_index: Int32[Tensor, " b"],
    role: UInt8[Tensor, "b p"],
    *,
    iterations: int,
    tolerance_m: float,
    label_m: float = LABEL_M,
) -> Alignment:
    """ICP of the template onto each trial's labelled cloud; a cloud with any WRAP point gets the
    rings.

    From the identity at the cloud's mean, the template scaled by the largest extents; points match
    in xyz + label.
    """
    device, b = scene.device, len(object_index)
    o = object_index.contiguous()
    points, extent, mean = _clouds(scene)
    templates = _templates(device)
    which = (role == WRAP).any(1).to(torch.int32)
    scale = (extent[o.long()] / templates.extent[which.long()]).float()
    R = torch.zeros((b, 3, 3), dtype=torch.float64, device=device)
    p = torch.zeros((b, 3), dtype=torch.float64, device=device)
    handle = torch.zeros((b, 3), dtype=torch.float32, device=device)
    error = torch.zeros(b, dtype=torch.float64, device=device)
    steps = torch.zeros(b, dtype=torch.int32, device=device)
    result = Alignment(R, p, error, steps, scale, handle)
    if b == 0:
        return result
    role = role.contiguous()
    launch_trials(
        kernels.align,
        b,
        inputs={
            "points": points,
            "shape": templates.points,
            "shape_role": templates.role,
            "shape_first": templates.first,
            "label_m": label_m,
            "iterations": iterations,
            "tolerance": tolerance_m,
            "object": o,
            "which": which,
            "scale": scale,
            "start": mean[o.long()].contiguous(),
            "role": role,
        },
        outputs={"R": R, "p": p, "error": error, "steps": steps},
        device=device,
        chunk=1,
    )
    launch_trials(
        kernels.role_means,
        b,
        inputs={"points": points, "wanted": GRASP, "object": o, "role": role},
        outputs={"mean": handle},
        device=device,
        chunk=64,
    )
    return result


@dataclass(frozen=True)
class _Templates:
    """Both templates in one table: template t has rows first[t] .. first[t + 1] of `points` (m) and
    `role`."""

    points: wp.array
    role: wp.array
    first: wp.array
    extent: Float64[Tensor, " t"]  # largest of each, m


@lru_cache(maxsize=2)
def _templates(device: str) -> _Templates:
    """The handle and the rings, in the order that `which` counts them in."""
    both = (handle_template(), wrap_template())
    shapes, roles = [points for points, _ in both], [role for _, role in both]
    first = np.cumsum([0, *map(len, shapes)]).astype(np.int32)
    return _Templates(
        wp.array(np.concatenate(shapes).astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(np.concatenate(roles), dtype=wp.uint8, device=device),
        wp.array(first, dtype=wp.int32, device=device),
        torch.tensor(
            [float(np.ptp(t, axis=0).max()) for t in shapes], dtype=torch.float64, device=device
        ),
    )


@KeptWith
def _clouds(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Points (O, P, 3), largest extent (O,) float64 and mean (O, 3) of the objects' clouds."""
    points = np.stack([o.points for o in scene.objects]).astype(np.float32)
    each: Callable[[NDArray[np.float32]], Tensor] = lambda x: torch.from_numpy(x).to(scene.device)  # noqa: E731
    extent = np.ptp(points.astype(np.float64), axis=1).max(1)
    return each(points), each(extent), each(points.astype(np.float64).mean(1).astype(np.float32))
