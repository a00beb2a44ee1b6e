"""Where a gripper's approach axis first meets an object."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"fuse_fp": True})


@wp.kernel
def approach_hits(
    first: int, back_off: float, cutoff: float,
    mesh_in: wp.array(dtype=wp.uint64),  # one mesh id per object
    object_in: wp.array(dtype=int), T_obj_ee_in: wp.array(dtype=wp.mat44), face_out: wp.array(dtype=int),
):  # fmt: skip
    """The face that the ray along ee's z axis hits first, from `back_off` (m) behind its origin; -1 within `cutoff`: none."""
    row = first + wp.tid()
    T = T_obj_ee_in[row]
    z = wp.vec3(T[0, 2], T[1, 2], T[2, 2])
    start = wp.vec3(T[0, 3], T[1, 3], T[2, 3]) - back_off * z
    hit = wp.mesh_query_ray(mesh_in[object_in[row]], start, z, cutoff)
    face_out[row] = wp.where(hit.result, hit.face, -1)
