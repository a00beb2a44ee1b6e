"""Inverse kinematics of any chain of turning joints: damped least squares from stored seeds, distinct postures kept.

A thread takes one target. It tries the seeds whose ee is nearest to it, nearest first, until it has K postures. A step
is dq = J^T y with (J J^T + lambda 1) y = e and lambda = 0.1 |e|^2 + 1e-6 (Sugihara 2011): the task has six rows whatever
the number of joints. A joint that a step takes beyond its limit stays there, and leaves the Jacobian while it is pushed on.
These steps are float32's; the last one closes an error that is known in float64.

More than six joints: from each posture that a seed leads to, further ones are found along its self-motion, towards home and
then away from it. A stride is the part of home - q that leaves the ee where it is, and a few steps close what it misses:
a quarter of what a seed costs.

That no seed converges proves nothing; a target farther than the arm is long is proven unreachable.
"""

import warp as wp

from r2h_batch.kernels.ik.jacobian import rotation_vector
from r2h_batch.kernels.ik.step import STATUS_INACTIVE, STATUS_UNREACHABLE, read_target
from r2h_batch.kernels.options import with_header

from .. import JOINTS as _JOINTS
from ..robot.joints import JOINTS, vecq

wp.set_module_options(with_header("arm.h"))

STATUS_NOT_FOUND = wp.constant(6)  # no seed converged; the list of ik/step.py goes on here
STATUS_SOME = wp.constant(7)  # there may be more postures than were found
MOST_SEEDS = wp.constant(64)
"""Seeds of a target that are tried, at most."""
ENOUGH_SEEDS = wp.constant(14)
"""Seeds that are tried where a posture was found."""
NEAR = wp.constant(3e-5)
"""Metres and radians from which float64 knows the error; one more step is enough but near singular postures and limits."""
LAST_STEPS = wp.constant(9)
SPREAD = wp.constant(37)
"""Stride through the list of seeds that are tried where all near ones failed."""
PROMISING = wp.constant(wp.float64(0.1))
"""Metres and radians within which such a seed gets three times as many steps more."""
WALK_STEPS = wp.constant(8)
"""Steps that close what a stride misses, at most."""
STRIDE = wp.constant(0.4)
"""Radians that a joint moves, at most, from a posture to the next one along the self-motion."""
SHARE = wp.constant(4)
"""Postures of one self-motion: others are of another elbow or wrist."""
TURN_M = wp.constant(0.3)
"""Metres that half a turn's chord counts for when seeds are sorted."""

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
ENTRIES = wp.constant(6 * _JOINTS)
"""Number of entries of a Jacobian."""
TWO_PI = wp.constant(6.283185307179586)

vec6 = wp.types.vector(6, float)


@wp.struct
class Chain:
    """A chain of joints about z: frames from the link before (the last: ee in the last link), limits and home (rad)."""

    R: wp.array(dtype=wp.mat33d)  # (JOINTS + 1,)
    p: wp.array(dtype=wp.vec3d)
    frames: wp.array(dtype=float)  # (12 (JOINTS + 1),) rows of [R | p]
    lower: vecq
    upper: vecq
    home: vecq
    center: wp.vec3d  # the ee is never farther from here than
    reach: wp.float64  # this (m)


@wp.struct
class Seeds:
    """S postures (rad), where they have the ee, and what their distance from home counts for when they are sorted (m^2)."""

    q: wp.array2d(dtype=float)  # (S, JOINTS)
    p: wp.array(dtype=wp.vec3)
    turn: wp.array(dtype=wp.quat)
    away: wp.array(dtype=float)


@wp.func
def ee_of(chain: Chain, q: wp.array(dtype=float)):
    """R, p of the ee in the world."""
    R = wp.identity(n=3, dtype=wp.float64)
    p = wp.vec3d()
    for j in range(JOINTS):
        p = R * chain.p[j] + p
        c = wp.cos(wp.float64(q[j]))
        s = wp.sin(wp.float64(q[j]))
        R = R * chain.R[j] * wp.mat33d(c, -s, ZERO, s, c, ZERO, ZERO, ZERO, ONE)
    return R * chain.R[JOINTS], R * chain.p[JOINTS] + p


@wp.func_native("return r2h::descend(frames.data, lower.c, upper.c, goal.data, most, near, q.data, J.data);")
def descend(
    frames: wp.array(dtype=float), lower: vecq, upper: vecq, goal: wp.array(dtype=float), most: int, near: float,
    q: wp.array(dtype=float), J: wp.array(dtype=float),
) -> int:  # fmt: skip
    """Steps from a posture (rad), which moves, until it misses the goal's frame by less than `near` (most + 1: in vain).

    Writes the Jacobian (6 rows) at the posture that is left.
    """
    ...


