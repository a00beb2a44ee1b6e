"""Clearance between a gripper and a hand that is posed anew for every trial: primitives against the hand's convex pieces.

The same pieces and the same distance as the planner's: what keeps clear here keeps clear there.
"""

import warp as wp

from r2h_batch.kernels.geometry.closest import eroded, rounded, signed_distance
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.shape import CAPSULE, HULL, Shape
from r2h_batch.kernels.geometry.surface import inverse_pose
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap, finger_pose

wp.set_module_options(OPTIONS | {"fuse_fp": True})


@wp.struct
class PosedHands:
    """Points of B posed hands, piece after piece (m, any one frame for each hand), and a ball about every piece."""

    n_pieces: int
    n_points: int
    piece_start: wp.array(dtype=int)  # (n_pieces + 1,) within one hand's points
    points: wp.array(dtype=wp.vec3)  # (B * n_points,)
    ball: wp.array(dtype=wp.vec4)  # (B * n_pieces,) centre, radius


@wp.kernel
def enclose_pieces(first: int, hands: PosedHands, ball_out: wp.array(dtype=wp.vec4)):
    """A ball about every piece: the middle of its box, the farthest point."""
    trial = first + wp.tid()
    base = trial * hands.n_points
    for piece in range(hands.n_pieces):
        low = hands.points[base + hands.piece_start[piece]]
        high = low
        for i in range(base + hands.piece_start[piece], base + hands.piece_start[piece + 1]):
            low = wp.min(low, hands.points[i])
            high = wp.max(high, hands.points[i])
        middle = 0.5 * (low + high)
        far = float(0.0)
        for i in range(base + hands.piece_start[piece], base + hands.piece_start[piece + 1]):
            far = wp.max(far, wp.length_sq(hands.points[i] - middle))
        ball_out[trial * hands.n_pieces + piece] = wp.vec4(middle[0], middle[1], middle[2], wp.sqrt(far) + 1.0e-6)


@wp.func
def gripper_distance(
    gripper: Gripper, hands: PosedHands, hand: int, R_ee: wp.mat33, p_ee: wp.vec3, drive: float, cap: float
):  # fmt: skip
    """Distance (m) of the gripper from a hand: `cap` at most, 0 where they overlap. R_ee, p_ee: from the hand points' frame
    to ee."""
    best = float(cap)
    a = Shape()
    a.kind = HULL
    for g in range(gripper.kind.shape[0]):
        if best > 0.0:
            Rg, pg = finger_pose(gripper, g, drive)
            R = wp.transpose(Rg) * R_ee  # hand frame to primitive frame
            p = wp.transpose(Rg) * (p_ee - pg)
            kind = gripper.kind[g]
            size = gripper.size[g]
            b = eroded(kind, size, 0.0)
            around = wp.length(size)  # no point of a primitive is farther from its middle
            if kind == CAPSULE:
                around = size[0] + size[1]
            primitive = -(wp.transpose(R) * p)  # its middle, hand frame
            for piece in range(hands.n_pieces):
                ball = hands.ball[hand * hands.n_pieces + piece]
                center = wp.vec3(ball[0], ball[1], ball[2])
                room = best + ball[3] + around
                if best > 0.0 and wp.length_sq(center - primitive) < room * room:
                    middle = R * center + p
                    if signed_distance(kind, size, middle) - ball[3] < best:
                        a.start = hand * hands.n_points + hands.piece_start[piece]
                        a.count = hands.piece_start[piece + 1] - hands.piece_start[piece]
                        d = gjk(a, R, p, hands.points, b, hands.points, p - middle, best, 0.0)
                        best = wp.min(best, wp.max(d.lower, 0.0))
    return best


@wp.func
def gripper_overlap(gripper: Gripper, hands: PosedHands, hand: int, R_ee: wp.mat33, p_ee: wp.vec3, drive: float):
    """Minus how deep (m) the gripper meets a hand, as far as the balls that its primitives hold tell; arguments as of
    `gripper_distance`."""
    deepest = float(0.0)
    a = Shape()
    a.kind = HULL
    for g in range(gripper.kind.shape[0]):
        Rg, pg = finger_pose(gripper, g, drive)
        R = wp.transpose(Rg) * R_ee
        p = wp.transpose(Rg) * (p_ee - pg)
        b = rounded(gripper.kind[g], gripper.size[g])
        for piece in range(hands.n_pieces):
            ball = hands.ball[hand * hands.n_pieces + piece]
            middle = R * wp.vec3(ball[0], ball[1], ball[2]) + p
            if signed_distance(gripper.kind[g], gripper.size[g], middle) - ball[3] < deepest:
                a.start = hand * hands.n_points + hands.piece_start[piece]
                a.count = hands.piece_start[piece + 1] - hands.piece_start[piece]
                d = gjk(a, R, p, hands.points, b, hands.points, p - middle, deepest, 0.0)
                deepest = wp.min(deepest, d.upper)
    return deepest


@wp.kernel
def gripper_to_hand(
    first: int,
    # tables
    gripper: Gripper, hands: PosedHands, cap: float,
    # trials
    row_in: wp.array(dtype=int), count_in: wp.array(dtype=int), T_in: wp.array(dtype=wp.mat44),
    opening_in: wp.array(dtype=float),
    # out
    clearance_out: wp.array2d(dtype=float),
):  # fmt: skip
    """Distance (m) of gripper k of each trial to its hand: `cap` at most, 0 where they overlap.

    Gripper k of a trial stands at row row_in + k of `T_in` (ee in the hand points' frame) and `opening_in`.
    """
    i, k = wp.tid()
    trial = first + i
    if k >= count_in[trial]:
        clearance_out[trial, k] = 0.0
        return
    row = row_in[trial] + k
    R_ee, p_ee = inverse_pose(T_in[row])
    drive = drive_from_gap(gripper, opening_in[row])
    clearance_out[trial, k] = gripper_distance(gripper, hands, trial, R_ee, p_ee, drive, cap)
