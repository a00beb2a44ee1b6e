"""Clearance between gripper primitives and a triangle surface: the least signed distance of its points.

The signed distance of a point to a primitive is its distance outside and minus its depth (distance to the nearest face)
inside. Over a solid the least value is found on its surface, unless the primitive's middle is buried in it: then it is
minus the primitive's inner radius. Depths are thus lower bounds on how far the bodies would have to be moved apart.
"""

import warp as wp

from r2h_batch.kernels.geometry.closest import inner_radius, signed_distance
from r2h_batch.kernels.geometry.lanes import (
    BOX_M,
    LANES,
    LEAF_ROWS,
    NODE_ROWS,
    TRIANGLE_ROWS,
    boxes_near,
    first_lane,
    lane_point,
    points_near,
    triangles_near,
)
from r2h_batch.kernels.geometry.shape import BOX, SPHERE
from r2h_batch.kernels.geometry.surface import Surfaces, center, inverse_pose
from r2h_batch.kernels.grasp.crossings import crossings
from r2h_batch.kernels.grasp.triangle import GJK_M, apart, bounding_half, triangle_clearance
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, finger_pose

wp.set_module_options(OPTIONS)

UNASKED = wp.constant(-1.0e29)
GROUPS = wp.constant(7)
"""Bits of the three groups of primitives: the palm, the finger at -y, the finger at +y."""
POINT_ROW = wp.constant(7)
"""Where a group of nodes has their points (`NODE_ROWS`)."""


@wp.func
def _turned_half(R: wp.mat33, half: wp.vec3) -> wp.vec3:
    """Half sides of a box that holds a box turned by R."""
    return wp.vec3(
        wp.abs(R[0, 0]) * half[0] + wp.abs(R[0, 1]) * half[1] + wp.abs(R[0, 2]) * half[2],
        wp.abs(R[1, 0]) * half[0] + wp.abs(R[1, 1]) * half[1] + wp.abs(R[1, 2]) * half[2],
        wp.abs(R[2, 0]) * half[0] + wp.abs(R[2, 1]) * half[1] + wp.abs(R[2, 2]) * half[2],
    )


@wp.func
def _in_box(surfaces: Surfaces, s: int, x: wp.vec3) -> bool:
    """Whether x (object frame) lies in surface s's bounding box."""
    low = surfaces.low[s]
    high = surfaces.high[s]
    return x[0] > low[0] and x[0] < high[0] and x[1] > low[1] and x[1] < high[1] and x[2] > low[2] and x[2] < high[2]


@wp.func
def _inside(surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, x: wp.vec3) -> bool:
    """Whether x (ee frame) lies inside closed surface s; R, t: object to ee frame."""
    ys = wp.zeros(shape=24, dtype=float)
    signs = wp.zeros(shape=24, dtype=int)
    _, winding = crossings(surfaces, s, R, t, x[0], x[2], x[1], ys, signs)
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
def _place_primitives(
    gripper: Gripper, used: int, drive: float, R_ee_obj: wp.mat33, t_ee_obj: wp.vec3, trial: int,
    R_out: wp.array2d(dtype=wp.mat33), p_out: wp.array2d(dtype=wp.vec3), low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3), group_low_out: wp.array(dtype=wp.vec3),
    group_high_out: wp.array(dtype=wp.vec3), mask_out: wp.array(dtype=int),
):  # fmt: skip
    """Writes each primitive's pose (object to primitive frame) and the box about it (ee frame).

    And of the palm and each finger the box about its primitives and their bits.
    """
    for g in range(3):
        group_low_out[g] = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        group_high_out[g] = wp.vec3(-1.0e30, -1.0e30, -1.0e30)
    for i in range(gripper.kind.shape[0]):
        R, p = finger_pose(gripper, i, drive)
        half = _box_half(gripper.kind[i], gripper.size[i], R)
        low_out[i] = p - half
        high_out[i] = p + half
        if (used >> i) & 1 != 0:
            g = int(gripper.side[i]) + 1
            group_low_out[g] = wp.min(group_low_out[g], p - half)
            group_high_out[g] = wp.max(group_high_out[g], p + half)
            mask_out[g] = mask_out[g] | (1 << i)
        R_out[trial, i] = wp.transpose(R) * R_ee_obj
        p_out[trial, i] = wp.transpose(R) * (t_ee_obj - p)


@wp.func
def _most_buried(
    gripper: Gripper, used: int, low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3),
    surfaces: Surfaces, s: int, R_ee_obj: wp.mat33, t_ee_obj: wp.vec3, best: float,
):  # fmt: skip
    """`best` or, when less, minus the inner radius of a primitive whose middle lies in the solid; which one, or -1."""
    witness = int(-1)
    for i in range(gripper.kind.shape[0]):
        if (used >> i) & 1 != 0:
            p = 0.5 * (low[i] + high[i])
            x = wp.transpose(R_ee_obj) * (p - t_ee_obj)
            r = inner_radius(gripper.kind[i], gripper.size[i])
            if -r < best and _in_box(surfaces, s, x) and _inside(surfaces, s, R_ee_obj, t_ee_obj, p):
                best = -r
                witness = i
    return best, witness


