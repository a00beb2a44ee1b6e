"""Spheres, capsules, cylinders and boxes seen from inside: signed distance, inner radius, what erosion leaves of them.

Sizes as MuJoCo's, each in its own frame: sphere (radius), capsule and cylinder (radius, half length along z), box (half
sides). The depth of a point is its distance to the nearest face, so at depth d it can be moved out by d and no less.
"""

import warp as wp

from r2h_batch.kernels.geometry.body import BOX, CAPSULE, CYLINDER, Body
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

TOUCH_M = wp.constant(1.0e-6)
"""Bodies nearer than this count as touching: GJK's rounding allowance."""


@wp.func
def signed_distance(kind: int, size: wp.vec3, x: wp.vec3) -> float:
    """Distance of point x to the primitive in its frame, minus the depth when inside."""
    d = wp.length(x) - size[0]
    if kind == BOX:
        # q: signed distances to the three pairs of faces. Outside, those above 0 are the legs of the way to the box;
        # inside, the largest (least negative) is minus the depth.
        q = wp.vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        outside = wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0))
        d = wp.length(outside) + wp.min(wp.max(q[0], wp.max(q[1], q[2])), 0.0)
    elif kind == CYLINDER:  # the same in the plane of (distance from the axis, height)
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
    """Radius of the ball about the primitive's middle that it holds: no point of it is deeper."""
    r = size[0]
    if kind == BOX:
        r = wp.min(size[0], wp.min(size[1], size[2]))
    elif kind == CYLINDER:
        r = wp.min(size[0], size[1])
    return r


@wp.func
def eroded(kind: int, size: wp.vec3, depth: float) -> Body:
    """The primitive's points at least `depth` deep, as a GJK body (capsule, sphere: their axis, grown by the rest)."""
    body = Body()
    body.kind = kind
    body.size = size
    if kind == BOX:
        body.size = wp.vec3(wp.max(size[0] - depth, 0.0), wp.max(size[1] - depth, 0.0), wp.max(size[2] - depth, 0.0))
    elif kind == CYLINDER:
        body.size = wp.vec3(wp.max(size[0] - depth, 0.0), wp.max(size[1] - depth, 0.0), 0.0)
    else:
        body.radius = wp.max(size[0] - depth, 0.0)
    return body


@wp.func
def rounded(kind: int, size: wp.vec3) -> Body:
    """All balls of the inner radius that the primitive holds: its deepest points, grown by their depth.

    Capsules and spheres are such bodies already; boxes and cylinders lose their edges. Erosion by t, then growth by t
    (an opening by a ball). Inside, the GJK distance to the core less t measures how deep two bodies meet.
    """
    t = inner_radius(kind, size)
    body = eroded(kind, size, t)
    body.radius = t
    return body
