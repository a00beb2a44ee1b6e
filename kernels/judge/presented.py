"""Presented: what of gripper and object comes to the palm first. Upright: how a vessel's opening stands. Distances of points."""

import warp as wp

from r2h_batch.kernels.geometry.angles import angle_of
from r2h_batch.kernels.geometry.closest import signed_distance
from r2h_batch.kernels.geometry.shape import CAPSULE
from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.geometry.surface_distance import nearest_on_surface
from r2h_batch.kernels.judge.reach import solid_distance
from r2h_batch.kernels.judge.rows import inverse, moved, turned
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper

wp.set_module_options(OPTIONS)

BY_BALL = wp.constant(0)
"""As `r2h_batch.verdicts.Nearer`."""
BY_GRIPPER = wp.constant(1)
BY_SHARP = wp.constant(2)
OF_GRIPPER = wp.constant(0)
"""What `distance_of` measures to."""
OF_OBJECT = wp.constant(1)
OF_WANTED = wp.constant(2)
OF_SHARP = wp.constant(3)
FARTHER_M = wp.constant(1.0e-5)
"""More than rounding moves a distance of a few metres."""


@wp.func
def _gripper_distance(
    gripper: Gripper, R: wp.array2d(dtype=wp.mat33), p: wp.array2d(dtype=wp.vec3), row: int, x: wp.vec3
) -> float:
    """Distance of x from the gripper whose primitives stand at R, p in x's frame; 0 inside it."""
    best = float(1.0e30)
    for i in range(gripper.kind.shape[0]):
        kind = gripper.kind[i]
        size = gripper.size[i]
        d = x - p[row, i]
        around = wp.length(size)  # no point of a primitive is farther from its middle
        if kind == CAPSULE:
            around = size[0] + size[1]
        if wp.length(d) < best + around:
            best = wp.min(best, signed_distance(kind, size, wp.transpose(R[row, i]) * d))
    return wp.max(best, 0.0)


@wp.kernel
def present(
    first: int, cap: float, reach_radius: float,
    nearer_free: float,  # how much nearer gripper and sharp parts may be: where the object is wanted,
    nearer_region: float,  # and where a region of it is
    # tables
    surfaces: Surfaces,  # surface o is object o's, closed
    mesh_in: wp.array(dtype=wp.uint64),  # the same triangles as meshes of Warp
    regions: Surfaces,  # the region of object o: surface o + region_offset; without a triangle: it has none
    region_offset: int,
    region_mesh_in: wp.array(dtype=wp.uint64),
    sharp: Surfaces,  # the sharp parts of object o: surface o
    sharp_mesh_in: wp.array(dtype=wp.uint64),
    up_in: wp.array(dtype=wp.vec3),  # towards a vessel's opening, object frame; zero: it is no vessel
    gripper: Gripper,
    palm_point_in: wp.array(dtype=wp.vec3),  # of each hand, hand frame
    # trials
    active_in: wp.array(dtype=wp.bool), object_in: wp.array(dtype=int), hand_in: wp.array(dtype=int),
    attached_in: wp.array(dtype=wp.mat44),  # T_obj_ee once the pads have met the object
    T_world_ee_in: wp.array(dtype=wp.mat44), T_world_hand_in: wp.array(dtype=wp.mat44),
    R_wrist_grip_in: wp.array2d(dtype=wp.mat33), p_wrist_grip_in: wp.array2d(dtype=wp.vec3),
    R_wrist_obj_in: wp.array(dtype=wp.mat33), p_wrist_obj_in: wp.array(dtype=wp.vec3),
    ball_in: wp.array(dtype=wp.vec3),  # c_h, object frame
    reach_in: wp.array(dtype=float), nearest_in: wp.array(dtype=wp.vec3),  # its distance from the solid, and that point of it
    # out
    margin_out: wp.array(dtype=float), by_out: wp.array(dtype=wp.int8), tilt_out: wp.array(dtype=float),
):  # fmt: skip
    """Margin of Presented (m), what it is about, and a vessel's tilt (degrees); NaN and -1 in rows that are not active."""
    row = first + wp.tid()
    margin_out[row] = wp.nan
    by_out[row] = wp.int8(-1)
    tilt_out[row] = wp.nan
    if not active_in[row]:
        return
    o = object_in[row]
    region = o + region_offset
    palm = moved(T_world_hand_in[row], palm_point_in[hand_in[row]])
    palm = moved(attached_in[row], moved(inverse(T_world_ee_in[row]), palm))  # object frame
    has_region = regions.surface_first[region] < regions.surface_first[region + 1]
    distance = reach_in[row]
    y = nearest_in[row]
    room = float(nearer_free)
    if has_region:
        room = nearer_region
        distance, y = nearest_on_surface(regions, region, region_mesh_in[o], ball_in[row], cap)
    margin = reach_radius - distance
    by = int(BY_BALL)
    on_wrist = R_wrist_obj_in[row] * palm + p_wrist_obj_in[row]
    other = _gripper_distance(gripper, R_wrist_grip_in, p_wrist_grip_in, row, on_wrist)
    other_by = int(BY_GRIPPER)
    if sharp.surface_first[o] < sharp.surface_first[o + 1]:
        d, _ = nearest_on_surface(sharp, o, sharp_mesh_in[o], palm, wp.min(cap, other + FARTHER_M))
        if d < other:
            other = d
            other_by = int(BY_SHARP)
    # the wanted part is no farther from the palm than its point y: mostly that decides where it is out of the ball
    bound = wp.min(cap, wp.length(palm - y) + FARTHER_M)
    if room + other - bound < margin:
        wanted = float(0.0)
        if has_region:
            wanted, _ = nearest_on_surface(regions, region, region_mesh_in[o], palm, bound)
        else:
            wanted, _ = solid_distance(surfaces, o, mesh_in[o], palm, bound)
        if room + other - wanted < margin:
            margin = room + other - wanted
            by = other_by
    margin_out[row] = margin
    by_out[row] = wp.int8(by)
    up = up_in[o]
    if wp.length_sq(up) > 0.0:
        v = turned(T_world_ee_in[row], turned(inverse(attached_in[row]), up))
        # atan2 keeps its digits where acos loses them: at 0 and 180 degrees
        tilt_out[row] = wp.degrees(angle_of(wp.length(wp.vec3(v[0], v[1], 0.0)), v[2]))


