"""Which points decide a margin: nearest points of surfaces and primitives, and what bounds the material between the pads.

The evaluator's kernels give certified numbers; these find, for the number that came out, the feature it belongs to.
"""

import warp as wp

from r2h_batch.kernels.body import BOX, CAPSULE, CYLINDER, HULL, Body, from_ball
from r2h_batch.kernels.gjk import gjk
from r2h_batch.kernels.gripper import (
    FIXED,
    INNER_KNUCKLE,
    PIN,
    Gripper,
    drive_from_gap,
    finger_pose,
    gap_from_drive,
    pad_center_z_range,
)
from r2h_batch.kernels.region import DEPTH_M, eroded, inner_radius, signed_distance
from r2h_batch.kernels.surface import Surfaces, center, inverse_pose, line_hit
from r2h_batch.kernels.width import FAR, between_gaps, close_on

wp.set_module_options({"enable_backward": False})

MEET_M = wp.constant(1.0e-6)
RIDGE_M = wp.constant(2.0e-5)
REFINEMENTS = wp.constant(8)
STEP_M = wp.constant(2.0e-5)
"""Twice the accuracy to which closing locates the opening: the sweep of this much contains what the pads met."""


EMPTY = wp.constant(0)
FIXED_GAP = wp.constant(1)
MATERIAL = wp.constant(2)
STEP_LOW = wp.constant(3)
STEP_HIGH = wp.constant(4)


@wp.struct
class Nearest:
    """Signed distance of a surface's point to a primitive, the point, and the direction that takes it away (one frame)."""

    distance: float
    x: wp.vec3
    n: wp.vec3


@wp.func
def outwards(kind: int, size: wp.vec3, x: wp.vec3):
    """Unit gradient of a primitive's signed distance at x; on a ridge one of its one-sided limits."""
    n = wp.vec3(1.0, 0.0, 0.0)
    shape = Body()
    shape.kind = kind
    shape.size = size
    if kind < CYLINDER:
        y = wp.vec3(0.0, 0.0, 0.0)
        if kind == CAPSULE:
            y = wp.vec3(0.0, 0.0, wp.clamp(x[2], -size[1], size[1]))
        if wp.length(x - y) > 0.0:
            n = wp.normalize(x - y)
    else:
        away = -from_ball(shape, x)
        if wp.length(away) > MEET_M:
            n = wp.normalize(away)
        elif kind == BOX:
            least = float(-1.0e30)
            for k in range(3):
                q = wp.abs(x[k]) - size[k]
                if q > least:
                    least = q
                    n = wp.vec3(0.0, 0.0, 0.0)
                    n[k] = wp.where(x[k] < 0.0, -1.0, 1.0)
        else:
            r = wp.sqrt(x[0] * x[0] + x[1] * x[1])
            if wp.abs(x[2]) - size[1] > r - size[0]:
                n = wp.vec3(0.0, 0.0, wp.where(x[2] < 0.0, -1.0, 1.0))
            elif r > 0.0:
                n = wp.vec3(x[0] / r, x[1] / r, 0.0)
    return n


@wp.func
def outwards_inside(kind: int, size: wp.vec3, x: wp.vec3, u: wp.vec3, v: wp.vec3, w: wp.vec3):
    """How the least signed distance of triangle uvw changes per motion of it, x being its deepest point in a primitive.

    The deepest point mostly lies on a ridge, equally far from two or three faces. There the change is the mixture of
    their normals (Kuhn-Tucker multipliers) that is square to what x may slide along: an edge, or the triangle.
    """
    n = outwards(kind, size, x)
    if kind >= CYLINDER:
        q = wp.vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        axes = wp.mat33(
            wp.sign(x[0]), 0.0, 0.0,
            0.0, wp.sign(x[1]), 0.0,
            0.0, 0.0, wp.sign(x[2]),
        )  # fmt: skip
        if kind == CYLINDER:  # its side and its end
            r = wp.sqrt(x[0] * x[0] + x[1] * x[1])
            q = wp.vec3(r - size[0], -1.0e30, wp.abs(x[2]) - size[1])
            if r > 0.0:
                axes[0, 0] = x[0] / r
                axes[0, 1] = x[1] / r
            axes[1, 1] = 0.0
        top = wp.max(q[0], wp.max(q[1], q[2]))
        active = int(0)
        for k in range(3):
            if q[k] > top - RIDGE_M:
                active += 1
        if active > 1:
            edge = v - u
            nearest = wp.length_sq(wp.cross(edge, x - u)) / wp.max(wp.length_sq(edge), 1.0e-30)
            for k in range(2):
                other = wp.where(k == 0, w - v, u - w)
                start = wp.where(k == 0, v, w)
                d = wp.length_sq(wp.cross(other, x - start)) / wp.max(wp.length_sq(other), 1.0e-30)
                if d < nearest:
                    nearest = d
                    edge = other
            square = wp.cross(v - u, w - u)
            mixed = wp.vec3(0.0, 0.0, 0.0)
            total = float(0.0)
            for k in range(3):
                if q[k] > top - RIDGE_M:
                    face = wp.vec3(axes[k, 0], axes[k, 1], axes[k, 2])
                    weight = wp.abs(wp.dot(face, square))
                    if active == 2 and nearest < RIDGE_M * RIDGE_M:
                        weight = float(0.0)
                        for m in range(3):
                            if m != k and q[m] > top - RIDGE_M:
                                weight = wp.abs(wp.dot(wp.vec3(axes[m, 0], axes[m, 1], axes[m, 2]), edge))
                    mixed = mixed + weight * face
                    total += weight
            if total > 0.0:
                n = mixed / total
    return n


