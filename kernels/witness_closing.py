"""Which points of the object the closing pads come to stand on, and how these move when the pads' prism cuts elsewhere."""

import warp as wp

from r2h_batch.kernels.gripper import Gripper, drive_from_gap, gap_from_drive, pad_center_z_range
from r2h_batch.kernels.surface import Surfaces, center, inverse_pose, line_hit
from r2h_batch.kernels.width import FAR, between_gaps, close_on

wp.set_module_options({"enable_backward": False})

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


@wp.func
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


@wp.func
def _extreme_of_triangle(
    out: Extreme, target: float, a: wp.vec3, b: wp.vec3, c: wp.vec3, half_x: float, z_low: float, z_high: float
):
    """`out`, or the point of the triangle cut to the prism whose y is nearer to the target (see width.py)."""
    for i in range(3):
        p = wp.where(i == 0, a, wp.where(i == 1, b, c))
        q = wp.where(i == 0, b, wp.where(i == 1, c, a))
        d = q - p
        t0 = float(0.0)
        t1 = float(1.0)
        for k in range(2):
            axis = 2 * k
            low = wp.where(k == 0, -half_x, z_low)
            high = wp.where(k == 0, half_x, z_high)
            if d[axis] == 0.0:
                if p[axis] < low or p[axis] > high:
                    t0 = 2.0
            else:
                e = (low - p[axis]) / d[axis]
                f = (high - p[axis]) / d[axis]
                t0 = wp.max(t0, wp.min(e, f))
                t1 = wp.min(t1, wp.max(e, f))
        if t0 <= t1:
            out = _at_cut(out, target, p, d, t0, half_x, z_low, z_high)
            out = _at_cut(out, target, p, d, t1, half_x, z_low, z_high)
    x_min = wp.min(a[0], wp.min(b[0], c[0]))
    x_max = wp.max(a[0], wp.max(b[0], c[0]))
    z_min = wp.min(a[2], wp.min(b[2], c[2]))
    z_max = wp.max(a[2], wp.max(b[2], c[2]))
    for i in range(4):
        x = wp.where(i < 2, -half_x, half_x)
        z = wp.where(i % 2 == 0, z_low, z_high)
        if x > x_min and x < x_max and z > z_min and z < z_max:
            hit, y = line_hit(a, b, c, x, z)
            if hit != 0 and wp.abs(y - target) < out.error:
                n = wp.cross(b - a, c - a)
                out.error = wp.abs(y - target)
                out.x = wp.vec3(x, y, z)
                out.slope_x = wp.where(n[1] == 0.0, 0.0, -n[0] / n[1])
                out.slope_z = wp.where(n[1] == 0.0, 0.0, -n[2] / n[1])
    return out


