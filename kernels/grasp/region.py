"""Clearance between gripper primitives and a triangle surface: the least signed distance of its points.

The signed distance of a point to a primitive is its distance outside and minus its depth (distance to the nearest face)
inside. Over a solid the least value is found on its surface, unless the primitive's middle is buried in it: then it is
minus the primitive's inner radius. Depths are thus lower bounds on how far the bodies would have to be moved apart.
"""

import warp as wp

from r2h_batch.kernels.geometry.body import BOX, CAPSULE, HULL, SPHERE, Body
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.primitives import TOUCH_M, eroded, inner_radius, signed_distance
from r2h_batch.kernels.geometry.surface import Surfaces, center, inverse_pose, line_hit, may_hit
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, finger_pose

wp.set_module_options(OPTIONS)

DEPTH_M = wp.constant(5.0e-6)
UNASKED = wp.constant(-1.0e29)
LISTED = wp.constant(128)
GJK_M = wp.constant(1.0e-5)
"""What GJK gives may be this much below the distance: a triangle that is farther than `best` and this cannot lower it."""


@wp.func
def _apart(kind: int, size: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """A lower bound of the distance between a primitive and what lies in the box [low, high], both in its frame."""
    half = size
    if kind == CAPSULE:
        half = wp.vec3(size[0], size[0], size[1] + size[0])
    elif kind == SPHERE:
        half = wp.vec3(size[0], size[0], size[0])
    elif kind != BOX:
        half = wp.vec3(size[0], size[0], size[1])
    a = wp.max(low - half, -half - high)
    return wp.length(wp.max(a, wp.vec3(0.0, 0.0, 0.0)))


@wp.func
def _turned_half(R: wp.mat33, half: wp.vec3) -> wp.vec3:
    """Half sides of a box that holds a box turned by R."""
    return wp.vec3(
        wp.abs(R[0, 0]) * half[0] + wp.abs(R[0, 1]) * half[1] + wp.abs(R[0, 2]) * half[2],
        wp.abs(R[1, 0]) * half[0] + wp.abs(R[1, 1]) * half[1] + wp.abs(R[1, 2]) * half[2],
        wp.abs(R[2, 0]) * half[0] + wp.abs(R[2, 1]) * half[1] + wp.abs(R[2, 2]) * half[2],
    )


@wp.func
def triangle_clearance(
    points: wp.array(dtype=wp.vec3), tri: int, kind: int, size: wp.vec3, R: wp.mat33, p: wp.vec3, best: float
) -> float:
    """Least signed distance of a triangle's points to a primitive, or something >= best if it is not below `best`.

    R, p take the triangle to the primitive's frame. Apart, the distance is GJK's. Where they meet, the triangle is at least
    d deep exactly when it meets the primitive eroded by d: bisection on d between what is known and what can be.
    """
    u = R * points[3 * tri] + p
    v = R * points[3 * tri + 1] + p
    w = R * points[3 * tri + 2] + p
    # a ball about the triangle decides most
    middle = (u + v + w) / 3.0
    r = wp.sqrt(wp.max(wp.length_sq(u - middle), wp.max(wp.length_sq(v - middle), wp.length_sq(w - middle))))
    least = signed_distance(kind, size, middle) - r  # no point of the triangle is nearer
    clearance = float(least)
    if least < best:
        # a box about it, of what is left
        if _apart(kind, size, wp.min(u, wp.min(v, w)), wp.max(u, wp.max(v, w))) >= wp.max(best, 0.0) + GJK_M:
            return best
        # its corners are points of it too
        clearance = wp.min(
            wp.min(best, signed_distance(kind, size, u)),
            wp.min(signed_distance(kind, size, v), signed_distance(kind, size, w)),
        )
        depth = wp.max(-clearance, 0.0)
        probe = wp.where(depth > 0.0, depth + DEPTH_M, 0.0)  # known to be `depth` deep: is it any deeper?
        high = wp.min(inner_radius(kind, size), -least)
        if probe > 0.0 and probe >= high:
            return clearance
        a = Body()
        a.kind = HULL
        a.start = 3 * tri
        a.count = 3
        d = gjk(a, R, p, points, eroded(kind, size, probe), points, p - middle, wp.max(clearance, 0.0), 0.0)
        if d.upper > TOUCH_M:
            if probe == 0.0:
                clearance = wp.min(clearance, d.lower)
        else:
            low = float(probe)
            while high - low > DEPTH_M:
                half = 0.5 * (low + high)
                d = gjk(a, R, p, points, eroded(kind, size, half), points, p - middle, 0.0, 0.0)
                if d.upper <= TOUCH_M:
                    low = half
                else:
                    high = half
            clearance = -low
    return clearance


@wp.func
def _in_box(surfaces: Surfaces, s: int, x: wp.vec3) -> bool:
    """Whether x (object frame) lies in surface s's bounding box."""
    low = surfaces.low[s]
    high = surfaces.high[s]
    return x[0] > low[0] and x[0] < high[0] and x[1] > low[1] and x[1] < high[1] and x[2] > low[2] and x[2] < high[2]


@wp.func
def _inside(surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, x: wp.vec3) -> bool:
    """Whether x (ee frame) lies inside closed surface s; R, t: object to ee frame."""
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    # crossings of the half line from x along -y: 0 outside a closed surface
    winding = int(0)
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        ball = surfaces.node_sphere[node]
        at = center(ball)
        if wp.abs(wp.dot(rx, at) + t[0] - x[0]) <= ball[3] and wp.abs(wp.dot(rz, at) + t[2] - x[2]) <= ball[3]:
            for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
                ball = surfaces.leaf_sphere[leaf]
                at = center(ball)
                if wp.abs(wp.dot(rx, at) + t[0] - x[0]) <= ball[3] and wp.abs(wp.dot(rz, at) + t[2] - x[2]) <= ball[3]:
                    for tri in range(surfaces.leaf_first[leaf], surfaces.leaf_first[leaf + 1]):
                        if not may_hit(surfaces, tri, rz, x[2] - t[2]):
                            continue
                        a = R * surfaces.points[3 * tri] + t
                        b = R * surfaces.points[3 * tri + 1] + t
                        c = R * surfaces.points[3 * tri + 2] + t
                        hit, y = line_hit(a, b, c, x[0], x[2])
                        if y < x[1]:
                            winding += hit
    return winding != 0


@wp.func
def _box_half(kind: int, size: wp.vec3, R: wp.mat33) -> wp.vec3:
    """Half sides of a box along the outer axes that holds a primitive turned by R; a little more, for rounding."""
    h = wp.vec3(1.0e-6, 1.0e-6, 1.0e-6)
    for k in range(3):
        if kind == BOX:
            h[k] += wp.abs(R[k, 0]) * size[0] + wp.abs(R[k, 1]) * size[1] + wp.abs(R[k, 2]) * size[2]
        elif kind != SPHERE:
            h[k] += wp.abs(R[k, 2]) * size[1] + size[0]
        else:
            h[k] += size[0]
    return h


@wp.func
def _near_groups(
    low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3), x: wp.vec3, radius: float, mask: wp.array(dtype=int)
) -> int:
    """Bits of the primitives whose group's box is nearer than `radius` to x (ee frame)."""
    near = int(0)
    for g in range(3):
        a = low[g] - x
        b = x - high[g]
        d = wp.vec3(wp.max(wp.max(a[0], b[0]), 0.0), wp.max(wp.max(a[1], b[1]), 0.0), wp.max(wp.max(a[2], b[2]), 0.0))
        if wp.dot(d, d) < radius * radius:
            near = near | mask[g]
    return near


