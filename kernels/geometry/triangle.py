"""The point of a triangle that is nearest to a given one."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


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
