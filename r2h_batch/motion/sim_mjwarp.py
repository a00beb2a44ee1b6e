"""Motion in batched MuJoCo-Warp worlds: one captured graph, worlds refilled from a queue until it is empty."""

import copy
import logging
import threading
from dataclasses import dataclass

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from r2h_batch.kernels.motion.worlds import (
    OVERFLOW,
    Fields,
    Fingers,
    Queue,
    Record,
    Shapes,
    Worlds,
    command_worlds,
    finish_step,
    start_worlds,
)
from r2h_batch.launch import launch
from r2h_batch.motion.simulation import Job, Samples, warnings_unwritten
from r2h_batch.scene.model import MESH_FIELDS, SceneModel

ON_CPU = False
"""The engine reads its tables on the scene's device."""

MAX_WORLDS = {"cpu": 64, "cuda": 4096}
"""More are no faster on a CPU, and fewer are refilled more often."""
POLL = 32
"""Graph launches between two looks at how many trials are left."""

TRIES = 3
NJMAX, NACON_PER_WORLD = 32, 16
"""First size of the buffers: constraints per world (7 of the linkage; joint limits, 4 per contact), and contacts, of which
all worlds have one pool that also takes the pairs that are near. Every further try has four times as much."""

BATCHED = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "body_subtreemass", "body_invweight0",
    "dof_invweight0",
)  # fmt: skip
STATE = (
    "mocap_pos", "mocap_quat", "qpos", "qvel", "ctrl", "qacc_warmstart", "nacon", "ncollision", "nefc", "overflow",
    "naconmax", "njmax",
)  # fmt: skip

_log = logging.getLogger(__name__)
_one_at_a_time = threading.Lock()  # on a CPU, mjw.step in two threads at once crashes (shared tile storage)


def simulate(job: Job, *, threads: int | None = None) -> Samples:
    """Recorded motion of the job's trials. What overflowed a buffer runs again in larger ones; then it is not valid."""
    out = Samples.empty(job)
    todo = np.arange(len(job.rows))
    with _one_at_a_time, warnings_unwritten():
        for turn in range(TRIES):
            if not len(todo):
                break
            run = _run_in_memory(job, todo, NJMAX * 4**turn, NACON_PER_WORLD * 4**turn)
            out.q[todo, : run.q.shape[1]], out.acceleration[todo], out.sway_m[todo] = run.q, run.acceleration, run.sway
            finite = np.isfinite(run.q).all((1, 2)) & np.isfinite(run.acceleration).all(1) & np.isfinite(run.sway)
            out.valid[todo] = (run.failed == 0) & finite
            out.failed_state[todo] = np.where(out.valid[todo][:, None], np.nan, run.state)
            todo = todo[run.failed & OVERFLOW != 0]
    return out


@dataclass(frozen=True)
class Run:
    """What one run of n trials recorded (as `Record`)."""

    q: np.ndarray
    acceleration: np.ndarray
    sway: np.ndarray
    failed: np.ndarray
    state: np.ndarray


def _run_in_memory(job: Job, todo: np.ndarray, njmax: int, nacon_per_world: int) -> Run:
    """`_run` in as many worlds as the device has memory for: half as many whenever it says that it has not."""
    worlds = min(len(todo), MAX_WORLDS["cpu" if job.device == "cpu" else "cuda"])
    while True:
        try:
            return _run(job, todo, worlds, njmax, nacon_per_world * worlds)
        except RuntimeError as error:
            if worlds == 1 or "allocate" not in str(error).lower():
                raise
            worlds //= 2
            _log.warning("out of device memory: going on with %d worlds", worlds)


def _run(job: Job, todo: np.ndarray, nworld: int, njmax: int, naconmax: int) -> Run:
    """What the trials at places `todo` of the job do in `nworld` worlds, and what went wrong (OVERFLOW, NOT_FINITE)."""
    device, n = job.device, len(todo)
    host = _for_warp(job.scene.model)
    wp.synchronize_device(device)  # the job's tables were written on torch's stream
    with wp.ScopedDevice(device):
        batched = (*BATCHED, *MESH_FIELDS) if job.scene.full else BATCHED
        model = mjw.put_model(host, batch_sizes=dict.fromkeys(batched, nworld))
        data = mjw.make_data(host, nworld=nworld, njmax=njmax, naconmax=naconmax)
        model.opt.warn_overflow = 0  # it prints to stdout; the bits are read below
        queue, shapes = _queue(job, todo), _shapes(job.scene)
        written = _Written(
            _worlds(host, nworld, n), _fields(model, data), _record(host, n, int(job.samples[todo].max()))
        )
        graph = _captured_steps(job, model, data, queue, shapes, written)
        launch(
            start_worlds,
            nworld,
            inputs={"queue": queue, "shapes": shapes},
            outputs=vars(written),
            device=device,
        )
        while int(written.worlds.left.numpy()[0]) > 0:
            for _ in range(POLL):
                wp.capture_launch(graph)
        record = written.record
        q = record.q.numpy()
    # a trial that ended early stays where it was: rows beyond its last sample repeat it
    steps = np.arange(q.shape[1])[None]
    last = job.samples[todo][:, None]
    q = np.where((steps <= last)[..., None], q, q[np.arange(n), job.samples[todo]][:, None])
    return Run(q, *(getattr(record, k).numpy() for k in ("acceleration", "sway", "failed", "state")))


@dataclass(frozen=True)
class _Written:
    """What every kernel of a run writes: where the worlds stand in the queue, their state, what is kept of it."""

    worlds: Worlds
    fields: Fields
    record: Record


