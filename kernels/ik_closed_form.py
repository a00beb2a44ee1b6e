"""Which branches of a UR arm's inverse kinematics exist: the closed form in float64, without trigonometry."""

import warp as wp

from r2h_batch.kernels.fk import UrParameters, to_shoulder, vec12d

wp.set_module_options({"enable_backward": False})

NO_BRANCH = wp.constant(0)
BRANCH = wp.constant(1)
BRANCH_LINE = wp.constant(2)  # sin q5 = 0: q4 and q6 turn the same way, one line of solutions instead of two points
BRANCH_EDGE = wp.constant(3)  # not for this pose, but for one within the slack: float32 targets are rounded

SLACK_M = wp.constant(wp.float64(1e-6))
SLACK_RAD = wp.constant(wp.float64(1e-6))
SINGULAR_SIN = wp.constant(wp.float64(1e-6))  # |sin q5| below which it counts as 0: far below the rotation tolerance
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))


@wp.func
def elbow_reach(ur: UrParameters, x: wp.float64, z: wp.float64) -> wp.float64:
    """How far (x, z) in the arm's plane, from the shoulder, lies beyond what both links reach; <= 0 within. m"""
    d = wp.sqrt(x * x + z * z)
    return wp.max(d - ur.a2 - ur.a3, wp.abs(ur.a2 - ur.a3) - d)


@wp.func
def closed_form(ur: UrParameters, R: wp.mat33d, p5: wp.vec3d, shoulder: wp.float64, wrist: wp.float64):
    """The state with sin q3 >= 0 of one (shoulder, wrist) pair, and NO_BRANCH, BRANCH, BRANCH_LINE or BRANCH_EDGE."""
    state = vec12d()
    found = wp.int32(NO_BRANCH)
    r_sq = p5[0] * p5[0] + p5[1] * p5[1]
    r = wp.sqrt(r_sq)
    if r >= ur.d4 - SLACK_M:
        # q1: the wrist centre lies d4 off the arm's plane.
        rho = shoulder * wp.sqrt(wp.max(r_sq - ur.d4 * ur.d4, ZERO))
        c1 = p5[0] * rho + p5[1] * ur.d4
        s1 = p5[1] * rho - p5[0] * ur.d4
        scale = ONE / wp.sqrt(c1 * c1 + s1 * s1)
        c1 = c1 * scale
        s1 = s1 * scale
        x_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 0], R[1, 0], R[2, 0]))
        y_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 1], R[1, 1], R[2, 1]))
        z_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 2], R[1, 2], R[2, 2]))
        # q5 and psi3: z_ee = sin q5 u(psi3) + cos q5 n.
        c5 = z_ee[1]
        s5 = wrist * wp.sqrt(z_ee[0] * z_ee[0] + z_ee[2] * z_ee[2])
        height = p5[2] - ur.d1
        c3 = ONE
        s3 = ZERO
        d = wp.sqrt(rho * rho + height * height)
        if wp.abs(s5) > SINGULAR_SIN:
            c3 = z_ee[0] / s5
            s3 = -z_ee[2] / s5
            beyond = elbow_reach(ur, rho + ur.d5 * s3, height + ur.d5 * c3)
            if beyond <= ZERO and r >= ur.d4:
                found = wp.int32(BRANCH)
            elif beyond > SLACK_M:
                # Turning psi3 by SLACK_RAD / |sin q5| turns the hand by no more than SLACK_RAD: does that help?
                away = wp.sign(d - wp.abs(ur.a2 - ur.a3) - ur.d5)
                t_s = -away * rho / d
                t_c = -away * height / d
                limit = SLACK_RAD / wp.abs(s5)
                by = wp.clamp(wp.atan2(t_s * c3 - t_c * s3, t_c * c3 + t_s * s3), -limit, limit)
                turned_c = c3 * wp.cos(by) - s3 * wp.sin(by)
                s3 = s3 * wp.cos(by) + c3 * wp.sin(by)
                c3 = turned_c
                beyond = elbow_reach(ur, rho + ur.d5 * s3, height + ur.d5 * c3)
            if found == NO_BRANCH and beyond <= SLACK_M:
                found = wp.int32(BRANCH_EDGE)
        else:
            # psi3 is free. First q6 = home (or home + pi), else the end of the line that brings the elbow nearest.
            s5 = ZERO
            c5 = wp.sign(c5)
            c6 = wrist * wp.cos(ur.home[5])
            s6 = wrist * wp.sin(ur.home[5])
            w_x = -s6 * x_ee[0] - c6 * y_ee[0]
            w_z = -s6 * x_ee[2] - c6 * y_ee[2]
            for attempt in range(3):
                if found == NO_BRANCH:
                    if attempt > 0:
                        away = wrist
                        if attempt == 2:
                            away = -wrist
                        w_x = away * rho / d
                        w_z = away * height / d
                    length = wp.sqrt(w_x * w_x + w_z * w_z)
                    s3 = -w_x / length
                    c3 = -w_z / length
                    if elbow_reach(ur, rho + ur.d5 * s3, height + ur.d5 * c3) <= SLACK_M:
                        found = wp.int32(BRANCH_LINE)
        if found != NO_BRANCH:
            # The elbow triangle; as complex numbers x + i z a link of angle psi is exp(-i psi).
            x = rho + ur.d5 * s3
            z = height + ur.d5 * c3
            d_sq = x * x + z * z
            cq3 = (d_sq - ur.a2 * ur.a2 - ur.a3 * ur.a3) / (wp.float64(2.0) * ur.a2 * ur.a3)
            cq3 = wp.clamp(cq3, -ONE, ONE)
            sq3 = wp.sqrt(ONE - cq3 * cq3)
            e_x = ur.a2 + ur.a3 * cq3
            e_z = -ur.a3 * sq3
            k = ONE / wp.sqrt((e_x * e_x + e_z * e_z) * d_sq)
            cp1 = (x * e_x + z * e_z) * k
            sp1 = (x * e_z - z * e_x) * k
            s6 = s3 * x_ee[0] + c3 * x_ee[2]
            c6 = s3 * y_ee[0] + c3 * y_ee[2]
            k6 = ONE / wp.sqrt(s6 * s6 + c6 * c6)
            state = vec12d(
                c1, s1, cp1, sp1, cp1 * cq3 - sp1 * sq3, sp1 * cq3 + cp1 * sq3, c3, s3, c5, s5, c6 * k6, s6 * k6
            )  # fmt: skip
    return state, found


@wp.func
def other_elbow(ur: UrParameters, s: vec12d) -> vec12d:
    """The same pose with the elbow on the other side: both links mirrored at the line from shoulder to wrist 1."""
    d_x = ur.a2 * s[2] + ur.a3 * s[4]
    d_y = ur.a2 * s[3] + ur.a3 * s[5]
    k = ONE / (d_x * d_x + d_y * d_y)
    c = (d_x * d_x - d_y * d_y) * k
    m = wp.float64(2.0) * d_x * d_y * k
    return vec12d(
        s[0], s[1], c * s[2] + m * s[3], m * s[2] - c * s[3], c * s[4] + m * s[5], m * s[4] - c * s[5],
        s[6], s[7], s[8], s[9], s[10], s[11],
    )  # fmt: skip
