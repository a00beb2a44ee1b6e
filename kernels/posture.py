"""Smallest clearance of one posture over all pairs that the planner checks, with its witness; overlaps are measured too.

Separated pairs: the distance. Pairs that meet: the robot body (or the held object's hull) is shrunk about its centre until
it only touches (growth distance, Ong and Gilbert 1996). Shrunk to the fraction s it touches, so it reaches at least
(1 - s) r into the other body, r being the radius of the ball about its centre that it holds: -(1 - s) r is the clearance.
It is 0 where the bodies touch, falls the deeper they meet, and stays at -r once the centre is inside.
"""

import warp as wp

from r2h_batch.kernels.body import BOX, CAPSULE, CYLINDER, Body, from_ball, support
from r2h_batch.kernels.gjk import gjk
from r2h_batch.kernels.world import (
    GRIPPER,
    OBJECT,
    TrialBodies,
    World,
    body_pose,
    forward_kinematics,
    from_point,
    from_segment,
    hull_body,
    link_frame,
    object_body,
    robot_body,
    vec6,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 0})

PAIR_HAND = wp.constant(1)
PAIR_TABLE = wp.constant(2)
PAIR_SELF = wp.constant(3)
GROWTH_STEPS = wp.constant(12)
TOUCH_M = wp.constant(1.0e-6)


@wp.struct
class Nearest:
    """The nearest pair: clearance (m), CollidingPair, robot body, the body it meets (SELF: robot body), in the hand frame.

    When body and other move by rigid motions, the clearance changes by push . (move of the body's point - the other's).
    """

    clearance: float
    pair: int
    body: int
    other: int
    push: wp.vec3
    point: wp.vec3


@wp.func
def inner_radius(shape: Body):
    """Radius of the ball about a primitive's centre that it holds."""
    r = shape.size[0]
    if shape.kind == BOX:
        r = wp.min(shape.size[0], wp.min(shape.size[1], shape.size[2]))
    elif shape.kind == CYLINDER:
        r = wp.min(shape.size[0], shape.size[1])
    elif shape.kind == CAPSULE:
        r = shape.radius
    return r


