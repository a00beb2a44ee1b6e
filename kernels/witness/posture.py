"""Which points of robot and hand decide Safe at a posture, and how robot bodies move with the ee frame around it."""

import warp as wp

from r2h_batch.kernels.geometry.closest import TOUCH_M, rounded, signed_distance
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.hand_mesh import HandMesh, triangle_points
from r2h_batch.kernels.geometry.shape import BLOCKS, CAPSULE, SPHERE, triangle_shape
from r2h_batch.kernels.ik.jacobian import damped_gram, joint_rate, solve_spd
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.fk import ee_and_axes
from r2h_batch.kernels.witness.surface import SurfacePoint, triangle_witness

from ..robot.joints import FRAMES, JOINTS
from ..robot.posture import load
from ..robot.world import TrialBodies, World, body_pose, forward_kinematics, robot_shape

wp.set_module_options(OPTIONS | {"max_unroll": 0})

SLACK_M = wp.constant(3.0e-5)
"""As in r2h_batch.training.witnesses."""
APART_M = wp.constant(1.0e-5)
LIMIT = wp.constant(1.0e-5)


@wp.func
def hull_witness(world: World, body: int, tri: wp.array(dtype=wp.vec3), R: wp.mat33, p: wp.vec3, best: float):
    """`triangle_witness` of a robot's hull that the triangle does not meet; R, p: to the body's frame."""
    out = SurfacePoint()
    out.distance = best
    triangle = triangle_shape(0)
    middle = R * ((tri[0] + tri[1] + tri[2]) / 3.0) + p
    d = gjk(triangle, R, p, tri, robot_shape(world, body), world.points, p - middle, best, 0.0)
    if d.upper > TOUCH_M and d.upper < best:
        out.distance = d.upper
        out.x = d.point
        out.n = wp.normalize(d.v)
    return out


@wp.func
def nearest_face(
    world: World, mesh: HandMesh, hand: int, body: int, kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3,
    best: float, tri: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The hand's point of least signed distance to a primitive, in its frame; R, p: hand to primitive frame."""
    out = SurfacePoint()
    out.distance = best
    for i in range(world.n_pieces):
        piece = hand * world.n_pieces + i
        if signed_distance(kind, size, R * world.piece_center[piece] + p) - world.piece_radius[piece] < out.distance:
            for face in range(mesh.piece_face[i], mesh.piece_face[i + 1]):
                ball = mesh.face_ball[hand * mesh.n_faces + face]
                x = R * wp.vec3(ball[0], ball[1], ball[2]) + p
                if signed_distance(kind, size, x) - ball[3] < out.distance:
                    triangle_points(mesh, hand, face, tri)
                    near = SurfacePoint()
                    if kind == BLOCKS:
                        near = hull_witness(world, body, tri, R, p, out.distance)
                    else:
                        near = triangle_witness(tri, 0, kind, size, R, p, out.distance)
                    if near.distance < out.distance:
                        out = near
    return out


@wp.kernel
def hand_witness(
    first: int,
    # tables
    world: World, mesh: HandMesh, bodies: TrialBodies,
    # trials
    q_in: wp.array2d(dtype=float),  # (B, JOINTS)
    body_in: wp.array(dtype=int),  # -1: not wanted
    distance_in: wp.array(dtype=float),  # of that body, as Safe measures it
    # out
    found_out: wp.array(dtype=wp.bool),
    point_out: wp.array(dtype=wp.vec3),  # world frame
    normal_out: wp.array(dtype=wp.vec3),  # world frame, the distance grows when the hand's point goes along it
):  # fmt: skip
    """The hand's point that decides Safe at a posture. Overlaps are measured as Safe does: against the body's rounded core.

    Where the hand reaches that core, Safe's number no longer changes: then the way out of the sharp body is given.
    """
    trial = first + wp.tid()
    body = body_in[trial]
    found_out[trial] = False
    if body < 0:
        return
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], load(q_in, trial), R, p)
    Rb, pb = body_pose(world, bodies, trial, R, p, body)
    Rt = wp.transpose(Rb)
    pt = -(Rt * pb)
    hand = bodies.hand[trial]
    kind = world.kind[body]
    size = world.size[body]
    # SLACK_M: the face is found again by distance, and rounding must not lose it
    distance = distance_in[trial]
    on_hull = kind == BLOCKS
    if on_hull and distance < 0.0:  # how deep is measured in the ball that the hull holds
        kind = SPHERE
        size = wp.vec3(size[2], 0.0, 0.0)
    sharp = distance >= 0.0 or kind <= CAPSULE
    used_size = size
    below = distance + SLACK_M
    if not sharp:
        core = rounded(kind, size)
        used_size = core.size
        below = distance + core.radius + SLACK_M
    near = SurfacePoint()
    sign = float(1.0)
    attempt = int(0)
    while attempt < 2:  # around one call: inlined, it is most of the kernel
        near = nearest_face(world, mesh, hand, body, kind, used_size, Rt, pt, below, tri)
        attempt += 1
        if attempt == 1:
            if wp.length_sq(near.n) > 0.0 and (sharp or near.distance >= APART_M):
                attempt = 2
            used_size = size  # else the core is met, or the body is wholly inside the hand
            below = 1.0e30
        elif near.distance > 0.0 and distance < 0.0 and not (on_hull and distance >= -TOUCH_M):
            sign = -1.0
    R_world_hand = wp.transpose(bodies.R_hand_world[trial])
    found_out[trial] = wp.length_sq(near.n) > 0.0
    point_out[trial] = R_world_hand * (Rb * near.x + pb - bodies.p_hand_world[trial])
    normal_out[trial] = sign * (R_world_hand * (Rb * near.n))


