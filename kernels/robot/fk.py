"""UR forward kinematics in the shoulder frame.

Shoulder frame: turned by q1 about the world's z axis; x along the arm's plane, n (its y) the plane's normal, z up.
The state is six (cos, sin) pairs: q1, then the links' absolute angles psi1 = q2, psi2 = q2 + q3, psi3 = q2 + q3 + q4,
then q5, q6. With
  u(psi) = (cos psi, 0, -sin psi)      direction of a link
  w(psi) = (-sin psi, 0, -cos psi)     axis of joint 5
the wrist centre (where the axes of joints 5 and 6 meet) and the ee frame's axes are
  p5 = a2 u(psi1) + a3 u(psi2) + d5 w(psi3) + d4 n + d1 z
  z_ee = sin q5 u(psi3) + cos q5 n,  b = sin q5 n - cos q5 u(psi3)
  x_ee = cos q6 b - sin q6 w(psi3),  y_ee = -sin q6 b - cos q6 w(psi3)
and the ee frame's origin is p5 + tool z_ee.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

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
def ee_and_axes(
    joint_R: wp.array(dtype=wp.mat33d),  # (J + 1,) parent link to joint at q = 0; the last: last link to ee
    joint_p: wp.array(dtype=wp.vec3d),
    q: wp.array(dtype=wp.float64),  # (J,)
    axes: wp.array(dtype=wp.vec3d),  # (J,) out: the joints' axes and points on them, world frame
    origins: wp.array(dtype=wp.vec3d),
):
    """R, p of the ee in the world, joint by joint as world.py has it in float32; writes the joints' axes."""
    n = joint_R.shape[0] - 1
    zero = wp.float64(0.0)
    R = wp.identity(n=3, dtype=wp.float64)
    p = wp.vec3d()
    for j in range(n):
        p = R * joint_p[j] + p
        c = wp.cos(q[j])
        s = wp.sin(q[j])
        R = R * joint_R[j] * wp.mat33d(c, -s, zero, s, c, zero, zero, zero, wp.float64(1.0))
        axes[j] = wp.vec3d(R[0, 2], R[1, 2], R[2, 2])
        origins[j] = p
    return R * joint_R[n], R * joint_p[n] + p


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
        ur.a2 * s[2] + ur.a3 * s[4] - ur.d5 * s[7], ur.d4, ur.d1 - ur.a2 * s[3] - ur.a3 * s[5] - ur.d5 * s[6]
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


@wp.func
def ur_pose_error(ur: UrParameters, q: vec6d, R: wp.mat33d, p: wp.vec3d):
    """Distance (m) and angle (rad) between the ee pose of joint angles q and the pose R, p (world)."""
    s = ur_state(q)
    A = ur_ee_rotation(s)
    # Of the rotation between both: twice its axis times the sine of its angle, and its trace.
    vee = wp.vec3d()
    trace = wp.float64(0.0)
    for k in range(3):
        axis = from_shoulder(s[0], s[1], wp.vec3d(A[0, k], A[1, k], A[2, k]))
        goal = wp.vec3d(R[0, k], R[1, k], R[2, k])
        vee += wp.cross(axis, goal)
        trace += wp.dot(axis, goal)
    tool = wp.vec3d(ur.tool * A[0, 2], ur.tool * A[1, 2], ur.tool * A[2, 2])
    at = from_shoulder(s[0], s[1], ur_wrist_center(ur, s) + tool)
    return wp.length(at - p), wp.atan2(wp.length(vee), trace - wp.float64(1.0))
