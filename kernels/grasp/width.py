"""The width that a gripper closes to: the largest gap that the material between its pads fills.

Closing pads stop at the first gap g at which the material between them, w(g), is as wide as they stand apart.
"""

import warp as wp

from r2h_batch.kernels.geometry.surface import Surfaces, inverse_pose
from r2h_batch.kernels.grasp.material import material_between
from r2h_batch.kernels.grasp.prism import FAR
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, gap_from_drive, pad_center_z_range

wp.set_module_options(OPTIONS)

FOUND_M = wp.constant(1.0e-5)
MAX_STEPS = wp.constant(64)


@wp.struct
class Closing:
    """Width that the gripper closes on (m). `found` 0: nothing between the pads."""

    low: float
    high: float
    opening: float
    found: int


@wp.func
def between_gaps(
    g: Gripper, surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, gap_low: float, gap_high: float, half_gap: float
):
    """`material_between` for the prism that the pads sweep while the gap goes from gap_high to gap_low."""
    z_low, z_high = pad_center_z_range(g, gap_low, gap_high)
    low, high = material_between(surfaces, s, R, t, g.pad_half_x, z_low - g.pad_half_z, z_high + g.pad_half_z, half_gap)
    return low, high


# What `close_on` asks about next.
SWEPT = wp.constant(0)  # the prism of all gaps
AT_TOP = wp.constant(1)  # the prism of the gap `top`
NARROW = wp.constant(2)  # the prism of the gaps from `bottom` to `top`
LAST = wp.constant(3)  # the same from the least gap on, after MAX_STEPS


# Closing pads stop at the largest gap g with w(g) >= g. The pads' z depends on the gap, so w does too: this is a fixed point, and
# w has jumps where the pads' ends pass a step of the object. What is certain is a bound: the prism swept over [a, b] holds the
# prisms of all gaps in it, so its material W(a, b) >= w(g) for a <= g <= b, and W(a, b) < a proves that the pads pass through
# [a, b]. So `top` falls, in one loop around one call of `between_gaps`:
#
# 1. AT_TOP: w(top) >= top ends the search; else a secant through the last two (gap, w) says where w = g is to be expected, and
#    that is the bottom of the bracket;
# 2. NARROW: the pads pass all gaps above W(bottom, top): the top falls to W, or to the bottom where W lies below that. A bound
#    that takes off less than half of the bracket is followed by one over the upper half. Else AT_TOP follows.
@wp.func
def close_on(g: Gripper, surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, open_gap: float) -> Closing:
    """The largest gap g <= open_gap with w(g) >= g, w(g) being the material between pads that stand at gap g."""
    half_gap = 0.5 * open_gap
    least = gap_from_drive(g, g.drive_upper)
    out = Closing()
    asked = int(SWEPT)
    bottom = float(least)
    top = float(open_gap)
    guess = float(0.0)  # a bottom to try next (0: none)
    last_top = float(0.0)
    last_w = float(0.0)
    steps = int(0)
    running = bool(True)
    while running:
        low, high = between_gaps(g, surfaces, s, R, t, wp.where(asked == AT_TOP, top, bottom), top, half_gap)
        out.low = low
        out.high = high
        some = low <= high
        w = high - low
        steps += 1
        if asked == SWEPT:
            running = some
            if some:
                top = wp.clamp(w, least, top)
            asked = AT_TOP
        elif asked == AT_TOP:
            if some and (w >= top - FOUND_M or top <= least):
                out.found = 1
            running = out.found == 0 and top > least
            expected = float(w)
            if last_top > top + FOUND_M and some:
                slope = wp.clamp((last_w - w) / (last_top - top), -0.9, 0.99)
                expected = (w - slope * top) / (1.0 - slope)
            last_top = top
            last_w = w
            bottom = wp.clamp(wp.max(expected, guess), least, top)
            guess = 0.0
            asked = NARROW
        elif asked == NARROW:
            if w < bottom:
                top = bottom
                asked = AT_TOP
            elif top - bottom <= FOUND_M or steps >= MAX_STEPS:
                out.found = 1  # w jumps past g here: the pads' tips meet a step
                running = False
            else:
                asked = wp.where(w > 0.5 * (bottom + top), NARROW, AT_TOP)
                top = wp.min(top, w)
                if asked == NARROW:
                    guess = bottom
                    bottom = 0.5 * (bottom + top)
        else:
            out.found = wp.where(some, 1, 0)
            running = False
        if running and asked == AT_TOP and steps >= MAX_STEPS:  # never seen: the bound stands for the answer
            asked = LAST
            bottom = least
            running = top > least
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
    # tables
    gripper: Gripper, surfaces: Surfaces, open_gap: float, whole: int,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44), object_index_in: wp.array(dtype=wp.int32),
    # out
    width_out: wp.array(dtype=wp.float32), opening_out: wp.array(dtype=wp.float32),
    shift_out: wp.array(dtype=wp.float32), empty_out: wp.array(dtype=wp.bool),
):  # fmt: skip
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
