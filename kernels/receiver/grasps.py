"""Receiving grasps as kernels read them: where hands hold objects, and the turns of objects of revolution."""

import warp as wp

from r2h_batch.kernels.geometry.angles import sin_cos
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.struct
class Receiving:
    """The receiving grasps of all objects, in their objects' frames."""

    wrist: wp.array(dtype=wp.vec3)  # (M,) m
    along: wp.array(dtype=wp.vec3)  # unit, from the wrist along the hand, in the palm's plane
    normal: wp.array(dtype=wp.vec3)  # unit, out of the palm
    R: wp.array(dtype=wp.mat33)  # the hand's frame
    axis: wp.array(dtype=wp.vec3)  # (O,) of revolution; 0: the object has none
    axis_point: wp.array(dtype=wp.vec3)


@wp.func
def unit(v: wp.vec3):
    return v / wp.max(wp.length(v), 1.0e-9)


@wp.func
def about_axis(grasps: Receiving, obj: int, angle: float):
    """R, p of a turn by `angle` (rad) about the object's axis of revolution; the identity for an object without one."""
    u = grasps.axis[obj]
    s, c = sin_cos(angle)
    if wp.length_sq(u) == 0.0:
        s = float(0.0)
        c = float(1.0)
    R = c * wp.identity(n=3, dtype=float) + s * wp.skew(u) + (1.0 - c) * wp.outer(u, u)
    return R, grasps.axis_point[obj] - R * grasps.axis_point[obj]


@wp.func
def way_direction(grasps: Receiving, row: int, which: int):
    """From where a hand comes down on the object: out of its palm, along itself, between the two."""
    n = grasps.normal[row]
    if which == 1:
        n = grasps.along[row]
    elif which == 2:
        n = unit(grasps.normal[row] + grasps.along[row])
    return n
