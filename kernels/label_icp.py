"""ICP (Besl and McKay 1992) of a small template onto a labelled point cloud, one thread per trial.

Neighbours are nearest in (x, y, z, label), as where labels are colours: another label costs `label_m` across.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def align(
    first: int,
    points: wp.array2d(dtype=wp.vec3),  # (O, P)
    shape: wp.array(dtype=wp.vec3),
    shape_role: wp.array(dtype=wp.uint8),
    shape_first: wp.array(dtype=int),  # template t has rows shape_first[t] .. shape_first[t + 1]
    label_m: float,
    iterations: int,
    tolerance: wp.float64,
    object_in: wp.array(dtype=int),
    which_in: wp.array(dtype=int),
    scale_in: wp.array(dtype=float),
    start_in: wp.array(dtype=wp.vec3),
    role_in: wp.array2d(dtype=wp.uint8),  # (B, P)
    R_out: wp.array(dtype=wp.mat33d),
    p_out: wp.array(dtype=wp.vec3d),
    error_out: wp.array(dtype=wp.float64),
    steps_out: wp.array(dtype=int),
):
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
        Rf = wp.mat33(R)
        pf = wp.vec3(p)
        source = wp.vec3d()
        target = wp.vec3d()
        H = wp.mat33d()
        error = wp.float64(0.0)
        for i in range(lo, hi):
            s = scale * shape[i]
            x = Rf * s + pf
            role = shape_role[i]
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
            error += wp.float64(wp.sqrt(best))
            s64 = wp.vec3d(s)
            t64 = wp.vec3d(points[o, at])
            source += s64
            target += t64
            H += wp.outer(s64, t64)
        n = wp.float64(hi - lo)
        error = error / n
        H = H - wp.outer(source, target) / n
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
    first: int,
    points: wp.array2d(dtype=wp.vec3),
    wanted: int,
    object_in: wp.array(dtype=int),
    role_in: wp.array2d(dtype=wp.uint8),
    mean_out: wp.array(dtype=wp.vec3),
    count_out: wp.array(dtype=int),
):
    """Mean of the points with a role, and how many they are; the mean of all points where there are none."""
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
    count_out[trial] = count
