"""Where a trial's bodies sit: fingers at their opening, the attached object, the hand; and how far the object can swing."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, finger_pose

from .joints import JOINTS, LAST, vecq
from .world import World

wp.set_module_options(OPTIONS)

BALL_ROUNDING = wp.constant(1.0e-6)


@wp.func
def _square(x: float) -> float:
    return x * x


@wp.func
def motion_radius_of_ball(world: World, center: wp.vec3, ball_radius: float):
    """Largest distance of a ball, fixed to the last link, from each joint's axis in any posture (scene/bounds.py).

    Turning a joint keeps the ball in a cylinder about its axis; that cylinder, seen from the joint before, fits into one
    about that joint's axis, and so on to the base; a ball about the joint's origin is carried along and cuts what it can.
    """
    # (0, 0, low..high) with `radius`: the cylinder about z of the frame that is walked back, from the last link to the base
    rho = vecq()
    radius = wp.sqrt(center[0] * center[0] + center[1] * center[1]) + ball_radius
    low = center[2] - ball_radius
    high = center[2] + ball_radius
    ball = wp.sqrt(radius * radius + _square(wp.max(wp.abs(low), wp.abs(high))))
    for i in range(JOINTS):
        j = LAST - i
        rho[j] = radius + BALL_ROUNDING
        offset = world.joint_p[j]
        R = world.joint_R[j]
        axis = wp.vec3(R[0, 2], R[1, 2], R[2, 2])
        ball = ball + wp.length(offset)
        mid = offset + 0.5 * (low + high) * axis
        half = 0.5 * (high - low)
        # the cylinder (mid, axis, half, radius) inside a cylinder about z: exact for parallel or perpendicular axes
        tilt = wp.sqrt(axis[0] * axis[0] + axis[1] * axis[1])
        extent_z = half * wp.abs(axis[2]) + radius * tilt
        ax = float(1.0)
        ay = float(0.0)
        if tilt > 1.0e-6:
            ax = axis[0] / tilt
            ay = axis[1] / tilt
        u = wp.abs(mid[0] * ax + mid[1] * ay) + half * tilt + radius * wp.abs(axis[2])
        v = wp.abs(ax * mid[1] - ay * mid[0]) + radius
        e0 = wp.length(wp.vec2(mid[0] - half * axis[0], mid[1] - half * axis[1]))
        e1 = wp.length(wp.vec2(mid[0] + half * axis[0], mid[1] + half * axis[1]))
        extent = wp.min(wp.sqrt(u * u + v * v), wp.max(e0, e1) + radius)
        radius = wp.min(extent, ball)
        low = wp.max(mid[2] - extent_z, -ball)
        high = wp.min(mid[2] + extent_z, ball)
        ball = wp.min(ball, wp.sqrt(radius * radius + _square(wp.max(wp.abs(low), wp.abs(high)))))
    return rho


@wp.kernel
def place_bodies(
    first: int,
    # tables
    world: World, gripper: Gripper, R_wrist_ee: wp.mat33, p_wrist_ee: wp.vec3,
    # trials
    object_in: wp.array(dtype=int), T_obj_ee_in: wp.array(dtype=wp.mat44),
    T_world_hand_in: wp.array(dtype=wp.mat44), opening_in: wp.array(dtype=float),
    # out
    R_hand_world_out: wp.array(dtype=wp.mat33), p_hand_world_out: wp.array(dtype=wp.vec3),
    R_wrist_grip_out: wp.array2d(dtype=wp.mat33), p_wrist_grip_out: wp.array2d(dtype=wp.vec3),
    R_wrist_obj_out: wp.array(dtype=wp.mat33), p_wrist_obj_out: wp.array(dtype=wp.vec3),
    motion_radius_out: wp.array2d(dtype=float),
):  # fmt: skip
    """Poses of hand, fingers and attached object (`T_obj_ee_in` after closing moved the object between the pads)."""
    trial = first + wp.tid()
    # all collision work is done in the hand's frame: the world is placed in it
    H = T_world_hand_in[trial]
    R = wp.transpose(wp.mat33(H[0, 0], H[0, 1], H[0, 2], H[1, 0], H[1, 1], H[1, 2], H[2, 0], H[2, 1], H[2, 2]))
    R_hand_world_out[trial] = R
    p_hand_world_out[trial] = -(R * wp.vec3(H[0, 3], H[1, 3], H[2, 3]))

    drive = drive_from_gap(gripper, opening_in[trial])
    for i in range(gripper.kind.shape[0]):
        Rg, pg = finger_pose(gripper, i, drive)
        R_wrist_grip_out[trial, i] = R_wrist_ee * Rg
        p_wrist_grip_out[trial, i] = R_wrist_ee * pg + p_wrist_ee

    G = T_obj_ee_in[trial]
    # T_obj_ee inverted: the object in the ee frame, then in the last link's
    Rt = wp.transpose(wp.mat33(G[0, 0], G[0, 1], G[0, 2], G[1, 0], G[1, 1], G[1, 2], G[2, 0], G[2, 1], G[2, 2]))
    p_ee_obj = -(Rt * wp.vec3(G[0, 3], G[1, 3], G[2, 3]))
    Ro = R_wrist_ee * Rt
    po = R_wrist_ee * p_ee_obj + p_wrist_ee
    R_wrist_obj_out[trial] = Ro
    p_wrist_obj_out[trial] = po
    motion_radius = vecq()
    o = object_in[trial]
    for hull in range(world.hull_first[o], world.hull_first[o + 1]):
        a = motion_radius_of_ball(world, Ro * world.hull_c0[hull] + po, world.hull_radius[hull])
        b = motion_radius_of_ball(world, Ro * world.hull_c1[hull] + po, world.hull_radius[hull])
        for j in range(JOINTS):
            motion_radius[j] = wp.max(motion_radius[j], wp.max(a[j], b[j]))
    for j in range(JOINTS):
        motion_radius_out[trial, j] = motion_radius[j]
