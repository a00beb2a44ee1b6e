"""Inverse kinematics of a UR arm in closed form, one thread per (target, shoulder side, wrist sign).

A thread asks the closed form for one of its two branches (elbow up, elbow down); the other is its mirror image. Residuals
are measured afterwards on the float32 angles that are returned.
"""

import warp as wp

from r2h_batch.kernels.ik.closed_form import BRANCH, BRANCH_EDGE, BRANCH_LINE, closed_form, other_elbow
from r2h_batch.kernels.ik.wrist_center import orthonormal
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import UrParameters, ur_pose_error, vec6d, vec12d

wp.set_module_options(OPTIONS)

STATUS_UNREACHABLE = wp.constant(0)  # the closed form has no solution
STATUS_FOUND = wp.constant(1)
STATUS_CONVERGED = wp.constant(2)  # found by damped least squares (judge/ik_jacobian.py), not here
STATUS_SINGULAR = wp.constant(3)  # sin q5 = 0: one solution out of a line of them
STATUS_EDGE = wp.constant(4)  # solution of a pose within 1 um and 1 urad, where the asked one has none
STATUS_INACTIVE = wp.constant(5)  # masked, or not a rigid transform

PI = wp.constant(wp.float64(3.141592653589793))
ONE = wp.constant(wp.float64(1.0))


@wp.func
def nearest_turn(angle: wp.float64, home: wp.float64, lower: wp.float64, upper: wp.float64) -> wp.float32:
    """`angle` moved by whole turns: as near to home as the limits allow, and within them after rounding to float32.

    A range of less than a turn may hold none of these angles: `within_limits` tells.
    """
    two_pi = wp.float64(2.0) * PI
    q = angle - two_pi * wp.floor((angle - home) / two_pi + wp.float64(0.5))
    if q > upper:
        q -= two_pi
    if q < lower:
        q += two_pi
    q32 = wp.float32(q)
    if wp.float64(q32) > upper or wp.float64(q32) < lower:
        q32 = wp.float32(q * wp.float64(0.9999999))
    return q32


@wp.func
def within_limits(ur: UrParameters, q: vec6d) -> wp.bool:
    inside = wp.bool(True)
    for j in range(6):
        if q[j] < ur.lower[j] or q[j] > ur.upper[j]:
            inside = wp.bool(False)
    return inside


@wp.func
def joint_angles(ur: UrParameters, s: vec12d) -> vec6d:
    """Joint angles of a state, each from its own (cos, sin) pair or the difference of two."""
    return vec6d(
        wp.atan2(s[1], s[0]),
        wp.atan2(s[3], s[2]),
        wp.atan2(s[5] * s[2] - s[4] * s[3], s[4] * s[2] + s[5] * s[3]),
        wp.atan2(s[7] * s[4] - s[6] * s[5], s[6] * s[4] + s[7] * s[5]),
        wp.atan2(s[9], s[8]),
        wp.atan2(s[11], s[10]),
    )


@wp.func
def read_target(T_world_ee: wp.array3d(dtype=wp.float32), trial: int):
    """A target in float64: R with exactly orthonormal axes, p, and whether it was near enough to a rigid transform."""
    x = wp.vec3d()
    y = wp.vec3d()
    z = wp.vec3d()
    p = wp.vec3d()
    for i in range(3):
        x[i] = wp.float64(T_world_ee[trial, i, 0])
        y[i] = wp.float64(T_world_ee[trial, i, 1])
        z[i] = wp.float64(T_world_ee[trial, i, 2])
        p[i] = wp.float64(T_world_ee[trial, i, 3])
    skew = wp.abs(wp.dot(x, x) - ONE) + wp.abs(wp.dot(y, y) - ONE) + wp.abs(wp.dot(z, z) - ONE)
    skew += wp.length(wp.cross(y, z) - x)
    rigid = skew < wp.float64(1e-2) and wp.dot(p, p) < wp.float64(1e6)  # false for NaN
    return orthonormal(y, z), p, rigid


