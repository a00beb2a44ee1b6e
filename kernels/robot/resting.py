"""An object that rests in the world as pieces of a hand: what a robot with an empty gripper has to keep clear of."""

import warp as wp

from r2h_batch.kernels.geometry.shape import BLOCK_POINTS
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

ROUNDING_M = wp.constant(1.0e-6)


@wp.func
def _world_point(T: wp.mat44, x: wp.vec3):
    """T x in float64."""
    out = wp.vec3d()
    for i in range(3):
        out[i] = wp.float64(T[i, 3])
        for j in range(3):
            out[i] = out[i] + wp.float64(T[i, j]) * wp.float64(x[j])
    return out


@wp.func
def _in_frame(R: wp.mat33, p: wp.vec3, x: wp.vec3d):
    """R x + p, rounded once."""
    out = wp.vec3()
    for i in range(3):
        s = wp.float64(p[i])
        for j in range(3):
            s = s + wp.float64(R[i, j]) * x[j]
        out[i] = float(s)
    return out


@wp.func
def _distance(a: wp.vec3, b: wp.vec3):
    d = a - b
    return wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


@wp.kernel
def place_resting(
    first: int,
    before: int,  # rows of the batch's own points that stand before those written here
    of_hand: int,  # pieces of the trial's hand that stand before the object's
    hulls: int,  # pieces of an object, at most; one with fewer has its first one again
    blocks: int,  # of points that the largest piece fills
    # tables: pieces of hands, and points and hulls of the objects, as `World` has them
    piece_start_in: wp.array(dtype=int), piece_blocks_in: wp.array(dtype=int), piece_round_in: wp.array(dtype=float),
    piece_center_in: wp.array(dtype=wp.vec3), piece_radius_in: wp.array(dtype=float),
    point_in: wp.array(dtype=wp.vec3), hull_first_in: wp.array(dtype=int), hull_start_in: wp.array(dtype=int),
    # trials
    hand_in: wp.array(dtype=int), object_in: wp.array(dtype=int), T_world_obj_in: wp.array(dtype=wp.mat44),
    R_hand_world_in: wp.array(dtype=wp.mat33), p_hand_world_in: wp.array(dtype=wp.vec3),
    # out: tables in which every row is a hand
    row_out: wp.array(dtype=int),  # the row's own number: its hand
    piece_start_out: wp.array2d(dtype=int), piece_blocks_out: wp.array2d(dtype=int),
    piece_round_out: wp.array2d(dtype=float), piece_center_out: wp.array2d(dtype=wp.vec3),
    piece_radius_out: wp.array2d(dtype=float), hand_center_out: wp.array(dtype=wp.vec3),
    hand_radius_out: wp.array(dtype=float),
    number_out: wp.array2d(dtype=float),  # (B, hulls * blocks * 3 * BLOCK_POINTS)
):  # fmt: skip
    """A trial's hand with the resting object's convex bodies behind its own pieces, in the hand's frame.

    Corners are placed in float64 and rounded once. Each body's corners fill its blocks of points; the last corner fills up.
    """
    row = first + wp.tid()
    row_out[row] = row
    for i in range(of_hand):
        piece = hand_in[row] * of_hand + i
        piece_start_out[row, i] = piece_start_in[piece]
        piece_blocks_out[row, i] = piece_blocks_in[piece]
        piece_round_out[row, i] = piece_round_in[piece]
        piece_center_out[row, i] = piece_center_in[piece]
        piece_radius_out[row, i] = piece_radius_in[piece]
    R = R_hand_world_in[row]
    p = p_hand_world_in[row]
    T = T_world_obj_in[row]
    first_hull = hull_first_in[object_in[row]]
    n_hulls = hull_first_in[object_in[row] + 1] - first_hull
    for k in range(hulls):
        hull = first_hull + wp.where(k < n_hulls, k, 0)
        start = hull_start_in[hull]
        count = hull_start_in[hull + 1] - start
        filled = (count + BLOCK_POINTS - 1) / BLOCK_POINTS
        at = k * blocks * BLOCK_POINTS
        low = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        high = -low
        for b in range(filled):
            # a block has 16 x, then 16 y and 16 z
            for j in range(BLOCK_POINTS):
                x = _in_frame(R, p, _world_point(T, point_in[start + wp.min(b * BLOCK_POINTS + j, count - 1)]))
                low = wp.min(low, x)
                high = wp.max(high, x)
                for c in range(3):
                    number_out[row, 3 * (at + b * BLOCK_POINTS) + c * BLOCK_POINTS + j] = x[c]
        center = 0.5 * (low + high)
        radius = float(0.0)
        for i in range(count):
            radius = wp.max(radius, _distance(_in_frame(R, p, _world_point(T, point_in[start + i])), center))
        piece = of_hand + k
        piece_start_out[row, piece] = -1 - (before + row * hulls * blocks * BLOCK_POINTS + at)
        piece_blocks_out[row, piece] = filled
        piece_round_out[row, piece] = 0.0
        piece_center_out[row, piece] = center
        piece_radius_out[row, piece] = radius + ROUNDING_M
    low = wp.vec3(1.0e30, 1.0e30, 1.0e30)
    high = -low
    for i in range(of_hand + hulls):
        r = piece_radius_out[row, i]
        low = wp.min(low, piece_center_out[row, i] - wp.vec3(r, r, r))
        high = wp.max(high, piece_center_out[row, i] + wp.vec3(r, r, r))
    middle = 0.5 * (low + high)
    radius = float(0.0)
    for i in range(of_hand + hulls):
        radius = wp.max(radius, _distance(piece_center_out[row, i], middle) + piece_radius_out[row, i])
    hand_center_out[row] = middle
    hand_radius_out[row] = radius + ROUNDING_M
