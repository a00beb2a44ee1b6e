"""How much human contact a gripper blocks: the contact points that lie near it."""

import warp as wp

from r2h_batch.kernels.geometry.closest import signed_distance
from r2h_batch.kernels.geometry.surface import inverse_pose
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, finger_pose

wp.set_module_options(OPTIONS | {"fuse_fp": True})


@wp.kernel
def points_near_gripper(
    first: int,
    # tables
    gripper: Gripper, radius: float,
    points: wp.array2d(dtype=wp.vec3),  # (O, P) object frame
    # trials
    object_in: wp.array(dtype=int), T_obj_ee_in: wp.array(dtype=wp.mat44), opening_in: wp.array(dtype=float),
    # out
    near_out: wp.array2d(dtype=wp.uint8),  # (M, P)
):  # fmt: skip
    """Whether each point of grasp m's object is nearer than `radius` to the gripper."""
    i, k = wp.tid()
    row = first + i
    R_ee, p_ee = inverse_pose(T_obj_ee_in[row])
    x = R_ee * points[object_in[row], k] + p_ee
    drive = drive_from_gap(gripper, opening_in[row])
    near = wp.uint8(0)
    for g in range(gripper.kind.shape[0]):
        R, p = finger_pose(gripper, g, drive)
        if signed_distance(gripper.kind[g], gripper.size[g], wp.transpose(R) * (x - p)) < radius:
            near = wp.uint8(1)
    near_out[row, k] = near


@wp.kernel
def blocked_contact(
    first: int, threshold: float,
    near_in: wp.array2d(dtype=wp.uint8),  # (M, P)
    row_in: wp.array(dtype=int), count_in: wp.array(dtype=int),
    contact_in: wp.array2d(dtype=float),  # (B, P) probabilities
    blocked_out: wp.array2d(dtype=float),
):  # fmt: skip
    """Sum of the contact probabilities at or above `threshold` of the points near_in grasp k of each trial."""
    i, k = wp.tid()
    trial = first + i
    total = float(0.0)
    if k < count_in[trial]:
        row = row_in[trial] + k
        for p in range(near_in.shape[1]):
            if near_in[row, p] != wp.uint8(0):
                c = contact_in[trial, p]
                if c >= threshold:
                    total += c
    blocked_out[trial, k] = total
