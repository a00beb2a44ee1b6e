"""Work of a simulated world around each step: take its command, record, note what went wrong, go on to the next trial.

Worlds are refilled: one that has finished its trial loads the next one's object and hand and starts it, so that all stay
busy until the queue is empty. Which world a trial runs in makes no difference to it.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

from ..robot.joints import JOINTS
from .time_law import Law, servo_command

wp.set_module_options(OPTIONS)

IDLE = wp.constant(-1)
OVERFLOW = wp.constant(1)
NOT_FINITE = wp.constant(2)
WINDOW = wp.constant(8)
"""Segments between samples that are judged together where something holds a motion up: 64 ms."""


@wp.struct
class Shapes:
    """Fields of a geom with each mesh of the model; which geoms have a mesh of the trial's."""

    geom: wp.array(dtype=int)
    size: wp.array(dtype=wp.vec3)
    aabb: wp.array2d(dtype=wp.vec3)  # (meshes, 2)
    rbound: wp.array(dtype=float)
    pos: wp.array(dtype=wp.vec3)
    quat: wp.array(dtype=wp.quat)


@wp.struct
class Queue:
    """n trials in the order they are started: path, steps, start (rad), and what they put into the scene.

    The arrays are as long as the longest queue so far: a captured graph runs them again with other trials in them.
    """

    n: wp.array(dtype=int)  # (1,)
    path: wp.array3d(dtype=float)  # (n, W, JOINTS)
    time: wp.array2d(dtype=float)  # (n, W)
    length: wp.array(dtype=int)
    steps: wp.array(dtype=int)
    sample: wp.array(dtype=int)  # place of the trial's first recorded sample
    start: wp.array2d(dtype=float)  # (n, nq)
    hold: wp.array2d(dtype=float)  # (n, nu - JOINTS)
    pos: wp.array(dtype=wp.vec3)
    quat: wp.array(dtype=wp.quat)
    ipos: wp.array(dtype=wp.vec3)
    iquat: wp.array(dtype=wp.quat)
    mass: wp.array(dtype=float)
    inertia: wp.array(dtype=wp.vec3)
    subtreemass: wp.array2d(dtype=float)
    dof_invweight: wp.array2d(dtype=float)
    body_invweight: wp.array2d(dtype=wp.vec2)
    mesh: wp.array2d(dtype=int)  # (n, geoms of Shapes)
    hand_pos: wp.array(dtype=wp.vec3)
    hand_quat: wp.array(dtype=wp.quat)


@wp.struct
class Worlds:
    """Per world: the trial it runs (its place in the queue, IDLE: none), steps done, state before the step."""

    slot: wp.array(dtype=int)
    step: wp.array(dtype=int)
    qpos: wp.array2d(dtype=float)
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
    body_invweight0: wp.array2d(dtype=wp.vec2)
    dof_invweight0: wp.array2d(dtype=float)
    geom_dataid: wp.array2d(dtype=int)
    geom_size: wp.array2d(dtype=wp.vec3)
    geom_aabb: wp.array3d(dtype=wp.vec3)
    geom_rbound: wp.array2d(dtype=float)
    geom_pos: wp.array2d(dtype=wp.vec3)
    geom_quat: wp.array2d(dtype=wp.quat)
    mocap_pos: wp.array2d(dtype=wp.vec3)
    mocap_quat: wp.array2d(dtype=wp.quat)
    qpos: wp.array2d(dtype=float)
    qvel: wp.array2d(dtype=float)
    ctrl: wp.array2d(dtype=float)
    qacc_warmstart: wp.array2d(dtype=float)
    cvel: wp.array2d(dtype=wp.spatial_vector)
    cdof_dot: wp.array2d(dtype=wp.spatial_vector)
    nacon: wp.array(dtype=int)
    ncollision: wp.array(dtype=int)
    nefc: wp.array(dtype=int)
    overflow: wp.array(dtype=int)
    naconmax: int
    njmax: int


@wp.struct
class Fingers:
    """Levers of the gripper's moving parts (m): driver, pin about the driver's pivot, inner finger, inner knuckle.

    `weight`, of fingers that a table moves: by how much (m) a point is off per unit of each joint of a side, of the first
    (the driver) as it takes the others along. The others then count as one pin, in m. Empty: the linkage."""

    driver: float
    pin_arm: float
    pin: float
    inner_knuckle: float
    weight: wp.array(dtype=float)


@wp.struct
class Record:
    """Record of n trials. Fields of size (windows,) have an entry for each window of WINDOW segments."""

    q: wp.array2d(dtype=float)  # (samples, JOINTS) of all trials, each from `Queue.sample` on
    acceleration: wp.array2d(dtype=float)  # (n, JOINTS)
    sway: wp.array(dtype=float)  # (n,)
    bend: wp.array(dtype=float)  # (windows,) largest acceleration of any point of the robot, at most (m/s^2)
    drive_low: wp.array(dtype=float)  # (windows,) of drivers and inner knuckles, before, at and after its steps (rad)
    drive_high: wp.array(dtype=float)
    pin: wp.array(dtype=float)  # (windows,) how far an inner finger turned against the gripper (rad)
    failed: wp.array(dtype=int)  # (n,) OVERFLOW, NOT_FINITE
    state: wp.array2d(dtype=float)  # (n, nq + nv) before the first step that was not finite, else after the last


