"""A leaf's triangles, or the boxes of a node's leaves, eight at a time: what the prism and the runs of material leave of them.

In C++ as in geometry/lanes.py: each product and sum is a statement of its own, in the order of Warp's, and has its bits.
What is worked out of eight of them stands in scratch arrays, rows of eight as in the tables, so that it is asked again and
again (`outside_runs`) without being worked out again.
"""

import warp as wp

from r2h_batch.kernels.geometry.lanes import abreast
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func_native(
    abreast(
        """
    const float* p = lanes.data + 8 * row;
    floats u0 = from(p, 0) * ry.c[0], u1 = from(p, 1) * ry.c[1], u2 = from(p, 2) * ry.c[2];
    floats u = u0 + u1;
    u = u + u2;
    u = u + ty;
    floats e0 = from(p, 3) * fabsf(ry.c[0]), e1 = from(p, 4) * fabsf(ry.c[1]), e2 = from(p, 5) * fabsf(ry.c[2]);
    floats e = e0 + e1;
    e = e + e2;
    into(span.data, 0, u - e);
    into(span.data, 1, u + e);
""",
        "(void)bits;",
    )
)
def boxes_along(lanes: wp.array(dtype=float), row: int, ry: wp.vec3, ty: float, span: wp.array(dtype=float)):
    """`span` (2 rows): lowest and highest y (ee frame) of eight boxes; ry: that row of the rotation, ty: of the translation."""
    ...


@wp.func_native(
    abreast(
        """
    floats low = from(span.data, 0), high = from(span.data, 1);
    ints within = low != low;
    for (int i = 0; i < n; ++i) {
        floats a = (floats)(run_low.data[i] - slack), b = (floats)(run_high.data[i] + slack);
        within = within | ((low >= a) & (high <= b));
    }
    bits |= bits_of(within);
""",
        "return near & ~bits;",
    )
)
def outside_runs(
    span: wp.array(dtype=float), near: int, slack: float,
    run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), n: int,
) -> int:  # fmt: skip
    """Of the lanes in `near` those whose `span` none of n intervals holds, give or take `slack`."""
    ...


@wp.func_native(
    abreast(
        """
    const float* p = lanes.data + 8 * row;
    floats low[3], high[3];
    for (int c = 0; c < 3; ++c) {
        floats x = from(p, 3 * c), y = from(p, 3 * c + 1), z = from(p, 3 * c + 2);
        for (int axis = 0; axis < 3; ++axis) {
            floats u0 = x * R.data[axis][0], u1 = y * R.data[axis][1], u2 = z * R.data[axis][2];
            floats u = u0 + u1;
            u = u + u2;
            u = u + t.c[axis];
            into(corners.data, 3 * c + axis, u);
            low[axis] = c == 0 ? u : (u < low[axis] ? u : low[axis]);
            high[axis] = c == 0 ? u : (u > high[axis] ? u : high[axis]);
        }
    }
    into(span.data, 0, low[1]);
    into(span.data, 1, high[1]);
    bits |= bits_of((low[0] <= half_x) & (high[0] >= -half_x) & (low[2] <= z_high) & (high[2] >= z_low));
    bits |= bits_of((low[0] < -half_x) | (high[0] > half_x) | (low[2] < z_low) | (high[2] > z_high)) << 8;
""",
        "return bits & (0xff00 | ((1 << count) - 1));",
    )
)
def leaf_in_prism(
    lanes: wp.array(dtype=float), row: int, count: int, R: wp.mat33, t: wp.vec3,
    half_x: float, z_low: float, z_high: float, corners: wp.array(dtype=float), span: wp.array(dtype=float),
) -> int:  # fmt: skip
    """Those of a leaf's `count` triangles whose bounding rectangle in x and z meets the prism's; bits 8 ..: it sticks out.

    `corners` (9 rows): their corners in the ee frame; `span` (2 rows): their lowest and highest y. R, t: object to ee frame.
    """
    ...


