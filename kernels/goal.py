"""The goal posture of a handover pose: which branch the planner would go to first, how clear it is, how near the hand's mesh."""

import warp as wp

from r2h_batch.kernels.check import FREE
from r2h_batch.kernels.edge import edge
from r2h_batch.kernels.posture import Nearest, posture_clearance
from r2h_batch.kernels.safe import HandMesh, posture_distance
from r2h_batch.kernels.world import WRIST_3, TrialBodies, World, vec6

wp.set_module_options({"enable_backward": False, "max_unroll": 0})  # unrolled, the code outgrows every cache

BRANCHES = wp.constant(8)
TIE_M = wp.constant(1.0e-5)
"""Branches that differ by less are equal (the hand mostly meets gripper and object, which stand alike in all): the first."""

# PlanReason codes, as in r2h_batch.types
OK = wp.constant(0)
START_IN_COLLISION = wp.constant(1)
IK_UNREACHABLE = wp.constant(2)
IK_IN_COLLISION = wp.constant(3)
NOT_EVALUATED = wp.constant(5)


@wp.func
def _load(q: wp.array2d(dtype=float), row: int):
    return vec6(q[row, 0], q[row, 1], q[row, 2], q[row, 3], q[row, 4], q[row, 5])


@wp.kernel
def choose_goal(
    first: int,
    world: World,
    bodies: TrialBodies,
    home_in: wp.array2d(dtype=float),  # (1, 6)
    active_in: wp.array(dtype=wp.bool),
    valid_in: wp.array2d(dtype=wp.bool),  # (B, 8)
    q_in: wp.array2d(dtype=float),  # (B * 8, 6)
    reason_out: wp.array(dtype=int),
    pair_out: wp.array(dtype=int),
    slot_out: wp.array(dtype=int),
):
    """PlanReason as far as it is known without a path, the pair that blocks, and the free branch nearest to home (or -1).

    Branches are tried in the planner's order until one is free; the test is the planner's own (edge, mode 3).
    """
    trial = first + wp.tid()
    slot_out[trial] = -1
    pair_out[trial] = 0
    if not active_in[trial]:
        reason_out[trial] = NOT_EVALUATED
        return
    home = _load(home_in, 0)
    tried = int(0)
    first_valid = int(-1)
    for k in range(BRANCHES):
        if not valid_in[trial, k]:
            tried = tried | (1 << k)
        elif first_valid < 0:
            first_valid = k
    reason = int(IK_IN_COLLISION)
    if first_valid < 0:
        reason = IK_UNREACHABLE
    slot = int(-1)  # home itself comes first
    q = home
    running = bool(True)
    while running:
        found = edge(world, bodies, trial, q, q, 0.0, 0.0, 0.0, 0.0, 3, 0)
        if slot < 0:
            if found.status != FREE:
                reason = START_IN_COLLISION
                pair_out[trial] = found.pair
        elif found.status == FREE:
            slot_out[trial] = slot
            if reason == IK_IN_COLLISION:
                reason = OK
                pair_out[trial] = 0
            running = False
        elif slot == first_valid and reason == IK_IN_COLLISION:
            pair_out[trial] = found.pair  # what blocks the first valid branch stands for all, as in the planner
        if running:
            slot = int(-1)
            least = wp.float64(1e300)
            for k in range(BRANCHES):
                if (tried >> k) & 1 == 0:
                    d = wp.float64(0.0)
                    for j in range(6):
                        e = wp.float64(q_in[trial * BRANCHES + k, j] - home[j])
                        d += e * e
                    if d < least:
                        least = d
                        slot = k
            if slot < 0:
                running = False
            else:
                tried = tried | (1 << slot)
                q = _load(q_in, trial * BRANCHES + slot)
    reason_out[trial] = reason


