"""An object's voxel grid as depth cameras see it: a contact network never sees the far side.

A voxel is full unless some camera looks through it: cameras carve the box of the grid, so what is
hidden stays full. The box itself is known, as from a silhouette. Cameras stand around the object as
it lies in its own frame, z up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float64
from numpy.typing import NDArray

from r2h_batch.base import rng
from r2h_batch.base.launch import launch_trials
from r2h_batch.kernels.methods import approach_hit
from r2h_batch.scene.objects import VOXELS
from r2h_batch.scene.scene import Scene
from r2h_batch.trials.noise import normals

DISTANCE_M = 0.6
"""From a camera to the middle of the grid [choice]: depth cameras measure from 0.4 m."""
ELEVATION_DEG = (30.0, 60.0)
"""Above the horizontal [choice]."""
PIXEL = 2.0 / 525.0
"""Tangent between two rays: every second pixel of a camera with a focal length of 525 pixels."""
DRAWS = 8
"""Sets of cameras for each object; a trial has one of them."""
_PLACE, _NOISE, _LOST, _EXTRINSIC = 0, 1, 2, 3  # purposes of the random counters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthView:
    """Cameras and their errors.

    Attributes:
        cameras: how many, evenly spread around the object; 0: the whole solid is seen.
        noise: factor on the axial noise of a structured-light camera (Nguyen et al. 2012).
        lost: share of pixels without a depth.
        camera_m: standard deviation of where a camera is thought to be, per axis, m.
        camera_deg: of how it is thought to be turned, per axis, degrees.
    """

    cameras: int = 0
    noise: float = 1.0
    lost: float = 0.0
    camera_m: float = 0.0
    camera_deg: float = 0.0

    def __post_init__(self) -> None:
        bounds = {"cameras": 8, "noise": 10, "lost": 1, "camera_m": 0.1, "camera_deg": 20}
        for name, most in bounds.items():
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be 0 to {most}")


def axial_noise_m(z: Array) -> Array:
    """Standard deviation of a depth z (m), m: 0.0012 + 0.0019 (z - 0.4)^2.

    Nguyen, Izadi and Lovell 2012, "Modeling Kinect sensor noise for improved 3D reconstruction and
    tracking", eq. 4.
    """
    return 0.0012 + 0.0019 * (z - 0.4) ** 2


def carved(
    scene: Scene, row: int, view: DepthView, draw: int, seed: int
) -> Bool[NDArray[np.bool_], "64 64 64"]:
    """Voxels of an object that no camera looks through.

    Args:
        scene: its objects.
        row: the object's row in `Scene.objects`.
        view: the cameras.
        draw: number of the set of cameras, 0 to `DRAWS` - 1.
        seed: of the sweep.
    """
    from scipy.ndimage import minimum_filter  # 0.3 s

    model = scene.objects[row]
    key = rng.key_of(f"depth view {seed} {model.name}")
    steps = np.arange(VOXELS) + 0.5
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    voxels = model.voxel_origin + grid * model.voxel_pitch
    middle = model.voxel_origin + 0.5 * VOXELS * model.voxel_pitch
    half = int(np.ceil(np.sqrt(0.75) * VOXELS * model.voxel_pitch / DISTANCE_M / PIXEL)) + 2
    full = np.ones(len(voxels), bool)
    for camera in range(view.cameras):
        number = draw * 8 + camera
        T = _camera(middle, number, view, key)
        depth = _depth(scene, row, T, half)
        pixels = np.arange(depth.size, dtype=np.int64) + (number << 32)
        (z,) = normals(key, pixels, 1, purpose=_NOISE)
        (u,) = rng.uniforms(key, pixels, 1, purpose=_LOST)
        known = np.isfinite(depth).ravel()
        measured = np.where(known, depth.ravel(), np.inf)
        measured[known] += view.noise * axial_noise_m(measured[known]) * z[known]
        lost = (u < view.lost).reshape(depth.shape)
        # a pixel is as wide as a voxel: a ray carves where its neighbours pass too. Where all nine are lost,
        # nothing is known
        near = minimum_filter(np.where(lost, np.inf, measured.reshape(depth.shape)), 3)
        near[minimum_filter(lost, 3)] = 0.0
        believed = T @ _extrinsic(number, view, key)
        local = (voxels - believed[:3, 3]) @ believed[:3, :3]
        i, j = (np.rint(local[:, a] / local[:, 2] / PIXEL).astype(np.int64) + half for a in (0, 1))
        inside = (np.minimum(i, j) >= 0) & (np.maximum(i, j) < len(depth))
        seen = near[np.where(inside, i, 0), np.where(inside, j, 0)]
        # a voxel that holds the surface stays: half its diagonal, and three deviations of the depth
        slack = np.sqrt(0.75) * model.voxel_pitch + 3.0 * view.noise * axial_noise_m(local[:, 2])
        full &= ~inside | (local[:, 2] >= seen - slack)
    return full.reshape(VOXELS, VOXELS, VOXELS)


def _camera(middle: Array, number: int, view: DepthView, key: tuple[int, int]) -> Array:
    """(4, 4) pose T_obj_camera: z looks at the middle, x is level."""
    first = np.array(
        [number - number % 8], np.int64
    )  # cameras of a draw share their first direction
    azimuth, up = rng.uniforms(key, first, 2, purpose=_PLACE)[:, 0]
    angle = 2.0 * np.pi * (azimuth + (number % 8) / view.cameras)
    low, high = np.radians(ELEVATION_DEG)
    elevation = low + (high - low) * up
    outwards = np.array(
        [np.cos(elevation) * np.cos(angle), np.cos(elevation) * np.sin(angle), np.sin(elevation)]
    )
    z, x = -outwards, np.array([-np.sin(angle), np.cos(angle), 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    T[:3, 3] = middle + DISTANCE_M * outwards
    return T


def _extrinsic(number: int, view: DepthView, key: tuple[int, int]) -> Array:
    """(4, 4) error of the calibration, in the camera's frame."""
    z = normals(key, np.array([number], np.int64), 6, purpose=_EXTRINSIC)[:, 0]
    turn = np.radians(view.camera_deg) * z[:3]
    angle = np.linalg.norm(turn)
    T = np.eye(4)
    if angle > 0:
        a, b, c = turn / angle
        K = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        T[:3, :3] += np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    T[:3, 3] = view.camera_m * z[3:]
    return T


