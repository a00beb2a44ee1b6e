"""Which of up to 64 balls a capsule in motion may come near: one bit for each, all of them looked at at once.

Two bounds of what is left between a ball and the capsule over a stretch of motion q + s d, -1 <= s <= 1, of which the head of
plan/edge.py has the inequalities: as far as any of its points may travel; and along the way from the ball to the capsule, to
third order (`swept_capsule`). Here they are taken for all balls in one loop without branches.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


# In C++ for the reason given at `farthest_in_blocks` (body.py): ball by ball, as a loop over vec3, it was a fifth of a trial.
#
# With t the way from the ball's centre x to the nearest point of the segment, n = t / |t| and m = n x w: the capsule's ends
# c0, c1 give n . c +- m . c +- n . v at the stretch's two ends, less its radius times |n +- m|, which is
# sqrt(1 + |m|^2) <= 1 + |m|^2 / 2 as m is square to n. What is taken off for the rest is `swept_capsule`'s.
# 2 um are what all of it may round away.
@wp.func_native("""
    const float rounding = 2.0e-6f;
    const float* center = &centers.data[first].c[0];
    const float* ball = &radii.data[first];
    float ux = c1.c[0] - c0.c[0], uy = c1.c[1] - c0.c[1], uz = c1.c[2] - c0.c[2];
    float uu = ux * ux + uy * uy + uz * uz;
    float inv = uu > 0.0f ? 1.0f / uu : 0.0f;
    float wx = w.c[0], wy = w.c[1], wz = w.c[2];
    float keep = target + rounding;
    wp::uint64 found = 0;
    for (int block = 0; block < count; block += 8) {
        unsigned int near[8];
        for (int k = 0; k < 8; ++k) {
            int i = block + k < count ? block + k : count - 1;
            float x = center[3 * i], y = center[3 * i + 1], z = center[3 * i + 2], r = ball[i];
            float s = ((x - c0.c[0]) * ux + (y - c0.c[1]) * uy + (z - c0.c[2]) * uz) * inv;
            s = s < 0.0f ? 0.0f : (s > 1.0f ? 1.0f : s);
            float tx = c0.c[0] + s * ux - x, ty = c0.c[1] + s * uy - y, tz = c0.c[2] + s * uz - z;
            float far = sqrtf(tx * tx + ty * ty + tz * tz);
            float apart = far - r - radius;
            float over = 1.0f / (far > 1.0e-12f ? far : 1.0e-12f);
            float nx = tx * over, ny = ty * over, nz = tz * over;
            float mx = ny * wz - nz * wy, my = nz * wx - nx * wz, mz = nx * wy - ny * wx;
            float gx = ny * a.c[2] - nz * a.c[1] + my * wz - mz * wy;
            float gy = nz * a.c[0] - nx * a.c[2] + mz * wx - mx * wz;
            float gz = nx * a.c[1] - ny * a.c[0] + mx * wy - my * wx;
            float n0 = nx * c0.c[0] + ny * c0.c[1] + nz * c0.c[2];
            float n1 = nx * c1.c[0] + ny * c1.c[1] + nz * c1.c[2];
            float m0 = mx * c0.c[0] + my * c0.c[1] + mz * c0.c[2];
            float m1 = mx * c1.c[0] + my * c1.c[1] + mz * c1.c[2];
            float g0 = gx * c0.c[0] + gy * c0.c[1] + gz * c0.c[2];
            float g1 = gx * c1.c[0] + gy * c1.c[1] + gz * c1.c[2];
            float vn = nx * v.c[0] + ny * v.c[1] + nz * v.c[2];
            float least = nx * b.c[0] + ny * b.c[1] + nz * b.c[2] + (g0 < g1 ? g0 : g1);
            least = least - radius * sqrtf(gx * gx + gy * gy + gz * gz);
            float rest = third / 6.0f - 0.5f * (least < 0.0f ? least : 0.0f);
            rest = rest < 0.5f * second ? rest : 0.5f * second;
            float to0 = n0 + m0 + vn, to1 = n1 + m1 + vn, from0 = n0 - m0 - vn, from1 = n1 - m1 - vn;
            float to = to0 < to1 ? to0 : to1, from = from0 < from1 ? from0 : from1;
            float low = (to < from ? to : from) - radius * (1.0f + 0.5f * (mx * mx + my * my + mz * mz));
            low = low - rest - (nx * x + ny * y + nz * z) - r;
            int settled = (apart >= keep + travel) | ((moving != 0) & (apart > keep + tolerance) & (low >= keep));
            near[k] = settled ? 0u : 1u;
        }
        unsigned int bits = 0;
        for (int k = 0; k < 8; ++k)
            bits |= near[k] << k;
        found |= (wp::uint64)bits << block;
    }
    int none = 64 - count;
    return none > 0 ? (found << none) >> none : found;