@wp.func
def closest_on_triangle(x: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3):
    """The triangle's point nearest to x (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab = b - a
    ac = c - a
    d1 = wp.dot(ab, x - a)
    d2 = wp.dot(ac, x - a)
    d3 = wp.dot(ab, x - b)
    d4 = wp.dot(ac, x - b)
    d5 = wp.dot(ab, x - c)
    d6 = wp.dot(ac, x - c)
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    y = a
    if d1 <= 0.0 and d2 <= 0.0:
        y = a
    elif d3 >= 0.0 and d4 <= d3:
        y = b
    elif d6 >= 0.0 and d5 <= d6:
        y = c
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        y = a + (d1 / (d1 - d3)) * ab
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        y = a + (d2 / (d2 - d6)) * ac
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        y = b + ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b)
    else:
        total = va + vb + vc
        if total > 0.0:
            y = a + (vb / total) * ab + (vc / total) * ac
    return y


@wp.func
def triangle_witness(
    points: wp.array(dtype=wp.vec3),
    start: int,
    kind: int,
    size: wp.vec3,
    R: wp.mat33,
    p: wp.vec3,
    best: float,
):
    """The triangle's point of least signed distance to a primitive, in the primitive's frame; distance `best` if not below.

    The triangle is points[start : start + 3]; R, p take it to the primitive's frame.
    """
    out = Nearest()
    out.distance = best
    u = R * points[start] + p
    v = R * points[start + 1] + p
    w = R * points[start + 2] + p
    middle = (u + v + w) / 3.0
    r = wp.sqrt(wp.max(wp.length_sq(u - middle), wp.max(wp.length_sq(v - middle), wp.length_sq(w - middle))))
    if signed_distance(kind, size, middle) - r >= best:
        return out
    for k in range(3):
        x = wp.where(k == 0, u, wp.where(k == 1, v, w))
        s = signed_distance(kind, size, x)
        if s < out.distance:
            out.distance = s
            out.x = x
    depth = wp.max(-out.distance, 0.0)
    a = Body()
    a.kind = HULL
    a.start = start
    a.count = 3
    d = gjk(a, R, p, points, eroded(kind, size, depth), points, p - middle, 1.0e30, 0.0)
    x = d.point
    if d.upper <= MEET_M:  # deeper than its corners: where the primitive, eroded until it just touches, is met
        low = float(depth)
        high = float(inner_radius(kind, size))
        while high - low > DEPTH_M:
            half = 0.5 * (low + high)
            d = gjk(a, R, p, points, eroded(kind, size, half), points, p - middle, 0.0, 0.0)
            if d.upper <= MEET_M:
                low = half
            else:
                high = half
                x = d.point
    elif depth == 0.0:
        shape = Body()
        shape.kind = kind
        shape.size = size
        if kind <= CAPSULE:
            shape.radius = size[0]
        for _ in range(REFINEMENTS):  # GJK stops at 1e-6 m of distance, which leaves the direction of short ones open
            x = closest_on_triangle(x + from_ball(shape, x), u, v, w)
    s = signed_distance(kind, size, x)
    if s < out.distance:
        out.distance = s
        out.x = x
    if out.distance < wp.min(best, -RIDGE_M):
        out.n = outwards_inside(kind, size, out.x, u, v, w)
    elif out.distance < best:
        out.n = outwards(kind, size, out.x)
    return out


@wp.func
def finger_velocity(g: Gripper, i: int, gap: float, x: wp.vec3):
    """How a point x of primitive i (ee frame) moves per metre of opening; zero at the ends of the linkage's range."""
    out = wp.vec3(0.0, 0.0, 0.0)
    drive = drive_from_gap(g, gap)
    motion = g.motion[i]
    if motion != FIXED and drive > g.drive_lower and drive < g.drive_upper:
        side = g.side[i]
        c = wp.cos(drive)
        s = wp.sin(drive)
        turns = -1.0 / (2.0 * (g.pin_y * s + g.pin_z * c))  # rad per metre
        if motion == PIN:
            out = turns * wp.vec3(0.0, -side * (s * g.pin_y + c * g.pin_z), c * g.pin_y - s * g.pin_z)
        else:
            y = side * g.driver_pivot_y
            z = g.driver_pivot_z
            if motion == INNER_KNUCKLE:
                y = side * g.inner_knuckle_pivot_y
                z = g.inner_knuckle_pivot_z
            out = side * turns * wp.vec3(0.0, -(x[2] - z - g.z_ee_gripper), x[1] - y)
    return out


