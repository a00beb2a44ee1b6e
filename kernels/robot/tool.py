"""The ee frame at a posture, and from when on a motion keeps it at its goal."""

import warp as wp

from r2h_batch.kernels.geometry.angles import angle_of
from r2h_batch.kernels.options import OPTIONS

from .joints import JOINTS, vecq
from .posture import load_waypoint
from .world import child_frame

wp.set_module_options(OPTIONS)


@wp.struct
class Tool:
    """Joint frames and the ee in the wrist_3 frame."""

    joint_R: wp.array(dtype=wp.mat33)
    joint_p: wp.array(dtype=wp.vec3)
    R_wrist_ee: wp.mat33
    p_wrist_ee: wp.vec3


@wp.func
def ee_pose(tool: Tool, q: vecq):
    """R, p of the ee in the world."""
    R = wp.identity(n=3, dtype=float)
    p = wp.vec3(0.0, 0.0, 0.0)
    for i in range(JOINTS):
        R, p = child_frame(R, p, tool.joint_R[i], tool.joint_p[i], q[i])
    return R * tool.R_wrist_ee, R * tool.p_wrist_ee + p


@wp.kernel
def settle_sample(
    first: int,
    # tables
    tool: Tool, position_m: float, rotation_rad: float,
    # trials
    goal_in: wp.array3d(dtype=float),  # (B, 1, JOINTS)
    path_in: wp.array3d(dtype=float), length_in: wp.array(dtype=int),
    # out
    sample_out: wp.array(dtype=int),
):  # fmt: skip
    """The first sample from which on the ee stays within both tolerances of its pose at the goal; the length if none."""
    trial = first + wp.tid()
    n = length_in[trial]
    k = int(n)
    if n > 0:
        Rg, pg = ee_pose(tool, load_waypoint(goal_in, trial, 0))
        near = bool(True)
        while near and k > 0:
            R, p = ee_pose(tool, load_waypoint(path_in, trial, k - 1))
            # |axis| = 2 sin(angle) and trace - 1 = 2 cos(angle): the angle without acos, which is blunt near 0
            D = wp.transpose(Rg) * R
            axis = wp.vec3(D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1])
            angle = angle_of(wp.length(axis), wp.trace(D) - 1.0)
            near = wp.length(p - pg) <= position_m and angle <= rotation_rad
            if near:
                k -= 1
    sample_out[trial] = k
