"""What a simulator is asked and what it answers: the same for every engine."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.dynamics import Payload


@dataclass(frozen=True)
class Job:
    """n motions to simulate, longest first: row of the batch, payload, start, and how many samples each takes."""

    model: mujoco.MjModel
    law: Any  # Law of r2h_batch.kernels.reference
    tables: tuple[Any, Any, Any]  # path (B, W, 6), times (B, W), lengths (B,): Warp arrays on the engine's device
    rows: NDArray[np.int64]
    payloads: Sequence[Payload]
    start: NDArray[np.float64]  # (n, 6) rad, at rest
    samples: NDArray[np.int64]  # recorded after the start
    record_steps: int
    device: str


@dataclass(frozen=True)
class Samples:
    """n recorded motions, the start first; rows repeat their last sample. `valid` is False where the simulator failed."""

    q: NDArray[np.float32]  # (n, W, 6) rad
    acceleration: NDArray[np.float64]  # (n, 6) largest change of speed per step, rad/s^2
    valid: NDArray[np.bool_]

    @staticmethod
    def empty(job: Job) -> "Samples":
        """Room for a job's answer."""
        n = len(job.rows)
        q = np.full((n, int(job.samples.max(initial=0)) + 1, 6), np.nan, np.float32)
        return Samples(q, np.full((n, 6), np.nan), np.zeros(n, bool))