""")
def balls_near(
    centers: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), first: int, count: int,
    c0: wp.vec3, c1: wp.vec3, radius: float, travel: float,
    w: wp.vec3, v: wp.vec3, a: wp.vec3, b: wp.vec3, second: float, third: float, moving: int,
    target: float, tolerance: float,
) -> wp.uint64:  # fmt: skip
    """Bit i is unset where ball first + i (1 to 64 of them) keeps `target` (m) to the capsule c0-c1 over the whole stretch.

    The capsule as a `Mover` has it (plan/partners.py). A ball within target + tolerance in the stretch's middle keeps its bit
    unless the levers alone settle it.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffsll((long long)bits) - 1;
#else
    return __builtin_ctzll(bits);
#endif
""")
def lowest_bit(bits: wp.uint64) -> int:
    """The number of the lowest bit that is set; some bit is."""
    ...


@wp.func_native("""
    const float* center = &centers.data[first].c[0];
    const float* ball = &radii.data[first];
    float ux = c1.c[0] - c0.c[0], uy = c1.c[1] - c0.c[1], uz = c1.c[2] - c0.c[2];
    float uu = ux * ux + uy * uy + uz * uz;
    float inv = uu > 0.0f ? 1.0f / uu : 0.0f;
    float least = 1.0e30f;
    int at = 0;
    for (int block = 0; block < count; block += 8) {
        float gap[8];
        for (int k = 0; k < 8; ++k) {
            int i = block + k < count ? block + k : count - 1;
            float x = center[3 * i] - c0.c[0], y = center[3 * i + 1] - c0.c[1], z = center[3 * i + 2] - c0.c[2];
            float s = (x * ux + y * uy + z * uz) * inv;
            s = s < 0.0f ? 0.0f : (s > 1.0f ? 1.0f : s);
            x = x - s * ux;
            y = y - s * uy;
            z = z - s * uz;
            gap[k] = sqrtf(x * x + y * y + z * z) - ball[i];
        }
        for (int k = 0; k < 8; ++k) {
            at = gap[k] < least ? block + k : at;
            least = gap[k] < least ? gap[k] : least;
        }
    }
    return wp::vec2(least, (float)(at < count ? at : count - 1));
""")
def nearest_ball(
    centers: wp.array(dtype=wp.vec3), radii: wp.array(dtype=float), first: int, count: int, c0: wp.vec3, c1: wp.vec3
) -> wp.vec2:  # fmt: skip
    """The least distance of `count` balls from the segment c0-c1 (m; negative where it enters one), and whose it is."""
    ...


@wp.func_native("""
    const float* rows = &balls.data[first].c[0];
    float sx = size.c[0], sy = size.c[1], sz = size.c[2];
    float half = kind == 0 ? 0.0f : sy;
    float least = 1.0e30f;
    int at = 0;
    for (int block = 0; block < count; block += 8) {
        float far2[8];
        for (int k = 0; k < 8; ++k) {
            const float* q = rows + 4 * (block + k < count ? block + k : count - 1);
            float cx = q[0] - p.c[0], cy = q[1] - p.c[1], cz = q[2] - p.c[2];
            float x = fabsf(R.data[0][0] * cx + R.data[1][0] * cy + R.data[2][0] * cz);
            float y = fabsf(R.data[0][1] * cx + R.data[1][1] * cy + R.data[2][1] * cz);
            float z = fabsf(R.data[0][2] * cx + R.data[1][2] * cy + R.data[2][2] * cz);
            float dx = x - sx, dy = y - sy, dz = z - sz;
            if (kind != 3) {
                dx = sqrtf(x * x + y * y);
                dy = 0.0f;
                dz = z - half;
                if (kind == 2)
                    dx = dx - sx;
            }
            dx = dx > 0.0f ? dx : 0.0f;
            dy = dy > 0.0f ? dy : 0.0f;
            dz = dz > 0.0f ? dz : 0.0f;
            far2[k] = dx * dx + dy * dy + dz * dz;
        }
        for (int k = 0; k < 8; ++k) {
            at = far2[k] < least ? block + k : at;
            least = far2[k] < least ? far2[k] : least;
        }
    }
    return at < count ? at : count - 1;
""")
def nearest_center(
    balls: wp.array(dtype=wp.vec4), first: int, count: int, kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3
) -> int:
    """Which of `count` balls' centres is nearest to a primitive's core at R, p. kind, size: those of a Body but a hull."""
    ...
