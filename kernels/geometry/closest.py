"""Closest points of points, segments, triangles and primitives, and a capsule in motion.

Primitives have MuJoCo's sizes, each in its own frame: sphere (radius), capsule and cylinder (radius, half length along z), box
(half sides)."""

import warp as wp

from r2h_batch.kernels.geometry.shape import BLOCKS, BOX, CAPSULE, CYLINDER, ROUNDING_M, SPHERE, Shape
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
    """Lower bound of n . x over a capsule that moves: `swept_support` (shape.py) says how."""
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


@wp.func(inline=False)
def closest_on_triangle(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The triangle's point nearest to x (Ericson, Real-Time Collision Detection, 5.1.5).

    The plane is cut into the Voronoi regions of the three corners, the three edges and the inside. d1 .. d6 place x along
    ab and ac as seen from each corner; va : vb : vc are its barycentric weights, and an edge's is the nearest feature
    where the opposite corner's weight is not above 0 and x projects between the edge's ends.
    """
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, x - a)
    d2 = wp.dot(ac, x - a)
    d3 = wp.dot(ab, x - b)
    d4 = wp.dot(ac, x - b)
    d5 = wp.dot(ab, x - c)
    d6 = wp.dot(ac, x - c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    y = a
    if d1 <= 0.0 and d2 <= 0.0:
        y = a
    elif d3 >= 0.0 and d4 <= d3:
        y = b
    elif d6 >= 0.0 and d5 <= d6:
        y = c
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        y = a + (d1 / (d1 - d3)) * ab
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        y = a + (d2 / (d2 - d6)) * ac
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        y = b + ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b)
    else:
        total = va + vb + vc
        if total > 0.0:
            y = a + (vb / total) * ab + (vc / total) * ac
    return y


TOUCH_M = wp.constant(1.0e-6)
"""Bodies nearer than this count as touching: GJK's rounding allowance."""


@wp.func
def signed_distance(kind: int, size: wp.vec3, x: wp.vec3) -> float:
    """Distance of point x to the primitive in its frame, minus the depth when inside. Of a robot's hull: no more than that."""
    d = wp.length(x) - size[0]
    if kind == BOX:
        # q: signed distances to the three pairs of faces. Outside, those above 0 are the legs of the way to the box;
        # inside, the largest (least negative) is minus the depth.
        q = wp.vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        outside = wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0))
        d = wp.length(outside) + wp.min(wp.max(q[0], wp.max(q[1], q[2])), 0.0)
    elif kind == CYLINDER or kind == BLOCKS:  # noqa: SIM109 (Warp); the same in the plane of (distance from the axis, height)
        r = wp.sqrt(x[0] * x[0] + x[1] * x[1]) - size[0]
        z = wp.abs(x[2]) - size[1]
        u = wp.max(r, 0.0)
        v = wp.max(z, 0.0)
        d = wp.sqrt(u * u + v * v) + wp.min(wp.max(r, z), 0.0)
    elif kind == CAPSULE:
        d = wp.length(wp.vec3(x[0], x[1], wp.max(wp.abs(x[2]) - size[1], 0.0))) - size[0]
    return d


@wp.func
def inner_radius(kind: int, size: wp.vec3) -> float:
    """Radius of the ball about the middle that a shape holds: no point of it is deeper (in a hull: some may be)."""
    r = size[0]
    if kind == BOX:
        r = wp.min(size[0], wp.min(size[1], size[2]))
    elif kind == CYLINDER:
        r = wp.min(size[0], size[1])
    elif kind == BLOCKS:
        r = size[2]
    return r


@wp.func
def eroded(kind: int, size: wp.vec3, depth: float) -> Shape:
    """The primitive's points at least `depth` deep, as a GJK body (capsule, sphere: their axis, grown by the rest)."""
    shape = Shape()
    shape.kind = kind
    shape.size = size
    if kind == BOX:
        shape.size = wp.vec3(wp.max(size[0] - depth, 0.0), wp.max(size[1] - depth, 0.0), wp.max(size[2] - depth, 0.0))
    elif kind == CYLINDER:
        shape.size = wp.vec3(wp.max(size[0] - depth, 0.0), wp.max(size[1] - depth, 0.0), 0.0)
    elif kind == BLOCKS:  # the ball in it stands for the hull
        shape.kind = SPHERE
        shape.radius = wp.max(size[2] - depth, 0.0)
    else:
        shape.radius = wp.max(size[0] - depth, 0.0)
    return shape


@wp.func
def rounded(kind: int, size: wp.vec3) -> Shape:
    """All balls of the inner radius that the primitive holds: its deepest points, grown by their depth.

    Capsules and spheres are such bodies already; boxes and cylinders lose their edges. Erosion by t, then growth by t
    (an opening by a ball). Inside, the GJK distance to the core less t measures how deep two bodies meet.
    """
    t = inner_radius(kind, size)
    shape = eroded(kind, size, t)
    shape.radius = t
    return shape


@wp.func
def inscribed(shape: Shape) -> Shape:
    """A primitive in a robot's body, no nearer to anything than that: itself, or the ball in a hull."""
    out = shape
    if shape.kind == BLOCKS:
        out = rounded(shape.kind, shape.size)
    return out
