"""The receiver's arm, torso and head as pieces of a hand: forearm, upper arm and head as capsules, the torso as a box that stands
upright."""

import warp as wp

from r2h_batch.kernels.geometry.shape import BLOCK_POINTS
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

PIECES = wp.constant(4)
"""forearm, upper arm, torso, head"""
TORSO = wp.constant(2)
HEAD = wp.constant(3)
CORNERS = wp.constant(8)
"""of each piece: those of the torso's box; a segment's two ends, four times each"""
ALL_CORNERS = wp.constant(PIECES * CORNERS)
ROUNDING_M = wp.constant(1.0e-6)


@wp.func
def _point(receiver: wp.array3d(dtype=float), trial: int, row: int):
    """The first three numbers of a receiver's row."""
    return wp.vec3d(
        wp.float64(receiver[trial, row, 0]), wp.float64(receiver[trial, row, 1]), wp.float64(receiver[trial, row, 2])
    )


@wp.kernel
def place_head(
    first: int,
    # each: a length, and a share of the distance from shoulder to elbow
    low_ahead: wp.vec2d, low_up: wp.vec2d, high_ahead: wp.vec2d, high_up: wp.vec2d, radius: wp.vec2d,
    receiver_in: wp.array3d(dtype=float),  # (B, 5, 4) `Trials.receiver`
    head_out: wp.array2d(dtype=wp.vec4),  # (B, 2) lower and upper end, each with the radius; world, m
):  # fmt: skip
    """The head of each receiver, a capsule above the torso: `scene.person.heads_of`."""
    row = first + wp.tid()
    upper = wp.vec2d(wp.float64(1.0), wp.length(_point(receiver_in, row, 1) - _point(receiver_in, row, 0)))
    middle = _point(receiver_in, row, 3)
    top = middle[2] + wp.float64(receiver_in[row, 4, 2])
    x = wp.float64(receiver_in[row, 3, 3])  # where the torso faces
    y = wp.float64(receiver_in[row, 4, 3])
    grown = float(wp.dot(radius, upper))
    for k in range(2):
        ahead = wp.dot(wp.where(k == 0, low_ahead, high_ahead), upper)
        up = wp.dot(wp.where(k == 0, low_up, high_up), upper)
        head_out[row, k] = wp.vec4(float(middle[0] + ahead * x), float(middle[1] + ahead * y), float(top + up), grown)


@wp.func
def _corner(
    receiver: wp.array3d(dtype=float), head: wp.array3d(dtype=float), trial: int, room: float, piece: int, k: int
):
    """Corner k of a piece's core (world, m)."""
    if piece < TORSO:  # wrist 2, elbow 1, shoulder 0: from one joint to the next
        return _point(receiver, trial, wp.where(k % 2 == 0, 1 - piece, 2 - piece))
    if piece == HEAD:
        return _point(head, trial, k % 2)
    x = wp.float64(receiver[trial, 3, 3])  # where the torso faces
    y = wp.float64(receiver[trial, 4, 3])
    half = wp.vec3d(
        wp.float64(receiver[trial, 4, 0] + room),
        wp.float64(receiver[trial, 4, 1] + room),
        wp.float64(receiver[trial, 4, 2] + room),
    )
    a = wp.where(k % 2 == 0, -half[0], half[0])
    b = wp.where((k / 2) % 2 == 0, -half[1], half[1])
    c = wp.where(k / 4 == 0, -half[2], half[2])
    return _point(receiver, trial, 3) + wp.vec3d(a * x, a * y, a * wp.float64(0.0)) + wp.vec3d(
        b * -y, b * x, b * wp.float64(0.0)
    ) + wp.vec3d(c * wp.float64(0.0), c * wp.float64(0.0), c)  # fmt: skip


@wp.func
def _in_frame(R: wp.mat33, p: wp.vec3, x: wp.vec3d):
    """R x + p, rounded once."""
    out = wp.vec3()
    for i in range(3):
        out[i] = float(
            wp.float64(R[i, 0]) * x[0] + wp.float64(R[i, 1]) * x[1] + wp.float64(R[i, 2]) * x[2] + wp.float64(p[i])
        )
    return out