@wp.kernel
def closing_witness(
    first: int,
    gripper: Gripper,
    surfaces: Surfaces,
    open_gap: float,
    whole: int,
    T_obj_ee_in: wp.array(dtype=wp.mat44),
    object_index_in: wp.array(dtype=wp.int32),
    width_in: wp.array(dtype=wp.float32),  # as the evaluator found them; NaN: empty
    opening_in: wp.array(dtype=wp.float32),
    point_out: wp.array2d(dtype=wp.vec3),  # (B, 4) low, high of what the pads meet; low, high of what is judged
    slope_x_out: wp.array2d(dtype=wp.float32),
    slope_z_out: wp.array2d(dtype=wp.float32),
    lift_out: wp.array(dtype=wp.float32),
    state_out: wp.array(dtype=wp.int32),
):
    """The object's points (object frame) between which the pads come to stand, and how these slide (`Extreme`).

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
    least = gap_from_drive(gripper, gripper.drive_upper)
    bottom = wp.max(gap - STEP_M, least)
    low, high = between_gaps(gripper, surfaces, s, R, t, bottom, gap, 0.5 * open_gap)
    state = int(MATERIAL)
    if gap <= least or gap >= open_gap:
        state = FIXED_GAP
        bottom = gap
        low, high = between_gaps(gripper, surfaces, s, R, t, gap, gap, 0.5 * open_gap)
    elif width > gap + STEP_M:
        above_low, above_high = between_gaps(gripper, surfaces, s, R, t, gap, gap, 0.5 * open_gap)
        state = wp.where(above_low - low > high - above_high, STEP_LOW, STEP_HIGH)
    state_out[trial] = state
    z_low, z_high = pad_center_z_range(gripper, bottom, gap)
    z_low = z_low - gripper.pad_half_z
    z_high = z_high + gripper.pad_half_z
    half_x = gripper.pad_half_x
    drive = drive_from_gap(gripper, gap)
    dz = gripper.pin_y * wp.cos(drive) - gripper.pin_z * wp.sin(drive)
    dg = -2.0 * (gripper.pin_y * wp.sin(drive) + gripper.pin_z * wp.cos(drive))
    lift_out[trial] = dz / dg
    a = Extreme()
    b = Extreme()
    a.error = 1.0e30
    b.error = 1.0e30
    ends_low = float(FAR)
    ends_high = float(-FAR)
    low_at = wp.vec3(0.0, 0.0, 0.0)
    high_at = wp.vec3(0.0, 0.0, 0.0)
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    ry = wp.vec3(R[1, 0], R[1, 1], R[1, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
            ball = surfaces.leaf_sphere[leaf]
            at = wp.vec3(wp.dot(rx, center(ball)), wp.dot(ry, center(ball)), wp.dot(rz, center(ball))) + t
            if whole != 0 and (at[1] - ball[3] < ends_low or at[1] + ball[3] > ends_high):
                for i in range(3 * surfaces.leaf_first[leaf], 3 * surfaces.leaf_first[leaf + 1]):
                    y = wp.dot(ry, surfaces.points[i]) + t[1]
                    if y < ends_low:
                        ends_low = y
                        low_at = surfaces.points[i]
                    if y > ends_high:
                        ends_high = y
                        high_at = surfaces.points[i]
            off_x = wp.abs(at[0]) - half_x - ball[3]
            off_z = wp.abs(at[2] - 0.5 * (z_low + z_high)) - 0.5 * (z_high - z_low) - ball[3]
            near_end = wp.min(wp.abs(at[1] - low), wp.abs(at[1] - high)) - ball[3]
            if off_x <= 0.0 and off_z <= 0.0 and near_end <= STEP_M:
                for tri in range(surfaces.leaf_first[leaf], surfaces.leaf_first[leaf + 1]):
                    u = R * surfaces.points[3 * tri] + t
                    v = R * surfaces.points[3 * tri + 1] + t
                    w = R * surfaces.points[3 * tri + 2] + t
                    a = _extreme_of_triangle(a, low, u, v, w, half_x, z_low, z_high)
                    b = _extreme_of_triangle(b, high, u, v, w, half_x, z_low, z_high)
    Rt = wp.transpose(R)
    point_out[trial, 0] = Rt * (a.x - t)
    point_out[trial, 1] = Rt * (b.x - t)
    point_out[trial, 2] = Rt * (a.x - t)
    point_out[trial, 3] = Rt * (b.x - t)
    if state >= STEP_LOW:  # the pads rise with the step, and so does where they cut
        a.slope_z = 0.0
        b.slope_z = 0.0
    for k in range(2):
        slope_x_out[trial, 2 * k] = a.slope_x
        slope_x_out[trial, 2 * k + 1] = b.slope_x
        slope_z_out[trial, 2 * k] = a.slope_z
        slope_z_out[trial, 2 * k + 1] = b.slope_z
    if whole != 0 and ends_high - ends_low > high - low:
        point_out[trial, 2] = low_at
        point_out[trial, 3] = high_at
        for k in range(2, 4):
            slope_x_out[trial, k] = 0.0
            slope_z_out[trial, k] = 0.0
