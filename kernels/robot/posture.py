"""Postures in arrays, and the time that the arm takes from one to another."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

from .joints import JOINTS, vecq

wp.set_module_options(OPTIONS)


@wp.struct
class Pace:
    """Speed (rad/s) and acceleration (rad/s^2) of the slowest joint; what a radian of each joint counts for: 1 of the slowest."""

    speed: float
    acceleration: float
    weight: vecq


@wp.func
def load(q: wp.array2d(dtype=float), row: int):
    """A posture of a list, (n, JOINTS)."""
    out = vecq()
    for j in range(JOINTS):
        out[j] = q[row, j]
    return out


@wp.func
def load_waypoint(path: wp.array3d(dtype=float), trial: int, k: int):
    """Waypoint k of a trial's path, (B, W, JOINTS)."""
    out = vecq()
    for j in range(JOINTS):
        out[j] = path[trial, k, j]
    return out


@wp.func
def store_waypoint(path: wp.array3d(dtype=float), trial: int, k: int, q: vecq):
    """Writes waypoint k of a trial's path."""
    for j in range(JOINTS):
        path[trial, k, j] = q[j]


@wp.func
def peak_speed(distance: wp.Float, speed: wp.Float, acceleration: wp.Float):
    """The speed (rad/s) that is reached over a distance (rad): at most `speed`."""
    return wp.min(speed, wp.sqrt(acceleration * distance))


@wp.func
def duration(distance: wp.Float, speed: wp.Float, acceleration: wp.Float):
    """Time (s) over a distance (rad), 0 for none. judge/motion/time_law.py has the same law in torch."""
    v = peak_speed(distance, speed, acceleration)
    t = v / acceleration
    if v > type(v)(0.0):
        t += distance / v
    return t
