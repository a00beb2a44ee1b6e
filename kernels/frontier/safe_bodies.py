"""Which bodies, and which pieces of the hand, bounding volumes cannot settle in Safe: judge/hand_distance.py, coarse to fine."""

import warp as wp

from r2h_batch.kernels.frontier.safe_queues import BODIES, PIECES, BodyQueue, Moments, Nearest, Pieces
from r2h_batch.kernels.geometry.balls import balls_near, lowest_bit
from r2h_batch.kernels.geometry.closest import inscribed, rounded
from r2h_batch.kernels.geometry.hand_mesh import HandMesh
from r2h_batch.kernels.geometry.shape import from_ball
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import HAND

from ..judge.hand_bounds import ASK, WAITS, allowed_of, bound_of_ball, bound_of_hand, link_is_clear
from ..plan.obstacles import MovingBody
from ..robot.joints import OBJECT
from ..robot.posture import load
from ..robot.world import TrialBodies, World, link_frame
from .bodies import moving_body_of, stays_open
from .queues import NOW, Counts, Frames, take

wp.set_module_options(OPTIONS | {"max_unroll": 0})

FAR = wp.constant(1.0e30)
HALF_UM = wp.constant(2.0e-6)
"""More than what rounding may take off a distance."""


@wp.func
def compared_with(tolerance: float, known: float, above: float):
    """Distance that a part of the hand is compared with: the smallest one, or what follows from a point that is `above`
    away.

    That point's face must not be settled by the tolerance: D with D - allowed_of(D) just above `above`.
    """
    return wp.min(known, wp.max(above + tolerance, above / 0.998) + HALF_UM)


@wp.func
def bits_between(lo: int, hi: int):
    """Bits lo .. hi - 1."""
    return ((wp.int64(1) << wp.int64(hi)) - wp.int64(1)) & ~((wp.int64(1) << wp.int64(lo)) - wp.int64(1))


@wp.kernel
def safe_links(
    first: int, lanes: int, parity: int, tolerance: float, world: World, bodies: TrialBodies, nearest: Nearest,
    queue: Moments, frames: Frames, body_queue: BodyQueue, counts: Counts,
):  # fmt: skip
    """Each link as a whole against the ball about the hand; queues the bodies of links that are not clear."""
    if first + wp.tid() == 0:
        counts.n[NOW + 1 - parity] = 0
    n = OBJECT * wp.min(counts.n[NOW + parity], queue.trial.shape[0])
    for i in range(first + wp.tid(), n, lanes):
        s = i / OBJECT
        link = i % OBJECT
        trial = queue.trial[s]
        left = queue.look[s] & bits_between(world.link_first[link], world.link_first[link + 1])
        if left == wp.int64(0):
            continue
        known = nearest.distance[trial]
        k = link_frame(link)
        c0 = frames.R[s, k] * world.link_c0[link] + frames.p[s, k]
        c1 = frames.R[s, k] * world.link_c1[link] + frames.p[s, k]
        d = load(frames.d, s)
        if link_is_clear(world, bodies.hand[trial], link, c0, c1, d, known, allowed_of(tolerance, known)):
            continue
        for b in range(world.link_first[link], world.link_first[link + 1]):
            if (left >> wp.int64(b)) & wp.int64(1) == wp.int64(1):
                row = take(counts, BODIES, body_queue.interval.shape[0])
                if row >= 0:
                    body_queue.interval[row] = s
                    body_queue.body[row] = b
                    body_queue.known[row] = known
                    body_queue.meets[row] = 0
                    body_queue.nearest[row] = FAR


@wp.func
def pieces_left(world: World, body: MovingBody, hand: int, known: float, allowed: float):
    """Bits of the hand's pieces whose balls the body's capsule may come near to."""
    return balls_near(
        world.piece_center, world.piece_radius, hand * world.n_pieces, world.n_pieces,
        body.c0, body.c1, body.radius, body.travel,
        body.w, body.v, body.a, body.b, body.second, body.third,
        1, known - allowed, allowed,
    )  # fmt: skip


@wp.kernel
def safe_first_points(
    first: int, lanes: int, world: World, mesh: HandMesh, bodies: TrialBodies, nearest: Nearest, queue: Moments,
    frames: Frames, body_queue: BodyQueue, counts: Counts,
):  # fmt: skip
    """How near the first corner of each piece is to a queued body: the hand is no farther, and most pieces are."""
    for i in range(first + wp.tid(), wp.min(counts.n[BODIES], body_queue.interval.shape[0]), lanes):
        s = body_queue.interval[i]
        trial = queue.trial[s]
        hand = bodies.hand[trial]
        known = body_queue.known[i]
        body = moving_body_of(world, bodies, frames, s, trial, body_queue.body[i])
        shape = inscribed(body.shape)
        above = float(FAR)
        for piece in range(world.n_pieces):
            x = mesh.vertices[hand * mesh.n_vertices + mesh.faces[mesh.piece_face[piece], 0]]
            above = wp.min(above, wp.length(from_ball(shape, wp.transpose(body.R) * (x - body.p))))
        if above < known:
            wp.atomic_min(nearest.above, trial, above)


# For each body, as judge/hand_distance.py has it: the ball about the whole hand; most pieces at once, by their balls; the others
# one by one. They compare with the distance so far (`compared_with`), which no thread changes meanwhile.
@wp.kernel
def safe_pieces(
    first: int, lanes: int, tolerance: float, world: World, bodies: TrialBodies, nearest: Nearest,
    queue: Moments, frames: Frames, body_queue: BodyQueue, pieces: Pieces, counts: Counts,
):  # fmt: skip
    """Pieces of the hand that each queued body may come near to."""
    for i in range(first + wp.tid(), wp.min(counts.n[BODIES], body_queue.interval.shape[0]), lanes):
        s = body_queue.interval[i]
        b = body_queue.body[i]
        trial = queue.trial[s]
        hand = bodies.hand[trial]
        known = compared_with(tolerance, body_queue.known[i], nearest.above[trial])
        allowed = allowed_of(tolerance, known)
        body = moving_body_of(world, bodies, frames, s, trial, b)
        core = rounded(body.shape.kind, body.shape.size)
        waits = int(0)
        bound = bound_of_hand(world, body, hand, known, allowed)
        if bound == WAITS:
            waits = 1
        if bound == ASK and -core.radius < known - allowed:  # it cannot be met deeper than that
            left = pieces_left(world, body, hand, known, allowed)
            while left != wp.uint64(0):
                piece = hand * world.n_pieces + lowest_bit(left)
                left = left & (left - wp.uint64(1))
                bound = bound_of_ball(world, body, piece, known, allowed, waits)
                if bound == WAITS:
                    waits = 1
                if bound == ASK:
                    row = take(counts, PIECES, pieces.of.shape[0])
                    if row >= 0:
                        pieces.of[row] = i
                        pieces.piece[row] = piece
        body_queue.R[i] = body.R
        body_queue.p[i] = body.p
        body_queue.travel[i] = body.travel
        body_queue.known[i] = known
        body_queue.waits[i] = waits
        if waits == 1:
            stays_open(frames, s, HAND, wp.int64(1) << wp.int64(b))
