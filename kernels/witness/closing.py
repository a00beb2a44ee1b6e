"""Points of the object on which the closing pads stop, and how these move when the pads' prism cuts elsewhere.

To first order (see surface.py). The extreme y of the material in the prism is attained in one of three ways:
  at a corner of the mesh          y moves with the object alone
  where a wall cuts an edge        y also slides by dy / dx (or dy / dz) of the edge p + t d per shift of that wall
  where a face meets a corner line y slides along both walls by the face's slopes -n_x / n_y and -n_z / n_y
"""

import warp as wp

from r2h_batch.kernels.geometry.angles import sin_cos
from r2h_batch.kernels.geometry.shape import ROUNDING_M
from r2h_batch.kernels.geometry.surface import Surfaces, center, inverse_pose, line_hit
from r2h_batch.kernels.grasp.prism import FAR, clip_edge, corner
from r2h_batch.kernels.grasp.width import between_gaps, close_on
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, gap_from_drive, pad_center_z_range, table_slope

wp.set_module_options(OPTIONS)

STEP_M = wp.constant(2.0e-5)
"""Twice the accuracy to which closing locates the opening: the sweep of this much contains what the pads met."""

EMPTY = wp.constant(0)
FIXED_GAP = wp.constant(1)
MATERIAL = wp.constant(2)
STEP_LOW = wp.constant(3)
STEP_HIGH = wp.constant(4)


@wp.struct
class Extreme:
    """A surface point (ee frame) with the extreme y, and how y follows when the prism's walls cut the surface elsewhere."""

    error: float
    x: wp.vec3
    slope_x: float  # dy per shift of the wall |x| = half_x, 0: that wall does not cut here
    slope_z: float


@wp.func(inline=False)
def _at_cut(out: Extreme, target: float, p: wp.vec3, d: wp.vec3, t: float, half_x: float, z_low: float, z_high: float):
    """`out`, or the point p + t d of an edge if its y is nearer to the target."""
    x = p + t * d
    error = wp.abs(x[1] - target)
    if error < out.error:
        out.error = error
        out.x = x
        out.slope_x = 0.0
        out.slope_z = 0.0
        if t > 0.0 and t < 1.0:
            off_x = wp.abs(wp.abs(x[0]) - half_x)
            off_z = wp.min(wp.abs(x[2] - z_low), wp.abs(x[2] - z_high))
            if off_x <= off_z:
                out.slope_x = wp.where(d[0] == 0.0, 0.0, d[1] / d[0])
            else:
                out.slope_z = wp.where(d[2] == 0.0, 0.0, d[1] / d[2])
    return out


@wp.func(inline=False)
def _extreme_of_triangle(
    out: Extreme, target: float, a: wp.vec3, b: wp.vec3, c: wp.vec3, half_x: float, z_low: float, z_high: float
):
    """`out`, or the point of the triangle cut to the prism whose y is nearer to the target (grasp/prism.py)."""
    for i in range(3):
        p = wp.where(i == 0, a, wp.where(i == 1, b, c))
        q = wp.where(i == 0, b, wp.where(i == 1, c, a))
        d = q - p
        t0, t1 = clip_edge(p[0], q[0], -half_x, half_x, 0.0, 1.0)
        t0, t1 = clip_edge(p[2], q[2], z_low, z_high, t0, t1)
        if t0 <= t1:
            out = _at_cut(out, target, p, d, t0, half_x, z_low, z_high)
            out = _at_cut(out, target, p, d, t1, half_x, z_low, z_high)
    x_min = wp.min(a[0], wp.min(b[0], c[0]))
    x_max = wp.max(a[0], wp.max(b[0], c[0]))
    z_min = wp.min(a[2], wp.min(b[2], c[2]))
    z_max = wp.max(a[2], wp.max(b[2], c[2]))
    for i in range(4):
        x, z = corner(i, half_x, z_low, z_high)
        if x > x_min and x < x_max and z > z_min and z < z_max:
            hit, y = line_hit(a, b, c, x, z)
            if hit != 0 and wp.abs(y - target) < out.error:
                n = wp.cross(b - a, c - a)
                out.error = wp.abs(y - target)
                out.x = wp.vec3(x, y, z)
                out.slope_x = wp.where(n[1] == 0.0, 0.0, -n[0] / n[1])
                out.slope_z = wp.where(n[1] == 0.0, 0.0, -n[2] / n[1])
    return out


@wp.struct
class Met:
    """The pads' place after closing: state, the y between them, and the sweep's lowest gap, which cuts the prism."""

    state: int
    low: float
    high: float
    bottom: float


