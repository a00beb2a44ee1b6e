"""Eight nodes, leaves or triangles of a surface at a time: which of them may be near something, as the bits of a number.

A CPU looks at eight numbers at once where they lie side by side. `Surfaces` therefore holds bounds and corners once more in
groups of eight: row k of a group is one number of each of its members, what is missing to eight repeats the last one.

    node_lanes      NODE_ROWS rows for each group of eight nodes of a surface (`group_first`)
    leaf_lanes      LEAF_ROWS rows for each node's leaves
    triangle_lanes  TRIANGLE_ROWS rows for each leaf's triangles

Written in C++, of vectors of eight (`abreast`) or as plain loops that a compiler turns into vector instructions
(`over_lanes`): Warp's own vectors carry along what is to be done with NaN, its loops and arrays what is to be done with
negative steps and indices, and took four times as long. On CUDA they are loops over eight. Each product and sum is a
statement of its own, so that nothing is contracted; sums are taken in the order of `wp.dot` and have its bits.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


def over_lanes(code: str) -> str:
    """C++ whose loops over lanes stay loops on CUDA: unrolled, a call is eight copies of itself, and takes as long to compile."""
    rolled = "#if defined(__CUDA_ARCH__)\n#pragma unroll 1\n#endif\n"
    loops = tuple(f"for (int {name} =" for name in ("k", "c", "axis", "block"))
    return "\n".join(rolled + line if line.lstrip(" ").startswith(loops) else line for line in code.split("\n"))


def abreast(code: str, result: str) -> str:
    """C++ that is written once: on a CPU of vectors of eight lanes, on CUDA of numbers, in a loop over eight.

    `floats` and `ints` (what comparisons give) are types of either, `from(p, r)` and `into(p, r, x)` read and write row r of
    a group at p, `bits_of(mask)` is the bits of the lanes it is asked in.
    """
    head = """
