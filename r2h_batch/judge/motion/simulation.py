"""Input and output of a simulator, the same for every engine."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from r2h_batch.kernels.motion.worlds import WINDOW
from r2h_batch.scene.model import SceneModel, TrialScenes


@dataclass(frozen=True)
class Job:
    """n motions to simulate, longest first: row of the batch, trial, start, and how many samples
    each takes."""

    scene: SceneModel
    law: Any  # Law of r2h_batch.kernels.motion.time_law
    # path (B, W, J), times (B, W), lengths (B,): Warp arrays on the engine's device
    tables: tuple[Any, Any, Any]
    rows: NDArray[np.int64]
    trials: TrialScenes
    start: NDArray[np.float64]  # (n, J) rad, at rest
    samples: NDArray[np.int64]  # recorded after the start
    record_steps: int
    device: str
    motion_radii: NDArray[np.float64]  # (bodies, J) m a radian, of all points of the robot


@dataclass(frozen=True)
class Samples:
    """n recorded motions, the start first; rows repeat their last sample. `valid` is False where
    the simulator failed."""

    q: NDArray[np.float32]  # (n, W, J) rad
    acceleration: NDArray[np.float64]  # (n, J) largest change of speed per step, rad/s^2
    # (n,) how far any point of the fingers was from where their opening has it, at any step
    sway_m: NDArray[np.float64]
    # of K windows of WINDOW segments (0 beyond a trial's end): (n, K) the largest acceleration of
    # any point of the robot, at most, m/s^2; (n, K, 3) `SceneModel.fingers`, 0 for the arm alone
    bend: NDArray[np.float64]
    fingers: NDArray[np.float64]
    valid: NDArray[np.bool_]
    failed_state: NDArray[np.float64]
    """(n, nq + nv) qpos and qvel as last seen before the simulator failed; NaN where it did not"""

    @staticmethod
    def empty(job: Job) -> "Samples":
        """Room for a job's answer."""
        (n, joints), model = job.start.shape, job.scene.model
        samples = int(job.samples.max(initial=0))
        q = np.full((n, samples + 1, joints), np.nan, np.float32)
        windows = (n, -(-samples // int(WINDOW)))
        state = np.full((n, model.nq + model.nv), np.nan)
        return Samples(
            q, np.full((n, joints), np.nan), np.full(n, np.nan), np.zeros(windows),
            np.zeros((*windows, 3)), np.zeros(n, bool), state,
        )  # fmt: skip


_lock = threading.Lock()
_quiet = 0
_before: Any = None


@contextmanager
def warnings_unwritten() -> Iterator[None]:
    """While it lasts, MuJoCo writes no MUJOCO_LOG.TXT into the working directory: what it warns of
    is in the states.

    A handler that the user has set stays in charge.
    """
    global _quiet, _before
    with _lock:
        if _quiet == 0:
            _before = mujoco.get_mju_user_warning()
            if _before is None:
                mujoco.set_mju_user_warning(_say_nothing)
        _quiet += 1
    try:
        yield
    finally:
        with _lock:
            _quiet -= 1
            if _quiet == 0 and _before is None:
                mujoco.set_mju_user_warning(None)


def _say_nothing(message: str) -> None:
    pass
