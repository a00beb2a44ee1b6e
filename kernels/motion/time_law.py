"""Servo setpoints at a time, and a motion's deviation from them."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

from ..robot.joints import JOINTS, vecq, vecqd
from ..robot.posture import duration, peak_speed

wp.set_module_options(OPTIONS)

f64 = wp.float64


@wp.struct
class Law:
    """The time law: speed (rad/s) and acceleration (rad/s^2) of the slowest joint; the servos' kv / kp (s).

    `weight`: what a radian of each joint counts for.
    """

    speed: wp.float64
    acceleration: wp.float64
    weight: vecqd
    lead: wp.float64
    step: wp.float64


@wp.func
def servo_command(
    law: Law, path: wp.array3d(dtype=float), time: wp.array2d(dtype=float), length: wp.array(dtype=int),
    trial: int, t: wp.float64,
):  # fmt: skip
    """q_ref + qd_ref kv / kp at time t of a trial's path (judge/motion/time_law.py, in float64)."""
    n = length[trial]
    out = vecqd()
    # the segment that t falls into; the last one from there on
    k = int(0)
    while k < n - 2 and t >= f64(time[trial, k + 1]):
        k += 1
    # all joints run the same share f of the segment, paced by the one with the farthest to go
    whole = f64(0.0)
    for j in range(JOINTS):
        d = wp.abs(f64(path[trial, k + 1, j]) - f64(path[trial, k, j]))
        whole = wp.max(whole, d * law.weight[j])
    a = law.acceleration
    v = peak_speed(whole, law.speed, a)
    zero = f64(0.0)
    f = f64(1.0)
    rate = zero
    if whole > zero:
        # f(t) = a t^2 / 2 up, linear, and the first part backwards, all over `whole`; rate = df/dt
        ramp = v / a
        total = duration(whole, law.speed, a)
        at = wp.clamp(t - f64(time[trial, k]), zero, total)
        if at < ramp:
            f = f64(0.5) * a * at * at / whole
            rate = a * at / whole
        elif at <= total - ramp:
            f = v * (at - f64(0.5) * ramp) / whole
            rate = v / whole
        else:
            left = total - at
            f = f64(1.0) - f64(0.5) * a * left * left / whole
            rate = a * left / whole
    for j in range(JOINTS):
        q0 = f64(path[trial, k, j])
        d = f64(path[trial, k + 1, j]) - q0
        # position servos lag by kv / kp times the speed: their setpoint is the arm's reference that much later
        out[j] = q0 + d * (f + law.lead * rate)
    return out


@wp.kernel
def servo_commands(
    first: int, law: Law, trial_in: wp.array(dtype=int), path_in: wp.array3d(dtype=float),
    time_in: wp.array2d(dtype=float), length_in: wp.array(dtype=int),
    command_out: wp.array3d(dtype=wp.float64),  # (rows, steps, JOINTS or more): the arm's come first
):  # fmt: skip
    """Commands of every step of the listed trials."""
    tid, step = wp.tid()
    row = first + tid
    c = servo_command(law, path_in, time_in, length_in, trial_in[row], f64(step) * law.step)
    for j in range(JOINTS):
        command_out[row, step, j] = c[j]


@wp.kernel
def path_deviation(
    first: int,
    # tables
    law: Law,
    motion_radius: wp.array2d(dtype=float),  # (bodies, JOINTS)
    # trials
    object_motion_radius_in: wp.array2d(dtype=float),  # (B, JOINTS)
    path_in: wp.array3d(dtype=float), time_in: wp.array2d(dtype=float), length_in: wp.array(dtype=int),
    motion_in: wp.array3d(dtype=float), motion_length_in: wp.array(dtype=int),
    # out
    deviation_out: wp.array(dtype=float),
):  # fmt: skip
    """How far any point of robot and object was, at most, from where the path has it at a sample's time (m)."""
    trial = first + wp.tid()
    worst = float(0.0)
    for k in range(motion_length_in[trial]):
        c = servo_command(law, path_in, time_in, length_in, trial, f64(k) * law.step)
        off = vecq()
        held = float(0.0)
        for j in range(JOINTS):
            off[j] = float(wp.abs(f64(motion_in[trial, k, j]) - c[j]))
            held += off[j] * object_motion_radius_in[trial, j]
        worst = wp.max(worst, held)
        for b in range(motion_radius.shape[0]):
            at = float(0.0)
            for j in range(JOINTS):
                at += off[j] * motion_radius[b, j]
            worst = wp.max(worst, at)
    deviation_out[trial] = worst
