"""What Pick asks of a grasp itself, row by row: where it is when the object rests, which branch reaches it, the verdict.

Tensor operations would do the same, but a small call that launches nothing but kernels is recorded (`base.launch.repeated`).
Products are rounded before they are added, in the order of `r2h_batch.base.se3.matmul`: the bits are its own.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import BRANCHES, PAIR_NONE, REASON_IK_UNREACHABLE, REASON_NOT_EVALUATED

wp.set_module_options(OPTIONS)


@wp.kernel
def place_grasps(
    first: int, open_gap: float, T_world_obj_in: wp.array(dtype=wp.mat44), T_obj_ee_in: wp.array(dtype=wp.mat44),
    T_world_ee_out: wp.array(dtype=wp.mat44), opening_out: wp.array(dtype=float),
):  # fmt: skip
    """The grasps where the objects rest, and the gap of the open gripper."""
    row = first + wp.tid()
    A = T_world_obj_in[row]
    B = T_obj_ee_in[row]
    T = wp.mat44()
    for i in range(4):
        for j in range(4):
            total = float(A[i, 0] * B[0, j])
            for k in range(1, 4):
                total = total + A[i, k] * B[k, j]
            T[i, j] = total
    T_world_ee_out[row] = T
    opening_out[row] = open_gap


@wp.kernel
def first_branches(
    first: int, active_in: wp.array(dtype=wp.bool), valid_in: wp.array2d(dtype=wp.bool), q_in: wp.array2d(dtype=float),
    missed_out: wp.array(dtype=wp.bool), reason_out: wp.array(dtype=int), pair_out: wp.array(dtype=int),
    slot_out: wp.array(dtype=int), length_out: wp.array(dtype=int), posture_out: wp.array3d(dtype=float),
):  # fmt: skip
    """The first valid branch of each row as a path of one posture; without one no path, and what `judge.goal.measured` takes of
    rows that are out of reach."""
    row = first + wp.tid()
    slot = int(-1)
    for k in range(BRANCHES):
        if slot < 0 and valid_in[row, k]:
            slot = k
    length_out[row] = wp.where(slot < 0, 0, 1)
    missed = active_in[row] and slot < 0
    missed_out[row] = missed
    reason_out[row] = wp.where(missed, int(REASON_IK_UNREACHABLE), int(REASON_NOT_EVALUATED))
    pair_out[row] = PAIR_NONE
    slot_out[row] = -1
    if slot >= 0:
        for j in range(q_in.shape[1]):
            posture_out[row, 0, j] = q_in[row * BRANCHES + slot, j]


@wp.kernel
def judge_grasps(
    first: int, cap: float, farthest: float,
    ok: int, not_evaluated: int, out_of_reach: int, collides: int,  # PickReason
    active_in: wp.array(dtype=wp.bool), length_in: wp.array(dtype=int), missed_in: wp.array(dtype=float),
    clearance_in: wp.array(dtype=float), nearest_in: wp.array(dtype=int), part_in: wp.array(dtype=int),
    picked_out: wp.array(dtype=wp.bool), reason_out: wp.array(dtype=int), margin_out: wp.array(dtype=float),
    pair_out: wp.array(dtype=int), body_out: wp.array(dtype=int),
):  # fmt: skip
    """The first two stages of Pick: the grasp is within reach, and the open gripper meets nothing there.

    `missed_in` is minus what an unreachable grasp lacks; the other three: of the gripper alone, where there is a posture.
    """
    row = first + wp.tid()
    reason = int(ok)
    margin = float(cap)
    pair = int(PAIR_NONE)
    body = int(-1)
    if length_in[row] > 0:
        margin = clearance_in[row]
        pair = nearest_in[row]
        body = part_in[row]
        if margin <= 0.0:
            reason = collides
    else:
        reason = out_of_reach
        margin = missed_in[row]
        if margin < -farthest:
            margin = -farthest
    if not active_in[row]:
        reason = not_evaluated
        margin = wp.nan
        pair = PAIR_NONE
        body = -1
    picked_out[row] = reason == ok
    reason_out[row] = reason
    margin_out[row] = margin
    pair_out[row] = pair
    body_out[row] = body


@wp.kernel
def pick_columns(
    first: int, reason_in: wp.array(dtype=int), nearest_in: wp.array(dtype=int), part_in: wp.array(dtype=int),
    pick_out: wp.array2d(dtype=int),
):  # fmt: skip
    """Reason, pair and body side by side."""
    row = first + wp.tid()
    pick_out[row, 0] = reason_in[row]
    pick_out[row, 1] = nearest_in[row]
    pick_out[row, 2] = part_in[row]
