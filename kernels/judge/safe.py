"""Safe: smallest distance between the robot and the hand's exact mesh along a path (branch and bound over time).

The hand's convex pieces enclose the mesh: a body that keeps clear of a piece's hull keeps clear of its triangles, so hulls
and bounding volumes prune, and triangles decide.
"""

import warp as wp

from r2h_batch.kernels.geometry.balls import balls_near, lowest_bit
from r2h_batch.kernels.geometry.body import BOX, CYLINDER, HULL, Body, from_ball, support
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.hand_mesh import HandMesh, inside_mesh, triangle_points
from r2h_batch.kernels.geometry.primitives import TOUCH_M, rounded, signed_distance
from r2h_batch.kernels.geometry.segments import from_point
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.bisection import MAX_LEVEL, descend, half_width, middle, next_stretch
from r2h_batch.kernels.plan.edge import PART_RAD
from r2h_batch.kernels.plan.partners import Mover, least_rest, swept_mover
from r2h_batch.kernels.robot.posture import load_waypoint
from r2h_batch.kernels.robot.world import (
    CHANGES,
    FIELDS,
    OBJECT,
    TrialBodies,
    World,
    bends,
    body_pose,
    forward_kinematics,
    link_frame,
    motion,
    piece_body,
    robot_body,
    twists,
    vec6,
)

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache

SLACK_M = wp.constant(0.03)
HAND_SLACK_M = wp.constant(0.06)
"""A ball about a piece rarely understates a distance by more: pairs that would need it wait for shorter stretches."""


# What a bound says of a robot body and a part of the hand (all of it, a piece, a face) over a stretch of motion.
SETTLED = wp.constant(0)  # the part comes no nearer than what is known, by more than the tolerance
WAITS = wp.constant(1)  # it may, though not in the middle of the stretch: its halves will tell
ASK = wp.constant(2)  # it may be nearer even in the middle: look closer
MEETS = wp.constant(3)  # it meets the body in the middle: look how deep


@wp.struct
class HandDistance:
    """Signed distance so far, the robot body it belongs to, and the hand's point nearest to that body (hand frame)."""

    distance: float
    body: int
    point: wp.vec3
    changed: int  # 1: this call found something nearer
    open: int  # 1: something may come nearer within the stretch


@wp.func
def _robot_mover(
    world: World, bodies: TrialBodies, trial: int, link: int, b: int, d: vec6,
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), w: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Body b of a link, its twist over the stretch, how far its levers let it travel, how its path bends."""
    out = Mover()
    out.link = link
    out.body = b
    out.shape = robot_body(world, b)
    Rb, pb = body_pose(world, bodies, trial, R, p, b)
    out.R = Rb
    out.p = pb
    axis = Rb * world.cap_axis[b]
    out.c0 = pb - axis
    out.c1 = pb + axis
    out.radius = world.cap_radius[b]
    out.travel = motion(world.lever, b, 0, d)
    second, third = bends(world.lever, b, 0, d)
    out.second = second
    out.third = third
    out.w = w[link_frame(link)]
    out.v = v[link_frame(link)]
    out.a = w[CHANGES + link_frame(link)]
    out.b = v[CHANGES + link_frame(link)]
    return out


@wp.func
def _bound_of_hand(world: World, mover: Mover, hand: int, distance: float, tolerance: float):
    """SETTLED, WAITS or ASK, from the ball around the whole hand and the body's bounding capsule."""
    center = world.hand_center[hand]
    toward = from_point(center, mover.c0, mover.c1)
    far = wp.length(toward)
    apart = far - world.hand_radius[hand] - mover.radius
    if apart >= distance - tolerance + mover.travel:
        return SETTLED
    if apart > distance:
        n_hat = toward / far
        low = swept_mover(world, mover, n_hat, mover.second, mover.third)
        low = low - wp.dot(n_hat, center) - world.hand_radius[hand]
        if low >= distance - tolerance:
            return SETTLED
        if low + HAND_SLACK_M < distance - tolerance:
            return WAITS
    return ASK


