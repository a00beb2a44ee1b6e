"""One posture, or an interval of motion around it, against everything: are all pairs clear?

`check_interval` answers three questions with one enumeration of pairs and one call of GJK: is this posture free (d = 0), is
this interval of an edge free (conservative advancement, edge.py), and what is the smallest clearance (branch and bound,
`aim`). Masks carry what is settled from an interval to its halves: one 64-bit word for each kind of pair (hand, table, self),
bit b for body b, and one bit for all hulls of the object.

Coarse to fine, each step only for what the one before could not settle:

1. a link as a whole against the ball around the hand, the table and other links (obstacles.py: `link_clears_hand` ...);
2. a body against the bounding volumes of its obstacles; those that may be near are listed (obstacles.py: `pieces_near` ...);
3. GJK for each listed pair: a certified lower bound of its distance in the middle of the interval;
4. `settle_pair`: does the pair keep its margin on the whole interval, along the plane that GJK found?

A body's bit is cleared when all its pairs of that kind are settled. A bit that stays set means that the interval is halved. From
then on only pairs that may meet in the middle are checked (MAY_MEET), because they can block.
"""

import warp as wp

from r2h_batch.kernels.geometry.balls import balls_within
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.shape import BLOCKS, BOX, Shape
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import (
    BLOCKED,
    FREE,
    HAND,
    MEETING_M,
    OPEN,
    PAIR_HAND,
    PAIR_NONE,
    PAIR_OF_OBJECT,
    PAIR_SELF,
    PAIR_TABLE,
    SELF,
    TABLE,
)

from ..robot.joints import CHANGES, LINKS, OBJECT
from ..robot.world import TrialBodies, World, body_pose, forward_kinematics, link_frame, points_of, twists
from .obstacles import (
    MAY_MEET,
    Near,
    Query,
    bodies_near,
    link_clears_hand,
    link_clears_table,
    links_within,
    moving_body,
    pair_motion,
    pieces_near,
    settle_pair,
    table_near,
)

wp.set_module_options(OPTIONS)


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
def _seeks_smallest(query: Query, with_hand: bool):
    """Whether the smallest clearance counts pairs of this kind."""
    return query.aim == 1 or (query.aim == 2 and with_hand)


@wp.func
def _target(query: Query, best: float, margin: float, with_hand: bool):
    """Clearance that a pair has to keep: its margin, or what would improve on the smallest clearance so far."""
    return wp.where(_seeks_smallest(query, with_hand), best - query.tolerance, margin)


