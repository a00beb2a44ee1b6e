"""Material between the pads: exact on the triangles, one trial a thread.

The pad prism is |x| <= half_x, z_low <= z <= z_high in the ee frame, any y. The y at which it meets the object's solid
are the y ranges of the triangles clipped to it, and what lies inside the solid between those: there the prism's whole
cross-section is inside, so the line along its centre tells. What overlaps is one run of material.
"""

import warp as wp

from r2h_batch.kernels.geometry.lanes import (
    BOX_M,
    LANES,
    LEAF_ROWS,
    NODE_ROWS,
    TRIANGLE_ROWS,
    add_lanes,
    boxes_along,
    boxes_in_prism,
    cut_to_prism,
    first_lane,
    lane_point,
    leaf_in_prism,
    outside_runs,
)
from r2h_batch.kernels.geometry.surface import Surfaces, line_hit
from r2h_batch.kernels.grasp.crossings import solid_along_line
from r2h_batch.kernels.grasp.prism import COVERED_M, corner, outermost
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func(inline=False)
def _add_corners(
    corners: wp.array(dtype=float), at: int, half_x: float, z_low: float, z_high: float, cut: wp.array(dtype=float)
):
    """Grows `cut` by the triangles' points on the prism's corner lines, asked of the bits of `at` (`cut_to_prism`)."""
    for i in range(4):
        lanes = (at >> (8 * i)) & 255
        x, z = corner(i, half_x, z_low, z_high)
        while lanes != 0:
            lane = first_lane(lanes)
            lanes = lanes & (lanes - 1)
            hit, y = line_hit(
                lane_point(corners, 0, lane), lane_point(corners, 3, lane), lane_point(corners, 6, lane), x, z
            )
            if hit != 0:
                cut[lane] = wp.min(cut[lane], y)
                cut[8 + lane] = wp.max(cut[8 + lane], y)


@wp.func
def _add_leaf(
    surfaces: Surfaces, leaf: int, R: wp.mat33, t: wp.vec3, half_x: float, z_low: float, z_high: float,
    corners: wp.array(dtype=float), span: wp.array(dtype=float), cut: wp.array(dtype=float),
    run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), runs: int,
) -> int:  # fmt: skip
    """Joins the y ranges of a leaf's triangles, cut to the prism, to the runs, in place; the new number of runs."""
    found = leaf_in_prism(
        surfaces.triangle_lanes, TRIANGLE_ROWS * leaf, surfaces.leaf_first[leaf + 1] - surfaces.leaf_first[leaf],
        R, t, half_x, z_low, z_high, corners, span,
    )  # fmt: skip
    near = outside_runs(span, found & 255, COVERED_M, run_low, run_high, runs)
    sticking = near & (found >> 8)
    if sticking != 0:  # what is left of them inside
        at = cut_to_prism(corners, sticking, half_x, z_low, z_high, cut)
        if at != 0:
            _add_corners(corners, at, half_x, z_low, z_high, cut)
    return add_lanes(near, sticking, span, cut, COVERED_M, run_low, run_high, runs)


@wp.func(inline=False)
def material_between(
    surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, half_x: float, z_low: float, z_high: float, half_gap: float
):
    """y of the outermost material among the runs that meet |y| < half_gap (low > high: none).

    R, t: object to ee frame. The solid along the centre line comes first: most triangles then lie in known runs.
    """
    corners = wp.zeros(shape=72, dtype=float)
    span = wp.zeros(shape=16, dtype=float)
    cut = wp.zeros(shape=16, dtype=float)
    box_span = wp.zeros(shape=16, dtype=float)
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    ry = wp.vec3(R[1, 0], R[1, 1], R[1, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    z_mid = 0.5 * (z_low + z_high)
    half_z = 0.5 * (z_high - z_low)
    run_low = wp.zeros(shape=24, dtype=float)
    run_high = wp.zeros(shape=24, dtype=float)
    runs = solid_along_line(surfaces, s, R, t, 0.0, z_mid, run_low, run_high)
    node = surfaces.surface_first[s]
    end = surfaces.surface_first[s + 1]
    group = surfaces.group_first[s]
    while node < end:
        nodes = boxes_in_prism(
            surfaces.node_lanes, NODE_ROWS * group, wp.min(LANES, end - node), rx, rz, t[0], t[2],
            0.0, half_x + BOX_M, z_mid, half_z + BOX_M,
        )  # fmt: skip
        if nodes != 0:
            boxes_along(surfaces.node_lanes, NODE_ROWS * group, ry, t[1], box_span)
            nodes = outside_runs(box_span, nodes, COVERED_M, run_low, run_high, runs)
        while nodes != 0:
            at = node + first_lane(nodes)
            nodes = nodes & (nodes - 1)
            first = surfaces.node_first[at]
            row = LEAF_ROWS * at
            leaves = boxes_in_prism(
                surfaces.leaf_lanes, row, surfaces.node_first[at + 1] - first, rx, rz, t[0], t[2],
                0.0, half_x, z_mid, half_z,
            )  # fmt: skip
            if leaves != 0:
                boxes_along(surfaces.leaf_lanes, row, ry, t[1], box_span)
            while leaves != 0:  # asked anew each time: the runs have grown
                leaves = outside_runs(box_span, leaves, COVERED_M, run_low, run_high, runs)
                if leaves != 0:
                    leaf = first + first_lane(leaves)
                    leaves = leaves & (leaves - 1)
                    runs = _add_leaf(
                        surfaces, leaf, R, t, half_x, z_low, z_high, corners, span, cut, run_low, run_high, runs
                    )
        group += 1
        node += LANES
    return outermost(run_low, run_high, runs, half_gap)
