"""Safe's smallest distances in waves: a GPU's form of kernels/judge/safe.py (docs/gpu.md). It runs
on a CPU too.

A wave is one level of the bisection of all motions at once (kernels/wave/safe_*.py). The last
postures come first, as they are mostly the nearest; then the segments, in blocks from the end on.
As many waves are launched as a bisection may have levels: nobody waits for the device. What comes
out is what one thread a trial finds, within the tolerance of both.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.judge.wave import waves
from r2h_batch.kernels.plan.bisection import MAX_LEVEL
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.kernels.robot.world import FIELDS
from r2h_batch.kernels.wave import queues, safe_queues
from r2h_batch.kernels.wave.safe_bodies import safe_first_points, safe_links, safe_pieces
from r2h_batch.kernels.wave.safe_faces import safe_corners, safe_faces, safe_hulls, safe_insides
from r2h_batch.kernels.wave.safe_pairs import face_distances, hull_distances
from r2h_batch.kernels.wave.safe_settle import safe_witness, settle_faces
from r2h_batch.kernels.wave.safe_stretches import (
    queue_goals,
    queue_segments,
    safe_frames,
    safe_halves,
)
from r2h_batch.launch import launch_trials
from r2h_batch.launch.arguments import struct_of
from r2h_batch.scene.scene import BodyPoses, Scene

PER_ROW, PER_MOVED_ROW = 8, 40
"""Stretches that the queue has room for, for each motion as planned, and for each that was recorded
sample by sample."""
PER_STRETCH = {"bodies": 18, "pieces": 5, "sets": 14, "faces": 12}
"""Room in the other queues."""


class SafeWaves:
    """Waves over the motions `path` of `length` waypoints, one a trial; 0: none."""

    def __init__(
        self,
        scene: Scene,
        body_poses: BodyPoses,
        path: Float32[Tensor, "b w 6"],
        length: Int32[Tensor, " b"],
        tolerance: float,
    ) -> None:
        self._device, self._rows, self._width = scene.device, len(length), path.shape[1]
        self._full = torch.zeros(1, dtype=torch.int32, device=scene.device)
        per_row = PER_ROW if self._width <= WAYPOINTS else PER_MOVED_ROW
        least = waves.LEAST if scene.device == "cpu" else waves.LEAST_CUDA
        self._tables = {
            "world": scene.world, "mesh": scene.hand_mesh, "bodies": body_poses.bodies, "cap": CLEARANCE_CAP_M,
            "tolerance": tolerance, "path": path.contiguous(), "length": length.contiguous(),
            **self._queues(max(per_row * self._rows, least)),
        }  # fmt: skip

    def _queues(self, n: int) -> dict[str, Any]:
        """Room for n stretches."""
        device, real, whole, long = self._device, torch.float32, torch.int32, torch.int64

        def room(rows: int, kinds: dict[str, Any], **shapes: tuple[int, ...]) -> dict[str, Tensor]:
            return {
                name: torch.empty((rows, *shapes.get(name, ())), dtype=kind, device=device)
                for name, kind in kinds.items()
            }

        stretch = dict.fromkeys(("trial", "segment", "part", "level", "index"), whole) | {
            "look": long
        }
        self._stretches = [struct_of(safe_queues.Moments, room(n, stretch)) for _ in range(2)]
        self._counts = torch.zeros(int(queues.COUNTS), dtype=whole, device=device)
        body = dict.fromkeys(("stretch", "body", "waits", "meets"), whole)
        body |= dict.fromkeys(("R", "p", "travel", "known", "nearest"), real)
        piece = dict.fromkeys(("of", "piece", "meets", "steps"), whole) | dict.fromkeys(
            ("lower", "v"), real
        )
        of_set = dict.fromkeys(("of", "first", "last"), whole) | dict.fromkeys(
            ("n", "beyond"), real
        )
        face = dict.fromkeys(("of", "face", "steps"), whole) | dict.fromkeys(
            ("known", "value", "v"), real
        )
        frame = {"open": long} | dict.fromkeys(("d", "R", "p", "w", "v"), real)
        nearest = {"distance": real, "above": real, "place": long}
        more = {name: k * n for name, k in PER_STRETCH.items()}
        made = {
            "nearest": (safe_queues.Nearest, room(self._rows, nearest)),
            "frames": (
                queues.Frames,
                room(
                    n, frame, open=(3,), d=(6,), R=(7, 3, 3), p=(7, 3), w=(FIELDS, 3), v=(FIELDS, 3)
                ),
            ),
            "queue_bodies": (safe_queues.Bodies, room(more["bodies"], body, R=(3, 3), p=(3,))),
            "pieces": (safe_queues.Pieces, room(more["pieces"], piece, v=(3,))),
            "sets": (safe_queues.Sets, room(more["sets"], of_set, n=(3,))),
            "faces": (safe_queues.Faces, room(more["faces"], face, v=(3,))),
            "counts": (queues.Counts, {"n": self._counts}),
        }
        return {name: struct_of(kind, tensors) for name, (kind, tensors) in made.items()}

    def __call__(self, outputs: dict[str, Tensor]) -> None:
        """Writes what kernels/judge/safe.py writes, in rows with a motion."""
        self._counts.zero_()
        self._launch(queue_goals, self._rows, {"queue": self._stretches[0]})
        self._wave(0, goal=True)
        segments = int(safe_queues.SEGMENTS)
        for block in reversed(range(-(-(self._width - 1) // segments))):
            self._note_full()
            self._launch(
                queue_segments, self._rows * segments, {"block": block, "queue": self._stretches[0]}
            )
            for level in range(MAX_LEVEL):
                if self._device == "cpu" and not int(self._counts[level & 1]):
                    break  # asking a GPU would wait for it; its empty waves take next to nothing
                self._wave(level & 1)
        self._note_full()
        self._launch(safe_witness, self._rows, {}, outputs)

    def rows_where(self, mask: Bool[Tensor, " b"]) -> Int32[Tensor, " r"]:
        """Numbers of the rows that `mask` has, for one wait; MemoryError when a queue was too
        short."""
        return waves.rows_where(mask, self._full)

    def _note_full(self) -> None:
        """Keeps in mind that a queue was too short; empties all."""
        self._full |= self._counts[queues.FULL : queues.FULL + 1]
        self._counts.zero_()

    def _wave(self, parity: int, *, goal: bool = False) -> None:
        lanes = waves.LANES if self._device == "cpu" else waves.CUDA_LANES
        now, later = self._stretches[parity], self._stretches[1 - parity]
        asked = {"lanes": lanes, "queue": now, "parity": parity, "later": later}
        bodies = (safe_first_points, safe_pieces) if goal else (safe_pieces,)
        for kernel in (
            safe_frames, safe_links, *bodies, hull_distances, safe_hulls, safe_corners, safe_faces,
            face_distances, safe_insides, settle_faces, safe_halves,
        ):  # fmt: skip
            self._launch(kernel, lanes, asked)

    def _launch(
        self, kernel: Any, n: int, inputs: dict[str, Any], outputs: dict[str, Tensor] | None = None
    ) -> None:
        """With what the kernel takes of all there is; on a CPU one thread, as its additions are not
        atomic."""
        taken = {a.label.removesuffix("_in") for a in kernel.adj.args}
        inputs = {k: v for k, v in (self._tables | inputs).items() if k in taken}
        launch_trials(
            kernel,
            n,
            inputs=inputs,
            outputs=outputs or {},
            device=self._device,
            threads=1,
            uneven=True,
        )
