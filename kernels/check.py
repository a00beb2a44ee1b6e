"""One posture against everything: are all pairs clear, over a whole stretch of motion around it?

`examine` serves three questions with one enumeration of pairs and one GJK call site:
is this posture free (half = 0), is this stretch of an edge free (conservative advancement), and what is the smallest
clearance (branch and bound, `track`). Masks carry what is already settled from a stretch to its halves.
"""

import warp as wp

from r2h_batch.kernels.gjk import BOX, ROUNDING_M, Body, from_ball, gjk, support, swept_support
from r2h_batch.kernels.world import (
    GRIPPER,
    OBJECT,
    TrialBodies,
    World,
    body_pose,
    curvature,
    forward_kinematics,
    from_point,
    from_segment,
    hull_body,
    link_frame,
    motion,
    object_body,
    robot_body,
    swept_capsule,
    twists,
    vec6,
)

wp.set_module_options({"enable_backward": False})

FREE = wp.constant(0)
BLOCKED = wp.constant(1)
OPEN = wp.constant(2)

MAX_PARTNERS = wp.constant(64)
MAY_MEET = wp.constant(256)  # added to a partner that bounding volumes do not keep apart in the middle of the stretch
SLACK_M = wp.constant(0.03)
HAND_SLACK_M = wp.constant(0.06)
"""Bounding volumes rarely understate a distance by more: a pair that would need it stays open without asking GJK."""


# CollidingPair codes, as in r2h_batch.types
PAIR_HAND = wp.constant(1)
PAIR_TABLE = wp.constant(2)
PAIR_SELF = wp.constant(3)
PAIR_OBJECT_HAND = wp.constant(4)
PAIR_OBJECT_TABLE = wp.constant(5)
PAIR_OBJECT_ROBOT = wp.constant(6)


@wp.struct
class Query:
    """A posture q, and the stretch q +- d that it stands for; what each kind of pair has to keep."""

    q: vec6
    d: vec6  # half the stretch, rad (zero: the posture alone)
    hand_margin: float
    other_margin: float
    track: int  # 1: look for the smallest clearance below `best` instead of a yes or no
    tolerance: float  # of that smallest clearance


@wp.struct
class Finding:
    """FREE, BLOCKED or OPEN (undecided); the pair that blocked or is nearest, its body, and the smallest clearance."""

    status: int
    pair: int
    body: int
    best: float


@wp.func
def _bit(i: int):
    return wp.uint64(1) << wp.uint64(i)


