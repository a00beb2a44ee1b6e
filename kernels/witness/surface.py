"""Which points decide a clearance: where a surface is nearest to, or deepest in, the gripper's primitives.

The evaluator's kernels give certified numbers; these find, for the number that came out, the feature it belongs to.

Why a point and a direction are enough: a clearance is a minimum, c(m) = min over x of f(x, m), x running over surface
points and m being the motion. Where one x attains it, dc/dm is that of f at this x held still (envelope theorem, Danskin
1966). With f the signed distance of a point to a primitive its gradient is the unit normal n, so c changes by
n . (move of the surface's point - move of the primitive's point). Where several attain it, one of their values is given.
"""

import warp as wp

from r2h_batch.kernels.geometry.angles import sin_cos
from r2h_batch.kernels.geometry.closest import TOUCH_M, closest_on_triangle, eroded, inner_radius, signed_distance
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.shape import BOX, CAPSULE, CYLINDER, Shape, from_ball, triangle_shape
from r2h_batch.kernels.geometry.surface import Surfaces, center, inverse_pose
from r2h_batch.kernels.grasp.triangle import DEPTH_M, GJK_M, apart
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import (
    FIXED,
    INNER_KNUCKLE,
    PIN,
    TABLE,
    Gripper,
    drive_from_gap,
    finger_pose,
    table_at,
    table_slope,
)

wp.set_module_options(OPTIONS)

RIDGE_M = wp.constant(2.0e-5)
REFINEMENTS = wp.constant(8)


@wp.struct
class SurfacePoint:
    """Signed distance of a surface's point to a primitive, the point, and the direction that takes it away (one frame)."""

    distance: float
    x: wp.vec3
    n: wp.vec3


@wp.func
def outwards(kind: int, size: wp.vec3, x: wp.vec3):
    """Unit gradient of a primitive's signed distance at x; on a ridge one of its one-sided limits."""
    n = wp.vec3(1.0, 0.0, 0.0)
    shape = Shape()
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
        if wp.length(away) > TOUCH_M:
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
        # faces as near as the nearest, to RIDGE_M: their normals are mixed
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
            # weights that make the mixture square to what the deepest point may slide along: its edge, else the triangle
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
def _deepest(
    points: wp.array(dtype=wp.vec3), triangle: Shape, kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3,
    depth: float,
    u: wp.vec3,  # the triangle's corners in the primitive's frame
    v: wp.vec3, w: wp.vec3,
):  # fmt: skip
    """The deepest point in a primitive of a triangle that is deeper than `depth`: where eroded, it is only just met.

    The primitive eroded by d (its points at least d deep) shrinks as d grows; bisection finds the d at which the triangle
    leaves it. GJK's nearest point just beyond is the answer, but for DEPTH_M.
    """
    middle = (u + v + w) / 3.0
    x = middle
    low = float(depth)
    high = float(inner_radius(kind, size))
    apart = int(0)
    while high - low > DEPTH_M:
        half = 0.5 * (low + high)
        d = gjk(triangle, R, p, points, eroded(kind, size, half), points, p - middle, 0.0, 0.0)
        if d.upper <= TOUCH_M:
            low = half
        else:
            high = half
            x = d.point
            apart = 1
    if apart == 0:  # as deep as can be: where the triangle runs through the primitive's innermost points
        x = middle
        for _ in range(REFINEMENTS):
            x = closest_on_triangle(x + from_ball(eroded(kind, size, low), x), u, v, w)
    return x


@wp.func
def _polished(kind: int, size: wp.vec3, x: wp.vec3, u: wp.vec3, v: wp.vec3, w: wp.vec3):
    """Triangle uvw's nearest point to a primitive it keeps clear of, from a near one: projections onto both in turn.

    GJK stops at 1e-6 m of distance, which leaves the direction of short ones open.
    """
    shape = Shape()
    shape.kind = kind
    shape.size = size
    if kind <= CAPSULE:
        shape.radius = size[0]
    for _ in range(REFINEMENTS):
        x = closest_on_triangle(x + from_ball(shape, x), u, v, w)
    return x


