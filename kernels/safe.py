"""Safe: smallest distance between the robot and the hand's exact mesh along a path (branch and bound over time).

The hand's convex pieces enclose the mesh: a body that keeps clear of a piece's hull keeps clear of its triangles, so hulls
and bounding volumes prune, and triangles decide.
"""

import warp as wp

from r2h_batch.kernels.body import BOX, CYLINDER, HULL, Body, from_ball, support, swept_support
from r2h_batch.kernels.gjk import gjk
from r2h_batch.kernels.hand_mesh import HandMesh, inside_mesh, triangle_points
from r2h_batch.kernels.region import signed_distance
from r2h_batch.kernels.world import (
    OBJECT,
    TrialBodies,
    World,
    body_pose,
    curvature,
    forward_kinematics,
    from_point,
    hull_body,
    link_frame,
    motion,
    robot_body,
    twists,
    vec6,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 0})  # unrolled, the code outgrows every cache

MAX_LEVEL = wp.constant(15)
SLACK_M = wp.constant(0.03)
HAND_SLACK_M = wp.constant(0.06)
"""A ball about a piece rarely understates a distance by more: pairs that would need it wait for shorter stretches."""
TOUCH_M = wp.constant(1.0e-6)
"""Bodies nearer than this count as touching: GJK's rounding allowance."""


@wp.struct
class Nearest:
    """Signed distance so far, the robot body it belongs to, and the hand's point nearest to that body (hand frame)."""

    distance: float
    body: int
    point: wp.vec3
    changed: int
    open: int


@wp.func
def eroded(body: Body):
    """The body with its core shrunk by its own smallest half extent, which becomes its radius: measures overlap."""
    e = body
    if body.kind == BOX:
        t = wp.min(body.size[0], wp.min(body.size[1], body.size[2]))
        e.size = body.size - wp.vec3(t, t, t)
        e.radius = t
    elif body.kind == CYLINDER:
        t = wp.min(body.size[0], body.size[1])
        e.size = wp.vec3(body.size[0] - t, body.size[1] - t, 0.0)
        e.radius = t
    return e