@wp.func
def examine(
    world: World,
    bodies: TrialBodies,
    trial: int,
    query: Query,
    best: float,
    masks: wp.array(dtype=wp.uint64),  # hand, table, self: bit = body still to be settled; cleared here
    R: wp.array(dtype=wp.mat33),  # (7,) scratch: link frames
    p: wp.array(dtype=wp.vec3),
    w: wp.array(dtype=wp.vec3),  # (7,) scratch: link twists
    v: wp.array(dtype=wp.vec3),
    partner: wp.array(dtype=int),  # (MAX_PARTNERS,) scratch
):
    """What is known of the stretch after looking at its middle."""
    out = Finding()
    out.status = FREE
    out.pair = 0
    out.body = -1
    out.best = best
    R_hand_world = bodies.R_hand_world[trial]
    p_hand_world = bodies.p_hand_world[trial]
    forward_kinematics(world, R_hand_world, p_hand_world, query.q, R, p)
    moving = wp.dot(query.d, query.d) > 0.0
    if moving:
        twists(query.d, R, p, w, v)
    hand = bodies.hand[trial]
    hand_center = world.hand_center[hand]
    hand_radius = world.hand_radius[hand]
    up = wp.vec3(R_hand_world[0, 2], R_hand_world[1, 2], R_hand_world[2, 2])  # world z in the hand frame
    table_p = R_hand_world * world.table_center + p_hand_world
    first_hull = world.hull_first[bodies.object[trial]]
    n_hulls = world.hull_first[bodies.object[trial] + 1] - first_hull
    gap = wp.where(query.track == 1, 0.0, wp.where(moving, 0.05, 0.0))

    for link in range(9):
        lo = int(world.n_robot)
        hi = int(world.n_robot + n_hulls)
        if link < OBJECT:
            lo = world.link_first[link]
            hi = world.link_first[link + 1]
        # bits of this link's bodies; all hulls of the object share one
        bits = wp.uint64(0)
        if link == OBJECT:
            bits = _bit(world.n_robot)
        else:
            bits = (_bit(hi) - _bit(0)) & ~(_bit(lo) - _bit(0))
        hand_on = (masks[0] & bits) != wp.uint64(0)
        table_on = (masks[1] & bits) != wp.uint64(0)
        self_on = (masks[2] & bits) != wp.uint64(0)
        self_with = int(0)
        if not (hand_on or table_on or self_on):
            continue
        if link < OBJECT:  # the link as a whole first
            Rk = R[link_frame(link)]
            pk = p[link_frame(link)]
            c0 = Rk * world.link_c0[link] + pk
            c1 = Rk * world.link_c1[link] + pk
            rk = world.link_radius[link]
            if hand_on:
                target = wp.where(query.track == 1, out.best - query.tolerance, query.hand_margin)
                toward = from_point(hand_center, c0, c1)
                far = wp.length(toward)
                clear = far - hand_radius - rk - motion(world.link_lever, link, 0, query.d) >= target
                if moving and not clear and far - hand_radius - rk > target:
                    n_hat = toward / far
                    k = link_frame(link)
                    low = swept_capsule(c0, c1, rk, n_hat, w[k], v[k], curvature(world.link_lever, link, 0, query.d))
                    clear = low - wp.dot(n_hat, hand_center) - hand_radius >= target
                if clear:
                    hand_on = False
                    masks[0] = masks[0] & ~bits
            if table_on:
                target = wp.where(query.track == 1, out.best - query.tolerance, query.other_margin)
                low = wp.min(wp.dot(up, c0 - table_p), wp.dot(up, c1 - table_p)) - world.table_half[2]
                if low - rk >= target + motion(world.link_lever, link, 1, query.d):
                    table_on = False
                    masks[1] = masks[1] & ~bits
            if self_on:
                target = wp.where(query.track == 1, out.best - query.tolerance, query.other_margin)
                for other in range(link):
                    if (world.self_links[link] >> other) & 1 == 1:
                        Ro = R[other]
                        po = p[other]
                        o0 = Ro * world.link_c0[other] + po
                        o1 = Ro * world.link_c1[other] + po
                        toward = from_segment(o0, o1, c0, c1)
                        far = wp.length(toward)
                        reach = far - rk - world.link_radius[other]
                        clear = reach - motion(world.link_lever, link, other, query.d) >= target
                        if moving and not clear and reach > target:
                            n_hat = toward / far
                            k = link_frame(link)
                            bend_link = curvature(world.link_lever, link, other, query.d)
                            low = swept_capsule(c0, c1, rk, n_hat, w[k] - w[other], v[k] - v[other], bend_link)
                            high = wp.max(wp.dot(n_hat, o0), wp.dot(n_hat, o1)) + world.link_radius[other]
                            clear = low - high >= target
                        if not clear:
                            self_with = self_with | (1 << other)
                if self_with == 0:
                    self_on = False
                    masks[2] = masks[2] & ~bits
            if not (hand_on or table_on or self_on):
                continue
        elif self_on:
            self_with = world.self_links[OBJECT]

        hand_open = wp.uint64(0)
        table_open = wp.uint64(0)
        self_open = wp.uint64(0)
        for b in range(lo, hi):
            bit = _bit(wp.min(b, world.n_robot))
            do_hand = hand_on and (masks[0] & bit) != wp.uint64(0)
            do_table = table_on and (masks[1] & bit) != wp.uint64(0)
            do_self = self_on and (masks[2] & bit) != wp.uint64(0)
            if not (do_hand or do_table or do_self):
                continue
            Rb, pb = body_pose(world, bodies, trial, R, p, b)
            c0 = wp.vec3(0.0, 0.0, 0.0)
            c1 = wp.vec3(0.0, 0.0, 0.0)
            rb = float(0.0)
            mb = float(0.0)
            bend = float(0.0)
            w_b = w[link_frame(link)]
            v_b = v[link_frame(link)]
            hull = first_hull + b - world.n_robot
            if link == OBJECT:
                c0 = Rb * world.hull_c0[hull] + pb
                c1 = Rb * world.hull_c1[hull] + pb
                rb = world.hull_radius[hull]
                mb = motion(bodies.object_lever, trial, 0, query.d)
                bend = curvature(bodies.object_lever, trial, 0, query.d)
            else:
                axis = Rb * world.cap_axis[b]
                c0 = pb - axis
                c1 = pb + axis
                rb = world.cap_radius[b]
                mb = motion(world.lever, b, 0, query.d)
                bend = curvature(world.lever, b, 0, query.d)

            shape = robot_body(world, wp.min(b, world.n_robot - 1))
            if link == OBJECT:
                shape = object_body(world, hull)

            # partners of this body that bounding volumes cannot settle
            n = int(0)
            if do_hand:
                target = wp.where(query.track == 1, out.best - query.tolerance, query.hand_margin)
                toward = from_point(hand_center, c0, c1)
                far = wp.length(toward)
                near = far - hand_radius - rb < target + mb
                if near and moving and far - hand_radius - rb > target + query.tolerance:
                    n_hat = toward / far
                    low = swept_capsule(c0, c1, rb, n_hat, w_b, v_b, bend) - wp.dot(n_hat, hand_center) - hand_radius
                    if low >= target:
                        near = False
                    elif low + HAND_SLACK_M < target:
                        near = False
                        hand_open = hand_open | bit
                if near:
                    middle = 0.5 * (c0 + c1)
                    around = 0.5 * wp.length(c1 - c0) + rb + target + mb
                    for i in range(world.n_pieces):
                        piece = hand * world.n_pieces + i
                        center = world.piece_center[piece]
                        if wp.length(center - middle) - world.piece_radius[piece] >= around:
                            continue
                        toward = wp.vec3(0.0, 0.0, 0.0)
                        if link == OBJECT:
                            toward = from_point(center, c0, c1)
                        else:
                            toward = Rb * from_ball(shape, wp.transpose(Rb) * (center - pb))
                        far = wp.length(toward)
                        apart = far - world.piece_radius[piece]
                        if link == OBJECT:
                            apart = apart - rb
                        if apart >= target + mb:
                            continue
                        if moving and apart > target + query.tolerance:
                            if (hand_open & bit) != wp.uint64(0):
                                continue  # the stretch has to be halved anyway
                            n_hat = toward / far
                            low = -wp.dot(n_hat, center) - world.piece_radius[piece]
                            if link == OBJECT:
                                low = low + swept_capsule(c0, c1, rb, n_hat, w_b, v_b, bend)
                            else:
                                low = low + swept_support(shape, Rb, pb, world.points, n_hat, w_b, v_b, bend)
                            if low >= target:
                                continue
                            if low + SLACK_M < target:
                                hand_open = hand_open | bit
                                continue
                        partner[n] = wp.where(apart > target + query.tolerance, i, i + MAY_MEET)
                        n += 1
            n_hand = n
            if do_table:
                # height above the table's top: joint 1 cannot change it, whatever the distance to the table's edge does
                target = wp.where(query.track == 1, out.best - query.tolerance, query.other_margin)
                top = wp.dot(up, table_p) + world.table_half[2]
                lowest = Rb * support(shape, world.points, -(wp.transpose(Rb) * up)) + pb
                height = wp.dot(up, lowest) - shape.radius - top - ROUNDING_M
                low = height
                if moving:
                    if link == OBJECT:
                        low = height - motion(bodies.object_lever, trial, 1, query.d)
                        if low < target:
                            bend_up = curvature(bodies.object_lever, trial, 1, query.d)
                            low = wp.max(low, swept_capsule(c0, c1, rb, up, w_b, v_b, bend_up) - top)
                    else:
                        low = height - motion(world.lever, b, 1, query.d)
                        if low < target:
                            bend_up = curvature(world.lever, b, 1, query.d)
                            low = wp.max(low, swept_support(shape, Rb, pb, world.points, up, w_b, v_b, bend_up) - top)
                if low < target:
                    if height > target + query.tolerance:
                        table_open = table_open | bit  # a shorter stretch will tell
                    else:
                        partner[n] = MAY_MEET
                        n += 1
            n_table = n
            if do_self:
                target = wp.where(query.track == 1, out.best - query.tolerance, query.other_margin)
                for other in range(wp.min(link, GRIPPER)):
                    if (self_with >> other) & 1 == 1:
                        m = float(0.0)
                        bend_other = float(0.0)
                        if link == OBJECT:
                            m = motion(bodies.object_lever, trial, other, query.d)
                            bend_other = curvature(bodies.object_lever, trial, other, query.d)
                        else:
                            m = motion(world.lever, b, other, query.d)
                            bend_other = curvature(world.lever, b, other, query.d)
                        # the other link as a whole first
                        o0 = R[other] * world.link_c0[other] + p[other]
                        o1 = R[other] * world.link_c1[other] + p[other]
                        ro = world.link_radius[other]
                        toward = from_segment(o0, o1, c0, c1)
                        far = wp.length(toward)
                        if far - rb - ro >= target + m:
                            continue
                        if moving and far - rb - ro > target + query.tolerance:
                            n_hat = toward / far
                            low = swept_capsule(c0, c1, rb, n_hat, w_b - w[other], v_b - v[other], bend_other)
                            if low - wp.max(wp.dot(n_hat, o0), wp.dot(n_hat, o1)) - ro >= target:
                                continue
                        for o in range(world.link_first[other], world.link_first[other + 1]):
                            Ro, po = body_pose(world, bodies, trial, R, p, o)
                            axis = Ro * world.cap_axis[o]
                            toward = from_segment(po - axis, po + axis, c0, c1)
                            far = wp.length(toward)
                            apart = far - rb - world.cap_radius[o]
                            if apart >= target + m:
                                continue
                            if moving and apart > target + query.tolerance:
                                if (self_open & bit) != wp.uint64(0):
                                    continue
                                n_hat = toward / far
                                low = swept_capsule(c0, c1, rb, n_hat, w_b - w[other], v_b - v[other], bend_other)
                                low = (
                                    low
                                    - wp.max(wp.dot(n_hat, po - axis), wp.dot(n_hat, po + axis))
                                    - world.cap_radius[o]
                                )
                                if low >= target:
                                    continue
                                if low + SLACK_M < target:
                                    self_open = self_open | bit
                                    continue
                            partner[n] = wp.where(apart > target + query.tolerance, o, o + MAY_MEET)
                            n += 1

            for i in range(n):
                may_meet = partner[i] >= MAY_MEET
                other_body = partner[i] & (MAY_MEET - 1)
                if moving and not may_meet:
                    if i < n_hand and (hand_open & bit) != wp.uint64(0):
                        continue
                    if i >= n_table and (self_open & bit) != wp.uint64(0):
                        continue
                # the partner at the origin of its own frame; this body relative to it
                other_shape = Body()
                Rr = Rb
                pr = pb
                center = wp.vec3(0.0, 0.0, 0.0)
                pair = int(PAIR_HAND)
                m = mb
                bend_pair = bend
                margin = query.other_margin
                wr = w_b
                vr = v_b
                if i < n_hand:
                    piece = hand * world.n_pieces + other_body
                    other_shape = hull_body(world.piece_start, piece)
                    center = world.piece_center[piece]
                    margin = query.hand_margin
                elif i < n_table:
                    pair = PAIR_TABLE
                    other_shape.kind = BOX
                    other_shape.size = world.table_half
                    Rt = wp.transpose(R_hand_world)
                    Rr = Rt * Rb
                    pr = Rt * (pb - table_p)
                    vr = Rt * (vr + wp.cross(wr, table_p))
                    wr = Rt * wr
                else:
                    pair = PAIR_SELF
                    o = other_body
                    other_shape = robot_body(world, o)
                    Ro, po = body_pose(world, bodies, trial, R, p, o)
                    Rt = wp.transpose(Ro)
                    Rr = Rt * Rb
                    pr = Rt * (pb - po)
                    k = world.body_link[o]
                    wr = wr - w[k]
                    vr = vr - v[k]
                    vr = Rt * (vr + wp.cross(wr, po))
                    wr = Rt * wr
                    if link == OBJECT:
                        m = motion(bodies.object_lever, trial, k, query.d)
                        bend_pair = curvature(bodies.object_lever, trial, k, query.d)
                    else:
                        m = motion(world.lever, b, k, query.d)
                        bend_pair = curvature(world.lever, b, k, query.d)
                if link == OBJECT:
                    pair = pair + 3
                if query.track == 1:
                    margin = out.best - query.tolerance
                needed = margin + m
                if query.track == 1:
                    needed = wp.max(needed, out.best)  # a clearance that becomes the best must have converged
                dist = gjk(shape, Rr, pr, world.points, other_shape, world.points, center, needed, gap)
                if query.track == 1:
                    if dist.lower < out.best:
                        # a core that is met has no clearance, only an overlap that GJK does not measure
                        out.best = wp.max(dist.lower, -1.0e-6)
                        if dist.upper <= 0.0 and dist.lower > -1.0e-6:
                            out.best = -1.0e-6
                        out.pair = pair
                        out.body = b
                    margin = out.best - query.tolerance
                elif dist.upper <= margin or (gap == 0.0 and dist.lower < margin):
                    out.status = BLOCKED
                    out.pair = pair
                    out.body = b
                    return out
                apart = dist.lower
                if moving and apart < margin + m and apart > margin + 0.5 * bend_pair and dist.upper > 0.0:
                    # not clear of everything that the levers allow, but perhaps of where it really goes
                    n_hat = dist.v / wp.length(dist.v)
                    beside = wp.dot(n_hat, support(other_shape, world.points, n_hat)) + other_shape.radius
                    apart = m - beside + swept_support(shape, Rr, pr, world.points, n_hat, wr, vr, bend_pair)
                if apart < margin + m:
                    if i < n_hand:
                        hand_open = hand_open | bit
                    elif i < n_table:
                        table_open = table_open | bit
                    else:
                        self_open = self_open | bit
        if (hand_open | table_open | self_open) != wp.uint64(0):
            out.status = OPEN
        masks[0] = masks[0] & (~bits | hand_open)
        masks[1] = masks[1] & (~bits | table_open)
        masks[2] = masks[2] & (~bits | self_open)
    return out