@wp.func
def solve_pair(ur: UrParameters, R: wp.mat33d, p5: wp.vec3d, shoulder: wp.float64, wrist: wp.float64):
    """The state with sin q3 >= 0 of one (shoulder, wrist) pair, and its STATUS_*."""
    state, found = closed_form(ur, R, p5, shoulder, wrist)
    status = wp.int32(STATUS_UNREACHABLE)
    if found == BRANCH:
        status = wp.int32(STATUS_FOUND)
    if found == BRANCH_LINE:
        status = wp.int32(STATUS_SINGULAR)
    if found == BRANCH_EDGE:
        status = wp.int32(STATUS_EDGE)
    return state, status


# A UR arm has up to eight postures for a pose: the wrist centre before or behind the shoulder (s), elbow up or down (e),
# wrist flipped or not (w). Given s and w, the two elbows are mirror images in the line from shoulder to wrist, so a thread
# solves one pair and turns the elbow over for the other:
#
# 1. the wrist centre p5 = p - tool * z fixes joint 1 up to s; the closed form settles the rest, or has no solution (status);
# 2. for each elbow: angles from cosines and sines, each joint at the turn nearest to home within its limits;
# 3. residuals of what is returned, not of what was solved: forward kinematics in float64 from the rounded float32 angles.
@wp.kernel
def solve_ik_kernel(
    first: int,
    # tables
    ur: UrParameters, position_tolerance_m: wp.float64, rotation_tolerance_rad: wp.float64,
    # trials
    T_world_ee_in: wp.array3d(dtype=wp.float32), active_in: wp.array(dtype=wp.bool),
    # out
    q_out: wp.array3d(dtype=wp.float32), valid_out: wp.array2d(dtype=wp.bool),
    position_error_out: wp.array2d(dtype=wp.float32), rotation_error_out: wp.array2d(dtype=wp.float32),
    status_out: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """Branches 4 shoulder + 2 elbow + wrist of one target; thread (target, pair), pair = 2 shoulder + wrist."""
    item, pair = wp.tid()
    trial = first + item
    side = pair // 2
    flip = pair % 2
    shoulder = ONE
    if side == 1:
        shoulder = -ONE
    wrist = ONE
    if flip == 1:
        wrist = -ONE

    R, p, rigid = read_target(T_world_ee_in, trial)
    status = wp.int32(STATUS_INACTIVE)
    state = vec12d()
    if active_in[trial] and rigid:
        p5 = p - ur.tool * wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
        state, status = solve_pair(ur, R, p5, shoulder, wrist)

    status_out[trial, pair] = wp.uint8(status)
    solved = status >= STATUS_FOUND and status <= STATUS_EDGE
    for elbow in range(2):
        slot = 4 * side + 2 * elbow + flip
        valid = wp.bool(False)
        position_error_out[trial, slot] = wp.float32(wp.inf)
        rotation_error_out[trial, slot] = wp.float32(wp.inf)
        if solved:
            if elbow == 1:
                state = other_elbow(ur, state)
            q = joint_angles(ur, state)
            rounded = vec6d()
            for j in range(6):
                q32 = nearest_turn(q[j], ur.home[j], ur.lower[j], ur.upper[j])
                q_out[trial, slot, j] = q32
                rounded[j] = wp.float64(q32)
            # Residuals of what is returned: forward kinematics from the rounded angles.
            position_error, rotation_error = ur_pose_error(ur, rounded, R, p)
            position_error_out[trial, slot] = wp.float32(position_error)
            rotation_error_out[trial, slot] = wp.float32(rotation_error)
            close = position_error <= position_tolerance_m and rotation_error <= rotation_tolerance_rad
            valid = close and within_limits(ur, rounded)
        if not valid:
            for j in range(6):
                q_out[trial, slot, j] = wp.float32(wp.nan)
        valid_out[trial, slot] = valid
