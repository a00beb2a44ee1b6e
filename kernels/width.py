"""Material between the pads: exact on the triangles, one trial a thread.

The pad prism is |x| <= half_x, z_low <= z <= z_high in the ee frame, any y. The y at which it meets the object's solid
are the y ranges of the triangles clipped to it, and what lies inside the solid between those: there the prism's whole
cross-section is inside, so the line along its centre tells. What overlaps is one run of material.
"""

import warp as wp

from r2h_batch.kernels.gripper import Gripper, gap_from_drive, pad_center_z_range
from r2h_batch.kernels.surface import Surfaces, center, inverse_pose, line_hit, may_hit

wp.set_module_options({"enable_backward": False})

MAX_RUNS = wp.constant(24)
JOIN_M = wp.constant(1.0e-6)
COVERED_M = wp.constant(1.0e-7)
FOUND_M = wp.constant(1.0e-5)
MAX_STEPS = wp.constant(64)
FAR = wp.constant(1.0e30)

vec24 = wp.types.vector(24, wp.float32)
vec24i = wp.types.vector(24, wp.int32)


@wp.func
def _clip(p: float, q: float, low: float, high: float, t0: float, t1: float):
    """[t0, t1] cut to where low <= p + t (q - p) <= high."""
    if (p < low and q < low) or (p > high and q > high):
        t0 = 2.0
    elif p < low or q < low or p > high or q > high:
        d = q - p
        u = (low - p) / d
        v = (high - p) / d
        t0 = wp.max(t0, wp.min(u, v))
        t1 = wp.min(t1, wp.max(u, v))
    return t0, t1


@wp.func
def _triangle_in_prism(a: wp.vec3, b: wp.vec3, c: wp.vec3, half_x: float, z_low: float, z_high: float):
    """Range of y of triangle abc cut to the prism (low > high: none): its edges' parts, the prism's corner lines."""
    low = float(FAR)
    high = float(-FAR)
    for i in range(3):
        p = a
        q = b
        if i == 1:
            p = b
            q = c
        elif i == 2:
            p = c
            q = a
        d = q - p
        t0, t1 = _clip(p[0], q[0], -half_x, half_x, 0.0, 1.0)
        if t0 > t1:
            continue
        t0, t1 = _clip(p[2], q[2], z_low, z_high, t0, t1)
        if t0 <= t1:
            y0 = p[1] + t0 * d[1]
            y1 = wp.where(t1 >= 1.0, q[1], p[1] + t1 * d[1])
            low = wp.min(low, wp.min(y0, y1))
            high = wp.max(high, wp.max(y0, y1))
    x_min = wp.min(a[0], wp.min(b[0], c[0]))
    x_max = wp.max(a[0], wp.max(b[0], c[0]))
    z_min = wp.min(a[2], wp.min(b[2], c[2]))
    z_max = wp.max(a[2], wp.max(b[2], c[2]))
    for i in range(4):
        x = wp.where(i < 2, -half_x, half_x)
        z = wp.where(i % 2 == 0, z_low, z_high)
        if x > x_min and x < x_max and z > z_min and z < z_max:
            hit, y = line_hit(a, b, c, x, z)
            if hit != 0:
                low = wp.min(low, y)
                high = wp.max(high, y)
    return low, high


@wp.func
def _covered(low: wp.array(dtype=float), high: wp.array(dtype=float), n: int, a: float, b: float) -> bool:
    """Whether [a, b] lies in one of the n runs [low, high]."""
    out = bool(False)
    for i in range(n):
        if a >= low[i] - COVERED_M and b <= high[i] + COVERED_M:
            out = True
    return out


@wp.func
def _add(low: wp.array(dtype=float), high: wp.array(dtype=float), n: int, a: float, b: float) -> int:
    """Joins [a, b] to the runs it meets, in place; the new number of runs."""
    i = int(0)
    while i < n:
        if a <= high[i] + JOIN_M and b >= low[i] - JOIN_M:
            a = wp.min(a, low[i])
            b = wp.max(b, high[i])
            n -= 1
            low[i] = low[n]
            high[i] = high[n]
            i = 0  # the grown run may meet one that was passed
        else:
            i += 1
    if n < MAX_RUNS:
        low[n] = a
        high[n] = b
        n += 1
    else:  # no room: the nearest run takes it in
        gap = float(FAR)
        k = int(0)
        for j in range(n):
            d = wp.max(low[j] - b, a - high[j])
            if d < gap:
                gap = d
                k = j
        low[k] = wp.min(low[k], a)
        high[k] = wp.max(high[k], b)
    return n


