"""Collision cost of handover poses: how deep hand points stand in a zone about gripper and held object."""

import warp as wp

from r2h_batch.kernels.geometry.closest import signed_distance
from r2h_batch.kernels.geometry.surface import inverse_pose
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, finger_pose

wp.set_module_options(OPTIONS | {"fuse_fp": True})

MOST_POINTS = 256


# With y_h the hand's points in the ee frame, d(y) the signed distance to the union of gripper and held object:
#
#     cost = mean_h max(0, zone - d(y_h))
#
# A union's distance is the least of its parts', so each point keeps the least so far (`nearest`, never above the zone) and
# parts that cannot lower it are not asked: the object only within its bounding box grown by the zone, the gripper only
# where the point is near the interval of the z axis about which the gripper lies at any opening (`near_points`). Inside a part
# d is negative: deep points count as more than the zone is wide. Sums run over h in order: the same bits on every device.
@wp.kernel
def pose_cost(
    first: int,
    # tables
    gripper: Gripper, zone: float,
    axis_low: float,  # the gripper at any opening lies within axis_radius of this interval of ee's z axis
    axis_high: float, axis_radius: float,
    # trials
    mesh_in: wp.array(dtype=wp.uint64),  # one per object
    low_in: wp.array(dtype=wp.vec3),  # (O,) bounding boxes, object frame
    high_in: wp.array(dtype=wp.vec3), object_in: wp.array(dtype=int), opening_in: wp.array(dtype=float),
    T_obj_ee_in: wp.array(dtype=wp.mat44),
    T_world_ee_in: wp.array2d(dtype=wp.mat44),  # (B, R)
    hand_in: wp.array2d(dtype=wp.vec3),  # (B, H) points of the hand, world
    # out
    cost_out: wp.array2d(dtype=float),
):  # fmt: skip
    """Mean over the hand's points of max(0, zone - distance to gripper or object) (m); depths count as more than zone."""
    i, r = wp.tid()
    trial = first + i
    o = object_in[trial]
    R_ee, p_ee = inverse_pose(T_world_ee_in[trial, r])
    T = T_obj_ee_in[trial]
    R_obj = wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])
    p_obj = wp.vec3(T[0, 3], T[1, 3], T[2, 3])
    room = wp.vec3(zone, zone, zone)
    low = low_in[o] - room
    high = high_in[o] + room
    drive = drive_from_gap(gripper, opening_in[trial])
    total = float(0.0)
    nearest = wp.zeros(shape=256, dtype=float)
    near_points = wp.zeros(shape=256, dtype=int)
    count = int(0)
    # the object first, and which points are near enough to the gripper at any opening to be asked again
    for h in range(hand_in.shape[1]):
        y = R_ee * hand_in[trial, h] + p_ee
        off = y - wp.vec3(0.0, 0.0, wp.clamp(y[2], axis_low, axis_high))
        if wp.length(off) < axis_radius + zone:
            near_points[count] = h
            count += 1
        x = R_obj * y + p_obj
        d = float(zone)
        if x[0] > low[0] and x[1] > low[1] and x[2] > low[2] and x[0] < high[0] and x[1] < high[1] and x[2] < high[2]:
            query = wp.mesh_query_point_sign_normal(mesh_in[o], x, 1.0)
            if query.result:
                at = wp.mesh_eval_position(mesh_in[o], query.face, query.u, query.v)
                d = wp.min(d, query.sign * wp.length(at - x))
        nearest[h] = d
    for g in range(gripper.kind.shape[0]):
        R, p = finger_pose(gripper, g, drive)
        Rt = wp.transpose(R)
        for i_h in range(count):
            h = near_points[i_h]
            x = Rt * (R_ee * hand_in[trial, h] + p_ee - p)
            nearest[h] = wp.min(nearest[h], signed_distance(gripper.kind[g], gripper.size[g], x))
    for h in range(hand_in.shape[1]):
        total += zone - nearest[h]
    cost_out[trial, r] = total / float(hand_in.shape[1])