@wp.func
def _leaf_clearance(
    gripper: Gripper, surfaces: Surfaces, leaf: int, near: int, trial: int,
    R: wp.array2d(dtype=wp.mat33), p: wp.array2d(dtype=wp.vec3), best: float, witness: int,
):  # fmt: skip
    """`best` and `witness` after a leaf's triangles and the primitives in bit mask `near`."""
    ball = surfaces.leaf_sphere[leaf]
    first = surfaces.leaf_first[leaf]
    while near != 0:
        i = first_lane(near)
        near = near & (near - 1)
        Ri = R[trial, i]
        pi = p[trial, i]
        kind = gripper.kind[i]
        size = gripper.size[i]
        x = Ri * center(ball) + pi
        if signed_distance(kind, size, x) - ball[3] >= best:
            continue
        half = _turned_half(Ri, surfaces.leaf_half[leaf])
        if apart(kind, size, x - half, x + half) < wp.max(best, 0.0) + GJK_M:
            found = triangles_near(
                surfaces.triangle_lanes, TRIANGLE_ROWS * leaf, surfaces.leaf_first[leaf + 1] - first,
                Ri, pi, bounding_half(kind, size), wp.max(best, 0.0) + GJK_M + BOX_M,
            )  # fmt: skip
            while found != 0:
                tri = first + first_lane(found)
                found = found & (found - 1)
                d = triangle_clearance(surfaces.points, tri, kind, size, Ri, pi, best)
                if d < best:
                    best = d
                    witness = i
    return best, witness


@wp.func
def _primitives_near(group: int, surfaces: Surfaces, count: int, R: wp.mat33, t: wp.vec3, cutoff: float,
    group_low: wp.array(dtype=wp.vec3), group_high: wp.array(dtype=wp.vec3), mask: wp.array(dtype=int), near: wp.array(dtype=int),
) -> int:  # fmt: skip
    """Bits of the primitives whose group's box may be `cutoff` or less from one of eight nodes."""
    lanes = boxes_near(surfaces.node_lanes, NODE_ROWS * group, count, R, t, cutoff, group_low, group_high, GROUPS, near)
    groups = int(0)
    while lanes != 0:
        groups = groups | near[first_lane(lanes)]
        lanes = lanes & (lanes - 1)
    used = int(0)
    for g in range(3):
        if (groups >> g) & 1 != 0:
            used = used | mask[g]
    return used


@wp.func
def _points_clearance(
    gripper: Gripper, surfaces: Surfaces, s: int, R_ee_obj: wp.mat33, t_ee_obj: wp.vec3,
    low: wp.array(dtype=wp.vec3), high: wp.array(dtype=wp.vec3),
    group_low: wp.array(dtype=wp.vec3), group_high: wp.array(dtype=wp.vec3), mask: wp.array(dtype=int),
    trial: int, R: wp.array2d(dtype=wp.mat33), p: wp.array2d(dtype=wp.vec3),
    near: wp.array(dtype=int), enough: float, best: float, witness: int,
):  # fmt: skip
    """`best` and `witness` after one point of every node; no more are looked at once `best` is below `enough`."""
    node = surfaces.surface_first[s]
    end = surfaces.surface_first[s + 1]
    group = surfaces.group_first[s]
    while node < end and best >= enough:
        count = wp.min(LANES, end - node)
        cutoff = wp.max(best, 0.0) + BOX_M
        used = _primitives_near(group, surfaces, count, R_ee_obj, t_ee_obj, cutoff, group_low, group_high, mask, near)
        lanes = int(0)
        row = NODE_ROWS * group + POINT_ROW
        if used != 0:
            lanes = points_near(surfaces.node_lanes, row, count, R_ee_obj, t_ee_obj, cutoff, low, high, used, near)
        while lanes != 0:
            lane = first_lane(lanes)
            lanes = lanes & (lanes - 1)
            x = lane_point(surfaces.node_lanes, row, lane)
            around = near[lane]
            while around != 0:
                i = first_lane(around)
                around = around & (around - 1)
                d = signed_distance(gripper.kind[i], gripper.size[i], R[trial, i] * x + p[trial, i])
                if d < best:
                    best = d
                    witness = i
        group += 1
        node += LANES
    return best, witness


