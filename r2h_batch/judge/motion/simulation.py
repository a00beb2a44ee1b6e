"""Input and output of a simulator, the same for every engine."""

import ctypes
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, wraps
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
    contacts: bool = True  # False: nothing touches, and MuJoCo C need not look for it


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


Context = Callable[[], AbstractContextManager[None]]


def _shared(context: Context) -> Context:
    """The context, entered by the first thread that needs it and left by the last."""
    lock, entered, inside = threading.Lock(), ExitStack(), 0

    @contextmanager
    @wraps(context)
    def shared() -> Iterator[None]:
        nonlocal inside
        with lock:
            if inside == 0:
                entered.enter_context(context())
            inside += 1
        try:
            yield
        finally:
            with lock:
                inside -= 1
                if inside == 0:
                    entered.close()

    return shared


@_shared
@contextmanager
def warnings_unwritten() -> Iterator[None]:
    """While it lasts, MuJoCo writes no MUJOCO_LOG.TXT into the working directory: what it warns of
    is in the states.

    A handler that the user has set stays in charge.
    """
    if mujoco.get_mju_user_warning() is not None:
        yield
        return
    mujoco.set_mju_user_warning(_say_nothing)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def _say_nothing(message: str) -> None:
    pass


@_shared
@contextmanager
def clock_unread() -> Iterator[None]:
    """While it lasts, MuJoCo's steps read no clock for `MjData.timer`: they would twenty times or
    more, a seventh of the time of the arm alone. A clock that the user has set stays in charge."""
    clock = _clock()
    if clock is None or mujoco.get_mjcb_time() is not None:
        yield
        return
    before, clock.value = clock.value, None
    try:
        yield
    finally:
        clock.value = before


@cache
def _clock() -> ctypes.c_void_p | None:
    """The C library's `mjcb_time`, which Python can set to other clocks but not to none. None where
    the library does not show it."""
    bindings = sys.modules[mujoco.mj_step.__module__].__file__
    try:
        return ctypes.c_void_p.in_dll(ctypes.CDLL(bindings), "mjcb_time")
    except (OSError, ValueError):
        return None
