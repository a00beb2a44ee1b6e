"""Convex bodies: a core (point, segment, cylinder, box, point set) grown by a radius, and their support functions."""

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
"""A CELLS body is a hull whose points are sorted by direction: 6 x 6 cells on each face of a cube around the origin. Its
first 216 rows in `points` give, for each cell, where its points start (counted from the body's first row) and how many
they are; only those can be farthest in a direction of that cell (r2h_batch.bodies.bounds.support_cells)."""

BLOCK_POINTS = wp.constant(16)
"""A BLOCKS body is a hull whose points are stored 16 at a time, their 16 x, then their 16 y and 16 z, in 16 rows of `points`;
the last block is filled up with a point that it has. A CPU looks at all of a block at once (bodies/bounds.py, point_blocks)."""

ROUNDING_M = wp.constant(1.0e-6)


@wp.struct
class Body:
    """A convex body in its own frame: sizes as MuJoCo's (capsule and cylinder along z: radius, half length)."""

    kind: int
    size: wp.vec3
    start: int  # HULL: its points are points[start : start + count]; BLOCKS: `count` blocks from that row on
    count: int
    radius: float  # grown by this (capsules: theirs)


@wp.func(inline=False)
def direction_cell(d: wp.vec3):
    """The cell of a CELLS body that a direction falls into."""
    # the cube's face is that of d's largest coordinate; u, v: the other two, each cut into CELLS_PER_EDGE
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


# The largest product of each of 16 lanes, then of all; of equal ones the first point, as a loop over the points would have it.
# Written in C++ because Warp has no array that a compiler could keep in vector registers: as a loop over vec3 the same cost
# five times as much, and it was a tenth of all of a trial. Each product and sum is a statement of its own, so that nothing is
# contracted.
@wp.func_native("""
    const float* rows = &points.data[start].c[0];
    float best[16];
    int at[16];
    for (int k = 0; k < 16; ++k) {
        best[k] = -1.0e30f;
        at[k] = k;
    }
    for (int block = 0; block < count; ++block) {
        const float* x = rows + 48 * block;
        for (int k = 0; k < 16; ++k) {
            float tx = x[k] * d.c[0];
            float ty = x[16 + k] * d.c[1];
            float tz = x[32 + k] * d.c[2];
            float t = tx + ty;
            t = t + tz;
            int farther = t > best[k];
            at[k] = farther ? 16 * block + k : at[k];
            best[k] = farther ? t : best[k];
        }
    }
    for (int half = 8; half > 0; half >>= 1)
        for (int k = 0; k < half; ++k) {
            int farther = (best[k + half] > best[k]) | ((best[k + half] == best[k]) & (at[k + half] < at[k]));
            at[k] = farther ? at[k + half] : at[k];
            best[k] = farther ? best[k + half] : best[k];
        }
    const float* p = rows + 48 * (at[0] / 16) + at[0] % 16;
    return wp::vec3(p[0], p[16], p[32]);
""")
def farthest_in_blocks(points: wp.array(dtype=wp.vec3), start: int, count: int, d: wp.vec3) -> wp.vec3:
    """The point of a BLOCKS body that is farthest along d."""
    ...


@wp.func(inline=False)
def support(body: Body, points: wp.array(dtype=wp.vec3), d: wp.vec3):
    """The core's farthest point along d, in the body's frame."""
    p = wp.vec3(0.0, 0.0, 0.0)
    if body.kind == HULL or body.kind == CELLS:
        lo = body.start
        count = body.count
        if body.kind == CELLS:
            # only this cell's points can be farthest along d
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
    elif body.kind == BLOCKS:
        p = farthest_in_blocks(points, body.start, body.count, d)
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


@wp.func(inline=False)
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


@wp.func(inline=False)
def swept_support(
    body: Body,
    R: wp.mat33,
    p: wp.vec3,
    points: wp.array(dtype=wp.vec3),
    n: wp.vec3,
    w: wp.vec3,
    v: wp.vec3,
    g: wp.vec3,
    c: float,
    second: float,
    third: float,
):
    """Lower bound of n . x over a body that moves by up to +-1 with the twist (w, v).

    To first order n . x + s n . (v + w x), linear in x and, as a minimum over x, concave in s. The rest is at most
    s^2 / 2 `second`, a bound on any point's acceleration. Or, as along n a point accelerates by c + g . x in the middle, it is
    at most s^2 / 2 times the least of that (above 0: 0) and |s|^3 / 6 `third`. The ends s = -1, 1 bound all of it.
    """
    rest = 0.5 * second
    if third < 3.0 * second:
        x = R * support(body, points, -(wp.transpose(R) * g)) + p
        least = c + wp.dot(g, x) - body.radius * wp.length(g)
        rest = wp.min(rest, third / 6.0 - 0.5 * wp.min(least, 0.0))
    low = float(1.0e30)
    # n . (w x x) = (n x w) . x: the moving body is asked for its support along n +- n x w
    m = wp.cross(n, w)
    for k in range(2):
        s = float(2 * k - 1)
        u = n + s * m
        x = R * support(body, points, -(wp.transpose(R) * u)) + p
        low = wp.min(low, wp.dot(u, x) - body.radius * wp.length(u) + s * wp.dot(n, v))
    return low - rest - ROUNDING_M