@wp.kernel
def distance_of(
    first: int, cap: float,
    part: int,  # of OF_GRIPPER, OF_OBJECT, OF_WANTED, OF_SHARP
    # tables, as in `present`
    surfaces: Surfaces, mesh_in: wp.array(dtype=wp.uint64),
    regions: Surfaces, region_offset: int, region_mesh_in: wp.array(dtype=wp.uint64),
    sharp: Surfaces, sharp_mesh_in: wp.array(dtype=wp.uint64),
    gripper: Gripper,
    # trials
    active_in: wp.array(dtype=wp.bool), object_in: wp.array(dtype=int),
    attached_in: wp.array(dtype=wp.mat44), T_world_ee_in: wp.array(dtype=wp.mat44),
    R_wrist_grip_in: wp.array2d(dtype=wp.mat33), p_wrist_grip_in: wp.array2d(dtype=wp.vec3),
    R_wrist_obj_in: wp.array(dtype=wp.mat33), p_wrist_obj_in: wp.array(dtype=wp.vec3),
    point_in: wp.array(dtype=wp.vec3),  # world
    # out
    distance_out: wp.array(dtype=float),
):  # fmt: skip
    """Distance of a point from gripper, object, or a part of it (m); inf: it has none; NaN in rows that are not active."""
    row = first + wp.tid()
    distance_out[row] = wp.nan
    if not active_in[row]:
        return
    o = object_in[row]
    region = o + region_offset
    x = moved(attached_in[row], moved(inverse(T_world_ee_in[row]), point_in[row]))  # object frame
    found = float(wp.inf)
    if part == OF_GRIPPER:
        on_wrist = R_wrist_obj_in[row] * x + p_wrist_obj_in[row]
        found = _gripper_distance(gripper, R_wrist_grip_in, p_wrist_grip_in, row, on_wrist)
    elif part == OF_SHARP:
        if sharp.surface_first[o] < sharp.surface_first[o + 1]:
            found, _ = nearest_on_surface(sharp, o, sharp_mesh_in[o], x, cap)
    elif part == OF_WANTED and regions.surface_first[region] < regions.surface_first[region + 1]:
        found, _ = nearest_on_surface(regions, region, region_mesh_in[o], x, cap)
    else:
        found, _ = solid_distance(surfaces, o, mesh_in[o], x, cap)
    distance_out[row] = found
