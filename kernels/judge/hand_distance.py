"""Signed distance of the robot to the hand's exact mesh at a posture, and what may come nearer on an interval around it."""

import warp as wp

from r2h_batch.kernels.geometry.balls import balls_in_reach, balls_near, balls_within, lowest_bit
from r2h_batch.kernels.geometry.closest import TOUCH_M, rounded
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.hand_mesh import HandMesh, inside_mesh, triangle_points
from r2h_batch.kernels.geometry.shape import BLOCKS, BOX, CYLINDER, Shape, support, triangle_shape
from r2h_batch.kernels.options import OPTIONS

from ..plan.obstacles import MovingBody, moving_body, swept_body
from ..robot.joints import OBJECT, vecq
from ..robot.world import TrialBodies, World, forward_kinematics, link_frame, twists
from .hand_bounds import ASK, MEETS, WAITS, bound_of_face, bound_of_hand, bound_of_piece, link_is_clear

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache


@wp.struct
class HandDistance:
    """Signed distance so far, the robot body it belongs to, and the hand's point nearest to that body (hand frame)."""

    distance: float
    body: int
    point: wp.vec3
    changed: int  # 1: this call found something nearer
    inside: int  # 1: a body lies wholly in the hand; how deep is then measured from the distance known before
    open: int  # 1: something may come nearer within the interval


@wp.func
def is_edged(shape: Shape):
    """Whether a body has edges, which its `rounded` core has not: a capsule or a ball is its own core."""
    return shape.kind == BOX or shape.kind == CYLINDER or shape.kind == BLOCKS


@wp.func
def face_distance(lower: float, upper: float, radius: float, rounded_core: int):
    """Signed distance of a body to a face, from GJK's bounds; `radius` of the core that was asked, 1: of `rounded`."""
    value = wp.max(lower, -radius)
    if rounded_core == 1 or upper <= TOUCH_M:
        value = wp.min(value, -TOUCH_M)
    return value


@wp.func
def point_of_face(point: wp.vec3, v: wp.vec3, tri: wp.array(dtype=wp.vec3)):
    """The face's point nearest to a body, from the body's own and GJK's v."""
    x = point - v
    if wp.dot(v, v) == 0.0:  # through the core: any point of the face is a witness
        x = (tri[0] + tri[1] + tri[2]) / 3.0
    return x


@wp.func
def face_may_come_nearer(
    world: World, body: MovingBody, tri: wp.array(dtype=wp.vec3), value: float, v: wp.vec3, distance: float, tolerance: float
):  # fmt: skip
    """1 if a face may come nearer within the interval: neither the motion radii nor GJK's plane rule it out; else 0."""
    low = value - body.travel
    if value > 0.0 and low < distance - tolerance:
        n_hat = v / wp.length(v)
        low = swept_body(world, body, n_hat, body.second, body.third)
        low = low - wp.dot(n_hat, support(triangle_shape(0), tri, n_hat))
    return wp.where(low < distance - tolerance, 1, 0)


