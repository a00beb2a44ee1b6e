"""Inverse kinematics of any chain of turning joints: damped least squares from stored seeds, distinct postures kept.

A thread takes one target. It tries the seeds whose ee is nearest to it, nearest first, until it has K postures or no
seed is left. A step is dq = J^T y with (J J^T + lambda 1) y = e and lambda = 0.1 |e|^2 + 1e-6 (Sugihara 2011): the task has
six rows whatever the number of joints. A joint that a step takes beyond its limit stays there, and leaves the Jacobian while
it is pushed on. That no seed converges proves nothing; a target farther than the arm is long is proven unreachable.
"""

import warp as wp

from r2h_batch.kernels.ik.jacobian import mat67d, rotation_vector, solve_spd
from r2h_batch.kernels.ik.step import STATUS_INACTIVE, STATUS_UNREACHABLE, read_target
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import vec6d

from ..robot.joints import JOINTS, vecqd

wp.set_module_options(OPTIONS | {"max_unroll": 0})

STATUS_NOT_FOUND = wp.constant(6)  # no seed converged; the list of ik/step.py goes on here
STATUS_SOME = wp.constant(7)  # there may be more postures than were found
MOST_SEEDS = wp.constant(64)
"""Seeds of a target that are tried, at most."""

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
HALF = wp.constant(wp.float64(0.5))
TWO_PI = wp.constant(wp.float64(6.283185307179586))
CONVERGED = wp.constant(wp.float64(1e-7))  # metres and radians at which the iteration stops
DAMPING = wp.constant(wp.float64(0.1))
DAMPING_MIN = wp.constant(wp.float64(1e-6))
RELEASE = wp.constant(4)
"""Every so many steps a joint that was held at its limit is asked again."""
TURN_M = wp.constant(0.3)
"""Metres that half a turn's chord counts for when seeds are sorted."""


@wp.struct
class Chain:
    """A chain of joints about z: frames from the link before (the last: ee in the last link), limits (rad)."""

    R: wp.array(dtype=wp.mat33d)  # (JOINTS + 1,)
    p: wp.array(dtype=wp.vec3d)
    lower: wp.array(dtype=wp.float64)  # (JOINTS,)
    upper: wp.array(dtype=wp.float64)
    center: wp.vec3d  # the ee is never farther from here than
    reach: wp.float64  # this (m)


@wp.struct
class Seeds:
    """S postures (rad) and where they have the ee."""

    q: wp.array2d(dtype=wp.float64)  # (S, JOINTS)
    p: wp.array(dtype=wp.vec3)
    turn: wp.array(dtype=wp.quat)


@wp.func
def ee_of(
    chain: Chain,
    q: vecqd,
    axes: wp.array(dtype=wp.vec3d),  # (JOINTS,) out: the joints' axes and points on them, world frame
    origins: wp.array(dtype=wp.vec3d),
):
    """R, p of the ee in the world; writes the joints' axes."""
    R = wp.identity(n=3, dtype=wp.float64)
    p = wp.vec3d()
    for j in range(JOINTS):
        p = R * chain.p[j] + p
        c = wp.cos(q[j])
        s = wp.sin(q[j])
        R = R * chain.R[j] * wp.mat33d(c, -s, ZERO, s, c, ZERO, ZERO, ZERO, ONE)
        axes[j] = wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
        origins[j] = p
    return R * chain.R[JOINTS], R * chain.p[JOINTS] + p


@wp.func
def damped_step(
    axes: wp.array(dtype=wp.vec3d), linear: wp.array(dtype=wp.vec3d), free: vecqd, damping: wp.float64, e: vec6d
):
    """J^T (J J^T + damping 1)^-1 e over the joints that are free (1, else 0)."""
    A = mat67d()
    for j in range(JOINTS):
        a = free[j] * axes[j]
        v = free[j] * linear[j]
        column = vec6d(v[0], v[1], v[2], a[0], a[1], a[2])
        for r in range(6):
            for m in range(r, 6):
                A[r, m] = A[r, m] + column[r] * column[m]
    for r in range(6):
        for m in range(r):
            A[r, m] = A[m, r]
        A[r, r] = A[r, r] + damping
        A[r, 6] = e[r]
    y = solve_spd(A)
    d = vecqd()
    for j in range(JOINTS):
        moved = wp.dot(linear[j], wp.vec3d(y[0], y[1], y[2])) + wp.dot(axes[j], wp.vec3d(y[3], y[4], y[5]))
        d[j] = free[j] * moved
    return d


