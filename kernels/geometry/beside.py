"""Which of up to 64 balls or capsules may lie beside a capsule: one bit for each, all of them looked at at once."""

import warp as wp

from r2h_batch.kernels.geometry.lanes import over_lanes
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


# In C++ for the reason given at `farthest_in_blocks` (body.py): ball by ball a posture asks it of each of its bodies.
# 2 um are what all of it may round away.
@wp.func_native(
    over_lanes("""
    const float* center = &centers.data[first].c[0];
    const float* ball = &radii.data[first];
    float ux = c1.c[0] - c0.c[0], uy = c1.c[1] - c0.c[1], uz = c1.c[2] - c0.c[2];
    float uu = ux * ux + uy * uy + uz * uz;
    float inv = uu > 0.0f ? 1.0f / uu : 0.0f;
    float around = reach + radius + 2.0e-6f;
    wp::uint64 found = 0;
    for (int block = 0; block < count; block += 8) {
        unsigned int near[8];
        for (int k = 0; k < 8; ++k) {
            int i = block + k < count ? block + k : count - 1;
            float x = center[3 * i] - c0.c[0], y = center[3 * i + 1] - c0.c[1], z = center[3 * i + 2] - c0.c[2];
            float s = (x * ux + y * uy + z * uz) * inv;
            s = s < 0.0f ? 0.0f : (s > 1.0f ? 1.0f : s);
            x = x - s * ux;
            y = y - s * uy;
            z = z - s * uz;
            float far = around + ball[i];
            near[k] = ((far > 0.0f) & (x * x + y * y + z * z <= far * far)) ? 1u : 0u;
        }
        unsigned int bits = 0;
        for (int k = 0; k < 8; ++k)
            bits |= near[k] << k;
        found |= (wp::uint64)bits << block;
    }
    int none = 64 - count;
    return none > 0 ? (found << none) >> none : found;
""")
)
def balls_beside(
    centers: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), first: int, count: int,
    c0: wp.vec3, c1: wp.vec3, radius: float, reach: float,
) -> wp.uint64:  # fmt: skip
    """Bit i is unset where ball first + i (1 to 64 of them) is farther than `reach` (m) from the capsule c0-c1 of `radius`."""
    ...


# The same sums as in `from_segment` (segments.py), whose answer is the distance of two points of the segments: where its own
# would be `reach` or more, so is this one, but for what 10 um allow. Segments that are nearly parallel keep their bit: there
# `from_segment` looks at the ends too.
@wp.func_native(
    over_lanes("""
    const float* first_end = &ends0.data[0].c[0];
    const float* second_end = &ends1.data[0].c[0];
    float ux = c1.c[0] - c0.c[0], uy = c1.c[1] - c0.c[1], uz = c1.c[2] - c0.c[2];
    float a = ux * ux + uy * uy + uz * uz;
    float of_a = a > 1.0e-12f ? 1.0f / a : 0.0f;
    float around = reach + radius + 1.0e-5f;
    wp::uint64 found = 0;
    for (int block = 0; block < count; block += 8) {
        unsigned int near[8];
        for (int k = 0; k < 8; ++k) {
            int i = block + k < count ? block + k : count - 1;
            float px = first_end[3 * i], py = first_end[3 * i + 1], pz = first_end[3 * i + 2];
            float vx = second_end[3 * i] - px, vy = second_end[3 * i + 1] - py, vz = second_end[3 * i + 2] - pz;
            float rx = c0.c[0] - px, ry = c0.c[1] - py, rz = c0.c[2] - pz;
            float e = vx * vx + vy * vy + vz * vz;
            float f = vx * rx + vy * ry + vz * rz;
            float c = ux * rx + uy * ry + uz * rz;
            float b = ux * vx + uy * vy + uz * vz;
            float denom = a * e - b * b;
            int is_long = e > 1.0e-12f;
            int turned = denom > 1.0e-9f * a * e;
            float s_low = -c * of_a, s_high = (b - c) * of_a;
            float s_in = (b * f - c * e) / (turned ? denom : 1.0f);
            s_in = turned ? s_in : 0.0f;
            s_in = s_in < 0.0f ? 0.0f : (s_in > 1.0f ? 1.0f : s_in);
            float t = (b * s_in + f) / (is_long ? e : 1.0f);
            t = is_long ? t : 0.0f;
            float s = t > 1.0f ? s_high : s_low;
            s = s < 0.0f ? 0.0f : (s > 1.0f ? 1.0f : s);
            int within = (t >= 0.0f) & (t <= 1.0f) & is_long;
            s = within ? s_in : s;
            t = t < 0.0f ? 0.0f : (t > 1.0f ? 1.0f : t);
            float x = rx + s * ux - t * vx, y = ry + s * uy - t * vy, z = rz + s * uz - t * vz;
            float far = around + radii.data[i];
            int beside = (far > 0.0f) & (x * x + y * y + z * z <= far * far);
            near[k] = (beside | (denom < 1.0e-3f * a * e)) ? 1u : 0u;
        }
        unsigned int bits = 0;
        for (int k = 0; k < 8; ++k)
            bits |= near[k] << k;
        found |= (wp::uint64)bits << block;
    }
    int none = 64 - count;
    return none > 0 ? (found << none) >> none : found;
""")
)
def capsules_beside(
    ends0: wp.array(dtype=wp.vec3), ends1: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), count: int,
    c0: wp.vec3, c1: wp.vec3, radius: float, reach: float,
) -> wp.uint64:  # fmt: skip
    """Bit i is unset where capsule i of the first `count` (1 to 64) is farther than `reach` (m) from the capsule c0-c1."""
    ...
