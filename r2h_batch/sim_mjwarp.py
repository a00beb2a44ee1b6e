"""Motion in batched MuJoCo-Warp worlds: one captured graph, worlds refilled from a queue until it is empty."""

import copy
import logging
import threading

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from r2h_batch.dynamics import load
from r2h_batch.kernels.worlds import OVERFLOW, Fields, Queue, Worlds, command_worlds, finish_step, start_worlds
from r2h_batch.simulation import Job, Samples

MAX_WORLDS = {"cpu": 64, "cuda": 4096}
"""More are no faster on a CPU, and fewer are refilled more often."""
POLL = 32
"""Graph launches between two looks at how many trials are left."""

TRIES = 3
NJMAX, NACONMAX = 8, 8
"""First size of the buffers (constraints per world, contacts of all worlds): six joint limits are all there can be.
Every further try has four times as much."""

BATCHED = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "body_subtreemass", "dof_invweight0",
)  # fmt: skip

_log = logging.getLogger(__name__)
_one_at_a_time = threading.Lock()  # on a CPU, mjw.step in two threads at once crashes (shared tile storage)


def simulate(job: Job, *, threads: int | None = None) -> Samples:
    """Recorded motion of the job's trials. What overflowed a buffer runs again in larger ones; then it is not valid."""
    out = Samples.empty(job)
    todo = np.arange(len(job.rows))
    with _one_at_a_time:
        for turn in range(TRIES):
            if not len(todo):
                break
            q, acceleration, failed = _run_in_memory(job, todo, NJMAX * 4**turn, NACONMAX * 4**turn)
            out.q[todo, : q.shape[1]], out.acceleration[todo] = q, acceleration
            out.valid[todo] = (failed == 0) & np.isfinite(q).all((1, 2)) & np.isfinite(acceleration).all(1)
            todo = todo[failed & OVERFLOW != 0]
    return out


def _run_in_memory(job: Job, todo: np.ndarray, njmax: int, naconmax: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`_run` in as many worlds as the device has memory for: half as many whenever it says that it has not."""
    worlds = min(len(todo), MAX_WORLDS["cpu" if job.device == "cpu" else "cuda"])
    while True:
        try:
            return _run(job, todo, worlds, njmax, naconmax)
        except RuntimeError as error:
            if worlds == 1 or "allocate" not in str(error).lower():
                raise
            worlds //= 2
            _log.warning("out of device memory: going on with %d worlds", worlds)


def _run(
    job: Job, todo: np.ndarray, nworld: int, njmax: int, naconmax: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """q (n, W, 6), largest acceleration (n, 6) and what went wrong (n,: OVERFLOW, NOT_FINITE), for places `todo` of the job."""
    device, n = job.device, len(todo)
    host = _without_reset_flag(job.model)
    wp.synchronize_device(device)  # the job's tables were written on torch's stream
    with wp.ScopedDevice(device):
        model = mjw.put_model(host, batch_sizes=dict.fromkeys(BATCHED, nworld))
        data = mjw.make_data(host, nworld=nworld, njmax=njmax, naconmax=naconmax)
        model.opt.warn_overflow = 0  # it prints to stdout; the bits are read below
        queue, fields = _queue(job, todo), _fields(model, data)
        worlds = Worlds()
        worlds.slot, worlds.step = (wp.zeros(nworld, dtype=wp.int32) for _ in range(2))
        worlds.qvel = wp.zeros((nworld, host.nv), dtype=wp.float32)
        worlds.taken, worlds.left = wp.zeros(1, dtype=wp.int32), wp.full(1, n, dtype=wp.int32)
        sample = wp.zeros((n, int(job.samples[todo].max()) + 1, host.nq), dtype=wp.float32)
        acceleration = wp.zeros((n, host.nv), dtype=wp.float32)
        failed = wp.zeros(n, dtype=wp.int32)

        def step() -> None:
            wp.launch(command_worlds, nworld, [job.law, worlds, queue, fields, *job.tables, failed])
            mjw.step(model, data)
            inputs = [job.record_steps, host.opt.timestep, worlds, queue, fields, sample, acceleration, failed]
            wp.launch(finish_step, nworld, inputs)

        for kernel in (command_worlds, finish_step):
            wp.load_module(kernel.module, device=device)
        mjw.step(model, data)  # compiles what the graph needs; the worlds start afterwards
        with wp.ScopedCapture() as capture:
            for _ in range(job.record_steps):
                step()
        wp.launch(start_worlds, nworld, [worlds, queue, fields, sample])
        while int(worlds.left.numpy()[0]) > 0:
            for _ in range(POLL):
                wp.capture_launch(capture.graph)
        q = sample.numpy()
    steps = np.arange(q.shape[1])[None]
    last = job.samples[todo][:, None]
    q = np.where((steps <= last)[..., None], q, q[np.arange(n), job.samples[todo]][:, None])
    return q, acceleration.numpy(), failed.numpy()


def _without_reset_flag(model: mujoco.MjModel) -> mujoco.MjModel:
    model = copy.copy(model)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # it never resets, and refuses the flag
    return model


def _queue(job: Job, todo: np.ndarray) -> Queue:
    model = copy.copy(job.model)
    scratch = mujoco.MjData(model)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in BATCHED}
    for i in todo:
        load(model, job.payloads[i], scratch)
        for name, values in rows.items():
            values.append(getattr(model, name).copy())
    table = {name: np.stack(values).astype(np.float32) for name, values in rows.items()}
    queue = Queue()
    queue.n = len(todo)
    queue.row = wp.array(job.rows[todo].astype(np.int32), dtype=wp.int32)
    queue.steps = wp.array((job.samples[todo] * job.record_steps).astype(np.int32), dtype=wp.int32)
    queue.start = wp.array(job.start[todo].astype(np.float32), dtype=wp.float32)
    for name, dtype in (("pos", wp.vec3), ("quat", wp.quat), ("ipos", wp.vec3), ("iquat", wp.quat), ("inertia", wp.vec3)):
        setattr(queue, name, wp.array(np.ascontiguousarray(table[f"body_{name}"][:, -1]), dtype=dtype))
    queue.mass = wp.array(np.ascontiguousarray(table["body_mass"][:, -1]), dtype=wp.float32)
    queue.subtreemass = wp.array(table["body_subtreemass"], dtype=wp.float32)
    queue.dof_invweight = wp.array(table["dof_invweight0"], dtype=wp.float32)
    return queue


def _fields(model: mjw.Model, data: mjw.Data) -> Fields:
    fields = Fields()
    for name in BATCHED:
        setattr(fields, name, getattr(model, name))
    for name in ("qpos", "qvel", "ctrl", "qacc_warmstart", "nacon", "nefc", "overflow", "naconmax", "njmax"):
        setattr(fields, name, getattr(data, name))
    return fields