@wp.func
def solid_along_line(
    surfaces: Surfaces,
    s: int,
    R: wp.mat33,
    t: wp.vec3,
    x: float,
    z: float,
    low: wp.array(dtype=float),
    high: wp.array(dtype=float),
) -> int:
    """The y at which the line (x, ., z) of the ee frame lies inside closed surface s, as runs. R, t: object to ee frame."""
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    ax = wp.vec3(wp.abs(rx[0]), wp.abs(rx[1]), wp.abs(rx[2]))
    az = wp.vec3(wp.abs(rz[0]), wp.abs(rz[1]), wp.abs(rz[2]))
    n = int(0)
    ys = vec24()
    windings = vec24i()
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        ball = surfaces.node_sphere[node]
        if (
            wp.abs(wp.dot(rx, center(ball)) + t[0] - x) <= ball[3]
            and wp.abs(wp.dot(rz, center(ball)) + t[2] - z) <= ball[3]
        ):
            for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
                at = center(surfaces.leaf_sphere[leaf])
                half = surfaces.leaf_half[leaf]
                if (
                    wp.abs(wp.dot(rx, at) + t[0] - x) <= wp.dot(ax, half) + JOIN_M
                    and wp.abs(wp.dot(rz, at) + t[2] - z) <= wp.dot(az, half) + JOIN_M
                ):
                    for tri in range(surfaces.leaf_first[leaf], surfaces.leaf_first[leaf + 1]):
                        if not may_hit(surfaces, tri, rz, z - t[2]):
                            continue
                        winding, y = line_hit(
                            R * surfaces.points[3 * tri] + t,
                            R * surfaces.points[3 * tri + 1] + t,
                            R * surfaces.points[3 * tri + 2] + t,
                            x,
                            z,
                        )
                        if winding != 0 and n < MAX_RUNS:
                            ys[n] = y
                            windings[n] = winding
                            n += 1
    runs = int(0)
    winding = int(0)
    start = float(0.0)
    for i in range(n):
        k = int(i)
        for j in range(i + 1, n):
            if ys[j] < ys[k]:
                k = j
        y = ys[k]
        if winding == 0:
            start = y
        winding += windings[k]
        ys[k] = ys[i]
        windings[k] = windings[i]
        if winding == 0 or i == n - 1:
            runs = _add(low, high, runs, start, y)
    return runs


