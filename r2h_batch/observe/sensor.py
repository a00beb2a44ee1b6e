"""Errors of what cameras measure: depth, masks, and where the cameras are believed to stand."""

import math
from typing import Any, Literal, get_args

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Int32, Int64, UInt8
from torch import Tensor

from r2h_batch.base import rng
from r2h_batch.base.launch import over_trials
from r2h_batch.kernels.observe import sensor as kernels
from r2h_batch.observe.rig import Rig
from r2h_batch.observe.seen import LABELS
from r2h_batch.trials.noise import perturbed, trial_ids

Masks = Literal["exact", "eroded", "grown", "missed"]
"""Errors of labels: none; masks of object and hand shrink or grow by `Sensor.mask_px`; a share of them is not there."""
MASKS: tuple[Masks, ...] = get_args(Masks)
MOST_NOISE = 5.0
"""Largest factor on a sensor's errors: flying pixels fill the edges at 2.3."""
_MOST_LATERAL = 3.47  # the kernel's normal number of two words is at most this
_PLACE = 0  # purpose of the random counters of calibration


class Errors:
    """The errors of a rig's cameras in a run: a pixel, a mask or a camera of a trial has the same in any batch and order.

    Args:
        rig: cameras and their sensor.
        noise: factor on its errors but the masks'; 0: none.
        labels: errors of masks.
        seed: of the run.
        device: where images are.
    """

    def __init__(self, rig: Rig, *, noise: float, labels: Masks, seed: int, device: str) -> None:
        self.rig, self.noise, self.labels, self.seed, self.device = rig, noise, labels, seed, device
        own: Any = kernels.Sensor()
        sensor = rig.sensor
        own.stereo = noise * sensor.disparity_px / (rig.focal_px * sensor.baseline_m)
        own.stereo_px = sensor.disparity_side_px
        own.lateral = noise * sensor.lateral_px
        own.reach = max(1, math.floor(own.lateral * _MOST_LATERAL + 0.5))
        own.edge = sensor.edge_m
        own.edge_lost, own.flying, own.lost = (
            min(1.0, noise * share) for share in (sensor.edge_lost, sensor.edge_flying, sensor.lost)
        )
        own.facing = math.cos(math.radians(sensor.steepest_deg))
        own.rounding = sensor.step_m
        self._sensor = own
        words = [rng.key_of(f"sensor {seed} {c.name}") for c in rig.cameras]
        self._keys = torch.from_numpy(np.array(words, np.uint32).view(np.int32)).to(device)

    def measured(
        self,
        trial_id: Int64[Tensor, " n"],
        corner_px: Int32[Tensor, "n c 2"],
        depth_m: Float32[Tensor, "n c h w"],
        facing: Float32[Tensor, "n c h w"],
    ) -> Float32[Tensor, "n c h w"]:
        """The depths that the cameras measure, m; 0: nothing.

        Args:
            trial_id: of N trials.
            corner_px: (N, C, 2) int32, column and row of each window's first pixel on the sensor.
            depth_m: (N, C, H, W) float32 exact depth, m.
            facing: (N, C, H, W) float32 |cosine| of the ray's angle to the surface's normal.
        """
        if self.noise == 0:
            return depth_m
        n, cameras, rows, columns = depth_m.shape
        pixels = cameras * rows * columns
        several = self._several(columns)
        run = over_trials(
            kernels.measure,
            n,
            self.device,
            sizes={"depth": pixels},
            width=pixels // several,
            chunk=1,
        )
        made = run(
            several=several, cameras=cameras, columns=columns, rows=rows, width=self.rig.width, sensor=self._sensor,
            key=self._keys, trial=trial_id.contiguous(), corner=corner_px.contiguous(),
            exact=depth_m.reshape(n, pixels).contiguous(), facing=facing.reshape(n, pixels).contiguous(),
        )  # fmt: skip
        found: Tensor = made["depth"].view(depth_m.shape)
        return found

    def masked(
        self, trial_id: Int64[Tensor, " n"], label: UInt8[Tensor, "n c h w"]
    ) -> UInt8[Tensor, "n c h w"]:
        """Labels with the masks' errors.

        Args:
            trial_id: of N trials.
            label: (N, C, H, W) uint8, what each pixel shows.
        """
        if self.labels == "exact":
            return label
        n, cameras, rows, columns = label.shape
        pixels = cameras * rows * columns
        by = {"eroded": -1, "grown": 1}.get(self.labels, 0) * self.rig.sensor.mask_px
        several = self._several(columns)
        run = over_trials(
            kernels.segment,
            n,
            self.device,
            sizes={"label": pixels},
            width=pixels // several,
            chunk=1,
        )
        made = run(
            several=several, cameras=cameras, columns=columns, rows=rows, grown=by,
            missed=self.rig.sensor.mask_missed if self.labels == "missed" else 0.0,
            things=wp.vec2i(*map(LABELS.index, ("object", "hand"))),
            key=self._keys, trial=trial_id.contiguous(), exact=label.reshape(n, pixels).contiguous(),
        )  # fmt: skip
        found: Tensor = made["label"].view(label.shape)
        return found

    def _several(self, columns: int) -> int:
        """Pixels of a thread: on a CPU a row, whose neighbours share most of what they read and draw."""
        return columns if self.device == "cpu" else 1

    def believed(self, trial_id: Int64[Tensor, " n"]) -> Float32[Tensor, "n c 4 4"]:
        """T_world_camera that a method is told, m: each camera turned about its centre, then shifted, along its own axes.

        Drawn by (seed, camera, trial), as if each trial were in a newly calibrated cell.

        Args:
            trial_id: of N trials.
        """
        ids, sensor = trial_ids(trial_id), self.rig.sensor
        T = self.rig.T_world_camera
        nowhere = torch.zeros((len(ids), 3), dtype=torch.float32, device="cpu")
        found = [
            perturbed(
                T[c].expand(len(ids), 4, 4), nowhere, ids, rng.key_of(f"calibration {self.seed} {camera.name}"),
                purpose=_PLACE, rotation_deg=self.noise * sensor.calibration_deg,
                translation_m=self.noise * sensor.calibration_m,
            )
            for c, camera in enumerate(self.rig.cameras)
        ]  # fmt: skip
        return torch.stack(found, 1).to(self.device)
