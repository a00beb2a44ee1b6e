"""Which branches of a UR arm's inverse kinematics exist: the closed form in float64, without trigonometry."""

import warp as wp

from r2h_batch.kernels.ik.wrist_center import arm_state, elbow_reach, shoulder_turn
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import UrParameters, to_shoulder, vec12d

wp.set_module_options(OPTIONS)

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
def wrist_angle(ur: UrParameters, r: wp.float64, rho: wp.float64, height: wp.float64, s5: wp.float64, z_ee: wp.vec3d):
    """NO_BRANCH, BRANCH or BRANCH_EDGE, and cos, sin of psi3, away from the singular set: u(psi3) is z_ee's part in the plane."""
    found = wp.int32(NO_BRANCH)
    c3 = z_ee[0] / s5
    s3 = -z_ee[2] / s5
    beyond = elbow_reach(ur, rho + ur.d5 * s3, height + ur.d5 * c3)
    if beyond <= ZERO and r >= ur.d4:
        found = wp.int32(BRANCH)
    elif beyond > SLACK_M:
        # Turning psi3 by SLACK_RAD / |sin q5| turns the hand by no more than SLACK_RAD: does that help? The links' end
        # lies d5 from (rho, height), at the angle of psi3: nearest to the shoulder, or farthest, on the line through both.
        d = wp.sqrt(rho * rho + height * height)
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
    return found, c3, s3


@wp.func
def free_wrist_angle(
    ur: UrParameters, rho: wp.float64, height: wp.float64, wrist: wp.float64, x_ee: wp.vec3d, y_ee: wp.vec3d
):
    """NO_BRANCH or BRANCH_LINE, and cos, sin of the first psi3 of three that the elbow allows, where psi3 is free.

    First the one with q6 = home (or home + pi), then the two ends of the line: those that bring the links' end nearest to
    the shoulder, or take it farthest.
    """
    found = wp.int32(NO_BRANCH)
    c3 = ONE
    s3 = ZERO
    d = wp.sqrt(rho * rho + height * height)
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
    return found, c3, s3


@wp.func
def closed_form(ur: UrParameters, R: wp.mat33d, p5: wp.vec3d, shoulder: wp.float64, wrist: wp.float64):
    """The state with sin q3 >= 0 of one (shoulder, wrist) pair, and NO_BRANCH, BRANCH, BRANCH_LINE or BRANCH_EDGE."""
    state = vec12d()
    found = wp.int32(NO_BRANCH)
    r = wp.sqrt(p5[0] * p5[0] + p5[1] * p5[1])
    if r >= ur.d4 - SLACK_M:
        c1, s1, rho = shoulder_turn(ur, p5, shoulder)
        x_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 0], R[1, 0], R[2, 0]))
        y_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 1], R[1, 1], R[2, 1]))
        z_ee = to_shoulder(c1, s1, wp.vec3d(R[0, 2], R[1, 2], R[2, 2]))
        # q5 and psi3: z_ee = sin q5 u(psi3) + cos q5 n.
        c5 = z_ee[1]
        s5 = wrist * wp.sqrt(z_ee[0] * z_ee[0] + z_ee[2] * z_ee[2])
        height = p5[2] - ur.d1
        c3 = ONE
        s3 = ZERO
        if wp.abs(s5) > SINGULAR_SIN:
            found, c3, s3 = wrist_angle(ur, r, rho, height, s5, z_ee)
        else:
            s5 = ZERO
            c5 = wp.sign(c5)
            found, c3, s3 = free_wrist_angle(ur, rho, height, wrist, x_ee, y_ee)
        if found != NO_BRANCH:
            x = rho + ur.d5 * s3
            z = height + ur.d5 * c3
            state = arm_state(ur, c1, s1, x, z, c3, s3, c5, s5, x_ee, y_ee)
    return state, found


@wp.func
def other_elbow(ur: UrParameters, s: vec12d) -> vec12d:
    """The same pose with the elbow on the other side: both links mirrored at the line from shoulder to wrist 1."""
    # mirrored at a line of angle phi, psi becomes 2 phi - psi: c, m are cos 2 phi, sin 2 phi
    d_x = ur.a2 * s[2] + ur.a3 * s[4]
    d_y = ur.a2 * s[3] + ur.a3 * s[5]
    k = ONE / (d_x * d_x + d_y * d_y)
    c = (d_x * d_x - d_y * d_y) * k
    m = wp.float64(2.0) * d_x * d_y * k
    return vec12d(
        s[0], s[1], c * s[2] + m * s[3], m * s[2] - c * s[3], c * s[4] + m * s[5], m * s[4] - c * s[5],
        s[6], s[7], s[8], s[9], s[10], s[11],
    )  # fmt: skip
