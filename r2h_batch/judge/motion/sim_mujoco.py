"""Motion in MuJoCo C: every trial its own rollout, on all cores."""

import copy
from collections.abc import Iterator
from functools import partial
from queue import SimpleQueue

import mujoco
import numpy as np
import torch
from mujoco import rollout
from numpy.typing import NDArray

from r2h_batch.base.launch import cpu_threads, over_trials, thread_pool
from r2h_batch.base.launch.instances import of_joints
from r2h_batch.judge.motion.simulation import Job, Samples, clock_unread, warnings_unwritten
from r2h_batch.kernels.motion.time_law import servo_commands
from r2h_batch.kernels.motion.worlds import WINDOW

ON_CPU = True
"""The engine reads its tables on the host, even if the scene is on another device."""

CHUNK = 64
"""Trials whose commands are held in memory at once: about 20 MB."""

_BIT = mujoco.mjtDisableBit
UNCONSTRAINED = int(_BIT.mjDSBL_CONSTRAINT) | int(_BIT.mjDSBL_DAMPER)
"""Flags without effect in MuJoCo C for the arm alone while its joints are within their limits: it has
no other constraints, and no joint of it has damping. The steps are the same."""
ONE_ISLAND = int(_BIT.mjDSBL_ISLAND) | int(_BIT.mjDSBL_DAMPER)
"""And for the whole scene, whose moving bodies are one tree."""

Simulator = tuple[mujoco.MjModel, mujoco.MjData]
"""A copy of the model, which trials are put into one after the other, and its state."""


def simulate(job: Job) -> Samples:
    """Recorded motion of the job's trials; each stops at its own end, so that no trial waits for the
    slowest."""
    out = Samples.empty(job)
    workers = min(cpu_threads(), max(len(job.rows), 1))
    simulators: SimpleQueue[Simulator] = SimpleQueue()
    for _ in range(workers):
        model = copy.copy(job.scene.model)
        simulators.put((model, mujoco.MjData(model)))
    with warnings_unwritten(), clock_unread():
        for first in range(0, len(job.rows), CHUNK):
            rows = range(first, min(first + CHUNK, len(job.rows)))
            steps = job.samples[rows.start : rows.stop].astype(np.int64) * job.record_steps
            most = int(steps.max(initial=0))
            size = (len(rows), most, job.scene.model.nu)
            found = {"command": torch.empty(size, dtype=torch.float64, device="cpu")}
            index = torch.from_numpy(job.rows[rows.start : rows.stop].astype(np.int32))
            path, time, length = job.tables
            kernel = of_joints(servo_commands, job.start.shape[1])
            run = over_trials(kernel, len(rows), "cpu", outputs=found, chunk=1, width=most)
            run(law=job.law, trial=index, path=path, time=time, length=length)
            command = found["command"].numpy()
            todo = iter(rows)  # next() is atomic: a free thread takes the next trial
            work = partial(_work, job, simulators, todo, first, command, steps, out)
            futures = [thread_pool(workers).submit(work) for _ in range(workers - 1)]
            work()
            for future in futures:
                future.result()
    return out


def _work(
    job: Job,
    simulators: "SimpleQueue[Simulator]",
    todo: Iterator[int],
    first: int,
    command: np.ndarray,
    steps: np.ndarray,
    out: Samples,
) -> None:
    simulator = simulators.get()
    for i in todo:
        _run(job, i, *simulator, command[i - first, : steps[i - first]], out)
    simulators.put(simulator)


def _run(
    job: Job, i: int, model: mujoco.MjModel, data: mujoco.MjData, command: np.ndarray, out: Samples
) -> None:  # fmt: skip
    scene, trial, n = job.scene, job.trials[i], job.start.shape[1]
    scene.load(model, trial, data)
    command[:, n:] = scene.hold(trial)
    start = scene.start(trial, job.start[i])
    every = scene.model.opt.disableflags
    if scene.full:
        model.opt.disableflags = every | ONE_ISLAND
        if not job.contacts:
            model.opt.disableflags |= int(_BIT.mjDSBL_CONTACT)
        states = _states(model, data, start, command)
    else:
        model.opt.disableflags = every | UNCONSTRAINED
        states = _states(model, data, start, command)
        if not _within_limits(model, states[:, 1 : 1 + n]):
            model.opt.disableflags = every
            states = _states(model, data, start, command)
    time, q, qd = np.split(states, [1, 1 + model.nq], axis=1)
    kept = q[:: job.record_steps, :n]
    out.q[i, : len(kept)] = kept
    out.q[i, len(kept) :] = kept[-1]
    acceleration = np.diff(qd[:, :n], axis=0)
    np.abs(acceleration, out=acceleration)
    acceleration /= model.opt.timestep
    begins = np.arange(0, len(command), job.record_steps * int(WINDOW))
    of_window = np.maximum.reduceat(acceleration, begins)
    out.acceleration[i], out.sway_m[i] = of_window.max(0), scene.sway(trial, q)
    out.bend[i, : len(begins)] = (of_window @ job.motion_radii.T).max(1)
    if scene.full:
        fingers = scene.fingers(trial, q) * [-1, 1, 1]  # the smallest angle as a maximum too
        found = np.maximum(np.maximum.reduceat(fingers[1:], begins), fingers[begins])
        out.fingers[i, : len(begins)] = found * [-1, 1, 1]
    # after a warning (bad position, velocity, acceleration) rollout repeats the last state: time
    # stands still
    on_time = abs(time[-1, 0] - len(command) * model.opt.timestep) < 0.5 * model.opt.timestep
    out.valid[i] = on_time and bool(np.isfinite(states).all())
    if not out.valid[i]:
        finite = np.isfinite(q).all(1) & np.isfinite(qd).all(1)
        last = max(int(np.argmin(finite)) - 1, 0) if not finite.all() else -1
        out.failed_state[i] = np.concatenate([q[last], qd[last]])


def _states(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    start: NDArray[np.float64],
    command: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Time, qpos and qvel (steps + 1, 1 + nq + nv) of a motion that begins at rest."""
    states = np.empty((len(command) + 1, 1 + model.nq + model.nv))
    states[0] = [0.0, *start, *np.zeros(model.nv)]
    rollout.rollout(model, data, states[:1], command[None], state=states[None, 1:])
    return states


def _within_limits(model: mujoco.MjModel, q: NDArray[np.float64]) -> bool:
    """Whether no joint was beyond its limits at positions (n, nq) of the arm alone; False for
    NaN."""
    limited = model.jnt_limited.astype(bool)
    low, high = model.jnt_range[limited].T
    q = q[:, limited]
    return bool((q.min(0) >= low).all() and (q.max(0) <= high).all())
