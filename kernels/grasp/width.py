"""Material between the pads: exact on the triangles, one trial a thread.

The pad prism is |x| <= half_x, z_low <= z <= z_high in the ee frame, any y. The y at which it meets the object's solid
are the y ranges of the triangles clipped to it, and what lies inside the solid between those: there the prism's whole
cross-section is inside, so the line along its centre tells. What overlaps is one run of material.
"""

import warp as wp

from r2h_batch.kernels.geometry.surface import Surfaces, center, inverse_pose, line_hit, may_hit
from r2h_batch.kernels.grasp.prism import clip_edge, corner
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, gap_from_drive, pad_center_z_range

wp.set_module_options(OPTIONS)

MAX_RUNS = wp.constant(24)
JOIN_M = wp.constant(1.0e-6)
COVERED_M = wp.constant(1.0e-7)
FOUND_M = wp.constant(1.0e-5)
MAX_STEPS = wp.constant(64)
FAR = wp.constant(1.0e30)

vec24 = wp.types.vector(24, wp.float32)
vec24i = wp.types.vector(24, wp.int32)


@wp.func(inline=False)
def _triangle_in_prism(a: wp.vec3, b: wp.vec3, c: wp.vec3, half_x: float, z_low: float, z_high: float):
    """Range of y of triangle abc cut to the prism (low > high: none)."""
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
        t0, t1 = clip_edge(p[0], q[0], -half_x, half_x, 0.0, 1.0)
        if t0 > t1:
            continue
        t0, t1 = clip_edge(p[2], q[2], z_low, z_high, t0, t1)
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
        x, z = corner(i, half_x, z_low, z_high)
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


@wp.func(inline=False)
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


@wp.func(inline=False)
def _crossings(surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, x: float, z: float):
    """Where the line (x, ., z) of the ee frame crosses surface s: how often, the y (unsorted), the signs."""
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
    return n, ys, windings


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
    """The y at which the line (x, ., z) of the ee frame lies inside closed surface s, as runs. R, t: object to ee frame.

    From one end to the other the winding number changes by each crossing's sign; where it is not 0, there is solid.
    """
    n, ys, windings = _crossings(surfaces, s, R, t, x, z)
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
def _add_triangle(
    surfaces: Surfaces,
    tri: int,
    rx: wp.vec3,  # rows of R, object to ee frame
    ry: wp.vec3,
    rz: wp.vec3,
    t: wp.vec3,
    half_x: float,
    z_low: float,
    z_high: float,
    run_low: wp.array(dtype=float),
    run_high: wp.array(dtype=float),
    runs: int,
) -> int:
    """Joins the y range of a triangle cut to the prism to the runs, in place; the new number of runs."""
    p = surfaces.points[3 * tri]
    q = surfaces.points[3 * tri + 1]
    r = surfaces.points[3 * tri + 2]
    y0 = wp.dot(ry, p) + t[1]
    y1 = wp.dot(ry, q) + t[1]
    y2 = wp.dot(ry, r) + t[1]
    low = wp.min(y0, wp.min(y1, y2))
    high = wp.max(y0, wp.max(y1, y2))
    if not _covered(run_low, run_high, runs, low, high):
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
    return runs


@wp.func
def _outermost(run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), runs: int, half_gap: float):
    """Lowest and highest y of the runs that meet |y| < half_gap (low > high: none)."""
    low = float(FAR)
    high = float(-FAR)
    for i in range(runs):
        if run_high[i] > -half_gap and run_low[i] < half_gap:
            low = wp.min(low, run_low[i])
            high = wp.max(high, run_high[i])
    return low, high


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
                                runs = _add_triangle(
                                    surfaces, tri, rx, ry, rz, t, half_x, z_low, z_high, run_low, run_high, runs
                                )
    return _outermost(run_low, run_high, runs, half_gap)


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


@wp.struct
class Bracket:
    """Where the pads come to stand: between the gaps bottom and top; `guess`: a bottom to try next (0: none)."""

    bottom: float
    top: float
    guess: float
    low: float  # y of the material in the last prism asked
    high: float
    found: int
    steps: int


