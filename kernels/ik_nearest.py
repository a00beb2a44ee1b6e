"""Where a UR arm comes nearest to a target that it cannot reach: the hand turned as asked, the elbow stretched or folded.

The closed form of ik_closed_form.py with its two conditions clamped: a wrist centre too near to the axis of joint 1 is
moved out to the arm's offset d4, and one that both links do not reach is moved along the line to the shoulder. The ee
frame's axes stay exact, so what is left is a distance.
"""

import warp as wp

from r2h_batch.kernels.fk import (
    UrParameters,
    from_shoulder,
    to_shoulder,
    ur_ee_rotation,
    ur_state,
    ur_wrist_center,
    vec6d,
    vec12d,
)
from r2h_batch.kernels.ik_closed_form import SINGULAR_SIN, elbow_reach
from r2h_batch.kernels.ik_step import joint_angles, nearest_turn

wp.set_module_options({"enable_backward": False})

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1e-12))
LEAST = wp.constant(wp.float64(1e-6))  # a target that was called unreachable is missed by this at least


@wp.func
def clamped_form(ur: UrParameters, R: wp.mat33d, p5: wp.vec3d, shoulder: wp.float64, wrist: wp.float64):
    """The state with sin q3 >= 0 that comes nearest to the wrist centre p5 with the hand turned as R; by how much it misses."""
    r = wp.sqrt(p5[0] * p5[0] + p5[1] * p5[1])
    rho = shoulder * wp.sqrt(wp.max(r * r - ur.d4 * ur.d4, ZERO))
    c1 = p5[0] * rho + p5[1] * ur.d4
    s1 = p5[1] * rho - p5[0] * ur.d4
    scale = wp.sqrt(c1 * c1 + s1 * s1)
    if scale > TINY:
        c1 = c1 / scale
        s1 = s1 / scale
    else:  # on the axis of joint 1: all its angles are equally near
        c1 = ONE
        s1 = ZERO
    z_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 2], R[1, 2], R[2, 2]))
    x_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 0], R[1, 0], R[2, 0]))
    y_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 1], R[1, 1], R[2, 1]))
    c5 = z_ee[1]
    s5 = wrist * wp.sqrt(z_ee[0] * z_ee[0] + z_ee[2] * z_ee[2])
    height = p5[2] - ur.d1
    c3 = ONE
    s3 = ZERO
    if wp.abs(s5) > SINGULAR_SIN:
        c3 = z_ee[0] / s5
        s3 = -z_ee[2] / s5
    else:  # psi3 is free: the end of its line that brings the elbow nearest
        s5 = ZERO
        d = wp.max(wp.sqrt(rho * rho + height * height), TINY)
        s3 = -rho / d
        c3 = -height / d
        if elbow_reach(ur, rho - ur.d5 * s3, height - ur.d5 * c3) < elbow_reach(
            ur, rho + ur.d5 * s3, height + ur.d5 * c3
        ):
            s3 = -s3
            c3 = -c3
    x = rho + ur.d5 * s3
    z = height + ur.d5 * c3
    beyond = wp.max(elbow_reach(ur, x, z), ZERO)
    off = wp.max(ur.d4 - r, ZERO)
    d_sq = wp.max(x * x + z * z, TINY)
    cq3 = wp.clamp((d_sq - ur.a2 * ur.a2 - ur.a3 * ur.a3) / (wp.float64(2.0) * ur.a2 * ur.a3), -ONE, ONE)
    sq3 = wp.sqrt(ONE - cq3 * cq3)
    e_x = ur.a2 + ur.a3 * cq3
    e_z = -ur.a3 * sq3
    k = ONE / wp.sqrt((e_x * e_x + e_z * e_z) * d_sq)
    cp1 = (x * e_x + z * e_z) * k
    sp1 = (x * e_z - z * e_x) * k
    s6 = s3 * x_ee[0] + c3 * x_ee[2]
    c6 = s3 * y_ee[0] + c3 * y_ee[2]
    k6 = ONE / wp.sqrt(s6 * s6 + c6 * c6)
    state = vec12d(
        c1, s1, cp1, sp1, cp1 * cq3 - sp1 * sq3, sp1 * cq3 + cp1 * sq3, c3, s3, c5, s5, c6 * k6, s6 * k6
    )  # fmt: skip
    return state, wp.sqrt(beyond * beyond + off * off)


@wp.kernel
def nearest_posture(
    first: int,
    ur: UrParameters,
    rotation_lever_m: wp.float64,
    wanted_in: wp.array(dtype=wp.bool),
    T_world_ee_in: wp.array(dtype=wp.mat44),
    q_out: wp.array2d(dtype=wp.float32),
    residual_out: wp.array(dtype=wp.float32),
):
    """The nearest posture of each wanted target, and its residual: metres, plus `rotation_lever_m` times radians."""
    trial = first + wp.tid()
    if not wanted_in[trial]:
        return
    T = T_world_ee_in[trial]
    x = wp.vec3d()
    y = wp.vec3d()
    z = wp.vec3d()
    p = wp.vec3d()
    for i in range(3):
        y[i] = wp.float64(T[i, 1])
        z[i] = wp.float64(T[i, 2])
        p[i] = wp.float64(T[i, 3])
    z = wp.normalize(z)
    y = wp.normalize(y - wp.dot(y, z) * z)
    x = wp.cross(y, z)
    R = wp.mat33d(x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2])
    state = vec12d()
    least = wp.float64(1e30)
    for pair in range(4):
        shoulder = wp.where(pair < 2, ONE, -ONE)
        wrist = wp.where(pair % 2 == 0, ONE, -ONE)
        s, miss = clamped_form(ur, R, p - ur.tool * z, shoulder, wrist)
        if miss < least:
            least = miss
            state = s
    q = joint_angles(ur, state)
    rounded = vec6d()
    for j in range(6):
        q32 = nearest_turn(q[j], ur.home[j], ur.lower[j], ur.upper[j])
        q_out[trial, j] = q32
        rounded[j] = wp.float64(q32)
    s = ur_state(rounded)
    A = ur_ee_rotation(s)
    vee = wp.vec3d()
    trace = ZERO
    for k in range(3):
        axis = from_shoulder(s[0], s[1], wp.vec3d(A[0, k], A[1, k], A[2, k]))
        goal = wp.vec3d(R[0, k], R[1, k], R[2, k])
        vee += wp.cross(axis, goal)
        trace += wp.dot(axis, goal)
    tool = wp.vec3d(ur.tool * A[0, 2], ur.tool * A[1, 2], ur.tool * A[2, 2])
    at = from_shoulder(s[0], s[1], ur_wrist_center(ur, s) + tool)
    angle = wp.atan2(wp.length(vee), trace - ONE)
    residual_out[trial] = wp.float32(wp.max(wp.length(at - p) + rotation_lever_m * angle, LEAST))