@wp.kernel
def goal_clearance(
    first: int,
    cap: float,
    world: World,
    hull_ball: wp.array(dtype=wp.vec4),
    bodies: TrialBodies,
    home_in: wp.array2d(dtype=float),
    reason_in: wp.array(dtype=int),
    valid_in: wp.array2d(dtype=wp.bool),
    q_in: wp.array2d(dtype=float),  # (B * 8, 6)
    residual_in: wp.array(dtype=float),  # of unreachable targets
    pair_out: wp.array(dtype=int),  # of free goals: the nearest pair
    slot: wp.array(dtype=int),  # the free branch, or -1: then the one with the largest clearance is put here
    q_goal: wp.array2d(dtype=float),  # (B, 6) unreachable targets: the nearest posture, already here
    clearance_out: wp.array(dtype=float),
    nearest_out: wp.array(dtype=int),  # the nearest pair, of colliding goals too
    body_out: wp.array(dtype=int),
    other_out: wp.array(dtype=int),
    push_out: wp.array(dtype=wp.vec3),  # world frame
    point_out: wp.array(dtype=wp.vec3),
):
    """Clearance of the goal posture (a start in collision: of home), its witness, and the goal posture itself.

    Above 0 exactly where the reason is OK; unreachable targets have minus their residual.
    """
    trial = first + wp.tid()
    reason = reason_in[trial]
    body_out[trial] = -1
    other_out[trial] = -1
    nearest_out[trial] = 0
    if reason == NOT_EVALUATED:
        return
    R = wp.zeros(shape=7, dtype=wp.mat33)
    p = wp.zeros(shape=7, dtype=wp.vec3)
    chosen = slot[trial]
    best = Nearest()
    best.clearance = -1.0e30
    best.body = -1
    best.other = -1
    settled = bool(False)
    # step 8 is home, for starts in collision
    for step in range(BRANCHES + 1):
        wanted = step == chosen
        if step < BRANCHES and chosen < 0:
            wanted = valid_in[trial, step] and not settled
        floor = best.clearance + TIE_M
        q = vec6()
        if step == BRANCHES:
            wanted = reason == START_IN_COLLISION
            floor = float(-1.0e30)
            q = _load(home_in, 0)
        else:
            q = _load(q_in, trial * BRANCHES + step)
        # a first look for something deeper than the best branch's margin, then everything
        attempt = wp.where(floor > -1.0e29 and floor < 0.0, 0, 1)
        while wanted and attempt < 2:
            look = wp.where(attempt == 0, floor, cap)
            found = posture_clearance(world, hull_ball, bodies, trial, q, look, floor, R, p)
            wanted = found.clearance >= look or attempt == 1
            attempt += 1
            if wanted and attempt == 2 and (found.clearance > floor or step == BRANCHES):
                best = found
                if step < BRANCHES:
                    slot[trial] = step
                # what rides on the wrist meets hand and table alike in every branch: none can be better
                if best.clearance < 0.0 and best.pair % 3 != 0 and best.body >= world.link_first[WRIST_3]:
                    settled = True
    if slot[trial] >= 0:
        for j in range(6):
            q_goal[trial, j] = q_in[trial * BRANCHES + slot[trial], j]
    clearance = best.clearance
    if reason == OK:
        clearance = wp.max(clearance, 1.0e-7)
        pair_out[trial] = best.pair
    elif reason == IK_UNREACHABLE:
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


@wp.kernel
def goal_safe_distance(
    first: int,
    cap: float,
    world: World,
    mesh: HandMesh,
    bodies: TrialBodies,
    active_in: wp.array(dtype=wp.bool),
    q_in: wp.array2d(dtype=float),  # (B, 6)
    distance_out: wp.array(dtype=float),
    body_out: wp.array(dtype=int),
    point_out: wp.array(dtype=wp.vec3),  # world frame
):
    """Signed distance of the robot to the hand's exact mesh at one posture: exact below `cap`, an overlap bound below 0."""
    trial = first + wp.tid()
    distance_out[trial] = cap
    body_out[trial] = -1
    if not active_in[trial]:
        return
    R = wp.zeros(shape=7, dtype=wp.mat33)
    p = wp.zeros(shape=7, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    w = wp.zeros(shape=7, dtype=wp.vec3)
    v = wp.zeros(shape=7, dtype=wp.vec3)
    mask = wp.zeros(shape=1, dtype=wp.uint64)
    mask[0] = (wp.uint64(1) << wp.uint64(world.n_robot)) - wp.uint64(1)
    found = posture_distance(world, mesh, bodies, trial, _load(q_in, trial), vec6(), cap, 0.0, mask, R, p, w, v, tri)
    distance_out[trial] = found.distance
    body_out[trial] = found.body
    if found.body >= 0:
        point_out[trial] = wp.transpose(bodies.R_hand_world[trial]) * (found.point - bodies.p_hand_world[trial])
