// Damped least squares on an arm of N turning joints, in float32: `kernels/ik/any_arm.py` has the
// method. Loops over N and 6 are unrolled by the compiler, which Warp's are not.
//
// A frame is 12 numbers, the rows of [R | p]. A Jacobian J (6, N) has the velocity and the turn of
// the ee per joint rate. Sines and angles are those of geometry/angles.py.

#ifndef R2H_ARM_H
#define R2H_ARM_H

namespace r2h {

// Of J J^T, m^2: what keeps steps near singular postures bounded. Also the least pivot.
R2H_FUNCTION float least_damping() { return 1e-6f; }

R2H_FUNCTION void sine_and_cosine(float x, float &sine, float &cosine) {
    float turns = floorf(x * 0.6366197723675814f + 0.5f);
    float r = ((x - turns * 1.5703125f) - turns * 4.837512969970703125e-4f) - turns * 7.54978995489188216e-8f;
    float z = r * r;
    float s = ((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * r + r;
    float c = ((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z * z;
    c = c - 0.5f * z + 1.0f;
    int quarter = int(turns) & 3;
    sine = quarter & 1 ? c : s;
    cosine = quarter & 1 ? s : c;
    sine = quarter >= 2 ? -sine : sine;
    cosine = quarter == 1 || quarter == 2 ? -cosine : cosine;
}

// The angle of (x, y), y >= 0, from the x axis.
R2H_FUNCTION float angle_above(float y, float x) {
    float ax = x < 0.0f ? -x : x;
    float t = (ax < y ? ax : y) / (ax < y ? y : (ax > 1e-38f ? ax : 1e-38f));
    bool from_eighth = t > 0.41421356237309503f;
    t = from_eighth ? (t - 1.0f) / (t + 1.0f) : t;
    float z = t * t;
    float a = ((8.05374449538e-2f * z - 1.38776856032e-1f) * z + 1.99777106478e-1f) * z - 3.33329491539e-1f;
    a = a * z * t + t;
    a = from_eighth ? a + 0.7853981633974483f : a;
    a = y > ax ? 1.5707963267948966f - a : a;
    return x < 0.0f ? 3.141592653589793f - a : a;
}

// What is missing from frame `at` to frame `goal`: metres, and axis times angle of the rotation.
R2H_FUNCTION void missing(const float *goal, const float *at, float (&e)[6]) {
    float D[3][3];
    for (int i = 0; i < 3; ++i) {
        e[i] = goal[4 * i + 3] - at[4 * i + 3];
        for (int k = 0; k < 3; ++k)
            D[i][k] = goal[4 * i] * at[4 * k] + goal[4 * i + 1] * at[4 * k + 1] + goal[4 * i + 2] * at[4 * k + 2];
    }
    float x = 0.5f * (D[2][1] - D[1][2]), y = 0.5f * (D[0][2] - D[2][0]), z = 0.5f * (D[1][0] - D[0][1]);
    float sine = sqrtf(x * x + y * y + z * z), cosine = 0.5f * (D[0][0] + D[1][1] + D[2][2] - 1.0f);
    float scale = sine > 1e-4f ? angle_above(sine, cosine) / sine : 1.0f;
    bool half_turn = sine <= 1e-4f && cosine < 0.0f; // some axis
    e[3] = half_turn ? 3.1415927f : scale * x;
    e[4] = half_turn ? 0.0f : scale * y;
    e[5] = half_turn ? 0.0f : scale * z;
}

// The ee's frame and the Jacobian. `frames`: N + 1, each joint's in the link before, the ee's in the last.
template <int N>
R2H_FUNCTION void ee_and_jacobian(const float *frames, const float (&q)[N], float *ee, float (&J)[6][N]) {
    float T[12] = {1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f};
    for (int j = 0; j <= N; ++j) {
        const float *F = frames + 12 * j;
        float c = 1.0f, s = 0.0f;
        if (j < N)
            sine_and_cosine(q[j], s, c);
        for (int i = 0; i < 3; ++i) {
            float *t = T + 4 * i;
            float x = t[0] * F[0] + t[1] * F[4] + t[2] * F[8];
            float y = t[0] * F[1] + t[1] * F[5] + t[2] * F[9];
            float z = t[0] * F[2] + t[1] * F[6] + t[2] * F[10];
            t[3] += t[0] * F[3] + t[1] * F[7] + t[2] * F[11];
            t[0] = c * x + s * y;
            t[1] = c * y - s * x;
            t[2] = z;
            if (j < N) {
                J[i][j] = t[3]; // a point on the axis, until the ee is known
                J[3 + i][j] = z;
            }
        }
    }
    for (int j = 0; j < N; ++j) {
        float x = T[3] - J[0][j], y = T[7] - J[1][j], z = T[11] - J[2][j];
        J[0][j] = J[4][j] * z - J[5][j] * y;
        J[1][j] = J[5][j] * x - J[3][j] * z;
        J[2][j] = J[3][j] * y - J[4][j] * x;
    }
    for (int i = 0; i < 12; ++i)
        ee[i] = T[i];
}

// The step that moves the ee by e, and beside that the joints by `pull`: pull + J^T y, where
// (J J^T + damping 1) y = e - J pull. Joints that are not free (0, else 1) stay.
template <int N>
R2H_FUNCTION void damped_step(const float (&J)[6][N], const float (&free)[N], float damping, const float (&e)[6],
                              const float (&pull)[N], float (&d)[N]) {
    float A[6][6], y[6];
    for (int r = 0; r < 6; ++r) {
        float row[N];
        y[r] = e[r];
        for (int j = 0; j < N; ++j) {
            row[j] = free[j] * J[r][j];
            y[r] -= row[j] * pull[j];
        }
        for (int m = 0; m <= r; ++m) {
            float total = m == r ? damping : 0.0f;
            for (int j = 0; j < N; ++j)
                total += row[j] * J[m][j];
            A[r][m] = total;
        }
    }
    // L D L^T; the diagonal keeps 1 / D
    for (int i = 0; i < 6; ++i) {
        float inverse = 1.0f / (A[i][i] > least_damping() ? A[i][i] : least_damping());
        for (int r = i + 1; r < 6; ++r) {
            float f = A[r][i] * inverse;
            y[r] -= f * y[i];
            for (int m = i + 1; m <= r; ++m)
                A[r][m] -= f * A[m][i];
        }
        A[i][i] = inverse;
    }
    for (int i = 5; i >= 0; --i) {
        for (int r = i + 1; r < 6; ++r)
            y[i] -= A[r][i] * y[r];
        y[i] *= A[i][i];
    }
    for (int j = 0; j < N; ++j) {
        float total = pull[j];
        for (int r = 0; r < 6; ++r)
            total += J[r][j] * y[r];
        d[j] = free[j] * total;
    }
}

// Steps from posture q, which moves: how many until the error is below `near` (m and rad), `most` + 1 if
// that was not enough. J is the Jacobian at the posture that is left.
template <int N>
R2H_FUNCTION int descend(const float *frames, const float (&lower)[N], const float (&upper)[N], const float *goal,
                         int most, float near, float *posture, float *jacobian) {
    float(&q)[N] = *(float(*)[N])posture;
    float(&J)[6][N] = *(float(*)[6][N])jacobian;
    float free[N], none[N], d[N], ee[12], e[6];
    for (int j = 0; j < N; ++j) {
        free[j] = 1.0f;
        none[j] = 0.0f;
    }
    for (int step = 1;; ++step) {
        ee_and_jacobian<N>(frames, q, ee, J);
        missing(goal, ee, e);
        float size = e[0] * e[0] + e[1] * e[1] + e[2] * e[2] + e[3] * e[3] + e[4] * e[4] + e[5] * e[5];
        if (size < near * near)
            return step - 1;
        if (step > most)
            return step;
        damped_step<N>(J, free, 0.1f * size + least_damping(), e, none, d);
        for (int j = 0; j < N; ++j) {
            // the step itself where it is small, at most 1.8 rad
            float x = d[j] < -3.5f ? -3.5f : (d[j] > 3.5f ? 3.5f : d[j]);
            x = q[j] + x / (1.0f + x * x * 0.083333333f);
            bool above = x >= upper[j], below = x <= lower[j];
            // a joint that is pushed on at its limit leaves the Jacobian; every fourth step it is asked again
            bool held = (above && q[j] >= upper[j]) || (below && q[j] <= lower[j]);
            free[j] = step % 4 == 0 ? 1.0f : (held ? 0.0f : free[j]);
            q[j] = above ? upper[j] : (below ? lower[j] : x);
        }
    }
}

// Moves posture q once, within limits: the ee by e, the joints by as much of `pull` as leaves the ee where it
// is. The joint that moves farthest moves by `shortest` to `longest` (rad); returns by how much.
template <int N>
R2H_FUNCTION float move(const float (&lower)[N], const float (&upper)[N], const float *jacobian, const float (&e)[6],
                        const float (&pull)[N], float shortest, float longest, float *q) {
    float free[N], d[N], far = 1e-6f;
    for (int j = 0; j < N; ++j)
        free[j] = 1.0f;
    damped_step<N>(*(const float(*)[6][N])jacobian, free, least_damping(), e, pull, d);
    for (int j = 0; j < N; ++j)
        far = d[j] > far ? d[j] : (-d[j] > far ? -d[j] : far);
    float length = far < shortest ? shortest : (far > longest ? longest : far);
    for (int j = 0; j < N; ++j) {
        float x = q[j] + d[j] * (length / far);
        q[j] = x < lower[j] ? lower[j] : (x > upper[j] ? upper[j] : x);
    }
    return length;
}

} // namespace r2h

#endif
