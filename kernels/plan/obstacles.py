"""Obstacles that a body may meet over an interval of motion, as far as bounding volumes can tell; and `settle_pair`, after GJK.

Each pair goes through up to three bounds, the cheapest first: how far the joints let the body move (`motion`); how the body
moves along one direction (swept supports); GJK. An interval that must be halved anyway skips GJK.

The inequalities are those of edge.py, with bounding volumes in place of the bodies. With D the distance of two volumes in the
middle of the interval and L what the pair may travel, D - L >= target settles the pair. So does the swept volume along the
direction between them. If the swept volume falls short by more than bounding volumes understate a distance (SLACK_M), GJK could
not settle the interval either: it stays open for its halves, without GJK.
"""

import warp as wp

from r2h_batch.kernels.geometry.balls import balls_near, lowest_bit
from r2h_batch.kernels.geometry.closest import from_point, from_segment, swept_capsule
from r2h_batch.kernels.geometry.shape import ROUNDING_M, Shape, from_ball, support, swept_support
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import SELF, TABLE

from ..robot.joints import CHANGES, GRIPPER, OBJECT, vecq
from ..robot.world import (
    TrialBodies,
    World,
    acceleration_along,
    bends,
    body_pose,
    link_frame,
    motion,
    object_shape,
    points_of,
    relative_acceleration,
    robot_shape,
)

wp.set_module_options(OPTIONS)

MAY_MEET = wp.constant(256)
"""Added to an obstacle that bounding volumes do not keep apart in the middle of the interval."""
SLACK_M = wp.constant(0.03)
HAND_SLACK_M = wp.constant(0.06)
"""Bounding volumes rarely understate a distance by more: a pair that would need it stays open without asking GJK."""


@wp.struct
class Query:
    """A posture q, and the interval q +- d that it stands for; what each kind of pair has to keep."""

    q: vecq
    d: vecq  # half the interval, rad (zero: the posture alone)
    hand_margin: float
    other_margin: float
    aim: int  # 1: look for the smallest clearance below `best` instead of a yes or no; 2: that of the hand, and both
    tolerance: float  # of that smallest clearance
    closely: bool  # whether distances are asked as near as they go over an interval too


@wp.struct
class MovingBody:
    """A body of the robot or a hull of the object, in the hand's frame: pose, bounding capsule, twist, what it may travel."""

    link: int
    index: int
    shape: Shape
    R: wp.mat33
    p: wp.vec3
    c0: wp.vec3
    c1: wp.vec3
    radius: float
    travel: float
    second: float  # bounds on its points' second and third derivative along the interval
    third: float
    w: wp.vec3
    v: wp.vec3
    a: wp.vec3
    b: wp.vec3


@wp.struct
class Near:
    """How many obstacles are listed so far, and whether the interval has to be halved for this kind of pair."""

    n: int
    open: int


@wp.func
def least_rest(second: float, third: float):
    """Smallest amount by which a swept bound lowers a distance: with less between two bodies they are not settled along
    any plane."""
    return wp.min(0.5 * second, third / 6.0)


@wp.func
def pair_motion(world: World, bodies: TrialBodies, trial: int, link: int, b: int, first_joint: int, d: vecq):
    """How far body b may travel (`motion`) and its bounds on the derivatives (`bends`), joints from `first_joint` on.

    An obstacle on link k sees the joints from k on; one that stands still in the hand's frame sees all of them.
    """
    travel = float(0.0)
    second = float(0.0)
    third = float(0.0)
    if link == OBJECT:
        travel = motion(bodies.object_motion_radius, trial, first_joint, d)
        second, third = bends(bodies.object_motion_radius, trial, first_joint, d)
    else:
        travel = motion(world.motion_radius, b, first_joint, d)
        second, third = bends(world.motion_radius, b, first_joint, d)
    return travel, second, third


