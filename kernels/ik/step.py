"""Inverse kinematics of a UR arm: fused damped least squares, one thread per (target, shoulder side, wrist sign).

A thread first asks the closed form whether its two branches (elbow up, elbow down) exist. If so, it runs damped least
squares in float64 from the committed seeds, in order, until one converges; the other elbow is its mirror image. The
closed form's own solution is used only where no seed converged (reported as `rescued`), on the singular set
sin q5 = 0 and at the very edge of the reach. Residuals are measured afterwards on the float32 angles that are returned.
"""

import warp as wp

from r2h_batch.kernels.ik.closed_form import BRANCH, BRANCH_EDGE, BRANCH_LINE, closed_form, other_elbow
from r2h_batch.kernels.ik.wrist_center import orthonormal
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import (
    UrParameters,
    to_shoulder,
    ur_ee_rotation,
    ur_pose_error,
    ur_wrist_center,
    vec6d,
    vec12d,
)

wp.set_module_options(OPTIONS)

STATUS_UNREACHABLE = wp.constant(0)  # the closed form has no solution
STATUS_CONVERGED = wp.constant(1)  # damped least squares
STATUS_RESCUED = wp.constant(2)  # no seed converged: the closed form's solution
STATUS_SINGULAR = wp.constant(3)  # sin q5 = 0: one solution out of a line of them
STATUS_EDGE = wp.constant(4)  # solution of a pose within 1 um and 1 urad, where the asked one has none
STATUS_INACTIVE = wp.constant(5)  # masked, or not a rigid transform

TOLERANCE = wp.constant(wp.float64(1e-9))  # metres and radians at which the iteration stops
DAMPING = wp.constant(wp.float64(0.1))
DAMPING_MIN = wp.constant(wp.float64(1e-12))
PI = wp.constant(wp.float64(3.141592653589793))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.func
def turn(c: wp.float64, s: wp.float64, step: wp.float64) -> wp.vec2d:
    """The (cos, sin) pair turned by 2 atan(step / 2): the Cayley map, exact for steps 2 tan(angle / 2)."""
    t = wp.float64(0.5) * step
    k = ONE / (ONE + t * t)
    a = (ONE - t * t) * k
    b = wp.float64(2.0) * t * k
    return wp.vec2d(a * c - b * s, a * s + b * c)


@wp.func
def hand_error(s: vec12d, R: wp.mat33d):
    """Rotation vector (shoulder frame) from a state's hand to R, its length 2 tan(angle / 2); the rotation's trace."""
    now = ur_ee_rotation(s)
    vee = wp.vec3d(ZERO, ZERO, ZERO)
    trace = ZERO
    for k in range(3):
        axis = wp.vec3d(now[0, k], now[1, k], now[2, k])
        goal = to_shoulder(s[0], s[1], wp.vec3d(R[0, k], R[1, k], R[2, k]))
        vee += wp.cross(axis, goal)
        trace += wp.dot(axis, goal)
    # |vee| = 2 sin(angle) and 1 + trace = 2 + 2 cos(angle): their ratio is tan(angle / 2), bounded near half a turn.
    return vee * (wp.float64(2.0) / wp.max(ONE + trace, wp.float64(0.2))), trace


