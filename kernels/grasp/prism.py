"""The prism that the pads sweep, |x| <= half_x and z_low <= z <= z_high in the ee frame, and what a triangle leaves in it.

A triangle cut to a prism along y is a polygon. Its corners are ends of what the triangle's edges have inside the prism,
or points of the triangle on the prism's four corner lines: y, being linear on it, is extreme at one of these.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func(inline=False)
def clip_edge(p: float, q: float, low: float, high: float, t0: float, t1: float):
    """[t0, t1] cut to where low <= p + t (q - p) <= high (t0 > t1: nowhere)."""
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
def corner(i: int, half_x: float, z_low: float, z_high: float):
    """x, z of the prism's corner line i = 0 .. 3."""
    return wp.where(i < 2, -half_x, half_x), wp.where(i % 2 == 0, z_low, z_high)
