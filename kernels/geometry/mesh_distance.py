"""Signed distance and closest point to a triangle mesh that need not be closed (sign by winding number)."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.kernel
def signed_distance(
    mesh: wp.uint64, cutoff: wp.float32, points_in: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32), closest_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """distance_out: negative where the winding number is above 0.5; +cutoff where nothing is nearer than that."""
    i = wp.tid()
    p = points_in[i]
    query = wp.mesh_query_point_sign_winding_number(mesh, p, cutoff, 2.0, 0.5)
    if query.result:
        closest = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        distance_out[i] = query.sign * wp.length(p - closest)
        closest_out[i] = closest
    else:
        distance_out[i] = cutoff
        closest_out[i] = p


@wp.kernel
def nearest_face(
    mesh: wp.uint64, cutoff: wp.float32, points_in: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32), face_out: wp.array(dtype=wp.int32),
):  # fmt: skip
    """distance_out: without a sign; +cutoff and face -1 where nothing is nearer than that."""
    i = wp.tid()
    p = points_in[i]
    distance_out[i] = cutoff
    face_out[i] = -1
    query = wp.mesh_query_point_no_sign(mesh, p, cutoff)
    if query.result:
        distance_out[i] = wp.length(p - wp.mesh_eval_position(mesh, query.face, query.u, query.v))
        face_out[i] = query.face
