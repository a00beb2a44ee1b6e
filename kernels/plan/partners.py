"""Who may touch a body over a stretch of motion: what bounding volumes cannot settle.

Each question is asked three times, cheaper bounds first: as the levers allow (`motion`), as the bodies really go to first
order (swept supports), and, if neither is enough, GJK will be asked - unless the stretch must be halved anyway.

The inequalities are those of edge.py with bounding volumes in place of the bodies: with D the distance of two volumes in
the middle of the stretch and L what the pair may travel, D - L >= target settles it, and so does the swept volume along
the direction between them. If even the swept volume falls short by more than bounding volumes understate a distance
(SLACK_M), GJK could not settle the stretch either: it is left open for its halves, without GJK.
"""

import warp as wp

from r2h_batch.kernels.geometry.balls import balls_near, lowest_bit
from r2h_batch.kernels.geometry.body import ROUNDING_M, Body, from_ball, support, swept_support
from r2h_batch.kernels.geometry.segments import from_point, from_segment, swept_capsule
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.world import (
    CHANGES,
    GRIPPER,
    OBJECT,
    TrialBodies,
    World,
    acceleration_along,
    acceleration_seen_along,
    bends,
    body_pose,
    link_frame,
    motion,
    vec6,
)

wp.set_module_options(OPTIONS)

MAY_MEET = wp.constant(256)  # added to a partner that bounding volumes do not keep apart in the middle of the stretch
SLACK_M = wp.constant(0.03)
HAND_SLACK_M = wp.constant(0.06)
"""Bounding volumes rarely understate a distance by more: a pair that would need it stays open without asking GJK."""


@wp.struct
class Query:
    """A posture q, and the stretch q +- d that it stands for; what each kind of pair has to keep."""

    q: vec6
    d: vec6  # half the stretch, rad (zero: the posture alone)
    hand_margin: float
    other_margin: float
    track: int  # 1: look for the smallest clearance below `best` instead of a yes or no; 2: that of the hand, and both
    tolerance: float  # of that smallest clearance


@wp.struct
class Mover:
    """A body of the robot or a hull of the object, in the hand's frame: pose, bounding capsule, twist, what it may travel."""

    link: int
    body: int
    shape: Body
    R: wp.mat33
    p: wp.vec3
    c0: wp.vec3
    c1: wp.vec3
    radius: float
    travel: float
    second: float  # bounds on its points' second and third derivative along the stretch
    third: float
    w: wp.vec3
    v: wp.vec3
    a: wp.vec3
    b: wp.vec3


@wp.struct
class Near:
    """How many partners are listed so far, and whether the stretch has to be halved for this kind of pair."""

    n: int
    open: int


@wp.func
def least_rest(second: float, third: float):
    """What a swept bound takes off at least: with less between two bodies they are not settled along any plane."""
    return wp.min(0.5 * second, third / 6.0)


@wp.func
def swept_mover(world: World, mover: Mover, n: wp.vec3, second: float, third: float):
    """`swept_support` of a body for a partner that stands still in the hand's frame."""
    g, c = acceleration_along(n, mover.w, mover.a, mover.b)
    return swept_support(mover.shape, mover.R, mover.p, world.points, n, mover.w, mover.v, g, c, second, third)


@wp.func
def _swept_capsule_of(query: Query, mover: Mover, n: wp.vec3):
    """The same of its bounding capsule."""
    g, c = acceleration_along(n, mover.w, mover.a, mover.b)
    return swept_capsule(mover.c0, mover.c1, mover.radius, n, mover.w, mover.v, g, c, mover.second, mover.third)


