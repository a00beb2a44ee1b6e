"""Which bodies of which links, and which of their obstacles, bounding volumes cannot settle: plan/check.py's steps 1 and 2.

One thread for a link of an interval, then one for a body and one kind of pair: each asks one kind of question, so that the lanes
of a warp run through the same code, and kernels stay small. The questions themselves are those of plan/obstacles.py.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import HAND, MAX_OBSTACLES, SELF, TABLE

from ..plan.obstacles import (
    MAY_MEET,
    Query,
    bodies_near,
    hand_near,
    link_clears_hand,
    link_clears_table,
    links_within,
    moving_body,
    pair_motion,
    pieces_near,
    table_near,
)
from ..robot.joints import CHANGES, LINKS, OBJECT
from ..robot.posture import load
from ..robot.world import TrialBodies, World, body_pose, link_frame
from .queues import (
    BODIES,
    KINDS,
    NOW,
    PAIRS,
    PIECES,
    BodyQueue,
    Counts,
    Edges,
    Frames,
    Intervals,
    Pairs,
    bit_of,
    is_done,
    link_of,
    pair_of,
    take,
    target_of,
    value_of,
)

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.func
def moving_body_of(world: World, bodies: TrialBodies, frames: Frames, s: int, trial: int, b: int):
    """Body b of an interval, or hull b - n_robot of its trial's object."""
    d = load(frames.d, s)
    return moving_body(
        world, bodies, trial, link_of(world, b), b, d, True, frames.R[s], frames.p[s], frames.w[s], frames.v[s]
    )


@wp.func
def query_of(edges: Edges, frames: Frames, s: int, edge: int, aim: int, tolerance: float):
    """The `Query` of an interval (obstacles.py)."""
    query = Query()
    query.d = load(frames.d, s)
    query.hand_margin = edges.hand_margin[edge]
    query.aim = aim
    query.tolerance = tolerance
    return query


@wp.func
def queue_body(queue: BodyQueue, counts: Counts, kind: int, s: int, b: int, links: int):
    """Queues a body for one kind of pair."""
    capacity = queue.interval.shape[0] / KINDS
    row = take(counts, BODIES + kind, capacity)
    if row >= 0:
        queue.interval[kind * capacity + row] = s
        queue.body[kind * capacity + row] = b
        queue.links[kind * capacity + row] = links


# For each of nine links of each interval, what plan/check.py asks of a link as a whole:
#
# 1. `look`: its bodies that an interval before left open. None of any kind: nothing to do;
# 2. its capsule against the ball about the hand, the table's top, the capsules of links that it may meet, as far as the
#    motion radii allow and along the interval. A link that is clear settles all its bodies; `with_links` keeps the links
#    that it may meet;
# 3. its bodies are queued for each kind of pair that is left. The object has no capsule as a whole: all its hulls are.
#
# An interval whose owner is done is skipped: something blocks it already, or bodies meet on it.
@wp.kernel
def clear_links(
    first: int, lanes: int, parity: int, aim: int, tolerance: float, world: World, bodies: TrialBodies,
    edges: Edges, queue: Intervals, frames: Frames, body_queue: BodyQueue, counts: Counts,
):  # fmt: skip
    """Each link as a whole against hand, table and other links; queues the bodies of links that are not clear."""
    if first + wp.tid() == 0:
        counts.n[NOW + 1 - parity] = 0
    n = wp.min(counts.n[NOW + parity], queue.edge.shape[0])
    for i in range(first + wp.tid(), LINKS * n, lanes):  # link by link: lanes that lie side by side do the same
        s = i % n
        link = i / n
        edge = queue.edge[s]
        key = edges.found[edges.owner[edge]]
        if is_done(aim, key):
            continue
        trial = edges.trial[edge]
        lo = int(world.n_robot)
        hi = int(world.n_robot + world.hull_first[bodies.object[trial] + 1] - world.hull_first[bodies.object[trial]])
        bits = wp.int64(1) << wp.int64(world.n_robot)
        if link < OBJECT:
            lo = world.link_first[link]
            hi = world.link_first[link + 1]
            bits = ((wp.int64(1) << wp.int64(hi)) - wp.int64(1)) & ~((wp.int64(1) << wp.int64(lo)) - wp.int64(1))
        on_hand = (queue.look[s, HAND] & bits) != wp.int64(0)
        on_table = (queue.look[s, TABLE] & bits) != wp.int64(0)
        on_self = (queue.look[s, SELF] & bits) != wp.int64(0)
        if not (on_hand or on_table or on_self):
            continue
        query = query_of(edges, frames, s, edge, aim, tolerance)
        hand_target = target_of(aim, tolerance, key, query.hand_margin)
        target = target_of(aim, tolerance, key, query.other_margin)
        with_links = world.self_links[link]
        if link < OBJECT:
            moving = wp.dot(query.d, query.d) > 0.0
            hand = bodies.hand[trial]
            R_hand_world = bodies.R_hand_world[trial]
            up = wp.vec3(R_hand_world[0, 2], R_hand_world[1, 2], R_hand_world[2, 2])
            table_p = R_hand_world * world.table_center + bodies.p_hand_world[trial]
            k = link_frame(link)
            c0 = frames.R[s, k] * world.link_c0[link] + frames.p[s, k]
            c1 = frames.R[s, k] * world.link_c1[link] + frames.p[s, k]
            if on_hand:
                on_hand = not link_clears_hand(
                    world, query, hand_target, world.hand_center[hand], world.hand_radius[hand], link, c0, c1,
                    frames.w[s, k], frames.v[s, k], frames.w[s, CHANGES + k], frames.v[s, CHANGES + k], moving,
                )  # fmt: skip
            if on_table:
                on_table = not link_clears_table(world, query, target, link, c0, c1, up, table_p, moving)
            if on_self:
                with_links = links_within(
                    world, query, target, link, c0, c1, moving, frames.R[s], frames.p[s], frames.w[s], frames.v[s]
                )
                on_self = with_links != 0
        for b in range(lo, hi):
            bit = bit_of(world, b)
            if on_hand and (queue.look[s, HAND] & bit) != wp.int64(0):
                queue_body(body_queue, counts, HAND, s, b, 0)
            if on_table and (queue.look[s, TABLE] & bit) != wp.int64(0):
                queue_body(body_queue, counts, TABLE, s, b, 0)
            if on_self and (queue.look[s, SELF] & bit) != wp.int64(0):
                queue_body(body_queue, counts, SELF, s, b, with_links)


