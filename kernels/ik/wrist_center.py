"""From a UR arm's wrist centre to its posture: what closed_form.py and nearest.py share.

Three steps in the notation of robot/fk.py, as in Hawkins 2013 (Analytic inverse kinematics for the Universal Robots
UR-5/UR-10 arms), written with cosines and sines instead of angles:
  q1    the wrist centre lies d4 beside the arm's plane: seen from above it is (rho, d4) turned by q1, so
        rho^2 = |p5|^2 - d4^2 (horizontal parts) and (cos q1, sin q1) ~ (x rho + y d4, y rho - x d4);
        the sign of rho is the shoulder's side.
  elbow once psi3 is known, p5 - d5 w(psi3) is the end of the two links a2, a3: law of cosines for q3, then psi1 turns
        a2 u(0) + a3 u(q3) to there. Of +-q3 this is the one with sin q3 >= 0; closed_form.other_elbow makes the other.
  q6    w(psi3), the axis of joint 5, has the ee coordinates -(sin q6, cos q6, 0).
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import UrParameters, vec12d

wp.set_module_options(OPTIONS)

ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
TINY = wp.constant(wp.float64(1e-12))


@wp.func
def orthonormal(y: wp.vec3d, z: wp.vec3d) -> wp.mat33d:
    """The rotation whose third column is along z and whose second is as near to y as that allows."""
    z = wp.normalize(z)
    y = wp.normalize(y - wp.dot(y, z) * z)
    x = wp.cross(y, z)
    return wp.mat33d(x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2])


@wp.func
def shoulder_turn(ur: UrParameters, p5: wp.vec3d, shoulder: wp.float64):
    """cos q1, sin q1 and rho, the signed distance (m) from joint 1's axis at which the arm's plane has the wrist centre.

    A wrist centre nearer to that axis than d4 gives rho = 0; on the axis itself all q1 are as good.
    """
    rho = shoulder * wp.sqrt(wp.max(p5[0] * p5[0] + p5[1] * p5[1] - ur.d4 * ur.d4, ZERO))
    c = p5[0] * rho + p5[1] * ur.d4
    s = p5[1] * rho - p5[0] * ur.d4
    length = wp.sqrt(c * c + s * s)
    if length > TINY:
        scale = ONE / length
        c = c * scale
        s = s * scale
    else:
        c = ONE
        s = ZERO
    return c, s, rho


@wp.func
def elbow_reach(ur: UrParameters, x: wp.float64, z: wp.float64) -> wp.float64:
    """How far (x, z) in the arm's plane, from the shoulder, lies beyond what both links reach; <= 0 within. m"""
    d = wp.sqrt(x * x + z * z)
    return wp.max(d - ur.a2 - ur.a3, wp.abs(ur.a2 - ur.a3) - d)


@wp.func
def elbow_triangle(ur: UrParameters, x: wp.float64, z: wp.float64):
    """cos and sin of psi1 and of q3 (sin q3 >= 0) that bring the links' end to (x, z), or as near as they reach."""
    # As complex numbers x + i z, a link of angle psi is exp(-i psi).
    d_sq = wp.max(x * x + z * z, TINY)
    cq3 = (d_sq - ur.a2 * ur.a2 - ur.a3 * ur.a3) / (wp.float64(2.0) * ur.a2 * ur.a3)
    cq3 = wp.clamp(cq3, -ONE, ONE)
    sq3 = wp.sqrt(ONE - cq3 * cq3)
    e_x = ur.a2 + ur.a3 * cq3
    e_z = -ur.a3 * sq3
    k = ONE / wp.sqrt((e_x * e_x + e_z * e_z) * d_sq)
    return (x * e_x + z * e_z) * k, (x * e_z - z * e_x) * k, cq3, sq3


@wp.func
def last_joint(c3: wp.float64, s3: wp.float64, x_ee: wp.vec3d, y_ee: wp.vec3d):
    """cos q6, sin q6 from psi3 and the ee frame's axes in the shoulder frame."""
    s6 = s3 * x_ee[0] + c3 * x_ee[2]
    c6 = s3 * y_ee[0] + c3 * y_ee[2]
    k6 = ONE / wp.sqrt(s6 * s6 + c6 * c6)
    return c6 * k6, s6 * k6


@wp.func
def arm_state(
    ur: UrParameters,
    c1: wp.float64,  # q1
    s1: wp.float64,
    x: wp.float64,  # the links' end in the arm's plane, from the shoulder
    z: wp.float64,
    c3: wp.float64,  # psi3
    s3: wp.float64,
    c5: wp.float64,  # q5
    s5: wp.float64,
    x_ee: wp.vec3d,  # shoulder frame
    y_ee: wp.vec3d,
) -> vec12d:
    """The state (fk.py) with sin q3 >= 0, once q1, psi3 and q5 are known."""
    cp1, sp1, cq3, sq3 = elbow_triangle(ur, x, z)
    c6, s6 = last_joint(c3, s3, x_ee, y_ee)
    return vec12d(c1, s1, cp1, sp1, cp1 * cq3 - sp1 * sq3, sp1 * cq3 + cp1 * sq3, c3, s3, c5, s5, c6, s6)