@wp.func
def _distance(a: wp.vec3, b: wp.vec3):
    d = a - b
    return wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


@wp.kernel
def place_person(
    first: int,
    of_hand: int,  # pieces of the trial's hand that stand before the person's; 0: the person alone
    room: float,  # by how much the person is grown, m
    head_room: float,  # and the head beside that
    # the scene's tables of pieces, as `World` has them
    piece_start_in: wp.array(dtype=int), piece_blocks_in: wp.array(dtype=int), piece_round_in: wp.array(dtype=float),
    piece_center_in: wp.array(dtype=wp.vec3), piece_radius_in: wp.array(dtype=float),
    # trials
    receiver_in: wp.array3d(dtype=float),  # (B, 5, 4) `Trials.receiver`
    head_in: wp.array3d(dtype=float),  # (B, 2, 4) of `place_head`
    hand_in: wp.array(dtype=int), R_hand_world_in: wp.array(dtype=wp.mat33), p_hand_world_in: wp.array(dtype=wp.vec3),
    # out: tables in which every row is a hand
    row_out: wp.array(dtype=int),  # the row's own number: its hand
    piece_start_out: wp.array2d(dtype=int), piece_blocks_out: wp.array2d(dtype=int),
    piece_round_out: wp.array2d(dtype=float), piece_center_out: wp.array2d(dtype=wp.vec3),
    piece_radius_out: wp.array2d(dtype=float), hand_center_out: wp.array(dtype=wp.vec3),
    hand_radius_out: wp.array(dtype=float),
    own_points_out: wp.array2d(dtype=wp.vec3),  # (B, PIECES * BLOCK_POINTS)
):  # fmt: skip
    """A trial's hand with the person's pieces behind its own, in the hand's frame, where all collision work is done.

    Corners are placed in float64 and rounded once. Each piece's corners fill one block of points, twice over.
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
    corner = wp.zeros(shape=ALL_CORNERS, dtype=wp.vec3)
    for k in range(ALL_CORNERS):
        at_world = _corner(receiver_in, head_in, row, room, k / CORNERS, k % CORNERS)
        corner[k] = _in_frame(R_hand_world_in[row], p_hand_world_in[row], at_world)
    for k in range(PIECES * BLOCK_POINTS):  # a block has 16 x, then 16 y and 16 z
        v = wp.vec3()
        for j in range(3):
            at = (3 * k + j) % (3 * BLOCK_POINTS)
            x = corner[k / BLOCK_POINTS * CORNERS + at % BLOCK_POINTS % CORNERS]
            v[j] = x[at / BLOCK_POINTS]
        own_points_out[row, k] = v
    for k in range(PIECES):
        low = corner[k * CORNERS]
        high = low
        for j in range(1, CORNERS):
            low = wp.min(low, corner[k * CORNERS + j])
            high = wp.max(high, corner[k * CORNERS + j])
        center = 0.5 * (low + high)
        radius = float(0.0)
        for j in range(CORNERS):
            radius = wp.max(radius, _distance(corner[k * CORNERS + j], center))
        grown = float(0.0)
        if k < TORSO:
            grown = receiver_in[row, 1 - k, 3] + room
        if k == HEAD:
            grown = head_in[row, 0, 3] + room + head_room
        i = of_hand + k
        piece_start_out[row, i] = -1 - BLOCK_POINTS * (PIECES * row + k)
        piece_blocks_out[row, i] = 1
        piece_round_out[row, i] = grown
        piece_center_out[row, i] = center
        piece_radius_out[row, i] = radius + grown + ROUNDING_M
    low = wp.vec3(1.0e30, 1.0e30, 1.0e30)
    high = -low
    for i in range(of_hand + PIECES):
        r = piece_radius_out[row, i]
        low = wp.min(low, piece_center_out[row, i] - wp.vec3(r, r, r))
        high = wp.max(high, piece_center_out[row, i] + wp.vec3(r, r, r))
    middle = 0.5 * (low + high)
    radius = float(0.0)
    for i in range(of_hand + PIECES):
        radius = wp.max(radius, _distance(piece_center_out[row, i], middle) + piece_radius_out[row, i])
    hand_center_out[row] = middle
    hand_radius_out[row] = radius + ROUNDING_M