@wp.func
def stands_at_limit(q: float, lower: float, upper: float):
    """Whether a joint angle is a limit (rad), up to what rounding leaves."""
    return q < lower + LIMIT or q > upper - LIMIT


@wp.kernel
def arm_jacobian(
    first: int,
    # tables
    damping: wp.float64,
    joint_R: wp.array(dtype=wp.mat33d),  # (JOINTS + 1,) parent link to joint at q = 0; the last: last link to ee
    joint_p: wp.array(dtype=wp.vec3d),
    lower: wp.array(dtype=float),  # (JOINTS,) rad
    upper: wp.array(dtype=float),
    # trials
    q_in: wp.array2d(dtype=float),
    # out
    axis_out: wp.array2d(dtype=wp.vec3),  # (B, JOINTS) joint axes and points on them, world frame
    origin_out: wp.array2d(dtype=wp.vec3),
    inverse_out: wp.array3d(dtype=float),  # (B, JOINTS, 6)
    ee_out: wp.array(dtype=wp.mat44),  # T_world_ee
):
    """Joint axes at a posture, and J^T (J J^T + damping^2)^-1: joint rates per (velocity of the ee origin, turn), world.

    With more than six joints these rates are the smallest ones (least squares): nothing moves along the self-motion. A joint
    at its limit stays there, as long as six others are left.
    """
    trial = first + wp.tid()
    n = int(JOINTS)
    q = wp.zeros(shape=JOINTS, dtype=wp.float64)
    axes = wp.zeros(shape=JOINTS, dtype=wp.vec3d)
    linear = wp.zeros(shape=JOINTS, dtype=wp.vec3d)
    at_limit = int(0)
    for j in range(n):
        q[j] = wp.float64(q_in[trial, j])
    R, p = ee_and_axes(joint_R, joint_p, q, axes, linear)
    T = wp.identity(n=4, dtype=float)
    for i in range(3):
        T[i, 3] = float(p[i])
        for k in range(3):
            T[i, k] = float(R[i, k])
    ee_out[trial] = T
    for j in range(n):
        axis_out[trial, j] = wp.vec3(axes[j])
        origin_out[trial, j] = wp.vec3(linear[j])
        linear[j] = wp.cross(axes[j], p - linear[j])
        if stands_at_limit(q_in[trial, j], lower[j], upper[j]):
            at_limit += 1
    if at_limit <= JOINTS - 6:
        for j in range(n):
            if stands_at_limit(q_in[trial, j], lower[j], upper[j]):
                axes[j] = wp.vec3d()
                linear[j] = wp.vec3d()
    M = damped_gram(axes, linear, damping * damping)
    for k in range(6):  # column k: J^T y with (J J^T + damping^2 1) y = e_k
        A = M
        A[k, 6] = wp.float64(1.0)
        y = solve_spd(A)
        for j in range(n):
            inverse_out[trial, j, k] = wp.float32(joint_rate(axes[j], linear[j], y))