@wp.func
def link_clears_hand(
    world: World, query: Query, target: float, center: wp.vec3, radius: float, link: int,
    c0: wp.vec3, c1: wp.vec3, w: wp.vec3, v: wp.vec3, a: wp.vec3, b: wp.vec3, moving: bool,
):  # fmt: skip
    """Whether a whole link keeps `target` to the ball around the whole hand."""
    rk = world.link_radius[link]
    toward = from_point(center, c0, c1)
    far = wp.length(toward)
    travel = float(0.0)
    if moving:
        travel = motion(world.link_lever, link, 0, query.d)
    clear = far - radius - rk - travel >= target
    if moving and not clear and far - radius - rk > target:
        second, third = bends(world.link_lever, link, 0, query.d)
        if far - radius - rk - least_rest(second, third) >= target:
            n_hat = toward / far
            g, c = acceleration_along(n_hat, w, a, b)
            low = swept_capsule(c0, c1, rk, n_hat, w, v, g, c, second, third)
            clear = low - wp.dot(n_hat, center) - radius >= target
    return clear


@wp.func
def link_clears_table(
    world: World, query: Query, target: float, link: int, c0: wp.vec3, c1: wp.vec3, up: wp.vec3, table_p: wp.vec3,
    moving: bool,
):  # fmt: skip
    """Whether a whole link keeps `target` above the table's top."""
    low = wp.min(wp.dot(up, c0 - table_p), wp.dot(up, c1 - table_p)) - world.table_half[2]
    travel = float(0.0)
    if moving:
        travel = motion(world.link_lever, link, 1, query.d)
    return low - world.link_radius[link] >= target + travel


