"""Motion in batched MuJoCo-Warp worlds: one captured graph, worlds refilled from a queue until it
is empty.

The worlds (model, data, room for a queue, the graph) stand from one batch to the next. A graph
holds addresses, so a batch is written into the arrays that are there; a queue that they have no
room for gets longer ones, and a new graph.
"""

import copy
import logging
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from r2h_batch.base.launch import launch
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.judge.motion.simulation import Job, Samples, clock_unread, warnings_unwritten
from r2h_batch.kernels.motion.time_law import Law
from r2h_batch.kernels.motion.worlds import (
    OVERFLOW,
    WINDOW,
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
from r2h_batch.scene.dynamics import quats_wxyz
from r2h_batch.scene.model import MESH_FIELDS, SceneModel

BATCHED = (
    "body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "body_subtreemass", "body_invweight0",
    "dof_invweight0",
)  # fmt: skip
"""Fields of the model that each world has of its own."""
STATE = (
    "mocap_pos", "mocap_quat", "qpos", "qvel", "ctrl", "qacc_warmstart", "cvel", "cdof_dot", "nacon", "ncollision", "nefc",
    "overflow", "naconmax", "njmax",
)  # fmt: skip

ANY_DRIVE = 1e9
"""Beyond every drive angle, rad."""

POLL = 32
"""Graph launches between two looks at how many trials are left."""

KEPT = 6
"""Sets of worlds that a process holds, 30 kB a world: arm and scene, and the smaller ones in which
few trials run again."""

_kept: "OrderedDict[tuple[Any, ...], StandingWorlds]" = OrderedDict()


@dataclass(frozen=True)
class Run:
    """Recorded motion of one run of n trials (as `Record`); rows of q repeat their last sample."""

    q: np.ndarray  # (n, W, 6)
    acceleration: np.ndarray
    sway: np.ndarray
    bend: np.ndarray  # (n, K), as `Samples` has them
    fingers: np.ndarray
    failed: np.ndarray
    state: np.ndarray


def standing_worlds(job: Job, nworld: int, njmax: int, naconmax: int) -> "StandingWorlds":
    """The process' worlds for such jobs, with buffers of these sizes; built if there are none."""
    law = tuple(float(getattr(job.law, name)) for name in ("speed", "acceleration", "lead", "step"))
    key = (id(job.scene), law, job.record_steps, job.device, nworld, njmax, naconmax)
    worlds = _kept.get(key)
    if worlds is None:
        while len(_kept) >= KEPT:
            _kept.popitem(last=False)
        worlds = _kept[key] = StandingWorlds(
            job.scene, job.law, job.record_steps, job.motion_radii, job.device, nworld, njmax,
            naconmax,
        )  # fmt: skip
    _kept.move_to_end(key)
    return worlds


def forget_worlds() -> None:
    """Gives back the memory of all worlds."""
    _kept.clear()


class StandingWorlds:
    """`nworld` worlds of one model."""

    def __init__(
        self,
        scene: SceneModel,
        law: Law,
        record_steps: int,
        motion_radii: np.ndarray,
        device: str,
        nworld: int,
        njmax: int,
        naconmax: int,
    ) -> None:
        self.scene, self.law, self.record_steps = scene, law, record_steps
        self.device, self.nworld = device, nworld
        host = _for_warp(scene.model)
        with wp.ScopedDevice(device):
            batched = (*BATCHED, *MESH_FIELDS) if scene.full else BATCHED
            self.model = mjw.put_model(host, batch_sizes=dict.fromkeys(batched, nworld))
            self.data = mjw.make_data(host, nworld=nworld, njmax=njmax, naconmax=naconmax)
            self.model.opt.warn_overflow = 0  # it prints to stdout; the bits are read below
            self.fields = _fields(scene, self.model, self.data)
            self.shapes, self.fingers = _shapes(scene), _fingers(scene)
            self.worlds = _worlds(scene, host, nworld)
            self.motion_radii: Any = wp.array(motion_radii.astype(np.float32), dtype=wp.float32)
            self.room = (0, 0, 0)
            self.graph: Any = None
            for kernel in (command_worlds, finish_step, start_worlds):
                wp.load_module(self._sized(kernel).module, device=device)
            # compiles what the graph needs; the worlds start afterwards
            mjw.step(self.model, self.data)

    def run(self, job: Job, todo: np.ndarray) -> Run:
        """Simulates the trials at places `todo` of the job; the record, and faults (OVERFLOW,
        NOT_FINITE)."""
        n = len(todo)
        wp.synchronize_device(self.device)  # the job's tables were written on torch's stream
        table = queue_table(job, todo)
        last = job.samples[todo]
        with wp.ScopedDevice(self.device):
            self._make_room(n, int((last + 1).sum()), table["path"].shape[1])
            for name, values in table.items():
                if values.size:  # the arm alone has nothing to hold
                    getattr(self.queue, name)[: len(values)].assign(values)
            self.worlds.taken.zero_()
            self.worlds.left.fill_(n)
            for name in ("acceleration", "sway", "failed", "bend", "pin"):
                getattr(self.record, name).zero_()
            self.record.drive_low.fill_(ANY_DRIVE)
            self.record.drive_high.fill_(-ANY_DRIVE)
            launch(
                self._sized(start_worlds),
                self.nworld,
                inputs={"queue": self.queue, "shapes": self.shapes},
                outputs=self._written,
                device=self.device,
            )
            while int(self.worlds.left.numpy()[0]) > 0:
                for _ in range(POLL):
                    wp.capture_launch(self.graph)
            flat = self.record.q[: int((last + 1).sum())].numpy()
            windows = {
                k: getattr(self.record, k).numpy()
                for k in ("bend", "drive_low", "drive_high", "pin")
            }
            kept = {
                k: getattr(self.record, k)[:n].numpy()
                for k in ("acceleration", "sway", "failed", "state")
            }
        # a trial that ended early stays where it was
        place = table["sample"][:, None] + np.minimum(np.arange(int(last.max()) + 1), last[:, None])
        return Run(
            flat[place], **{k: v.copy() for k, v in kept.items()},
            **_windows(windows, table["sample"], last, table["hold"]),
        )  # fmt: skip

    def _sized(self, kernel: Any) -> Any:
        return of_joints(kernel, len(self.scene.robot.joints))

    @property
    def _written(self) -> dict[str, Any]:
        """Outputs of every kernel of a run: the worlds' places in the queue, their state, the
        recorded part of it."""
        return {"worlds": self.worlds, "fields": self.fields, "record": self.record}

    def _make_room(self, n: int, samples: int, waypoints: int) -> None:
        """Arrays for n trials, and the graph that works on them, unless there are such."""
        if (
            self.graph is not None
            and n <= self.room[0]
            and samples <= self.room[1]
            and waypoints == self.room[2]
        ):
            return
        # a little more than asked, so that a sweep's chunks find room after the first few
        self.room = (
            _rounded(max(n, self.room[0])),
            _rounded(max(samples, self.room[1])),
            waypoints,
        )
        self.graph = None
        self.queue = _empty_queue(self.scene, self.room[0], waypoints)
        self.record = _empty_record(self.scene, *self.room[:2])
        self.graph = self._captured_steps()

    def _captured_steps(self) -> wp.Graph:
        """The steps between two recorded samples, as one graph: command, step, and record or
        refill."""

        def step() -> None:
            launch(
                self._sized(command_worlds),
                self.nworld,
                inputs={"law": self.law, "queue": self.queue},
                outputs=self._written,
                device=self.device,
            )
            mjw.step(self.model, self.data)
            launch(
                self._sized(finish_step),
                self.nworld,
                inputs={
                    "record_steps": self.record_steps,
                    "step_s": self.scene.model.opt.timestep,
                    "fingers": self.fingers,
                    "motion_radius": self.motion_radii,
                    "queue": self.queue,
                    "shapes": self.shapes,
                },
                outputs=self._written,
                device=self.device,
            )

        with wp.ScopedCapture() as capture:
            for _ in range(self.record_steps):
                step()
        return capture.graph


def queue_table(job: Job, todo: np.ndarray) -> dict[str, np.ndarray]:
    """The `Queue` of the trials at places `todo` of the job, on the host: all at once, nothing
    trial by trial."""
    scene, trials, rows = job.scene, job.trials.rows(todo), job.rows[todo]
    model = scene.loaded(trials)
    path, time, length = (table.numpy()[rows] for table in job.tables)
    samples = job.samples[todo]
    table = {
        "n": np.array([len(todo)]),
        "path": path,
        "time": time,
        "length": length,
        "steps": samples * job.record_steps,
        "sample": np.cumsum(samples + 1) - (samples + 1),
        "start": scene.start(trials, job.start[todo]),
        "hold": scene.hold(trials),
        **{
            name: model[f"body_{name}"]
            for name in ("pos", "quat", "ipos", "iquat", "mass", "inertia", "subtreemass")
        },
        "dof_invweight": model["dof_invweight0"],
        "body_invweight": model["body_invweight0"],
    }
    if scene.full:
        table["mesh"] = scene.meshes_of(trials)
        table["hand_pos"] = trials.T_world_hand[:, :3, 3]
        table["hand_quat"] = quats_wxyz(trials.T_world_hand[:, :3, :3])
    return {k: v.astype(np.int32 if k in INTEGERS else np.float32) for k, v in table.items()}


INTEGERS = ("n", "length", "steps", "sample", "mesh")


def _empty_queue(scene: SceneModel, n: int, waypoints: int) -> Queue:
    model, joints = scene.model, len(scene.robot.joints)
    queue: Queue = of_joints(Queue, joints)()
    for name in INTEGERS[:-1]:
        setattr(queue, name, wp.zeros(1 if name == "n" else n, dtype=wp.int32))
    for name, shape in (
        ("path", (n, waypoints, joints)),
        ("time", (n, waypoints)),
        ("start", (n, model.nq)),
        ("hold", (n, model.nu - joints)),
        ("mass", (n,)),
        ("subtreemass", (n, model.nbody)),
        ("dof_invweight", (n, model.nv)),
    ):
        setattr(queue, name, wp.zeros(shape, dtype=wp.float32))
    queue.body_invweight = wp.zeros((n, model.nbody), dtype=wp.vec2)
    vectors, turns = ["pos", "ipos", "inertia"], ["quat", "iquat"]
    if scene.full:
        queue.mesh = wp.zeros((n, len(scene.varied)), dtype=wp.int32)
        vectors.append("hand_pos")
        turns.append("hand_quat")
    for name in vectors:
        setattr(queue, name, wp.zeros(n, dtype=wp.vec3))
    for name in turns:
        setattr(queue, name, wp.zeros(n, dtype=wp.quat))
    return queue


def _empty_record(scene: SceneModel, n: int, samples: int) -> Record:
    model, joints = scene.model, len(scene.robot.joints)
    record: Record = of_joints(Record, joints)()
    record.q = wp.zeros((samples, joints), dtype=wp.float32)
    record.acceleration = wp.zeros((n, joints), dtype=wp.float32)
    record.sway, record.failed = wp.zeros(n, dtype=wp.float32), wp.zeros(n, dtype=wp.int32)
    for name in ("bend", "drive_low", "drive_high", "pin"):
        setattr(record, name, wp.zeros(samples // int(WINDOW) + n + 1, dtype=wp.float32))
    record.state = wp.zeros((n, model.nq + model.nv), dtype=wp.float32)
    return record


def _windows(
    record: dict[str, np.ndarray], sample: np.ndarray, last: np.ndarray, hold: np.ndarray
) -> dict[str, np.ndarray]:
    """`bend` and `fingers` of n trials from the windows of a record, 0 beyond a trial's end.

    `sample`: place of each trial's first sample; `last`: its segments; `hold`: (n, 1) or (n, 0).
    """
    k = np.arange(-(-int(last.max()) // int(WINDOW)))
    there = k * int(WINDOW) < last[:, None]
    place = np.where(there, (sample // int(WINDOW) + np.arange(len(sample)))[:, None] + k, 0)
    bend, low, high, pin = (np.where(there, record[name][place], 0.0) for name in record)
    fingers = np.stack([low, high, pin], -1)
    if hold.shape[1]:  # they begin where their motor holds them
        fingers[:, 0, 0] = np.minimum(fingers[:, 0, 0], hold[:, 0])
        fingers[:, 0, 1] = np.maximum(fingers[:, 0, 1], hold[:, 0])
    return {"bend": bend, "fingers": fingers if hold.shape[1] else np.zeros_like(fingers)}


def _worlds(scene: SceneModel, model: mujoco.MjModel, nworld: int) -> Worlds:
    worlds: Worlds = of_joints(Worlds, len(scene.robot.joints))()
    worlds.slot, worlds.step = (wp.zeros(nworld, dtype=wp.int32) for _ in range(2))
    worlds.qpos, worlds.qvel = (wp.zeros((nworld, model.nv), dtype=wp.float32) for _ in range(2))
    worlds.taken, worlds.left = (wp.zeros(1, dtype=wp.int32) for _ in range(2))
    return worlds


def _rounded(n: int) -> int:
    """n or up to an eighth more."""
    step = max(1 << max(n.bit_length() - 3, 0), 1)
    return -(-n // step) * step


def _for_warp(model: mujoco.MjModel) -> mujoco.MjModel:
    model = copy.copy(model)
    # it never resets, and refuses the flag
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # boxes as in MuJoCo C, by their faces: the general routine makes one contact of four, and a
    # gripper that meets the table bounces off
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    return model


def _shapes(scene: SceneModel) -> Shapes:
    shapes: Shapes = of_joints(Shapes, len(scene.robot.joints))()
    shapes.geom = wp.array(scene.varied.astype(np.int32), dtype=wp.int32)
    if scene.full:
        for name, dtype in (
            ("size", wp.vec3),
            ("rbound", wp.float32),
            ("pos", wp.vec3),
            ("quat", wp.quat),
        ):
            setattr(
                shapes, name, wp.array(scene.shapes[f"geom_{name}"].astype(np.float32), dtype=dtype)
            )
        aabb = scene.shapes["geom_aabb"].astype(np.float32).reshape(-1, 2, 3)
        shapes.aabb = wp.array(aabb, dtype=wp.vec3)
    return shapes


def _fingers(scene: SceneModel) -> Fingers:
    fingers: Fingers = of_joints(Fingers, len(scene.robot.joints))()
    for name in ("driver", "pin_arm", "pin", "inner_knuckle"):
        setattr(fingers, name, getattr(scene.levers, name))
    fingers.weight = wp.array(np.array(scene.levers.weight, np.float32), dtype=wp.float32)
    return fingers


def _fields(scene: SceneModel, model: mjw.Model, data: mjw.Data) -> Fields:
    fields: Fields = of_joints(Fields, len(scene.robot.joints))()
    for name in (*BATCHED, *MESH_FIELDS):
        setattr(fields, name, getattr(model, name))
    for name in STATE:
        setattr(fields, name, getattr(data, name))
    return fields


ON_CPU = False
"""The engine reads its tables on the scene's device."""

MAX_WORLDS = {"cpu": 64, "cuda": 4096}
"""More are not faster on a CPU, and fewer are refilled more often."""
TRIES = 3
NJMAX, NACON_PER_WORLD = 32, 16
"""First size of the buffers: constraints per world (7 of the linkage; joint limits, 4 per contact),
and contacts, of which all worlds have one pool that also takes the pairs that are near. Every
further try has four times as much."""

_log = logging.getLogger(__name__)
# on a CPU, mjw.step in two threads at once crashes (shared tile storage)
_one_at_a_time = threading.Lock()


def simulate(job: Job) -> Samples:
    """Recorded motion of the job's trials. What overflowed a buffer runs again in larger ones; then
    it is not valid."""
    out = Samples.empty(job)
    todo = np.arange(len(job.rows))
    with _one_at_a_time, warnings_unwritten(), clock_unread():
        for turn in range(TRIES):
            if not len(todo):
                break
            run = _run_in_memory(job, todo, NJMAX * 4**turn, NACON_PER_WORLD * 4**turn)
            out.q[todo, : run.q.shape[1]] = run.q
            out.acceleration[todo], out.sway_m[todo] = run.acceleration, run.sway
            out.bend[todo, : run.bend.shape[1]] = run.bend
            out.fingers[todo, : run.bend.shape[1]] = run.fingers
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
    """Simulates the trials at places `todo` of the job in `nworld` worlds; the record, and faults
    (OVERFLOW, NOT_FINITE)."""
    try:
        return standing_worlds(job, nworld, njmax, naconmax).run(job, todo)
    except BaseException:
        forget_worlds()  # what went wrong in them may last, and if it was memory others need it
        raise
