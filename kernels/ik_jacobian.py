"""One IK solution, as a numerical solver gives it: damped least squares on the whole arm from home, restarts if it sticks.

Which branch such a solver ends in is decided by its start; the solutions themselves are those of ik_step.py.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

mat67d = wp.types.matrix((6, 7), wp.float64)
vec6d = wp.types.vector(6, wp.float64)
vec8d = wp.types.vector(8, wp.float64)

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


@wp.kernel
def first_branch(
    first: int,
    iterations: int,
    joint_R: wp.array(dtype=wp.mat33d),  # (7,) parent link to joint at q = 0; the last: wrist_3 to ee
    joint_p: wp.array(dtype=wp.vec3d),
    lower: wp.array(dtype=wp.float64),
    upper: wp.array(dtype=wp.float64),
    starts_in: wp.array2d(dtype=wp.float64),  # (S, 6) tried in this order
    T_world_ee_in: wp.array(dtype=wp.mat44),
    q_in: wp.array3d(dtype=float),  # (B, 8, 6) all branches
    valid_in: wp.array2d(dtype=wp.bool),
    slot_out: wp.array(dtype=int),
    start_out: wp.array(dtype=int),
):
    """The slot of the branch that the solver reaches, and from which start; -1 where it reaches none."""
    trial = first + wp.tid()
    slot_out[trial] = -1
    start_out[trial] = -1
    n = int(6)
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
    axes = wp.zeros(shape=6, dtype=wp.vec3d)
    origins = wp.zeros(shape=6, dtype=wp.vec3d)
    q = wp.zeros(shape=6, dtype=wp.float64)
    for s in range(starts_in.shape[0]):
        for j in range(n):
            q[j] = starts_in[s, j]
        done = bool(False)
        step = int(0)
        while step <= iterations and not done:
            R = wp.identity(n=3, dtype=wp.float64)
            p = wp.vec3d()
            for j in range(n):
                p = R * joint_p[j] + p
                c = wp.cos(q[j])
                z = wp.sin(q[j])
                R = R * joint_R[j] * wp.mat33d(
                    c, -z, wp.float64(0.0), z, c, wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(1.0)
                )  # fmt: skip
                axes[j] = wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
                origins[j] = p
            p = R * joint_p[6] + p
            R = R * joint_R[6]
            e_p = goal_p - p
            e_r = rotation_vector(goal_R * wp.transpose(R))
            if wp.length(e_p) < CONVERGED and wp.length(e_r) < CONVERGED:
                done = True
            else:
                # (J J^T + damping) y = e, dq = J^T y; rows of J: three of translation, three of rotation
                damping = DAMPING * (wp.dot(e_p, e_p) + wp.dot(e_r, e_r)) + DAMPING_MIN
                A = mat67d()
                for j in range(n):
                    lin = wp.cross(axes[j], p - origins[j])
                    column = vec6d(lin[0], lin[1], lin[2], axes[j][0], axes[j][1], axes[j][2])
                    for r in range(n):
                        for m in range(n):
                            A[r, m] = A[r, m] + column[r] * column[m]
                for r in range(n):
                    A[r, r] = A[r, r] + damping
                    A[r, 6] = wp.where(r < 3, e_p[wp.min(r, 2)], e_r[wp.max(r - 3, 0)])
                y = solve_spd(A)
                for j in range(n):
                    lin = wp.cross(axes[j], p - origins[j])
                    d = lin[0] * y[0] + lin[1] * y[1] + lin[2] * y[2]
                    d = d + axes[j][0] * y[3] + axes[j][1] * y[4] + axes[j][2] * y[5]
                    q[j] = wp.clamp(q[j] + d, lower[j], upper[j])
            step += 1
        if done:
            for k in range(8):
                if valid_in[trial, k] and slot_out[trial] < 0:
                    apart = wp.float64(0.0)
                    for j in range(n):
                        d = q[j] - wp.float64(q_in[trial, k, j])
                        d = d - wp.float64(2.0) * PI * wp.floor(d / (wp.float64(2.0) * PI) + wp.float64(0.5))
                        apart = wp.max(apart, wp.abs(d))
                    if apart < SAME:
                        slot_out[trial] = k
                        start_out[trial] = s
            if slot_out[trial] >= 0:
                return