@wp.func
def moving_body(
    world: World, bodies: TrialBodies, trial: int, link: int, b: int, d: vecq, moving: bool,
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Body b of a link, or hull b - n_robot of the trial's object, over the interval +- d. R, p, w, v: as `twists` has them."""
    out = MovingBody()
    out.link = link
    out.index = b
    Rb, pb = body_pose(world, bodies, trial, R, p, b)
    out.R = Rb
    out.p = pb
    out.w = w[link_frame(link)]
    out.v = v[link_frame(link)]
    out.a = w[CHANGES + link_frame(link)]
    out.b = v[CHANGES + link_frame(link)]
    out.shape = robot_shape(world, wp.min(b, world.n_robot - 1))
    if link == OBJECT:
        hull = world.hull_first[bodies.object[trial]] + b - world.n_robot
        out.shape = object_shape(world, hull)
        out.c0 = Rb * world.hull_c0[hull] + pb
        out.c1 = Rb * world.hull_c1[hull] + pb
        out.radius = world.hull_radius[hull]
    else:
        axis = Rb * world.cap_axis[b]
        out.c0 = pb - axis
        out.c1 = pb + axis
        out.radius = world.cap_radius[b]
    if moving:
        travel, second, third = pair_motion(world, bodies, trial, link, b, 0, d)
        out.travel = travel
        out.second = second
        out.third = third
    return out


# With D the lower bound in the middle, L = `travel` and the margin m:
#
# 1. D - L >= m: settled;
# 2. D - `least_rest` < m, or the bodies meet: no plane can settle the pair;
# 3. else the plane between the nearest points, which GJK found. n points from the obstacle to the body, in the hand's frame
#    for a piece, turned with the world for the table and with its link for a body. On the whole interval the moving body has
#    n . x >= `swept_support` and the obstacle n . x <= `farthest`, so the pair keeps the difference.
@wp.func
def settle_pair(
    world: World, bodies: TrialBodies, trial: int, body: MovingBody, kind: int, other: int, shape: Shape,
    lower: float, upper: float, direction: wp.vec3, margin: float, travel: float, second: float, third: float, moving: bool,
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Whether a pair keeps `margin` (m) over the whole interval, after GJK in its middle.

    kind, other, shape: the obstacle (HAND, TABLE or SELF; the body's number for SELF). lower, upper, direction: GJK's bounds
    on the distance and the vector between the nearest points, in the obstacle's frame. travel, second, third: `pair_motion`.
    """
    apart = lower
    if moving and apart < margin + travel and apart > margin + least_rest(second, third) and upper > 0.0:
        n_hat = direction / wp.length(direction)
        farthest = wp.dot(n_hat, support(shape, points_of(world, shape), n_hat)) + shape.radius
        wr = body.w
        vr = body.v
        n = n_hat
        g = wp.vec3(0.0, 0.0, 0.0)
        c = float(0.0)
        if kind == SELF:
            k = world.body_link[other]
            Ro, po = body_pose(world, bodies, trial, R, p, other)
            n = Ro * n_hat
            farthest += wp.dot(n, po)
            wr = body.w - w[k]
            vr = body.v - v[k]
            g, c = relative_acceleration(n, body.w, body.v, body.a, body.b, k, w, v)
        else:
            if kind == TABLE:
                R_hand_world = bodies.R_hand_world[trial]
                n = R_hand_world * n_hat
                farthest += wp.dot(n, R_hand_world * world.table_center + bodies.p_hand_world[trial])
            g, c = acceleration_along(n, body.w, body.a, body.b)
        apart = (
            travel - farthest + swept_support(body.shape, body.R, body.p, world.points, n, wr, vr, g, c, second, third)
        )
    return apart >= margin + travel


@wp.func
def swept_body(world: World, body: MovingBody, n: wp.vec3, second: float, third: float):
    """`swept_support` of a body for an obstacle that stands still in the hand's frame."""
    g, c = acceleration_along(n, body.w, body.a, body.b)
    return swept_support(body.shape, body.R, body.p, world.points, n, body.w, body.v, g, c, second, third)


@wp.func
def _swept_capsule_of(query: Query, body: MovingBody, n: wp.vec3):
    """The same of its bounding capsule."""
    g, c = acceleration_along(n, body.w, body.a, body.b)
    return swept_capsule(body.c0, body.c1, body.radius, n, body.w, body.v, g, c, body.second, body.third)


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
        travel = motion(world.link_motion_radius, link, 0, query.d)
    clear = far - radius - rk - travel >= target
    if moving and not clear and far - radius - rk > target:
        second, third = bends(world.link_motion_radius, link, 0, query.d)
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
        travel = motion(world.link_motion_radius, link, 1, query.d)
    return low - world.link_radius[link] >= target + travel


@wp.func
def links_within(
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
            between = far - rk - world.link_radius[other]
            travel = float(0.0)
            if moving:
                travel = motion(world.link_motion_radius, link, other, query.d)
            clear = between - travel >= target
            if moving and not clear and between > target:
                second, third = bends(world.link_motion_radius, link, other, query.d)
                if between - least_rest(second, third) >= target:
                    n_hat = toward / far
                    k = link_frame(link)
                    g, c = relative_acceleration(n_hat, w[k], v[k], w[CHANGES + k], v[CHANGES + k], other, w, v)
                    wr = w[k] - w[other]
                    vr = v[k] - v[other]
                    low = swept_capsule(c0, c1, rk, n_hat, wr, vr, g, c, second, third)
                    high = wp.max(wp.dot(n_hat, o0), wp.dot(n_hat, o1)) + world.link_radius[other]
                    clear = low - high >= target
            if not clear:
                found = found | (1 << other)
    return found


@wp.func
def hand_near(query: Query, target: float, body: MovingBody, center: wp.vec3, radius: float, moving: bool):
    """Whether a body may come nearer than `target` to the ball around the whole hand; whether the interval has to be halved."""
    toward = from_point(center, body.c0, body.c1)
    far = wp.length(toward)
    near = far - radius - body.radius < target + body.travel
    halved = bool(False)
    if near and moving and far - radius - body.radius > target + query.tolerance:
        n_hat = toward / far
        low = far - radius - body.radius - least_rest(body.second, body.third)
        if low + HAND_SLACK_M >= target:
            low = _swept_capsule_of(query, body, n_hat)
            low = low - wp.dot(n_hat, center) - radius
        if low >= target:
            near = False
        elif low + HAND_SLACK_M < target:
            near = False
            halved = True
    return near, halved


# The ball around the whole hand, then each piece, by three lower bounds of the distance along the interval:
#
# 1. as the motion radii allow: apart - travel >= target settles the pair;
# 2. `least_rest`: what any swept bound takes off. Even without more it falls short of the target by more than bounding
#    volumes understate a distance: the interval has to be halved, and neither the sweep nor GJK is worth asking;
# 3. the swept bound along the way to the ball's centre: enough settles the pair; short by more than that slack: halved.
#
# The others are listed for GJK. A pair that its volumes do not keep apart in the middle is listed with MAY_MEET whatever the
# rest says, for it alone can block.
@wp.func
def pieces_near(
    world: World, query: Query, target: float, body: MovingBody, hand: int, center: wp.vec3, radius: float, moving: bool,
    is_open: int, obstacle: wp.array(dtype=int),
):  # fmt: skip
    """Lists the hand's pieces that may come nearer than `target`."""
    out = Near()
    out.open = is_open
    near, halved = hand_near(query, target, body, center, radius, moving)
    if halved:
        out.open = 1
    rest = least_rest(body.second, body.third)
    if near:
        # piece by piece: its ball against the moving body's capsule, then against its very shape (primitives)
        first = hand * world.n_pieces
        left = balls_near(
            world.piece_center, world.piece_radius, first, world.n_pieces,
            body.c0, body.c1, body.radius, body.travel, body.w, body.v, body.a, body.b, body.second, body.third,
            int(moving), target, query.tolerance,
        )  # fmt: skip
        while left != wp.uint64(0):
            i = lowest_bit(left)
            left = left & (left - wp.uint64(1))
            piece = first + i
            at = world.piece_center[piece]
            toward = wp.vec3(0.0, 0.0, 0.0)
            if body.link == OBJECT:
                toward = from_point(at, body.c0, body.c1)
            else:
                toward = body.R * from_ball(body.shape, wp.transpose(body.R) * (at - body.p))
            far = wp.length(toward)
            apart = far - world.piece_radius[piece]
            if body.link == OBJECT:
                apart = apart - body.radius
            if apart >= target + body.travel:
                continue
            if moving and apart > target + query.tolerance:
                if out.open == 1:
                    continue  # the interval has to be halved anyway
                if apart - rest + SLACK_M < target:
                    out.open = 1
                    continue
                n_hat = toward / far
                low = -wp.dot(n_hat, at) - world.piece_radius[piece]
                if body.link == OBJECT:
                    low = low + _swept_capsule_of(query, body, n_hat)
                else:
                    low = low + swept_body(world, body, n_hat, body.second, body.third)
                if low >= target:
                    continue
                if low + SLACK_M < target:
                    out.open = 1
                    continue
            obstacle[out.n] = wp.where(apart > target + query.tolerance, i, i + MAY_MEET)
            out.n += 1
    return out


@wp.func
def table_near(
    world: World, bodies: TrialBodies, trial: int, query: Query, target: float, body: MovingBody, up: wp.vec3,
    table_p: wp.vec3, moving: bool, n: int, obstacle: wp.array(dtype=int),
):  # fmt: skip
    """Lists the table if the body may come nearer than `target` to the height of its top.

    Joint 1 cannot change that height, whatever the distance to the table's edge does.
    """
    out = Near()
    out.n = n
    top = wp.dot(up, table_p) + world.table_half[2]
    lowest = body.R * support(body.shape, world.points, -(wp.transpose(body.R) * up)) + body.p
    height = wp.dot(up, lowest) - body.shape.radius - top - ROUNDING_M
    low = height
    if moving:
        if body.link == OBJECT:
            low = height - motion(bodies.object_motion_radius, trial, 1, query.d)
            if low < target:
                second, third = bends(bodies.object_motion_radius, trial, 1, query.d)
                g, c = acceleration_along(up, body.w, body.a, body.b)
                swept = swept_capsule(body.c0, body.c1, body.radius, up, body.w, body.v, g, c, second, third)
                low = wp.max(low, swept - top)
                if low < target and height > target:  # its capsule reaches lower than the hull does
                    low = wp.max(low, swept_body(world, body, up, second, third) - top)
        else:
            low = height - motion(world.motion_radius, body.index, 1, query.d)
            if low < target:
                second, third = bends(world.motion_radius, body.index, 1, query.d)
                swept = swept_body(world, body, up, second, third)
                low = wp.max(low, swept - top)
    if low < target:
        if height > target + query.tolerance:
            out.open = 1  # a shorter interval will tell
        else:
            obstacle[out.n] = MAY_MEET
            out.n += 1
    return out


# For each other link that this one may meet: the link as a whole first, then its bodies, capsule against capsule, with the
# three bounds of `pieces_near`. Motion counts as the other link sees it: only the joints between the two turn them against
# each other, so the motion radii are summed from there on, and twist and acceleration are differences (world.py).
#
# 1. the whole link's capsule: settled as the motion radii allow, or along the way between the capsules;
# 2. each of its bodies: settled in the same two ways, or left for the interval's halves (`open`) without asking further;
# 3. the others are listed for GJK, with MAY_MEET where the capsules touch in the middle.
#
# The object is a moving body as the gripper's bodies are, with motion radii of its own in each trial.
@wp.func
def bodies_near(
    world: World, bodies: TrialBodies, trial: int, query: Query, target: float, body: MovingBody, links: int, moving: bool,
    is_open: int, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
    n: int, obstacle: wp.array(dtype=int),
):  # fmt: skip
    """Lists the robot's own bodies, of the links in `links`, that may come nearer than `target`."""
    out = Near()
    out.n = n
    out.open = is_open
    for other in range(wp.min(body.link, GRIPPER)):
        if (links >> other) & 1 == 1:
            travel = float(0.0)
            second = float(0.0)
            third = float(0.0)
            if moving:
                travel, second, third = pair_motion(world, bodies, trial, body.link, body.index, other, query.d)
            # motion relative to the other link: only the joints between the two turn them against each other
            wr = body.w - w[other]
            vr = body.v - v[other]
            # the other link as a whole first
            o0 = R[other] * world.link_c0[other] + p[other]
            o1 = R[other] * world.link_c1[other] + p[other]
            ro = world.link_radius[other]
            toward = from_segment(o0, o1, body.c0, body.c1)
            far = wp.length(toward)
            if far - body.radius - ro >= target + travel:
                continue
            rest = least_rest(second, third)
            if moving and far - body.radius - ro - rest >= target + query.tolerance:
                n_hat = toward / far
                g, c = relative_acceleration(n_hat, body.w, body.v, body.a, body.b, other, w, v)
                low = swept_capsule(body.c0, body.c1, body.radius, n_hat, wr, vr, g, c, second, third)
                if low - wp.max(wp.dot(n_hat, o0), wp.dot(n_hat, o1)) - ro >= target:
                    continue
            # then its bodies one by one, capsule against capsule
            for o in range(world.link_first[other], world.link_first[other + 1]):
                Ro, po = body_pose(world, bodies, trial, R, p, o)
                axis = Ro * world.cap_axis[o]
                toward = from_segment(po - axis, po + axis, body.c0, body.c1)
                far = wp.length(toward)
                apart = far - body.radius - world.cap_radius[o]
                if apart >= target + travel:
                    continue
                if moving and apart > target + query.tolerance:
                    if out.open == 1:
                        continue
                    if apart - rest + SLACK_M < target:
                        out.open = 1
                        continue
                    n_hat = toward / far
                    g, c = relative_acceleration(n_hat, body.w, body.v, body.a, body.b, other, w, v)
                    low = swept_capsule(body.c0, body.c1, body.radius, n_hat, wr, vr, g, c, second, third)
                    low = low - wp.max(wp.dot(n_hat, po - axis), wp.dot(n_hat, po + axis)) - world.cap_radius[o]
                    if low >= target:
                        continue
                    if low + SLACK_M < target:
                        out.open = 1
                        continue
                obstacle[out.n] = wp.where(apart > target + query.tolerance, o, o + MAY_MEET)
                out.n += 1
    return out