@wp.func
def put_pair(pairs: Pairs, counts: Counts, s: int, b: int, other: int, R: wp.mat33, p: wp.vec3, needed: float):
    """Queues a pair for GJK."""
    row = take(counts, PAIRS, pairs.interval.shape[0])
    if row >= 0:
        pairs.interval[row] = s
        pairs.body[row] = b
        pairs.other[row] = other
        pairs.R[row] = R
        pairs.p[row] = p
        pairs.needed[row] = needed


@wp.func
def needed_of(aim: int, key: wp.int64, target: float, travel: float):
    """How much GJK has to prove: a clearance that becomes the smallest must have converged."""
    return wp.where(aim == 1, wp.max(target + travel, value_of(key)), target + travel)


@wp.func
def stays_open(frames: Frames, s: int, kind: int, bit: wp.int64):
    """Notes that the interval has to be halved for this body."""
    wp.atomic_or(frames.open, s, kind, bit)


@wp.kernel
def near_hand(
    first: int, lanes: int, aim: int, tolerance: float, world: World, bodies: TrialBodies, edges: Edges,
    queue: Intervals, frames: Frames, body_queue: BodyQueue, counts: Counts,
):  # fmt: skip
    """Whether each queued body may come near to the ball around the whole hand; queues it for the pieces, if so."""
    capacity = body_queue.interval.shape[0] / KINDS
    for i in range(first + wp.tid(), wp.min(counts.n[BODIES + HAND], capacity), lanes):
        s = body_queue.interval[i]
        b = body_queue.body[i]
        edge = queue.edge[s]
        trial = edges.trial[edge]
        key = edges.found[edges.owner[edge]]
        body = moving_body_of(world, bodies, frames, s, trial, b)
        query = query_of(edges, frames, s, edge, aim, tolerance)
        moving = wp.dot(query.d, query.d) > 0.0
        target = target_of(aim, tolerance, key, query.hand_margin)
        hand = bodies.hand[trial]
        near, halved = hand_near(query, target, body, world.hand_center[hand], world.hand_radius[hand], moving)
        if halved:
            stays_open(frames, s, HAND, bit_of(world, b))
        if near:
            queue_body(body_queue, counts, PIECES, s, b, 0)


