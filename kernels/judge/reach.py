"""Reach: distance of a point to an object's solid."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def point_to_object(
    first: int, cap: float,
    mesh_in: wp.array(dtype=wp.uint64),  # one mesh id per object
    low_in: wp.array(dtype=wp.vec3),  # and its bounding box
    high_in: wp.array(dtype=wp.vec3), object_in: wp.array(dtype=int),
    point_in: wp.array(dtype=wp.vec3),  # object frame
    distance_out: wp.array(dtype=float), nearest_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Distance from a point to the object (0 inside it) and the object's nearest point, object frame.

    The winding number says what is inside; outside the bounding box it is not needed.
    """
    trial = first + wp.tid()
    o = object_in[trial]
    x = point_in[trial]
    low = low_in[o]
    high = high_in[o]
    d = float(cap)
    y = x
    inside = bool(False)
    if x[0] > low[0] and x[0] < high[0] and x[1] > low[1] and x[1] < high[1] and x[2] > low[2] and x[2] < high[2]:
        hit = wp.mesh_query_point_sign_winding_number(mesh_in[o], x, cap)
        if hit.result:
            inside = hit.sign < 0.0
            y = wp.mesh_eval_position(mesh_in[o], hit.face, hit.u, hit.v)
            d = wp.length(y - x)
    else:
        hit = wp.mesh_query_point_no_sign(mesh_in[o], x, cap)
        if hit.result:
            y = wp.mesh_eval_position(mesh_in[o], hit.face, hit.u, hit.v)
            d = wp.length(y - x)
    if inside:
        d = 0.0
        y = x
    distance_out[trial] = d
    nearest_out[trial] = y
