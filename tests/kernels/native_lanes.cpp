// The functions of kernels/native/lanes.h without Warp: test_lanes.py builds this as a library and compares it with its kernel.
// GCC builds the form that CUDA runs, one lane at a time.

#include <math.h>

namespace wp {
struct vec2 { float c[2]; vec2(float x, float y) : c{x, y} {} };
struct vec3 { float c[3]; vec3(float x, float y, float z) : c{x, y, z} {} };
struct vec4 { float c[4]; };
struct mat33 { float data[3][3]; };
} // namespace wp

#include "lanes.h"

extern "C" void ask(int rows, float half_x, float half_z, float reach, const float *leaf, const float *triangle,
                    const int *members, const wp::mat33 *R_in, const wp::vec3 *t_in, const wp::vec3 *low,
                    const wp::vec3 *high, const float *run_low, const float *run_high, int runs, const wp::vec3 *center,
                    const float *radius, int balls, int *found_out, int *near_out, float *cut_out) {
    for (int i = 0; i < rows; ++i) {
        const wp::mat33 &R = R_in[i];
        const wp::vec3 &t = t_in[i];
        wp::vec3 rx(R.data[0][0], R.data[0][1], R.data[0][2]), ry(R.data[1][0], R.data[1][1], R.data[1][2]);
        wp::vec3 rz(R.data[2][0], R.data[2][1], R.data[2][2]);
        const float *a = leaf + 56 * i, *b = triangle + 72 * i;
        int n = members[i], *found = found_out + 11 * i, *near = near_out + 16 * i;
        float corners[72], span[16];
        found[0] = r2h::boxes_in_prism(a, n, rx, rz, t.c[0], t.c[2], 0.0f, half_x, 0.0f, half_z);
        found[1] = r2h::triangles_in_prism(b, n, rx, rz, t.c[0], t.c[2], -half_x, half_x, -half_z, half_z);
        r2h::boxes_along(a, ry, t.c[1], span);
        found[2] = r2h::outside_runs(span, 255, 0.0f, run_low, run_high, runs);
        found[9] = r2h::leaf_in_prism(b, n, R, t, half_x, -half_z, half_z, corners, span);
        found[3] = r2h::outside_runs(span, 255, 0.0f, run_low, run_high, runs);
        found[10] = r2h::cut_to_prism(corners, 254, half_x, -half_z, half_z, cut_out + 16 * i);
        found[4] = r2h::boxes_near(a, n, R, t, reach, low, high, 5, near);
        found[5] = r2h::points_near(a, n, R, t, reach, low, high, 5, near + 8);
        found[6] = r2h::triangles_near(b, n, R, t, high[2], reach);
        found[7] = (int)r2h::balls_within(center, radius, balls, low[0], high[0], t.c[1] * t.c[1], reach);
        wp::vec3 p = r2h::lane_point(b + 24, r2h::first_lane(1 << (i % 8)));
        found[8] = p.c[2] == b[40 + i % 8];
    }
}
