"""Where a UR arm comes nearest to a target that it cannot reach, with the hand turned as asked.

Once joint 1 and the sign of sin q5 are chosen, the hand's turn gives psi3 and q5 (closed_form.py), and the wrist centre
misses the target by two lengths square to each other: across the arm's plane |y - d4|, within it what the links do not
reach (`elbow_reach`). What is left is a minimum over joint 1, of which there are up to five for each sign.

With theta the angle from the arm's plane to the ee's z axis seen from above, u(psi3) is along (h cos theta, v); h, v are the
horizontal and the vertical part of that axis. Where v is small, psi3 turns by pi within |v|/h of theta = pi/2. So each half
turn of theta is sampled twice, evenly in theta and evenly in the angle of (h cos theta, |v|). Every minimum of the samples
is narrowed down by golden sections, unless it cannot fall below the least found. Of 3,000 random targets the largest error
is 0.01 mm (tests/kernels/test_nearest.py).
"""

import warp as wp

from r2h_batch.kernels.ik.closed_form import SINGULAR_SIN
from r2h_batch.kernels.ik.step import joint_angles, nearest_turn
from r2h_batch.kernels.ik.wrist_center import arm_state, elbow_reach, orthonormal
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import UrParameters, to_shoulder, ur_pose_error, vec6d, vec12d

wp.set_module_options(OPTIONS)

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1e-12))
LEAST = wp.constant(wp.float64(1e-6))  # a target that was called unreachable is missed by this at least
PI = wp.constant(wp.float64(3.141592653589793))
GOLDEN = wp.constant(wp.float64(0.6180339887498949))
STEP = wp.constant(wp.float64(0.125))  # of half a turn, between samples


@wp.struct
class Wanted:
    """The target's wrist centre (world, m) and its ee's z axis: horizontal direction, horizontal and vertical part."""

    p5: wp.vec3d
    cos_a: wp.float64
    sin_a: wp.float64
    h: wp.float64
    v: wp.float64


@wp.struct
class Way:
    """One of eight ways to sample: the sign of sin theta, the sign of sin q5, evenly in psi3 or in theta."""

    half: wp.float64
    wrist: wp.float64
    by_psi3: wp.bool


@wp.func
def wanted_of(R: wp.mat33d, p5: wp.vec3d) -> Wanted:
    """Inputs of the search from a target with rotation R; at sin q5 = 0 psi3 is any angle, so v = 0 counts as
    `SINGULAR_SIN`."""
    w = Wanted()
    w.p5 = p5
    w.cos_a = ONE
    w.h = wp.sqrt(R[0, 2] * R[0, 2] + R[1, 2] * R[1, 2])
    if w.h > TINY:
        w.cos_a = R[0, 2] / w.h
        w.sin_a = R[1, 2] / w.h
    w.v = R[2, 2]
    if wp.abs(w.v) < SINGULAR_SIN:
        w.v = SINGULAR_SIN
    return w


@wp.func
def turn_at(w: Wanted, way: Way, t: wp.float64):
    """cos, sin of joint 1 at t in [0, 1] of a way."""
    c = ZERO
    if way.by_psi3:
        least = wp.atan2(wp.abs(w.v), w.h)
        angle = least + t * (PI - wp.float64(2.0) * least)
        c = wp.abs(w.v) * wp.cos(angle) / (wp.max(w.h, TINY) * wp.sin(angle))
        c = wp.clamp(c, -ONE, ONE)
    else:
        c = wp.cos(PI * t)
    s = way.half * wp.sqrt(ONE - c * c)
    return w.cos_a * c + w.sin_a * s, w.sin_a * c - w.cos_a * s


@wp.func
def arm_at(ur: UrParameters, w: Wanted, way: Way, t: wp.float64):
    """The square of what is missed (m^2), and what `arm_state` needs: q1, the links' end, psi3, sin q5."""
    c1, s1 = turn_at(w, way, t)
    p = to_shoulder(c1, s1, w.p5)
    forward = w.h * (c1 * w.cos_a + s1 * w.sin_a)
    s5 = way.wrist * wp.sqrt(forward * forward + w.v * w.v)
    c3 = forward / s5
    s3 = -w.v / s5
    x = p[0] + ur.d5 * s3
    z = p[2] - ur.d1 + ur.d5 * c3
    off = p[1] - ur.d4
    beyond = wp.max(elbow_reach(ur, x, z), ZERO)
    return off * off + beyond * beyond, c1, s1, x, z, c3, s3, s5