@wp.func
def links_in_reach(
    world: World, query: Query, target: float, link: int, c0: wp.vec3, c1: wp.vec3, moving: bool,
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Bits of the links that this link is not clear of as a whole."""
    rk = world.link_radius[link]
    found = int(0)
    for other in range(link):
        if (world.self_links[link] >> other) & 1 == 1:
            o0 = R[other] * world.link_c0[other] + p[other]
            o1 = R[other] * world.link_c1[other] + p[other]
            toward = from_segment(o0, o1, c0, c1)
            far = wp.length(toward)
            reach = far - rk - world.link_radius[other]
            travel = float(0.0)
            if moving:
                travel = motion(world.link_lever, link, other, query.d)
            clear = reach - travel >= target
            if moving and not clear and reach > target:
                second, third = bends(world.link_lever, link, other, query.d)
                if reach - least_rest(second, third) >= target:
                    n_hat = toward / far
                    k = link_frame(link)
                    g, c = acceleration_seen_along(n_hat, w[k], v[k], w[CHANGES + k], v[CHANGES + k], other, w, v)
                    wr = w[k] - w[other]
                    vr = v[k] - v[other]
                    low = swept_capsule(c0, c1, rk, n_hat, wr, vr, g, c, second, third)
                    high = wp.max(wp.dot(n_hat, o0), wp.dot(n_hat, o1)) + world.link_radius[other]
                    clear = low - high >= target
            if not clear:
                found = found | (1 << other)
    return found


@wp.func
def hand_near(query: Query, target: float, mover: Mover, center: wp.vec3, radius: float, moving: bool):
    """Whether a body may come nearer than `target` to the ball around the whole hand; whether the stretch has to be halved."""
    toward = from_point(center, mover.c0, mover.c1)
    far = wp.length(toward)
    near = far - radius - mover.radius < target + mover.travel
    halved = bool(False)
    if near and moving and far - radius - mover.radius > target + query.tolerance:
        n_hat = toward / far
        low = far - radius - mover.radius - least_rest(mover.second, mover.third)
        if low + HAND_SLACK_M >= target:
            low = _swept_capsule_of(query, mover, n_hat)
            low = low - wp.dot(n_hat, center) - radius
        if low >= target:
            near = False
        elif low + HAND_SLACK_M < target:
            near = False
            halved = True
    return near, halved


# The ball around the whole hand, then each piece, by three bounds of what is left between the two along the stretch:
#
# 1. as the levers allow: apart - travel >= target settles the pair;
# 2. `least_rest`: what any swept bound takes off. Even without more it falls short of the target by more than bounding
#    volumes understate a distance: the stretch has to be halved, and neither the sweep nor GJK is worth asking;
# 3. the swept bound along the way to the ball's centre: enough settles the pair; short by more than that slack: halved.
#
# What is left is listed for GJK. A pair that its volumes do not keep apart in the middle is listed with MAY_MEET whatever the
# rest says, for it alone can block.
@wp.func
def pieces_near(
    world: World, query: Query, target: float, mover: Mover, hand: int, center: wp.vec3, radius: float, moving: bool,
    is_open: int, partner: wp.array(dtype=int),
):  # fmt: skip
    """Lists the hand's pieces that may come nearer than `target`."""
    out = Near()
    out.open = is_open
    near, halved = hand_near(query, target, mover, center, radius, moving)
    if halved:
        out.open = 1
    rest = least_rest(mover.second, mover.third)
    if near:
        # piece by piece: its ball against the mover's capsule, then against its very shape (primitives)
        first = hand * world.n_pieces
        left = balls_near(
            world.piece_center, world.piece_radius, first, world.n_pieces,
            mover.c0, mover.c1, mover.radius, mover.travel, mover.w, mover.v, mover.a, mover.b, mover.second, mover.third,
            int(moving), target, query.tolerance,
        )  # fmt: skip
        while left != wp.uint64(0):
            i = lowest_bit(left)
            left = left & (left - wp.uint64(1))
            piece = first + i
            at = world.piece_center[piece]
            toward = wp.vec3(0.0, 0.0, 0.0)
            if mover.link == OBJECT:
                toward = from_point(at, mover.c0, mover.c1)
            else:
                toward = mover.R * from_ball(mover.shape, wp.transpose(mover.R) * (at - mover.p))
            far = wp.length(toward)
            apart = far - world.piece_radius[piece]
            if mover.link == OBJECT:
                apart = apart - mover.radius
            if apart >= target + mover.travel:
                continue
            if moving and apart > target + query.tolerance:
                if out.open == 1:
                    continue  # the stretch has to be halved anyway
                if apart - rest + SLACK_M < target:
                    out.open = 1
                    continue
                n_hat = toward / far
                low = -wp.dot(n_hat, at) - world.piece_radius[piece]
                if mover.link == OBJECT:
                    low = low + _swept_capsule_of(query, mover, n_hat)
                else:
                    low = low + swept_mover(world, mover, n_hat, mover.second, mover.third)
                if low >= target:
                    continue
                if low + SLACK_M < target:
                    out.open = 1
                    continue
            partner[out.n] = wp.where(apart > target + query.tolerance, i, i + MAY_MEET)
            out.n += 1
    return out


@wp.func
def table_near(
    world: World, bodies: TrialBodies, trial: int, query: Query, target: float, mover: Mover, up: wp.vec3,
    table_p: wp.vec3, moving: bool, n: int, partner: wp.array(dtype=int),
):  # fmt: skip
    """Lists the table if the body may come nearer than `target` to the height of its top.

    Joint 1 cannot change that height, whatever the distance to the table's edge does.
    """
    out = Near()
    out.n = n
    top = wp.dot(up, table_p) + world.table_half[2]
    lowest = mover.R * support(mover.shape, world.points, -(wp.transpose(mover.R) * up)) + mover.p
    height = wp.dot(up, lowest) - mover.shape.radius - top - ROUNDING_M
    low = height
    if moving:
        if mover.link == OBJECT:
            low = height - motion(bodies.object_lever, trial, 1, query.d)
            if low < target:
                second, third = bends(bodies.object_lever, trial, 1, query.d)
                g, c = acceleration_along(up, mover.w, mover.a, mover.b)
                swept = swept_capsule(mover.c0, mover.c1, mover.radius, up, mover.w, mover.v, g, c, second, third)
                low = wp.max(low, swept - top)
                if low < target and height > target:  # its capsule reaches lower than the hull does
                    low = wp.max(low, swept_mover(world, mover, up, second, third) - top)
        else:
            low = height - motion(world.lever, mover.body, 1, query.d)
            if low < target:
                second, third = bends(world.lever, mover.body, 1, query.d)
                swept = swept_mover(world, mover, up, second, third)
                low = wp.max(low, swept - top)
    if low < target:
        if height > target + query.tolerance:
            out.open = 1  # a shorter stretch will tell
        else:
            partner[out.n] = MAY_MEET
            out.n += 1
    return out


# For each other link that this one may meet: the link as a whole first, then its bodies, capsule against capsule, with the
# three bounds of `pieces_near`. Motion counts as the other link sees it: only the joints between the two turn them against
# each other, so the levers are summed from there on, and twist and acceleration are differences (world.py).
#
# 1. the whole link's capsule: settled as the levers allow, or along the way between the capsules;
# 2. each of its bodies: settled in the same two ways, or left for the stretch's halves (`open`) without asking further;
# 3. what is left is listed for GJK, with MAY_MEET where the capsules touch in the middle.
#
# The object is a mover as the gripper's bodies are, with levers of its own in each trial.
@wp.func
def bodies_near(
    world: World, bodies: TrialBodies, trial: int, query: Query, target: float, mover: Mover, links: int, moving: bool,
    is_open: int, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
    n: int, partner: wp.array(dtype=int),
):  # fmt: skip
    """Lists the robot's own bodies, of the links in `links`, that may come nearer than `target`."""
    out = Near()
    out.n = n
    out.open = is_open
    for other in range(wp.min(mover.link, GRIPPER)):
        if (links >> other) & 1 == 1:
            travel = float(0.0)
            second = float(0.0)
            third = float(0.0)
            if moving and mover.link == OBJECT:
                travel = motion(bodies.object_lever, trial, other, query.d)
                second, third = bends(bodies.object_lever, trial, other, query.d)
            elif moving:
                travel = motion(world.lever, mover.body, other, query.d)
                second, third = bends(world.lever, mover.body, other, query.d)
            # motion relative to the other link: only the joints between the two turn them against each other
            wr = mover.w - w[other]
            vr = mover.v - v[other]
            # the other link as a whole first
            o0 = R[other] * world.link_c0[other] + p[other]
            o1 = R[other] * world.link_c1[other] + p[other]
            ro = world.link_radius[other]
            toward = from_segment(o0, o1, mover.c0, mover.c1)
            far = wp.length(toward)
            if far - mover.radius - ro >= target + travel:
                continue
            rest = least_rest(second, third)
            if moving and far - mover.radius - ro - rest >= target + query.tolerance:
                n_hat = toward / far
                g, c = acceleration_seen_along(n_hat, mover.w, mover.v, mover.a, mover.b, other, w, v)
                low = swept_capsule(mover.c0, mover.c1, mover.radius, n_hat, wr, vr, g, c, second, third)
                if low - wp.max(wp.dot(n_hat, o0), wp.dot(n_hat, o1)) - ro >= target:
                    continue
            # then its bodies one by one, capsule against capsule
            for o in range(world.link_first[other], world.link_first[other + 1]):
                Ro, po = body_pose(world, bodies, trial, R, p, o)
                axis = Ro * world.cap_axis[o]
                toward = from_segment(po - axis, po + axis, mover.c0, mover.c1)
                far = wp.length(toward)
                apart = far - mover.radius - world.cap_radius[o]
                if apart >= target + travel:
                    continue
                if moving and apart > target + query.tolerance:
                    if out.open == 1:
                        continue
                    if apart - rest + SLACK_M < target:
                        out.open = 1
                        continue
                    n_hat = toward / far
                    g, c = acceleration_seen_along(n_hat, mover.w, mover.v, mover.a, mover.b, other, w, v)
                    low = swept_capsule(mover.c0, mover.c1, mover.radius, n_hat, wr, vr, g, c, second, third)
                    low = low - wp.max(wp.dot(n_hat, po - axis), wp.dot(n_hat, po + axis)) - world.cap_radius[o]
                    if low >= target:
                        continue
                    if low + SLACK_M < target:
                        out.open = 1
                        continue
                partner[out.n] = wp.where(apart > target + query.tolerance, o, o + MAY_MEET)
                out.n += 1
    return out