@wp.func_native("return r2h::move(lower.c, upper.c, J.data, e.c, pull.c, shortest, longest, q.data);")
def move(
    lower: vecq, upper: vecq, J: wp.array(dtype=float), e: vec6, pull: vecq, shortest: float, longest: float,
    q: wp.array(dtype=float),
) -> float:  # fmt: skip
    """Moves a posture once: the ee by e (m, rad), the joints by as much of `pull` as leaves the ee where it is.

    The joint that moves farthest moves by `shortest` to `longest` (rad); returns by how much.
    """
    ...


@wp.func
def pull_home(chain: Chain, q: wp.array(dtype=float), way: float) -> vecq:
    """Towards home (way 1) or away from it (-1), rad."""
    pull = vecq()
    for j in range(JOINTS):
        pull[j] = way * (chain.home[j] - q[j])
    return pull


@wp.func
def missed(chain: Chain, q: wp.array(dtype=float), goal_R: wp.mat33d, goal_p: wp.vec3d):
    """Error between a posture's ee and the goal: m, and axis times angle of the rotation."""
    R, p = ee_of(chain, q)
    return goal_p - p, rotation_vector(goal_R * wp.transpose(R))


@wp.func
def nearest_seeds(
    seeds: Seeds, p: wp.vec3, turn: wp.quat, most: int, row: wp.array(dtype=int), far: wp.array(dtype=float)
):
    """Writes the rows of the `most` seeds whose ee is nearest to a pose, nearest first; of equal ones the first."""
    kept = int(0)
    for s in range(seeds.q.shape[0]):
        away = seeds.p[s] - p
        # 1 - |cos(angle / 2)|: 0 for equal rotations, 1 for half a turn
        turned = 2.0 * (1.0 - wp.abs(wp.dot(seeds.turn[s], turn)))
        d = seeds.away[s] + wp.dot(away, away) + TURN_M * TURN_M * turned
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
def is_new(q: wp.array(dtype=float), q_out: wp.array3d(dtype=float), trial: int, found: int, apart: float):
    """Whether a posture is `apart` (rad) in some joint from each that was found, whole turns not counted."""
    new = bool(True)
    for k in range(found):
        far = float(0.0)
        for j in range(JOINTS):
            d = q[j] - q_out[trial, k, j]
            far = wp.max(far, wp.abs(d - TWO_PI * wp.floor(d / TWO_PI + 0.5)))
        new = new and far >= apart
    return new