@wp.func
def _met(
    g: Gripper, surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, open_gap: float, gap: float, width: float
) -> Met:
    """The cause that stops the pads at a gap: material as wide as the gap, a step of the object, or the linkage's own
    end.

    `width` is the material's; the sweep from the gap to STEP_M below it contains what the pads met. On a step it is wider
    than the gap; the side that the prism just above does not have is the step's.
    """
    out = Met()
    least = gap_from_drive(g, g.drive_upper)
    out.bottom = wp.max(gap - STEP_M, least)
    low, high = between_gaps(g, surfaces, s, R, t, out.bottom, gap, 0.5 * open_gap)
    out.state = MATERIAL
    if gap <= least or gap >= open_gap:
        out.state = FIXED_GAP
        out.bottom = gap
        low, high = between_gaps(g, surfaces, s, R, t, gap, gap, 0.5 * open_gap)
    elif width > gap + STEP_M:
        above_low, above_high = between_gaps(g, surfaces, s, R, t, gap, gap, 0.5 * open_gap)
        out.state = wp.where(above_low - low > high - above_high, STEP_LOW, STEP_HIGH)
    out.low = low
    out.high = high
    return out


@wp.func
def _may_end(
    ball: wp.vec4, rx: wp.vec3, ry: wp.vec3, rz: wp.vec3, t: wp.vec3, low: float, high: float, half_x: float,
    z_low: float, z_high: float,
) -> bool:  # fmt: skip
    """Whether a ball (object frame) reaches into the prism, and to y = `low` or `high` there."""
    at = wp.vec3(wp.dot(rx, center(ball)), wp.dot(ry, center(ball)), wp.dot(rz, center(ball))) + t
    off_x = wp.abs(at[0]) - half_x - ball[3]
    off_z = wp.abs(at[2] - 0.5 * (z_low + z_high)) - 0.5 * (z_high - z_low) - ball[3]
    near_end = wp.min(wp.abs(at[1] - low), wp.abs(at[1] - high)) - ball[3]
    return off_x <= 0.0 and off_z <= 0.0 and near_end <= STEP_M