@wp.func
def triangle_witness(
    points: wp.array(dtype=wp.vec3), start: int, kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3, best: float
):
    """The triangle's point of least signed distance to a primitive, in the primitive's frame; distance `best` if not below.

    The triangle is points[start : start + 3]; R, p take it to the primitive's frame.
    """
    out = SurfacePoint()
    out.distance = best
    u = R * points[start] + p
    v = R * points[start + 1] + p
    w = R * points[start + 2] + p
    middle = (u + v + w) / 3.0
    r = wp.sqrt(wp.max(wp.length_sq(u - middle), wp.max(wp.length_sq(v - middle), wp.length_sq(w - middle))))
    if signed_distance(kind, size, middle) - r >= best:
        return out
    if apart(kind, size, wp.min(u, wp.min(v, w)), wp.max(u, wp.max(v, w))) >= wp.max(best, 0.0) + GJK_M:
        return out
    for k in range(3):
        x = wp.where(k == 0, u, wp.where(k == 1, v, w))
        s = signed_distance(kind, size, x)
        if s < out.distance:
            out.distance = s
            out.x = x
    depth = wp.max(-out.distance, 0.0)
    a = triangle_shape(start)
    # at this distance from the primitive, or from its points that are at least `depth` deep, a corner is the nearest
    needed = wp.max(out.distance, 0.0) + GJK_M
    d = gjk(a, R, p, points, eroded(kind, size, depth), points, p - middle, needed, 0.0)
    if d.lower < needed:
        x = d.point
        if d.upper <= TOUCH_M:
            x = _deepest(points, a, kind, size, R, p, depth, u, v, w)
        elif depth == 0.0:
            x = _polished(kind, size, x, u, v, w)
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
        if motion >= TABLE:
            at = table_at(g, motion - TABLE, gap)
            slope = table_slope(g, motion - TABLE, gap)
            turning = side * slope[2]  # about x through the ee frame's origin, which the shift has carried along
            return wp.vec3(0.0, side * slope[0] - turning * (x[2] - at[1]), slope[1] + turning * (x[1] - side * at[0]))
        s, c = sin_cos(drive)
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


@wp.func
def _box_apart(kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3, middle: wp.vec3, half: wp.vec3) -> float:
    """A lower bound of the distance between a primitive and the box middle +- half, which R, p take to its frame."""
    at = R * middle + p
    reach = wp.vec3(0.0, 0.0, 0.0)
    for k in range(3):
        reach[k] = wp.abs(R[k, 0]) * half[0] + wp.abs(R[k, 1]) * half[1] + wp.abs(R[k, 2]) * half[2]
    return apart(kind, size, at - reach, at + reach)


@wp.kernel
def surface_witness(
    first: int,
    # tables
    gripper: Gripper, surfaces: Surfaces, surface_offset: int, used: int,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44), object_index_in: wp.array(dtype=wp.int32),
    opening_in: wp.array(dtype=wp.float32), bound_in: wp.array(dtype=wp.float32),
    # out
    part_out: wp.array(dtype=wp.int32), point_out: wp.array(dtype=wp.vec3), normal_out: wp.array(dtype=wp.vec3),
    finger_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The surface's point of least signed distance to the gripper's primitives in `used`, below `bound_in` (else part -1).

    Point in the object's frame; normal in the ee frame, pointing from the gripper to the surface; `finger_out`: how the
    primitive's point there moves per metre of opening, ee frame.
    """
    trial = first + wp.tid()
    best = float(bound_in[trial])
    part = int(-1)
    point = wp.vec3(0.0, 0.0, 0.0)
    normal = wp.vec3(0.0, 0.0, 0.0)
    if best > -wp.inf:
        o = object_index_in[trial]
        s = o + surface_offset
        middle = 0.5 * (surfaces.low[o] + surfaces.high[o])
        half = 0.5 * (surfaces.high[o] - surfaces.low[o])
        R_ee_obj, t_ee_obj = inverse_pose(T_obj_ee_in[trial])
        drive = drive_from_gap(gripper, opening_in[trial])
        for i in range(gripper.kind.shape[0]):
            if (used >> i) & 1 != 0:
                Rg, pg = finger_pose(gripper, i, drive)
                R = wp.transpose(Rg) * R_ee_obj
                p = wp.transpose(Rg) * (t_ee_obj - pg)
                kind = gripper.kind[i]
                size = gripper.size[i]
                nodes = surfaces.surface_first[s + 1]
                far = wp.max(best, 0.0) + GJK_M
                if surface_offset == 0 and _box_apart(kind, size, R, p, middle, half) >= far:  # regions may be larger
                    nodes = 0
                for node in range(surfaces.surface_first[s], nodes):
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
        if part >= 0:
            x = R_ee_obj * point + t_ee_obj
            finger_out[trial] = finger_velocity(gripper, part, opening_in[trial], x)
    part_out[trial] = part
    point_out[trial] = point
    normal_out[trial] = normal


@wp.kernel
def nearest_of_points(
    first: int,
    # trials
    point_in: wp.array2d(dtype=wp.vec3),  # (O, P) points of each object, object frame
    counts_in: wp.array2d(dtype=wp.bool),  # (O, P) which of them count
    object_index_in: wp.array(dtype=wp.int32), wanted_in: wp.array(dtype=wp.bool),
    x_in: wp.array(dtype=wp.vec3),  # object frame
    # out
    found_out: wp.array(dtype=wp.bool), nearest_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The nearest to x of an object's points that count."""
    trial = first + wp.tid()
    found_out[trial] = False
    if wanted_in[trial]:
        o = object_index_in[trial]
        best = float(1.0e30)
        for k in range(point_in.shape[1]):
            if counts_in[o, k]:
                d = wp.length_sq(point_in[o, k] - x_in[trial])
                if d < best:
                    best = d
                    nearest_out[trial] = point_in[o, k]
                    found_out[trial] = True