@wp.func
def _place_primitives(
    gripper: Gripper,
    used: int,
    drive: float,
    R_ee_obj: wp.mat33,
    t_ee_obj: wp.vec3,
    trial: int,
    R_out: wp.array2d(dtype=wp.mat33),
    p_out: wp.array2d(dtype=wp.vec3),
    low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3),
    mask_out: wp.array(dtype=int),
    middle_out: wp.array(dtype=wp.vec3),
):
    """Writes each primitive's pose (object to primitive frame) and middle (ee frame).

    And of the body and each finger the box about its primitives (ee frame) and their bits.
    """
    for g in range(3):
        low_out[g] = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        high_out[g] = wp.vec3(-1.0e30, -1.0e30, -1.0e30)
    for i in range(gripper.kind.shape[0]):
        R, p = finger_pose(gripper, i, drive)
        if (used >> i) & 1 != 0:
            g = int(gripper.side[i]) + 1
            half = _box_half(gripper.kind[i], gripper.size[i], R)
            low_out[g] = wp.min(low_out[g], p - half)
            high_out[g] = wp.max(high_out[g], p + half)
            mask_out[g] = mask_out[g] | (1 << i)
        middle_out[i] = p
        R_out[trial, i] = wp.transpose(R) * R_ee_obj
        p_out[trial, i] = wp.transpose(R) * (t_ee_obj - p)


