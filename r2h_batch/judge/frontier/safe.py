"""Safe's smallest distances level by level: a GPU's form of kernels/judge/safe.py (docs/gpu.md). It runs
on a CPU too.

A level is one level of the bisection of all motions at once (kernels/frontier/safe_*.py). The last
postures come first, as they are mostly the nearest; then the segments, in blocks from the end on.
As many levels are launched as a bisection may have levels: nobody waits for the device. What comes
out is what one thread a trial finds, within the tolerance of both.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.judge.frontier import levels
from r2h_batch.kernels.frontier import queues, safe_queues
from r2h_batch.kernels.frontier.safe_bodies import safe_first_points, safe_links, safe_pieces
from r2h_batch.kernels.frontier.safe_faces import safe_corners, safe_faces, safe_hulls, safe_insides
from r2h_batch.kernels.frontier.safe_intervals import (
    queue_goals,
    queue_segments,
    safe_frames,
    safe_halves,
)
from r2h_batch.kernels.frontier.safe_pairs import face_distances, hull_distances
from r2h_batch.kernels.frontier.safe_settle import safe_witness, settle_faces
from r2h_batch.kernels.plan.bisection import MAX_LEVEL
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.kernels.robot.world import FIELDS
from r2h_batch.launch import launch_trials
from r2h_batch.launch.arguments import struct_of
from r2h_batch.scene.scene import BodyPoses, Scene

PER_ROW, PER_MOVED_ROW = 8, 40
"""Intervals that the queue has room for, for each motion as planned, and for each that was recorded
sample by sample."""
PER_INTERVAL = {"bodies": 18, "pieces": 5, "sets": 14, "faces": 12}
"""Room in the other queues."""


class SafeFrontier:
    """Levels over the motions `path` of `length` waypoints, one a trial; 0: none."""

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
        least = levels.LEAST if scene.device == "cpu" else levels.LEAST_CUDA
        self._tables = {
            "world": scene.world, "mesh": scene.hand_mesh, "bodies": body_poses.bodies, "cap": CLEARANCE_CAP_M,
            "tolerance": tolerance, "path": path.contiguous(), "length": length.contiguous(),
            **self._queues(max(per_row * self._rows, least)),
        }  # fmt: skip

    def _queues(self, n: int) -> dict[str, Any]:
        """Room for n intervals."""
        device, real, whole, long = self._device, torch.float32, torch.int32, torch.int64

        def room(rows: int, kinds: dict[str, Any], **shapes: tuple[int, ...]) -> dict[str, Tensor]:
            return {
                name: torch.empty((rows, *shapes.get(name, ())), dtype=kind, device=device)
                for name, kind in kinds.items()
            }

        interval = dict.fromkeys(("trial", "segment", "part", "level", "index"), whole) | {
            "look": long
        }
        self._intervals = [struct_of(safe_queues.Moments, room(n, interval)) for _ in range(2)]
        self._counts = torch.zeros(int(queues.COUNTS), dtype=whole, device=device)
        body = dict.fromkeys(("interval", "body", "waits", "meets"), whole)
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
        more = {name: k * n for name, k in PER_INTERVAL.items()}
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
        self._launch(queue_goals, self._rows, {"queue": self._intervals[0]})
        self._level(0, goal=True)
        segments = int(safe_queues.SEGMENTS)
        for block in reversed(range(-(-(self._width - 1) // segments))):
            self._note_full()
            self._launch(
                queue_segments,
                self._rows * segments,
                {"block": block, "queue": self._intervals[0]},
            )
            for level in range(MAX_LEVEL):
                if self._device == "cpu" and not int(self._counts[level & 1]):
                    break  # asking a GPU would wait for it; its empty levels take next to nothing
                self._level(level & 1)
        self._note_full()
        self._launch(safe_witness, self._rows, {}, outputs)

    def rows_where(self, mask: Bool[Tensor, " b"]) -> Int32[Tensor, " r"]:
        """Numbers of the rows that `mask` has, for one wait; MemoryError when a queue was too
        short."""
        return levels.rows_where(mask, self._full)

    def _note_full(self) -> None:
        """Keeps in mind that a queue was too short; empties all."""
        self._full |= self._counts[queues.FULL : queues.FULL + 1]
        self._counts.zero_()

    def _level(self, parity: int, *, goal: bool = False) -> None:
        lanes = levels.LANES if self._device == "cpu" else levels.CUDA_LANES
        now, later = self._intervals[parity], self._intervals[1 - parity]
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
