"""Sine, cosine, arc tangent and arc cosine in float32 from products and sums alone: the same bits on every processor.

The functions of C's library and of CUDA's differ in their last bits. Ranges and polynomials are Cephes' (Moshier 1989: sinf,
cosf, atanf); errors are below 1.3e-7 for angles within +-100 rad (tests/kernels/test_angles.py).
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

TURNS_PER_RAD = wp.constant(0.6366197723675814)
"""Quarter turns in a radian."""


@wp.func
def sin_cos(x: float):
    """Sine and cosine of x (rad)."""
    # whole quarter turns are taken off in three parts (Cody and Waite): the first has 8 bits, so that products are exact
    turns = wp.floor(x * TURNS_PER_RAD + 0.5)
    r = ((x - turns * 1.5703125) - turns * 4.837512969970703125e-4) - turns * 7.54978995489188216e-8
    z = r * r
    s = ((-1.9515295891e-4 * z + 8.3321608736e-3) * z - 1.6666654611e-1) * z * r + r
    c = ((2.443315711809948e-5 * z - 1.388731625493765e-3) * z + 4.166664568298827e-2) * z * z - 0.5 * z + 1.0
    quarter = int(turns) & 3
    odd = (quarter & 1) == 1
    sine = wp.where(odd, c, s)
    cosine = wp.where(odd, s, c)
    sine = wp.where(quarter >= 2, -sine, sine)
    cosine = wp.where(quarter == 1 or quarter == 2, -cosine, cosine)
    return sine, cosine


@wp.func
def angle_of(y: float, x: float) -> float:
    """The angle of (x, y) from the x axis, -pi to pi; 0 of the origin itself."""
    ax = wp.abs(x)
    ay = wp.abs(y)
    # the lesser over the greater is the tangent of an angle below pi / 4; above pi / 8 that of the rest to pi / 4
    t = wp.min(ax, ay) / wp.max(wp.max(ax, ay), 1.0e-38)
    from_eighth = t > 0.41421356237309503
    t = wp.where(from_eighth, (t - 1.0) / (t + 1.0), t)
    z = t * t
    a = (((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z - 3.33329491539e-1) * z * t + t
    a = wp.where(from_eighth, a + 0.7853981633974483, a)
    a = wp.where(ay > ax, 1.5707963267948966 - a, a)
    a = wp.where(x < 0.0, 3.141592653589793 - a, a)
    return wp.where(y < 0.0, -a, a)


@wp.func
def arc_cosine(c: float) -> float:
    """The angle whose cosine is c, 0 to pi."""
    return angle_of(wp.sqrt((1.0 - c) * (1.0 + c)), c)
