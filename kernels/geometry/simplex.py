"""The point of a segment, triangle or tetrahedron that is nearest to the origin, with its weights: GJK's inner step.

The nearest point lies inside exactly one of the simplex's parts (corners, edges, faces, all of it): the one in whose
Voronoi region the origin is. That part alone is kept. Its point is sum w_i s_i with weights w_i >= 0 that sum to 1, and as
s_i = a_i - b_i, the same weights give the nearest points sum w_i a_i and sum w_i b_i of both bodies.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Simplex:
    """Up to four points of the Minkowski difference a - b, the points of a they come from, and their weights."""

    n: int
    s0: wp.vec3
    s1: wp.vec3
    s2: wp.vec3
    s3: wp.vec3
    a0: wp.vec3
    a1: wp.vec3
    a2: wp.vec3
    a3: wp.vec3
    w0: float
    w1: float
    w2: float
    v: wp.vec3


@wp.func
def _keep(s: Simplex, i: int, j: int):
    """The simplex of points i (and j if it is not -1)."""
    r = Simplex()
    pi = s.s0
    ai = s.a0
    if i == 1:
        pi = s.s1
        ai = s.a1
    elif i == 2:
        pi = s.s2
        ai = s.a2
    r.n = 1
    r.s0 = pi
    r.a0 = ai
    r.w0 = 1.0
    r.v = pi
    if j >= 0:
        pj = s.s1
        aj = s.a1
        if j == 2:
            pj = s.s2
            aj = s.a2
        r.n = 2
        r.s1 = pj
        r.a1 = aj
    return r


@wp.func
def nearest_on_edge(s: Simplex):
    """The segment cut to what holds its nearest point: s0 + f (s1 - s0) with f = -s0 . d / d . d, clamped to [0, 1]."""
    d = s.s1 - s.s0
    dd = wp.dot(d, d)
    t = -wp.dot(s.s0, d)
    r = s
    if t <= 0.0 or dd <= 0.0:
        r = _keep(s, 0, -1)
    elif t >= dd:
        r = _keep(s, 1, -1)
    else:
        f = t / dd
        r.n = 2
        r.w0 = 1.0 - f
        r.w1 = f
        r.w2 = 0.0
        r.v = s.s0 + f * d
    return r


@wp.func
def nearest_on_face(s: Simplex):
    """The triangle cut to what holds its nearest point, by Voronoi regions (Ericson, Real-Time Collision Detection, 5.1.5).

    As triangle.py has it, for the origin; the weights va : vb : vc decide the region only.
    """
    a = s.s0
    b = s.s1
    c = s.s2
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
    r = s
    if d1 <= 0.0 and d2 <= 0.0:
        r = _keep(s, 0, -1)
    elif d3 >= 0.0 and d4 <= d3:
        r = _keep(s, 1, -1)
    elif d6 >= 0.0 and d5 <= d6:
        r = _keep(s, 2, -1)
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        r = nearest_on_edge(_keep(s, 0, 1))
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        r = nearest_on_edge(_keep(s, 0, 2))
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        r = nearest_on_edge(_keep(s, 1, 2))
    else:
        n = wp.cross(ab, ac)
        nn = wp.dot(n, n)
        total = va + vb + vc
        if nn > 0.0 and total > 0.0:
            r.n = 3
            # plane and areas seen from the nearest point: for thin triangles va, vb, vc are mostly rounding
            v = n * (wp.dot(a, n) / nn)
            r.w0 = wp.clamp(wp.dot(n, wp.cross(b - v, c - v)) / nn, 0.0, 1.0)
            r.w1 = wp.clamp(wp.dot(n, wp.cross(c - v, a - v)) / nn, 0.0, 1.0 - r.w0)
            r.w2 = 1.0 - r.w0 - r.w1
            r.v = v
        else:
            r = nearest_on_edge(_keep(s, 0, 1))
    return r


@wp.func
def _face(s: Simplex, i: int):
    """The tetrahedron's face without point i."""
    r = Simplex()
    r.n = 3
    r.s0 = s.s0
    r.a0 = s.a0
    r.s1 = s.s1
    r.a1 = s.a1
    r.s2 = s.s2
    r.a2 = s.a2
    if i == 0:
        r.s0 = s.s3
        r.a0 = s.a3
    elif i == 1:
        r.s1 = s.s3
        r.a1 = s.a3
    elif i == 2:
        r.s2 = s.s3
        r.a2 = s.a3
    return r


@wp.func
def nearest_on_tetrahedron(s: Simplex):
    """n = 4 when the origin is inside; otherwise the nearest of the faces that have the origin on their outer side."""
    best = float(1.0e30)
    found = int(0)
    r = s
    for i in range(4):
        f = _face(s, i)
        q = s.s3
        if i == 0:
            q = s.s0
        elif i == 1:
            q = s.s1
        elif i == 2:
            q = s.s2
        n = wp.cross(f.s1 - f.s0, f.s2 - f.s0)
        origin_side = -wp.dot(n, f.s0)
        inner_side = wp.dot(n, q - f.s0)
        # flat tetrahedra have no inner side: all their faces count
        if origin_side * inner_side <= 0.0:
            c = nearest_on_face(f)
            d = wp.dot(c.v, c.v)
            if d < best:
                best = d
                r = c
                found = 1
    if found == 0:
        r.n = 4
        r.v = wp.vec3(0.0, 0.0, 0.0)
    return r