@wp.func
def nearest_to_mesh(
    world: World,
    mesh: HandMesh,
    hand: int,
    piece: int,
    body: Body,
    R: wp.mat33,
    p: wp.vec3,
    w: wp.vec3,  # the body's twist over the stretch, how far its levers let it move, its path's curvature
    v: wp.vec3,
    moves: float,
    bend: float,
    best: float,
    tolerance: float,
    tri: wp.array(dtype=wp.vec3),
):
    """Signed distance of a body to the triangles of one piece when below `best`, and the hand's nearest point.

    `open` counts triangles that may come nearer than `best` within the stretch.
    """
    out = Nearest()
    out.distance = best
    b = Body()
    b.kind = HULL
    b.start = 0
    b.count = 3
    for face in range(mesh.piece_face[piece], mesh.piece_face[piece + 1]):
        ball = mesh.face_ball[hand * mesh.n_faces + face]
        center = wp.vec3(ball[0], ball[1], ball[2])
        toward = from_ball(body, wp.transpose(R) * (center - p))  # in the body's frame
        far = wp.length(toward)
        apart = far - ball[3]
        limit = out.distance - tolerance + moves
        if far == 0.0:  # a centre inside the body: no point of the face is deeper than this
            deepest = signed_distance(body.kind, body.size, wp.transpose(R) * (center - p)) - ball[3] - TOUCH_M
            apart = wp.where(deepest >= limit, deepest, -1.0e30)
        if apart >= limit:
            continue
        if apart >= out.distance:
            if out.open > 0:
                continue  # the stretch has to be halved anyway
            n_hat = R * (toward / far)
            low = swept_support(body, R, p, world.points, n_hat, w, v, bend) - wp.dot(n_hat, center) - ball[3]
            if low >= out.distance - tolerance:
                continue
            if low + 2.0 * ball[3] < out.distance - tolerance:  # GJK cannot add more than that
                out.open += 1
                continue
        triangle_points(mesh, hand, face, tri)
        shape = body
        for attempt in range(2):
            if attempt == 0 and moves == 0.0 and out.distance < 0.0 and (body.kind == BOX or body.kind == CYLINDER):
                shape = eroded(body)  # only faces that meet it matter any more: at once how deep
                continue
            d = gjk(shape, R, p, world.points, b, tri, center, wp.max(limit, out.distance), 0.0)
            value = wp.max(d.lower, -shape.radius)
            if attempt == 0 and d.upper <= TOUCH_M and (body.kind == BOX or body.kind == CYLINDER):
                shape = eroded(body)  # they meet: once more for how deep
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
            low = value - moves
            if value > 0.0 and low < out.distance - tolerance:
                n_hat = d.v / wp.length(d.v)
                low = swept_support(body, R, p, world.points, n_hat, w, v, bend) - wp.dot(n_hat, support(b, tri, n_hat))
            if low < out.distance - tolerance:
                out.open += 1
            break
    return out


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
    mask: wp.array(dtype=wp.uint64),
    R: wp.array(dtype=wp.mat33),
    p: wp.array(dtype=wp.vec3),
    w: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    tri: wp.array(dtype=wp.vec3),
):
    """Improves the smallest distance with posture q; `mask` keeps the bodies that may come nearer within q +- d."""
    out = Nearest()
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
            Rb, pb = body_pose(world, bodies, trial, R, p, b)
            axis = Rb * world.cap_axis[b]
            rb = world.cap_radius[b]
            m = motion(world.lever, b, 0, d)
            bend = curvature(world.lever, b, 0, d)
            wb = w[link_frame(link)]
            vb = v[link_frame(link)]
            shape = robot_body(world, b)
            core = eroded(shape)
            still = int(0)
            hulls_met = int(0)
            toward = from_point(world.hand_center[hand], pb - axis, pb + axis)
            far = wp.length(toward)
            apart = far - world.hand_radius[hand] - rb
            near_hand = apart < out.distance - tolerance + m
            if near_hand and apart > out.distance:
                n_hat = toward / far
                low = swept_support(shape, Rb, pb, world.points, n_hat, wb, vb, bend)
                low = low - wp.dot(n_hat, world.hand_center[hand]) - world.hand_radius[hand]
                if low >= out.distance - tolerance:
                    near_hand = False
                elif low + HAND_SLACK_M < out.distance - tolerance:
                    near_hand = False
                    still = 1
            if near_hand and -core.radius < out.distance - tolerance:  # it cannot be met deeper than that
                size = wp.length(axis) + rb
                for i in range(world.n_pieces):
                    piece = hand * world.n_pieces + i
                    limit = out.distance - tolerance + m
                    center = world.piece_center[piece]
                    if wp.length(center - pb) - world.piece_radius[piece] - size >= limit:
                        continue
                    toward = Rb * from_ball(shape, wp.transpose(Rb) * (center - pb))
                    far = wp.length(toward)
                    apart = far - world.piece_radius[piece]
                    if far == 0.0:
                        at = wp.transpose(Rb) * (center - pb)
                        deepest = signed_distance(shape.kind, shape.size, at) - world.piece_radius[piece] - TOUCH_M
                        apart = wp.where(deepest >= limit, deepest, -1.0e30)
                    if apart >= limit:
                        continue
                    if apart >= out.distance:
                        if still == 1:
                            continue
                        n_hat = toward / far
                        low = swept_support(shape, Rb, pb, world.points, n_hat, wb, vb, bend) - wp.dot(n_hat, center)
                        low = low - world.piece_radius[piece]
                        if low >= out.distance - tolerance:
                            continue
                        if low + SLACK_M < out.distance - tolerance:
                            still = 1
                            continue
                    hull = hull_body(world.piece_start, piece)
                    h = gjk(
                        shape, Rb, pb, world.points, hull, world.points, world.piece_center[piece],
                        wp.max(limit, out.distance), 0.05,
                    )  # fmt: skip
                    met = h.upper <= TOUCH_M  # then GJK's bound says nothing of how deep: the faces have to
                    if met and out.distance < 0.0:  # unless the whole piece is no deeper than what is known
                        deep = gjk(
                            core, Rb, pb, world.points, hull, world.points, world.piece_center[piece], limit, 0.05
                        )
                        if deep.lower >= limit:
                            continue
                    if not met and (h.lower >= limit or (still == 1 and h.lower >= out.distance)):
                        continue
                    low = h.lower - m
                    if not met and h.lower > 0.0:
                        n_hat = h.v / wp.length(h.v)
                        beside = wp.dot(n_hat, support(hull, world.points, n_hat))
                        low = wp.max(low, swept_support(shape, Rb, pb, world.points, n_hat, wb, vb, bend) - beside)
                    if not met and low >= out.distance - tolerance and h.lower >= out.distance:
                        continue
                    if not met and h.lower >= out.distance and h.lower < out.distance - tolerance + 0.5 * bend:
                        still = 1  # too long a stretch to settle here, and nothing nearer in its middle
                        continue
                    near = nearest_to_mesh(
                        world, mesh, hand, i, shape, Rb, pb, wb, vb, m, bend,
                        out.distance, tolerance, tri,
                    )  # fmt: skip
                    if near.changed == 1:
                        out.distance = near.distance
                        out.point = near.point
                        out.body = b
                        out.changed = 1
                    if near.open > 0:
                        still = 1
                    if met:
                        hulls_met = 1
            # in a hull but clear of all faces: in a hollow of the mesh, or wholly inside the hand
            if hulls_met == 1 and out.distance > 0.0 and inside_mesh(mesh, hand, pb, tri):
                out.distance = wp.min(-out.distance, -TOUCH_M)
                if out.body != b:
                    out.point = pb  # no face of the hand was nearer than what was already known: the body's own middle
                out.body = b
                out.changed = 1
                still = 1
            if still == 0:
                mask[0] = mask[0] & ~bit
    if mask[0] != wp.uint64(0):
        out.open = 1
    return out