# From the coarse to the fine, with D the distance known so far, tol the tolerance, travel what the levers allow:
#
# 1. the piece's ball against the body's ball, then against the body itself: farther than D - tol + travel, it is settled;
# 2. not nearer than D in the middle: the swept bound along the way to the ball's centre. Enough: settled. Short by more than
#    a ball understates a distance (SLACK_M): GJK would not settle it either, it waits for the stretch's halves;
# 3. GJK of body and hull. They meet: the faces have to say how deep, unless the whole piece is clear of the body's core grown
#    by what is known;
# 4. along the plane that GJK found, over the whole stretch. What is left: the faces, or, if nothing is nearer in the middle
#    and the plane could not have settled it (`least_rest`), the halves.
@wp.func
def _bound_of_piece(
    world: World,
    mover: Mover,
    core: Body,
    hand: int,
    i: int,
    distance: float,
    tolerance: float,
    waits: int,
):
    """SETTLED, WAITS, ASK or MEETS, from the piece's ball, then from its hull, which holds all its faces.

    With ASK also a direction n and how far along it the body stays over the whole stretch (n . x at least `beyond`): most
    faces of a piece lie behind its hull, and are settled by that alone.
    """
    piece = hand * world.n_pieces + i
    n = wp.vec3(0.0, 0.0, 0.0)
    beyond = float(-1.0e30)
    limit = distance - tolerance + mover.travel
    center = world.piece_center[piece]
    size = wp.length(mover.R * world.cap_axis[mover.body]) + mover.radius
    if wp.length(center - mover.p) - world.piece_radius[piece] - size >= limit:
        return SETTLED, n, beyond
    at = wp.transpose(mover.R) * (center - mover.p)
    toward = mover.R * from_ball(mover.shape, at)
    far = wp.length(toward)
    apart = far - world.piece_radius[piece]
    if far == 0.0:  # the ball's centre is in the body: no point of the piece is deeper than this
        deepest = signed_distance(mover.shape.kind, mover.shape.size, at) - world.piece_radius[piece] - TOUCH_M
        apart = wp.where(deepest >= limit, deepest, -1.0e30)
    if apart >= limit:
        return SETTLED, n, beyond
    if apart >= distance:
        if waits == 1:
            return WAITS, n, beyond
        n_hat = toward / far
        low = swept_mover(world, mover, n_hat, mover.second, mover.third)
        low = low - wp.dot(n_hat, center)
        low = low - world.piece_radius[piece]
        if low >= distance - tolerance:
            return SETTLED, n, beyond
        if low + SLACK_M < distance - tolerance:
            return WAITS, n, beyond

    hull = piece_body(world, piece)
    h = gjk(mover.shape, mover.R, mover.p, world.points, hull, world.points, center, wp.max(limit, distance), 0.05)
    if h.upper <= TOUCH_M:  # GJK's bound says nothing of how deep: the faces have to
        if distance < 0.0:  # unless the whole piece is no deeper than what is known
            deep = gjk(core, mover.R, mover.p, world.points, hull, world.points, center, limit, 0.05)
            if deep.lower >= limit:
                return SETTLED, n, beyond
        return MEETS, n, beyond
    if h.lower >= limit or (waits == 1 and h.lower >= distance):
        return SETTLED, n, beyond
    low = h.lower - mover.travel
    rest = least_rest(mover.second, mover.third)
    if h.lower > 0.0:
        n = h.v / wp.length(h.v)
        beyond = swept_mover(world, mover, n, mover.second, mover.third)
        low = wp.max(low, beyond - wp.dot(n, support(hull, world.points, n)))
    if low >= distance - tolerance and h.lower >= distance:
        return SETTLED, n, beyond
    if h.lower >= distance and h.lower < distance - tolerance + rest:
        return WAITS, n, beyond  # too long a stretch to settle here, and nothing nearer in its middle
    return ASK, n, beyond


