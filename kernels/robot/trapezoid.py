"""Rest to rest over a distance with a trapezoid of speed: how fast it gets, how long it takes; in float32 or float64.

Speed rises with the acceleration a to v, stays, and falls with a. Ramps take v / a and v^2 / 2a each, so a distance d takes
v / a + d / v. Below d = v^2 / a the trapezoid is a triangle with the peak sqrt(a d), where this is 2 sqrt(d / a).
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def peak_speed(distance: wp.Float, speed: wp.Float, acceleration: wp.Float):
    """The speed (rad/s) that is reached over a distance (rad): at most `speed`."""
    return wp.min(speed, wp.sqrt(acceleration * distance))


@wp.func
def duration(distance: wp.Float, speed: wp.Float, acceleration: wp.Float):
    """Time (s) over a distance (rad), 0 for none. r2h_batch.motion.execute has the same law in torch."""
    v = peak_speed(distance, speed, acceleration)
    t = v / acceleration
    if v > type(v)(0.0):
        t += distance / v
    return t