@wp.kernel
def near_pieces(
    first: int, lanes: int, aim: int, tolerance: float, world: World, bodies: TrialBodies, edges: Edges,
    queue: Intervals, frames: Frames, body_queue: BodyQueue, pairs: Pairs, counts: Counts,
):  # fmt: skip
    """Pieces of the hand that each body near to the hand may come near to."""
    obstacle = wp.zeros(shape=MAX_OBSTACLES, dtype=int)
    capacity = body_queue.interval.shape[0] / KINDS
    for i in range(first + wp.tid(), wp.min(counts.n[BODIES + PIECES], capacity), lanes):
        s = body_queue.interval[PIECES * capacity + i]
        b = body_queue.body[PIECES * capacity + i]
        edge = queue.edge[s]
        trial = edges.trial[edge]
        key = edges.found[edges.owner[edge]]
        body = moving_body_of(world, bodies, frames, s, trial, b)
        query = query_of(edges, frames, s, edge, aim, tolerance)
        moving = wp.dot(query.d, query.d) > 0.0
        target = target_of(aim, tolerance, key, query.hand_margin)
        hand = bodies.hand[trial]
        found = pieces_near(
            world, query, target, body, hand, world.hand_center[hand], world.hand_radius[hand], moving, 0, obstacle
        )
        if found.open == 1:
            stays_open(frames, s, HAND, bit_of(world, b))
        for m in range(found.n):
            # a pair that cannot block needs no GJK where the interval has to be halved anyway
            if not (moving and found.open == 1 and obstacle[m] < MAY_MEET):
                other = obstacle[m] & (MAY_MEET - 1)
                needed = needed_of(aim, key, target, body.travel)
                put_pair(pairs, counts, s, b, pair_of(HAND, other), body.R, body.p, needed)


@wp.kernel
def near_table(
    first: int, lanes: int, aim: int, tolerance: float, world: World, bodies: TrialBodies, edges: Edges,
    queue: Intervals, frames: Frames, body_queue: BodyQueue, pairs: Pairs, counts: Counts,
):  # fmt: skip
    """Whether each queued body may come near to the table."""
    obstacle = wp.zeros(shape=MAX_OBSTACLES, dtype=int)
    capacity = body_queue.interval.shape[0] / KINDS
    for i in range(first + wp.tid(), wp.min(counts.n[BODIES + TABLE], capacity), lanes):
        s = body_queue.interval[TABLE * capacity + i]
        b = body_queue.body[TABLE * capacity + i]
        edge = queue.edge[s]
        trial = edges.trial[edge]
        key = edges.found[edges.owner[edge]]
        body = moving_body_of(world, bodies, frames, s, trial, b)
        query = query_of(edges, frames, s, edge, aim, tolerance)
        moving = wp.dot(query.d, query.d) > 0.0
        target = target_of(aim, tolerance, key, query.other_margin)
        R_hand_world = bodies.R_hand_world[trial]
        up = wp.vec3(R_hand_world[0, 2], R_hand_world[1, 2], R_hand_world[2, 2])
        table_p = R_hand_world * world.table_center + bodies.p_hand_world[trial]
        found = table_near(world, bodies, trial, query, target, body, up, table_p, moving, 0, obstacle)
        if found.open == 1:
            stays_open(frames, s, TABLE, bit_of(world, b))
        if found.n > 0:
            Rt = wp.transpose(R_hand_world)
            needed = needed_of(aim, key, target, body.travel)
            put_pair(pairs, counts, s, b, pair_of(TABLE, 0), Rt * body.R, Rt * (body.p - table_p), needed)


@wp.kernel
def near_bodies(
    first: int, lanes: int, aim: int, tolerance: float, world: World, bodies: TrialBodies, edges: Edges,
    queue: Intervals, frames: Frames, body_queue: BodyQueue, pairs: Pairs, counts: Counts,
):  # fmt: skip
    """The robot's own bodies that each queued body may come near to."""
    obstacle = wp.zeros(shape=MAX_OBSTACLES, dtype=int)
    capacity = body_queue.interval.shape[0] / KINDS
    for i in range(first + wp.tid(), wp.min(counts.n[BODIES + SELF], capacity), lanes):
        s = body_queue.interval[SELF * capacity + i]
        b = body_queue.body[SELF * capacity + i]
        edge = queue.edge[s]
        trial = edges.trial[edge]
        key = edges.found[edges.owner[edge]]
        body = moving_body_of(world, bodies, frames, s, trial, b)
        query = query_of(edges, frames, s, edge, aim, tolerance)
        moving = wp.dot(query.d, query.d) > 0.0
        target = target_of(aim, tolerance, key, query.other_margin)
        found = bodies_near(
            world, bodies, trial, query, target, body, body_queue.links[SELF * capacity + i], moving, 0,
            frames.R[s], frames.p[s], frames.w[s], frames.v[s], 0, obstacle,
        )  # fmt: skip
        if found.open == 1:
            stays_open(frames, s, SELF, bit_of(world, b))
        for m in range(found.n):
            if not (moving and found.open == 1 and obstacle[m] < MAY_MEET):
                other = obstacle[m] & (MAY_MEET - 1)
                Ro, po = body_pose(world, bodies, trial, frames.R[s], frames.p[s], other)
                Rt = wp.transpose(Ro)
                k = world.body_link[other]
                travel, _second, _third = pair_motion(world, bodies, trial, body.link, b, k, query.d)
                needed = needed_of(aim, key, target, travel)
                put_pair(pairs, counts, s, b, pair_of(SELF, other), Rt * body.R, Rt * (body.p - po), needed)
