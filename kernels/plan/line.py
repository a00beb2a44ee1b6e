"""Straight lines of the ee in the world, followed by the joints: which IK branch goes on into which."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import BRANCHES

from ..robot.joints import JOINTS, vecq
from ..robot.tool import Tool, ee_pose
from ..robot.world import World

wp.set_module_options(OPTIONS | {"max_unroll": 0})

TURN = wp.constant(6.2831853071795865)


@wp.func
def _branch(q: wp.array4d(dtype=float), trial: int, k: int, slot: int):
    out = vecq()
    for j in range(JOINTS):
        out[j] = q[trial, k, slot, j]
    return out


@wp.func
def _turned_towards(q: vecq, x: vecq):
    """x with each joint at the turn that is nearest to q."""
    out = vecq()
    for j in range(JOINTS):
        out[j] = x[j] - TURN * wp.round((x[j] - q[j]) / TURN)
    return out


@wp.func
def _most_turn(world: World, q: vecq, x: vecq):
    """How far the joint goes that goes farthest from q to x (rad); 1e30 where x is beyond a limit."""
    turn = float(0.0)
    for j in range(JOINTS):
        turn = wp.max(turn, wp.abs(x[j] - q[j]))
        if x[j] < world.lower[j] or x[j] > world.upper[j]:
            turn = 1.0e30
    return turn


@wp.func
def _point(T: wp.mat44):
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def _off(tool: Tool, q: vecq, T: wp.mat44, p_line: wp.vec3, lever: float):
    """How far a point at most `lever` from the ee is from where it would be with the ee turned as T, at p_line (m)."""
    R, p = ee_pose(tool, q)
    D = wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])
    D = wp.transpose(D) * R
    # |axis| = 2 sin(angle)
    axis = wp.vec3(D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1])
    return wp.length(p - p_line) + 0.5 * lever * wp.length(axis)


@wp.kernel
def follow_lines(
    first: int,
    most_turn: float,  # of a joint from one waypoint to the next, rad
    most_off: float,  # of the line, m
    lever: float,
    # tables
    world: World, tool: Tool,
    # trials
    q_in: wp.array4d(dtype=float),  # (B, K, 8, JOINTS) branches at the line's waypoints
    valid_in: wp.array3d(dtype=wp.bool),  # (B, K, 8)
    T_world_ee_in: wp.array2d(dtype=wp.mat44),  # (B, K) turned alike
    # out
    path_out: wp.array4d(dtype=float),  # (B, 8, K, JOINTS) the line's last waypoint first
    followed_out: wp.array2d(dtype=int),  # (B, 8) how many waypoints, 0: the branch is none
    off_out: wp.array2d(dtype=float),  # (B, 8) how far the gripper is from the line at most, m
):  # fmt: skip
    """From each branch at the first waypoint to the nearest at the next, and so on, as far as one is near enough.

    Joints go straight from waypoint to waypoint, so the ee leaves the line in between; most in the middle, where it is looked at.
    """
    trial = first + wp.tid()
    n = path_out.shape[2]
    for slot in range(BRANCHES):
        q = vecq()
        count = int(0)
        off = float(0.0)
        running = valid_in[trial, 0, slot]
        if running:
            q = _branch(q_in, trial, 0, slot)
            count = 1
            for j in range(JOINTS):
                path_out[trial, slot, n - 1, j] = q[j]
        while running and count < n:
            best = float(most_turn)
            nearest = vecq()
            found = int(-1)
            for other in range(BRANCHES):
                if valid_in[trial, count, other]:
                    x = _turned_towards(q, _branch(q_in, trial, count, other))
                    turn = _most_turn(world, q, x)
                    if turn < best:
                        best = turn
                        nearest = x
                        found = other
            running = found >= 0
            if running:
                T = T_world_ee_in[trial, count]
                middle = 0.5 * (_point(T_world_ee_in[trial, count - 1]) + _point(T))
                aside = _off(tool, 0.5 * (q + nearest), T, middle, lever)
                running = aside <= most_off
                if running:
                    off = wp.max(off, aside)
                    q = nearest
                    count += 1
                    for j in range(JOINTS):
                        path_out[trial, slot, n - count, j] = q[j]
        followed_out[trial, slot] = count
        off_out[trial, slot] = off
