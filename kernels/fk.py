"""UR forward kinematics in the shoulder frame, where the Jacobian at the wrist centre is block triangular.

Shoulder frame: turned by q1 about the world's z axis; x along the arm's plane, n (its y) the plane's normal, z up.
The state is six (cos, sin) pairs, so that iterations need no trigonometry: q1, then the links' absolute angles
psi1 = q2, psi2 = q2 + q3, psi3 = q2 + q3 + q4, then q5, q6. With
  u(psi) = (cos psi, 0, -sin psi)      direction of a link
  w(psi) = (-sin psi, 0, -cos psi)     axis of joint 5
the wrist centre (where the axes of joints 5 and 6 meet) and the ee frame's axes are
  p5 = a2 u(psi1) + a3 u(psi2) + d5 w(psi3) + d4 n + d1 z
  z_ee = sin q5 u(psi3) + cos q5 n,  b = sin q5 n - cos q5 u(psi3)
  x_ee = cos q6 b - sin q6 w(psi3),  y_ee = -sin q6 b - cos q6 w(psi3)
and the ee frame's origin is p5 + tool z_ee.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

vec6d = wp.types.vector(6, wp.float64)
vec12d = wp.types.vector(12, wp.float64)


@wp.struct
class UrParameters:
    """Lengths in metres; joint limits and home in rad. `tool` runs from the wrist centre to the ee frame's origin."""

    d1: wp.float64
    a2: wp.float64
    a3: wp.float64
    d4: wp.float64
    d5: wp.float64
    tool: wp.float64
    home: vec6d
    lower: vec6d
    upper: vec6d


@wp.func
def ur_state(q: vec6d) -> vec12d:
    """The state (cos, sin pairs) of joint angles."""
    psi2 = q[1] + q[2]
    psi3 = psi2 + q[3]
    return vec12d(
        wp.cos(q[0]), wp.sin(q[0]), wp.cos(q[1]), wp.sin(q[1]), wp.cos(psi2), wp.sin(psi2),
        wp.cos(psi3), wp.sin(psi3), wp.cos(q[4]), wp.sin(q[4]), wp.cos(q[5]), wp.sin(q[5]),
    )  # fmt: skip


@wp.func
def ur_wrist_center(ur: UrParameters, s: vec12d) -> wp.vec3d:
    """The wrist centre in the shoulder frame."""
    return wp.vec3d(
        ur.a2 * s[2] + ur.a3 * s[4] - ur.d5 * s[7],
        ur.d4,
        ur.d1 - ur.a2 * s[3] - ur.a3 * s[5] - ur.d5 * s[6],
    )


@wp.func
def ur_ee_rotation(s: vec12d) -> wp.mat33d:
    """The ee frame's axes (columns) in the shoulder frame."""
    bx = -s[8] * s[6]
    by = s[9]
    bz = s[8] * s[7]
    return wp.mat33d(
        s[10] * bx + s[11] * s[7], s[10] * s[7] - s[11] * bx, s[9] * s[6],
        s[10] * by, -s[11] * by, s[8],
        s[10] * bz + s[11] * s[6], s[10] * s[6] - s[11] * bz, -s[9] * s[7],
    )  # fmt: skip


@wp.func
def from_shoulder(c: wp.float64, s: wp.float64, p: wp.vec3d) -> wp.vec3d:
    """Shoulder frame to world."""
    return wp.vec3d(c * p[0] - s * p[1], s * p[0] + c * p[1], p[2])


@wp.func
def to_shoulder(c: wp.float64, s: wp.float64, p: wp.vec3d) -> wp.vec3d:
    """World to shoulder frame."""
    return wp.vec3d(c * p[0] + s * p[1], c * p[1] - s * p[0], p[2])
