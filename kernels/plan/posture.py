"""Smallest clearance of one posture over all pairs that the planner checks, with its witness; overlaps are measured too.

Separated pairs have their distance. Pairs that meet have minus a lower bound of their penetration depth, which is the
length of the shortest translation that parts them. The bound comes from the growth distance (Ong and Gilbert 1996). Let
the body A hold a ball of radius r about its centre m, and shrink it about m:

    A(s) = m + s (A - m),    s* = the scale at which A(s) only touches the other body B.

rho(n) = max n . (m - x) over A is how far A reaches from m against the unit vector n, so rho(n) >= r. Were A moved clear
of B along n, it would have to travel h_B(n) - n . m + rho(n), with h_B the support of B. As A(s) meets B for every
s > s*, no plane parts them there: h_B(n) - n . m >= -s* rho(n). The way out is thus at least (1 - s*) rho(n) in every
direction, and so at least (1 - s*) r: the clearance is -(1 - s*) r. It is 0 where the bodies touch, falls the deeper
they meet, and stays at -r once m is in B.

s* is approached from below. At a scale s that is clear of B by g along n, the same plane still parts them at
s + g / rho(n): each step is certified, and n converges to the normal at the touch. A(s) is not small enough to say how deep
they meet, but it is at most g away from B, and A(t) holds A(s) grown by (t - s) r. So they meet at t = s + g / r, and

    (1 - s*) r  >=  (1 - s) r - g,

with GJK's upper bound for g. Every step gives such a bound, and the largest counts. Where A moves by u relative to B, the
gap grows by n . u, s* by n . u / rho(n), and the clearance by (r / rho(n)) n . u: that vector is `push`."""

import warp as wp

from r2h_batch.kernels.geometry.balls import balls_within, capsules_within, lowest_bit
from r2h_batch.kernels.geometry.closest import TOUCH_M, from_point, from_segment, inner_radius
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.shape import BOX, Shape, from_ball, support
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import MAX_ARM_BODIES, PAIR_HAND, PAIR_OF_OBJECT, PAIR_SELF, PAIR_TABLE

from ..robot.joints import GRIPPER, LINKS, OBJECT, vecq
from ..robot.world import (
    TrialBodies,
    World,
    body_pose,
    forward_kinematics,
    link_frame,
    object_shape,
    piece_shape,
    points_of,
    robot_shape,
)

wp.set_module_options(OPTIONS | {"max_unroll": 0})

GROWTH_STEPS = wp.constant(12)

# The questions to GJK about a pair, in this order (`pair_clearance`).
MEET = wp.constant(0)  # at full size: do they meet?
DEEPER = wp.constant(1)  # as small as the deepest overlap so far leaves it: do they meet deeper?
AT_FLOOR = wp.constant(2)  # as small as an overlap of `floor` leaves it: do they meet as deep as that?
GROW = wp.constant(3)  # from a scale that is clear, up to the touch
AT_FLOOR_AGAIN = wp.constant(4)  # a little smaller still: GJK has rare false hits, a posture is given up after two


@wp.struct
class BodyInPlace:
    """A body of the robot or a hull of the object, hand frame: pose, bounding capsule c0-c1, the ball that it holds."""

    link: int
    shape: Shape
    R: wp.mat33
    p: wp.vec3
    c0: wp.vec3
    c1: wp.vec3
    radius: float
    middle: wp.vec3  # centre of that ball, in the body's frame
    inner: float  # its radius


@wp.struct
class Obstacle:
    """Obstacle of a body: a piece of the hand, the table, or a body of another link; its pose in the hand frame."""

    near: int  # 0: bounding volumes keep it farther away than the smallest clearance so far
    pair: int  # as if the robot itself met it
    other: int
    shape: Shape
    center: wp.vec3
    R: wp.mat33
    p: wp.vec3