# For each face of the piece, with D the distance known so far and tol the tolerance:
#
# 1. the ball about the face: wholly behind the plane (n, beyond) that the body keeps to, by D - tol, or farther than D - tol
#    along the whole interval, it is settled; it may come nearer, but not in the middle: that is left to the interval's halves
#    (WAITS);
# 2. GJK of body and triangle. It is asked no further than what decides: max(limit, D);
# 3. a box or cylinder that meets the triangle is asked again as a core that is smaller by t all around and grown by t:
#    GJK measures how far they are apart, so the core's distance less t is the overlap, while that is below t. Where an
#    overlap is known already only deeper ones count, and the first question is left out;
# 4. may the face come nearer within the interval than D - tol? First as far as the motion radii allow, value - travel; then along
#    the plane that GJK found (plan/edge.py), whose slack falls with the square of the interval's length.
@wp.func
def nearest_to_mesh(
    world: World, mesh: HandMesh, body: MovingBody, hand: int, piece: int, n: wp.vec3, beyond: float,
    best: float, tolerance: float, tri: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Signed distance of a body to the triangles of one piece when below `best`, and the hand's nearest point.

    Separated: GJK's lower bound. A box or cylinder that a triangle meets is asked once more as its `rounded` core, grown
    by t: the distance to the core less t measures how deep they meet, down to -t.
    """
    out = HandDistance()
    out.distance = best
    b = triangle_shape(0)
    shape = body.shape
    edged = is_edged(shape)
    # 64 faces at a time: most are settled all at once
    start = int(mesh.piece_face[piece])
    after = mesh.piece_face[piece + 1]
    left = wp.uint64(0)
    face = int(start)
    while start < after or left != wp.uint64(0):
        if left == wp.uint64(0):
            face = start
            left = balls_in_reach(
                mesh.face_ball, hand * mesh.n_faces + face, wp.min(64, after - face),
                body.shape.kind, body.shape.size, body.shape.radius, body.R, body.p,
                out.distance - tolerance + body.travel, n, beyond, out.distance - tolerance,
            )  # fmt: skip
            start += 64
            continue
        at = face + lowest_bit(left)
        left = left & (left - wp.uint64(1))
        ball = mesh.face_ball[hand * mesh.n_faces + at]
        if beyond - wp.dot(n, wp.vec3(ball[0], ball[1], ball[2])) - ball[3] >= out.distance - tolerance:
            continue
        bound = bound_of_face(world, body, ball, out.distance, tolerance, out.open)
        if bound == WAITS:
            out.open = 1
        if bound != ASK:
            continue
        center = wp.vec3(ball[0], ball[1], ball[2])
        limit = out.distance - tolerance + body.travel
        triangle_points(mesh, hand, at, tri)
        shape = body.shape
        for attempt in range(2):  # as it is, then as its core
            if attempt == 0 and body.travel == 0.0 and out.distance < 0.0 and edged:
                shape = rounded(shape.kind, shape.size)  # only faces that meet it matter any more: at once how deep
                continue
            d = gjk(shape, body.R, body.p, world.points, b, tri, center, wp.max(limit, out.distance), 0.0)
            if attempt == 0 and d.upper <= TOUCH_M and edged:
                shape = rounded(shape.kind, shape.size)  # they meet: once more for how deep
                continue
            value = face_distance(d.lower, d.upper, shape.radius, attempt)
            if value < out.distance:
                out.distance = value
                out.point = point_of_face(d.point, d.v, tri)
                out.changed = 1
            if out.open == 0:
                out.open = face_may_come_nearer(world, body, tri, value, d.v, out.distance, tolerance)
            break
    return out


# Shapes from the coarse to the fine, each asked only what the one before left open. D is the smallest distance so far:
#
#     link (capsule)  against the ball about the hand      D(link) - travel >= D - tol: all its bodies are settled
#     body            against that ball                     `bound_of_hand`
#     body            against each piece, ball then hull    `bound_of_piece`
#     body            against each face, ball then triangle `nearest_to_mesh`
#
# A bound says SETTLED, WAITS (only within the interval, not in its middle), ASK or MEETS. A body keeps its bit in `mask`
# exactly when something of it waits: then the caller halves the interval. Hulls enclose the mesh and are larger: a body in a
# hull that is clear of all faces stands in a hollow of the hand, or wholly within it, which a ray decides (`inside_mesh`).
@wp.func
def posture_distance(
    world: World, mesh: HandMesh, bodies: TrialBodies, trial: int, q: vecq, d: vecq, best: float,
    tolerance: float,
    mask: wp.array(dtype=wp.uint64),  # bit b: robot body b may come nearer within q +- d; cleared here
    R: wp.array(dtype=wp.mat33),  # (7,) scratch: link frames
    p: wp.array(dtype=wp.vec3),
    w: wp.array(dtype=wp.vec3),  # (FIELDS,) scratch: link twists and how they change
    v: wp.array(dtype=wp.vec3),
    tri: wp.array(dtype=wp.vec3),  # (3,) scratch: a face
):  # fmt: skip
    """Improves the smallest distance with posture q; `mask` keeps the bodies that may come nearer within q +- d.

    A link, then a body against the ball around the hand; a body against each piece, ball and hull; against each face of
    the pieces that are left, ball and triangle. At every step the inequalities of plan/edge.py, with what is known less
    the tolerance in place of the margin: D - travel >= known - tolerance settles a pair for the whole interval.
    """
    out = HandDistance()
    out.distance = best
    out.body = -1
    forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q, R, p)
    twists(d, R, p, w, v)
    hand = bodies.hand[trial]
    for link in range(OBJECT):
        lo = world.link_first[link]
        hi = world.link_first[link + 1]
        bits = ((wp.uint64(1) << wp.uint64(hi)) - wp.uint64(1)) & ~((wp.uint64(1) << wp.uint64(lo)) - wp.uint64(1))
        if (mask[0] & bits) == wp.uint64(0):
            continue
        Rk = R[link_frame(link)]
        pk = p[link_frame(link)]
        c0 = Rk * world.link_c0[link] + pk
        c1 = Rk * world.link_c1[link] + pk
        if link_is_clear(world, hand, link, c0, c1, d, out.distance, tolerance):
            mask[0] = mask[0] & ~bits
            continue
        for b in range(lo, hi):
            bit = wp.uint64(1) << wp.uint64(b)
            if (mask[0] & bit) == wp.uint64(0):
                continue
            body = moving_body(world, bodies, trial, link, b, d, True, R, p, w, v)
            core = rounded(body.shape.kind, body.shape.size)
            waits = int(0)
            hulls_met = int(0)
            bound = bound_of_hand(world, body, hand, out.distance, tolerance)
            if bound == WAITS:
                waits = 1
            if bound == ASK and -core.radius < out.distance - tolerance:  # it cannot be met deeper than that
                # most pieces are settled all at once
                left = wp.uint64(0)
                if body.travel == 0.0:  # a posture alone
                    left = balls_within(
                        world.piece_center, world.piece_radius, hand * world.n_pieces, world.n_pieces,
                        body.c0, body.c1, body.radius, out.distance - tolerance,
                    )  # fmt: skip
                else:
                    left = balls_near(
                        world.piece_center, world.piece_radius, hand * world.n_pieces, world.n_pieces,
                        body.c0, body.c1, body.radius, body.travel,
                        body.w, body.v, body.a, body.b, body.second, body.third,
                        1, out.distance - tolerance, tolerance,
                    )  # fmt: skip
                while left != wp.uint64(0):
                    i = lowest_bit(left)
                    left = left & (left - wp.uint64(1))
                    bound, n, beyond = bound_of_piece(world, body, core, hand, i, out.distance, tolerance, waits)
                    if bound == WAITS:
                        waits = 1
                    if bound < ASK:
                        continue
                    near = nearest_to_mesh(world, mesh, body, hand, i, n, beyond, out.distance, tolerance, tri)
                    if near.changed == 1:
                        out.distance = near.distance
                        out.point = near.point
                        out.body = b
                        out.changed = 1
                    if near.open > 0:
                        waits = 1
                    if bound == MEETS:
                        hulls_met = 1
            # in a hull but clear of all faces: in a hollow of the mesh, or wholly inside the hand
            if hulls_met == 1 and out.distance > 0.0 and inside_mesh(mesh, hand, body.p, tri):
                out.distance = wp.min(-out.distance, -TOUCH_M)
                out.inside = 1
                if out.body != b:
                    out.point = body.p  # no face was nearer than what was already known: the body's own middle
                out.body = b
                out.changed = 1
                waits = 1
            if waits == 0:
                mask[0] = mask[0] & ~bit
    if mask[0] != wp.uint64(0):
        out.open = 1
    return out
