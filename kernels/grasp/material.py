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
    boxes_in_prism,
    boxes_outside_runs,
    first_lane,
    lane_point,
    triangles_in_prism,
    triangles_outside_runs,
)
from r2h_batch.kernels.geometry.surface import Surfaces, line_hit
from r2h_batch.kernels.grasp.crossings import solid_along_line
from r2h_batch.kernels.grasp.prism import clip_edge, corner
from r2h_batch.kernels.grasp.runs import COVERED_M, FAR, add_run, outermost
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func(inline=False)
def _triangle_in_prism(a: wp.vec3, b: wp.vec3, c: wp.vec3, half_x: float, z_low: float, z_high: float):
    """Range of y of triangle abc cut to the prism (low > high: none)."""
    low = float(FAR)
    high = float(-FAR)
    for i in range(3):
        p = a
        q = b
        if i == 1:
            p = b
            q = c
        elif i == 2:
            p = c
            q = a
        d = q - p
        t0, t1 = clip_edge(p[0], q[0], -half_x, half_x, 0.0, 1.0)
        if t0 > t1:
            continue
        t0, t1 = clip_edge(p[2], q[2], z_low, z_high, t0, t1)
        if t0 <= t1:
            y0 = p[1] + t0 * d[1]
            y1 = wp.where(t1 >= 1.0, q[1], p[1] + t1 * d[1])
            low = wp.min(low, wp.min(y0, y1))
            high = wp.max(high, wp.max(y0, y1))
    x_min = wp.min(a[0], wp.min(b[0], c[0]))
    x_max = wp.max(a[0], wp.max(b[0], c[0]))
    z_min = wp.min(a[2], wp.min(b[2], c[2]))
    z_max = wp.max(a[2], wp.max(b[2], c[2]))
    for i in range(4):
        x, z = corner(i, half_x, z_low, z_high)
        if x > x_min and x < x_max and z > z_min and z < z_max:
            hit, y = line_hit(a, b, c, x, z)
            if hit != 0:
                low = wp.min(low, y)
                high = wp.max(high, y)
    return low, high


@wp.func
def _add_leaf(
    surfaces: Surfaces, leaf: int, R: wp.mat33, rx: wp.vec3, ry: wp.vec3, rz: wp.vec3, t: wp.vec3,
    half_x: float, z_low: float, z_high: float,
    run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), runs: int,
) -> int:  # fmt: skip
    """Joins the y ranges of a leaf's triangles, cut to the prism, to the runs, in place; the new number of runs."""
    row = TRIANGLE_ROWS * leaf
    found = triangles_in_prism(
        surfaces.triangle_lanes, row, surfaces.leaf_first[leaf + 1] - surfaces.leaf_first[leaf], rx, rz, t[0], t[2],
        -half_x, half_x, z_low, z_high,
    )  # fmt: skip
    near = found & 255
    while near != 0:  # asked anew each time: the runs have grown
        near = triangles_outside_runs(surfaces.triangle_lanes, row, near, ry, t[1], COVERED_M, run_low, run_high, runs)
        if near != 0:
            lane = first_lane(near)
            near = near & (near - 1)
            a = R * lane_point(surfaces.triangle_lanes, row, lane) + t
            b = R * lane_point(surfaces.triangle_lanes, row + 3, lane) + t
            c = R * lane_point(surfaces.triangle_lanes, row + 6, lane) + t
            low = wp.min(a[1], wp.min(b[1], c[1]))
            high = wp.max(a[1], wp.max(b[1], c[1]))
            if (found >> (8 + lane)) & 1 != 0:  # it sticks out: what is left of it inside
                low, high = _triangle_in_prism(a, b, c, half_x, z_low, z_high)
            if low <= high:
                runs = add_run(run_low, run_high, runs, low, high)
    return runs


@wp.func
def material_between(
    surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, half_x: float, z_low: float, z_high: float, half_gap: float
):
    """y of the outermost material among the runs that meet |y| < half_gap (low > high: none).

    R, t: object to ee frame. The solid along the centre line comes first: most triangles then lie in known runs.
    """
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
            nodes = boxes_outside_runs(
                surfaces.node_lanes, NODE_ROWS * group, nodes, ry, t[1], COVERED_M, run_low, run_high, runs
            )
        while nodes != 0:
            at = node + first_lane(nodes)
            nodes = nodes & (nodes - 1)
            first = surfaces.node_first[at]
            row = LEAF_ROWS * at
            leaves = boxes_in_prism(
                surfaces.leaf_lanes, row, surfaces.node_first[at + 1] - first, rx, rz, t[0], t[2],
                0.0, half_x, z_mid, half_z,
            )  # fmt: skip
            while leaves != 0:  # asked anew each time: the runs have grown
                leaves = boxes_outside_runs(
                    surfaces.leaf_lanes, row, leaves, ry, t[1], COVERED_M, run_low, run_high, runs
                )
                if leaves != 0:
                    leaf = first + first_lane(leaves)
                    leaves = leaves & (leaves - 1)
                    runs = _add_leaf(surfaces, leaf, R, rx, ry, rz, t, half_x, z_low, z_high, run_low, run_high, runs)
        group += 1
        node += LANES
    return outermost(run_low, run_high, runs, half_gap)