@wp.func
def in_place(
    world: World, hull_ball: wp.array(dtype=wp.vec4), bodies: TrialBodies, trial: int, link: int, b: int,
    hull: int, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Body b of a link, or a hull of the object."""
    out = BodyInPlace()
    out.link = link
    Rb, pb = body_pose(world, bodies, trial, R, p, b)
    out.R = Rb
    out.p = pb
    out.shape = robot_shape(world, wp.min(b, world.n_robot - 1))
    out.inner = inner_radius(out.shape.kind, out.shape.size)
    if link == OBJECT:
        out.shape = object_shape(world, hull)
        ball = hull_ball[hull]
        out.middle = wp.vec3(ball[0], ball[1], ball[2])
        out.inner = ball[3]
        out.c0 = Rb * world.hull_c0[hull] + pb
        out.c1 = Rb * world.hull_c1[hull] + pb
        out.radius = world.hull_radius[hull]
    else:
        axis = Rb * world.cap_axis[b]
        out.c0 = pb - axis
        out.c1 = pb + axis
        out.radius = world.cap_radius[b]
    return out


@wp.func
def hand_piece(world: World, body: BodyInPlace, hand: int, i: int, known: float):
    """Piece i of the hand, if it may be nearer than `known`: ball against capsule, then ball against primitive."""
    out = Obstacle()
    out.pair = PAIR_HAND
    out.other = i
    out.R = wp.identity(3, dtype=float)
    piece = hand * world.n_pieces + i
    out.center = world.piece_center[piece]
    ball = world.piece_radius[piece]
    if wp.length(from_point(out.center, body.c0, body.c1)) - ball - body.radius < known:
        out.near = 1
        if body.link < OBJECT:
            toward = from_ball(body.shape, wp.transpose(body.R) * (out.center - body.p))
            if wp.length(toward) - ball >= known:
                out.near = 0
    out.shape = piece_shape(world, piece)
    return out


@wp.func
def table_below(
    world: World, body: BodyInPlace, R_hand_world: wp.mat33, table_p: wp.vec3, up: wp.vec3, top: float, known: float
):
    """The table, if the body's lowest point may be nearer than `known` to the height of its top."""
    out = Obstacle()
    out.pair = PAIR_TABLE
    out.other = -1
    lowest = body.R * support(body.shape, world.points, -(wp.transpose(body.R) * up)) + body.p
    if wp.dot(up, lowest) - body.shape.radius - top - TOUCH_M < known:
        out.near = 1
    out.shape.kind = BOX
    out.shape.size = world.table_half
    out.R = R_hand_world
    out.p = table_p
    return out


@wp.func
def arm_body(
    world: World, bodies: TrialBodies, trial: int, body: BodyInPlace, other: int, known: float,
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The robot's body `other`, if it may be nearer than `known`: capsule against capsule."""
    out = Obstacle()
    out.pair = PAIR_SELF
    out.other = other
    Ro, po = body_pose(world, bodies, trial, R, p, other)
    axis = Ro * world.cap_axis[other]
    apart = wp.length(from_segment(po - axis, po + axis, body.c0, body.c1)) - body.radius - world.cap_radius[other]
    if apart < known:
        out.near = 1
    out.shape = robot_shape(world, other)
    out.R = Ro
    out.p = po
    return out


@wp.func
def bodies_below(b: int):
    """A bit for each body before b."""
    return (wp.uint64(1) << wp.uint64(b)) - wp.uint64(1)


@wp.func
def place_links(
    world: World, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), c0: wp.array(dtype=wp.vec3),
    c1: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Writes the ends of the links' bounding capsules."""
    for link in range(OBJECT):
        k = link_frame(link)
        c0[link] = R[k] * world.link_c0[link] + p[k]
        c1[link] = R[k] * world.link_c1[link] + p[k]


@wp.func
def place_bodies(
    world: World, link: int, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3),
    c0: wp.array(dtype=wp.vec3), c1: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Writes the ends of the bounding capsules of an arm link's bodies."""
    for b in range(world.link_first[link], world.link_first[link + 1]):
        pb = R[link] * world.body_p[b] + p[link]
        axis = R[link] * (world.body_R[b] * world.cap_axis[b])
        c0[b] = pb - axis
        c1[b] = pb + axis


@wp.struct
class PairClearance:
    """The nearest pair: clearance (m), CollidingPair, robot body, the body it meets (SELF: robot body), in the hand frame.

    When body and other move by rigid motions, the clearance changes by push . (move of the body's point - the other's).
    """

    clearance: float
    pair: int
    body: int
    other: int
    push: wp.vec3
    point: wp.vec3


@wp.struct
class Overlap:
    """Clearance of one pair when it is below `known`; push and point in the obstacle's frame."""

    clearance: float
    push: wp.vec3
    point: wp.vec3
    given_up: int  # as deep as `floor`: nothing else of this posture matters


# A state machine around one call of GJK (the head of this file says why growth is certified). `scale` is how large the body
# is asked, `known` the smallest clearance so far, `floor` what a branch has to beat to matter:
#
#     MEET            scale 1. Apart: the distance is the answer. Else to AT_FLOOR
#     DEEPER          scale 1 + known / r: as small as an overlap of `known` would have it. Clear: not deeper, done
#     AT_FLOOR        scale 1 + floor / r. Clear there: growth starts from it. Else to AT_FLOOR_AGAIN
#     AT_FLOOR_AGAIN  0.95 of that, as the rounding allowance makes a touch look like an overlap. Still met: given up
#     GROW            scale grows by gap / rho(n) until the gap is TOUCH_M: the clearance is gap - (1 - scale) r
#
# Without a floor within the body's ball growth starts at its centre (scale 0), which is clear unless it is inside.
@wp.func
def pair_clearance(world: World, body: BodyInPlace, obstacle: Obstacle, known: float, floor: float):
    """Clearance of one pair if it is below `known` (else `known`), given up when it is not above `floor`.

    One call site of GJK serves all questions. A pair that meets at full size (MEET), or deeper than what is known
    (DEEPER), is first looked at as deep as `floor`; if it is not, that scale is clear and growth starts there. Without
    a `floor` within the body's ball it starts at its centre alone (scale 0), which is clear unless it is inside.
    """
    out = Overlap()
    out.clearance = known
    Rt = wp.transpose(obstacle.R)
    R = Rt * body.R  # the body in its obstacle's frame
    p = Rt * (body.p - obstacle.p)
    phase = wp.where(known < 0.0, DEEPER, MEET)
    scale = wp.where(known < 0.0, 1.0 + known / body.inner, 1.0)
    shrunk = body.shape
    shrunk.radius = scale * body.shape.radius
    steps = int(0)
    running = bool(True)
    while running:
        # How much GJK has to prove: no more than decides the question; how far exactly only while growing.
        needed = wp.where(phase == MEET, wp.max(known, 0.0), wp.where(phase == DEEPER, 0.0, 1.0e30))
        at_scale = p + (1.0 - scale) * (R * body.middle)
        dist = gjk(
            shrunk, scale * R, at_scale, world.points, obstacle.shape, points_of(world, obstacle.shape), obstacle.center,
            needed, 0.0,
        )  # fmt: skip
        if phase == MEET and dist.lower >= 0.0:
            running = False
            out.clearance = dist.lower
            if dist.lower < known:
                out.push = wp.normalize(dist.v)
                out.point = dist.point
        elif phase == DEEPER and dist.lower >= 0.0:
            running = False
        elif phase <= DEEPER:
            out.clearance = wp.min(known, 0.0)
            phase = wp.where(floor > -body.inner, AT_FLOOR, GROW)
            scale = wp.max(1.0 + floor / body.inner, 0.0)
        elif phase == AT_FLOOR and dist.lower <= TOUCH_M:
            phase = AT_FLOOR_AGAIN
            scale = 0.95 * scale
        elif phase == AT_FLOOR_AGAIN and dist.lower <= TOUCH_M:
            running = False
            out.given_up = 1
        else:
            phase = GROW
            # they are at least so deep, whether or not growth has come to the touch
            out.clearance = wp.min(out.clearance, wp.max(dist.upper, 0.0) - (1.0 - scale) * body.inner)
            running = dist.lower > TOUCH_M
            n_hat = wp.normalize(dist.v)
            d = -(wp.transpose(R) * n_hat)
            # minus rho(n)
            extent = wp.dot(n_hat, R * (support(body.shape, world.points, d) - body.middle)) - body.shape.radius
            running = running and extent < -1.0e-9
            if running:
                scale = wp.min(scale - (dist.lower + TOUCH_M) / extent, 1.0)
                out.push = (-body.inner / extent) * n_hat
                out.point = dist.point
            steps += 1
            if scale >= 1.0 or steps >= GROWTH_STEPS:
                running = False
        shrunk.radius = scale * body.shape.radius
    return out


@wp.func
def obstacle_of(
    world: World, bodies: TrialBodies, trial: int, body: BodyInPlace, kind: int, i: int, hand: int,
    R_hand_world: wp.mat33, table_p: wp.vec3, up: wp.vec3, top: float, known: float,
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Obstacle i of a kind, as far as it may be nearer than `known`."""
    obstacle = Obstacle()
    if kind == PAIR_HAND:
        obstacle = hand_piece(world, body, hand, i, known)
    elif kind == PAIR_TABLE:
        obstacle = table_below(world, body, R_hand_world, table_p, up, top, known)
    else:
        obstacle = arm_body(world, bodies, trial, body, i, known, R, p)
    return obstacle


# Branch and bound over links, bodies and pairs. `out.clearance` starts at `cap` and falls with every nearer pair; nothing
# whose bounding volumes are farther than that is looked at:
#
# 1. gripper and object first, then the arm from the wrist down: the first are nearest mostly, and prune the rest;
# 2. a link's capsule against the ball about the hand, the table's top, the capsules of links it may meet;
# 3. a body's capsule against the ball about the hand; then its obstacles, one after the other: pieces of the hand, the
#    table, bodies of the arm, of which bounding volumes leave a bit for each that may be near (balls.py), so that all go
#    through one call of `pair_clearance`;
# 4. an overlap cannot be deeper than the radius r of the ball within the body: once a pair as deep as that is known, the
#    body's other pairs are left out;
# 5. at or below `floor` the function returns at once: the caller keeps another branch.
@wp.func
def posture_clearance(
    world: World,
    hull_ball: wp.array(dtype=wp.vec4),  # centre of each object hull and the radius of the ball it holds there
    bodies: TrialBodies, trial: int, q: vecq, cap: float, floor: float,
    R: wp.array(dtype=wp.mat33),  # (7,) scratch
    p: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The nearest of all pairs of a posture, exact below `cap`; given up as soon as it is not above `floor`.

    `cap` below 0: only overlaps deeper than that are looked for, which is quick. Links, then bodies, then pairs are left
    out as soon as bounding volumes keep them farther away than the smallest clearance so far (branch and bound).
    """
    out = PairClearance()
    out.clearance = cap
    out.body = -1
    out.other = -1
    R_hand_world = bodies.R_hand_world[trial]
    forward_kinematics(world, R_hand_world, bodies.p_hand_world[trial], q, R, p)
    hand = bodies.hand[trial]
    hand_center = world.hand_center[hand]
    hand_radius = world.hand_radius[hand]
    up = wp.vec3(R_hand_world[0, 2], R_hand_world[1, 2], R_hand_world[2, 2])  # world z in the hand frame
    table_p = R_hand_world * world.table_center + bodies.p_hand_world[trial]
    top = wp.dot(up, table_p) + world.table_half[2]
    first_hull = world.hull_first[bodies.object[trial]]
    n_hulls = world.hull_first[bodies.object[trial] + 1] - first_hull
    # bounding capsules of all links, and of the bodies of those links of the arm that something may meet
    link_c0 = wp.zeros(shape=OBJECT, dtype=wp.vec3)
    link_c1 = wp.zeros(shape=OBJECT, dtype=wp.vec3)
    place_links(world, R, p, link_c0, link_c1)
    arm_c0 = wp.zeros(shape=MAX_ARM_BODIES, dtype=wp.vec3)
    arm_c1 = wp.zeros(shape=MAX_ARM_BODIES, dtype=wp.vec3)
    body_poses = int(0)

    for back in range(LINKS):  # gripper and object first: mostly they are nearest, and prune the rest
        link = wp.where(back < 2, GRIPPER + back, OBJECT - back)
        lo = int(world.n_robot)
        hi = int(world.n_robot + n_hulls)
        self_with = world.self_links[link]
        near_hand = bool(True)
        near_table = bool(True)
        if link < OBJECT:  # the link as a whole first
            lo = world.link_first[link]
            hi = world.link_first[link + 1]
            c0 = link_c0[link]
            c1 = link_c1[link]
            rk = world.link_radius[link]
            near_hand = wp.length(from_point(hand_center, c0, c1)) - hand_radius - rk < out.clearance
            near_table = hi > world.table_from and wp.min(wp.dot(up, c0), wp.dot(up, c1)) - top - rk < out.clearance
            if self_with != 0:
                near_links = capsules_within(
                    link_c0, link_c1, world.link_radius, wp.min(link, GRIPPER), c0, c1, rk, out.clearance
                )
                self_with = self_with & int(near_links)
                for other in range(wp.min(link, GRIPPER)):
                    if (self_with >> other) & 1 == 1:
                        toward = from_segment(link_c0[other], link_c1[other], c0, c1)
                        if wp.length(toward) - rk - world.link_radius[other] >= out.clearance:
                            self_with = self_with & ~(1 << other)
            if not (near_hand or near_table or self_with != 0):
                continue
        arm = wp.uint64(0)  # the bodies of the links in `self_with`
        for other in range(GRIPPER):
            if (self_with >> other) & 1 == 1:
                arm = arm | (bodies_below(world.link_first[other + 1]) & ~bodies_below(world.link_first[other]))
                if (body_poses >> other) & 1 == 0:
                    place_bodies(world, other, R, p, arm_c0, arm_c1)
                    body_poses = body_poses | (1 << other)
        for b in range(lo, hi):
            body = in_place(world, hull_ball, bodies, trial, link, b, first_hull + b - world.n_robot, R, p)
            on_table = near_table and b >= world.table_from
            ball = wp.length(from_point(hand_center, body.c0, body.c1)) - hand_radius - body.radius
            on_hand = near_hand and ball < out.clearance

            # its obstacles: pieces of the hand, the table, the arm's bodies; `left`: who may be near and is still to come
            kind = int(PAIR_HAND)
            left = wp.uint64(0)
            if on_hand:
                left = balls_within(
                    world.piece_center, world.piece_radius, hand * world.n_pieces, world.n_pieces,
                    body.c0, body.c1, body.radius, out.clearance,
                )  # fmt: skip
            while kind <= PAIR_SELF and -body.inner < out.clearance:  # else it cannot meet anything deeper
                if left == wp.uint64(0):
                    kind += 1
                    if kind == PAIR_TABLE and on_table:
                        left = wp.uint64(1)
                    elif kind == PAIR_SELF and arm != wp.uint64(0):
                        left = arm & capsules_within(
                            arm_c0, arm_c1, world.cap_radius, world.n_arm, body.c0, body.c1, body.radius, out.clearance
                        )
                    continue
                i = lowest_bit(left)
                left = left & (left - wp.uint64(1))
                obstacle = obstacle_of(
                    world, bodies, trial, body, kind, i, hand, R_hand_world, table_p, up, top, out.clearance, R, p
                )
                if obstacle.near == 0:
                    continue
                found = pair_clearance(world, body, obstacle, out.clearance, floor)
                if found.given_up == 1:
                    out.clearance = floor - TOUCH_M
                    return out
                if found.clearance < out.clearance:
                    out.clearance = found.clearance
                    out.pair = wp.where(link == OBJECT, obstacle.pair + PAIR_OF_OBJECT, obstacle.pair)
                    out.body = b
                    out.other = obstacle.other
                    out.push = obstacle.R * found.push
                    out.point = obstacle.R * found.point + obstacle.p
                    if out.clearance <= floor:
                        return out
    return out