@wp.kernel
def safe_distance(
    first: int,
    cap: float,
    tolerance: float,
    world: World,
    mesh: HandMesh,
    bodies: TrialBodies,
    path_in: wp.array3d(dtype=float),  # (B, W, 6)
    length_in: wp.array(dtype=int),
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
    w = wp.zeros(shape=7, dtype=wp.vec3)
    v = wp.zeros(shape=7, dtype=wp.vec3)
    mask = wp.zeros(shape=1, dtype=wp.uint64)
    stack = wp.zeros(shape=16, dtype=wp.uint64)
    everything = (wp.uint64(1) << wp.uint64(world.n_robot)) - wp.uint64(1)
    best = float(cap)
    body = int(-1)
    segment = int(n - 2)
    fraction = float(1.0)
    point = wp.vec3(0.0, 0.0, 0.0)
    # step 0 is the goal posture alone, step k > 0 the k-th segment from the end
    for step in range(n):
        i = wp.max(n - 1 - wp.max(step, 1), 0)
        a = vec6()
        delta = vec6()
        for j in range(6):
            a[j] = path_in[trial, i, j]
            delta[j] = path_in[trial, i + 1, j] - a[j]
        stack[0] = everything
        level = int(0)
        index = int(0)
        running = bool(True)
        while running:
            half = 1.0 / float(2 << level)
            t = float(2 * index + 1) * half
            d = half * delta
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
                level += 1
                index = 2 * index
                stack[level] = mask[0]
            else:
                while level > 0 and (index & 1) == 1:
                    index = index >> 1
                    level -= 1
                if level == 0:
                    running = False
                else:
                    index += 1
    distance_out[trial] = best
    body_out[trial] = body
    segment_out[trial] = segment
    fraction_out[trial] = fraction
    point_out[trial] = wp.transpose(bodies.R_hand_world[trial]) * (point - bodies.p_hand_world[trial])