@wp.func
def _narrow(k: Bracket, g: Gripper, surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, half_gap: float):
    """The bracket with its top at a gap that the pads do reach, or `found`: the prism's bound, until it says no more.

    W = material in the prism swept over [bottom, top] is at least w(g) for every gap g of it. So the pads pass all gaps
    above W: the top falls to W, or to the bottom where W lies below that. A bound that takes off less than half of the
    bracket is followed by one over the upper half.
    """
    k.guess = 0.0
    narrowing = 1 - k.found
    while narrowing == 1:
        low, high = between_gaps(g, surfaces, s, R, t, k.bottom, k.top, half_gap)
        k.steps += 1
        k.low = low
        k.high = high
        w = high - low
        if w < k.bottom:
            k.top = k.bottom
            narrowing = 0
        elif k.top - k.bottom <= FOUND_M or k.steps >= MAX_STEPS:
            k.found = 1  # w jumps past g here: the pads' tips meet a step
            narrowing = 0
        else:
            slow = wp.where(w > 0.5 * (k.bottom + k.top), 1, 0)
            k.top = wp.min(k.top, w)
            if slow == 1:
                k.guess = k.bottom
                k.bottom = 0.5 * (k.bottom + k.top)
            else:
                narrowing = 0
    return k


@wp.func
def close_on(g: Gripper, surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, open_gap: float) -> Closing:
    """The largest gap g <= open_gap with w(g) >= g, w(g) being the material between pads that stand at gap g.

    Closing pads stop there. The pads' z depends on the gap, so w does too: this is a fixed point, and w has jumps where
    the pads' ends pass a step of the object. What is certain is a bound: the prism swept over [a, b] holds the prisms of
    all gaps in it, so its material W(a, b) >= w(g) for a <= g <= b, and W(a, b) < a proves that the pads pass through
    [a, b]. From the top: w(top) >= top ends the search; else a secant through the last two (gap, w) says where w = g is to
    be expected, and the bracket from there to the top is narrowed (`_narrow`) until the pads are known to reach its top.
    """
    half_gap = 0.5 * open_gap
    least = gap_from_drive(g, g.drive_upper)
    k = Bracket()
    k.bottom = least
    k.top = open_gap
    low, high = between_gaps(g, surfaces, s, R, t, k.bottom, k.top, half_gap)
    k.steps = 1
    if low <= high:
        k.top = wp.clamp(high - low, least, k.top)
        last_top = float(0.0)
        last_w = float(0.0)
        while k.found == 0 and k.steps < MAX_STEPS:
            low, high = between_gaps(g, surfaces, s, R, t, k.top, k.top, half_gap)
            k.steps += 1
            w = high - low
            if low <= high and (w >= k.top - FOUND_M or k.top <= least):
                k.found = 1
            elif k.top <= least:
                break
            # the pads pass `top`: narrow [bottom, top], with a bottom where the secant expects w = g
            expected = float(w)
            if last_top > k.top + FOUND_M and low <= high:
                slope = wp.clamp((last_w - w) / (last_top - k.top), -0.9, 0.99)
                expected = (w - slope * k.top) / (1.0 - slope)
            last_top = k.top
            last_w = w
            k.bottom = wp.clamp(wp.max(expected, k.guess), least, k.top)
            k.low = low
            k.high = high
            k = _narrow(k, g, surfaces, s, R, t, half_gap)
            low = k.low
            high = k.high
    if k.found == 0 and k.steps >= MAX_STEPS and k.top > least:  # never seen: the bound stands for the answer
        low, high = between_gaps(g, surfaces, s, R, t, least, k.top, half_gap)
        k.found = wp.where(low <= high, 1, 0)
    out = Closing()
    out.low = low
    out.high = high
    out.opening = k.top
    out.found = k.found
    out.steps = k.steps
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
    # tables
    gripper: Gripper,
    surfaces: Surfaces,
    open_gap: float,
    whole: int,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44),
    object_index_in: wp.array(dtype=wp.int32),
    # out
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
