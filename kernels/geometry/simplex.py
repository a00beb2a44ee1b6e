"""The point of a segment, triangle or tetrahedron that is nearest to the origin, with its weights: GJK's inner step.

The nearest point lies inside exactly one of the simplex's parts (corners, edges, faces, all of it): the one in whose
Voronoi region the origin is. Its corners alone are kept. Its point is sum w_i s_i with weights w_i >= 0 that sum to 1, and
as s_i = a_i - b_i, the same weights give the nearest points sum w_i a_i and sum w_i b_i of both bodies.

The kept corners are returned as bits (bit i: corner i is kept) beside the weights and the point, not as a struct: Warp
writes a struct that differs between branches to memory and reads it back after each, which took a third of a GJK
iteration.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

ALL_OF_IT = wp.constant(8)
"""In place of the bits: the origin is inside the tetrahedron."""


@wp.func(inline=False)
def nearest_on_edge(a: wp.vec3, b: wp.vec3):
    """Part, weights and point of a segment: a + f (b - a) with f = -a . d / d . d, clamped to [0, 1]."""
    d = b - a
    dd = wp.dot(d, d)
    t = -wp.dot(a, d)
    corner_bits = int(1)
    weight = wp.vec3(1.0, 0.0, 0.0)
    v = a
    if t > 0.0 and dd > 0.0:
        if t >= dd:
            corner_bits = 2
            weight = wp.vec3(0.0, 1.0, 0.0)
            v = b
        else:
            f = t / dd
            corner_bits = 3
            weight = wp.vec3(1.0 - f, f, 0.0)
            v = a + f * d
    return corner_bits, weight, v


@wp.func
def _nearest_on_edge_of(a: wp.vec3, b: wp.vec3, c: wp.vec3, edge: int):
    """As `nearest_on_edge`, of the two corners of a triangle whose bits `edge` has."""
    kept, w, v = nearest_on_edge(wp.where(edge == 6, b, a), wp.where(edge == 3, b, c))
    corner_bits = kept
    weight = w
    if edge == 5:
        corner_bits = (kept & 1) | ((kept & 2) << 1)
        weight = wp.vec3(w[0], 0.0, w[1])
    elif edge == 6:
        corner_bits = kept << 1
        weight = wp.vec3(0.0, w[0], w[1])
    return corner_bits, weight, v


@wp.func(inline=False)
def nearest_on_face(a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """Part, weights and point of a triangle, by Voronoi regions (Ericson, Real-Time Collision Detection, 5.1.5).

    As closest.py has it, for the origin; the weights va : vb : vc decide the region only.
    """
    ab = b - a
    ac = c - a
    d1 = -wp.dot(ab, a)
    d2 = -wp.dot(ac, a)
    d3 = -wp.dot(ab, b)
    d4 = -wp.dot(ac, b)
    d5 = -wp.dot(ab, c)
    d6 = -wp.dot(ac, c)
    vc = d1 * d4 - d3 * d2
    vb = d5 * d2 - d1 * d6
    va = d3 * d6 - d5 * d4
    corner_bits = int(0)
    weight = wp.vec3(0.0, 0.0, 0.0)
    v = a
    edge = int(0)  # the two corners of the edge in whose region the origin is
    if d1 <= 0.0 and d2 <= 0.0:
        corner_bits = 1
        weight = wp.vec3(1.0, 0.0, 0.0)
    elif d3 >= 0.0 and d4 <= d3:
        corner_bits = 2
        weight = wp.vec3(0.0, 1.0, 0.0)
        v = b
    elif d6 >= 0.0 and d5 <= d6:
        corner_bits = 4
        weight = wp.vec3(0.0, 0.0, 1.0)
        v = c
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        edge = 3
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        edge = 5
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        edge = 6
    else:
        n = wp.cross(ab, ac)
        nn = wp.dot(n, n)
        total = va + vb + vc
        if nn > 0.0 and total > 0.0:
            corner_bits = 7
            # plane and areas seen from the nearest point: for thin triangles va, vb, vc are mostly rounding
            v = n * (wp.dot(a, n) / nn)
            w0 = wp.clamp(wp.dot(n, wp.cross(b - v, c - v)) / nn, 0.0, 1.0)
            w1 = wp.clamp(wp.dot(n, wp.cross(c - v, a - v)) / nn, 0.0, 1.0 - w0)
            weight = wp.vec3(w0, w1, 1.0 - w0 - w1)
        else:
            edge = 3
    if edge != 0:
        corner_bits, weight, v = _nearest_on_edge_of(a, b, c, edge)
    return corner_bits, weight, v


@wp.func(inline=False)
def nearest_on_tetrahedron(s0: wp.vec3, s1: wp.vec3, s2: wp.vec3, s3: wp.vec3):
    """ALL_OF_IT when the origin is inside; otherwise the nearest of the faces that have the origin on their outer side.

    Fourth: the face, by the corner that it lacks, in whose place it has corner 3.
    """
    best = float(1.0e30)
    corner_bits = int(ALL_OF_IT)
    weight = wp.vec3(0.0, 0.0, 0.0)
    v = wp.vec3(0.0, 0.0, 0.0)
    face = int(3)
    for i in range(4):
        a = wp.where(i == 0, s3, s0)
        b = wp.where(i == 1, s3, s1)
        c = wp.where(i == 2, s3, s2)
        q = wp.where(i == 0, s0, wp.where(i == 1, s1, wp.where(i == 2, s2, s3)))
        n = wp.cross(b - a, c - a)
        origin_side = -wp.dot(n, a)
        inner_side = wp.dot(n, q - a)
        # flat tetrahedra have no inner side: all their faces count
        if origin_side * inner_side <= 0.0:
            kept, w, x = nearest_on_face(a, b, c)
            d = wp.dot(x, x)
            if d < best:
                best = d
                corner_bits = kept
                weight = w
                v = x
                face = i
    return corner_bits, weight, v, face
