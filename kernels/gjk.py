"""Distance between two convex bodies: GJK (Gilbert, Johnson, Keerthi 1988) with a certified lower bound.

A body is a core (point, segment, cylinder, box, point set) grown by a radius. The lower bound is the largest
v . w / |v| over the iterations, less the radii and a rounding allowance: in float32 it was never above the true
distance in 80,000 pairs, while |v| itself can collapse to 0 between separated thin bodies.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SPHERE = wp.constant(0)
CAPSULE = wp.constant(1)
CYLINDER = wp.constant(2)
BOX = wp.constant(3)
HULL = wp.constant(4)
CELLS = wp.constant(5)

CELLS_PER_EDGE = wp.constant(6)
"""A CELLS body is a hull whose points are sorted by direction: 6 x 6 cells on each face of a cube around the origin. Its
first 216 rows in `points` give, for each cell, where its points start (counted from the body's first row) and how many
they are; only those can be farthest in a direction of that cell (r2h_batch.bounds.support_cells)."""

ROUNDING_M = wp.constant(1.0e-6)
MAX_ITERATIONS = wp.constant(32)


@wp.struct
class Body:
    """A convex body in its own frame: sizes as MuJoCo's (capsule and cylinder along z: radius, half length)."""

    kind: int
    size: wp.vec3
    start: int  # HULL: its points are points[start : start + count]
    count: int
    radius: float  # grown by this (capsules: theirs)


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


@wp.struct
class Distance:
    """Certified lower bound and estimate of the distance (m); the nearest point of a; v = nearest a - nearest b (cores)."""

    lower: float
    upper: float
    point: wp.vec3
    v: wp.vec3


@wp.func
def direction_cell(d: wp.vec3):
    """The cell of a CELLS body that a direction falls into."""
    a = wp.vec3(wp.abs(d[0]), wp.abs(d[1]), wp.abs(d[2]))
    axis = int(0)
    if a[1] > a[axis]:
        axis = 1
    if a[2] > a[axis]:
        axis = 2
    scale = 0.5 * float(CELLS_PER_EDGE) / wp.max(a[axis], 1.0e-30)
    u = wp.clamp(int(0.5 * float(CELLS_PER_EDGE) + scale * d[(axis + 1) % 3]), 0, CELLS_PER_EDGE - 1)
    v = wp.clamp(int(0.5 * float(CELLS_PER_EDGE) + scale * d[(axis + 2) % 3]), 0, CELLS_PER_EDGE - 1)
    face = 2 * axis + wp.where(d[axis] < 0.0, 1, 0)
    return (face * CELLS_PER_EDGE + u) * CELLS_PER_EDGE + v


@wp.func
def support(body: Body, points: wp.array(dtype=wp.vec3), d: wp.vec3):
    """The core's farthest point along d, in the body's frame."""
    p = wp.vec3(0.0, 0.0, 0.0)
    if body.kind == HULL or body.kind == CELLS:
        lo = body.start
        count = body.count
        if body.kind == CELLS:
            row = points[body.start + direction_cell(d)]
            lo = body.start + int(row[0])
            count = int(row[1])
        best = float(-1.0e30)
        at = int(lo)
        for i in range(lo, lo + count):
            t = wp.dot(points[i], d)
            if t > best:
                best = t
                at = i
        p = points[at]
    elif body.kind == BOX:
        p = wp.vec3(
            wp.where(d[0] < 0.0, -body.size[0], body.size[0]),
            wp.where(d[1] < 0.0, -body.size[1], body.size[1]),
            wp.where(d[2] < 0.0, -body.size[2], body.size[2]),
        )
    elif body.kind == CAPSULE:
        p = wp.vec3(0.0, 0.0, wp.where(d[2] < 0.0, -body.size[1], body.size[1]))
    elif body.kind == CYLINDER:
        z = wp.where(d[2] < 0.0, -body.size[1], body.size[1])
        r = wp.sqrt(d[0] * d[0] + d[1] * d[1])
        if r > 1.0e-12:
            p = wp.vec3(body.size[0] * d[0] / r, body.size[0] * d[1] / r, z)
        else:
            p = wp.vec3(0.0, 0.0, z)
    return p


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
def _closest_on_segment(s: Simplex):
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
def _closest_on_triangle(s: Simplex):
    """Voronoi regions of a triangle (Ericson, Real-Time Collision Detection, 5.1.5), for the origin."""
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
        r = _closest_on_segment(_keep(s, 0, 1))
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        r = _closest_on_segment(_keep(s, 0, 2))
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        r = _closest_on_segment(_keep(s, 1, 2))
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
            r = _closest_on_segment(_keep(s, 0, 1))
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
def _closest_on_tetrahedron(s: Simplex):
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
            c = _closest_on_triangle(f)
            d = wp.dot(c.v, c.v)
            if d < best:
                best = d
                r = c
                found = 1
    if found == 0:
        r.n = 4
        r.v = wp.vec3(0.0, 0.0, 0.0)
    return r


@wp.func
def gjk(
    a: Body,
    R: wp.mat33,
    p: wp.vec3,
    a_points: wp.array(dtype=wp.vec3),
    b: Body,
    b_points: wp.array(dtype=wp.vec3),
    center_b: wp.vec3,
    needed: float,
    relative_gap: float,
):
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
    s = Simplex()
    s.n = 0
    best = Simplex()
    best.v = v
    best.n = 0
    for _ in range(MAX_ITERATIONS):
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
        if s.n >= 1 and w == s.s0:
            break
        if s.n >= 2 and w == s.s1:
            break
        if s.n >= 3 and w == s.s2:
            break
        if s.n == 0:
            s.s0 = w
            s.a0 = pa
            s.n = 1
            s.w0 = 1.0
            s.v = w
        elif s.n == 1:
            s.s1 = w
            s.a1 = pa
            s.n = 2
            s = _closest_on_segment(s)
        elif s.n == 2:
            s.s2 = w
            s.a2 = pa
            s.n = 3
            s = _closest_on_triangle(s)
        else:
            s.s3 = w
            s.a3 = pa
            s.n = 4
            s = _closest_on_tetrahedron(s)
        if s.n == 4 or wp.dot(s.v, s.v) < 1.0e-14:
            # the origin is inside; unless a separating plane was already found: then rounding has collapsed a thin simplex
            if lower <= ROUNDING_M:
                upper = 0.0
                best = s
                best.v = wp.vec3(0.0, 0.0, 0.0)
            break
        d = wp.length(s.v)
        if d >= upper:
            break  # rounding: the estimate no longer falls
        upper = d
        best = s
        v = s.v
    out = Distance()
    out.lower = lower - radii - ROUNDING_M
    out.upper = upper - radii
    out.v = best.v
    out.point = best.a0
    if best.n == 2:
        out.point = best.w0 * best.a0 + best.w1 * best.a1
    elif best.n == 3:
        out.point = best.w0 * best.a0 + best.w1 * best.a1 + best.w2 * best.a2
    return out


@wp.func
def from_ball(body: Body, x: wp.vec3):
    """The vector from point x to the nearest point of a primitive (not a hull), in its frame; zero inside it."""
    y = wp.vec3(0.0, 0.0, 0.0)
    if body.kind == BOX:
        for k in range(3):
            y[k] = wp.clamp(x[k], -body.size[k], body.size[k])
    elif body.kind == CYLINDER:
        r = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        f = wp.where(r > body.size[0], body.size[0] / r, 1.0)
        y = wp.vec3(f * x[0], f * x[1], wp.clamp(x[2], -body.size[1], body.size[1]))
    else:
        if body.kind == CAPSULE:
            y = wp.vec3(0.0, 0.0, wp.clamp(x[2], -body.size[1], body.size[1]))
        d = wp.length(x - y)
        if d > body.radius:
            y = y + (body.radius / d) * (x - y)
        else:
            y = x
    return y - x


@wp.func
def swept_support(
    body: Body,
    R: wp.mat33,
    p: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    n: wp.vec3,
    w: wp.vec3,
    v: wp.vec3,
    bend: float,
):
    """Lower bound of n . x over a body while it moves by up to +-1 along the velocity field v + w x.

    To first order n . x + s n . (v + w x), which is linear in x and, as a minimum over x, concave in s: the ends
    s = -1, 1 bound it. What is left of the motion is at most bend / 2.
    """
    low = float(1.0e30)
    m = wp.cross(n, w)
    for k in range(2):
        s = float(2 * k - 1)
        u = n + s * m
        x = R * support(body, points, -(wp.transpose(R) * u)) + p
        low = wp.min(low, wp.dot(u, x) - body.radius * wp.length(u) + s * wp.dot(n, v))
    return low - 0.5 * bend - ROUNDING_M
