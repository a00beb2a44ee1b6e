"""What may meet what at a posture: bodies and links in place, and partners that bounding volumes do not keep apart."""

import warp as wp

from r2h_batch.kernels.geometry.body import BOX, Body, from_ball, support
from r2h_batch.kernels.geometry.primitives import TOUCH_M, inner_radius
from r2h_batch.kernels.geometry.segments import from_point, from_segment
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import PAIR_HAND, PAIR_SELF, PAIR_TABLE
from r2h_batch.kernels.robot.world import (
    OBJECT,
    TrialBodies,
    World,
    body_pose,
    link_frame,
    object_body,
    piece_body,
    robot_body,
)

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.struct
class BodyInPlace:
    """A body of the robot or a hull of the object, hand frame: pose, bounding capsule c0-c1, the ball that it holds."""

    link: int
    shape: Body
    R: wp.mat33
    p: wp.vec3
    c0: wp.vec3
    c1: wp.vec3
    radius: float
    middle: wp.vec3  # centre of that ball, in the body's frame
    inner: float  # its radius


@wp.struct
class Partner:
    """What a body may meet: a piece of the hand, the table, or a body of another link; its pose in the hand frame."""

    near: int  # 0: bounding volumes keep it farther away than the smallest clearance so far
    pair: int  # as if the robot itself met it
    other: int
    shape: Body
    center: wp.vec3
    R: wp.mat33
    p: wp.vec3


@wp.func
def in_place(
    world: World,
    hull_ball: wp.array(dtype=wp.vec4),
    bodies: TrialBodies,
    trial: int,
    link: int,
    b: int,
    hull: int,
    R: wp.array(dtype=wp.mat33),
    p: wp.array(dtype=wp.vec3),
):
    """Body b of a link, or a hull of the object."""
    out = BodyInPlace()
    out.link = link
    Rb, pb = body_pose(world, bodies, trial, R, p, b)
    out.R = Rb
    out.p = pb
    out.shape = robot_body(world, wp.min(b, world.n_robot - 1))
    out.inner = inner_radius(out.shape.kind, out.shape.size)
    if link == OBJECT:
        out.shape = object_body(world, hull)
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
    out = Partner()
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
    out.shape = piece_body(world, piece)
    return out


@wp.func
def table_below(
    world: World, body: BodyInPlace, R_hand_world: wp.mat33, table_p: wp.vec3, up: wp.vec3, top: float, known: float
):
    """The table, if the body's lowest point may be nearer than `known` to the height of its top."""
    out = Partner()
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
    world: World,
    bodies: TrialBodies,
    trial: int,
    body: BodyInPlace,
    other: int,
    known: float,
    R: wp.array(dtype=wp.mat33),
    p: wp.array(dtype=wp.vec3),
):
    """The robot's body `other`, if it may be nearer than `known`: capsule against capsule."""
    out = Partner()
    out.pair = PAIR_SELF
    out.other = other
    Ro, po = body_pose(world, bodies, trial, R, p, other)
    axis = Ro * world.cap_axis[other]
    apart = wp.length(from_segment(po - axis, po + axis, body.c0, body.c1)) - body.radius - world.cap_radius[other]
    if apart < known:
        out.near = 1
    out.shape = robot_body(world, other)
    out.R = Ro
    out.p = po
    return out


@wp.func
def bodies_below(b: int):
    """A bit for each body before b."""
    return (wp.uint64(1) << wp.uint64(b)) - wp.uint64(1)


@wp.func
def place_links(
    world: World,
    R: wp.array(dtype=wp.mat33),
    p: wp.array(dtype=wp.vec3),
    c0: wp.array(dtype=wp.vec3),
    c1: wp.array(dtype=wp.vec3),
):
    """Writes the ends of the links' bounding capsules."""
    for link in range(OBJECT):
        k = link_frame(link)
        c0[link] = R[k] * world.link_c0[link] + p[k]
        c1[link] = R[k] * world.link_c1[link] + p[k]


@wp.func
def place_bodies(
    world: World,
    link: int,
    R: wp.array(dtype=wp.mat33),
    p: wp.array(dtype=wp.vec3),
    c0: wp.array(dtype=wp.vec3),
    c1: wp.array(dtype=wp.vec3),
):
    """Writes the ends of the bounding capsules of an arm link's bodies."""
    for b in range(world.link_first[link], world.link_first[link + 1]):
        pb = R[link] * world.body_p[b] + p[link]
        axis = R[link] * (world.body_R[b] * world.cap_axis[b])
        c0[b] = pb - axis
        c1[b] = pb + axis