@wp.func
def _most_buried(
    gripper: Gripper,
    used: int,
    middle: wp.array(dtype=wp.vec3),
    surfaces: Surfaces,
    s: int,
    R_ee_obj: wp.mat33,
    t_ee_obj: wp.vec3,
    best: float,
):
    """`best` or, when less, minus the inner radius of a primitive whose middle lies in the solid; which one, or -1."""
    witness = int(-1)
    for i in range(gripper.kind.shape[0]):
        if (used >> i) & 1 != 0:
            p = middle[i]
            x = wp.transpose(R_ee_obj) * (p - t_ee_obj)
            r = inner_radius(gripper.kind[i], gripper.size[i])
            if -r < best and _in_box(surfaces, s, x) and _inside(surfaces, s, R_ee_obj, t_ee_obj, p):
                best = -r
                witness = i
    return best, witness


@wp.func
def _leaf_clearance(
    gripper: Gripper,
    surfaces: Surfaces,
    leaf: int,
    near: int,
    trial: int,
    R: wp.array2d(dtype=wp.mat33),
    p: wp.array2d(dtype=wp.vec3),
    best: float,
    witness: int,
):
    """`best` and `witness` after a leaf's triangles and the primitives in bit mask `near`."""
    ball = surfaces.leaf_sphere[leaf]
    for i in range(gripper.kind.shape[0]):
        if (near >> i) & 1 != 0:
            Ri = R[trial, i]
            pi = p[trial, i]
            kind = gripper.kind[i]
            size = gripper.size[i]
            x = Ri * center(ball) + pi
            if signed_distance(kind, size, x) - ball[3] >= best:
                continue
            half = _turned_half(Ri, surfaces.leaf_half[leaf])
            if _apart(kind, size, x - half, x + half) < wp.max(best, 0.0) + GJK_M:
                for tri in range(surfaces.leaf_first[leaf], surfaces.leaf_first[leaf + 1]):
                    d = triangle_clearance(surfaces.points, tri, kind, size, Ri, pi, best)
                    if d < best:
                        best = d
                        witness = i
    return best, witness


@wp.func
def _points_clearance(
    gripper: Gripper,
    surfaces: Surfaces,
    s: int,
    R_ee_obj: wp.mat33,
    t_ee_obj: wp.vec3,
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
    mask: wp.array(dtype=int),
    trial: int,
    R: wp.array2d(dtype=wp.mat33),
    p: wp.array2d(dtype=wp.vec3),
    enough: float,
    best: float,
    witness: int,
):
    """`best` and `witness` after one point of every node; no more are looked at once `best` is below `enough`."""
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        if best < enough:
            break
        x = surfaces.points[3 * surfaces.leaf_first[surfaces.node_first[node]]]
        ball = surfaces.node_sphere[node]
        around = _near_groups(low, high, R_ee_obj * center(ball) + t_ee_obj, wp.max(best, 0.0) + ball[3], mask)
        if around == 0:
            continue
        for i in range(gripper.kind.shape[0]):
            if (around >> i) & 1 != 0:
                d = signed_distance(gripper.kind[i], gripper.size[i], R[trial, i] * x + p[trial, i])
                if d < best:
                    best = d
                    witness = i
    return best, witness