@wp.func
def damped_step(ur: UrParameters, s: vec12d, p: wp.vec3d, e: wp.vec3d, r: wp.vec3d) -> vec12d:
    """The state after one step: p the asked wrist centre, e and r what is missing of it and of the hand (shoulder frame).

    The Jacobian's columns, taken at the wanted wrist centre, in the order of solving (robot/fk.py has u and w):
      joint  wrist centre (x, n, z)                turn of the hand
      q1     (-p_n, p_x, 0)                        z
      psi3   (-d5 cos psi3, 0, d5 sin psi3)        n
      q5     0                                     w(psi3)
      q6     0                                     z_ee
      psi1   a2 (-sin psi1, 0, -cos psi1)          0
      psi2   a3 (-sin psi2, 0, -cos psi2)          0
    Row n of the wrist centre knows q1 only; with q1 known, the hand knows psi3, q5, q6 only; psi1 and psi2 get the rest.
    Each block is (J^T J + lambda 1) d = J^T error.
    """
    # q1
    d1 = e[1] * p[0] / (p[0] * p[0] + DAMPING * e[1] * e[1] + DAMPING_MIN)
    # The hand: the axes n, w, z_ee have length 1; w is square to both others, n . z_ee = cos q5.
    damp = DAMPING * wp.dot(r, r) + DAMPING_MIN
    g3 = r[1]
    g5 = -s[7] * r[0] - s[6] * (r[2] - d1)
    g6 = s[9] * s[6] * r[0] + s[8] * r[1] - s[9] * s[7] * (r[2] - d1)
    a = ONE + damp
    det = a * a - s[8] * s[8]
    d3 = (a * g3 - s[8] * g6) / det
    d6 = (a * g6 - s[8] * g3) / det
    d5 = g5 / a
    # The place in the plane: columns of psi1, psi2; what q1 and psi3 move is known.
    e_x = e[0] + p[1] * d1 + ur.d5 * s[6] * d3
    e_z = e[2] - ur.d5 * s[7] * d3
    damp2 = DAMPING * (e[0] * e[0] + e[2] * e[2]) + DAMPING_MIN
    j1x = -ur.a2 * s[3]
    j1z = -ur.a2 * s[2]
    j2x = -ur.a3 * s[5]
    j2z = -ur.a3 * s[4]
    b1 = j1x * e_x + j1z * e_z
    b2 = j2x * e_x + j2z * e_z
    m11 = ur.a2 * ur.a2 + damp2
    m22 = ur.a3 * ur.a3 + damp2
    m12 = j1x * j2x + j1z * j2z
    kp = ONE / (m11 * m22 - m12 * m12)
    t1 = turn(s[0], s[1], d1)
    p1 = turn(s[2], s[3], (m22 * b1 - m12 * b2) * kp)
    p2 = turn(s[4], s[5], (m11 * b2 - m12 * b1) * kp)
    p3 = turn(s[6], s[7], d3)
    t5 = turn(s[8], s[9], d5)
    t6 = turn(s[10], s[11], d6)
    return vec12d(t1[0], t1[1], p1[0], p1[1], p2[0], p2[1], p3[0], p3[1], t5[0], t5[1], t6[0], t6[1])


@wp.func
def damped_least_squares(
    ur: UrParameters, R: wp.mat33d, p5: wp.vec3d, wrist: wp.float64, iterations: int, seed: vec12d
):
    """The state after damped least squares from a seed, and the number of steps (`iterations` + 1: not converged).

    Errors are taken in the shoulder frame at the wrist centre, where the Jacobian is block triangular (`damped_step`).
    Each block has its own damping, lambda = 0.1 |error|^2 + 1e-12: as in Sugihara 2011 (Solvability-unconcerned inverse
    kinematics by the Levenberg-Marquardt method) it falls with the squared error, so that steps stay bounded near singular
    postures as long as there is something to do, and become Newton's at the end.
    """
    s = seed
    steps = wp.int32(0)
    done = wp.bool(False)
    while not done:
        # The wrist flip (psi3 + pi, -q5, q6 + pi) turns the hand to the same place: keep to the asked sign of sin q5.
        if s[9] * wrist < ZERO:
            s = vec12d(s[0], s[1], s[2], s[3], s[4], s[5], -s[6], -s[7], s[8], -s[9], -s[10], -s[11])
        p = to_shoulder(s[0], s[1], p5)
        e = p - ur_wrist_center(ur, s)
        r, trace = hand_error(s, R)
        e_sq = e[0] * e[0] + e[2] * e[2]
        if wp.max(e_sq + e[1] * e[1], wp.dot(r, r)) < TOLERANCE * TOLERANCE and trace > ONE:
            done = wp.bool(True)
        else:
            steps += 1
            if steps > iterations:
                done = wp.bool(True)
            else:
                s = damped_step(ur, s, p, e, r)
    return s, steps