@wp.func
def descend(
    iterations: int, chain: Chain, start: vecqd, goal_R: wp.mat33d, goal_p: wp.vec3d,
    axes: wp.array(dtype=wp.vec3d), linear: wp.array(dtype=wp.vec3d),  # (JOINTS,) scratch
):  # fmt: skip
    """Joint angles from a seed, and the steps taken (iterations + 1: not converged)."""
    q = start
    free = vecqd()
    for j in range(JOINTS):
        free[j] = ONE
    step = int(0)
    done = bool(False)
    while not done:
        R, p = ee_of(chain, q, axes, linear)
        for j in range(JOINTS):
            linear[j] = wp.cross(axes[j], p - linear[j])
        e_p = goal_p - p
        e_r = rotation_vector(goal_R * wp.transpose(R))
        size = wp.dot(e_p, e_p) + wp.dot(e_r, e_r)
        if wp.length(e_p) < CONVERGED and wp.length(e_r) < CONVERGED:
            done = bool(True)
        else:
            step += 1
            if step > iterations:
                done = bool(True)
            else:
                e = vec6d(e_p[0], e_p[1], e_p[2], e_r[0], e_r[1], e_r[2])
                d = damped_step(axes, linear, free, DAMPING * size + DAMPING_MIN, e)
                for j in range(JOINTS):
                    # at most half a turn, and the step itself where it is small
                    x = q[j] + wp.float64(2.0) * wp.atan(HALF * d[j])
                    if x >= chain.upper[j]:
                        free[j] = wp.where(q[j] >= chain.upper[j], ZERO, free[j])
                        x = chain.upper[j]
                    if x <= chain.lower[j]:
                        free[j] = wp.where(q[j] <= chain.lower[j], ZERO, free[j])
                        x = chain.lower[j]
                    q[j] = x
                if step % RELEASE == 0:
                    for j in range(JOINTS):
                        free[j] = ONE
    return q, step


@wp.func
def nearest_seeds(
    seeds: Seeds, p: wp.vec3, turn: wp.quat, most: int, row: wp.array(dtype=int), far: wp.array(dtype=float)
):
    """Writes the rows of the `most` seeds whose ee is nearest to a pose, nearest first; of equal ones the first."""
    kept = int(0)
    for s in range(seeds.q.shape[0]):
        away = seeds.p[s] - p
        # 1 - |cos(angle / 2)|: 0 for equal rotations, 1 for half a turn
        d = wp.dot(away, away) + TURN_M * TURN_M * 2.0 * (1.0 - wp.abs(wp.dot(seeds.turn[s], turn)))
        if kept < most or d < far[kept - 1]:
            k = int(wp.min(kept, most - 1))
            while k > 0 and far[wp.max(k - 1, 0)] > d:
                far[k] = far[k - 1]
                row[k] = row[k - 1]
                k -= 1
            far[k] = d
            row[k] = s
            kept = wp.min(kept + 1, most)
    return kept


@wp.func
def rounded(q: vecqd) -> vecqd:
    """The angles as they are returned, in float32."""
    out = vecqd()
    for j in range(JOINTS):
        out[j] = wp.float64(wp.float32(q[j]))
    return out


@wp.func
def is_new(q: vecqd, q_out: wp.array3d(dtype=float), trial: int, found: int, apart: wp.float64):
    """Whether a posture is `apart` (rad) in some joint from each that was found, whole turns not counted."""
    new = bool(True)
    for k in range(found):
        far = ZERO
        for j in range(JOINTS):
            d = q[j] - wp.float64(q_out[trial, k, j])
            far = wp.max(far, wp.abs(d - TWO_PI * wp.floor(d / TWO_PI + HALF)))
        new = new and far >= apart
    return new


