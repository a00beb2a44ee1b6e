"""Which of up to 64 balls a primitive may reach, or that lie on this side of a plane: all of them looked at at once."""

import warp as wp

from r2h_batch.kernels.geometry.lanes import over_lanes
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


# In C++ for the reason given at `farthest_in_blocks` (body.py): face by face it was a third of what Safe asks of a posture.
# From the ball's centre, in the primitive's frame, to what `from_ball` calls its nearest point: a box by its half sides, a
# cylinder by its radius and half length, else a segment and a radius. 2 um are what all of it may round away; a centre
# within 10 um of the primitive may as well be in it, where this distance says nothing.
@wp.func_native(
    over_lanes("""
    const float* rows = &balls.data[first].c[0];
    float sx = size.c[0], sy = size.c[1], sz = size.c[2];
    float half = kind == 0 ? 0.0f : sy;
    float plane = beyond - known - 2.0e-6f, around = limit + 2.0e-6f;
    wp::uint64 found = 0;
    for (int block = 0; block < count; block += 8) {
        float x[8], y[8], z[8], r[8], far2[8];
        unsigned int near[8];
        float copy[32];
        const float* eight = rows + 4 * block;
        if (block + 8 > count) {
            for (int k = 0; k < 32; ++k)
                copy[k] = rows[4 * (block + k / 4 < count ? block + k / 4 : count - 1) + k % 4];
            eight = copy;
        }
        for (int k = 0; k < 8; ++k) {
            float cx = eight[4 * k], cy = eight[4 * k + 1], cz = eight[4 * k + 2];
            r[k] = eight[4 * k + 3];
            near[k] = plane - (n.c[0] * cx + n.c[1] * cy + n.c[2] * cz) >= r[k] ? 0u : 1u;
            cx = cx - p.c[0];
            cy = cy - p.c[1];
            cz = cz - p.c[2];
            x[k] = fabsf(R.data[0][0] * cx + R.data[1][0] * cy + R.data[2][0] * cz);
            y[k] = fabsf(R.data[0][1] * cx + R.data[1][1] * cy + R.data[2][1] * cz);
            z[k] = fabsf(R.data[0][2] * cx + R.data[1][2] * cy + R.data[2][2] * cz);
        }
        if (kind == 3) {
            for (int k = 0; k < 8; ++k) {
                float dx = x[k] > sx ? x[k] - sx : 0.0f, dy = y[k] > sy ? y[k] - sy : 0.0f;
                float dz = z[k] > sz ? z[k] - sz : 0.0f;
                far2[k] = dx * dx + dy * dy + dz * dz;
            }
        } else if (kind == 2) {
            for (int k = 0; k < 8; ++k) {
                float ring = sqrtf(x[k] * x[k] + y[k] * y[k]);
                float dr = ring > sx ? ring - sx : 0.0f, dz = z[k] > sy ? z[k] - sy : 0.0f;
                far2[k] = dr * dr + dz * dz;
            }
        } else {
            for (int k = 0; k < 8; ++k) {
                float dz = z[k] > half ? z[k] - half : 0.0f;
                float far = sqrtf(x[k] * x[k] + y[k] * y[k] + dz * dz);
                far = far > radius ? far - radius : 0.0f;
                far2[k] = far * far;
            }
        }
        unsigned int bits = 0;
        for (int k = 0; k < 8; ++k) {
            float reach = around + r[k];
            reach = reach > 1.0e-5f ? reach : 1.0e-5f;
            near[k] &= far2[k] >= reach * reach ? 0u : 1u;
        }
        for (int k = 0; k < 8; ++k)
            bits |= near[k] << k;
        found |= (wp::uint64)bits << block;
    }
    int none = 64 - count;
    return none > 0 ? (found << none) >> none : found;
""")
)
def balls_in_reach(
    balls: wp.array(dtype=wp.vec4), first: int, count: int, kind: int, size: wp.vec3, radius: float, R: wp.mat33,
    p: wp.vec3, limit: float, n: wp.vec3, beyond: float, known: float,
) -> wp.uint64:  # fmt: skip
    """Bit i is unset where ball first + i (1 to 64; centre, radius) is `limit` (m) or more from a primitive at R, p.

    Or where all x of it have n . x at most `beyond` - `known`. kind, size, radius: those of a Body (body.py) but a hull.
    """
    ...
