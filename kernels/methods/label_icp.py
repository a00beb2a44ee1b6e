"""ICP (Besl and McKay 1992) of a small template onto a labelled point cloud, one thread per trial.

Neighbours are nearest in (x, y, z, label), as where labels are colours: another label costs `label_m` across.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"fuse_fp": True})


@wp.func
def nearest_labelled(
    points: wp.array2d(dtype=wp.vec3), o: int, role_in: wp.array2d(dtype=wp.uint8), trial: int, x: wp.vec3,
    role: wp.uint8, label_m: float,
):  # fmt: skip
    """The point of object o nearest to x, another role than `role` counting `label_m` more across; squared distance."""
    best = float(1.0e30)
    at = int(0)
    for k in range(points.shape[1]):
        d2 = wp.length_sq(points[o, k] - x)
        if d2 < best:
            if role_in[trial, k] != role:
                d2 = d2 + label_m * label_m
            if d2 < best:
                best = d2
                at = k
    return at, best


# ICP (Besl and McKay 1992) of a scaled template onto a labelled cloud, with labels as a fourth coordinate. With s_i the
# template's points (roles r_i) and c_k the cloud's (roles l_k), each step does
#
#     k(i) = argmin_k  |R s_i + p - c_k|^2 + label_m^2 [r_i != l_k]      nearest in position and label
#     R, p = argmin    sum_i |R s_i + p - c_k(i)|^2                      closed form, below
#
# and the mean of the first line's roots is the error. The closed form takes both means off: H = sum s c^T - (sum s)(sum
# c)^T / n = U S V^T gives R = V U^T, and p from the means. It stops once the error changes by less than the tolerance.
@wp.kernel
def align(
    first: int,
    # tables
    points: wp.array2d(dtype=wp.vec3),  # (O, P)
    shape: wp.array(dtype=wp.vec3), shape_role: wp.array(dtype=wp.uint8),
    shape_first: wp.array(dtype=int),  # template t has rows shape_first[t] .. shape_first[t + 1]
    label_m: float, iterations: int, tolerance: wp.float64,
    # trials
    object_in: wp.array(dtype=int), which_in: wp.array(dtype=int), scale_in: wp.array(dtype=float),
    start_in: wp.array(dtype=wp.vec3),
    role_in: wp.array2d(dtype=wp.uint8),  # (B, P)
    # out
    R_out: wp.array(dtype=wp.mat33d), p_out: wp.array(dtype=wp.vec3d), error_out: wp.array(dtype=wp.float64),
    steps_out: wp.array(dtype=int),
):  # fmt: skip
    """R, p of the template (scaled) in the cloud's frame, from the identity at `start`; mean distance, steps taken.

    Stops when the mean distance changes by less than `tolerance` (m).
    """
    trial = first + wp.tid()
    o = object_in[trial]
    lo = shape_first[which_in[trial]]
    hi = shape_first[which_in[trial] + 1]
    scale = scale_in[trial]
    R = wp.identity(n=3, dtype=wp.float64)
    p = wp.vec3d(start_in[trial])
    before = wp.float64(0.0)
    error = wp.float64(0.0)
    steps = int(0)
    running = bool(True)
    while running and steps < iterations:
        # correspondences in float32, as the points are; sums and the fit in float64
        Rf = wp.mat33(R)
        pf = wp.vec3(p)
        source = wp.vec3d()
        target = wp.vec3d()
        H = wp.mat33d()
        error = wp.float64(0.0)
        for i in range(lo, hi):
            s = scale * shape[i]
            x = Rf * s + pf
            at, best = nearest_labelled(points, o, role_in, trial, x, shape_role[i], label_m)
            error += wp.float64(wp.sqrt(best))
            s64 = wp.vec3d(s)
            t64 = wp.vec3d(points[o, at])
            source += s64
            target += t64
            H += wp.outer(s64, t64)
        n = wp.float64(hi - lo)
        error = error / n
        H = H - wp.outer(source, target) / n
        # least squares over rotations: R = V U^T of H = U S V^T (Arun, Huang and Blostein 1987)
        U, _, V = wp.svd3(H)  # proper rotations, the least singular value takes the sign
        R = V * wp.transpose(U)
        p = (target - R * source) / n
        steps += 1
        if wp.abs(before - error) < tolerance:
            running = False
        before = error
    R_out[trial] = R
    p_out[trial] = p
    error_out[trial] = error
    steps_out[trial] = steps


@wp.kernel
def role_means(
    first: int, points: wp.array2d(dtype=wp.vec3), wanted: int, object_in: wp.array(dtype=int),
    role_in: wp.array2d(dtype=wp.uint8), mean_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Mean of the points with a role; the mean of all points where there are none."""
    trial = first + wp.tid()
    o = object_in[trial]
    total = wp.vec3d()
    every = wp.vec3d()
    count = int(0)
    for k in range(points.shape[1]):
        x = wp.vec3d(points[o, k])
        every += x
        if int(role_in[trial, k]) == wanted:
            total += x
            count += 1
    mean = every / wp.float64(points.shape[1])
    if count > 0:
        mean = total / wp.float64(count)
    mean_out[trial] = wp.vec3(mean)