@wp.func
def posture_clearance(
    world: World,
    hull_ball: wp.array(dtype=wp.vec4),  # centre of each object hull and the radius of the ball it holds there
    bodies: TrialBodies,
    trial: int,
    q: vec6,
    cap: float,
    floor: float,
    R: wp.array(dtype=wp.mat33),  # (7,) scratch
    p: wp.array(dtype=wp.vec3),
):
    """The nearest of all pairs of a posture, exact below `cap`; given up as soon as it is not above `floor`.

    `cap` below 0: only overlaps deeper than that are looked for, which is quick.
    """
    out = Nearest()
    out.clearance = cap
    out.body = -1
    out.other = -1
    R_hand_world = bodies.R_hand_world[trial]
    forward_kinematics(world, R_hand_world, bodies.p_hand_world[trial], q, R, p)
    hand = bodies.hand[trial]
    hand_center = world.hand_center[hand]
    hand_radius = world.hand_radius[hand]
    up = wp.vec3(R_hand_world[0, 2], R_hand_world[1, 2], R_hand_world[2, 2])
    table_p = R_hand_world * world.table_center + bodies.p_hand_world[trial]
    top = wp.dot(up, table_p) + world.table_half[2]
    first_hull = world.hull_first[bodies.object[trial]]
    n_hulls = world.hull_first[bodies.object[trial] + 1] - first_hull

    for back in range(9):  # gripper and object first: mostly they are nearest, and prune the rest
        link = wp.where(back < 2, GRIPPER + back, OBJECT - back)
        lo = int(world.n_robot)
        hi = int(world.n_robot + n_hulls)
        self_with = world.self_links[link]
        near_hand = bool(True)
        near_table = bool(True)
        if link < OBJECT:
            lo = world.link_first[link]
            hi = world.link_first[link + 1]
            Rk = R[link_frame(link)]
            pk = p[link_frame(link)]
            c0 = Rk * world.link_c0[link] + pk
            c1 = Rk * world.link_c1[link] + pk
            rk = world.link_radius[link]
            near_hand = wp.length(from_point(hand_center, c0, c1)) - hand_radius - rk < out.clearance
            near_table = hi > world.table_from and wp.min(wp.dot(up, c0), wp.dot(up, c1)) - top - rk < out.clearance
            for other in range(wp.min(link, GRIPPER)):
                if (self_with >> other) & 1 == 1:
                    o0 = R[other] * world.link_c0[other] + p[other]
                    o1 = R[other] * world.link_c1[other] + p[other]
                    if wp.length(from_segment(o0, o1, c0, c1)) - rk - world.link_radius[other] >= out.clearance:
                        self_with = self_with & ~(1 << other)
            if not (near_hand or near_table or self_with != 0):
                continue
        for b in range(lo, hi):
            Rb, pb = body_pose(world, bodies, trial, R, p, b)
            shape = robot_body(world, wp.min(b, world.n_robot - 1))
            middle = wp.vec3(0.0, 0.0, 0.0)  # in the body's frame
            inner = inner_radius(shape)
            hull = first_hull + b - world.n_robot
            c0 = wp.vec3(0.0, 0.0, 0.0)
            c1 = wp.vec3(0.0, 0.0, 0.0)
            rb = float(0.0)
            if link == OBJECT:
                shape = object_body(world, hull)
                ball = hull_ball[hull]
                middle = wp.vec3(ball[0], ball[1], ball[2])
                inner = ball[3]
                c0 = Rb * world.hull_c0[hull] + pb
                c1 = Rb * world.hull_c1[hull] + pb
                rb = world.hull_radius[hull]
            else:
                axis = Rb * world.cap_axis[b]
                c0 = pb - axis
                c1 = pb + axis
                rb = world.cap_radius[b]
            on_table = near_table and b >= world.table_from
            on_hand = near_hand and wp.length(from_point(hand_center, c0, c1)) - hand_radius - rb < out.clearance

            # partners: hand pieces, the table, bodies of other links; one call site of GJK for all
            n_hand = wp.where(on_hand, world.n_pieces, 0)
            n_table = n_hand + wp.where(on_table, 1, 0)
            n_all = n_table + wp.where(self_with != 0, world.n_arm, 0)
            for i in range(n_all):
                if -inner >= out.clearance:
                    continue  # this body cannot meet anything deeper
                other_shape = Body()
                center = wp.vec3(0.0, 0.0, 0.0)
                Ro = wp.identity(3, dtype=float)
                po = wp.vec3(0.0, 0.0, 0.0)
                pair = int(PAIR_HAND)
                other = int(i)
                if i < n_hand:
                    piece = hand * world.n_pieces + i
                    center = world.piece_center[piece]
                    apart = wp.length(from_point(center, c0, c1)) - world.piece_radius[piece] - rb
                    if apart >= out.clearance:
                        continue
                    if link < OBJECT:
                        toward = from_ball(shape, wp.transpose(Rb) * (center - pb))
                        if wp.length(toward) - world.piece_radius[piece] >= out.clearance:
                            continue
                    other_shape = hull_body(world.piece_start, piece)
                elif i < n_table:
                    pair = PAIR_TABLE
                    other = int(-1)
                    lowest = Rb * support(shape, world.points, -(wp.transpose(Rb) * up)) + pb
                    if wp.dot(up, lowest) - shape.radius - top - TOUCH_M >= out.clearance:
                        continue
                    other_shape.kind = BOX
                    other_shape.size = world.table_half
                    Ro = R_hand_world
                    po = table_p
                else:
                    pair = PAIR_SELF
                    other = i - n_table
                    k = world.body_link[other]
                    if (self_with >> k) & 1 == 0:
                        continue
                    Ro, po = body_pose(world, bodies, trial, R, p, other)
                    axis = Ro * world.cap_axis[other]
                    apart = wp.length(from_segment(po - axis, po + axis, c0, c1)) - rb - world.cap_radius[other]
                    if apart >= out.clearance:
                        continue
                    other_shape = robot_body(world, other)
                Rt = wp.transpose(Ro)
                Rr = Rt * Rb
                pr = Rt * (pb - po)

                # phase 0: do they meet? 1: deeper than what is known? 2, 4: as deep as `floor`? 3: grow from a free scale
                phase = wp.where(out.clearance < 0.0, 1, 0)
                scale = wp.where(out.clearance < 0.0, 1.0 + out.clearance / inner, 1.0)
                shrunk = shape
                shrunk.radius = scale * shape.radius
                value = float(out.clearance)
                push = wp.vec3(0.0, 0.0, 0.0)
                at = wp.vec3(0.0, 0.0, 0.0)
                steps = int(0)
                running = bool(True)
                while running:
                    needed = wp.where(phase == 0, wp.max(out.clearance, 0.0), wp.where(phase == 1, 0.0, 1.0e30))
                    at_scale = pr + (1.0 - scale) * (Rr * middle)
                    dist = gjk(
                        shrunk, scale * Rr, at_scale, world.points, other_shape, world.points, center, needed, 0.0
                    )
                    if phase == 0 and dist.lower >= 0.0:
                        running = False
                        value = dist.lower
                        if dist.lower < out.clearance:
                            push = wp.normalize(dist.v)
                            at = dist.point
                    elif phase == 1 and dist.lower >= 0.0:
                        running = False
                    elif phase < 2 and floor > -inner:
                        phase = 2
                        scale = 1.0 + floor / inner
                    elif phase < 2:
                        phase = 3
                        scale = 0.0
                        value = -inner
                    elif phase == 2 and dist.lower <= TOUCH_M:
                        phase = 4  # GJK has rare false hits: a branch is given up after two
                        scale = 0.95 * scale
                    elif dist.lower <= TOUCH_M:
                        running = False
                        if phase == 4:
                            out.clearance = floor - TOUCH_M
                            return out
                    else:
                        phase = 3
                        n_hat = wp.normalize(dist.v)
                        d = -(wp.transpose(Rr) * n_hat)
                        reach = wp.dot(n_hat, Rr * (support(shape, world.points, d) - middle)) - shape.radius
                        running = reach < -1.0e-9
                        if running:
                            scale = wp.min(scale - (dist.lower + TOUCH_M) / reach, 1.0)
                            value = -(1.0 - scale) * inner
                            push = (-inner / reach) * n_hat
                            at = dist.point
                        steps += 1
                        if scale >= 1.0 or steps >= GROWTH_STEPS:
                            running = False
                    shrunk.radius = scale * shape.radius
                if value < out.clearance:
                    out.clearance = value
                    out.pair = wp.where(link == OBJECT, pair + 3, pair)
                    out.body = b
                    out.other = other
                    out.push = Ro * push
                    out.point = Ro * at + po
                    if out.clearance <= floor:
                        return out
    return out
