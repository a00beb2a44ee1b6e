"""Safe's smallest distances level by level: a GPU's form of kernels/judge/safe.py (docs/gpu.md). It runs
on a CPU too.

A level is one level of the bisection of all motions at once (kernels/frontier/safe_*.py). The last
postures come first, as they are mostly the nearest; then the segments, in blocks from the end on.
As many levels are launched as a bisection may have levels: the host does not wait for the device. What comes
out is what one thread a trial finds, within the tolerance of both.
"""

from typing import Any

from jaxtyping import Float32, Int32
from torch import Tensor

from r2h_batch.config import CLEARANCE_CAP_M
from r2h_batch.judge.frontier import levels
from r2h_batch.kernels.frontier import safe_queues
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
from r2h_batch.kernels.geometry.bisection import MAX_LEVEL
from r2h_batch.kernels.plan.codes import WAYPOINTS
from r2h_batch.scene.scene import BodyPoses, Scene

PER_ROW, PER_MOVED_ROW = 8, 40
"""Intervals that the queue has room for, for each motion as planned, and for each that was recorded
sample by sample."""
PER_INTERVAL = {"bodies": 18, "pieces": 5, "sets": 14, "faces": 12}
"""Room in the other queues."""


class SafeFrontier(levels.Levels):
    """Levels over the motions `path` of `length` waypoints, one a trial; 0: none."""

    def __init__(
        self,
        scene: Scene,
        body_poses: BodyPoses,
        path: Float32[Tensor, "b w 6"],
        length: Int32[Tensor, " b"],
        tolerance: float,
    ) -> None:
        tables = {
            "world": scene.world, "mesh": scene.hand_mesh, "bodies": body_poses.bodies, "cap": CLEARANCE_CAP_M,
            "tolerance": tolerance, "path": path.contiguous(), "length": length.contiguous(),
        }  # fmt: skip
        super().__init__(tables, scene.device)
        self._rows, self._width = len(length), path.shape[1]
        per_row = PER_ROW if self._width <= WAYPOINTS else PER_MOVED_ROW
        self.tables |= self._queues(max(per_row * self._rows, levels.LEAST))

    def _queues(self, n: int) -> dict[str, Any]:
        """Room for n intervals."""
        self._intervals = [self.new(safe_queues.Moments, n) for _ in range(2)]
        return {
            "nearest": self.new(safe_queues.Nearest, self._rows),
            "frames": self.new_frames(n),
            "body_queue": self.new(safe_queues.BodyQueue, PER_INTERVAL["bodies"] * n),
            "pieces": self.new(safe_queues.Pieces, PER_INTERVAL["pieces"] * n),
            "sets": self.new(safe_queues.Sets, PER_INTERVAL["sets"] * n),
            "faces": self.new(safe_queues.Faces, PER_INTERVAL["faces"] * n),
        }

    def __call__(self, outputs: dict[str, Tensor]) -> None:
        """Writes what kernels/judge/safe.py writes, in rows with a motion."""
        self.clear()
        self.launch(queue_goals, self._rows, {"queue": self._intervals[0]})
        self._level(0, goal=True)
        segments = int(safe_queues.SEGMENTS)
        for block in reversed(range(-(-(self._width - 1) // segments))):
            self.note_full()
            self.clear()
            queued = {"block": block, "queue": self._intervals[0]}
            self.launch(queue_segments, self._rows * segments, queued)
            for level in range(MAX_LEVEL):
                if self.device == "cpu" and not int(self.counts[level & 1]):
                    break  # asking a GPU would wait for it; its empty levels take next to nothing
                self._level(level & 1)
        self.note_full()
        self.launch(safe_witness, self._rows, outputs=outputs)

    def _level(self, parity: int, *, goal: bool = False) -> None:
        now, later = self._intervals[parity], self._intervals[1 - parity]
        self.tables |= {"lanes": self.lanes, "queue": now, "parity": parity, "later": later}
        bodies = (safe_first_points, safe_pieces) if goal else (safe_pieces,)
        for kernel in (
            safe_frames, safe_links, *bodies, hull_distances, safe_hulls, safe_corners, safe_faces,
            face_distances, safe_insides, settle_faces, safe_halves,
        ):  # fmt: skip
            self.launch(kernel, self.lanes)