# An edge from p to q is cut to where low <= p + t (q - p) <= high in x, then in z; where it does not cross a bound, the
# quotients mean nothing and are not used. t1 = 1 gives q itself.
@wp.func_native(
    abreast(
        """
    const float* p = corners.data;
    floats low = (floats)(1.0e30f), high = (floats)(-1.0e30f);
    floats x_min, x_max, z_min, z_max;
    for (int c = 0; c < 3; ++c) {
        int n = c == 2 ? 0 : c + 1;
        floats ax = from(p, 3 * c), ay = from(p, 3 * c + 1), az = from(p, 3 * c + 2);
        floats bx = from(p, 3 * n), by = from(p, 3 * n + 1), bz = from(p, 3 * n + 2);
        x_min = c == 0 ? ax : (ax < x_min ? ax : x_min);
        x_max = c == 0 ? ax : (ax > x_max ? ax : x_max);
        z_min = c == 0 ? az : (az < z_min ? az : z_min);
        z_max = c == 0 ? az : (az > z_max ? az : z_max);
        floats t0 = (floats)(0.0f), t1 = (floats)(1.0f);
        for (int axis = 0; axis < 2; ++axis) {
            floats a = axis == 0 ? ax : az, b = axis == 0 ? bx : bz;
            floats l = (floats)(axis == 0 ? -half_x : z_low), h = (floats)(axis == 0 ? half_x : z_high);
            ints nowhere = ((a < l) & (b < l)) | ((a > h) & (b > h));
            ints crosses = (a < l) | (b < l) | (a > h) | (b > h);
            floats d = b - a;
            floats u = (l - a) / d, v = (h - a) / d;
            floats first = u < v ? u : v, last = u > v ? u : v;
            first = first > t0 ? first : t0;
            last = last < t1 ? last : t1;
            t0 = crosses ? first : t0;
            t1 = crosses ? last : t1;
            t0 = nowhere ? (floats)(2.0f) : t0;
            t1 = nowhere ? (floats)(-1.0f) : t1;
        }
        floats d = by - ay;
        floats s0 = t0 * d, s1 = t1 * d;
        floats y0 = ay + s0, y1 = ay + s1;
        y1 = t1 >= 1.0f ? by : y1;
        ints inside = t0 <= t1;
        floats least = y0 < y1 ? y0 : y1, most = y0 > y1 ? y0 : y1;
        low = (inside & (least < low)) ? least : low;
        high = (inside & (most > high)) ? most : high;
    }
    ints left = (x_min < -half_x) & (x_max > -half_x), right = (x_min < half_x) & (x_max > half_x);
    ints bottom = (z_min < z_low) & (z_max > z_low), top = (z_min < z_high) & (z_max > z_high);
    bits |= bits_of(left & bottom) | (bits_of(left & top) << 8);
    bits |= (bits_of(right & bottom) << 16) | (bits_of(right & top) << 24);
    into(cut.data, 0, low);
    into(cut.data, 1, high);
""",
        "return bits & (0x01010101 * lanes);",
    )
)
def cut_to_prism(
    corners: wp.array(dtype=float), lanes: int, half_x: float, z_low: float, z_high: float, cut: wp.array(dtype=float)
) -> int:
    """`cut` (2 rows): lowest and highest y at which the edges of eight triangles run inside the prism (low > high: none).

    Given back: those of the triangles in bits `lanes` that may hold a point of the prism's corner line i = 0 .. 3
    (`corner`), as bits 8 i ...
    """
    ...


# What `add_run` does where there is one run and the range meets it, which is nearly always so: nothing but that run grows.
@wp.func_native("""
    float low = run_low.data[0], high = run_high.data[0];
    while (n == 1 && near != 0) {
#if defined(__CUDA_ARCH__)
        int lane = __ffs(near) - 1;
#else
        int lane = __builtin_ctz(near);
#endif
        const float* y = ((sticking >> lane) & 1) ? cut.data : span.data;
        float a = y[lane], b = y[8 + lane];
        if (a <= b && !(a <= high + join && b >= low - join))
            break;
        near &= near - 1;
        if (a <= b && !(span.data[lane] >= low - slack && span.data[8 + lane] <= high + slack)) {
            low = a < low ? a : low;
            high = b > high ? b : high;
        }
    }
    run_low.data[0] = low;
    run_high.data[0] = high;
    return near;
""")
def grow_run(
    near: int, sticking: int, span: wp.array(dtype=float), cut: wp.array(dtype=float), slack: float, join: float,
    run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), n: int,
) -> int:  # fmt: skip
    """Joins lanes to the one run there is (n = 1), lowest lane first, until one does not meet it; what is left of `near`.

    A lane's range of y is its `cut` where it is in `sticking`, else its `span`. Lanes whose span lies in the run, give or take
    `slack`, are passed over; ranges within `join` of the run meet it.
    """
    ...
