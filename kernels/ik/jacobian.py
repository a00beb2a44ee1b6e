"""One IK solution, as a numerical solver gives it: damped least squares on the whole arm from home, restarts if it sticks.

Which branch such a solver ends in is decided by its start; the solutions themselves are those of ik/step.py.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import ee_and_axes, vec6d

wp.set_module_options(OPTIONS)

mat67d = wp.types.matrix((6, 7), wp.float64)

CONVERGED = wp.constant(wp.float64(1e-5))  # metres and radians
SAME = wp.constant(wp.float64(1e-3))  # rad: the branch that the solver arrived at
DAMPING = wp.constant(wp.float64(1e-2))
DAMPING_MIN = wp.constant(wp.float64(1e-6))
PI = wp.constant(wp.float64(3.141592653589793))


@wp.func
def solve_spd(A: mat67d) -> vec6d:
    """x of the symmetric positive definite system in the augmented matrix A = [M | b]."""
    n = int(6)
    for i in range(n):
        # elimination without pivoting: the pivots of a positive definite matrix are positive
        for r in range(i + 1, n):
            f = A[r, i] / A[i, i]
            for c in range(i, n + 1):
                A[r, c] = A[r, c] - f * A[i, c]
    x = vec6d()
    for k in range(n):
        i = n - 1 - k
        total = A[i, n]
        for c in range(i + 1, n):
            total -= A[i, c] * x[c]
        x[i] = total / A[i, i]
    return x


@wp.func
def rotation_vector(D: wp.mat33d) -> wp.vec3d:
    """Axis times angle of a rotation matrix; half turns get some axis."""
    v = wp.float64(0.5) * wp.vec3d(D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1])
    sine = wp.length(v)
    cosine = wp.float64(0.5) * (D[0, 0] + D[1, 1] + D[2, 2] - wp.float64(1.0))
    angle = wp.atan2(sine, cosine)
    if sine > wp.float64(1e-9):
        return v * (angle / sine)
    if cosine > wp.float64(0.0):
        return v
    return wp.vec3d(PI, wp.float64(0.0), wp.float64(0.0))


@wp.func
def damped_gram(axes: wp.array(dtype=wp.vec3d), linear: wp.array(dtype=wp.vec3d), damping: wp.float64):
    """[J J^T + damping 1 | 0] (6, 7) of the Jacobian with columns (linear_j, axes_j): velocity and turn per joint rate."""
    n = int(6)
    A = mat67d()
    for j in range(axes.shape[0]):
        column = vec6d(linear[j][0], linear[j][1], linear[j][2], axes[j][0], axes[j][1], axes[j][2])
        for r in range(n):
            for m in range(n):
                A[r, m] = A[r, m] + column[r] * column[m]
    for r in range(n):
        A[r, r] = A[r, r] + damping
    return A


@wp.func
def joint_rate(axis: wp.vec3d, linear: wp.vec3d, y: vec6d):
    """One element of J^T y."""
    d = linear[0] * y[0] + linear[1] * y[1] + linear[2] * y[2]
    return d + axis[0] * y[3] + axis[1] * y[4] + axis[2] * y[5]


@wp.func
def solve_from(
    start: int, iterations: int, joint_R: wp.array(dtype=wp.mat33d), joint_p: wp.array(dtype=wp.vec3d),
    lower: wp.array(dtype=wp.float64), upper: wp.array(dtype=wp.float64), starts: wp.array2d(dtype=wp.float64),
    goal_R: wp.mat33d, goal_p: wp.vec3d,
    q: wp.array(dtype=wp.float64),  # (6,) out
    axes: wp.array(dtype=wp.vec3d),  # (6,) scratch
    linear: wp.array(dtype=wp.vec3d),
):  # fmt: skip
    """Whether damped least squares from a start come to the goal within the joint limits; the angles, in `q`.

    A step is dq = J^T y with (J J^T + lambda 1) y = e (Levenberg-Marquardt: Wampler 1986, Nakamura and Hanafusa 1986),
    e = (goal_p - p, rotation vector of goal_R R^T), lambda = 0.01 |e|^2 + 1e-6: far from the goal it bounds the step near
    singular postures, close to it the step is Newton's.
    """
    n = int(6)
    for j in range(n):
        q[j] = starts[start, j]
    done = bool(False)
    step = int(0)
    while step <= iterations and not done:
        R, p = ee_and_axes(joint_R, joint_p, q, axes, linear)
        for j in range(n):
            linear[j] = wp.cross(axes[j], p - linear[j])
        e_p = goal_p - p
        e_r = rotation_vector(goal_R * wp.transpose(R))
        if wp.length(e_p) < CONVERGED and wp.length(e_r) < CONVERGED:
            done = True
        else:
            A = damped_gram(axes, linear, DAMPING * (wp.dot(e_p, e_p) + wp.dot(e_r, e_r)) + DAMPING_MIN)
            for r in range(n):
                A[r, 6] = wp.where(r < 3, e_p[wp.min(r, 2)], e_r[wp.max(r - 3, 0)])
            y = solve_spd(A)
            for j in range(n):
                q[j] = wp.clamp(q[j] + joint_rate(axes[j], linear[j], y), lower[j], upper[j])
        step += 1
    return done


@wp.func
def branch_of(
    q: wp.array(dtype=wp.float64), q_in: wp.array3d(dtype=float), valid_in: wp.array2d(dtype=wp.bool), trial: int
):
    """The first valid branch that is posture q but for whole turns; -1 if none is."""
    slot = int(-1)
    n = int(6)
    for k in range(8):
        if valid_in[trial, k] and slot < 0:
            apart = wp.float64(0.0)
            for j in range(n):
                d = q[j] - wp.float64(q_in[trial, k, j])
                d = d - wp.float64(2.0) * PI * wp.floor(d / (wp.float64(2.0) * PI) + wp.float64(0.5))
                apart = wp.max(apart, wp.abs(d))
            if apart < SAME:
                slot = k
    return slot


@wp.kernel
def first_branch(
    first: int,
    # tables
    iterations: int,
    joint_R: wp.array(dtype=wp.mat33d),  # (7,) parent link to joint at q = 0; the last: wrist_3 to ee
    joint_p: wp.array(dtype=wp.vec3d), lower: wp.array(dtype=wp.float64), upper: wp.array(dtype=wp.float64),
    # trials
    starts_in: wp.array2d(dtype=wp.float64),  # (S, 6) tried in this order
    T_world_ee_in: wp.array(dtype=wp.mat44),
    q_in: wp.array3d(dtype=float),  # (B, 8, 6) all branches
    valid_in: wp.array2d(dtype=wp.bool),
    # out
    slot_out: wp.array(dtype=int),
):  # fmt: skip
    """The slot of the branch that the solver reaches; -1 where it reaches none."""
    trial = first + wp.tid()
    slot_out[trial] = -1
    any_branch = bool(False)
    for k in range(8):
        if valid_in[trial, k]:
            any_branch = True
    if not any_branch:
        return
    T = T_world_ee_in[trial]
    goal_R = wp.mat33d()
    goal_p = wp.vec3d()
    for i in range(3):
        goal_p[i] = wp.float64(T[i, 3])
        for j in range(3):
            goal_R[i, j] = wp.float64(T[i, j])
    q = wp.zeros(shape=6, dtype=wp.float64)
    axes = wp.zeros(shape=6, dtype=wp.vec3d)
    linear = wp.zeros(shape=6, dtype=wp.vec3d)
    for s in range(starts_in.shape[0]):
        if solve_from(s, iterations, joint_R, joint_p, lower, upper, starts_in, goal_R, goal_p, q, axes, linear):
            slot = branch_of(q, q_in, valid_in, trial)
            if slot >= 0:
                slot_out[trial] = slot
                return
