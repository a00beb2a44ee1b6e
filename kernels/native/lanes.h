// Kernel functions in C++: loops over eight or sixteen numbers that lie side by side, and the
// few things that Warp's Python cannot say.
//
// `r2h_batch/kernels/options.py` puts this text before the code that Warp generates for a
// module, for a CPU and for CUDA. A function of Python with the same name calls each function
// here. Warp's own loops and vectors took four to five times as long, for what they do about
// NaN and negative indices.
//
// Bits: every product and sum is rounded by itself (no contraction), in the order of `wp.dot`.
// So all forms of a function (vectors, loops, Python on Warp) have the same float32 bits.
//
// Groups of eight: row r of a group at p is p[8 r] .. p[8 r + 7], one number for each lane.
// Tables that are shorter repeat their last entry; `first_lanes(count)` takes the copies out.

#ifndef R2H_LANES_H
#define R2H_LANES_H

#if defined(__CUDA_ARCH__)
// A rolled loop is compiled once. Unrolled, a call is eight copies and takes as long to compile.
#define R2H_ROLLED _Pragma("unroll 1")
#define R2H_UNROLLED _Pragma("unroll")
#else
#define R2H_ROLLED
#define R2H_UNROLLED
#endif

#if !defined(CUDA_CALLABLE)
#define CUDA_CALLABLE
#endif
#define R2H_FUNCTION CUDA_CALLABLE static inline

#if defined(__CUDA_ARCH__)
// Warp writes `x = where(condition, x_within, x_before)` after each `if`. A select keeps
// `x_within` of a loop's last turn in a register all the way round; a branch on the condition of
// the `if` joins with it. GJK of listed pairs has 168 registers in place of 239.
namespace wp {
template <typename C, typename T> CUDA_CALLABLE inline T where_by_branch(const C &condition, const T &a, const T &b) {
    if (!!condition) {
        asm volatile(""); // empty, but no compiler moves it: the branch cannot become a select
        return a;
    }
    return b;
}
} // namespace wp
#define where where_by_branch
#else
// `@wp.func(inline=False)` holds on CUDA only (a quarter of the compile time, half the code).
// On a CPU calls cost 17 % of a trial.
#undef WP_NOINLINE
#define WP_NOINLINE
#endif