@wp.func
def at_rest(fields: Fields, w: int):
    """Takes all speed out of a world. The next step reads twists of the last one (times 0, which leaves what was not finite)."""
    still = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for b in range(fields.cvel.shape[1]):
        fields.cvel[w, b] = still
    for j in range(fields.qvel.shape[1]):
        fields.cdof_dot[w, j] = still
        fields.qvel[w, j] = 0.0
        fields.qacc_warmstart[w, j] = 0.0


@wp.func
def start_next(worlds: Worlds, queue: Queue, shapes: Shapes, fields: Fields, w: int, record: Record):
    """Puts the next trial of the queue into a world."""
    # whichever world is free first takes the next trial
    slot = wp.atomic_add(worlds.taken, 0, 1)
    if slot >= queue.n[0]:
        worlds.slot[w] = IDLE
        # it stands where the first trial starts: all worlds share one pool of contacts, and none should be left in any
        for j in range(queue.hold.shape[1]):
            fields.ctrl[w, JOINTS + j] = queue.hold[0, j]
        for j in range(JOINTS):
            fields.ctrl[w, j] = queue.start[0, j]
        for j in range(fields.qpos.shape[1]):
            fields.qpos[w, j] = queue.start[0, j]
        at_rest(fields, w)
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
        fields.body_invweight0[w, b] = queue.body_invweight[slot, b]
    # geoms whose mesh depends on the trial
    for k in range(shapes.geom.shape[0]):
        g = shapes.geom[k]
        mesh = queue.mesh[slot, k]
        fields.geom_dataid[w, g] = mesh
        fields.geom_size[w, g] = shapes.size[mesh]
        fields.geom_aabb[w, g, 0] = shapes.aabb[mesh, 0]
        fields.geom_aabb[w, g, 1] = shapes.aabb[mesh, 1]
        fields.geom_rbound[w, g] = shapes.rbound[mesh]
        fields.geom_pos[w, g] = shapes.pos[mesh]
        fields.geom_quat[w, g] = shapes.quat[mesh]
    for k in range(fields.mocap_pos.shape[1]):
        fields.mocap_pos[w, k] = queue.hand_pos[slot]
        fields.mocap_quat[w, k] = queue.hand_quat[slot]
    for j in range(queue.hold.shape[1]):
        fields.ctrl[w, JOINTS + j] = queue.hold[slot, j]
    for j in range(fields.qpos.shape[1]):
        fields.dof_invweight0[w, j] = queue.dof_invweight[slot, j]
        fields.qpos[w, j] = queue.start[slot, j]
        worlds.qpos[w, j] = queue.start[slot, j]
        worlds.qvel[w, j] = 0.0
    at_rest(fields, w)
    for j in range(JOINTS):
        record.q[queue.sample[slot], j] = queue.start[slot, j]


@wp.kernel
def start_worlds(worlds_inout: Worlds, queue: Queue, shapes: Shapes, fields_inout: Fields, record_out: Record):
    """The first trial of every world."""
    start_next(worlds_inout, queue, shapes, fields_inout, wp.tid(), record_out)


@wp.kernel
def command_worlds(law: Law, worlds_inout: Worlds, queue: Queue, fields_inout: Fields, record_out: Record):
    """Before a step: the servos' commands. One that is not finite is noted: torque limits would hide it in the motion."""
    w = wp.tid()
    slot = worlds_inout.slot[w]
    if slot == IDLE:
        return
    t = wp.float64(worlds_inout.step[w]) * law.step
    c = servo_command(law, queue.path, queue.time, queue.length, slot, t)
    for j in range(JOINTS):
        fields_inout.ctrl[w, j] = float(c[j])
        if not wp.isfinite(c[j]):
            record_out.failed[slot] = record_out.failed[slot] | NOT_FINITE


@wp.func
def went_wrong(fields: Fields, w: int):
    """Whether this step lost constraints or contacts of a world: flags are not to be trusted alone, counts are compared."""
    lost = fields.nacon[0] > fields.naconmax or fields.ncollision[0] > fields.naconmax
    return lost or fields.overflow[w] != 0 or fields.nefc[w] > fields.njmax


@wp.func
def window_of(queue: Queue, slot: int, segment: int):
    """A trial's window in `Record`: no two trials share one, as each leaves one for the rest of a division."""
    return queue.sample[slot] / WINDOW + slot + segment / WINDOW


