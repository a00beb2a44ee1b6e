"""Bounds on the distance between a moving robot body and a part of the hand: all of it, a convex piece, a face of its
mesh.

The hand's convex pieces enclose the mesh: a body that keeps clear of a piece's hull keeps clear of its triangles, so hulls
and bounding volumes settle most of it, and triangles (hand_distance.py) decide the rest. The inequalities are those of
plan/edge.py, with what is known less the tolerance in place of the margin.
"""

import warp as wp

from r2h_batch.kernels.geometry.closest import TOUCH_M, from_point, signed_distance
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.shape import Shape, from_ball, support
from r2h_batch.kernels.options import OPTIONS

from ..plan.obstacles import MovingBody, least_rest, swept_body
from ..robot.joints import vecq
from ..robot.world import World, motion, piece_shape

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache

SLACK_M = wp.constant(0.03)
HAND_SLACK_M = wp.constant(0.06)
"""A ball about a piece rarely understates a distance by more: pairs that would need it wait for shorter intervals."""
HULL_GAP = wp.constant(0.05)
"""GJK of a hull may stop so far short of the distance, of which it is a part: faces and shorter intervals ask again."""

# What a bound says of a robot body and a part of the hand (all of it, a piece, a face) over an interval of motion.
SETTLED = wp.constant(0)  # the part comes no nearer than what is known, by more than the tolerance
WAITS = wp.constant(1)  # it may, though not in the middle of the interval: its halves will tell
ASK = wp.constant(2)  # it may be nearer even in the middle: look closer
MEETS = wp.constant(3)  # it meets the body in the middle: look how deep


@wp.func
def allowed_of(tolerance: float, distance: float):
    """Allowed error of the smallest distance, m: `tolerance`, or 0.2 % of it; half of an overlap (judge/safe.py)."""
    return wp.max(tolerance, wp.where(distance < 0.0, -0.5 * distance, 0.002 * distance))


@wp.func
def bound_of_hand(world: World, body: MovingBody, hand: int, distance: float, tolerance: float):
    """SETTLED, WAITS or ASK, from the ball around the whole hand and the body's bounding capsule."""
    center = world.hand_center[hand]
    toward = from_point(center, body.c0, body.c1)
    far = wp.length(toward)
    apart = far - world.hand_radius[hand] - body.radius
    if apart >= distance - tolerance + body.travel:
        return SETTLED
    if apart > distance:
        n_hat = toward / far
        low = swept_body(world, body, n_hat, body.second, body.third)
        low = low - wp.dot(n_hat, center) - world.hand_radius[hand]
        if low >= distance - tolerance:
            return SETTLED
        if low + HAND_SLACK_M < distance - tolerance:
            return WAITS
    return ASK


@wp.func
def link_is_clear(
    world: World, hand: int, link: int, c0: wp.vec3, c1: wp.vec3, d: vecq, distance: float, tolerance: float
):
    """Whether a whole link, its capsule's ends at c0 and c1, keeps clear of the ball around the hand on the whole interval."""
    toward = from_point(world.hand_center[hand], c0, c1)
    apart = wp.length(toward) - world.hand_radius[hand] - world.link_radius[link]
    return apart >= distance - tolerance + motion(world.link_motion_radius, link, 0, d)


# From the coarse to the fine, with D the distance known so far, tol the tolerance, travel what the motion radii allow:
#
# 1. the piece's ball against the body's ball, then against the body itself: farther than D - tol + travel, it is settled;
# 2. not nearer than D in the middle: the swept bound along the way to the ball's centre. Enough: settled. Short by more than
#    a ball understates a distance (SLACK_M): GJK would not settle it either, it waits for the interval's halves;
# 3. GJK of body and hull. They meet: the faces have to say how deep, unless the whole piece is clear of the body's core grown
#    by what is known;
# 4. along the plane that GJK found, over the whole interval. What is left: the faces, or, if nothing is nearer in the middle
#    and the plane could not have settled it (`least_rest`), the halves.
#
# `bound_of_ball` is 1 and 2, `bound_of_hull` 4.
@wp.func
def bound_of_ball(world: World, body: MovingBody, piece: int, distance: float, tolerance: float, waits: int):
    """SETTLED, WAITS or ASK, from the ball around a piece (numbered over all hands)."""
    limit = distance - tolerance + body.travel
    center = world.piece_center[piece]
    size = wp.length(body.R * world.cap_axis[body.index]) + body.radius
    if wp.length(center - body.p) - world.piece_radius[piece] - size >= limit:
        return SETTLED
    at = wp.transpose(body.R) * (center - body.p)
    toward = body.R * from_ball(body.shape, at)
    far = wp.length(toward)
    apart = far - world.piece_radius[piece]
    if far == 0.0:  # the ball's centre is in the body: no point of the piece is deeper than this
        deepest = signed_distance(body.shape.kind, body.shape.size, at) - world.piece_radius[piece] - TOUCH_M
        apart = wp.where(deepest >= limit, deepest, -1.0e30)
    if apart >= limit:
        return SETTLED
    if apart >= distance:
        if waits == 1:
            return WAITS
        n_hat = toward / far
        low = swept_body(world, body, n_hat, body.second, body.third)
        low = low - wp.dot(n_hat, center)
        low = low - world.piece_radius[piece]
        if low >= distance - tolerance:
            return SETTLED
        if low + SLACK_M < distance - tolerance:
            return WAITS
    return ASK