@wp.kernel
def solve_any(
    first: int,
    # tables
    chain: Chain,
    seeds: Seeds,
    most: int,  # seeds that are tried, at most MOST_SEEDS
    iterations: int,
    apart: wp.float64,  # rad
    position_tolerance_m: wp.float64,
    rotation_tolerance_rad: wp.float64,
    rotation_lever_m: wp.float64,
    # trials
    T_world_ee_in: wp.array3d(dtype=wp.float32),
    active_in: wp.array(dtype=wp.bool),
    # out
    q_out: wp.array3d(dtype=float),  # (B, K, JOINTS)
    valid_out: wp.array2d(dtype=wp.bool),
    position_error_out: wp.array2d(dtype=wp.float32),
    rotation_error_out: wp.array2d(dtype=wp.float32),
    status_out: wp.array2d(dtype=wp.uint8),  # (B, 4), all alike
    steps_out: wp.array2d(dtype=int),  # (B, 4): the first holds all, the second how many seeds were tried
    nearest_out: wp.array2d(dtype=float),  # (B, JOINTS) where nothing was found: the posture that came nearest
    residual_out: wp.array(dtype=float),  # and by how much it misses: metres + rotation_lever_m radians
):
    """Up to K postures of each target, `apart` from each other, in the order in which seeds found them."""
    trial = first + wp.tid()
    for k in range(q_out.shape[1]):
        valid_out[trial, k] = False
        position_error_out[trial, k] = wp.float32(wp.inf)
        rotation_error_out[trial, k] = wp.float32(wp.inf)
        for j in range(JOINTS):
            q_out[trial, k, j] = wp.float32(wp.nan)
    for k in range(4):
        status_out[trial, k] = wp.uint8(STATUS_INACTIVE)
        steps_out[trial, k] = 0
    for j in range(JOINTS):
        nearest_out[trial, j] = wp.float32(wp.nan)
    residual_out[trial] = wp.float32(wp.inf)
    goal_R, goal_p, rigid = read_target(T_world_ee_in, trial)
    if not active_in[trial] or not rigid:
        return
    axes = wp.zeros(shape=JOINTS, dtype=wp.vec3d)
    linear = wp.zeros(shape=JOINTS, dtype=wp.vec3d)
    row = wp.zeros(shape=MOST_SEEDS, dtype=int)
    far = wp.zeros(shape=MOST_SEEDS, dtype=float)
    n = nearest_seeds(seeds, wp.vec3(goal_p), wp.quat_from_matrix(wp.mat33(goal_R)), wp.min(most, MOST_SEEDS), row, far)
    status = int(STATUS_NOT_FOUND)
    if wp.length(goal_p - chain.center) > chain.reach + position_tolerance_m:
        status = STATUS_UNREACHABLE
        n = wp.min(n, 8)  # for the nearest posture alone
    found = int(0)
    tried = int(0)
    total = int(0)
    least = wp.float64(wp.inf)
    while tried < n and found < q_out.shape[1]:
        start = vecqd()
        for j in range(JOINTS):
            start[j] = seeds.q[row[tried], j]
        tried += 1
        q, steps = descend(iterations, chain, start, goal_R, goal_p, axes, linear)
        total += wp.min(steps, iterations)
        q = rounded(q)
        for j in range(JOINTS):  # rounding may not lead beyond a limit
            if q[j] > chain.upper[j] or q[j] < chain.lower[j]:
                q[j] = wp.float64(wp.float32(q[j] * wp.float64(0.9999999)))
        if found == 0 or (steps <= iterations and is_new(q, q_out, trial, found, apart)):
            R, p = ee_of(chain, q, axes, linear)
            e_p = wp.length(goal_p - p)
            e_r = wp.length(rotation_vector(goal_R * wp.transpose(R)))
            if e_p <= position_tolerance_m and e_r <= rotation_tolerance_rad:
                for j in range(JOINTS):
                    q_out[trial, found, j] = wp.float32(q[j])
                valid_out[trial, found] = True
                position_error_out[trial, found] = wp.float32(e_p)
                rotation_error_out[trial, found] = wp.float32(e_r)
                status = STATUS_SOME
                found += 1
            elif found == 0 and e_p + rotation_lever_m * e_r < least:
                least = e_p + rotation_lever_m * e_r
                residual_out[trial] = wp.float32(least)
                for j in range(JOINTS):
                    nearest_out[trial, j] = wp.float32(q[j])
    for k in range(4):
        status_out[trial, k] = wp.uint8(status)
    steps_out[trial, 0] = total
    steps_out[trial, 1] = tried
