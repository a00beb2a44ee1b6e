"""The goal posture of a pose: the branch that the planner would take first, and its clearance. Its distance to the hand:
goal_distance.py, compiled at the same time by another core."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS, opaque
from r2h_batch.kernels.plan.codes import (
    BRANCHES,
    FREE,
    MAX_OBSTACLES,
    PAIR_HAND,
    PAIR_NONE,
    PAIR_OF_OBJECT,
    PAIR_SELF,
    REASON_IK_IN_COLLISION,
    REASON_IK_UNREACHABLE,
    REASON_NOT_EVALUATED,
    REASON_OK,
    REASON_START_IN_COLLISION,
)

from ..plan.check import check_interval
from ..plan.obstacles import Query
from ..plan.posture import PairClearance, posture_clearance
from ..robot.joints import FIELDS, FRAMES, JOINTS, LAST_LINK, vecq
from ..robot.posture import load
from ..robot.world import TrialBodies, World

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache

TIE_M = wp.constant(1.0e-5)
"""Branches that differ by less are equal (the hand mostly meets gripper and object, which stand alike in all): the first."""


@wp.func
def _nearest_untried(q_in: wp.array2d(dtype=float), trial: int, home: vecq, tried: int):
    """The branch nearest to home among those whose bit of `tried` is not set; -1: none is left.

    Distances in float64, as the planner sorts its goals: ties fall the same way.
    """
    slot = int(-1)
    least = wp.float64(1e300)
    for k in range(BRANCHES):
        if (tried >> k) & 1 == 0:
            d = wp.float64(0.0)
            for j in range(JOINTS):
                e = wp.float64(q_in[trial * BRANCHES + k, j] - home[j])
                d += e * e
            if d < least:
                least = d
                slot = k
    return slot


# The planner goes to the free branch that is nearest to home in joint space. If none is free, it names what blocks the first
# valid one. This kernel does the same without a path, in one loop around one call of `check_interval` (most of its code):
#
# 1. home comes first (slot -1). If it is not free, and the object is in the gripper there already, that is the reason. The
#    branches are still checked, because the goal's clearance is measured at the one that is free;
# 2. the valid branches follow by distance from home, until one is free;
# 3. `tried` has a bit for each branch that needs no check: invalid ones, and those that are checked. When all bits are set the
#    reason stays: unreachable without any valid branch, else in collision;
# 4. a branch is first checked for the body and kind of pair that blocked the one before. This is quick and often enough, because
#    all that rides on the wrist stands in the same place in every branch. The first valid branch is checked in full order
#    when the caller wants to know what blocks it.
@wp.kernel
def choose_goal(
    first: int,
    # tables
    world: World, bodies: TrialBodies,
    singular: int,  # the status of such a pair (kernels/ik/step.py)
    unproven: int,  # the reason in place of REASON_IK_IN_COLLISION where branches are points of a line of solutions
    home_in: wp.array2d(dtype=float),  # (1, JOINTS)
    from_home: int,  # 1: the object is in the gripper at home already
    # trials
    active_in: wp.array(dtype=wp.bool),  # (B,)
    valid_in: wp.array2d(dtype=wp.bool),  # (B, 8)
    status_in: wp.array2d(dtype=wp.uint8),  # (B, 4) of pairs of branches
    q_in: wp.array2d(dtype=float),  # (B * 8, JOINTS)
    # out
    reason_out: wp.array(dtype=int), pair_out: wp.array(dtype=int), slot_out: wp.array(dtype=int),
):  # fmt: skip
    """PlanReason as far as it is known without a path, the pair that blocks, and the free branch nearest to home (or -1).

    Branches are tried in the planner's order until one is free; the test is the planner's own (check.py).
    """
    trial = first + wp.tid()
    slot_out[trial] = -1
    pair_out[trial] = PAIR_NONE
    if not active_in[trial]:
        reason_out[trial] = REASON_NOT_EVALUATED
        return
    home = load(home_in, 0)
    tried = int(0)  # bit k: branch k is done with
    first_valid = int(-1)
    for k in range(BRANCHES):
        if not valid_in[trial, k]:
            tried = tried | (1 << k)
        elif first_valid < 0:
            first_valid = k
    reason = int(REASON_IK_IN_COLLISION)
    if first_valid < 0:
        reason = REASON_IK_UNREACHABLE
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    w = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    v = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    obstacle = wp.zeros(shape=MAX_OBSTACLES, dtype=int)
    masks = wp.zeros(shape=3, dtype=wp.uint64)
    query = Query()  # no motion, no margins
    query.q = home
    slot = int(-1)  # home itself comes first
    blocker = int(PAIR_NONE)  # what blocked the branch before: a pair, and the body's bit in the masks
    blocking = wp.uint64(0)
    running = bool(True)
    while running:
        quick = blocker != PAIR_NONE and (slot != first_valid or reason != REASON_IK_IN_COLLISION)
        masks[0] = ~wp.uint64(0)
        masks[1] = ~wp.uint64(0) << wp.uint64(world.table_from)  # base and shoulder stand on the table
        masks[2] = ~wp.uint64(0)
        if quick:
            for kind in range(3):
                masks[kind] = wp.where(kind == (blocker - PAIR_HAND) % PAIR_OF_OBJECT, blocking, wp.uint64(0))
        found = check_interval(world, bodies, trial, query, False, 0.0, masks, R, p, w, v, obstacle)
        if quick and found.status == FREE:
            blocker = PAIR_NONE
            continue
        if slot >= 0:
            blocker = found.pair
            blocking = wp.uint64(1) << wp.uint64(wp.max(wp.min(found.body, world.n_robot), 0))
        if slot < 0:
            if from_home == 1 and found.status != FREE:
                reason = REASON_START_IN_COLLISION
                pair_out[trial] = found.pair
        elif found.status == FREE:
            slot_out[trial] = slot
            if reason == REASON_IK_IN_COLLISION:
                reason = REASON_OK
                pair_out[trial] = PAIR_NONE
            running = False
        elif slot == first_valid and reason == REASON_IK_IN_COLLISION:
            pair_out[trial] = found.pair  # what blocks the first valid branch stands for all, as in the planner
        if running:
            slot = _nearest_untried(q_in, trial, home, tried)
            if slot < 0:
                running = False
            else:
                tried = tried | (1 << slot)
                query.q = load(q_in, trial * BRANCHES + slot)
    if reason == REASON_IK_IN_COLLISION:
        for k in range(status_in.shape[1]):
            if int(status_in[trial, k]) == singular:
                reason = unproven
    reason_out[trial] = reason


@wp.func
def _branch_or_home(q_in: wp.array2d(dtype=float), first: int, step: int, home_in: wp.array2d(dtype=float)):
    """The branch that `first` and `step` say, home after the last."""
    q = load(home_in, opaque(0))
    if step < BRANCHES:
        q = load(q_in, first + step)
    return q


@wp.kernel
def goal_clearance(
    first: int, cap: float,
    # tables
    world: World, hull_ball: wp.array(dtype=wp.vec4), bodies: TrialBodies,
    home_in: wp.array2d(dtype=float),  # (1, JOINTS)
    # trials
    reason_in: wp.array(dtype=int),  # (B,)
    valid_in: wp.array2d(dtype=wp.bool),  # (B, 8)
    q_in: wp.array2d(dtype=float),  # (B * 8, JOINTS)
    residual_in: wp.array(dtype=float),  # of unreachable targets
    # in and out; out
    pair_out: wp.array(dtype=int),  # of free goals: the nearest pair
    slot_inout: wp.array(dtype=int),  # the free branch, or -1: then the one with the largest clearance is put here
    q_goal_inout: wp.array2d(dtype=float),  # (B, JOINTS) unreachable targets: the nearest posture, already here
    clearance_out: wp.array(dtype=float),
    nearest_out: wp.array(dtype=int),  # the nearest pair, of colliding goals too
    body_out: wp.array(dtype=int), other_out: wp.array(dtype=int),
    push_out: wp.array(dtype=wp.vec3),  # world frame
    point_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Clearance of the goal posture (a start in collision: of home), its witness, and the goal posture itself.

    Above 0 exactly where the reason is REASON_OK; unreachable targets have minus their residual.

    One loop, with one call of `posture_clearance`, over the postures that count: the chosen branch where one is free;
    else all valid branches, the largest clearance of which is kept (by more than TIE_M: the first of equal ones); after
    the branches home. A branch that has to beat a known overlap is looked at twice: first only for overlaps at least as
    deep (`cap` = that depth), which is quick and mostly enough to drop it, then for its exact clearance.
    """
    trial = first + wp.tid()
    reason = reason_in[trial]
    body_out[trial] = -1
    other_out[trial] = -1
    nearest_out[trial] = PAIR_NONE
    if reason == REASON_NOT_EVALUATED:  # its posture is NaN already
        clearance_out[trial] = wp.nan
        push_out[trial] = wp.vec3()
        point_out[trial] = wp.vec3()
        return
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    chosen = slot_inout[trial]
    best = PairClearance()
    best.clearance = -1.0e30
    best.body = -1
    best.other = -1
    settled = bool(False)
    for step in range(BRANCHES + 1):  # the last one is home, for starts in collision
        row = opaque(trial)
        wanted = step == chosen
        if step < BRANCHES and chosen < 0:
            wanted = valid_in[row, step] and not settled
        floor = best.clearance + TIE_M
        if step == BRANCHES:
            wanted = reason == REASON_START_IN_COLLISION
            floor = float(-1.0e30)
        q = _branch_or_home(q_in, row * BRANCHES, step, home_in)
        # a first look for something deeper than the best branch's margin, then everything
        attempt = wp.where(floor > -1.0e29 and floor < 0.0, 0, 1)
        while wanted and attempt < 2:
            look = wp.where(attempt == 0, floor, cap)
            found = posture_clearance(world, hull_ball, bodies, row, q, look, floor, R, p)
            wanted = found.clearance >= look or attempt == 1
            attempt += 1
            if wanted and attempt == 2 and (found.clearance > floor or step == BRANCHES):
                best = found
                if step < BRANCHES:
                    slot_inout[row] = step
                # bodies on the wrist meet hand and table in the same way in every branch: none can be better
                if best.clearance < 0.0 and best.pair % PAIR_SELF != 0 and best.body >= world.link_first[LAST_LINK]:
                    settled = True
    trial = opaque(trial)
    if slot_inout[trial] >= 0:
        for j in range(JOINTS):
            q_goal_inout[trial, j] = q_in[trial * BRANCHES + slot_inout[trial], j]
    clearance = best.clearance
    if reason == REASON_OK:
        clearance = wp.max(clearance, 1.0e-7)
        pair_out[trial] = best.pair
    elif reason == REASON_IK_UNREACHABLE:
        clearance = -residual_in[trial]
    else:
        clearance = wp.min(clearance, -1.0e-6)
    clearance_out[trial] = clearance
    body_out[trial] = best.body
    other_out[trial] = best.other
    nearest_out[trial] = best.pair
    R_world_hand = wp.transpose(bodies.R_hand_world[trial])
    push_out[trial] = R_world_hand * best.push
    point_out[trial] = R_world_hand * (best.point - bodies.p_hand_world[trial])