# The steps of this file's head, for links 0 .. 7 of the robot (a link's bodies share its motion) and for the object.
# For each of them:
#
# 1. `bits`: this link's bodies in the masks. If none is open in any of the three kinds, the next link follows;
# 2. the link's bounding capsule against the ball around the hand, the table's top and capsules of other links. A kind that is
#    clear loses all its bits at once; `self_with` keeps the links that this one may meet;
# 3. each body: one array lists the obstacles that bounding volumes cannot settle: pieces, the table, then bodies. So all pairs go
#    through one call of GJK. Inlined, GJK is most of the code of every planning kernel;
# 4. each listed pair: one that meets ends the function (BLOCKED). A pair that is not settled puts the body's bit into its
#    kind's `*_open`;
# 5. the link's bits in the masks become the open ones. A caller that halves the interval goes on with these masks.
@wp.func
def check_interval(
    world: World, bodies: TrialBodies, trial: int, query: Query,
    moving: bool,  # whether query.d is not zero: a caller that knows leaves out what moves
    best: float,
    masks: wp.array(dtype=wp.uint64),  # hand, table, self: bit = body still to be settled; cleared here
    R: wp.array(dtype=wp.mat33),  # (7,) scratch: link frames
    p: wp.array(dtype=wp.vec3),
    w: wp.array(dtype=wp.vec3),  # (FIELDS,) scratch: link twists and how they change
    v: wp.array(dtype=wp.vec3),
    obstacle: wp.array(dtype=int),  # (MAX_OBSTACLES,) scratch
):  # fmt: skip
    """FREE, BLOCKED by a pair or OPEN, after a look at the interval's middle; the masks keep the open bodies.

    A pair has to keep `target`: its margin, or with `aim` the smallest clearance so far less the tolerance. It blocks when
    it is nearer than that in the middle (with `aim` 2: nearer than its margin), and is settled when it is farther than
    `target` plus what it may travel.
    """
    out = Finding()
    out.status = FREE
    out.pair = PAIR_NONE
    out.body = -1
    out.best = best
    R_hand_world = bodies.R_hand_world[trial]
    p_hand_world = bodies.p_hand_world[trial]
    forward_kinematics(world, R_hand_world, p_hand_world, query.q, R, p)
    if moving:
        twists(query.d, R, p, w, v)
    hand = bodies.hand[trial]
    hand_center = world.hand_center[hand]
    hand_radius = world.hand_radius[hand]
    up = wp.vec3(R_hand_world[0, 2], R_hand_world[1, 2], R_hand_world[2, 2])  # world z in the hand frame
    table_p = R_hand_world * world.table_center + p_hand_world
    first_hull = world.hull_first[bodies.object[trial]]
    n_hulls = world.hull_first[bodies.object[trial] + 1] - first_hull
    # GJK may stop 5 % short of the distance where a shorter interval asks again. The distance is that of cores, from which
    # radii are taken off: of two fingers that keep 3 mm it may be a third
    gap = wp.where(query.aim == 1 or query.closely, 0.0, wp.where(moving, 0.05, 0.0))

    for link in range(LINKS):
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
            k = link_frame(link)
            c0 = R[k] * world.link_c0[link] + p[k]
            c1 = R[k] * world.link_c1[link] + p[k]
            if hand_on:
                target = _target(query, out.best, query.hand_margin, True)
                if link_clears_hand(
                    world, query, target, hand_center, hand_radius, link, c0, c1,
                    w[k], v[k], w[CHANGES + k], v[CHANGES + k], moving,
                ):  # fmt: skip
                    hand_on = False
                    masks[0] = masks[0] & ~bits
                elif query.aim == 0 and not moving:  # a person's ball holds much air: piece by piece
                    near = balls_within(
                        world.piece_center, world.piece_radius, hand * world.n_pieces, world.n_pieces,
                        c0, c1, world.link_radius[link], target,
                    )  # fmt: skip
                    if near == wp.uint64(0):
                        hand_on = False
                        masks[0] = masks[0] & ~bits
            target = _target(query, out.best, query.other_margin, False)
            if table_on:  # noqa: SIM102 (Warp's `and` evaluates both sides)
                if link_clears_table(world, query, target, link, c0, c1, up, table_p, moving):
                    table_on = False
                    masks[1] = masks[1] & ~bits
            if self_on:
                self_with = links_within(world, query, target, link, c0, c1, moving, R, p, w, v)
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
            body = moving_body(world, bodies, trial, link, b, query.d, moving, R, p, w, v)

            # obstacles of this body that bounding volumes cannot settle
            found = Near()
            if do_hand:
                target = _target(query, out.best, query.hand_margin, True)
                is_open = wp.where((hand_open & bit) != wp.uint64(0), 1, 0)
                found = pieces_near(
                    world, query, target, body, hand, hand_center, hand_radius, moving, is_open, obstacle
                )
                if found.open == 1:
                    hand_open = hand_open | bit
            n_hand = found.n
            target = _target(query, out.best, query.other_margin, False)
            if do_table:
                found = table_near(world, bodies, trial, query, target, body, up, table_p, moving, n_hand, obstacle)
                if found.open == 1:
                    table_open = table_open | bit
            n_table = found.n
            if do_self:
                is_open = wp.where((self_open & bit) != wp.uint64(0), 1, 0)
                found = bodies_near(
                    world, bodies, trial, query, target, body, self_with, moving, is_open, R, p, w, v, n_table, obstacle
                )
                if found.open == 1:
                    self_open = self_open | bit

            # the listed pairs, 0 .. n_hand pieces, .. n_table the table, .. found.n own bodies: GJK
            for i in range(found.n):
                may_meet = obstacle[i] >= MAY_MEET
                other = obstacle[i] & (MAY_MEET - 1)
                if moving and not may_meet:  # it cannot block, and its kind is open already
                    if i < n_hand and (hand_open & bit) != wp.uint64(0):
                        continue
                    if i >= n_table and (self_open & bit) != wp.uint64(0):
                        continue
                # the pair as its obstacle sees it: the moving body's pose in the obstacle's frame, what the pair may travel.
                # Values that differ between branches are no struct: Warp would write it to memory and read it back in each
                shape = Shape()
                center = wp.vec3(0.0, 0.0, 0.0)
                pair_R = body.R
                pair_p = body.p
                travel = body.travel
                second = body.second
                third = body.third
                kind = int(HAND)
                code = int(PAIR_HAND)
                kept = query.other_margin
                if i < n_hand:  # stands still in the hand's frame, which is the moving body's
                    piece = hand * world.n_pieces + other
                    center = world.piece_center[piece]
                    kept = query.hand_margin
                    shape.kind = BLOCKS
                    shape.start = world.piece_start[piece]
                    shape.count = world.piece_blocks[piece]
                    shape.radius = world.piece_round[piece]
                elif i < n_table:
                    kind = TABLE
                    code = PAIR_TABLE
                    shape.kind = BOX
                    shape.size = world.table_half
                    pair_R = wp.transpose(R_hand_world) * body.R
                    pair_p = wp.transpose(R_hand_world) * (body.p - table_p)
                else:
                    kind = SELF
                    code = PAIR_SELF
                    shape.kind = world.kind[other]
                    shape.size = world.size[other]
                    shape.radius = world.radius[other]
                    if shape.kind == BLOCKS:
                        shape.start = world.body_start[other]
                        shape.count = world.body_blocks[other]
                    Ro, po = body_pose(world, bodies, trial, R, p, other)
                    pair_R = wp.transpose(Ro) * body.R
                    pair_p = wp.transpose(Ro) * (body.p - po)
                    if moving:
                        travel, second, third = pair_motion(
                            world, bodies, trial, link, b, world.body_link[other], query.d
                        )
                if link == OBJECT:
                    code = code + PAIR_OF_OBJECT
                seeks = _seeks_smallest(query, i < n_hand)
                margin = _target(query, out.best, kept, i < n_hand)
                needed = margin + travel
                if seeks:
                    needed = wp.max(needed, out.best)  # a clearance that becomes the best must have converged
                dist = gjk(
                    body.shape, pair_R, pair_p, world.points, shape, points_of(world, shape), center, needed, gap
                )
                if seeks and (query.aim == 1 or dist.lower >= kept):
                    if dist.lower < out.best:
                        # a core that is met has no clearance, only an overlap that GJK does not measure
                        out.best = wp.max(dist.lower, MEETING_M)
                        if dist.upper <= 0.0 and dist.lower > MEETING_M:
                            out.best = MEETING_M
                        out.pair = code
                        out.body = b
                    margin = out.best - query.tolerance
                elif dist.upper <= margin or (gap == 0.0 and dist.lower < margin):
                    out.status = BLOCKED
                    out.pair = code
                    out.body = b
                    return out
                if not settle_pair(
                    world, bodies, trial, body, kind, other, shape, dist.lower, dist.upper, dist.v,
                    margin, travel, second, third, moving, R, p, w, v,
                ):  # fmt: skip
                    if kind == HAND:
                        hand_open = hand_open | bit
                    elif kind == TABLE:
                        table_open = table_open | bit
                    else:
                        self_open = self_open | bit
        # bits stay set where this link left something open
        if (hand_open | table_open | self_open) != wp.uint64(0):
            out.status = OPEN
        masks[0] = masks[0] & (~bits | hand_open)
        masks[1] = masks[1] & (~bits | table_open)
        masks[2] = masks[2] & (~bits | self_open)
    return out
