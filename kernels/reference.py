"""Where the servos shall be at a time, whether the arm has come to rest at its goal, and what each world does next."""

import warp as wp

from r2h_batch.kernels.world import vec6

wp.set_module_options({"enable_backward": False})

f64 = wp.float64
vec6d = wp.types.vector(length=6, dtype=wp.float64)


@wp.struct
class Law:
    """The time law: speed (rad/s) and acceleration (rad/s^2) of the joint that sets the pace; the servos' kv / kp (s)."""

    speed: wp.float64
    acceleration: wp.float64
    lead: wp.float64
    step: wp.float64


@wp.func
def servo_command(
    law: Law,
    path: wp.array3d(dtype=float),
    time: wp.array2d(dtype=float),
    length: wp.array(dtype=int),
    trial: int,
    t: wp.float64,
):
    """q_ref + qd_ref kv / kp at time t of a trial's path (r2h_batch.execute.time_path, in float64)."""
    n = length[trial]
    out = vec6d()
    k = int(0)
    while k < n - 2 and t >= f64(time[trial, k + 1]):
        k += 1
    whole = f64(0.0)
    for j in range(6):
        whole = wp.max(whole, wp.abs(f64(path[trial, k + 1, j]) - f64(path[trial, k, j])))
    a = law.acceleration
    v = wp.min(law.speed, wp.sqrt(a * whole))
    zero = f64(0.0)
    f = f64(1.0)
    rate = zero
    if whole > zero:
        ramp = v / a
        total = ramp + whole / v
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
    for j in range(6):
        q0 = f64(path[trial, k, j])
        d = f64(path[trial, k + 1, j]) - q0
        out[j] = q0 + d * (f + law.lead * rate)
    return out


@wp.kernel
def servo_commands(
    first: int,
    law: Law,
    trial_in: wp.array(dtype=int),
    path_in: wp.array3d(dtype=float),
    time_in: wp.array2d(dtype=float),
    length_in: wp.array(dtype=int),
    command_out: wp.array3d(dtype=wp.float64),  # (rows, steps, 6)
):
    """Commands of every step of the listed trials."""
    tid, step = wp.tid()
    row = first + tid
    c = servo_command(law, path_in, time_in, length_in, trial_in[row], f64(step) * law.step)
    for j in range(6):
        command_out[row, step, j] = c[j]


@wp.kernel
def path_deviation(
    first: int,
    law: Law,
    lever: wp.array2d(dtype=float),  # (bodies, 6)
    object_lever_in: wp.array2d(dtype=float),  # (B, 6)
    path_in: wp.array3d(dtype=float),
    time_in: wp.array2d(dtype=float),
    length_in: wp.array(dtype=int),
    motion_in: wp.array3d(dtype=float),
    motion_length_in: wp.array(dtype=int),
    deviation_out: wp.array(dtype=float),
):
    """How far any point of robot and object was, at most, from where the path has it at a sample's time (m)."""
    trial = first + wp.tid()
    worst = float(0.0)
    for k in range(motion_length_in[trial]):
        c = servo_command(law, path_in, time_in, length_in, trial, f64(k) * law.step)
        off = vec6()
        held = float(0.0)
        for j in range(6):
            off[j] = float(wp.abs(f64(motion_in[trial, k, j]) - c[j]))
            held += off[j] * object_lever_in[trial, j]
        worst = wp.max(worst, held)
        for b in range(lever.shape[0]):
            at = float(0.0)
            for j in range(6):
                at += off[j] * lever[b, j]
            worst = wp.max(worst, at)
    deviation_out[trial] = worst


@wp.struct
class Tool:
    """Joint frames and the ee in the wrist_3 frame."""

    joint_R: wp.array(dtype=wp.mat33)
    joint_p: wp.array(dtype=wp.vec3)
    R_wrist_ee: wp.mat33
    p_wrist_ee: wp.vec3


@wp.func
def ee_pose(tool: Tool, q: vec6):
    """R, p of the ee in the world."""
    R = wp.identity(n=3, dtype=float)
    p = wp.vec3(0.0, 0.0, 0.0)
    for i in range(6):
        p = R * tool.joint_p[i] + p
        c = wp.cos(q[i])
        s = wp.sin(q[i])
        R = R * tool.joint_R[i] * wp.mat33(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)
    return R * tool.R_wrist_ee, R * tool.p_wrist_ee + p


@wp.func
def joints(path: wp.array3d(dtype=float), trial: int, k: int):
    """One posture of a path."""
    q = vec6()
    for j in range(6):
        q[j] = path[trial, k, j]
    return q


@wp.kernel
def settle_sample(
    first: int,
    tool: Tool,
    position_m: float,
    rotation_rad: float,
    goal_in: wp.array3d(dtype=float),  # (B, 1, 6)
    path_in: wp.array3d(dtype=float),
    length_in: wp.array(dtype=int),
    sample_out: wp.array(dtype=int),
):
    """The first sample from which on the ee stays within both tolerances of its pose at the goal; the length if none."""
    trial = first + wp.tid()
    n = length_in[trial]
    k = int(n)
    if n > 0:
        Rg, pg = ee_pose(tool, joints(goal_in, trial, 0))
        near = bool(True)
        while near and k > 0:
            R, p = ee_pose(tool, joints(path_in, trial, k - 1))
            D = wp.transpose(Rg) * R
            axis = wp.vec3(D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1])
            angle = wp.atan2(wp.length(axis), wp.trace(D) - 1.0)
            near = wp.length(p - pg) <= position_m and angle <= rotation_rad
            if near:
                k -= 1
    sample_out[trial] = k
