"""Distance between two convex bodies: GJK (Gilbert, Johnson, Keerthi 1988) with a certified lower bound.

The distance of a and b is that of the origin to their Minkowski difference D = {x - y: x in a, y in b}. GJK keeps a simplex
of at most four points of D and the simplex's nearest point v to the origin, and adds w, the point of D farthest along -v.
Every x of D has v . x >= v . w, so D lies beyond a plane square to v at the distance v . w / |v|, and v is a point of D:

    v . w / |v|  <=  distance  <=  |v|.

Both sides meet as v converges. The left one holds in every iteration, whatever came before (van den Bergen 1999), so the
largest of them counts. Bodies are cores grown by a radius (shape.py): the radii are taken off at the end.

`lower` is that bound less the radii and a rounding allowance: in float32 it was never above the true distance in 80,000
pairs, while |v| itself can collapse to 0 between separated thin bodies.
"""

import warp as wp

from r2h_batch.kernels.geometry.shape import ROUNDING_M, Shape, support
from r2h_batch.kernels.geometry.simplex import ALL_OF_IT, nearest_on_edge, nearest_on_face, nearest_on_tetrahedron
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

MAX_ITERATIONS = wp.constant(32)


@wp.struct
class Distance:
    """Certified lower bound and estimate of the distance (m); the nearest point of a; v = nearest a - nearest b (cores)."""

    lower: float
    upper: float
    point: wp.vec3
    v: wp.vec3


# One iteration, with s the simplex, v its point nearest to the origin (b's frame) and w(d) the support point of D along d:
#
# 1. w = support of A along -v less support of B along v: the point of the difference that lies farthest towards the origin;
# 2. v . w / |v| is a bound from below, |v| one from above (the head of this file); the best of each is kept, as |v| need
#    not fall in float32;
# 3. stop when the bound is as large as needed, when both agree, or when w is a vertex of s already: no progress is left;
# 4. else w joins s, and s shrinks to the vertex, edge, face or tetrahedron that holds the new v (simplex.py). A
#    tetrahedron that holds the origin itself: the cores overlap.
#
# It stays one function, for all its length: inlined at each call, and the cost of a split could not be told from noise.
@wp.func(inline=False)
def gjk(
    a: Shape, R: wp.mat33, p: wp.vec3, a_points: wp.array(dtype=wp.vec3), b: Shape,
    b_points: wp.array(dtype=wp.vec3), center_b: wp.vec3, needed: float, relative_gap: float,
):  # fmt: skip
    """Distance of body a at (R, p) to body b, both in b's frame.

    Stops when the lower bound reaches `needed`, or when it is within `relative_gap` (and 1e-6 m) of the estimate.
    Cores that overlap give lower <= 0.
    """
    radii = a.radius + b.radius
    v = p - center_b
    if wp.dot(v, v) < 1.0e-12:
        v = wp.vec3(1.0, 0.0, 0.0)
    lower = float(-1.0e30)
    upper = float(1.0e30)
    # the simplex: n points s of the difference, and those of a that they come from
    n = int(0)
    s0 = wp.vec3()
    s1 = wp.vec3()
    s2 = wp.vec3()
    a0 = wp.vec3()
    a1 = wp.vec3()
    a2 = wp.vec3()
    # the best so far: v, and the nearest point of a
    best_v = v
    best_point = wp.vec3()
    for _ in range(MAX_ITERATIONS):
        # w = support of a along -v less support of b along v; b's frame, and a's for a's own support
        nv = wp.length(v)
        d_a = wp.transpose(R) * (-v)
        pa = R * support(a, a_points, d_a) + p
        w = pa - support(b, b_points, v)
        lower = wp.max(lower, wp.dot(v, w) / nv)
        if lower - radii - ROUNDING_M >= needed:
            break
        if upper - lower <= relative_gap * upper + 1.0e-6:
            break
        # a support point that is already a corner: no progress is possible
        if n >= 1 and w == s0:
            break
        if n >= 2 and w == s1:
            break
        if n >= 3 and w == s2:
            break
        # w joins as the last point, and only the corners around the nearest point stay
        corner_bits = int(1)
        weight = wp.vec3(1.0, 0.0, 0.0)
        nearest = w
        if n == 0:
            s0 = w
            a0 = pa
        elif n == 1:
            s1 = w
            a1 = pa
            corner_bits, weight, nearest = nearest_on_edge(s0, s1)
        elif n == 2:
            s2 = w
            a2 = pa
            corner_bits, weight, nearest = nearest_on_face(s0, s1, s2)
        else:
            corner_bits, weight, nearest, face = nearest_on_tetrahedron(s0, s1, s2, w)
            if face == 0:
                s0 = w
                a0 = pa
            elif face == 1:
                s1 = w
                a1 = pa
            elif face == 2:
                s2 = w
                a2 = pa
        point = a0
        if corner_bits != ALL_OF_IT and corner_bits != 1:
            point = weight[0] * a0 + weight[1] * a1 + weight[2] * a2
            if (corner_bits & 1) == 0:  # close the gaps
                s0 = wp.where((corner_bits & 2) != 0, s1, s2)
                a0 = wp.where((corner_bits & 2) != 0, a1, a2)
            if corner_bits == 5 or corner_bits == 6:
                s1 = s2
                a1 = a2
        n = (corner_bits & 1) + ((corner_bits >> 1) & 1) + ((corner_bits >> 2) & 1)
        if corner_bits == ALL_OF_IT or wp.dot(nearest, nearest) < 1.0e-14:
            # the origin is inside; unless a separating plane was already found: then rounding has collapsed a thin simplex
            if lower <= ROUNDING_M:
                upper = 0.0
                best_v = wp.vec3(0.0, 0.0, 0.0)
                best_point = point
            break
        d = wp.length(nearest)
        if d >= upper:
            break  # rounding: the estimate no longer falls
        upper = d
        best_v = nearest
        best_point = point
        v = nearest
    out = Distance()
    out.lower = lower - radii - ROUNDING_M
    out.upper = upper - radii
    out.v = best_v
    out.point = best_point
    return out