@wp.func
def bound_of_hull(
    world: World, body: MovingBody, piece: int, apart: float, v: wp.vec3, distance: float, tolerance: float, waits: int
):
    """SETTLED, WAITS or ASK, from what GJK says of a piece's hull that the body does not meet: lower bound and v.

    Also a direction n and how far along it the body stays over the whole interval (n . x at least `beyond`): most faces of a
    piece lie behind its hull, and are settled by that alone.
    """
    n = wp.vec3(0.0, 0.0, 0.0)
    beyond = float(-1.0e30)
    if apart >= distance - tolerance + body.travel or (waits == 1 and apart >= distance):
        return SETTLED, n, beyond
    low = apart - body.travel
    rest = least_rest(body.second, body.third)
    if apart > 0.0:
        n = v / wp.length(v)
        beyond = swept_body(world, body, n, body.second, body.third)
        low = wp.max(low, beyond - wp.dot(n, support(piece_shape(world, piece), world.points, n)))
    if low >= distance - tolerance and apart >= distance:
        return SETTLED, n, beyond
    if apart >= distance and apart < distance - tolerance + rest:
        return WAITS, n, beyond  # too long an interval to settle here, and nothing nearer in its middle
    return ASK, n, beyond


@wp.func
def bound_of_piece(
    world: World, body: MovingBody, core: Shape, hand: int, i: int, distance: float, tolerance: float, waits: int
):
    """SETTLED, WAITS, ASK or MEETS, from the piece's ball, then from its hull, which holds all its faces.

    With ASK also n and `beyond` (`bound_of_hull`).
    """
    piece = hand * world.n_pieces + i
    n = wp.vec3(0.0, 0.0, 0.0)
    beyond = float(-1.0e30)
    bound = bound_of_ball(world, body, piece, distance, tolerance, waits)
    if bound != ASK:
        return bound, n, beyond
    limit = distance - tolerance + body.travel
    center = world.piece_center[piece]
    hull = piece_shape(world, piece)
    h = gjk(body.shape, body.R, body.p, world.points, hull, world.points, center, wp.max(limit, distance), HULL_GAP)
    if h.upper <= TOUCH_M:  # GJK's bound says nothing of how deep: the faces have to
        if distance < 0.0:  # unless the whole piece is no deeper than what is known
            deep = gjk(core, body.R, body.p, world.points, hull, world.points, center, limit, HULL_GAP)
            if deep.lower >= limit:
                return SETTLED, n, beyond
        return MEETS, n, beyond
    bound, n, beyond = bound_of_hull(world, body, piece, h.lower, h.v, distance, tolerance, waits)
    return bound, n, beyond


@wp.func
def bound_of_face(world: World, body: MovingBody, ball: wp.vec4, distance: float, tolerance: float, waits: int):
    """SETTLED, WAITS or ASK, from the ball around a face."""
    center = wp.vec3(ball[0], ball[1], ball[2])
    at = wp.transpose(body.R) * (center - body.p)
    toward = from_ball(body.shape, at)  # in the body's frame
    far = wp.length(toward)
    apart = far - ball[3]
    limit = distance - tolerance + body.travel
    if far == 0.0:  # a centre inside the body: no point of the face is deeper than this
        deepest = signed_distance(body.shape.kind, body.shape.size, at) - ball[3] - TOUCH_M
        apart = wp.where(deepest >= limit, deepest, -1.0e30)
    if apart >= limit:
        return SETTLED
    if apart >= distance:
        if waits == 1:
            return WAITS
        n_hat = body.R * (toward / far)
        low = swept_body(world, body, n_hat, body.second, body.third)
        low = low - wp.dot(n_hat, center) - ball[3]
        if low >= distance - tolerance:
            return SETTLED
        if low + 2.0 * ball[3] < distance - tolerance:  # GJK cannot add more than that
            return WAITS
    return ASK