@wp.func
def fastest_change(motion_radius: wp.array2d(dtype=float), worlds: Worlds, fields: Fields, w: int):
    """By how much a step changed the speed of any point of the robot, at most (m/s)."""
    most = float(0.0)
    for b in range(motion_radius.shape[0]):
        change = float(0.0)
        for j in range(JOINTS):
            change += motion_radius[b, j] * wp.abs(fields.qvel[w, j] - worlds.qvel[w, j])
        most = wp.max(most, change)
    return most


@wp.func
def finger_joints(fingers: Fingers, queue: Queue, slot: int, fields: Fields, w: int, side: int):
    """Driver, inner knuckle and how far the inner finger is turned, of one side (`Fingers`)."""
    per_side = (fields.qpos.shape[1] - JOINTS) / 2
    j = JOINTS + per_side * side
    driver = fields.qpos[w, j]
    if fingers.weight.shape[0] > 0:
        off = float(0.0)
        for k in range(per_side):
            off += fingers.weight[k] * wp.abs(fields.qpos[w, j + k] - queue.start[slot, j + k])
        return driver, driver, off
    return driver, fields.qpos[w, j + 2], driver + fields.qpos[w, j + 1]


@wp.func
def note_fingers(record: Record, window: int, fingers: Fingers, queue: Queue, slot: int, fields: Fields, w: int):
    """Widens what a window knows of the finger joints (as SceneModel.fingers)."""
    for side in range(2):
        driver, knuckle, turned = finger_joints(fingers, queue, slot, fields, w, side)
        record.drive_low[window] = wp.min(record.drive_low[window], wp.min(driver, knuckle))
        record.drive_high[window] = wp.max(record.drive_high[window], wp.max(driver, knuckle))
        record.pin[window] = wp.max(record.pin[window], wp.abs(turned))


@wp.func
def finger_sway(fingers: Fingers, queue: Queue, slot: int, fields: Fields, w: int):
    """How far any point of the fingers is from where the trial's drive has it, at most (as SceneModel.sway)."""
    worst = float(0.0)
    drive = queue.hold[slot, 0]
    for side in range(2):
        at, knuckle, turned = finger_joints(fingers, queue, slot, fields, w, side)
        driver = wp.abs(at - drive)
        pin = wp.abs(turned)
        worst = wp.max(worst, driver * wp.max(fingers.driver, fingers.pin_arm) + pin * fingers.pin)
        worst = wp.max(worst, wp.abs(knuckle - drive) * fingers.inner_knuckle)
    return worst


@wp.kernel
def finish_step(
    record_steps: int, step_s: float, fingers: Fingers,
    motion_radius: wp.array2d(dtype=float),  # (bodies, JOINTS)
    worlds_inout: Worlds, queue: Queue, shapes: Shapes, fields_inout: Fields, record_out: Record,
):  # fmt: skip
    """After a step: record, note what went wrong, refill the world when its trial is over."""
    w = wp.tid()
    slot = worlds_inout.slot[w]
    if slot == IDLE:
        return
    nq = fields_inout.qpos.shape[1]
    step = worlds_inout.step[w] + 1
    worlds_inout.step[w] = step
    if went_wrong(fields_inout, w):
        record_out.failed[slot] = record_out.failed[slot] | OVERFLOW
    finite = bool(True)
    for j in range(nq):
        finite = finite and wp.isfinite(fields_inout.qpos[w, j]) and wp.isfinite(fields_inout.qvel[w, j])
    if not finite:
        record_out.failed[slot] = record_out.failed[slot] | NOT_FINITE
    for j in range(JOINTS):
        a = wp.abs(fields_inout.qvel[w, j] - worlds_inout.qvel[w, j]) / step_s
        if a > record_out.acceleration[slot, j]:
            record_out.acceleration[slot, j] = a
    window = window_of(queue, slot, (step - 1) / record_steps)
    change = fastest_change(motion_radius, worlds_inout, fields_inout, w)
    record_out.bend[window] = wp.max(record_out.bend[window], change / step_s)
    if nq > JOINTS:
        record_out.sway[slot] = wp.max(record_out.sway[slot], finger_sway(fingers, queue, slot, fields_inout, w))
        note_fingers(record_out, window, fingers, queue, slot, fields_inout, w)
        if step % (record_steps * WINDOW) == 0 and step < queue.steps[slot]:
            note_fingers(record_out, window + 1, fingers, queue, slot, fields_inout, w)
    if finite:  # the last finite state stays where it is
        for j in range(nq):
            worlds_inout.qpos[w, j] = fields_inout.qpos[w, j]
            worlds_inout.qvel[w, j] = fields_inout.qvel[w, j]
    if step % record_steps == 0:
        for j in range(JOINTS):
            record_out.q[queue.sample[slot] + step / record_steps, j] = fields_inout.qpos[w, j]
    if step == queue.steps[slot]:
        for j in range(nq):
            record_out.state[slot, j] = worlds_inout.qpos[w, j]
            record_out.state[slot, nq + j] = worlds_inout.qvel[w, j]
        wp.atomic_sub(worlds_inout.left, 0, 1)
        start_next(worlds_inout, queue, shapes, fields_inout, w, record_out)
