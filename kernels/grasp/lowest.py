"""How low the gripper reaches in the world, at some openings."""

import warp as wp

from r2h_batch.kernels.geometry.shape import BOX, CYLINDER, SPHERE
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, finger_pose

from ..robot.posture import load
from ..robot.tool import Tool, ee_pose

wp.set_module_options(OPTIONS)


@wp.func
def _reach(kind: int, size: wp.vec3, u: wp.vec3) -> float:
    """How far a primitive goes from its middle along the unit vector u (its frame)."""
    if kind == BOX:
        return wp.abs(u[0]) * size[0] + wp.abs(u[1]) * size[1] + wp.abs(u[2]) * size[2]
    if kind == SPHERE:
        return size[0]
    along = wp.abs(u[2])
    if kind == CYLINDER:
        return along * size[1] + wp.sqrt(wp.max(1.0 - along * along, 0.0)) * size[0]
    return along * size[1] + size[0]


@wp.kernel
def lowest_points(
    first: int, tool: Tool, gripper: Gripper,
    q_in: wp.array2d(dtype=float),  # (B, JOINTS), rad
    opening_in: wp.array2d(dtype=wp.float32),  # (B, K), m
    lowest_out: wp.array2d(dtype=wp.float32),  # (B, K)
):  # fmt: skip
    """World z (m) of the lowest point of all gripper primitives at each trial's posture and K openings."""
    trial = first + wp.tid()
    R_world_ee, p_world_ee = ee_pose(tool, load(q_in, trial))
    up = wp.vec3(R_world_ee[2, 0], R_world_ee[2, 1], R_world_ee[2, 2])  # in the ee frame
    for k in range(opening_in.shape[1]):
        drive = drive_from_gap(gripper, opening_in[trial, k])
        low = float(1.0e30)
        for i in range(gripper.kind.shape[0]):
            R, p = finger_pose(gripper, i, drive)
            low = wp.min(low, wp.dot(up, p) - _reach(gripper.kind[i], gripper.size[i], wp.transpose(R) * up))
        lowest_out[trial, k] = p_world_ee[2] + low
