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
they are; only those can be farthest in a direction of that cell (r2h_batch.bodies.bounds.support_cells). They are stored in
blocks."""

BLOCK_POINTS = wp.constant(16)
"""Points in blocks are stored 16 at a time, their 16 x, then their 16 y and 16 z, in 16 rows of `points`; the last block is
filled up with its last point. A CPU looks at all of a block at once (bodies/bounds.py, point_blocks). A BLOCKS body is a hull
whose points are stored so."""

ROUNDING_M = wp.constant(1.0e-6)


@wp.struct
class Body:
    """A convex body in its own frame: sizes as MuJoCo's (capsule and cylinder along z: radius, half length)."""

    kind: int
    size: wp.vec3
    start: int  # HULL: its points are points[start : start + count]; BLOCKS: `count` blocks from that row on
    count: int
    radius: float  # grown by this (capsules: theirs)


# The largest product of each of 16 lanes, then of all; of equal ones the first point, as a loop over the points would have it.
# Written in C++ because Warp has no array that a compiler could keep in vector registers: as a loop over vec3 the same cost
# five times as much, and it was a tenth of all of a trial. On a CPU the lanes are clang's vectors (Warp compiles with nothing
# else): of loops over arrays it makes vectors in the middle, but not where 16 lanes become one, which took twice as long as
# all the products. CUDA takes few points one after the other. Each product and sum is a statement of its own, so that nothing
# is contracted.
@wp.func_native("""
    const float* rows = &points.data[start].c[0];
    int blocks = (count + 15) / 16;
#if defined(__CUDA_ARCH__)
    float best[16];
    int at[16];
    for (int k = 0; k < 16; ++k) {
        best[k] = -1.0e30f;
        at[k] = k;
    }
    if (count <= 16) {
        #pragma unroll 1
        for (int k = 0; k < count; ++k) {
            float tx = rows[k] * d.c[0];
            float ty = rows[16 + k] * d.c[1];
            float tz = rows[32 + k] * d.c[2];
            float t = tx + ty;
            t = t + tz;
            int farther = t > best[0];
            at[0] = farther ? k : at[0];
            best[0] = farther ? t : best[0];
        }
        blocks = 0;
    }
    for (int block = 0; block < blocks; ++block) {
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
    int first = at[0];
#else
    typedef float floats __attribute__((ext_vector_type(16)));
    typedef int ints __attribute__((ext_vector_type(16)));
    const ints lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    floats best = (floats)(-1.0e30f);
    ints at = lane;
    for (int block = 0; block < blocks; ++block) {
        floats x, y, z;
        __builtin_memcpy(&x, rows + 48 * block, sizeof(x));
        __builtin_memcpy(&y, rows + 48 * block + 16, sizeof(y));
        __builtin_memcpy(&z, rows + 48 * block + 32, sizeof(z));
        floats tx = x * d.c[0];
        floats ty = y * d.c[1];
        floats tz = z * d.c[2];
        floats t = tx + ty;
        t = t + tz;
        ints farther = t > best;
        at = farther ? lane + 16 * block : at;
        best = farther ? t : best;
    }
    auto of8 = best.hi > best.lo ? best.hi : best.lo;
    auto of4 = of8.hi > of8.lo ? of8.hi : of8.lo;
    auto of2 = of4.hi > of4.lo ? of4.hi : of4.lo;
    float most = of2.y > of2.x ? of2.y : of2.x;
    int first = __builtin_reduce_min(best == most ? at : (ints)(1 << 30));
#endif
    const float* p = rows + 48 * (first / 16) + first % 16;
    return wp::vec3(p[0], p[16], p[32]);
""")
def farthest_in_blocks(points: wp.array(dtype=wp.vec3), start: int, count: int, d: wp.vec3) -> wp.vec3:
    """Of `count` points in blocks of 16 from row `start` on the one that is farthest along d.

    On a CPU what fills up the last block is looked at too: it repeats a point that comes before.
    """
    ...


# The cell: the cube's face is that of d's largest coordinate; u, v: the other two, each cut into CELLS_PER_EDGE.
@wp.func_native("""
    float ax = fabsf(d.c[0]), ay = fabsf(d.c[1]), az = fabsf(d.c[2]);
    int axis = ay > ax ? 1 : 0;
    float most = ay > ax ? ay : ax;
    axis = az > most ? 2 : axis;
    most = az > most ? az : most;
    float scale = 3.0f / (most > 1.0e-30f ? most : 1.0e-30f);
    float to = axis == 0 ? d.c[0] : (axis == 1 ? d.c[1] : d.c[2]);
    float along_u = scale * (axis == 0 ? d.c[1] : (axis == 1 ? d.c[2] : d.c[0]));
    float along_v = scale * (axis == 0 ? d.c[2] : (axis == 1 ? d.c[0] : d.c[1]));
    int u = (int)(3.0f + along_u), v = (int)(3.0f + along_v);
    u = u < 0 ? 0 : (u > 5 ? 5 : u);
    v = v < 0 ? 0 : (v > 5 ? 5 : v);
    int face = 2 * axis + (to < 0.0f ? 1 : 0);
    return (face * 6 + u) * 6 + v;
""")
def direction_cell(d: wp.vec3) -> int:
    """The cell of a CELLS body that a direction falls into."""
    ...


@wp.func(inline=False)
def support(body: Body, points: wp.array(dtype=wp.vec3), d: wp.vec3):
    """The core's farthest point along d, in the body's frame."""
    p = wp.vec3(0.0, 0.0, 0.0)
    if body.kind == CELLS:
        # only this cell's points can be farthest along d
        row = points[body.start + direction_cell(d)]
        p = farthest_in_blocks(points, body.start + int(row[0]), int(row[1]), d)
    elif body.kind == BLOCKS:
        p = farthest_in_blocks(points, body.start, BLOCK_POINTS * body.count, d)
    elif body.kind == HULL:
        best = float(-1.0e30)
        at = int(body.start)
        for i in range(body.start, body.start + body.count):
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
