"""Points, segments and capsules: the way from one to the nearest point of the other, and a capsule in motion."""

import warp as wp

from r2h_batch.kernels.geometry.body import ROUNDING_M
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func(inline=False)
def from_point(x: wp.vec3, a: wp.vec3, b: wp.vec3):
    """The vector from x to the nearest point of the segment a-b."""
    d = b - a
    dd = wp.dot(d, d)
    t = float(0.0)
    if dd > 0.0:
        t = wp.clamp(wp.dot(x - a, d) / dd, 0.0, 1.0)
    return a + t * d - x


@wp.func(inline=False)
def from_segment(b0: wp.vec3, b1: wp.vec3, a0: wp.vec3, a1: wp.vec3):
    """The vector from segment b to segment a where they are nearest (Ericson 5.1.9)."""
    # |r + s u - t v|^2 over s, t in [0, 1]: a quadratic with the matrix [[a, -b], [-b, e]]
    u = a1 - a0
    v = b1 - b0
    r = a0 - b0
    a = wp.dot(u, u)
    e = wp.dot(v, v)
    f = wp.dot(v, r)
    c = wp.dot(u, r)
    s = float(0.0)
    t = float(0.0)
    parallel = bool(False)
    if a <= 1.0e-12:
        if e > 1.0e-12:
            t = wp.clamp(f / e, 0.0, 1.0)
    elif e <= 1.0e-12:
        s = wp.clamp(-c / a, 0.0, 1.0)
    else:
        b = wp.dot(u, v)
        denom = a * e - b * b
        parallel = denom < 1.0e-3 * a * e
        if denom > 1.0e-9 * a * e:
            s = wp.clamp((b * f - c * e) / denom, 0.0, 1.0)
        t = (b * s + f) / e
        if t < 0.0:
            t = 0.0
            s = wp.clamp(-c / a, 0.0, 1.0)
        elif t > 1.0:
            t = 1.0
            s = wp.clamp((b - c) / a, 0.0, 1.0)
    out = r + s * u - t * v
    if parallel:  # where they are nearest is rounding noise then, up to 0.14 mm too far: an end may be nearer
        ends = wp.matrix_from_rows(
            from_point(b0, a0, a1), from_point(b1, a0, a1), -from_point(a0, b0, b1), -from_point(a1, b0, b1)
        )
        for k in range(4):
            if wp.length_sq(ends[k]) < wp.length_sq(out):
                out = ends[k]
    return out


@wp.func(inline=False)
def swept_capsule(
    c0: wp.vec3, c1: wp.vec3, radius: float, n: wp.vec3, w: wp.vec3, v: wp.vec3, g: wp.vec3, c: float,
    second: float, third: float,
):  # fmt: skip
    """Lower bound of n . x over a capsule that moves: `swept_support` (body.py) says how."""
    rest = 0.5 * second
    if third < 3.0 * second:
        least = c + wp.min(wp.dot(g, c0), wp.dot(g, c1)) - radius * wp.length(g)
        rest = wp.min(rest, third / 6.0 - 0.5 * wp.min(least, 0.0))
    low = float(1.0e30)
    m = wp.cross(n, w)
    for k in range(2):
        s = float(2 * k - 1)
        u = n + s * m
        low = wp.min(low, wp.min(wp.dot(u, c0), wp.dot(u, c1)) - radius * wp.length(u) + s * wp.dot(n, v))
    return low - rest - ROUNDING_M
