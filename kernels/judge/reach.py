"""Reach: distance of a point to an object's solid."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def point_to_object(
    first: int,
    cap: float,
    mesh_in: wp.array(dtype=wp.uint64),  # one mesh id per object
    object_in: wp.array(dtype=int),
    point_in: wp.array(dtype=wp.vec3),  # object frame
    distance_out: wp.array(dtype=float),
    nearest_out: wp.array(dtype=wp.vec3),
):
    """Distance from a point to the object (0 inside it) and the object's nearest point, object frame."""
    trial = first + wp.tid()
    x = point_in[trial]
    hit = wp.mesh_query_point_sign_winding_number(mesh_in[object_in[trial]], x, cap)
    if hit.result:
        y = wp.mesh_eval_position(mesh_in[object_in[trial]], hit.face, hit.u, hit.v)
        d = wp.length(y - x)
        if hit.sign < 0.0:
            d = 0.0
            y = x
        distance_out[trial] = d
        nearest_out[trial] = y
    else:
        distance_out[trial] = cap
        nearest_out[trial] = x
