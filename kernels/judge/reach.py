"""Reach: distance of a point to an object's solid."""

import warp as wp

from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.geometry.surface_distance import nearest_on_surface
from r2h_batch.kernels.grasp.crossings import crossings
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def solid_distance(surfaces: Surfaces, o: int, mesh: wp.uint64, x: wp.vec3, cap: float):
    """Distance from a point to closed surface o (0 inside it) and the nearest point of it; object frame.

    A line through the point says what is inside; outside the bounding box it is not needed.
    """
    low = surfaces.low[o]
    high = surfaces.high[o]
    inside = bool(False)
    if x[0] > low[0] and x[0] < high[0] and x[1] > low[1] and x[1] < high[1] and x[2] > low[2] and x[2] < high[2]:
        ys = wp.zeros(shape=24, dtype=float)
        signs = wp.zeros(shape=24, dtype=int)
        _, winding = crossings(
            surfaces, o, wp.identity(n=3, dtype=float), wp.vec3(0.0, 0.0, 0.0), x[0], x[2], x[1], ys, signs
        )
        inside = winding != 0
    d = float(0.0)
    y = x
    if not inside:
        d, y = nearest_on_surface(surfaces, o, mesh, x, cap)
    return d, y


@wp.kernel
def point_to_object(
    first: int, cap: float,
    # tables
    surfaces: Surfaces,  # surface o is object o's, closed
    mesh_in: wp.array(dtype=wp.uint64),  # the same triangles as a mesh of Warp
    # trials
    object_in: wp.array(dtype=int),
    point_in: wp.array(dtype=wp.vec3),  # object frame
    # out
    distance_out: wp.array(dtype=float), nearest_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Distance from a point to the object (0 inside it) and the object's nearest point, object frame."""
    trial = first + wp.tid()
    o = object_in[trial]
    d, y = solid_distance(surfaces, o, mesh_in[o], point_in[trial], cap)
    distance_out[trial] = d
    nearest_out[trial] = y
