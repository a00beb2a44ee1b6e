"""Where a line along y of the ee frame crosses a closed surface, and where it lies inside."""

import warp as wp

from r2h_batch.kernels.geometry.lanes import (
    BOX_M,
    LANES,
    LEAF_ROWS,
    NODE_ROWS,
    TRIANGLE_ROWS,
    add_run,
    boxes_in_prism,
    first_lane,
    lane_point,
    triangles_in_prism,
)
from r2h_batch.kernels.geometry.surface import Surfaces, line_hit
from r2h_batch.kernels.grasp.prism import FAR, JOIN_M, MAX_RUNS
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

HIT_M = wp.constant(1.0e-6)


@wp.func
def _of_leaf(
    surfaces: Surfaces, leaf: int, R: wp.mat33, rx: wp.vec3, rz: wp.vec3, t: wp.vec3, x: float, z: float,
    y_end: float, ys: wp.array(dtype=float), signs: wp.array(dtype=int), n: int, winding: int,
):  # fmt: skip
    """Adds the crossings of a leaf's triangles: only those can cross whose bounding rectangle in x and z holds the line."""
    row = TRIANGLE_ROWS * leaf
    near = triangles_in_prism(
        surfaces.triangle_lanes, row, surfaces.leaf_first[leaf + 1] - surfaces.leaf_first[leaf], rx, rz, t[0], t[2],
        x - HIT_M, x + HIT_M, z - HIT_M, z + HIT_M,
    )  # fmt: skip
    near = near & 255
    while near != 0:
        lane = first_lane(near)
        near = near & (near - 1)
        a = R * lane_point(surfaces.triangle_lanes, row, lane) + t
        b = R * lane_point(surfaces.triangle_lanes, row + 3, lane) + t
        c = R * lane_point(surfaces.triangle_lanes, row + 6, lane) + t
        sign, y = line_hit(a, b, c, x, z)
        if y < y_end:
            winding += sign
        if sign != 0 and n < MAX_RUNS:
            ys[n] = y
            signs[n] = sign
            n += 1
    return n, winding


@wp.func(inline=False)
def crossings(
    surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, x: float, z: float, y_end: float,
    ys: wp.array(dtype=float), signs: wp.array(dtype=int),
):  # fmt: skip
    """How often the line (x, ., z) of the ee frame crosses surface s, and its winding number at y_end (0: outside).

    Also the y (unsorted) and the signs of up to MAX_RUNS crossings. R, t: object to ee frame.
    """
    n = int(0)
    winding = int(0)
    rx = wp.vec3(R[0, 0], R[0, 1], R[0, 2])
    rz = wp.vec3(R[2, 0], R[2, 1], R[2, 2])
    node = surfaces.surface_first[s]
    end = surfaces.surface_first[s + 1]
    group = surfaces.group_first[s]
    while node < end:
        nodes = boxes_in_prism(
            surfaces.node_lanes, NODE_ROWS * group, wp.min(LANES, end - node), rx, rz, t[0], t[2], x, BOX_M, z, BOX_M
        )
        while nodes != 0:
            at = node + first_lane(nodes)
            nodes = nodes & (nodes - 1)
            leaf = surfaces.node_first[at]
            leaves = boxes_in_prism(
                surfaces.leaf_lanes, LEAF_ROWS * at, surfaces.node_first[at + 1] - leaf, rx, rz, t[0], t[2],
                x, JOIN_M, z, JOIN_M,
            )  # fmt: skip
            while leaves != 0:
                n, winding = _of_leaf(
                    surfaces, leaf + first_lane(leaves), R, rx, rz, t, x, z, y_end, ys, signs, n, winding
                )
                leaves = leaves & (leaves - 1)
        group += 1
        node += LANES
    return n, winding


@wp.func
def solid_along_line(
    surfaces: Surfaces, s: int, R: wp.mat33, t: wp.vec3, x: float, z: float, low: wp.array(dtype=float),
    high: wp.array(dtype=float),
) -> int:  # fmt: skip
    """The y at which the line (x, ., z) of the ee frame lies inside closed surface s, as runs. R, t: object to ee frame.

    From one end to the other the winding number changes by each crossing's sign; where it is not 0, there is solid.
    """
    ys = wp.zeros(shape=24, dtype=float)
    signs = wp.zeros(shape=24, dtype=int)
    n, _ = crossings(surfaces, s, R, t, x, z, FAR, ys, signs)
    runs = int(0)
    winding = int(0)
    start = float(0.0)
    for i in range(n):
        k = int(i)
        for j in range(i + 1, n):
            if ys[j] < ys[k]:
                k = j
        y = ys[k]
        if winding == 0:
            start = y
        winding += signs[k]
        ys[k] = ys[i]
        signs[k] = signs[i]
        if winding == 0 or i == n - 1:
            runs = add_run(low, high, runs, start, y)
    return runs
