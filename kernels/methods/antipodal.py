"""Antipodal grasps on a closed mesh: opposite surface points along a line, and what the closed pads touch."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"fuse_fp": True, "max_unroll": 0})  # unrolled, it takes many times as long to compile

STEP_M = wp.constant(2.0e-5)
MAX_HITS = wp.constant(6)
ROWS_X = wp.constant(5)
ROWS_Z = wp.constant(7)
PARTS = wp.constant(16)

vec16i = wp.types.vector(16, wp.int32)


@wp.func(inline=False)
def _first_hit(mesh: wp.uint64, start: wp.vec3, d: wp.vec3, far: float):
    """Whether the ray meets the mesh within `far`; how far off, on which face, with what normal."""
    hit = wp.mesh_query_ray(mesh, start, d, far)
    return hit.result, hit.t, hit.face, hit.normal


@wp.kernel
def opposite_points(
    first: int,
    # tables
    mesh: wp.uint64, friction_cosine: float, widest: float,
    # trials
    point_in: wp.array(dtype=wp.vec3), normal_in: wp.array(dtype=wp.vec3), random_in: wp.array(dtype=wp.vec3),
    # out
    center_out: wp.array(dtype=wp.vec3), axis_out: wp.array(dtype=wp.vec3),
    thickness_out: wp.array(dtype=wp.float32),
):  # fmt: skip
    """From each surface point a line into the solid, within the friction cone; one of the opposite points within cutoff.

    An opposite point is where the line leaves the solid, again within the cone. random: tilt, turn, choice in [0, 1).
    Thickness 0: no opposite point.
    """
    i = first + wp.tid()
    n = normal_in[i]
    u = random_in[i]
    side = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(n[0]) > 0.7:
        side = wp.vec3(0.0, 1.0, 0.0)
    e = wp.normalize(wp.cross(n, side))
    f = wp.cross(n, e)
    # uniform over the cone's cap about -n
    cosine = 1.0 - u[0] * (1.0 - friction_cosine)
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    turn = 2.0 * wp.pi * u[1]
    d = -cosine * n + sine * (wp.cos(turn) * e + wp.sin(turn) * f)
    start = point_in[i]
    travelled = float(STEP_M)
    found = int(0)
    thickness = float(0.0)
    pick = float(u[2])
    for _ in range(MAX_HITS):
        met, at, _face, normal = _first_hit(mesh, start + travelled * d, d, widest - travelled)
        if not met:
            break
        travelled += at
        if wp.dot(normal, d) >= friction_cosine:
            found += 1
            # each of k opposite points with probability 1 / k
            pick = pick * float(found)
            if pick < 1.0:
                thickness = travelled
            else:
                pick = (pick - 1.0) / float(found - 1)
        travelled += STEP_M
        if travelled >= widest:
            break
    center_out[i] = start + (0.5 * thickness) * d
    axis_out[i] = d
    thickness_out[i] = thickness


@wp.kernel
def pad_contact(
    first: int,
    # tables
    mesh: wp.uint64, face_part: wp.array(dtype=wp.uint8), half_x: float, half_z: float, cutoff: float,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44), pad_z_in: wp.array(dtype=wp.float32),
    width_in: wp.array(dtype=wp.float32),
    # out
    contact_out: wp.array(dtype=wp.float32), alignment_out: wp.array(dtype=wp.float32),
    part_out: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Share of the lesser pad that has surface within `cutoff` of it, mean cosine of those surfaces to the closing axis,
    and the part that the pads touch most. The pads stand `width` apart at height pad_z in the ee frame."""
    i = first + wp.tid()
    T = T_obj_ee_in[i]
    R = wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])
    origin = wp.vec3(T[0, 3], T[1, 3], T[2, 3])
    least = float(1.0)
    aligned = float(0.0)
    touched = int(0)
    parts = vec16i()
    # rays from `cutoff` behind each pad's face to `cutoff` before it, on a grid over the pad
    for pad in range(2):
        side = wp.where(pad == 0, -1.0, 1.0)
        inward = R * wp.vec3(0.0, -side, 0.0)
        on_pad = int(0)
        for j in range(ROWS_X):
            for k in range(ROWS_Z):
                x = half_x * (2.0 * (float(j) + 0.5) / float(ROWS_X) - 1.0)
                z = half_z * (2.0 * (float(k) + 0.5) / float(ROWS_Z) - 1.0)
                start = R * wp.vec3(x, side * (0.5 * width_in[i] + cutoff), pad_z_in[i] + z) + origin
                met, _at, face, normal = _first_hit(mesh, start, inward, 2.0 * cutoff)
                if met:
                    on_pad += 1
                    aligned += wp.max(-wp.dot(normal, inward), 0.0)
                    part = wp.min(int(face_part[face]), PARTS - 1)
                    parts[part] = parts[part] + 1
        touched += on_pad
        least = wp.min(least, float(on_pad) / float(ROWS_X * ROWS_Z))
    most = int(0)
    for k in range(PARTS):
        if parts[k] > parts[most]:
            most = k
    contact_out[i] = least
    alignment_out[i] = aligned / float(wp.max(touched, 1))
    part_out[i] = most
