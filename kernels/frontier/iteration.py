"""One iteration of GJK, for kernels whose lanes iterate together and take the next pair when their own is done.

The iteration is that of geometry/gjk.py, which says why it is certified; the same numbers come out, bit for bit
(tests/judge/test_frontier.py). No caller needs the nearest points of the two bodies, so only the difference's are kept.
"""

import warp as wp

from r2h_batch.kernels.geometry.shape import ROUNDING_M
from r2h_batch.kernels.geometry.simplex import ALL_OF_IT, nearest_on_edge, nearest_on_face, nearest_on_tetrahedron
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.func
def first_direction(p: wp.vec3, center: wp.vec3):
    """Where GJK of a body at p starts from; `center`: a point of its obstacle."""
    v = p - center
    if wp.dot(v, v) < 1.0e-12:
        v = wp.vec3(1.0, 0.0, 0.0)
    return v


@wp.func
def iterate(
    w: wp.vec3, radii: float, needed: float, gap: float, v: wp.vec3, best_v: wp.vec3, lower: float, upper: float,
    n: int, s0: wp.vec3, s1: wp.vec3, s2: wp.vec3,
):  # fmt: skip
    """GJK's state after one more support point w of the difference of two cores (along -v): `over`, then as it is given.

    Over: the lower bound is `needed` more than the `radii`, or within `gap` of the estimate, or there is no progress left.
    """
    low = wp.max(lower, wp.dot(v, w) / wp.length(v))
    over = low - radii - ROUNDING_M >= needed or upper - low <= gap * upper + 1.0e-6
    # a support point that is already a corner: no progress is possible
    over = over or (n >= 1 and w == s0) or (n >= 2 and w == s1) or (n >= 3 and w == s2)
    high = float(upper)
    count = int(n)
    found_v = wp.vec3(best_v)
    next_v = wp.vec3(v)
    t0 = wp.vec3(s0)
    t1 = wp.vec3(s1)
    t2 = wp.vec3(s2)
    if not over:
        corner_bits = int(1)
        nearest = wp.vec3(w)
        if n == 0:
            t0 = w
        elif n == 1:
            t1 = w
            corner_bits, _weight, nearest = nearest_on_edge(t0, t1)
        elif n == 2:
            t2 = w
            corner_bits, _weight, nearest = nearest_on_face(t0, t1, t2)
        else:
            corner_bits, _weight, nearest, face = nearest_on_tetrahedron(t0, t1, t2, w)
            if face == 0:
                t0 = w
            elif face == 1:
                t1 = w
            elif face == 2:
                t2 = w
        if corner_bits != ALL_OF_IT and corner_bits != 1:
            if (corner_bits & 1) == 0:  # close the gaps
                t0 = wp.where((corner_bits & 2) != 0, t1, t2)
            if corner_bits == 5 or corner_bits == 6:
                t1 = t2
        count = (corner_bits & 1) + ((corner_bits >> 1) & 1) + ((corner_bits >> 2) & 1)
        far = wp.length(nearest)
        if corner_bits == ALL_OF_IT or wp.dot(nearest, nearest) < 1.0e-14:
            over = True
            # the origin is inside, unless a separating plane was already found: rounding has collapsed a thin simplex
            if low <= ROUNDING_M:
                high = 0.0
                found_v = wp.vec3(0.0, 0.0, 0.0)
        elif far >= upper:
            over = True  # rounding: the estimate no longer falls
        else:
            high = far
            found_v = nearest
            next_v = nearest
    return over, next_v, found_v, low, high, count, t0, t1, t2
