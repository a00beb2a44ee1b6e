"""Postures (six joint angles, rad) in arrays."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.world import vec6

wp.set_module_options(OPTIONS)


@wp.func
def load(q: wp.array2d(dtype=float), row: int):
    """A posture of a list, (n, 6)."""
    return vec6(q[row, 0], q[row, 1], q[row, 2], q[row, 3], q[row, 4], q[row, 5])


@wp.func
def load_waypoint(path: wp.array3d(dtype=float), trial: int, k: int):
    """Waypoint k of a trial's path, (B, W, 6)."""
    return vec6(
        path[trial, k, 0], path[trial, k, 1], path[trial, k, 2], path[trial, k, 3], path[trial, k, 4], path[trial, k, 5]
    )


@wp.func
def store_waypoint(path: wp.array3d(dtype=float), trial: int, k: int, q: vec6):
    """Writes waypoint k of a trial's path."""
    for j in range(6):
        path[trial, k, j] = q[j]