def _depth(
    scene: Scene, row: int, T_obj_camera: Array, half: int
) -> Float64[NDArray[np.float64], "n n"]:
    """Depth along the camera's z, m, of (2 half + 1)^2 pixels; inf where the object is not."""
    side = np.arange(-half, half + 1) * PIXEL
    x, y = np.meshgrid(side, side, indexing="ij")
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ T_obj_camera[:3, :3].T
    T = np.zeros((len(rays), 4, 4), np.float32)  # the kernel reads z and the origin
    T[:, :3, 2], T[:, :3, 3] = unit, T_obj_camera[:3, 3]
    device = scene.device
    face = torch.empty(len(rays), dtype=torch.int32, device=device)
    launch_trials(
        approach_hit.approach_hits,
        len(rays),
        inputs={
            "back_off": 0.0,
            "cutoff": 2.0 * DISTANCE_M,
            "mesh": scene.object_mesh_ids,
            "object": torch.full((len(rays),), row, dtype=torch.int32, device=device),
            "T_obj_ee": torch.from_numpy(T).to(device),
        },
        outputs={"face": face},
        device=device,
        chunk=1024,
    )
    hit = face.cpu().numpy()
    model = scene.objects[row]
    corners = model.vertices[model.faces[np.maximum(hit, 0)]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    # the plane of the face that was met: n . (start + z ray) = n . corner, and the ray has length 1 along z
    ray = rays @ T_obj_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        z = ((corners[:, 0] - T_obj_camera[:3, 3]) * normal).sum(1) / (ray * normal).sum(1)
    return np.where((hit >= 0) & np.isfinite(z), z, np.inf).reshape(x.shape)