@wp.func
def place_seed(p5: wp.vec3d, shoulder: wp.float64, seed: vec12d) -> vec12d:
    """A seed turned to the wrist centre's azimuth; mirrored in the arm's plane for the other shoulder side."""
    # q1 of the seed is counted from the wrist centre's azimuth
    r = wp.sqrt(p5[0] * p5[0] + p5[1] * p5[1])
    c = shoulder * p5[0] / r
    s = shoulder * p5[1] / r
    return vec12d(
        c * seed[0] - s * seed[1], s * seed[0] + c * seed[1], shoulder * seed[2], seed[3], shoulder * seed[4], seed[5],
        seed[6], seed[7], seed[8], seed[9], seed[10], seed[11],
    )  # fmt: skip


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
def solve_pair(
    ur: UrParameters, seeds: wp.array2d(dtype=wp.float64), iterations: int, R: wp.mat33d, p5: wp.vec3d,
    shoulder: wp.float64, wrist: wp.float64,
):  # fmt: skip
    """The state with sin q3 >= 0 of one (shoulder, wrist) pair, its STATUS_*, and all steps that were taken.

    Damped least squares from one seed after the other; a result on the other side of the shoulder does not count.
    """
    state, found = closed_form(ur, R, p5, shoulder, wrist)
    status = wp.int32(STATUS_UNREACHABLE)
    steps = wp.int32(0)
    if found == BRANCH_LINE:
        status = wp.int32(STATUS_SINGULAR)
    if found == BRANCH_EDGE:
        status = wp.int32(STATUS_EDGE)
    if found == BRANCH:
        status = wp.int32(STATUS_RESCUED)
        for k in range(seeds.shape[0]):
            if status == STATUS_RESCUED:
                seed = vec12d()
                for j in range(12):
                    seed[j] = seeds[k, j]
                seed = place_seed(p5, shoulder, seed)
                reached, used = damped_least_squares(ur, R, p5, wrist, iterations, seed)
                steps += wp.min(used, iterations)
                side_x = reached[0] * p5[0] + reached[1] * p5[1]
                if used <= iterations and side_x * shoulder >= ZERO:
                    state = reached
                    status = wp.int32(STATUS_CONVERGED)
    # The solution found may have either elbow: put sin q3 >= 0 first.
    if state[5] * state[2] - state[4] * state[3] < ZERO:
        state = other_elbow(ur, state)
    return state, status, steps


# A UR arm has up to eight postures for a pose: the wrist centre before or behind the shoulder (s), elbow up or down (e),
# wrist flipped or not (w). Given s and w, the two elbows are mirror images in the line from shoulder to wrist, so a thread
# solves one pair and turns the elbow over for the other:
#
# 1. the wrist centre p5 = p - tool * z fixes joint 1 up to s; `solve_pair` settles the rest, by damped least squares from
#    seeds, by the closed form where that fails, or finds that the closed form has no solution (status);
# 2. for each elbow: angles from cosines and sines, each joint at the turn nearest to home within its limits;
# 3. residuals of what is returned, not of what was solved: forward kinematics in float64 from the rounded float32 angles.
@wp.kernel
def solve_ik_kernel(
    first: int,
    # tables
    ur: UrParameters, iterations: int, position_tolerance_m: wp.float64, rotation_tolerance_rad: wp.float64,
    # trials
    seeds_in: wp.array2d(dtype=wp.float64), T_world_ee_in: wp.array3d(dtype=wp.float32),
    active_in: wp.array(dtype=wp.bool),
    # out
    q_out: wp.array3d(dtype=wp.float32), valid_out: wp.array2d(dtype=wp.bool),
    position_error_out: wp.array2d(dtype=wp.float32), rotation_error_out: wp.array2d(dtype=wp.float32),
    status_out: wp.array2d(dtype=wp.uint8), steps_out: wp.array2d(dtype=wp.int32),
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
    steps = wp.int32(0)
    state = vec12d()
    if active_in[trial] and rigid:
        p5 = p - ur.tool * wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
        state, status, steps = solve_pair(ur, seeds_in, iterations, R, p5, shoulder, wrist)

    steps_out[trial, pair] = steps
    status_out[trial, pair] = wp.uint8(status)
    solved = status >= STATUS_CONVERGED and status <= STATUS_EDGE
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
