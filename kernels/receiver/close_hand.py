"""A hand coming down on an object and closing its fingers, in the object's distance field. Frames: obj, hand.

Field: signed distance at the nodes of a grid (negative inside), node (i, j, k) at `origin + pitch * (i, j, k)`.
Hand h of the tables has a rest pose without turns; a finger is three rigid segments, each with its own points.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS | {"fuse_fp": True, "max_unroll": 0})  # unrolled, it takes many times as long to compile

ROUNDS = wp.constant(64)
STEPS = wp.constant(90)
STEEPEST = wp.constant(1.7321)
"""How fast `distance` changes at most inside the grid: nodes by no more than one goes, between them along each axis."""
STEEPEST_OUTSIDE = wp.constant(2.0001)
"""The same where some of the way is outside: there the value at the border less the way there, at right angles to it."""
STEP_AT_BORDER_M = wp.constant(1.0e-5)


@wp.struct
class Field:
    """Signed distance of one object on a grid (m)."""

    origin: wp.vec3
    pitch: wp.float32
    nodes: wp.vec3i
    value: wp.array(dtype=wp.float32)


@wp.struct
class ClosingHands:
    """K hands before they close: rest joints and skin, starting turns, how fast and how far each joint flexes."""

    joints: wp.array(dtype=wp.vec3)  # (K * 16) rest
    axes: wp.array(dtype=wp.mat33)  # (16) columns flexion, abduction, bone
    root_turn: wp.array(dtype=wp.mat33)  # (K * 16) abduction and twist, in the joint's own axes
    flexion: wp.array(dtype=wp.float32)  # (K * 16) at the start, rad
    rate: wp.array(dtype=wp.float32)  # (K * 16) share of a step
    limit: wp.array(dtype=wp.float32)  # (16) rad
    skin: wp.array(dtype=wp.vec3)  # (K * n_points) rest, less the rest joint of the point's segment
    cluster: wp.array(dtype=wp.vec4)  # (K * n_clusters) ball about some points, as `skin`: centre, radius
    cluster_first: wp.array(dtype=wp.int32)  # (n_clusters + 1) its points
    segment_first: wp.array(dtype=wp.int32)  # (17) clusters of segment (joint) j: segment_first[j] up to the next
    n_clusters: wp.int32
    n_points: wp.int32
    open_skin: wp.array(dtype=wp.vec3)  # (K * n_open) the whole hand at the start
    open_ball: wp.array(dtype=wp.vec4)  # (K * n_open_balls) about some of its points: centre, radius
    open_first: wp.array(dtype=wp.int32)  # (n_open_balls + 1) these points
    n_open: wp.int32
    n_open_balls: wp.int32


@wp.func
def node(field: Field, i: int, j: int, k: int) -> float:
    """Value at a node."""
    return field.value[(i * field.nodes[1] + j) * field.nodes[2] + k]


@wp.func
def distance(field: Field, p: wp.vec3) -> float:
    """Trilinear inside the grid; a lower bound of the distance outside it."""
    q = (p - field.origin) / field.pitch
    c = wp.vec3(
        wp.clamp(q[0], 0.0, float(field.nodes[0] - 1) - 1.0e-3),
        wp.clamp(q[1], 0.0, float(field.nodes[1] - 1) - 1.0e-3),
        wp.clamp(q[2], 0.0, float(field.nodes[2] - 1) - 1.0e-3),
    )
    i = int(c[0])
    j = int(c[1])
    k = int(c[2])
    u = c[0] - float(i)
    v = c[1] - float(j)
    w = c[2] - float(k)
    low = wp.lerp(
        wp.lerp(node(field, i, j, k), node(field, i, j, k + 1), w),
        wp.lerp(node(field, i, j + 1, k), node(field, i, j + 1, k + 1), w),
        v,
    )
    high = wp.lerp(
        wp.lerp(node(field, i + 1, j, k), node(field, i + 1, j, k + 1), w),
        wp.lerp(node(field, i + 1, j + 1, k), node(field, i + 1, j + 1, k + 1), w),
        v,
    )
    # outside the grid: the value at its border less the way there, or the way itself where that is more
    away = field.pitch * wp.length(q - c)
    inside = wp.lerp(low, high, u)
    if away > 1.0e-3 * field.pitch * 2.0:
        return wp.max(away, inside - away)
    return inside


@wp.kernel
def approach(
    first: int,
    # tables
    field: Field, hands: ClosingHands, farthest: float,
    # trials
    hand_in: wp.array(dtype=wp.int32), R_in: wp.array(dtype=wp.mat33), start_in: wp.array(dtype=wp.vec3),
    direction_in: wp.array(dtype=wp.vec3),
    # out
    travel_out: wp.array(dtype=wp.float32),
):  # fmt: skip
    """How far the open hand moves from `start` along `direction` until it touches: `farthest` where it never does."""
    i = first + wp.tid()
    base = hand_in[i] * hands.n_open
    R = R_in[i]
    travelled = float(0.0)
    nearest = int(0)
    for _ in range(ROUNDS):
        origin = start_in[i] + travelled * direction_in[i]
        # sphere tracing (Hart 1996): no point can touch before it has moved by its distance
        least = float(farthest)
        begin = nearest
        for n in range(hands.n_open_balls):  # from the one that was the nearest on: it rules out most of the others
            c = (begin + n) % hands.n_open_balls
            ball = hands.open_ball[hand_in[i] * hands.n_open_balls + c]
            middle = R * wp.vec3(ball[0], ball[1], ball[2]) + origin
            if distance(field, middle) - STEEPEST_OUTSIDE * ball[3] - STEP_AT_BORDER_M < least:
                for k in range(hands.open_first[c], hands.open_first[c + 1]):
                    d = distance(field, R * hands.open_skin[base + k] + origin)
                    if d < least:
                        least = d
                        nearest = c
        if least < 3.0e-4:
            break
        travelled += least
        if travelled >= farthest:
            travelled = farthest
            break
    travel_out[i] = travelled


@wp.func
def flexed(hands: ClosingHands, hand: int, joint: int, angle: float) -> wp.mat33:
    """Turn of a joint (rest frame) at a flexion."""
    c = wp.cos(angle)
    s = wp.sin(angle)
    A = hands.axes[joint]
    flex = wp.mat33(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c)
    return A * flex * hands.root_turn[hand * 16 + joint] * wp.transpose(A)


@wp.func
def clearance(
    field: Field, hands: ClosingHands, hand: int, root: int, angle: wp.vec3, begin: int, R: wp.mat33,
    p: wp.vec3, most: float,
) -> float:  # fmt: skip
    """Least distance of a finger's segments from `begin` (0, 1, 2) on, `most` where nothing is nearer than that."""
    turn = R
    at = R * hands.joints[hand * 16 + root] + p
    least = float(most)
    for k in range(3):
        joint = root + k
        if k > 0:
            at = turn * (hands.joints[hand * 16 + joint] - hands.joints[hand * 16 + joint - 1]) + at
        turn = turn * flexed(hands, hand, joint, angle[k])
        if k >= begin:
            for c in range(hands.segment_first[joint], hands.segment_first[joint + 1]):
                # no point of a ball is nearer than its centre less this
                ball = hands.cluster[hand * hands.n_clusters + c]
                middle = turn * wp.vec3(ball[0], ball[1], ball[2]) + at
                if distance(field, middle) - STEEPEST * ball[3] < least:
                    for i in range(hands.cluster_first[c], hands.cluster_first[c + 1]):
                        least = wp.min(least, distance(field, turn * hands.skin[hand * hands.n_points + i] + at))
    return least


