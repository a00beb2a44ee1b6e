"""Where a UR arm comes nearest to a target that it cannot reach: the hand turned as asked, the elbow stretched or folded.

The closed form of closed_form.py with its two conditions clamped: a wrist centre too near to the axis of joint 1 is
moved out to the arm's offset d4, and one that both links do not reach is moved along the line to the shoulder. The ee
frame's axes stay exact, so what is left is a distance.
"""

import warp as wp

from r2h_batch.kernels.ik.closed_form import SINGULAR_SIN
from r2h_batch.kernels.ik.step import joint_angles, nearest_turn
from r2h_batch.kernels.ik.wrist_center import arm_state, elbow_reach, orthonormal, shoulder_turn
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import UrParameters, to_shoulder, ur_pose_error, vec6d, vec12d

wp.set_module_options(OPTIONS)

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1e-12))
LEAST = wp.constant(wp.float64(1e-6))  # a target that was called unreachable is missed by this at least


@wp.func
def clamped_form(ur: UrParameters, R: wp.mat33d, p5: wp.vec3d, shoulder: wp.float64, wrist: wp.float64):
    """The state with sin q3 >= 0 that comes nearest to the wrist centre p5 with the hand turned as R; by how much it misses."""
    r = wp.sqrt(p5[0] * p5[0] + p5[1] * p5[1])
    c1, s1, rho = shoulder_turn(ur, p5, shoulder)
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
    # what is missed: within the arm's plane by the links' reach, square to it by the offset d4
    beyond = wp.max(elbow_reach(ur, x, z), ZERO)
    off = wp.max(ur.d4 - r, ZERO)
    state = arm_state(ur, c1, s1, x, z, c3, s3, c5, s5, x_ee, y_ee)
    return state, wp.sqrt(beyond * beyond + off * off)


@wp.kernel
def nearest_posture(
    first: int,
    ur: UrParameters,
    rotation_lever_m: wp.float64,
    active_in: wp.array(dtype=wp.bool),
    branches_in: wp.array2d(dtype=wp.bool),  # (B, 8) that reach the target
    T_world_ee_in: wp.array(dtype=wp.mat44),
    q_out: wp.array2d(dtype=wp.float32),
    residual_out: wp.array(dtype=wp.float32),
):
    """The nearest posture of each target that no branch reaches, and its residual: metres, plus `rotation_lever_m` x radians.

    NaN where a branch does, or the trial is not active.
    """
    trial = first + wp.tid()
    wanted = active_in[trial]
    for k in range(branches_in.shape[1]):
        if branches_in[trial, k]:
            wanted = False
    if not wanted:
        residual_out[trial] = wp.nan
        for j in range(6):
            q_out[trial, j] = wp.nan
        return
    T = T_world_ee_in[trial]
    y = wp.vec3d()
    z = wp.vec3d()
    p = wp.vec3d()
    for i in range(3):
        y[i] = wp.float64(T[i, 1])
        z[i] = wp.float64(T[i, 2])
        p[i] = wp.float64(T[i, 3])
    R = orthonormal(y, z)
    p5 = p - ur.tool * wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
    state = vec12d()
    least = wp.float64(1e30)
    for pair in range(4):
        shoulder = wp.where(pair < 2, ONE, -ONE)
        wrist = wp.where(pair % 2 == 0, ONE, -ONE)
        s, miss = clamped_form(ur, R, p5, shoulder, wrist)
        if miss < least:
            least = miss
            state = s
    q = joint_angles(ur, state)
    rounded = vec6d()
    for j in range(6):
        q32 = nearest_turn(q[j], ur.home[j], ur.lower[j], ur.upper[j])
        q_out[trial, j] = q32
        rounded[j] = wp.float64(q32)
    distance, angle = ur_pose_error(ur, rounded, R, p)
    residual_out[trial] = wp.float32(wp.max(distance + rotation_lever_m * angle, LEAST))
