"""The point of a triangle surface that is nearest to a given one, by the surface's tables (surface.py)."""

import warp as wp

from r2h_batch.kernels.geometry.lanes import (
    LANES,
    LEAF_ROWS,
    NODE_ROWS,
    TRIANGLE_ROWS,
    boxes_within,
    lane_point,
    least_lane,
    nearest_triangle,
)
from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

TIE = wp.constant(4)
"""The entry of `best` that says whether rounding decides (`nearest_triangle`)."""
TIE_M = wp.constant(1.0e-6)
"""More than distances differ by that rounding decides about."""


@wp.func
def _in_node(
    surfaces: Surfaces, node: int, x: wp.vec3, far2: wp.array(dtype=float), best: wp.array(dtype=float), at: wp.array(dtype=int)
):  # fmt: skip
    """Puts a node's nearest triangle into `best` and `at` (row and lane) if it is nearer; its nearest leaf first."""
    first = surfaces.node_first[node]
    leaves = boxes_within(
        surfaces.leaf_lanes, LEAF_ROWS * node, surfaces.node_first[node + 1] - first, x, best[0], far2
    )
    while leaves != 0:
        k = least_lane(far2, leaves)
        leaves = leaves & ~(1 << k)
        leaf = first + k
        row = TRIANGLE_ROWS * leaf
        count = surfaces.leaf_first[leaf + 1] - surfaces.leaf_first[leaf]
        lane = nearest_triangle(surfaces.triangle_lanes, row, count, x, best)
        if lane >= 0:
            at[0] = row
            at[1] = lane
            leaves = leaves & boxes_within(surfaces.leaf_lanes, LEAF_ROWS * node, LANES, x, best[0], far2)


# Branch and bound. The node whose box is nearest to x comes first: it mostly holds the nearest triangle, and of the other nodes
# few boxes are nearer than that.
#
# Two triangles that share an edge are equally near, and their points differ in the last bit. Which one counts is then up to
# Warp's tree of the same triangles: stored margins come from it, and keep all their bits.
@wp.func
def nearest_on_surface(surfaces: Surfaces, s: int, mesh: wp.uint64, x: wp.vec3, cap: float):
    """Distance of x from surface s when below `cap` (else `cap` and x), and the surface's nearest point; x: object frame.

    `mesh`: the same triangles as a mesh of Warp.
    """
    far2 = wp.zeros(shape=8, dtype=float)
    leaf_far2 = wp.zeros(shape=8, dtype=float)
    best = wp.zeros(shape=5, dtype=float)
    at = wp.zeros(shape=2, dtype=int)
    best[0] = cap * cap
    at[0] = -1
    start = surfaces.surface_first[s]
    end = surfaces.surface_first[s + 1]
    if wp.isnan(wp.dot(x, x)):  # no bound would leave a triangle out
        end = start
    nearest_node = int(-1)
    least = float(1.0e38)
    node = int(start)
    group = int(surfaces.group_first[s])
    while node < end:
        near = boxes_within(surfaces.node_lanes, NODE_ROWS * group, wp.min(LANES, end - node), x, least, far2)
        if near != 0:
            lane = least_lane(far2, near)
            if far2[lane] < least:
                least = far2[lane]
                nearest_node = node + lane
        group += 1
        node += LANES
    if nearest_node >= 0:
        _in_node(surfaces, nearest_node, x, leaf_far2, best, at)
    node = int(start)
    group = int(surfaces.group_first[s])
    while node < end:
        near = boxes_within(surfaces.node_lanes, NODE_ROWS * group, wp.min(LANES, end - node), x, best[0], far2)
        while near != 0:
            lane = least_lane(far2, near)
            near = near & ~(1 << lane)
            if node + lane != nearest_node:
                _in_node(surfaces, node + lane, x, leaf_far2, best, at)
        group += 1
        node += LANES
    d = float(cap)
    y = x
    if at[0] >= 0:
        a = lane_point(surfaces.triangle_lanes, at[0], at[1])
        b = lane_point(surfaces.triangle_lanes, at[0] + 3, at[1])
        c = lane_point(surfaces.triangle_lanes, at[0] + 6, at[1])
        u = 1.0 - best[1] - best[2]
        y = u * a + best[1] * b + (1.0 - u - best[1]) * c
        d = wp.length(y - x)
        if best[TIE] > 0.0:
            hit = wp.mesh_query_point_no_sign(mesh, x, wp.min(d + TIE_M, cap))
            if hit.result:
                y = wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
                d = wp.length(y - x)
    return d, y
