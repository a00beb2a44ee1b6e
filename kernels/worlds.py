"""What a simulated world does around each step: take its command, record, note what went wrong, go on to the next trial.

Worlds are refilled: one that has finished its trial loads the next one's payload and starts it, so that all stay busy
until the queue is empty. Which world a trial runs in makes no difference to it.
"""

import warp as wp

from r2h_batch.kernels.reference import Law, servo_command

wp.set_module_options({"enable_backward": False})

IDLE = wp.constant(-1)
OVERFLOW = wp.constant(1)
NOT_FINITE = wp.constant(2)


@wp.struct
class Queue:
    """n trials in the order they are started: row of the batch, steps, start (rad), and what they hold."""

    n: int
    row: wp.array(dtype=int)
    steps: wp.array(dtype=int)
    start: wp.array2d(dtype=float)
    pos: wp.array(dtype=wp.vec3)
    quat: wp.array(dtype=wp.quat)
    ipos: wp.array(dtype=wp.vec3)
    iquat: wp.array(dtype=wp.quat)
    mass: wp.array(dtype=float)
    inertia: wp.array(dtype=wp.vec3)
    subtreemass: wp.array2d(dtype=float)
    dof_invweight: wp.array2d(dtype=float)


@wp.struct
class Worlds:
    """Per world: the trial it runs (its place in the queue, IDLE: none), steps done, speed before the step."""

    slot: wp.array(dtype=int)
    step: wp.array(dtype=int)
    qvel: wp.array2d(dtype=float)
    taken: wp.array(dtype=int)  # (1,) trials that were started
    left: wp.array(dtype=int)  # (1,) trials that are not finished


@wp.struct
class Fields:
    """Fields of mujoco-warp's Model and Data, one row per world."""

    body_pos: wp.array2d(dtype=wp.vec3)
    body_quat: wp.array2d(dtype=wp.quat)
    body_ipos: wp.array2d(dtype=wp.vec3)
    body_iquat: wp.array2d(dtype=wp.quat)
    body_mass: wp.array2d(dtype=float)
    body_inertia: wp.array2d(dtype=wp.vec3)
    body_subtreemass: wp.array2d(dtype=float)
    dof_invweight0: wp.array2d(dtype=float)
    qpos: wp.array2d(dtype=float)
    qvel: wp.array2d(dtype=float)
    ctrl: wp.array2d(dtype=float)
    qacc_warmstart: wp.array2d(dtype=float)
    nacon: wp.array(dtype=int)
    nefc: wp.array(dtype=int)
    overflow: wp.array(dtype=int)
    naconmax: int
    njmax: int


@wp.func
def start_next(worlds: Worlds, queue: Queue, fields: Fields, w: int, sample_out: wp.array3d(dtype=float)):
    """Puts the next trial of the queue into a world."""
    slot = wp.atomic_add(worlds.taken, 0, 1)
    if slot >= queue.n:
        worlds.slot[w] = IDLE
        return
    worlds.slot[w] = slot
    worlds.step[w] = 0
    fields.overflow[w] = 0  # the simulator only ever adds to it
    body = fields.body_pos.shape[1] - 1
    fields.body_pos[w, body] = queue.pos[slot]
    fields.body_quat[w, body] = queue.quat[slot]
    fields.body_ipos[w, body] = queue.ipos[slot]
    fields.body_iquat[w, body] = queue.iquat[slot]
    fields.body_mass[w, body] = queue.mass[slot]
    fields.body_inertia[w, body] = queue.inertia[slot]
    for b in range(body + 1):
        fields.body_subtreemass[w, b] = queue.subtreemass[slot, b]
    for j in range(6):
        fields.dof_invweight0[w, j] = queue.dof_invweight[slot, j]
        fields.qpos[w, j] = queue.start[slot, j]
        fields.qvel[w, j] = 0.0
        worlds.qvel[w, j] = 0.0
        fields.qacc_warmstart[w, j] = 0.0
        sample_out[slot, 0, j] = queue.start[slot, j]


@wp.kernel
def start_worlds(worlds: Worlds, queue: Queue, fields: Fields, sample_out: wp.array3d(dtype=float)):
    """The first trial of every world."""
    start_next(worlds, queue, fields, wp.tid(), sample_out)


@wp.kernel
def command_worlds(
    law: Law,
    worlds: Worlds,
    queue: Queue,
    fields: Fields,
    path_in: wp.array3d(dtype=float),
    time_in: wp.array2d(dtype=float),
    length_in: wp.array(dtype=int),
    failed_out: wp.array(dtype=int),  # (n,) OVERFLOW, NOT_FINITE
):
    """Before a step: the servos' commands. One that is not finite is noted: torque limits would hide it in the motion."""
    w = wp.tid()
    slot = worlds.slot[w]
    if slot == IDLE:
        return
    c = servo_command(law, path_in, time_in, length_in, queue.row[slot], wp.float64(worlds.step[w]) * law.step)
    for j in range(6):
        fields.ctrl[w, j] = float(c[j])
        if not wp.isfinite(c[j]):
            failed_out[slot] = failed_out[slot] | NOT_FINITE


@wp.func
def went_wrong(fields: Fields, w: int):
    """Whether this step lost constraints or contacts of a world: flags are not to be trusted alone, counts are compared."""
    return fields.overflow[w] != 0 or fields.nefc[w] > fields.njmax or fields.nacon[0] > fields.naconmax


@wp.kernel
def finish_step(
    record_steps: int,
    step_s: float,
    worlds: Worlds,
    queue: Queue,
    fields: Fields,
    sample_out: wp.array3d(dtype=float),  # (n, W, 6)
    acceleration_out: wp.array2d(dtype=float),  # (n, 6)
    failed_out: wp.array(dtype=int),  # (n,)
):
    """After a step: record, note overflows, refill the world when its trial is over."""
    w = wp.tid()
    slot = worlds.slot[w]
    if slot == IDLE:
        return
    step = worlds.step[w] + 1
    worlds.step[w] = step
    if went_wrong(fields, w):
        failed_out[slot] = failed_out[slot] | OVERFLOW
    for j in range(6):
        v = fields.qvel[w, j]
        a = wp.abs(v - worlds.qvel[w, j]) / step_s
        if a > acceleration_out[slot, j]:
            acceleration_out[slot, j] = a
        worlds.qvel[w, j] = v
    if step % record_steps == 0:
        for j in range(6):
            sample_out[slot, step / record_steps, j] = fields.qpos[w, j]
    if step == queue.steps[slot]:
        wp.atomic_sub(worlds.left, 0, 1)
        start_next(worlds, queue, fields, w, sample_out)