@wp.kernel
def close_fingers(
    first: int,
    # tables
    field: Field, hands: ClosingHands, step: float, deepest: float, wanted: int,
    # trials
    hand_in: wp.array(dtype=wp.int32), R_in: wp.array(dtype=wp.mat33), p_in: wp.array(dtype=wp.vec3),
    # out
    flexion_out: wp.array2d(dtype=wp.vec3), gap_out: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """Flexion (rad) of a finger's three joints: each turns on until it would press what it moves `deepest` into the object.

    Fingers that are not in bit mask `wanted` are passed over.
    """
    row, f = wp.tid()
    if (wanted >> f) & 1 == 0:
        return
    i = first + row
    hand = hand_in[i]
    R = R_in[i]
    p = p_in[i]
    root = 1 + 3 * f
    angle = wp.vec3(
        hands.flexion[hand * 16 + root], hands.flexion[hand * 16 + root + 1], hands.flexion[hand * 16 + root + 2]
    )
    free = wp.vec3i(1, 1, 1)
    for _ in range(STEPS):
        if free[0] + free[1] + free[2] == 0:
            break
        for k in range(3):
            if free[k] == 1:
                new = angle[k] + step * hands.rate[hand * 16 + root + k]
                tried = wp.vec3(angle)
                tried[k] = new
                stop = new > hands.limit[root + k]
                if not stop:
                    stop = clearance(field, hands, hand, root, tried, k, R, p, -deepest) < -deepest
                if stop:
                    free[k] = 0
                else:
                    angle[k] = new
    flexion_out[i, f] = angle
    gap_out[i, f] = clearance(field, hands, hand, root, angle, 0, R, p, 1.0)


@wp.kernel
def field_distance(
    first: int, field: Field, point_in: wp.array(dtype=wp.vec3), distance_out: wp.array(dtype=wp.float32)
):
    """`distance` of points."""
    i = first + wp.tid()
    distance_out[i] = distance(field, point_in[i])