# Branch and bound over a surface in two levels of bounding spheres (nodes, their leaves, triangles). A primitive's signed
# distance f never changes faster than the point it is asked at, so |f(x) - f(c)| <= r for every x of a sphere (c, r): what
# has f(c) - r >= best holds nothing nearer than `best`. In this order, as each lowers `best` for the next:
#
# 1. primitives that lie in the solid: the depth of their cores (`_most_buried`);
# 2. one vertex of every node: an upper bound that spares most triangles;
# 3. nodes by groups of primitives (chassis, each finger) with a box about each, then by primitive, then their leaves. A box
#    about a leaf or a triangle, along the primitive's axes, says sooner than a sphere that something flat is too far away;
#    GJK is asked of what neither rules out.
#
# A primitive's frame (object to primitive) is needed for every sphere: it is written once to the scratch arrays.
@wp.kernel
def primitives_clearance(
    first: int,
    # tables
    gripper: Gripper,
    surfaces: Surfaces,
    surface_offset: int,
    used: int,
    solid: int,
    cap: float,
    enough: float,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44),
    object_index_in: wp.array(dtype=wp.int32),
    opening_in: wp.array(dtype=wp.float32),
    # scratch: (B, G) object to primitive frame
    R_scratch: wp.array2d(dtype=wp.mat33),
    p_scratch: wp.array2d(dtype=wp.vec3),
    # out
    clearance_out: wp.array(dtype=wp.float32),
    witness_out: wp.array(dtype=wp.int32),
):
    """Least clearance (m) of the primitives in bit mask `used` at each trial's opening, and which one has it.

    Exact between `enough` and `cap`; `cap` and -1 beyond; something below `enough` where it is less than that (who only asks
    whether a gripper is clear need not know how deep it is not). The surface is object_index + surface_offset; `solid` counts
    its inside too.

    Branch and bound. `best` starts at the cap and falls: with primitives buried in the solid, with one point of every
    node, and then with the triangles of nodes and leaves whose sphere a primitive may come nearer to than `best`.
    """
    trial = first + wp.tid()
    s = object_index_in[trial] + surface_offset
    R_ee_obj, t_ee_obj = inverse_pose(T_obj_ee_in[trial])
    drive = drive_from_gap(gripper, opening_in[trial])
    best = float(cap)
    witness = int(-1)
    count = gripper.kind.shape[0]
    # boxes (ee frame) around the body's and each finger's primitives: most of the surface is far from all three
    low = wp.zeros(shape=3, dtype=wp.vec3)
    high = wp.zeros(shape=3, dtype=wp.vec3)
    mask = wp.zeros(shape=3, dtype=int)
    middle = wp.zeros(shape=31, dtype=wp.vec3)  # as many as a bit mask has room for
    _place_primitives(gripper, used, drive, R_ee_obj, t_ee_obj, trial, R_scratch, p_scratch, low, high, mask, middle)
    if (
        enough > UNASKED
    ):  # most that are not clear are found out by a point: that is cheaper than what lies in the solid
        best, witness = _points_clearance(
            gripper,
            surfaces,
            s,
            R_ee_obj,
            t_ee_obj,
            low,
            high,
            mask,
            trial,
            R_scratch,
            p_scratch,
            enough,
            best,
            witness,
        )
        if best < enough:
            clearance_out[trial] = best
            witness_out[trial] = witness
            return
    if solid != 0:
        best, witness = _most_buried(gripper, used, middle, surfaces, s, R_ee_obj, t_ee_obj, best)
    # some points first: a small `best` spares most triangles
    near_nodes = wp.zeros(shape=128, dtype=int)
    nodes = int(0)
    for node in range(surfaces.surface_first[s], surfaces.surface_first[s + 1]):
        ball = surfaces.node_sphere[node]
        around = _near_groups(low, high, R_ee_obj * center(ball) + t_ee_obj, wp.max(best, 0.0) + ball[3], mask)
        if around == 0:
            continue
        if nodes < LISTED:
            near_nodes[nodes] = node
        nodes += 1
        x = surfaces.points[3 * surfaces.leaf_first[surfaces.node_first[node]]]
        for i in range(count):
            if (around >> i) & 1 != 0:
                d = signed_distance(gripper.kind[i], gripper.size[i], R_scratch[trial, i] * x + p_scratch[trial, i])
                if d < best:
                    best = d
                    witness = i
    whole = nodes > LISTED  # a large surface: all of its nodes again
    if whole:
        nodes = surfaces.surface_first[s + 1] - surfaces.surface_first[s]
    for k in range(nodes):
        node = surfaces.surface_first[s] + k
        if not whole:
            node = near_nodes[k]
        if best < enough:
            break
        near = int(0)
        ball = surfaces.node_sphere[node]
        around = _near_groups(low, high, R_ee_obj * center(ball) + t_ee_obj, wp.max(best, 0.0) + ball[3], mask)
        if around == 0:
            continue
        for i in range(count):
            if (around >> i) & 1 != 0:
                x = R_scratch[trial, i] * center(ball) + p_scratch[trial, i]
                if signed_distance(gripper.kind[i], gripper.size[i], x) - ball[3] < best:
                    near = near | (1 << i)
        if near != 0:
            for leaf in range(surfaces.node_first[node], surfaces.node_first[node + 1]):
                best, witness = _leaf_clearance(
                    gripper, surfaces, leaf, near, trial, R_scratch, p_scratch, best, witness
                )
    clearance_out[trial] = best
    witness_out[trial] = witness