@wp.func
def _bound_of_face(world: World, mover: Mover, ball: wp.vec4, distance: float, tolerance: float, waits: int):
    """SETTLED, WAITS or ASK, from the ball around a face."""
    center = wp.vec3(ball[0], ball[1], ball[2])
    at = wp.transpose(mover.R) * (center - mover.p)
    toward = from_ball(mover.shape, at)  # in the body's frame
    far = wp.length(toward)
    apart = far - ball[3]
    limit = distance - tolerance + mover.travel
    if far == 0.0:  # a centre inside the body: no point of the face is deeper than this
        deepest = signed_distance(mover.shape.kind, mover.shape.size, at) - ball[3] - TOUCH_M
        apart = wp.where(deepest >= limit, deepest, -1.0e30)
    if apart >= limit:
        return SETTLED
    if apart >= distance:
        if waits == 1:
            return WAITS
        n_hat = mover.R * (toward / far)
        low = swept_mover(world, mover, n_hat, mover.second, mover.third)
        low = low - wp.dot(n_hat, center) - ball[3]
        if low >= distance - tolerance:
            return SETTLED
        if low + 2.0 * ball[3] < distance - tolerance:  # GJK cannot add more than that
            return WAITS
    return ASK


# For each face of the piece, with D the distance known so far and tol the tolerance:
#
# 1. the ball about the face: wholly behind the plane (n, beyond) that the body keeps to, by D - tol, or farther than D - tol
#    along the whole stretch, it is settled; it may come nearer, but not in the middle: that is left to the stretch's halves
#    (WAITS);
# 2. GJK of body and triangle. It is asked no further than what decides: max(limit, D);
# 3. a box or cylinder that meets the triangle is asked again as a core that is smaller by t all around and grown by t:
#    GJK measures how far they are apart, so the core's distance less t is the overlap, while that is below t. Where an
#    overlap is known already only deeper ones count, and the first question is left out;
# 4. may the face come nearer within the stretch than D - tol? First as far as the levers allow, value - travel; then along
#    the plane that GJK found (plan/edge.py), whose slack falls with the square of the stretch's length.
@wp.func
def nearest_to_mesh(
    world: World,
    mesh: HandMesh,
    mover: Mover,
    hand: int,
    piece: int,
    n: wp.vec3,
    beyond: float,
    best: float,
    tolerance: float,
    tri: wp.array(dtype=wp.vec3),
):
    """Signed distance of a body to the triangles of one piece when below `best`, and the hand's nearest point.

    Separated: GJK's lower bound. A box or cylinder that a triangle meets is asked once more as its `rounded` core, grown
    by t: the distance to the core less t measures how deep they meet, down to -t.
    """
    out = HandDistance()
    out.distance = best
    b = Body()
    b.kind = HULL
    b.start = 0
    b.count = 3
    shape = mover.shape
    edged = shape.kind == BOX or shape.kind == CYLINDER
    for face in range(mesh.piece_face[piece], mesh.piece_face[piece + 1]):
        ball = mesh.face_ball[hand * mesh.n_faces + face]
        if beyond - wp.dot(n, wp.vec3(ball[0], ball[1], ball[2])) - ball[3] >= out.distance - tolerance:
            continue
        bound = _bound_of_face(world, mover, ball, out.distance, tolerance, out.open)
        if bound == WAITS:
            out.open = 1
        if bound != ASK:
            continue
        center = wp.vec3(ball[0], ball[1], ball[2])
        limit = out.distance - tolerance + mover.travel
        triangle_points(mesh, hand, face, tri)
        shape = mover.shape
        for attempt in range(2):  # as it is, then as its core
            if attempt == 0 and mover.travel == 0.0 and out.distance < 0.0 and edged:
                shape = rounded(shape.kind, shape.size)  # only faces that meet it matter any more: at once how deep
                continue
            d = gjk(shape, mover.R, mover.p, world.points, b, tri, center, wp.max(limit, out.distance), 0.0)
            value = wp.max(d.lower, -shape.radius)
            if attempt == 0 and d.upper <= TOUCH_M and edged:
                shape = rounded(shape.kind, shape.size)  # they meet: once more for how deep
                continue
            if attempt == 1 or d.upper <= TOUCH_M:
                value = wp.min(value, -TOUCH_M)
            if value < out.distance:
                out.distance = value
                out.point = d.point - d.v
                if wp.dot(d.v, d.v) == 0.0:  # through the core: any point of the face is a witness
                    out.point = (tri[0] + tri[1] + tri[2]) / 3.0
                out.changed = 1
            if out.open > 0:
                break
            # may the face come nearer within the stretch? As the levers allow, then along the plane GJK found
            low = value - mover.travel
            if value > 0.0 and low < out.distance - tolerance:
                n_hat = d.v / wp.length(d.v)
                low = swept_mover(world, mover, n_hat, mover.second, mover.third)
                low = low - wp.dot(n_hat, support(b, tri, n_hat))
            if low < out.distance - tolerance:
                out.open = 1
            break
    return out


