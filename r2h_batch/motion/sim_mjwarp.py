"""Motion in batched MuJoCo-Warp worlds: one captured graph, worlds refilled from a queue until it
is empty."""

import logging
import threading

import numpy as np

from r2h_batch.kernels.motion.worlds import OVERFLOW
from r2h_batch.motion.simulation import Job, Samples, warnings_unwritten
from r2h_batch.motion.standing import Run, forget_worlds, standing_worlds

ON_CPU = False
"""The engine reads its tables on the scene's device."""

MAX_WORLDS = {"cpu": 64, "cuda": 4096}
"""More are no faster on a CPU, and fewer are refilled more often."""
TRIES = 3
NJMAX, NACON_PER_WORLD = 32, 16
"""First size of the buffers: constraints per world (7 of the linkage; joint limits, 4 per contact),
and contacts, of which all worlds have one pool that also takes the pairs that are near. Every
further try has four times as much."""

_log = logging.getLogger(__name__)
_one_at_a_time = (
    threading.Lock()
)  # on a CPU, mjw.step in two threads at once crashes (shared tile storage)


def simulate(job: Job, *, threads: int | None = None) -> Samples:
    """Recorded motion of the job's trials. What overflowed a buffer runs again in larger ones; then
    it is not valid."""
    out = Samples.empty(job)
    todo = np.arange(len(job.rows))
    with _one_at_a_time, warnings_unwritten():
        for turn in range(TRIES):
            if not len(todo):
                break
            run = _run_in_memory(job, todo, NJMAX * 4**turn, NACON_PER_WORLD * 4**turn)
            out.q[todo, : run.q.shape[1]], out.acceleration[todo], out.sway_m[todo] = (
                run.q,
                run.acceleration,
                run.sway,
            )
            finite = (
                np.isfinite(run.q).all((1, 2))
                & np.isfinite(run.acceleration).all(1)
                & np.isfinite(run.sway)
            )
            out.valid[todo] = (run.failed == 0) & finite
            out.failed_state[todo] = np.where(out.valid[todo][:, None], np.nan, run.state)
            todo = todo[run.failed & OVERFLOW != 0]
    return out


def _run_in_memory(job: Job, todo: np.ndarray, njmax: int, nacon_per_world: int) -> Run:
    """`_run` in as many worlds as the device has memory for: half as many whenever it says that it
    has not."""
    worlds = _worlds_for(len(todo), job.device)
    while True:
        try:
            return _run(job, todo, worlds, njmax, nacon_per_world * worlds)
        except RuntimeError as error:
            if worlds == 1 or "allocate" not in str(error).lower():
                raise
            worlds //= 2
            _log.warning("out of device memory: going on with %d worlds", worlds)


def _worlds_for(n: int, device: str) -> int:
    """How many worlds n trials get: a power of four, so that the next batch finds worlds that
    stand.

    A world without a trial takes as long as the others on a CPU: rather fewer than n, and they are
    refilled.
    """
    kind = "cpu" if device == "cpu" else "cuda"
    power = (n.bit_length() - 1) // 2 if kind == "cpu" else ((n - 1).bit_length() + 1) // 2
    return min(4**power, MAX_WORLDS[kind])


def _run(job: Job, todo: np.ndarray, nworld: int, njmax: int, naconmax: int) -> Run:
    """What the trials at places `todo` of the job do in `nworld` worlds, and what went wrong
    (OVERFLOW, NOT_FINITE)."""
    try:
        return standing_worlds(job, nworld, njmax, naconmax).run(job, todo)
    except BaseException:
        forget_worlds()  # what went wrong in them may last, and if it was memory others need it
        raise