@wp.func
def missed(ur: UrParameters, w: Wanted, way: Way, t: wp.float64) -> wp.float64:
    """The square of what is missed (m^2) at t of a way."""
    miss, _c1, _s1, _x, _z, _c3, _s3, _s5 = arm_at(ur, w, way, t)
    return miss


@wp.func
def narrow(ur: UrParameters, w: Wanted, way: Way, low: wp.float64, high: wp.float64):
    """The t in [low, high] that a golden section ends at, and the square of what is missed there."""
    a = high - GOLDEN * (high - low)
    b = low + GOLDEN * (high - low)
    at_a = missed(ur, w, way, a)
    at_b = missed(ur, w, way, b)
    sections = int(16)
    for _ in range(sections):
        if at_a < at_b:
            high = b
            b = a
            at_b = at_a
            a = high - GOLDEN * (high - low)
            at_a = missed(ur, w, way, a)
        else:
            low = a
            a = b
            at_a = at_b
            b = low + GOLDEN * (high - low)
            at_b = missed(ur, w, way, b)
    t = wp.where(at_a < at_b, a, b)
    return t, wp.min(at_a, at_b)


@wp.func
def nearest_state(ur: UrParameters, R: wp.mat33d, p5: wp.vec3d) -> vec12d:
    """The state with sin q3 >= 0 whose hand is turned as R and whose wrist centre comes nearest to p5."""
    w = wanted_of(R, p5)
    best = Way()
    where = ZERO
    least = wp.float64(1e30)
    ways = int(8)
    samples = int(9)
    for k in range(ways):
        way = Way()
        way.half = wp.where(k % 2 == 0, ONE, -ONE)
        way.wrist = wp.where(k % 4 < 2, ONE, -ONE)
        way.by_psi3 = k > 3
        now = missed(ur, w, way, ZERO)
        after = missed(ur, w, way, STEP)
        before = after
        for i in range(samples):
            t = STEP * wp.float64(i)
            # a parabola through three samples is at most an eighth of the last difference below the middle one
            if now <= before and now < after and now - wp.max(before - now, after - now) < least:
                t, low = narrow(ur, w, way, wp.max(t - STEP, ZERO), wp.min(t + STEP, ONE))
                if low < least:
                    least = low
                    where = t
                    best = way
            before = now
            now = after
            if i < samples - 2:
                after = missed(ur, w, way, STEP * wp.float64(i + 2))
            else:
                after = before
    _miss, c1, s1, x, z, c3, s3, s5 = arm_at(ur, w, best, where)
    x_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 0], R[1, 0], R[2, 0]))
    y_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 1], R[1, 1], R[2, 1]))
    c5 = c1 * R[1, 2] - s1 * R[0, 2]
    return arm_state(ur, c1, s1, x, z, c3, s3, c5, s5, x_ee, y_ee)


@wp.kernel
def nearest_posture(
    first: int, ur: UrParameters, rotation_lever_m: wp.float64, active_in: wp.array(dtype=wp.bool),
    branches_in: wp.array2d(dtype=wp.bool),  # (B, 8) that reach the target
    T_world_ee_in: wp.array(dtype=wp.mat44), q_out: wp.array2d(dtype=wp.float32),
    residual_out: wp.array(dtype=wp.float32),
):  # fmt: skip
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
    q = joint_angles(ur, nearest_state(ur, R, p5))
    rounded = vec6d()
    for j in range(6):
        q32 = nearest_turn(q[j], ur.home[j], ur.lower[j], ur.upper[j])
        q_out[trial, j] = q32
        rounded[j] = wp.float64(q32)
    distance, angle = ur_pose_error(ur, rounded, R, p)
    residual_out[trial] = wp.float32(wp.max(distance + rotation_lever_m * angle, LEAST))