#if defined(__CUDA_ARCH__)
    typedef float floats;
    typedef int ints;
    #pragma unroll 1
    for (int k = 0; k < 8; ++k) {
    auto from = [&](const float* p, int r) { return p[8 * r + k]; };
    auto into = [&](auto* p, int r, auto x) { p[8 * r + k] = x; };
    auto bits_of = [&](ints mask) { return mask << k; };
#else
    typedef float floats __attribute__((ext_vector_type(8)));
    typedef int ints __attribute__((ext_vector_type(8)));
    typedef bool bools __attribute__((ext_vector_type(8)));
    {
    auto from = [](const float* p, int r) { floats x; __builtin_memcpy(&x, p + 8 * r, sizeof(x)); return x; };
    auto into = [](auto* p, int r, auto x) { __builtin_memcpy(p + 8 * r, &x, sizeof(x)); };
    auto bits_of = [](ints mask) {
        return (int)__builtin_bit_cast(unsigned char, __builtin_convertvector(mask, bools));
    };
#endif
"""
    return "    int bits = 0;" + head + code.strip("\n") + "\n    }\n    " + result + "\n"


LANES = wp.constant(8)
NODE_ROWS = wp.constant(10)
"""Centre x, y, z; half sides of the box about it x, y, z; the ball's radius; a point of it x, y, z."""
LEAF_ROWS = wp.constant(7)
"""Centre x, y, z; half sides x, y, z; the ball's radius."""
TRIANGLE_ROWS = wp.constant(9)
"""x, y, z of the first corner, of the second, of the third."""
BOX_M = wp.constant(1.0e-6)
"""Rounding of a box's place in another frame."""


@wp.func_native(
    over_lanes("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
)
def first_lane(bits: int) -> int:
    """The lowest bit that is set; `bits` is not 0."""
    ...


@wp.func_native(
    abreast(
        """
    const float* p = lanes.data + 8 * row;
    floats cx = from(p, 0), cy = from(p, 1), cz = from(p, 2), hx = from(p, 3), hy = from(p, 4), hz = from(p, 5);
    auto meets = [&](const wp::vec3& r, float t, float middle, float half) {
        floats u0 = cx * r.c[0], u1 = cy * r.c[1], u2 = cz * r.c[2];
        floats u = u0 + u1;
        u = u + u2;
        u = u + t;
        u = u - middle;
        u = u < 0.0f ? -u : u;
        floats e0 = hx * fabsf(r.c[0]), e1 = hy * fabsf(r.c[1]), e2 = hz * fabsf(r.c[2]);
        floats e = e0 + e1;
        e = e + e2;
        e = e + half;
        return u <= e;
    };
    bits |= bits_of(meets(rx, tx, x, half_x) & meets(rz, tz, z, half_z));
""",
        "return bits & ((1 << count) - 1);",
    )
)
def boxes_in_prism(
    lanes: wp.array(dtype=float), row: int, count: int, rx: wp.vec3, rz: wp.vec3, tx: float, tz: float,
    x: float, half_x: float, z: float, half_z: float,
) -> int:  # fmt: skip
    """Those of the first `count` boxes that may meet the prism |X - x| <= half_x, |Z - z| <= half_z along y of the ee frame.

    rx, rz: rows of the rotation from the object's frame to the ee frame; tx, tz: its translation.
    """
    ...


@wp.func_native(
    over_lanes("""
    const float* p = lanes.data + 8 * row;
    int near[8];
    int out[8];
    for (int k = 0; k < 8; ++k) {
        float low_x = 1.0e30f, high_x = -1.0e30f, low_z = 1.0e30f, high_z = -1.0e30f;
        for (int c = 0; c < 3; ++c) {
            const float* q = p + 24 * c;
            float u0 = rx.c[0] * q[k], u1 = rx.c[1] * q[8 + k], u2 = rx.c[2] * q[16 + k];
            float u = u0 + u1;
            u = u + u2;
            u = u + tx;
            float w0 = rz.c[0] * q[k], w1 = rz.c[1] * q[8 + k], w2 = rz.c[2] * q[16 + k];
            float w = w0 + w1;
            w = w + w2;
            w = w + tz;
            low_x = u < low_x ? u : low_x;
            high_x = u > high_x ? u : high_x;
            low_z = w < low_z ? w : low_z;
            high_z = w > high_z ? w : high_z;
        }
        near[k] = (low_x <= x_high) & (high_x >= x_low) & (low_z <= z_high) & (high_z >= z_low);
        out[k] = (low_x < x_low) | (high_x > x_high) | (low_z < z_low) | (high_z > z_high);
    }
    int bits = 0;
    for (int k = 0; k < 8; ++k)
        bits |= near[k] << k;
    int sticking = 0;
    for (int k = 0; k < 8; ++k)
        sticking |= out[k] << k;
    return (bits & ((1 << count) - 1)) | (sticking << 8);
""")
)
def triangles_in_prism(
    lanes: wp.array(dtype=float), row: int, count: int, rx: wp.vec3, rz: wp.vec3, tx: float, tz: float,
    x_low: float, x_high: float, z_low: float, z_high: float,
) -> int:  # fmt: skip
    """Those of the first `count` triangles whose bounding rectangle in x and z meets the prism's; bits 8 ..: it sticks out."""
    ...


@wp.func_native(
    over_lanes("""
    const float* p = lanes.data + 8 * row + lane;
    return wp::vec3(p[0], p[8], p[16]);
""")
)
def lane_point(lanes: wp.array(dtype=float), row: int, lane: int) -> wp.vec3:
    """The point of one lane in rows row .. row + 2."""
    ...


# What is near a primitive is first asked of the box about it along the axes of the ee frame, which needs no turning: with c the
# middle of a box of surface and e its half sides there, no point of it is nearer to [low, high] along an axis than
# max(low - c, c - high) - e; nor than the distance of c less the ball's radius.
@wp.func_native(
    abreast(
        """
    const float* p = lanes.data + 8 * row;
    floats x = from(p, 0), y = from(p, 1), z = from(p, 2);
    floats cx = x * R.data[0][0] + y * R.data[0][1] + z * R.data[0][2] + t.c[0];
    floats cy = x * R.data[1][0] + y * R.data[1][1] + z * R.data[1][2] + t.c[1];
    floats cz = x * R.data[2][0] + y * R.data[2][1] + z * R.data[2][2] + t.c[2];
    floats hx = from(p, 3), hy = from(p, 4), hz = from(p, 5);
    floats ex = hx * fabsf(R.data[0][0]) + hy * fabsf(R.data[0][1]) + hz * fabsf(R.data[0][2]);
    floats ey = hx * fabsf(R.data[1][0]) + hy * fabsf(R.data[1][1]) + hz * fabsf(R.data[1][2]);
    floats ez = hx * fabsf(R.data[2][0]) + hy * fabsf(R.data[2][1]) + hz * fabsf(R.data[2][2]);
    floats far = from(p, 6) + reach;
    floats far2 = far * far;
    const floats zero = (floats)(0.0f);
    float reach2 = reach * reach;
    ints found = (ints)(0);
    for (int i = 0; used >> i != 0; ++i) {
        int bit = used & (1 << i);
        if (bit == 0)
            continue;
        floats x1 = low.data[i].c[0] - cx, x2 = cx - high.data[i].c[0];
        floats y1 = low.data[i].c[1] - cy, y2 = cy - high.data[i].c[1];
        floats z1 = low.data[i].c[2] - cz, z2 = cz - high.data[i].c[2];
        x = x1 > x2 ? x1 : x2, y = y1 > y2 ? y1 : y2, z = z1 > z2 ? z1 : z2;
        floats a = x > 0.0f ? x : zero, b = y > 0.0f ? y : zero, c = z > 0.0f ? z : zero;
        floats d2 = a * a + b * b + c * c;
        x = x - ex, y = y - ey, z = z - ez;
        a = x > 0.0f ? x : zero, b = y > 0.0f ? y : zero, c = z > 0.0f ? z : zero;
        floats s2 = a * a + b * b + c * c;
        found = found | (((d2 <= far2) & (s2 <= reach2)) ? (ints)(bit) : (ints)(0));
    }
    into(near.data, 0, found);
    bits |= bits_of(found != 0);
""",
        "return bits & ((1 << count) - 1);",
    )
)
def boxes_near(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3, reach: float,
    low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), used: int, near: wp.array(dtype=int),
) -> int:  # fmt: skip
    """Those of the first `count` boxes that may be `reach` or less from some box [low, high] of the bits `used`.

    `near` (8,): the bits of those boxes for each lane. R, t: from the lanes' frame to that of low and high. `reach` has to
    be a little more than what is asked, for rounding.
    """
    ...


@wp.func_native(
    abreast(
        """
    const float* p = lanes.data + 8 * row;
    floats x = from(p, 0), y = from(p, 1), z = from(p, 2);
    floats cx = x * R.data[0][0] + y * R.data[0][1] + z * R.data[0][2] + t.c[0];
    floats cy = x * R.data[1][0] + y * R.data[1][1] + z * R.data[1][2] + t.c[1];
    floats cz = x * R.data[2][0] + y * R.data[2][1] + z * R.data[2][2] + t.c[2];
    const floats zero = (floats)(0.0f);
    float reach2 = reach * reach;
    ints found = (ints)(0);
    for (int i = 0; used >> i != 0; ++i) {
        int bit = used & (1 << i);
        if (bit == 0)
            continue;
        floats x1 = low.data[i].c[0] - cx, x2 = cx - high.data[i].c[0];
        floats y1 = low.data[i].c[1] - cy, y2 = cy - high.data[i].c[1];
        floats z1 = low.data[i].c[2] - cz, z2 = cz - high.data[i].c[2];
        x = x1 > x2 ? x1 : x2, y = y1 > y2 ? y1 : y2, z = z1 > z2 ? z1 : z2;
        floats a = x > 0.0f ? x : zero, b = y > 0.0f ? y : zero, c = z > 0.0f ? z : zero;
        floats d2 = a * a + b * b + c * c;
        found = found | ((d2 <= reach2) ? (ints)(bit) : (ints)(0));
    }
    into(near.data, 0, found);
    bits |= bits_of(found != 0);
""",
        "return bits & ((1 << count) - 1);",
    )
)
def points_near(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3, reach: float,
    low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), used: int, near: wp.array(dtype=int),
) -> int:  # fmt: skip
    """As `boxes_near`, of points in rows row .. row + 2."""
    ...


@wp.func_native(
    abreast(
        """
    const float* p = lanes.data + 8 * row;
    floats d2 = (floats)(0.0f);
    for (int axis = 0; axis < 3; ++axis) {
        floats low, high;
        for (int c = 0; c < 3; ++c) {
            floats x = from(p, 3 * c), y = from(p, 3 * c + 1), z = from(p, 3 * c + 2);
            floats u = x * R.data[axis][0] + y * R.data[axis][1] + z * R.data[axis][2] + t.c[axis];
            low = c == 0 ? u : (u < low ? u : low);
            high = c == 0 ? u : (u > high ? u : high);
        }
        floats a = low - half.c[axis], b = -half.c[axis] - high;
        floats d = a > b ? a : b;
        d = d > 0.0f ? d : (floats)(0.0f);
        d2 = d2 + d * d;
    }
    bits |= bits_of(d2 <= reach * reach);
""",
        "return bits & ((1 << count) - 1);",
    )
)
def triangles_near(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3, half: wp.vec3, reach: float
) -> int:
    """Those of the first `count` triangles whose box, along the axes of a box with these half sides, is within `reach` of it.

    R, t: from the lanes' frame to the box's.
    """
    ...