# Shapes from the coarse to the fine, each asked only what the one before left open. D is the smallest distance so far:
#
#     link (capsule)  against the ball about the hand      D(link) - travel >= D - tol: all its bodies are settled
#     body            against that ball                     `_bound_of_hand`
#     body            against each piece, ball then hull    `_bound_of_piece`
#     body            against each face, ball then triangle `nearest_to_mesh`
#
# A bound says SETTLED, WAITS (only within the stretch, not in its middle), ASK or MEETS. A body keeps its bit in `mask`
# exactly when something of it waits: then the caller halves the stretch. Hulls enclose the mesh and are larger: a body in a
# hull that is clear of all faces stands in a hollow of the hand, or wholly within it, which a ray decides (`inside_mesh`).
@wp.func
def posture_distance(
    world: World,
    mesh: HandMesh,
    bodies: TrialBodies,
    trial: int,
    q: vec6,
    d: vec6,
    best: float,
    tolerance: float,
    mask: wp.array(dtype=wp.uint64),  # bit b: robot body b may come nearer within q +- d; cleared here
    R: wp.array(dtype=wp.mat33),  # (7,) scratch: link frames
    p: wp.array(dtype=wp.vec3),
    w: wp.array(dtype=wp.vec3),  # (FIELDS,) scratch: link twists and how they change
    v: wp.array(dtype=wp.vec3),
    tri: wp.array(dtype=wp.vec3),  # (3,) scratch: a face
):
    """Improves the smallest distance with posture q; `mask` keeps the bodies that may come nearer within q +- d.

    A link, then a body against the ball around the hand; a body against each piece, ball and hull; against each face of
    the pieces that are left, ball and triangle. At every step the inequalities of plan/edge.py, with what is known less
    the tolerance in place of the margin: D - travel >= known - tolerance settles a pair for the whole stretch.
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
        toward = from_point(world.hand_center[hand], Rk * world.link_c0[link] + pk, Rk * world.link_c1[link] + pk)
        apart = wp.length(toward) - world.hand_radius[hand] - world.link_radius[link]
        if apart >= out.distance - tolerance + motion(world.link_lever, link, 0, d):
            mask[0] = mask[0] & ~bits
            continue
        for b in range(lo, hi):
            bit = wp.uint64(1) << wp.uint64(b)
            if (mask[0] & bit) == wp.uint64(0):
                continue
            mover = _robot_mover(world, bodies, trial, link, b, d, R, p, w, v)
            core = rounded(mover.shape.kind, mover.shape.size)
            waits = int(0)
            hulls_met = int(0)
            bound = _bound_of_hand(world, mover, hand, out.distance, tolerance)
            if bound == WAITS:
                waits = 1
            if bound == ASK and -core.radius < out.distance - tolerance:  # it cannot be met deeper than that
                # most pieces are settled all at once
                left = balls_near(
                    world.piece_center, world.piece_radius, hand * world.n_pieces, world.n_pieces,
                    mover.c0, mover.c1, mover.radius, mover.travel,
                    mover.w, mover.v, mover.a, mover.b, mover.second, mover.third,
                    1, out.distance - tolerance, tolerance,
                )  # fmt: skip
                while left != wp.uint64(0):
                    i = lowest_bit(left)
                    left = left & (left - wp.uint64(1))
                    bound, n, beyond = _bound_of_piece(world, mover, core, hand, i, out.distance, tolerance, waits)
                    if bound == WAITS:
                        waits = 1
                    if bound < ASK:
                        continue
                    near = nearest_to_mesh(world, mesh, mover, hand, i, n, beyond, out.distance, tolerance, tri)
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
            if hulls_met == 1 and out.distance > 0.0 and inside_mesh(mesh, hand, mover.p, tri):
                out.distance = wp.min(-out.distance, -TOUCH_M)
                if out.body != b:
                    out.point = mover.p  # no face was nearer than what was already known: the body's own middle
                out.body = b
                out.changed = 1
                waits = 1
            if waits == 0:
                mask[0] = mask[0] & ~bit
    if mask[0] != wp.uint64(0):
        out.open = 1
    return out


# Branch and bound over time. `best` is an upper bound of the smallest distance, taken at postures, and falls; a stretch of
# the path is dropped as soon as none of its postures can be below `best` less what is allowed:
#
# 1. the goal posture alone (step 0), which is nearest of all most of the time;
# 2. the segments from the last to the first; each is halved depth first (bisection.py), level and index naming a stretch;
# 3. `stack` keeps per level the bodies that the halves have to look at: what was settled for a stretch is for its halves;
# 4. what is allowed grows with `best`, max(tol, 0.2 %): a distance of 5 cm need not be known to a tenth of a millimetre.
#    Overlaps are located to half their size only: how deep is asked for a slope, not for a verdict.
@wp.kernel
def safe_distance(
    first: int,
    cap: float,
    tolerance: float,
    # tables
    world: World,
    mesh: HandMesh,
    bodies: TrialBodies,
    # trials
    path_in: wp.array3d(dtype=float),  # (B, W, 6)
    length_in: wp.array(dtype=int),  # (B,)
    # out
    distance_out: wp.array(dtype=float),
    body_out: wp.array(dtype=int),
    segment_out: wp.array(dtype=int),
    fraction_out: wp.array(dtype=float),
    point_out: wp.array(dtype=wp.vec3),  # world frame
):
    """Smallest signed robot-hand distance along each path: exact to `tolerance` (or 0.2 %) below `cap`, a lower bound above.

    The goal posture comes first: it is usually the nearest, and prunes the rest. Overlaps are negative and grow with the
    depth of the deepest triangle in a primitive; they are located to half their size.
    """
    trial = first + wp.tid()
    n = length_in[trial]
    if n == 0:
        return
    R = wp.zeros(shape=7, dtype=wp.mat33)
    p = wp.zeros(shape=7, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    w = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    v = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    mask = wp.zeros(shape=1, dtype=wp.uint64)
    stack = wp.zeros(shape=16, dtype=wp.uint64)  # per level of the bisection: the mask that its stretches start from
    everything = (wp.uint64(1) << wp.uint64(world.n_robot)) - wp.uint64(1)
    best = float(cap)
    body = int(-1)
    segment = int(n - 2)
    fraction = float(1.0)
    point = wp.vec3(0.0, 0.0, 0.0)
    # step 0 is the goal posture alone, step k > 0 the k-th segment from the end
    for step in range(n):
        i = wp.max(n - 1 - wp.max(step, 1), 0)
        a = load_waypoint(path_in, trial, i)
        delta = load_waypoint(path_in, trial, i + 1) - a
        length = float(0.0)
        for j in range(6):
            length += wp.abs(delta[j])
        parts = wp.max(int(wp.ceil(length / PART_RAD)), 1)
        part = parts - 1
        one = 1.0 / float(parts)
        stack[0] = everything
        level = int(0)
        index = int(0)
        running = bool(True)
        while running:
            t = (float(part) + middle(level, index)) * one
            d = (half_width(level) * one) * delta
            if step == 0:
                t = 1.0
                d = 0.0 * delta
            mask[0] = stack[level]
            allowed = wp.max(tolerance, wp.where(best < 0.0, -0.5 * best, 0.002 * best))
            found = posture_distance(world, mesh, bodies, trial, a + t * delta, d, best, allowed, mask, R, p, w, v, tri)
            if found.changed == 1:
                best = found.distance
                body = found.body
                segment = i
                fraction = t
                point = found.point
            if step == 0:
                running = False
            elif found.open == 1 and level + 1 < MAX_LEVEL:
                level, index = descend(level, index)
                stack[level] = mask[0]
            else:
                level, index = next_stretch(level, index)
                if level == 0:
                    index = 0
                    part -= 1
                    running = part >= 0
    distance_out[trial] = best
    body_out[trial] = body
    segment_out[trial] = segment
    fraction_out[trial] = fraction
    point_out[trial] = wp.transpose(bodies.R_hand_world[trial]) * (point - bodies.p_hand_world[trial])
