"""Which of 32 balls may lie beside a capsule: one bit for each, all of them looked at at once."""

import warp as wp

from r2h_batch.kernels.geometry.lanes import over_lanes
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

BESIDE = wp.constant(32)


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
    unsigned int found = 0;
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
        found |= bits << block;
    }
    return (int)(count < 32 ? found & ((1u << count) - 1u) : found);
""")
)
def balls_beside(
    centers: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), first: int, count: int,
    c0: wp.vec3, c1: wp.vec3, radius: float, reach: float,
) -> int:  # fmt: skip
    """Bit i is unset where ball first + i (1 to 32 of them) is farther than `reach` (m) from the capsule c0-c1 of `radius`."""
    ...