def _captured_steps(
    job: Job, model: mjw.Model, data: mjw.Data, queue: Queue, shapes: Shapes, written: _Written
) -> wp.Graph:
    """The steps between two recorded samples, as one graph: command, step, and record or refill."""
    device, nworld = job.device, data.nworld
    path, time, length = job.tables
    fingers = _fingers(job.scene)

    def step() -> None:
        launch(
            command_worlds,
            nworld,
            inputs={"law": job.law, "queue": queue, "path": path, "time": time, "length": length},
            outputs=vars(written),
            device=device,
        )
        mjw.step(model, data)
        launch(
            finish_step,
            nworld,
            inputs={
                "record_steps": job.record_steps,
                "step_s": job.scene.model.opt.timestep,
                "fingers": fingers,
                "queue": queue,
                "shapes": shapes,
            },
            outputs=vars(written),
            device=device,
        )

    for kernel in (command_worlds, finish_step):
        wp.load_module(kernel.module, device=device)
    mjw.step(model, data)  # compiles what the graph needs; the worlds start afterwards
    with wp.ScopedCapture() as capture:
        for _ in range(job.record_steps):
            step()
    return capture.graph


def _worlds(model: mujoco.MjModel, nworld: int, n: int) -> Worlds:
    worlds = Worlds()
    worlds.slot, worlds.step = (wp.zeros(nworld, dtype=wp.int32) for _ in range(2))
    worlds.qpos, worlds.qvel = (wp.zeros((nworld, model.nv), dtype=wp.float32) for _ in range(2))
    worlds.taken, worlds.left = wp.zeros(1, dtype=wp.int32), wp.full(1, n, dtype=wp.int32)
    return worlds


def _record(model: mujoco.MjModel, n: int, last_sample: int) -> Record:
    record = Record()
    record.q = wp.zeros((n, last_sample + 1, 6), dtype=wp.float32)
    record.acceleration = wp.zeros((n, 6), dtype=wp.float32)
    record.sway, record.failed = wp.zeros(n, dtype=wp.float32), wp.zeros(n, dtype=wp.int32)
    record.state = wp.zeros((n, model.nq + model.nv), dtype=wp.float32)
    return record


def _for_warp(model: mujoco.MjModel) -> mujoco.MjModel:
    model = copy.copy(model)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # it never resets, and refuses the flag
    # boxes as in MuJoCo C, by their faces: the general routine makes one contact of four, and a gripper that meets the
    # table bounces off
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    return model


def _queue(job: Job, todo: np.ndarray) -> Queue:
    scene, trials = job.scene, [job.trials[i] for i in todo]
    model = copy.copy(scene.model)
    scratch = mujoco.MjData(model)
    rows: dict[str, list[np.ndarray]] = {name: [] for name in BATCHED}
    for trial in trials:
        scene.load(model, trial, scratch)
        for name, values in rows.items():
            values.append(getattr(model, name).copy())
    table = {name: np.stack(values).astype(np.float32) for name, values in rows.items()}
    queue = Queue()
    queue.n = len(todo)
    queue.row = wp.array(job.rows[todo].astype(np.int32), dtype=wp.int32)
    queue.steps = wp.array((job.samples[todo] * job.record_steps).astype(np.int32), dtype=wp.int32)
    start = [scene.start(t, q) for t, q in zip(trials, job.start[todo], strict=True)]
    queue.start = wp.array(np.array(start, np.float32), dtype=wp.float32)
    queue.hold = wp.array(np.array([scene.hold(t) for t in trials], np.float32), dtype=wp.float32)
    for name, dtype in (
        ("pos", wp.vec3),
        ("quat", wp.quat),
        ("ipos", wp.vec3),
        ("iquat", wp.quat),
        ("inertia", wp.vec3),
    ):
        setattr(queue, name, wp.array(np.ascontiguousarray(table[f"body_{name}"][:, -1]), dtype=dtype))
    queue.mass = wp.array(np.ascontiguousarray(table["body_mass"][:, -1]), dtype=wp.float32)
    queue.subtreemass = wp.array(table["body_subtreemass"], dtype=wp.float32)
    queue.dof_invweight = wp.array(table["dof_invweight0"], dtype=wp.float32)
    queue.body_invweight = wp.array(table["body_invweight0"], dtype=wp.vec2)
    if scene.full:
        queue.mesh = wp.array(np.stack([scene.meshes(t) for t in trials]).astype(np.int32), dtype=wp.int32)
        at = scene.hand_body
        queue.hand_pos = wp.array(np.ascontiguousarray(table["body_pos"][:, at]), dtype=wp.vec3)
        queue.hand_quat = wp.array(np.ascontiguousarray(table["body_quat"][:, at]), dtype=wp.quat)
    return queue


def _shapes(scene: SceneModel) -> Shapes:
    shapes = Shapes()
    shapes.geom = wp.array(scene.varied.astype(np.int32), dtype=wp.int32)
    if scene.full:
        for name, dtype in (("size", wp.vec3), ("rbound", wp.float32), ("pos", wp.vec3), ("quat", wp.quat)):
            setattr(shapes, name, wp.array(scene.shapes[f"geom_{name}"].astype(np.float32), dtype=dtype))
        aabb = scene.shapes["geom_aabb"].astype(np.float32).reshape(-1, 2, 3)
        shapes.aabb = wp.array(aabb, dtype=wp.vec3)
    return shapes


def _fingers(scene: SceneModel) -> Fingers:
    fingers = Fingers()
    for name in ("driver", "pin_arm", "pin", "inner_knuckle"):
        setattr(fingers, name, getattr(scene.levers, name))
    return fingers


def _fields(model: mjw.Model, data: mjw.Data) -> Fields:
    fields = Fields()
    for name in (*BATCHED, *MESH_FIELDS):
        setattr(fields, name, getattr(model, name))
    for name in STATE:
        setattr(fields, name, getattr(data, name))
    return fields
