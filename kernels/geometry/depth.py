"""Penetration depth of two convex bodies, from below: a polytope inside their Minkowski difference that grows to its surface.

Bodies a and b overlap where the origin is in D = {x - y: x in a, y in b}, and the shortest translation that parts them is as
long as the origin is deep in D. The hull of points of D lies in D, so the origin is at least as deep in D as in that hull:
the least distance to its faces is a bound from below. Where n is the normal of the nearest face, the farthest point of D along n
says how deep the origin is at most. That point joins the hull until both agree (the expanding polytope of van den Bergen 2001;
here in float64, and a hull that does not hold the origin yet grows in the same way).
"""

import warp as wp

from r2h_batch.kernels.geometry.shape import ROUNDING_M, Shape, support
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"max_unroll": 0})

POINTS = wp.constant(64)
FACES = wp.constant(124)
"""A closed surface of triangles with 64 corners has 2 * 64 - 4 of them."""
GAP = wp.constant(0.01)
"""The bound may be this part of the depth, and 1e-6 m, too small."""
FLAT_M = wp.constant(1.0e-7)


@wp.struct
class Polytope:
    """How many corners, faces and open edges there are; whether it is whole."""

    points: int
    faces: int
    edges: int
    whole: int


@wp.func
def _farthest(
    a: Shape, R: wp.mat33, p: wp.vec3, a_points: wp.array(dtype=wp.vec3), b: Shape,
    b_points: wp.array(dtype=wp.vec3), d: wp.vec3d,
) -> wp.vec3d:  # fmt: skip
    """The point of the difference that is farthest along d."""
    n = wp.vec3(d)
    x = R * support(a, a_points, wp.transpose(R) * n) + p - support(b, b_points, -n)
    return wp.vec3d(x)


@wp.func
def _add_face(
    size: Polytope, i: int, j: int, k: int, x: wp.array(dtype=wp.vec3d), corner: wp.array(dtype=wp.vec3i),
    normal: wp.array(dtype=wp.vec3d), height: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Adds the face ijk, counter-clockwise from outside; without room or area the polytope is no longer whole."""
    out = size
    n = wp.cross(x[j] - x[i], x[k] - x[i])
    area = wp.length(n)
    if out.faces >= FACES or area < wp.float64(1.0e-16):
        out.whole = 0
    else:
        n = n / area
        corner[out.faces] = wp.vec3i(i, j, k)
        normal[out.faces] = n
        height[out.faces] = wp.dot(n, x[i])
        out.faces += 1
    return out


@wp.func
def _open_edge(size: Polytope, i: int, j: int, edge: wp.array(dtype=wp.vec2i)):
    """Notes the edge from i to j of a face that was taken out; one between two such faces is forgotten."""
    out = size
    at = int(-1)
    for k in range(out.edges):
        if edge[k][0] == j and edge[k][1] == i:
            at = k
    if at >= 0:
        out.edges -= 1
        edge[at] = edge[out.edges]
    elif out.edges < FACES:
        edge[out.edges] = wp.vec2i(i, j)
        out.edges += 1
    else:
        out.whole = 0
    return out


@wp.func
def core_depth(
    a: Shape, R: wp.mat33, p: wp.vec3, a_points: wp.array(dtype=wp.vec3), b: Shape,
    b_points: wp.array(dtype=wp.vec3),
) -> float:  # fmt: skip
    """A lower bound of the penetration depth (m) of the cores of a at (R, p) and b, both in b's frame; 0 where none is known.

    Within 1 % of the depth unless 64 corners do not do. Flat differences (of two segments) have no depth.
    """
    x = wp.zeros(shape=POINTS, dtype=wp.vec3d)
    corner = wp.zeros(shape=FACES, dtype=wp.vec3i)
    normal = wp.zeros(shape=FACES, dtype=wp.vec3d)
    height = wp.zeros(shape=FACES, dtype=wp.float64)
    edge = wp.zeros(shape=FACES, dtype=wp.vec2i)
    size = Polytope()
    size.whole = 1
    # a tetrahedron: each corner as far as it goes from the point, line and plane of those before, to one side or the other
    d = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    away = d
    for k in range(4):
        if k == 2:
            u = x[1] - x[0]
            away = wp.vec3d(wp.float64(0.0), -u[2], u[1])
            if wp.abs(u[0]) < wp.abs(u[1]) or wp.abs(u[0]) < wp.abs(u[2]):
                away = wp.vec3d(-u[2], wp.float64(0.0), u[0])
            if wp.length(wp.cross(u, away)) < wp.float64(1.0e-14):
                away = wp.vec3d(u[1], -u[0], wp.float64(0.0))
        elif k == 3:
            away = wp.cross(x[1] - x[0], x[2] - x[0])
        found = float(0.0)
        for side in range(4):
            if wp.length(away) > wp.float64(1.0e-16) and found < FLAT_M:
                d = away / wp.length(away)
                if side % 2 == 1:
                    d = -d
                if side == 2 and k == 2:  # the other direction square to the line
                    away = wp.cross(x[1] - x[0], d)
                    d = away / wp.length(away)
                x[k] = _farthest(a, R, p, a_points, b, b_points, d)
                found = float(wp.where(k == 0, wp.float64(1.0), wp.abs(wp.dot(d, x[k] - x[0]))))
        if found < FLAT_M:
            return 0.0
    size.points = 4
    if wp.dot(wp.cross(x[1] - x[0], x[2] - x[0]), x[3] - x[0]) > wp.float64(0.0):
        swap = x[1]
        x[1] = x[2]
        x[2] = swap
    size = _add_face(size, 0, 1, 2, x, corner, normal, height)
    size = _add_face(size, 0, 3, 1, x, corner, normal, height)
    size = _add_face(size, 1, 3, 2, x, corner, normal, height)
    size = _add_face(size, 2, 3, 0, x, corner, normal, height)
    lower = float(0.0)
    running = size.whole == 1
    while running:
        nearest = int(0)
        for k in range(size.faces):
            if height[k] < height[nearest]:
                nearest = k
        lower = wp.max(lower, float(height[nearest]))
        w = _farthest(a, R, p, a_points, b, b_points, normal[nearest])
        upper = float(wp.dot(normal[nearest], w))
        running = upper > 0.0 and upper - lower > GAP * upper + 1.0e-6 and size.points < POINTS
        if running:
            # w joins: the faces that see it go, and their rim gets faces to it
            size.edges = 0
            for back in range(size.faces):
                k = size.faces - 1 - back
                if wp.dot(normal[k], w) - height[k] > wp.float64(1.0e-12):
                    c = corner[k]
                    for e in range(3):
                        size = _open_edge(size, c[e], c[(e + 1) % 3], edge)
                    height[k] = wp.float64(wp.inf)
            kept = int(0)
            for k in range(size.faces):
                if height[k] < wp.float64(1.0e30):
                    corner[kept] = corner[k]
                    normal[kept] = normal[k]
                    height[kept] = height[k]
                    kept += 1
            size.faces = kept
            x[size.points] = w
            for k in range(size.edges):
                size = _add_face(size, edge[k][0], edge[k][1], size.points, x, corner, normal, height)
            size.points += 1
            running = size.whole == 1 and size.edges > 0
    return wp.max(lower - ROUNDING_M, 0.0)