@wp.func
def _extremes(
    surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, low: float, high: float, half_x: float, z_low: float,
    z_high: float,
):  # fmt: skip
    """The points of the surface in the prism whose y are nearest to `low` and to `high`."""
    a = Extreme()
    b = Extreme()
    a.error = 1.0e30
    b.error = 1.0e30
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    ry = wp.vec3(R[1, 0], R[1, 1], R[1, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        if _may_end(surfaces.node_sphere[node], rx, ry, rz, t, low, high, half_x, z_low, z_high):
            for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
                if _may_end(surfaces.leaf_sphere[leaf], rx, ry, rz, t, low, high, half_x, z_low, z_high):
                    for tri in range(surfaces.leaf_first[leaf], surfaces.leaf_first[leaf + 1]):
                        u = R * surfaces.points[3 * tri] + t
                        v = R * surfaces.points[3 * tri + 1] + t
                        w = R * surfaces.points[3 * tri + 2] + t
                        least = wp.min(u, wp.min(v, w))
                        most = wp.max(u, wp.max(v, w))
                        in_x = least[0] <= half_x and most[0] >= -half_x
                        if in_x and least[2] <= z_high and most[2] >= z_low:
                            if wp.max(least[1] - low, low - most[1]) < a.error + ROUNDING_M:
                                a = _extreme_of_triangle(a, low, u, v, w, half_x, z_low, z_high)
                            if wp.max(least[1] - high, high - most[1]) < b.error + ROUNDING_M:
                                b = _extreme_of_triangle(b, high, u, v, w, half_x, z_low, z_high)
    return a, b


@wp.func
def _ends_along_y(surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3):
    """Least and largest y (ee frame) of a whole surface, and the points (object frame) that have them."""
    ry = wp.vec3(R[1, 0], R[1, 1], R[1, 2])
    low = float(FAR)
    high = float(-FAR)
    low_at = wp.vec3(0.0, 0.0, 0.0)
    high_at = wp.vec3(0.0, 0.0, 0.0)
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
            ball = surfaces.leaf_sphere[leaf]
            at = wp.dot(ry, center(ball)) + t[1]
            if at - ball[3] < low or at + ball[3] > high:
                for i in range(3 * surfaces.leaf_first[leaf], 3 * surfaces.leaf_first[leaf + 1]):
                    y = wp.dot(ry, surfaces.points[i]) + t[1]
                    if y < low:
                        low = y
                        low_at = surfaces.points[i]
                    if y > high:
                        high = y
                        high_at = surfaces.points[i]
    return low, high, low_at, high_at


@wp.func
def _lift(g: Gripper, gap: float):
    """By how much the pads' centres rise per metre of opening: dz/dq over dgap/dq, q the drive angle (gripper.py)."""
    if g.samples > 0:
        slope = table_slope(g, 0, gap)
        return slope[1]
    drive = drive_from_gap(g, gap)
    s, c = sin_cos(drive)
    dz = g.pin_y * c - g.pin_z * s
    dg = -2.0 * (g.pin_y * s + g.pin_z * c)
    return dz / dg


# What the opening depends on, to first order. The pads stop at what they meet within their prism (x across, z along them):
#
#     opening = high - low,    low, high = least and largest y of the surface within the prism.
#
# An extreme is a vertex, a point of an edge or of the prism's boundary; it moves with the object, and where it lies on the
# boundary it also slides along the surface as the prism moves: dy/dx and dy/dz of the surface there (`slope_x`, `slope_z`).
# The prism in turn rises as the pads open (`_lift`). Where the pads' ends stand on a step of the object the prism rises with
# it and z slopes count nothing. For grasps that are judged by the whole extent along y (`whole`) the object's ends are the
# witness as soon as they reach farther than what the pads meet; ends do not slide.
@wp.kernel
def closing_witness(
    first: int,
    # tables
    gripper: Gripper, surfaces: Surfaces, open_gap: float, whole: int,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44), object_index_in: wp.array(dtype=wp.int32),
    width_in: wp.array(dtype=wp.float32),  # as the evaluator found them; NaN: empty
    opening_in: wp.array(dtype=wp.float32),
    # out
    point_out: wp.array2d(dtype=wp.vec3),  # (B, 4) low, high of what the pads meet; low, high of what is judged
    slope_x_out: wp.array2d(dtype=wp.float32), slope_z_out: wp.array2d(dtype=wp.float32),
    lift_out: wp.array(dtype=wp.float32), state_out: wp.array(dtype=wp.int32),
):  # fmt: skip
    """The object's points (object frame) between which the pads stop, and how these slide (`Extreme`).

    `lift_out`: by how much the pads' centres rise per metre of opening. State: EMPTY, FIXED_GAP (open, or closed all the
    way), MATERIAL (the opening is the width), STEP_LOW, STEP_HIGH (the pads' ends stand on a step of the object).
    """
    trial = first + wp.tid()
    s = object_index_in[trial]
    R, t = inverse_pose(T_obj_ee_in[trial])
    width = width_in[trial]
    gap = opening_in[trial]
    if wp.isnan(width):
        state_out[trial] = EMPTY
        return
    if whole != 0 or width > open_gap:  # the gripper was left open, or another width was judged
        c = close_on(gripper, surfaces, s, R, t, open_gap)
        gap = c.opening
        width = c.high - c.low
    met = _met(gripper, surfaces, s, R, t, open_gap, gap, width)
    state_out[trial] = met.state
    lift_out[trial] = _lift(gripper, gap)
    z_low, z_high = pad_center_z_range(gripper, met.bottom, gap)
    z_low = z_low - gripper.pad_half_z
    z_high = z_high + gripper.pad_half_z
    a, b = _extremes(surfaces, s, R, t, met.low, met.high, gripper.pad_half_x, z_low, z_high)
    Rt = wp.transpose(R)
    point_out[trial, 0] = Rt * (a.x - t)
    point_out[trial, 1] = Rt * (b.x - t)
    point_out[trial, 2] = Rt * (a.x - t)
    point_out[trial, 3] = Rt * (b.x - t)
    if met.state >= STEP_LOW:  # the pads rise with the step, and so does where they cut
        a.slope_z = 0.0
        b.slope_z = 0.0
    for k in range(2):
        slope_x_out[trial, 2 * k] = a.slope_x
        slope_x_out[trial, 2 * k + 1] = b.slope_x
        slope_z_out[trial, 2 * k] = a.slope_z
        slope_z_out[trial, 2 * k + 1] = b.slope_z
    if whole != 0:
        ends_low, ends_high, low_at, high_at = _ends_along_y(surfaces, s, R, t)
        if ends_high - ends_low > met.high - met.low:
            point_out[trial, 2] = low_at
            point_out[trial, 3] = high_at
            for k in range(2, 4):
                slope_x_out[trial, k] = 0.0
                slope_z_out[trial, k] = 0.0