@wp.kernel
def solve_any(
    first: int,
    # tables
    chain: Chain, seeds: Seeds,
    most: int,  # seeds that are tried, at most MOST_SEEDS
    iterations: int,  # of a seed
    apart: float,  # rad
    position_tolerance_m: wp.float64, rotation_tolerance_rad: wp.float64, rotation_lever_m: wp.float64,
    # trials
    T_world_ee_in: wp.array3d(dtype=wp.float32), active_in: wp.array(dtype=wp.bool),
    # out
    q_out: wp.array3d(dtype=float),  # (B, K, JOINTS)
    valid_out: wp.array2d(dtype=wp.bool), position_error_out: wp.array2d(dtype=wp.float32),
    rotation_error_out: wp.array2d(dtype=wp.float32),
    status_out: wp.array2d(dtype=wp.uint8),  # (B, 4), all alike
    steps_out: wp.array2d(dtype=int),  # (B, 2): all steps, and how many seeds were tried
    nearest_out: wp.array2d(dtype=float),  # (B, JOINTS) where nothing was found: the posture that came nearest
    residual_out: wp.array(dtype=float),  # and by how much it misses: metres + rotation_lever_m radians
):  # fmt: skip
    """Up to K postures of each target, `apart` from each other, in the order in which they were found."""
    trial = first + wp.tid()
    for k in range(q_out.shape[1]):
        valid_out[trial, k] = False
        position_error_out[trial, k] = wp.float32(wp.inf)
        rotation_error_out[trial, k] = wp.float32(wp.inf)
        for j in range(JOINTS):
            q_out[trial, k, j] = wp.float32(wp.nan)
    for k in range(4):
        status_out[trial, k] = wp.uint8(STATUS_INACTIVE)
    steps_out[trial, 0] = 0
    steps_out[trial, 1] = 0
    for j in range(JOINTS):
        nearest_out[trial, j] = wp.float32(wp.nan)
    residual_out[trial] = wp.float32(wp.inf)
    goal_R, goal_p, rigid = read_target(T_world_ee_in, trial)
    if not active_in[trial] or not rigid:
        return
    goal = wp.zeros(shape=12, dtype=float)
    for i in range(3):
        for k in range(3):
            goal[4 * i + k] = float(goal_R[i, k])
        goal[4 * i + 3] = float(goal_p[i])
    row = wp.zeros(shape=MOST_SEEDS, dtype=int)
    far = wp.zeros(shape=MOST_SEEDS, dtype=float)
    n = nearest_seeds(seeds, wp.vec3(goal_p), wp.quat_from_matrix(wp.mat33(goal_R)), wp.min(most, MOST_SEEDS), row, far)
    status = int(STATUS_NOT_FOUND)
    if wp.length(goal_p - chain.center) > chain.reach + position_tolerance_m:
        status = STATUS_UNREACHABLE
        n = wp.min(n, 8)  # for the nearest posture alone
    q = wp.zeros(shape=JOINTS, dtype=float)
    J = wp.zeros(shape=ENTRIES, dtype=float)
    found = int(0)
    tried = int(0)
    total = int(0)
    share = int(0)  # postures of this self-motion
    root = int(0)  # the first of them
    way = float(0.0)  # 0: from the next seed; 1: along the self-motion, towards home; -1: away from it
    least = wp.float64(wp.inf)
    more = bool(n > 0)
    while more:
        go = bool(True)
        if way == 0.0:
            # where the nearest failed: as many of the others, spread over the list
            seed = wp.where(tried < n, row[tried % n], (tried * SPREAD) % seeds.q.shape[0])
            for j in range(JOINTS):
                q[j] = seeds.q[seed, j]
            tried += 1
            share = 0
        else:
            shortest = wp.where(way < 0.0, STRIDE, 0.0)
            go = move(chain.lower, chain.upper, J, vec6(), pull_home(chain, q, way), shortest, STRIDE, q) >= apart
        new = bool(False)
        if go:
            limit = wp.where(way == 0.0, iterations, WALK_STEPS)
            steps = descend(chain.frames, chain.lower, chain.upper, goal, limit, NEAR, q, J)
            total += wp.min(steps, limit)
            if way == 0.0 and tried > n and steps > limit:
                e_p, e_r = missed(chain, q, goal_R, goal_p)
                if wp.length(e_p) + wp.length(e_r) < PROMISING:
                    limit = 3 * iterations
                    steps = descend(chain.frames, chain.lower, chain.upper, goal, limit, NEAR, q, J)
                    total += wp.min(steps, limit)
            e = vec6()
            if found == 0 or (steps <= limit and is_new(q, q_out, trial, found, apart)):
                off_m = wp.float64(wp.inf)
                off_rad = wp.float64(wp.inf)
                last = int(0)
                while last < LAST_STEPS and not new:
                    if last > 0:
                        move(chain.lower, chain.upper, J, e, vecq(), 0.0, 1.0, q)
                    e_p, e_r = missed(chain, q, goal_R, goal_p)
                    off_m = wp.length(e_p)
                    off_rad = wp.length(e_r)
                    new = last > 0 and off_m <= position_tolerance_m and off_rad <= rotation_tolerance_rad
                    e = vec6(float(e_p[0]), float(e_p[1]), float(e_p[2]), float(e_r[0]), float(e_r[1]), float(e_r[2]))
                    last += 1
                if new:
                    for j in range(JOINTS):
                        q_out[trial, found, j] = q[j]
                    valid_out[trial, found] = True
                    position_error_out[trial, found] = wp.float32(off_m)
                    rotation_error_out[trial, found] = wp.float32(off_rad)
                    status = STATUS_SOME
                elif off_m + rotation_lever_m * off_rad < least:
                    least = off_m + rotation_lever_m * off_rad
                    residual_out[trial] = wp.float32(least)
                    for j in range(JOINTS):
                        nearest_out[trial, j] = q[j]
        if new:
            if way == 0.0:
                root = found
                way = wp.where(JOINTS > 6, 1.0, 0.0)
            found += 1
            share += 1
            if share == SHARE:
                way = 0.0
        elif way > 0.0:
            # back to where this self-motion was entered, for the other way
            way = -1.0
            for j in range(JOINTS):
                q[j] = q_out[trial, root, j]
            descend(chain.frames, chain.lower, chain.upper, goal, 0, NEAR, q, J)
        else:
            way = 0.0
        seeds_left = tried < wp.where(found > 0, wp.min(n, ENOUGH_SEEDS), 2 * n)
        more = found < q_out.shape[1] and (way != 0.0 or seeds_left)
    if found > 0:
        residual_out[trial] = wp.float32(wp.inf)
        for j in range(JOINTS):
            nearest_out[trial, j] = wp.float32(wp.nan)
    for k in range(4):
        status_out[trial, k] = wp.uint8(status)
    steps_out[trial, 0] = total
    steps_out[trial, 1] = tried