@wp.func
def material_between(
    surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, half_x: float, z_low: float, z_high: float, half_gap: float
):
    """y of the outermost material among the runs that meet |y| < half_gap (low > high: none).

    R, t: object to ee frame. The solid along the centre line comes first: most triangles then lie in known runs.
    """
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    ry = wp.vec3(R[1, 0], R[1, 1], R[1, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    z_mid = 0.5 * (z_low + z_high)
    half_z = 0.5 * (z_high - z_low)
    ax = wp.vec3(wp.abs(rx[0]), wp.abs(rx[1]), wp.abs(rx[2]))
    ay = wp.vec3(wp.abs(ry[0]), wp.abs(ry[1]), wp.abs(ry[2]))
    az = wp.vec3(wp.abs(rz[0]), wp.abs(rz[1]), wp.abs(rz[2]))
    run_low = wp.zeros(shape=24, dtype=float)
    run_high = wp.zeros(shape=24, dtype=float)
    runs = solid_along_line(surfaces, s, R, t, 0.0, z_mid, run_low, run_high)
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        ball = surfaces.node_sphere[node]
        at = center(ball)
        if (
            wp.abs(wp.dot(rx, at) + t[0]) <= half_x + ball[3]
            and wp.abs(wp.dot(rz, at) + t[2] - z_mid) <= half_z + ball[3]
        ):
            y = wp.dot(ry, at) + t[1]
            if not _covered(run_low, run_high, runs, y - ball[3], y + ball[3]):
                for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
                    at = center(surfaces.leaf_sphere[leaf])
                    half = surfaces.leaf_half[leaf]
                    if wp.abs(wp.dot(rx, at) + t[0]) <= half_x + wp.dot(ax, half) and wp.abs(
                        wp.dot(rz, at) + t[2] - z_mid
                    ) <= half_z + wp.dot(az, half):
                        y = wp.dot(ry, at) + t[1]
                        if not _covered(run_low, run_high, runs, y - wp.dot(ay, half), y + wp.dot(ay, half)):
                            for tri in range(surfaces.leaf_first[leaf], surfaces.leaf_first[leaf + 1]):
                                p = surfaces.points[3 * tri]
                                q = surfaces.points[3 * tri + 1]
                                r = surfaces.points[3 * tri + 2]
                                y0 = wp.dot(ry, p) + t[1]
                                y1 = wp.dot(ry, q) + t[1]
                                y2 = wp.dot(ry, r) + t[1]
                                low = wp.min(y0, wp.min(y1, y2))
                                high = wp.max(y0, wp.max(y1, y2))
                                if _covered(run_low, run_high, runs, low, high):
                                    continue
                                a = wp.vec3(wp.dot(rx, p) + t[0], y0, wp.dot(rz, p) + t[2])
                                b = wp.vec3(wp.dot(rx, q) + t[0], y1, wp.dot(rz, q) + t[2])
                                c = wp.vec3(wp.dot(rx, r) + t[0], y2, wp.dot(rz, r) + t[2])
                                x_min = wp.min(a[0], wp.min(b[0], c[0]))
                                x_max = wp.max(a[0], wp.max(b[0], c[0]))
                                z_min = wp.min(a[2], wp.min(b[2], c[2]))
                                z_max = wp.max(a[2], wp.max(b[2], c[2]))
                                if x_min <= half_x and x_max >= -half_x and z_min <= z_high and z_max >= z_low:
                                    if x_min < -half_x or x_max > half_x or z_min < z_low or z_max > z_high:
                                        low, high = _triangle_in_prism(a, b, c, half_x, z_low, z_high)
                                    if low <= high:
                                        runs = _add(run_low, run_high, runs, low, high)
    out_low = float(FAR)
    out_high = float(-FAR)
    for i in range(runs):
        if run_high[i] > -half_gap and run_low[i] < half_gap:
            out_low = wp.min(out_low, run_low[i])
            out_high = wp.max(out_high, run_high[i])
    return out_low, out_high


@wp.struct
class Closing:
    """What the gripper closes on (m). `found` 0: nothing between the pads."""

    low: float
    high: float
    opening: float
    found: int
    steps: int


@wp.func
def between_gaps(
    g: Gripper, surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, gap_low: float, gap_high: float, half_gap: float
):
    """`material_between` for the prism that the pads sweep while the gap goes from gap_high to gap_low."""
    z_low, z_high = pad_center_z_range(g, gap_low, gap_high)
    low, high = material_between(surfaces, s, R, t, g.pad_half_x, z_low - g.pad_half_z, z_high + g.pad_half_z, half_gap)
    return low, high


@wp.func
def close_on(g: Gripper, surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, open_gap: float) -> Closing:
    """The largest gap g <= open_gap with w(g) >= g, w(g) being the material between pads that stand at gap g.

    Closing pads stop there. The pads' z depends on the gap, so w does too. The prism swept over [a, b] bounds w(g) for
    all g in it: a bound below a proves that the pads pass through [a, b]; otherwise it cuts the top of the interval.
    """
    out = Closing()
    half_gap = 0.5 * open_gap
    least = gap_from_drive(g, g.drive_upper)
    bottom = float(least)
    top = float(open_gap)
    low, high = between_gaps(g, surfaces, s, R, t, bottom, top, half_gap)
    out.steps = 1
    if low <= high:
        top = wp.clamp(high - low, least, top)
        guess = float(0.0)
        last_top = float(0.0)
        last_w = float(0.0)
        while out.found == 0 and out.steps < MAX_STEPS:
            low, high = between_gaps(g, surfaces, s, R, t, top, top, half_gap)
            out.steps += 1
            w = high - low
            if low <= high and (w >= top - FOUND_M or top <= least):
                out.found = 1
            elif top <= least:
                break
            # the pads pass `top`: narrow [bottom, top], with a bottom where the secant expects w = g
            expected = float(w)
            if last_top > top + FOUND_M and low <= high:
                slope = wp.clamp((last_w - w) / (last_top - top), -0.9, 0.99)
                expected = (w - slope * top) / (1.0 - slope)
            last_top = top
            last_w = w
            bottom = wp.clamp(wp.max(expected, guess), least, top)
            guess = float(0.0)
            narrowing = 1 - out.found
            while narrowing == 1:
                low, high = between_gaps(g, surfaces, s, R, t, bottom, top, half_gap)
                out.steps += 1
                w = high - low
                if w < bottom:
                    top = bottom
                    narrowing = 0
                elif top - bottom <= FOUND_M or out.steps >= MAX_STEPS:
                    out.found = 1  # w jumps past g here: the pads' tips meet a step
                    narrowing = 0
                else:
                    slow = wp.where(w > 0.5 * (bottom + top), 1, 0)
                    top = wp.min(top, w)
                    if slow == 1:
                        guess = bottom
                        bottom = 0.5 * (bottom + top)
                    else:
                        narrowing = 0
    if out.found == 0 and out.steps >= MAX_STEPS and top > least:  # never seen: the bound stands for the answer
        low, high = between_gaps(g, surfaces, s, R, t, least, top, half_gap)
        out.found = wp.where(low <= high, 1, 0)
    out.low = low
    out.high = high
    out.opening = top
    return out


@wp.func
def extent_along_y(surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3):
    """Smallest and largest y (ee frame) of a whole surface."""
    ry = wp.vec3(R[1, 0], R[1, 1], R[1, 2])
    low = float(FAR)
    high = float(-FAR)
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
            ball = surfaces.leaf_sphere[leaf]
            y = wp.dot(ry, wp.vec3(ball[0], ball[1], ball[2])) + t[1]
            if y - ball[3] < low or y + ball[3] > high:
                for i in range(3 * surfaces.leaf_first[leaf], 3 * surfaces.leaf_first[leaf + 1]):
                    y = wp.dot(ry, surfaces.points[i]) + t[1]
                    low = wp.min(low, y)
                    high = wp.max(high, y)
    return low, high


@wp.kernel
def close_gripper(
    first: int,
    gripper: Gripper,
    surfaces: Surfaces,
    open_gap: float,
    whole: int,
    T_obj_ee_in: wp.array(dtype=wp.mat44),
    object_index_in: wp.array(dtype=wp.int32),
    width_out: wp.array(dtype=wp.float32),
    opening_out: wp.array(dtype=wp.float32),
    shift_out: wp.array(dtype=wp.float32),
    empty_out: wp.array(dtype=wp.bool),
    steps_out: wp.array(dtype=wp.int32),
):
    """Width, opening, shift (m) of each trial's grasp; empty: NaN, open gap, 0; too wide: w, open gap, 0.

    `whole` judges the width of the whole object; what the pads close on is the same.
    """
    trial = first + wp.tid()
    s = object_index_in[trial]
    R, t = inverse_pose(T_obj_ee_in[trial])
    c = close_on(gripper, surfaces, s, R, t, open_gap)
    width = c.high - c.low
    opening = c.opening
    shift = 0.5 * (c.low + c.high)
    if whole != 0:
        low, high = extent_along_y(surfaces, s, R, t)
        width = wp.max(width, high - low)
    if c.found == 0:
        width = wp.nan
    if c.found == 0 or width > open_gap:
        opening = open_gap
        shift = 0.0
    width_out[trial] = width
    opening_out[trial] = opening
    shift_out[trial] = shift
    empty_out[trial] = c.found == 0
    steps_out[trial] = c.steps
