"""Least signed distance of one triangle's points to a gripper primitive, or to any other primitive.

The signed distance of a point to a primitive is its distance outside and minus its depth (distance to the nearest face)
inside.
"""

import warp as wp

from r2h_batch.kernels.geometry.closest import TOUCH_M, eroded, inner_radius, signed_distance
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.shape import BOX, CAPSULE, CYLINDER, SPHERE, Shape, triangle_shape
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

DEPTH_M = wp.constant(5.0e-6)
GJK_M = wp.constant(1.0e-5)
"""GJK's result may be this much below the distance: a triangle that is farther than `best` and this cannot lower it."""


@wp.func
def bounding_half(kind: int, size: wp.vec3) -> wp.vec3:
    """Half sides of the box about a primitive, in its frame."""
    half = size
    if kind == CAPSULE:
        half = wp.vec3(size[0], size[0], size[1] + size[0])
    elif kind == SPHERE:
        half = wp.vec3(size[0], size[0], size[0])
    elif kind != BOX:
        half = wp.vec3(size[0], size[0], size[1])
    return half


@wp.func
def apart(kind: int, size: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """A lower bound of the distance between a primitive and what lies in the box [low, high], both in its frame."""
    half = bounding_half(kind, size)
    a = wp.max(low - half, -half - high)
    return wp.length(wp.max(a, wp.vec3(0.0, 0.0, 0.0)))


@wp.func
def _parted(b: Shape, x: wp.vec3, u: wp.vec3, v: wp.vec3, w: wp.vec3, distance: float) -> bool:
    """Whether a plane, square to the way from a primitive to the point x, keeps triangle uvw `distance` or more away from it.

    With h(g) the primitive's support along g, no point of the triangle is nearer than (min g . (u, v, w) - h(g)) / |g|.
    """
    g = x
    extent = float(0.0)
    if b.kind == BOX:
        g = x - wp.max(wp.min(x, b.size), -b.size)
        extent = wp.abs(g[0]) * b.size[0] + wp.abs(g[1]) * b.size[1] + wp.abs(g[2]) * b.size[2]
    elif b.kind == CAPSULE:
        g = wp.vec3(x[0], x[1], x[2] - wp.clamp(x[2], -b.size[1], b.size[1]))
        extent = wp.abs(g[2]) * b.size[1]
    elif b.kind == CYLINDER:
        r = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        f = wp.where(r > b.size[0], 1.0 - b.size[0] / r, 0.0)
        g = wp.vec3(f * x[0], f * x[1], x[2] - wp.clamp(x[2], -b.size[1], b.size[1]))
        extent = wp.sqrt(g[0] * g[0] + g[1] * g[1]) * b.size[0] + wp.abs(g[2]) * b.size[1]
    n = wp.length(g)
    return n > 0.0 and wp.min(wp.dot(g, u), wp.min(wp.dot(g, v), wp.dot(g, w))) - extent >= (distance + b.radius) * n


@wp.func
def triangle_clearance(
    points: wp.array(dtype=wp.vec3), tri: int, kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3, best: float
) -> float:
    """Least signed distance of a triangle's points to a primitive, or something >= best if it is not below `best`.

    R, p take the triangle to the primitive's frame. Apart, the distance is GJK's. Where they meet, the triangle is at least
    d deep exactly when it meets the primitive eroded by d: bisection on d between what is known and what can be.
    """
    u = R * points[3 * tri] + p
    v = R * points[3 * tri + 1] + p
    w = R * points[3 * tri + 2] + p
    # a ball about the triangle decides most
    middle = (u + v + w) / 3.0
    r = wp.sqrt(wp.max(wp.length_sq(u - middle), wp.max(wp.length_sq(v - middle), wp.length_sq(w - middle))))
    least = signed_distance(kind, size, middle) - r  # no point of the triangle is nearer
    clearance = float(least)
    if least < best:
        # a box about it, of what is left
        if apart(kind, size, wp.min(u, wp.min(v, w)), wp.max(u, wp.max(v, w))) >= wp.max(best, 0.0) + GJK_M:
            return best
        # its corners are points of it too
        clearance = wp.min(
            wp.min(best, signed_distance(kind, size, u)),
            wp.min(signed_distance(kind, size, v), signed_distance(kind, size, w)),
        )
        depth = wp.max(-clearance, 0.0)
        probe = wp.where(depth > 0.0, depth + DEPTH_M, 0.0)  # known to be `depth` deep: is it any deeper?
        high = wp.min(inner_radius(kind, size), -least)
        if probe > 0.0 and probe >= high:
            return clearance
        b = eroded(kind, size, probe)
        if _parted(b, middle, u, v, w, wp.max(clearance, 0.0) + GJK_M):
            return clearance
        a = triangle_shape(3 * tri)
        d = gjk(a, R, p, points, b, points, p - middle, wp.max(clearance, 0.0), 0.0)
        if d.upper > TOUCH_M:
            if probe == 0.0:
                clearance = wp.min(clearance, d.lower)
        else:
            low = float(probe)
            while high - low > DEPTH_M:
                half = 0.5 * (low + high)
                d = gjk(a, R, p, points, eroded(kind, size, half), points, p - middle, 0.0, 0.0)
                if d.upper <= TOUCH_M:
                    low = half
                else:
                    high = half
            clearance = -low
    return clearance