namespace r2h {

typedef unsigned long long bits64;

template <typename T> struct Xyz {
    T x, y, z;
};
typedef Xyz<float> Point;

R2H_FUNCTION Point xyz(const float *p) { return {p[0], p[1], p[2]}; }
R2H_FUNCTION Point xyz(const wp::vec3 &p) { return {p.c[0], p.c[1], p.c[2]}; }
template <typename A, typename B> R2H_FUNCTION auto operator+(const Xyz<A> &a, const Xyz<B> &b) {
    return Xyz<decltype(a.x + b.x)>{a.x + b.x, a.y + b.y, a.z + b.z};
}
template <typename A, typename B> R2H_FUNCTION auto operator-(const Xyz<A> &a, const Xyz<B> &b) {
    return Xyz<decltype(a.x - b.x)>{a.x - b.x, a.y - b.y, a.z - b.z};
}
template <typename S, typename T> R2H_FUNCTION auto operator*(S s, const Xyz<T> &a) {
    return Xyz<decltype(s * a.x)>{s * a.x, s * a.y, s * a.z};
}
template <typename A, typename B> R2H_FUNCTION auto dot(const Xyz<A> &a, const Xyz<B> &b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <typename A, typename B> R2H_FUNCTION auto cross(const Xyz<A> &a, const Xyz<B> &b) {
    return Xyz<decltype(a.x * b.x)>{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// ---------------------------------------------------------------------------- eight lanes

// `each_lane(body)` calls body(lane) and returns the bits that it gives. Clang for CPUs
// calls it once, for vectors of eight; any other compiler calls it for one lane at a time, where
// `floats` is a float and `ints` (the type of a comparison) an int.
#if defined(__clang__) && !defined(__CUDA_ARCH__)
#define R2H_VECTORS
typedef float floats __attribute__((ext_vector_type(8)));
typedef int ints __attribute__((ext_vector_type(8)));
typedef bool bools __attribute__((ext_vector_type(8)));

typedef Xyz<floats> Points; // one of each lane
struct Balls {
    Points center;
    floats radius;
};

struct Lane {
    // Row r of the group at p.
    static inline floats row(const float *p, int r) {
        floats x;
        __builtin_memcpy(&x, p + 8 * r, sizeof(x));
        return x;
    }
    // Entries first .. first + 7 of `count`; the last again where there are no more. Points lie side
    // by side in three vectors, of which each coordinate takes every third number.
    static inline floats entries(const float *p, int first, int count) {
        float copy[8];
        if (first + 8 > count) {
            for (int k = 0; k < 8; ++k)
                copy[k] = p[first + k < count ? first + k : count - 1];
            return row(copy, 0);
        }
        return row(p + first, 0);
    }
    static inline Points entries(const wp::vec3 *points, int first, int count) {
        const float *p = &points[first].c[0];
        float copy[24];
        if (first + 8 > count) {
            for (int k = 0; k < 8; ++k)
                __builtin_memcpy(copy + 3 * k, &points[first + k < count ? first + k : count - 1], 3 * sizeof(float));
            p = copy;
        }
        floats a = row(p, 0), b = row(p, 1), c = row(p, 2);
        floats x = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, -1, -1);
        floats y = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, -1, -1, -1);
        floats z = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, -1, -1, -1);
        return {__builtin_shufflevector(x, c, 0, 1, 2, 3, 4, 5, 10, 13),
                __builtin_shufflevector(y, c, 0, 1, 2, 3, 4, 8, 11, 14),
                __builtin_shufflevector(z, c, 0, 1, 2, 3, 4, 9, 12, 15)};
    }
    static inline Balls entries(const wp::vec4 *balls, int first, int count) {
        const float *p = &balls[first].c[0];
        float copy[32];
        if (first + 8 > count) {
            for (int k = 0; k < 8; ++k)
                __builtin_memcpy(copy + 4 * k, &balls[first + k < count ? first + k : count - 1], 4 * sizeof(float));
            p = copy;
        }
        floats a = row(p, 0), b = row(p, 1), c = row(p, 2), d = row(p, 3);
        floats xy = __builtin_shufflevector(a, b, 0, 4, 8, 12, 1, 5, 9, 13);
        floats zr = __builtin_shufflevector(a, b, 2, 6, 10, 14, 3, 7, 11, 15);
        floats xy_more = __builtin_shufflevector(c, d, 0, 4, 8, 12, 1, 5, 9, 13);
        floats zr_more = __builtin_shufflevector(c, d, 2, 6, 10, 14, 3, 7, 11, 15);
        return {{__builtin_shufflevector(xy, xy_more, 0, 1, 2, 3, 8, 9, 10, 11),
                 __builtin_shufflevector(xy, xy_more, 4, 5, 6, 7, 12, 13, 14, 15),
                 __builtin_shufflevector(zr, zr_more, 0, 1, 2, 3, 8, 9, 10, 11)},
                __builtin_shufflevector(zr, zr_more, 4, 5, 6, 7, 12, 13, 14, 15)};
    }
    template <typename T, typename X> static inline void put(T *p, int r, X x) {
        __builtin_memcpy(p + 8 * r, &x, sizeof(x));
    }
    // Bit k: whether `mask` holds in lane k.
    static inline int bits(ints mask) {
        return (int)__builtin_bit_cast(unsigned char, __builtin_convertvector(mask, bools));
    }
};

template <typename F> static inline int each_lane(F body) { return body(Lane()); }
#else
typedef float floats;
typedef int ints;
typedef Point Points;
struct Balls {
    Point center;
    float radius;
};

struct Lane {
    int k;
    CUDA_CALLABLE inline int entry(int first, int count) const { return first + k < count ? first + k : count - 1; }
    CUDA_CALLABLE inline float entries(const float *p, int first, int count) const { return p[entry(first, count)]; }
    CUDA_CALLABLE inline Point entries(const wp::vec3 *p, int first, int count) const { return xyz(p[entry(first, count)]); }
    CUDA_CALLABLE inline Balls entries(const wp::vec4 *p, int first, int count) const {
        const wp::vec4 &ball = p[entry(first, count)];
        return {{ball.c[0], ball.c[1], ball.c[2]}, ball.c[3]};
    }
    CUDA_CALLABLE inline float row(const float *p, int r) const { return p[8 * r + k]; }
    template <typename T> CUDA_CALLABLE inline void put(T *p, int r, T x) const { p[8 * r + k] = x; }
    CUDA_CALLABLE inline int bits(int mask) const { return mask << k; }
};

template <typename F> CUDA_CALLABLE inline int each_lane(F body) {
    int bits = 0;
    R2H_ROLLED
    for (int k = 0; k < 8; ++k)
        bits |= body(Lane{k});
    return bits;
}
#endif

#if defined(R2H_VECTORS)
R2H_FUNCTION floats root(floats x) { return __builtin_elementwise_sqrt(x); }
#else
R2H_FUNCTION float root(float x) { return sqrtf(x); }
#endif

R2H_FUNCTION int first_lanes(int count) { return (1 << count) - 1; }

// The number of the lowest bit that is set; some bit must be.
R2H_FUNCTION int first_lane(int bits) {
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
}

R2H_FUNCTION int lowest_bit(bits64 bits) {
#if defined(__CUDA_ARCH__)
    return __ffsll((long long)bits) - 1;
#else
    return __builtin_ctzll(bits);
#endif
}

// The point of one lane in rows 0 .. 2.
R2H_FUNCTION wp::vec3 lane_point(const float *p, int lane) { return wp::vec3(p[lane], p[8 + lane], p[16 + lane]); }

// R x + t, of the points in rows 0 .. 2.
R2H_FUNCTION Points placed(Lane lane, const float *p, const wp::mat33 &R, const wp::vec3 &t) {
    floats x = lane.row(p, 0), y = lane.row(p, 1), z = lane.row(p, 2);
    auto row = [&](int i) { return x * R.data[i][0] + y * R.data[i][1] + z * R.data[i][2] + t.c[i]; };
    return {row(0), row(1), row(2)};
}

// Half sides of boxes along the axes of the frame that R turns them to: |R| h.
R2H_FUNCTION Points turned_sides(Lane lane, const float *p, const wp::mat33 &R) {
    floats x = lane.row(p, 0), y = lane.row(p, 1), z = lane.row(p, 2);
    auto row = [&](int i) { return x * fabsf(R.data[i][0]) + y * fabsf(R.data[i][1]) + z * fabsf(R.data[i][2]); };
    return {row(0), row(1), row(2)};
}

// Along each axis max(low - c, c - high): how far c is outside [low, high], negative inside.
R2H_FUNCTION Points outside(const Points &c, const wp::vec3 &low, const wp::vec3 &high) {
    auto of = [](floats x, float low, float high) {
        floats below = low - x, above = x - high;
        return below > above ? below : above;
    };
    return {of(c.x, low.c[0], high.c[0]), of(c.y, low.c[1], high.c[1]), of(c.z, low.c[2], high.c[2])};
}

// The squared distance that belongs to it: the sum of the squares of what is positive.
R2H_FUNCTION floats squared_distance(const Points &d) {
    const floats zero = (floats)(0.0f);
    floats a = d.x > 0.0f ? d.x : zero, b = d.y > 0.0f ? d.y : zero, c = d.z > 0.0f ? d.z : zero;
    return a * a + b * b + c * c;
}

// Tells which of boxes i (bits `used`) each lane is near, in `near`, and which lanes are near any.
// close(outside): whether it is, of `outside` as above.
template <typename F> CUDA_CALLABLE inline int near_boxes(Lane lane, const Points &c, const wp::vec3 *low,
                                                          const wp::vec3 *high, int used, int *near, F close) {
    ints found = (ints)(0);
    for (int i = 0; used >> i != 0; ++i) {
        int bit = used & (1 << i);
        if (bit == 0)
            continue;
        found = found | (close(outside(c, low[i], high[i])) ? (ints)(bit) : (ints)(0));
    }
    lane.put(near, 0, found);
    return lane.bits(found != 0);
}

// A box with middle c and half sides e is no nearer to [low, high] along an axis than
// max(low - c, c - high) - e. A ball of radius r about c is no nearer than |outside| - r. The
// lane counts where neither bound exceeds `cutoff`.
// Rows: centre x, y, z; half sides x, y, z; radius.
R2H_FUNCTION int boxes_near(const float *p, int count, const wp::mat33 &R, const wp::vec3 &t, float cutoff,
                            const wp::vec3 *low, const wp::vec3 *high, int used, int *near) {
    int bits = each_lane([&](Lane lane) {
        Points c = placed(lane, p, R, t), e = turned_sides(lane, p + 24, R);
        floats far = lane.row(p, 6) + cutoff;
        floats far2 = far * far;
        float cutoff2 = cutoff * cutoff;
        return near_boxes(lane, c, low, high, used, near, [&](const Points &d) {
            Points less = {d.x - e.x, d.y - e.y, d.z - e.z};
            return (squared_distance(d) <= far2) & (squared_distance(less) <= cutoff2);
        });
    });
    return bits & first_lanes(count);
}

// As `boxes_near`, of points in rows 0 .. 2.
R2H_FUNCTION int points_near(const float *p, int count, const wp::mat33 &R, const wp::vec3 &t, float cutoff,
                             const wp::vec3 *low, const wp::vec3 *high, int used, int *near) {
    int bits = each_lane([&](Lane lane) {
        float cutoff2 = cutoff * cutoff;
        return near_boxes(lane, placed(lane, p, R, t), low, high, used, near,
                          [&](const Points &d) { return squared_distance(d) <= cutoff2; });
    });
    return bits & first_lanes(count);
}

// Triangles (three points, 9 rows) whose box along the axes of R, t is within `cutoff` of the box
// with half sides `half` about the origin there.
R2H_FUNCTION int triangles_near(const float *p, int count, const wp::mat33 &R, const wp::vec3 &t, const wp::vec3 &half,
                                float cutoff) {
    int bits = each_lane([&](Lane lane) {
        floats d2 = (floats)(0.0f);
        for (int axis = 0; axis < 3; ++axis) {
            floats low = {}, high = {};
            for (int c = 0; c < 3; ++c) {
                floats x = lane.row(p, 3 * c), y = lane.row(p, 3 * c + 1), z = lane.row(p, 3 * c + 2);
                floats u = x * R.data[axis][0] + y * R.data[axis][1] + z * R.data[axis][2] + t.c[axis];
                low = c == 0 ? u : (u < low ? u : low);
                high = c == 0 ? u : (u > high ? u : high);
            }
            floats a = low - half.c[axis], b = -half.c[axis] - high;
            floats d = a > b ? a : b;
            d = d > 0.0f ? d : (floats)(0.0f);
            d2 = d2 + d * d;
        }
        return lane.bits(d2 <= cutoff * cutoff);
    });
    return bits & first_lanes(count);
}

// ---------------------------------------------------------------------- the gripper's prism

// The prism of the finger pads runs along y of the ee frame: x_low <= x <= x_high and
// z_low <= z <= z_high. R, t (rows rx, ry, rz) take the object's frame to the ee frame.

// a . x + b, of the points in rows 0 .. 2, in the order of `wp.dot`.
R2H_FUNCTION floats along(Lane lane, const float *p, const wp::vec3 &a, float b) {
    floats u0 = lane.row(p, 0) * a.c[0], u1 = lane.row(p, 1) * a.c[1], u2 = lane.row(p, 2) * a.c[2];
    floats u = u0 + u1;
    u = u + u2;
    return u + b;
}

// |a| . h, of the half sides in rows 0 .. 2.
R2H_FUNCTION floats side_along(Lane lane, const float *p, const wp::vec3 &a) {
    floats e0 = lane.row(p, 0) * fabsf(a.c[0]), e1 = lane.row(p, 1) * fabsf(a.c[1]);
    floats e2 = lane.row(p, 2) * fabsf(a.c[2]);
    floats e = e0 + e1;
    return e + e2;
}

// Boxes that may meet |X - x| <= half_x, |Z - z| <= half_z.
R2H_FUNCTION int boxes_in_prism(const float *p, int count, const wp::vec3 &rx, const wp::vec3 &rz, float tx, float tz,
                                float x, float half_x, float z, float half_z) {
    int bits = each_lane([&](Lane lane) {
        auto meets = [&](const wp::vec3 &r, float t, float middle, float half) {
            floats u = along(lane, p, r, t) - middle;
            u = u < 0.0f ? -u : u;
            return u <= side_along(lane, p + 24, r) + half;
        };
        return lane.bits(meets(rx, tx, x, half_x) & meets(rz, tz, z, half_z));
    });
    return bits & first_lanes(count);
}

// `span` (2 rows): lowest and highest y of eight boxes.
R2H_FUNCTION void boxes_along(const float *p, const wp::vec3 &ry, float ty, float *span) {
    each_lane([&](Lane lane) {
        floats u = along(lane, p, ry, ty), e = side_along(lane, p + 24, ry);
        lane.put(span, 0, u - e);
        lane.put(span, 1, u + e);
        return 0;
    });
}

// Bits 0 .. 7: the rectangle [low, high] in x and z meets the prism's; bits 8 .. 15: it sticks out.
R2H_FUNCTION int rectangle_bits(Lane lane, const floats *low, const floats *high, float x_low, float x_high,
                                float z_low, float z_high) {
    int meets = lane.bits((low[0] <= x_high) & (high[0] >= x_low) & (low[2] <= z_high) & (high[2] >= z_low));
    int out = lane.bits((low[0] < x_low) | (high[0] > x_high) | (low[2] < z_low) | (high[2] > z_high));
    return meets | (out << 8);
}

// Triangles (9 rows) whose bounding rectangle in x and z meets the prism's, and which stick out.
R2H_FUNCTION int triangles_in_prism(const float *p, int count, const wp::vec3 &rx, const wp::vec3 &rz, float tx,
                                    float tz, float x_low, float x_high, float z_low, float z_high) {
    int bits = each_lane([&](Lane lane) {
        floats low[3], high[3];
        for (int c = 0; c < 3; ++c)
            for (int axis = 0; axis < 3; axis += 2) {
                floats u = along(lane, p + 24 * c, axis == 0 ? rx : rz, axis == 0 ? tx : tz);
                low[axis] = c == 0 ? u : (u < low[axis] ? u : low[axis]);
                high[axis] = c == 0 ? u : (u > high[axis] ? u : high[axis]);
            }
        return rectangle_bits(lane, low, high, x_low, x_high, z_low, z_high);
    });
    return bits & (0xff00 | first_lanes(count));
}

// The same, and writes the triangles' corners in the ee frame (9 rows) and their span of y (2).
R2H_FUNCTION int leaf_in_prism(const float *p, int count, const wp::mat33 &R, const wp::vec3 &t, float half_x,
                               float z_low, float z_high, float *corners, float *span) {
    int bits = each_lane([&](Lane lane) {
        floats low[3], high[3];
        for (int c = 0; c < 3; ++c) {
            floats x = lane.row(p, 3 * c), y = lane.row(p, 3 * c + 1), z = lane.row(p, 3 * c + 2);
            for (int axis = 0; axis < 3; ++axis) {
                floats u0 = x * R.data[axis][0], u1 = y * R.data[axis][1], u2 = z * R.data[axis][2];
                floats u = u0 + u1;
                u = u + u2;
                u = u + t.c[axis];
                lane.put(corners, 3 * c + axis, u);
                low[axis] = c == 0 ? u : (u < low[axis] ? u : low[axis]);
                high[axis] = c == 0 ? u : (u > high[axis] ? u : high[axis]);
            }
        }
        lane.put(span, 0, low[1]);
        lane.put(span, 1, high[1]);
        return rectangle_bits(lane, low, high, -half_x, half_x, z_low, z_high);
    });
    return bits & (0xff00 | first_lanes(count));
}

// Of the lanes in `near` those whose `span` lies in none of n intervals, each `slack` longer.
R2H_FUNCTION int outside_runs(const float *span, int near, float slack, const float *run_low, const float *run_high,
                              int n) {
    int within = each_lane([&](Lane lane) {
        floats low = lane.row(span, 0), high = lane.row(span, 1);
        ints within = low != low;
        for (int i = 0; i < n; ++i) {
            floats a = (floats)(run_low[i] - slack), b = (floats)(run_high[i] + slack);
            within = within | ((low >= a) & (high <= b));
        }
        return lane.bits(within);
    });
    return near & ~within;
}

// `cut` (2 rows): the lowest and highest y of the edges of eight triangles inside the prism; low >
// high: none.
//
// An edge from a to b, a + t (b - a), is cut to low <= a_i + t (b_i - a_i) <= high for x, then z.
// Where it crosses no bound the quotients are not used; t1 = 1 is b itself.
//
// Returns in bits 8 i .. 8 i + 7 the triangles of `lanes` whose bounding rectangle holds the
// prism's corner line i = 0 .. 3: (-x, low z), (-x, high z), (x, low z), (x, high z).
R2H_FUNCTION int cut_to_prism(const float *corners, int lanes, float half_x, float z_low, float z_high, float *cut) {
    int bits = each_lane([&](Lane lane) {
        floats low = (floats)(1.0e30f), high = (floats)(-1.0e30f);
        floats x_min = {}, x_max = {}, z_min = {}, z_max = {};
        for (int c = 0; c < 3; ++c) {
            const float *p = corners + 24 * c, *q = corners + 24 * (c == 2 ? 0 : c + 1);
            floats ax = lane.row(p, 0), ay = lane.row(p, 1), az = lane.row(p, 2);
            floats bx = lane.row(q, 0), by = lane.row(q, 1), bz = lane.row(q, 2);
            x_min = c == 0 ? ax : (ax < x_min ? ax : x_min);
            x_max = c == 0 ? ax : (ax > x_max ? ax : x_max);
            z_min = c == 0 ? az : (az < z_min ? az : z_min);
            z_max = c == 0 ? az : (az > z_max ? az : z_max);
            floats t0 = (floats)(0.0f), t1 = (floats)(1.0f);
            for (int axis = 0; axis < 2; ++axis) {
                floats a = axis == 0 ? ax : az, b = axis == 0 ? bx : bz;
                floats l = (floats)(axis == 0 ? -half_x : z_low);
                floats h = (floats)(axis == 0 ? half_x : z_high);
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
        lane.put(cut, 0, low);
        lane.put(cut, 1, high);
        ints left = (x_min < -half_x) & (x_max > -half_x);
        ints right = (x_min < half_x) & (x_max > half_x);
        ints bottom = (z_min < z_low) & (z_max > z_low), top = (z_min < z_high) & (z_max > z_high);
        return lane.bits(left & bottom) | (lane.bits(left & top) << 8) | (lane.bits(right & bottom) << 16) |
               (lane.bits(right & top) << 24);
    });
    return bits & (0x01010101 * lanes);
}

// Ranges within `join` of each other are one run (JOIN_M of grasp/prism.py), of which there is room
// for `most_runs` (MAX_RUNS).
R2H_FUNCTION float join() { return 1.0e-6f; }
R2H_FUNCTION int most_runs() { return 24; }

// Joins [a, b] to the n runs that it meets, in place; returns how many there are now.
R2H_FUNCTION int add_run(float *low, float *high, int n, float a, float b) {
    int i = 0;
    while (i < n) {
        if (a <= high[i] + join() && b >= low[i] - join()) {
            a = low[i] < a ? low[i] : a;
            b = high[i] > b ? high[i] : b;
            --n;
            low[i] = low[n];
            high[i] = high[n];
            i = 0; // the grown run may meet one that was passed
        } else
            ++i;
    }
    if (n < most_runs()) {
        low[n] = a;
        high[n] = b;
        return n + 1;
    }
    int nearest = 0; // no room: the nearest run takes it in
    float gap = 1.0e30f;
    for (int k = 0; k < n; ++k) {
        float below = low[k] - b, above = a - high[k];
        float apart = below > above ? below : above;
        nearest = apart < gap ? k : nearest;
        gap = apart < gap ? apart : gap;
    }
    low[nearest] = a < low[nearest] ? a : low[nearest];
    high[nearest] = b > high[nearest] ? b : high[nearest];
    return n;
}

// Joins lanes of `near` to the n runs, lowest lane first; returns how many runs there are now.
//
// A lane's range of y is its `cut` where it is in `sticking`, else its `span`; an empty one
// (low > high) and one whose span lies in a run, `slack` longer, add nothing.
R2H_FUNCTION int add_lanes(int near, int sticking, const float *span, const float *cut, float slack, float *low,
                           float *high, int n) {
    for (; near != 0; near &= near - 1) {
        int lane = first_lane(near);
        const float *y = ((sticking >> lane) & 1) ? cut : span;
        bool adds = y[lane] <= y[8 + lane];
        for (int i = 0; i < n && adds; ++i)
            adds = !(span[lane] >= low[i] - slack && span[8 + lane] <= high[i] + slack);
        if (adds)
            n = add_run(low, high, n, y[lane], y[8 + lane]);
    }
    return n;
}

// ------------------------------------------------------- the nearest point of a surface

// What a squared distance d^2 may differ by where distances differ by 0.1 um: 2 d (0.1 um). Rounding
// of the nearest point is a fifth of it for objects within a metre.
R2H_FUNCTION float tie(float d2) { return 2.0e-7f * sqrtf(d2) + 1.0e-14f; }

// `far2` (1 row): squared distances of x from eight boxes, at most. Returns the boxes that may hold
// something as near as sqrt(within2), but for rounding.
// Rows: centre x, y, z; half sides x, y, z.
R2H_FUNCTION int boxes_within(const float *p, int count, const wp::vec3 &x, float within2, float *far2) {
    within2 = within2 + tie(within2);
    int bits = each_lane([&](Lane lane) {
        auto beyond = [&](int axis) {
            floats d = lane.row(p, axis) - x.c[axis];
            d = (d < 0.0f ? -d : d) - lane.row(p, 3 + axis);
            return d > 0.0f ? d : (floats)(0.0f);
        };
        floats dx = beyond(0), dy = beyond(1), dz = beyond(2);
        floats d2 = (dx * dx + dy * dy + dz * dz) * 0.99999f;
        lane.put(far2, 0, d2);
        return lane.bits(d2 <= within2);
    });
    return bits & first_lanes(count);
}

// The lane of `bits` (some bit is set) with the least number in `row`.
R2H_FUNCTION int least_lane(const float *row, int bits) {
    int least = first_lane(bits);
    for (bits &= bits - 1; bits != 0; bits &= bits - 1) {
        int lane = first_lane(bits);
        least = row[lane] < row[least] ? lane : least;
    }
    return least;
}

// Eight triangles (9 rows) as to how near they come to x. By Voronoi regions (Ericson, Real-Time
// Collision Detection, 5.1.5); the one that holds x is asked last of all, so it decides.
// Triangles whose height is below a millionth of their sides are left out: rounding would put the
// point anywhere. Returns the lane of the nearest, -1: none is nearer than `best`.
//
// `best`: the nearest triangle so far; its squared distance, the weights v, w of its second and
// third corner there, the squared distance of the point that they give, and 1 where another
// triangle is as near but for rounding and gives another distance.
R2H_FUNCTION int nearest_triangle(const float *p, int count, const wp::vec3 &x, float *best) {
    float far2[8], weight_b[8], weight_c[8], given2[8];
    each_lane([&](Lane lane) {
        auto corner = [&](int i) { return Points{lane.row(p, 3 * i), lane.row(p, 3 * i + 1), lane.row(p, 3 * i + 2)}; };
        Points a = corner(0), b = corner(1), c = corner(2);
        Point at = xyz(x);
        Points ab = b - a, ac = c - a, bc = c - b;
        Points ap = at - a, bp = at - b, cp = at - c;
        floats d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp);
        floats d5 = dot(ab, cp), d6 = dot(ac, cp);
        floats va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
        floats zero = (floats)(0.0f), one = (floats)(1.0f);
        floats of_all = one / (va + vb + vc);
        floats v = vb * of_all, w = vc * of_all;
        floats along_b = d4 - d3, along_c = d5 - d6;
        ints on_bc = (va <= 0.0f) & (along_b >= 0.0f) & (along_c >= 0.0f);
        floats f = along_b / (along_b + along_c);
        v = on_bc ? one - f : v;
        w = on_bc ? f : w;
        ints on_ac = (vb <= 0.0f) & (d2 >= 0.0f) & (d6 <= 0.0f);
        f = d2 / (d2 - d6);
        v = on_ac ? zero : v;
        w = on_ac ? f : w;
        ints at_c = (d6 >= 0.0f) & (d5 <= d6);
        v = at_c ? zero : v;
        w = at_c ? one : w;
        ints on_ab = (vc <= 0.0f) & (d1 >= 0.0f) & (d3 <= 0.0f);
        f = d1 / (d1 - d3);
        v = on_ab ? f : v;
        w = on_ab ? zero : w;
        ints at_b = (d3 >= 0.0f) & (d4 <= d3);
        v = at_b ? one : v;
        w = at_b ? zero : w;
        ints at_a = (d1 <= 0.0f) & (d2 <= 0.0f);
        v = at_a ? zero : v;
        w = at_a ? zero : w;
        floats u = one - v - w;
        w = one - u - v;
        auto squared = [&](floats u, floats v, floats w) {
            Points toward = u * a + v * b + w * c - at;
            return dot(toward, toward);
        };
        floats d2_here = squared(u, v, w);
        Points normal = cross(ab, ac);
        floats sides2 = dot(ab, ab) + dot(ac, ac) + dot(bc, bc);
        ints is_sliver = dot(normal, normal) < 1.0e-12f * sides2 * sides2;
        lane.put(far2, 0, is_sliver ? (floats)(1.0e38f) : d2_here);
        lane.put(weight_b, 0, v);
        lane.put(weight_c, 0, w);
        u = one - v - w;
        lane.put(given2, 0, squared(u, v, one - u - v));
        return 0;
    });
    int nearest = -1;
    for (int k = 0; k < count; ++k) {
        float slack = tie(best[0]);
        if (far2[k] <= best[0] + slack && given2[k] != best[3])
            best[4] = far2[k] < best[0] - slack ? 0.0f : 1.0f;
        if (far2[k] < best[0]) {
            best[0] = far2[k];
            best[1] = weight_b[k];
            best[2] = weight_c[k];
            best[3] = given2[k];
            nearest = k;
        }
    }
    return nearest;
}

// ------------------------------------------------------------------- balls, eight at a time

// 2 um: what all sums of one of these functions may round away.
R2H_FUNCTION float rounding() { return 2.0e-6f; }

// Bit i: whether near(lane, first) holds for entry i = first + lane of 0 .. count - 1 (1 to 64).
template <typename F> CUDA_CALLABLE inline bits64 each_entry(int count, F near) {
    bits64 found = 0;
    R2H_ROLLED
    for (int first = 0; first < count; first += 8)
        found |= (bits64)each_lane([&](Lane lane) { return lane.bits(near(lane, first)); }) << first;
    int none = 64 - count;
    return none > 0 ? (found << none) >> none : found;
}

R2H_FUNCTION floats unit_interval(floats s) {
    floats zero = (floats)(0.0f), one = (floats)(1.0f);
    return s < 0.0f ? zero : (s > 1.0f ? one : s);
}

// A segment with its direction u; inv is 1 / |u|^2, 0 for a point.
struct Segment {
    Point start, u;
    float inv;
    CUDA_CALLABLE inline floats nearest(const Points &from_start) const { return unit_interval(dot(from_start, u) * inv); }
};

R2H_FUNCTION Segment segment(const wp::vec3 &c0, const wp::vec3 &c1) {
    Point u = xyz(c1) - xyz(c0);
    float uu = dot(u, u);
    return {xyz(c0), u, uu > 0.0f ? 1.0f / uu : 0.0f};
}

// The squared distances of points from it.
R2H_FUNCTION floats squared_distance(const Segment &of, const Points &points) {
    Points x = points - of.start;
    x = x - of.nearest(x) * of.u;
    return dot(x, x);
}

// Balls within `cutoff` of the capsule c0-c1 of `radius`.
R2H_FUNCTION bits64 balls_within(const wp::vec3 *centers, const float *radii, int count, const wp::vec3 &c0,
                                 const wp::vec3 &c1, float radius, float cutoff) {
    Segment capsule = segment(c0, c1);
    float around = cutoff + radius + rounding();
    return each_entry(count, [&](Lane lane, int first) {
        floats far = around + lane.entries(radii, first, count);
        return (far > 0.0f) & (squared_distance(capsule, lane.entries(centers, first, count)) <= far * far);
    });
}

// Capsules within `cutoff` of the capsule c0-c1 of `radius`.
//
// The sums are those of `from_segment` (closest.py). It returns the distance of two points of
// the segments: where that is `cutoff` or more, so is this one, but for 10 um of rounding.
// Segments that are nearly parallel keep their bit: `from_segment` also looks at the ends there.
R2H_FUNCTION bits64 capsules_within(const wp::vec3 *ends0, const wp::vec3 *ends1, const float *radii, int count,
                                    const wp::vec3 &c0, const wp::vec3 &c1, float radius, float cutoff) {
    Point u = xyz(c1) - xyz(c0);
    float a = dot(u, u);
    float of_a = a > 1.0e-12f ? 1.0f / a : 0.0f;
    float around = cutoff + radius + 1.0e-5f;
    return each_entry(count, [&](Lane lane, int first) {
        floats zero = (floats)(0.0f), one = (floats)(1.0f);
        Points p = lane.entries(ends0, first, count);
        Points v = lane.entries(ends1, first, count) - p, r = xyz(c0) - p;
        floats b = dot(u, v), c = dot(u, r), e = dot(v, v), f = dot(v, r);
        floats denom = a * e - b * b;
        ints is_long = e > 1.0e-12f;
        ints turned = denom > 1.0e-9f * a * e;
        floats s_low = -c * of_a, s_high = (b - c) * of_a;
        floats s_in = (b * f - c * e) / (turned ? denom : one);
        s_in = unit_interval(turned ? s_in : zero);
        floats t = (b * s_in + f) / (is_long ? e : one);
        t = is_long ? t : zero;
        floats s = unit_interval(t > 1.0f ? s_high : s_low);
        ints within = (t >= 0.0f) & (t <= 1.0f) & is_long;
        s = within ? s_in : s;
        t = unit_interval(t);
        Points x = r + s * u - t * v;
        floats far = around + lane.entries(radii, first, count);
        ints within_reach = (far > 0.0f) & (dot(x, x) <= far * far);
        return within_reach | (denom < 1.0e-3f * a * e);
    });
}

// Balls that may come nearer than `target` to a capsule c0-c1 over an interval of its motion.
//
// Two bounds on the distance (plan/edge.py has the inequalities): the distance in the middle less
// `travel`, by which any point moves at most; and the way along n from the ball to the capsule to
// third order (`swept_capsule`, closest.py). With n = t / |t| from the ball's centre x to the
// nearest point of the segment and m = n x w, the ends of the interval have n . c +- m . c
// +- n . v at c = c0, c1, less the radius times |n +- m| = sqrt(1 + |m|^2) <= 1 + |m|^2 / 2,
// as m is square to n.
R2H_FUNCTION bits64 balls_near(const wp::vec3 *centers, const float *radii, int count, const wp::vec3 &c0,
                               const wp::vec3 &c1, float radius, float travel, const wp::vec3 &w, const wp::vec3 &v,
                               const wp::vec3 &a, const wp::vec3 &b, float second, float third, int moving,
                               float target, float tolerance) {
    Segment capsule = segment(c0, c1);
    Point start = xyz(c0), end = xyz(c1), spin = xyz(w), swing = xyz(a);
    float keep = target + rounding();
    float sweeps_from = moving != 0 ? keep + tolerance : 1.0e30f;
    return each_entry(count, [&](Lane lane, int first) {
        Points x = lane.entries(centers, first, count);
        floats r = lane.entries(radii, first, count);
        floats s = capsule.nearest(x - start);
        Points t = start + s * capsule.u - x;
        floats far = root(dot(t, t));
        floats apart = far - r - radius;
        floats least_far = (floats)(1.0e-12f);
        Points n = (1.0f / (far > 1.0e-12f ? far : least_far)) * t;
        Points m = cross(n, spin);
        // g . y + n . b: how fast a point y of the capsule accelerates along n
        Points g = {n.y * swing.z - n.z * swing.y + m.y * spin.z - m.z * spin.y,
                    n.z * swing.x - n.x * swing.z + m.z * spin.x - m.x * spin.z,
                    n.x * swing.y - n.y * swing.x + m.x * spin.y - m.y * spin.x};
        floats n0 = dot(n, start), n1 = dot(n, end), m0 = dot(m, start), m1 = dot(m, end);
        floats g0 = dot(g, start), g1 = dot(g, end), vn = dot(n, xyz(v));
        floats least = dot(n, xyz(b)) + (g0 < g1 ? g0 : g1);
        least = least - radius * root(dot(g, g));
        floats zero = (floats)(0.0f), half = (floats)(0.5f * second);
        floats rest = third / 6.0f - 0.5f * (least < 0.0f ? least : zero);
        rest = rest < half ? rest : half;
        floats to0 = n0 + m0 + vn, to1 = n1 + m1 + vn, from0 = n0 - m0 - vn, from1 = n1 - m1 - vn;
        floats to = to0 < to1 ? to0 : to1, from = from0 < from1 ? from0 : from1;
        floats low = (to < from ? to : from) - radius * (1.0f + 0.5f * dot(m, m));
        low = low - rest - dot(n, x) - r;
        ints by_travel = apart >= keep + travel;
        ints by_sweep = (apart > sweeps_from) & (low >= keep);
        return (by_travel | by_sweep) == 0;
    });
}

// The core of a primitive in its own frame, by its kind (geometry/shape.py): a sphere is a point, a
// capsule a segment of half length size[1], both grown by `radius`; a cylinder has radius size[0]
// and half length size[1], as has the cylinder that holds a robot's hull (kind 6); a box has half
// sides size.
R2H_FUNCTION bool is_box(int kind) { return kind == 3; }
R2H_FUNCTION bool is_cylinder(int kind) { return kind == 2 || kind == 6; }
R2H_FUNCTION float half_length(int kind, const wp::vec3 &size) { return kind == 0 ? 0.0f : size.c[1]; }

// |x|, |y|, |z| of points in the frame R, p.
R2H_FUNCTION Points folded(const Points &x, const wp::mat33 &R, const wp::vec3 &p) {
    Points c = x - xyz(p);
    auto along = [&](int i) {
        floats u = dot(Point{R.data[0][i], R.data[1][i], R.data[2][i]}, c);
        return u < 0.0f ? -u : u;
    };
    return {along(0), along(1), along(2)};
}

// Balls (rows: centre, radius) that may be within `limit` of a primitive at R, p and that do not
// lie behind the plane n . x = beyond - known, where the primitive has n . x <= known.
//
// The distance is that of `from_ball` (shape.py). It says nothing for a centre inside the
// primitive, so centres within 10 um count as near.
R2H_FUNCTION bits64 balls_in_reach(const wp::vec4 *balls, int count, int kind, const wp::vec3 &size, float radius,
                                   const wp::mat33 &R, const wp::vec3 &p, float limit, const wp::vec3 &n, float beyond,
                                   float known) {
    float half = half_length(kind, size);
    float plane = beyond - known - rounding(), around = limit + rounding();
    return each_entry(count, [&](Lane lane, int first) {
        floats zero = (floats)(0.0f), touching = (floats)(1.0e-5f);
        auto above = [&](const floats &x, float limit) { return x > limit ? x - limit : zero; };
        Balls ball = lane.entries(balls, first, count);
        ints behind = plane - dot(xyz(n), ball.center) >= ball.radius;
        Points c = folded(ball.center, R, p);
        floats far2;
        if (is_box(kind)) {
            floats dx = above(c.x, size.c[0]), dy = above(c.y, size.c[1]), dz = above(c.z, size.c[2]);
            far2 = dx * dx + dy * dy + dz * dz;
        } else if (is_cylinder(kind)) {
            floats dr = above(root(c.x * c.x + c.y * c.y), size.c[0]), dz = above(c.z, size.c[1]);
            far2 = dr * dr + dz * dz;
        } else {
            floats dz = above(c.z, half);
            floats far = above(root(c.x * c.x + c.y * c.y + dz * dz), radius);
            far2 = far * far;
        }
        floats cutoff = around + ball.radius;
        cutoff = cutoff > 1.0e-5f ? cutoff : touching;
        return (behind | (far2 >= cutoff * cutoff)) == 0;
    });
}

// The least of value(lane, first) over the entries first + lane of 0 .. count - 1, and the first entry
// that attains it.
struct Least {
    float value;
    int at;
};

template <typename F> CUDA_CALLABLE inline Least least_of(int count, F value) {
    Least least = {1.0e30f, 0};
    float found[8];
    for (int first = 0; first < count; first += 8) {
        each_lane([&](Lane lane) {
            lane.put(found, 0, value(lane, first));
            return 0;
        });
        for (int k = 0; k < 8; ++k) {
            least.at = found[k] < least.value ? first + k : least.at;
            least.value = found[k] < least.value ? found[k] : least.value;
        }
    }
    least.at = least.at < count ? least.at : count - 1;
    return least;
}

// The least distance of balls from the segment c0-c1 (negative where it enters one), and whose.
R2H_FUNCTION wp::vec2 nearest_ball(const wp::vec3 *centers, const float *radii, int count, const wp::vec3 &c0,
                                   const wp::vec3 &c1) {
    Segment axis = segment(c0, c1);
    Least least = least_of(count, [&](Lane lane, int first) {
        return root(squared_distance(axis, lane.entries(centers, first, count))) - lane.entries(radii, first, count);
    });
    return wp::vec2(least.value, (float)least.at);
}

// Which of the balls' centres is nearest to the core of a primitive at R, p.
R2H_FUNCTION int nearest_center(const wp::vec4 *balls, int count, int kind, const wp::vec3 &size, const wp::mat33 &R,
                                const wp::vec3 &p) {
    float half = half_length(kind, size);
    return least_of(count, [&](Lane lane, int first) {
        floats zero = (floats)(0.0f);
        Points c = folded(lane.entries(balls, first, count).center, R, p);
        Points d = c - xyz(size);
        if (!is_box(kind)) {
            floats ring = root(c.x * c.x + c.y * c.y);
            d = {is_cylinder(kind) ? ring - size.c[0] : ring, zero, c.z - half};
        }
        d = {d.x > 0.0f ? d.x : zero, d.y > 0.0f ? d.y : zero, d.z > 0.0f ? d.z : zero};
        return dot(d, d);
    }).at;
}

// ------------------------------------------------------------------------- support of hulls

// Of `count` points in blocks of 16 (16 x, then 16 y, then 16 z) the one farthest along d; of
// several the first. Each of 16 lanes keeps its largest product, then the largest of all counts.
// The last block repeats its last point, so a CPU may look at all of it. CUDA takes up to 16
// points one after the other: most cells of an object's hull have that few.
R2H_FUNCTION wp::vec3 farthest_in_blocks(const wp::vec3 *points, int count, const wp::vec3 &d) {
    const float *rows = &points[0].c[0];
    int blocks = (count + 15) / 16;
#if defined(R2H_VECTORS)
    typedef float floats16 __attribute__((ext_vector_type(16)));
    typedef int ints16 __attribute__((ext_vector_type(16)));
    const ints16 lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    floats16 best = (floats16)(-1.0e30f);
    ints16 at = lane;
    for (int block = 0; block < blocks; ++block) {
        floats16 x, y, z;
        __builtin_memcpy(&x, rows + 48 * block, sizeof(x));
        __builtin_memcpy(&y, rows + 48 * block + 16, sizeof(y));
        __builtin_memcpy(&z, rows + 48 * block + 32, sizeof(z));
        floats16 tx = x * d.c[0];
        floats16 ty = y * d.c[1];
        floats16 tz = z * d.c[2];
        floats16 t = tx + ty;
        t = t + tz;
        ints16 farther = t > best;
        at = farther ? lane + 16 * block : at;
        best = farther ? t : best;
    }
    auto of8 = best.hi > best.lo ? best.hi : best.lo;
    auto of4 = of8.hi > of8.lo ? of8.hi : of8.lo;
    auto of2 = of4.hi > of4.lo ? of4.hi : of4.lo;
    float most = of2.y > of2.x ? of2.y : of2.x;
    int first = __builtin_reduce_min(best == most ? at : (ints16)(1 << 30));
#else
    auto product = [&](int block, int k) {
        const float *x = rows + 48 * block + k;
        float tx = x[0] * d.c[0];
        float ty = x[16] * d.c[1];
        float tz = x[32] * d.c[2];
        float t = tx + ty;
        return t + tz;
    };
    float best[16];
    int at[16];
    for (int k = 0; k < 16; ++k) {
        best[k] = -1.0e30f;
        at[k] = k;
    }
    if (count <= 16) {
        R2H_ROLLED
        for (int k = 0; k < count; ++k) {
            float t = product(0, k);
            int farther = t > best[0];
            at[0] = farther ? k : at[0];
            best[0] = farther ? t : best[0];
        }
        blocks = 0;
    }
    for (int block = 0; block < blocks; ++block)
        for (int k = 0; k < 16; ++k) {
            float t = product(block, k);
            int farther = t > best[k];
            at[k] = farther ? 16 * block + k : at[k];
            best[k] = farther ? t : best[k];
        }
    for (int half = 8; half > 0; half >>= 1)
        for (int k = 0; k < half; ++k) {
            int farther = (best[k + half] > best[k]) | ((best[k + half] == best[k]) & (at[k + half] < at[k]));
            at[k] = farther ? at[k + half] : at[k];
            best[k] = farther ? best[k + half] : best[k];
        }
    int first = at[0];
#endif
    const float *p = rows + 48 * (first / 16) + first % 16;
    return wp::vec3(p[0], p[16], p[32]);
}

// The cell of a CELLS body (geometry/shape.py) that a direction falls into: the cube's face is that
// of the largest coordinate; u and v, the other two, are cut into 6 cells each.
R2H_FUNCTION int direction_cell(const wp::vec3 &d) {
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
}

// --------------------------------------------------------------------------- joint intervals

// sum_j |d_j| radius_j over the joints from `first_joint` on: how far a body's points move when
// these N joints turn by d (rad). Joints before it add zeros, which moves no bit.
template <int N> R2H_FUNCTION float motion(const float *radius, int first_joint, const float (&d)[N]) {
    float sum = 0.0f;
    R2H_UNROLLED
    for (int j = 0; j < N; ++j) {
        float turn = j < first_joint ? 0.0f : fabsf(d[j]);
        float t = turn * radius[j];
        sum = sum + t;
    }
    return sum;
}

// Bounds on the second and third derivative of a body's points along q + s d (`bends`,
// robot/world.py): sum_j (S_j^2 - S_(j-1)^2) radius_j and sum_j (S_j^3 - S_(j-1)^3) radius_j,
// S_j = |d_0| + .. + |d_j|.
template <int N> R2H_FUNCTION wp::vec2 bends(const float *radius, int first_joint, const float (&d)[N]) {
    float second = 0.0f, third = 0.0f, inner = 0.0f;
    R2H_UNROLLED
    for (int j = 0; j < N; ++j) {
        float outer = inner + (j < first_joint ? 0.0f : fabsf(d[j]));
        float outer2 = outer * outer, inner2 = inner * inner;
        float outer3 = outer2 * outer, inner3 = inner2 * inner;
        float of_pairs = outer2 - inner2, of_triples = outer3 - inner3;
        float s = of_pairs * radius[j], t = of_triples * radius[j];
        second = second + s;
        third = third + t;
        inner = outer;
    }
    return wp::vec2(second, third);
}

// ---------------------------------------------------------------- what differs by the device

// i, of which a compiler for CUDA knows nothing: it computes addresses from it where they are
// used. It would keep addresses that do not change in a loop in registers throughout the loop.
R2H_FUNCTION int opaque(int i) {
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+r"(i));
#endif
    return i;
}

R2H_FUNCTION int on_cuda() {
#if defined(__CUDA_ARCH__)
    return 1;
#else
    return 0;
#endif
}

} // namespace r2h

#endif // R2H_LANES_H
