"""Presented: where the receiver's region is, seen from the grasp and from the receiver's palm."""

import warp as wp

from r2h_batch.kernels.geometry.angles import angle_of
from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.geometry.surface_distance import nearest_on_surface
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def _point(T: wp.mat44, p: wp.vec3):
    return wp.vec3(
        T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3],
        T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3],
        T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3],
    )


@wp.func
def _turned_back(T: wp.mat44, v: wp.vec3):
    """R^T v."""
    return wp.vec3(
        T[0, 0] * v[0] + T[1, 0] * v[1] + T[2, 0] * v[2],
        T[0, 1] * v[0] + T[1, 1] * v[1] + T[2, 1] * v[2],
        T[0, 2] * v[0] + T[1, 2] * v[1] + T[2, 2] * v[2],
    )


@wp.kernel
def region_presented(
    first: int, cap: float, facing_deg: float, reach_radius: float,
    surfaces: Surfaces,  # the region of object o: surface o + region_offset; without a triangle: it has none
    region_offset: int,
    mesh_in: wp.array(dtype=wp.uint64),  # the regions as meshes of Warp
    center_in: wp.array(dtype=wp.vec3),  # the region's centre, object frame
    palm_point_in: wp.array(dtype=wp.vec3),  # of each hand, hand frame
    active_in: wp.array(dtype=wp.bool), object_in: wp.array(dtype=int), hand_in: wp.array(dtype=int),
    attached_in: wp.array(dtype=wp.mat44),  # T_obj_ee once the pads have met the object
    T_world_ee_in: wp.array(dtype=wp.mat44), T_world_hand_in: wp.array(dtype=wp.mat44),
    ball_in: wp.array(dtype=wp.vec3),  # c_h, object frame
    presented_out: wp.array(dtype=wp.bool), angle_out: wp.array(dtype=float),
    distance_out: wp.array(dtype=float),
):  # fmt: skip
    """Angle at the TCP between the region's centre and the palm's (degrees), distance from c_h to the region (m), and whether
    both are within their limits. NaN and False without a region, and in rows that are not active.

    Both directions are taken in the gripper's frame, whose origin is the TCP.
    """
    row = first + wp.tid()
    o = object_in[row]
    region = o + region_offset
    angle = float(wp.nan)
    distance = float(wp.nan)
    if active_in[row] and surfaces.surface_first[region] < surfaces.surface_first[region + 1]:
        grasp, pose = attached_in[row], T_world_ee_in[row]
        tcp = wp.vec3(grasp[0, 3], grasp[1, 3], grasp[2, 3])
        a = _turned_back(grasp, center_in[o] - tcp)
        palm = _point(T_world_hand_in[row], palm_point_in[hand_in[row]])
        b = _turned_back(pose, palm - wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3]))
        # atan2 keeps its digits where acos loses them: at 0 and 180 degrees
        angle = wp.degrees(angle_of(wp.length(wp.cross(a, b)), wp.dot(a, b)))
        nearest, _ = nearest_on_surface(surfaces, region, mesh_in[o], ball_in[row], cap)
        distance = nearest
    presented_out[row] = angle <= facing_deg and distance <= reach_radius
    angle_out[row] = angle
    distance_out[row] = distance
