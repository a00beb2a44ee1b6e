"""Triangle surfaces as flat tables with two levels of bounding spheres, in the order of the leaves.

Surface s has nodes surface_first[s] .. surface_first[s + 1] - 1, node n has leaves node_first[n] .. , leaf l has
triangles leaf_first[l] .. , and triangle t has corners points[3 t .. 3 t + 2]. Spheres are (x, y, z, radius).
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.struct
class Surfaces:
    """Surfaces of all objects, each in its object's frame (m)."""

    surface_first: wp.array(dtype=wp.int32)
    node_first: wp.array(dtype=wp.int32)
    leaf_first: wp.array(dtype=wp.int32)
    node_sphere: wp.array(dtype=wp.vec4)
    leaf_sphere: wp.array(dtype=wp.vec4)
    leaf_half: wp.array(dtype=wp.vec3)  # half sides of the leaf's box about the sphere's centre
    points: wp.array(dtype=wp.vec3)
    low: wp.array(dtype=wp.vec3)  # bounding box
    high: wp.array(dtype=wp.vec3)
    group_first: wp.array(dtype=wp.int32)  # surface s has the groups group_first[s] .. of eight nodes
    node_lanes: wp.array(dtype=float)  # the same numbers eight abreast (geometry/lanes.py)
    leaf_lanes: wp.array(dtype=float)
    triangle_lanes: wp.array(dtype=float)


@wp.func
def center(sphere: wp.vec4) -> wp.vec3:
    """A sphere's centre."""
    return wp.vec3(sphere[0], sphere[1], sphere[2])


@wp.func
def inverse_pose(T: wp.mat44):
    """R, p of the inverse of a rigid transform."""
    R = wp.mat33(T[0, 0], T[1, 0], T[2, 0], T[0, 1], T[1, 1], T[2, 1], T[0, 2], T[1, 2], T[2, 2])
    return R, -(R * wp.vec3(T[0, 3], T[1, 3], T[2, 3]))


@wp.func(inline=False)
def line_hit(a: wp.vec3, b: wp.vec3, c: wp.vec3, x: float, z: float):
    """Signed crossings (-1, 0, 1) of triangle abc and the line (x, ., z) along y, and the y where it crosses.

    An edge shared by two triangles gives both the same numbers (its ends are ordered by z), so a closed surface is
    counted right even when the line runs through an edge or a corner.
    """
    winding = int(0)
    x_left = float(0.0)
    y_left = float(0.0)
    x_right = float(0.0)
    y_right = float(0.0)
    found = int(0)
    # two of the three edges cross the height z (or none): the line is inside the triangle when x lies between their crossings
    for i in range(3):
        p = a
        q = b
        if i == 1:
            p = b
            q = c
        elif i == 2:
            p = c
            q = a
        up = int(1)
        if p[2] > q[2]:
            up = -1
            swap = p
            p = q
            q = swap
        if p[2] <= z and q[2] > z:
            f = (z - p[2]) / (q[2] - p[2])
            x_cross = p[0] + f * (q[0] - p[0])
            y_cross = p[1] + f * (q[1] - p[1])
            # only edges to the right count, with their direction: two of them cancel, one alone means inside
            if x_cross > x:
                winding += up
                x_right = x_cross
                y_right = y_cross
            else:
                x_left = x_cross
                y_left = y_cross
            found += 1
    y = float(0.0)
    if winding != 0:
        # y between the two crossings, linear in x
        span = x_right - x_left
        f = float(0.0)
        if span > 0.0:
            f = wp.clamp((x - x_left) / span, 0.0, 1.0)
        y = y_left + f * (y_right - y_left)
    return winding, y
