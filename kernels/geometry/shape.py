"""Shapes of convex bodies: a core (point, segment, cylinder, box, point set) grown by a radius, and their support functions."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

SPHERE = wp.constant(0)
CAPSULE = wp.constant(1)
CYLINDER = wp.constant(2)
BOX = wp.constant(3)
HULL = wp.constant(4)
CELLS = wp.constant(5)
BLOCKS = wp.constant(6)

CELLS_PER_EDGE = wp.constant(6)
"""A CELLS shape is a hull whose points are sorted by direction: 6 x 6 cells on each face of a cube around the origin. Its
first 216 rows in `points` give, for each cell, where its points start (counted from the shape's first row) and how many
they are; only those can be farthest in a direction of that cell (r2h_batch.scene.bounds.support_cells). They are stored in
blocks."""

BLOCK_POINTS = wp.constant(16)
"""Points in blocks are stored 16 at a time, their 16 x, then their 16 y and 16 z, in 16 rows of `points`; the last block is
filled up with its last point. A CPU looks at all of a block at once (scene/bounds.py, point_blocks). A BLOCKS shape is a hull
whose points are stored so."""

ROUNDING_M = wp.constant(1.0e-6)


@wp.struct
class Shape:
    """The shape of a convex body, in the body's frame: sizes as MuJoCo's (capsule and cylinder along z: radius, half length).

    A robot's BLOCKS shape: radius and half length of a cylinder that holds it, radius of the ball about the origin in it.
    """

    kind: int
    size: wp.vec3
    # HULL: its points are points[start : start + count]; BLOCKS: `count` blocks from that row on, or, below 0, from row
    # -1 - start of a batch's own points (robot/world.py, `points_of`)
    start: int
    count: int
    radius: float  # grown by this (capsules: theirs)


@wp.func
def triangle_shape(start: int):
    """A triangle, points[start : start + 3]."""
    shape = Shape()
    shape.kind = HULL
    shape.start = start
    shape.count = 3
    return shape


@wp.func_native("return r2h::farthest_in_blocks(points.data + start, count, d);")
def farthest_in_blocks(points: wp.array(dtype=wp.vec3), start: int, count: int, d: wp.vec3) -> wp.vec3:
    """The point farthest along d of `count` points in blocks of 16, from row `start` on; the first one of several."""
    ...


@wp.func_native("return r2h::direction_cell(d);")
def direction_cell(d: wp.vec3) -> int:
    """The cell of a CELLS shape that a direction falls into."""
    ...


@wp.func(inline=False)
def support(shape: Shape, points: wp.array(dtype=wp.vec3), d: wp.vec3):
    """The core's farthest point along d, in the body's frame."""
    p = wp.vec3(0.0, 0.0, 0.0)
    if shape.kind == CELLS:
        # only this cell's points can be farthest along d
        row = points[shape.start + direction_cell(d)]
        p = farthest_in_blocks(points, shape.start + int(row[0]), int(row[1]), d)
    elif shape.kind == BLOCKS:
        p = farthest_in_blocks(points, wp.max(shape.start, -1 - shape.start), BLOCK_POINTS * shape.count, d)
    elif shape.kind == HULL:
        best = float(-1.0e30)
        at = int(shape.start)
        for i in range(shape.start, shape.start + shape.count):
            t = wp.dot(points[i], d)
            if t > best:
                best = t
                at = i
        p = points[at]
    elif shape.kind == BOX:
        p = wp.vec3(
            wp.where(d[0] < 0.0, -shape.size[0], shape.size[0]),
            wp.where(d[1] < 0.0, -shape.size[1], shape.size[1]),
            wp.where(d[2] < 0.0, -shape.size[2], shape.size[2]),
        )
    elif shape.kind == CAPSULE:
        p = wp.vec3(0.0, 0.0, wp.where(d[2] < 0.0, -shape.size[1], shape.size[1]))
    elif shape.kind == CYLINDER:
        z = wp.where(d[2] < 0.0, -shape.size[1], shape.size[1])
        r = wp.sqrt(d[0] * d[0] + d[1] * d[1])
        if r > 1.0e-12:
            p = wp.vec3(shape.size[0] * d[0] / r, shape.size[0] * d[1] / r, z)
        else:
            p = wp.vec3(0.0, 0.0, z)
    return p


@wp.func(inline=False)
def from_ball(shape: Shape, x: wp.vec3):
    """The vector from point x to the nearest point of a primitive, in its frame; zero inside it. Of a robot's hull: to the
    cylinder that holds it, so no longer than to the hull."""
    y = wp.vec3(0.0, 0.0, 0.0)
    if shape.kind == BOX:
        for k in range(3):
            y[k] = wp.clamp(x[k], -shape.size[k], shape.size[k])
    elif shape.kind == CYLINDER or shape.kind == BLOCKS:
        r = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        f = wp.where(r > shape.size[0], shape.size[0] / r, 1.0)
        y = wp.vec3(f * x[0], f * x[1], wp.clamp(x[2], -shape.size[1], shape.size[1]))
    else:
        if shape.kind == CAPSULE:
            y = wp.vec3(0.0, 0.0, wp.clamp(x[2], -shape.size[1], shape.size[1]))
        d = wp.length(x - y)
        if d > shape.radius:
            y = y + (shape.radius / d) * (x - y)
        else:
            y = x
    return y - x


@wp.func(inline=False)
def swept_support(
    shape: Shape, R: wp.mat33, p: wp.vec3, points: wp.array(dtype=wp.vec3), n: wp.vec3, w: wp.vec3, v: wp.vec3,
    g: wp.vec3, c: float, second: float, third: float,
):  # fmt: skip
    """Lower bound of n . x over a body that moves by up to +-1 with the twist (w, v).

    To first order n . x + s n . (v + w x), linear in x and, as a minimum over x, concave in s. The rest is at most
    s^2 / 2 `second`, a bound on any point's acceleration. Or, as along n a point accelerates by c + g . x in the middle, it is
    at most s^2 / 2 times the least of that (above 0: 0) and |s|^3 / 6 `third`. The ends s = -1, 1 bound all of it.
    """
    rest = 0.5 * second
    if third < 3.0 * second:
        x = R * support(shape, points, -(wp.transpose(R) * g)) + p
        least = c + wp.dot(g, x) - shape.radius * wp.length(g)
        rest = wp.min(rest, third / 6.0 - 0.5 * wp.min(least, 0.0))
    low = float(1.0e30)
    # n . (w x x) = (n x w) . x: it takes the moving body's support along n +- n x w
    m = wp.cross(n, w)
    for k in range(2):
        s = float(2 * k - 1)
        u = n + s * m
        x = R * support(shape, points, -(wp.transpose(R) * u)) + p
        low = wp.min(low, wp.dot(u, x) - shape.radius * wp.length(u) + s * wp.dot(n, v))
    return low - rest - ROUNDING_M