# Branch and bound over a surface in two levels of bounding spheres (nodes, their leaves, triangles). A primitive's signed
# distance f never changes faster than the point it is asked at, so |f(x) - f(c)| <= r for every x of a sphere (c, r): what
# has f(c) - r >= best holds nothing nearer than `best`. In this order, as each lowers `best` for the next:
#
# 1. primitives that lie in the solid: the depth of their cores (`_most_buried`);
# 2. one vertex of every node: an upper bound that spares most triangles;
# 3. nodes by groups of primitives (palm, each finger) with a box about each, then by primitive, then their leaves. A box
#    about a leaf or a triangle, along the primitive's axes, says sooner than a sphere that something flat is too far away;
#    GJK decides what neither rules out.
#
# A primitive's frame (object to primitive) is needed for every sphere: it is written once to the scratch arrays.
@wp.func
def least_clearance(
    gripper: Gripper, surfaces: Surfaces, s: int, used: int, solid: int, cap: float, enough: float,
    T_obj_ee: wp.mat44, opening: float, trial: int, R_scratch: wp.array2d(dtype=wp.mat33), p_scratch: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Least clearance (m) of the primitives in bit mask `used` to surface s, NaN without a triangle; which one has it.

    As `primitives_clearance` says it of a trial's row.
    """
    R_ee_obj, t_ee_obj = inverse_pose(T_obj_ee)
    drive = drive_from_gap(gripper, opening)
    best = float(cap)
    witness = int(-1)
    # boxes (ee frame) about the primitives, as many as a bit mask has room for, and about the palm's and each finger's:
    # most of the surface is far from all three
    low = wp.zeros(shape=31, dtype=wp.vec3)
    high = wp.zeros(shape=31, dtype=wp.vec3)
    group_low = wp.zeros(shape=3, dtype=wp.vec3)
    group_high = wp.zeros(shape=3, dtype=wp.vec3)
    mask = wp.zeros(shape=3, dtype=int)
    near = wp.zeros(shape=8, dtype=int)
    near_leaves = wp.zeros(shape=8, dtype=int)
    _place_primitives(
        gripper, used, drive, R_ee_obj, t_ee_obj, trial, R_scratch, p_scratch, low, high, group_low, group_high, mask
    )
    # who only asks whether it is clear: a point mostly tells, which is cheaper than what lies in the solid
    if solid != 0 and enough < UNASKED:
        best, witness = _most_buried(gripper, used, low, high, surfaces, s, R_ee_obj, t_ee_obj, best)
    best, witness = _points_clearance(
        gripper, surfaces, s, R_ee_obj, t_ee_obj, low, high, group_low, group_high, mask,
        trial, R_scratch, p_scratch, near, enough, best, witness,
    )  # fmt: skip
    if solid != 0 and enough >= UNASKED and best >= enough:
        best, witness = _most_buried(gripper, used, low, high, surfaces, s, R_ee_obj, t_ee_obj, best)
    node = surfaces.surface_first[s]
    end = surfaces.surface_first[s + 1]
    group = surfaces.group_first[s]
    while node < end and best >= enough:
        count = wp.min(LANES, end - node)
        cutoff = wp.max(best, 0.0) + GJK_M
        some = _primitives_near(group, surfaces, count, R_ee_obj, t_ee_obj, cutoff, group_low, group_high, mask, near)
        nodes = int(0)
        if some != 0:
            nodes = boxes_near(
                surfaces.node_lanes, NODE_ROWS * group, count, R_ee_obj, t_ee_obj, cutoff, low, high, some, near
            )
        while nodes != 0 and best >= enough:
            lane = first_lane(nodes)
            nodes = nodes & (nodes - 1)
            first_leaf = surfaces.node_first[node + lane]
            leaves = boxes_near(
                surfaces.leaf_lanes, LEAF_ROWS * (node + lane), surfaces.node_first[node + lane + 1] - first_leaf,
                R_ee_obj, t_ee_obj, wp.max(best, 0.0) + GJK_M, low, high, near[lane], near_leaves,
            )  # fmt: skip
            while leaves != 0:
                k = first_lane(leaves)
                leaves = leaves & (leaves - 1)
                best, witness = _leaf_clearance(
                    gripper, surfaces, first_leaf + k, near_leaves[k], trial, R_scratch, p_scratch, best, witness
                )
        group += 1
        node += LANES
    return wp.where(surfaces.surface_first[s] < end, best, wp.nan), witness


@wp.kernel
def primitives_clearance(
    first: int,
    # tables
    gripper: Gripper, surfaces: Surfaces, surface_offset: int, used: int, solid: int, cap: float, enough: float,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44), object_index_in: wp.array(dtype=wp.int32),
    opening_in: wp.array(dtype=wp.float32),
    # scratch: (B, G) object to primitive frame
    R_scratch: wp.array2d(dtype=wp.mat33), p_scratch: wp.array2d(dtype=wp.vec3),
    # out
    clearance_out: wp.array(dtype=wp.float32), witness_out: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Least clearance (m) of the primitives in bit mask `used` at each trial's opening, and which one has it.

    Exact between `enough` and `cap`; `cap` and -1 beyond; something below `enough` where it is less than that (who only asks
    whether a gripper is clear need not know how deep it is not). The surface is object_index + surface_offset; `solid` counts
    its inside too.

    Branch and bound. `best` starts at the cap and falls: with primitives buried in the solid, with one point of every
    node, and then with the triangles of nodes and leaves whose sphere a primitive may come nearer to than `best`.
    """
    trial = first + wp.tid()
    best, witness = least_clearance(
        gripper, surfaces, object_index_in[trial] + surface_offset, used, solid, cap, enough, T_obj_ee_in[trial],
        opening_in[trial], trial, R_scratch, p_scratch,
    )  # fmt: skip
    clearance_out[trial] = best
    witness_out[trial] = witness