@wp.kernel
def surface_witness(
    first: int,
    gripper: Gripper,
    surfaces: Surfaces,
    surface_offset: int,
    used: int,
    T_obj_ee_in: wp.array(dtype=wp.mat44),
    object_index_in: wp.array(dtype=wp.int32),
    opening_in: wp.array(dtype=wp.float32),
    bound_in: wp.array(dtype=wp.float32),
    part_out: wp.array(dtype=wp.int32),
    distance_out: wp.array(dtype=wp.float32),
    point_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
    finger_out: wp.array(dtype=wp.vec3),
):
    """The surface's point of least signed distance to the gripper's primitives in `used`, below `bound_in` (else part -1).

    Point in the object's frame; normal in the ee frame, pointing from the gripper to the surface; `finger_out`: how the
    primitive's point there moves per metre of opening, ee frame.
    """
    trial = first + wp.tid()
    s = object_index_in[trial] + surface_offset
    R_ee_obj, t_ee_obj = inverse_pose(T_obj_ee_in[trial])
    drive = drive_from_gap(gripper, opening_in[trial])
    best = float(bound_in[trial])
    part = int(-1)
    point = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    for i in range(gripper.kind.shape[0]):
        if (used >> i) & 1 != 0:
            Rg, pg = finger_pose(gripper, i, drive)
            R = wp.transpose(Rg) * R_ee_obj
            p = wp.transpose(Rg) * (t_ee_obj - pg)
            kind = gripper.kind[i]
            size = gripper.size[i]
            for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
                ball = surfaces.node_sphere[node]
                if signed_distance(kind, size, R * center(ball) + p) - ball[3] < best:
                    for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
                        ball = surfaces.leaf_sphere[leaf]
                        if signed_distance(kind, size, R * center(ball) + p) - ball[3] < best:
                            for tri in range(surfaces.leaf_first[leaf], surfaces.leaf_first[leaf + 1]):
                                near = triangle_witness(surfaces.points, 3 * tri, kind, size, R, p, best)
                                if near.distance < best:
                                    best = near.distance
                                    part = i
                                    point = wp.transpose(R) * (near.x - p)
                                    normal = Rg * near.n
    part_out[trial] = part
    distance_out[trial] = best
    point_out[trial] = point
    normal_out[trial] = normal
    if part >= 0:
        x = R_ee_obj * point + t_ee_obj
        finger_out[trial] = finger_velocity(gripper, part, opening_in[trial], x)


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
    c = close_on(gripper, surfaces, s, R, t, open_gap)
    if c.found == 0:
        state_out[trial] = EMPTY
        return
    gap = c.opening
    least = gap_from_drive(gripper, gripper.drive_upper)
    bottom = wp.max(gap - STEP_M, least)
    low, high = between_gaps(gripper, surfaces, s, R, t, bottom, gap, 0.5 * open_gap)
    state = int(MATERIAL)
    if gap <= least or gap >= open_gap:
        state = FIXED_GAP
        bottom = gap
        low, high = between_gaps(gripper, surfaces, s, R, t, gap, gap, 0.5 * open_gap)
    elif c.high - c.low > gap + STEP_M:
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
