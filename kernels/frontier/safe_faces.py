"""Which faces of the hand bounds cannot settle in Safe: along the planes between hulls, then each face's ball."""

import warp as wp

from r2h_batch.kernels.frontier.safe_queues import (
    BODIES,
    FACES,
    NO_FACE,
    PIECES,
    SET,
    SETS,
    TAKEN,
    BodyQueue,
    Faces,
    Moments,
    Nearest,
    Pieces,
    Sets,
)
from r2h_batch.kernels.geometry.closest import TOUCH_M, inscribed
from r2h_batch.kernels.geometry.hand_mesh import HandMesh, inside_mesh
from r2h_batch.kernels.geometry.shape import from_ball
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import HAND

from ..judge.hand_bounds import ASK, WAITS, allowed_of, bound_of_face, bound_of_hull
from ..robot.world import TrialBodies, World, robot_shape
from .bodies import moving_body_of, stays_open
from .queues import Counts, Frames, take
from .safe_bodies import FAR, compared_with

wp.set_module_options(OPTIONS | {"max_unroll": 0})


# As judge/hand_bounds.py `bound_of_piece` goes on after GJK. A body that meets the hull: the faces have to say how deep, unless
# an overlap is known and all of the piece is clear of the core grown by it. One that does not: the plane between the two.
@wp.kernel
def safe_hulls(
    first: int, lanes: int, tolerance: float, world: World, mesh: HandMesh, bodies: TrialBodies, queue: Moments,
    frames: Frames, body_queue: BodyQueue, pieces: Pieces, sets: Sets, counts: Counts,
):  # fmt: skip
    """Settles pieces of the hand over whole intervals from GJK's distances; queues the faces of the others, in sets."""
    if first + wp.tid() == 0:
        counts.n[TAKEN] = 0
    for i in range(first + wp.tid(), wp.min(counts.n[PIECES], pieces.of.shape[0]), lanes):
        m = pieces.of[i]
        s = body_queue.interval[m]
        b = body_queue.body[m]
        trial = queue.trial[s]
        known = body_queue.known[m]
        allowed = allowed_of(tolerance, known)
        n = wp.vec3(0.0, 0.0, 0.0)
        beyond = float(-FAR)
        if pieces.meets[i] == 1:
            if known < 0.0 and pieces.lower[i] >= known - allowed + body_queue.travel[m]:
                continue
            body_queue.meets[m] = 1
        else:
            body = moving_body_of(world, bodies, frames, s, trial, b)
            bound, n, beyond = bound_of_hull(
                world, body, pieces.piece[i], pieces.lower[i], pieces.v[i], known, allowed, body_queue.waits[m]
            )
            if bound == WAITS:
                stays_open(frames, s, HAND, wp.int64(1) << wp.int64(b))
            if bound != ASK:
                continue
        piece = pieces.piece[i] - bodies.hand[trial] * world.n_pieces
        end = mesh.piece_face[piece + 1]
        for face in range(mesh.piece_face[piece], end, SET):
            row = take(counts, SETS, sets.of.shape[0])
            if row >= 0:
                sets.of[row] = m
                sets.first[row] = face
                sets.last[row] = wp.min(face + SET, end)
                sets.n[row] = n
                sets.beyond[row] = beyond


@wp.func
def is_behind(sets: Sets, i: int, ball: wp.vec4, distance: float):
    """Whether a face lies behind the plane that the body keeps to, by `distance`."""
    return sets.beyond[i] - wp.dot(sets.n[i], wp.vec3(ball[0], ball[1], ball[2])) - ball[3] >= distance


@wp.kernel
def safe_corners(
    first: int, lanes: int, world: World, mesh: HandMesh, bodies: TrialBodies, nearest: Nearest, queue: Moments,
    body_queue: BodyQueue, sets: Sets, counts: Counts,
):  # fmt: skip
    """How near the queued faces' first corners are: the hand is no farther, and most faces are."""
    for i in range(first + wp.tid(), wp.min(counts.n[SETS], sets.of.shape[0]), lanes):
        m = sets.of[i]
        trial = queue.trial[body_queue.interval[m]]
        base = bodies.hand[trial] * mesh.n_vertices
        shape = inscribed(robot_shape(world, body_queue.body[m]))
        back = wp.transpose(body_queue.R[m])
        above = float(FAR)
        for face in range(sets.first[i], sets.last[i]):
            x = mesh.vertices[base + mesh.faces[face, 0]]
            above = wp.min(above, wp.length(from_ball(shape, back * (x - body_queue.p[m]))))
        if above < body_queue.known[m]:
            wp.atomic_min(nearest.above, trial, above)


@wp.kernel
def safe_faces(
    first: int, lanes: int, tolerance: float, world: World, mesh: HandMesh, bodies: TrialBodies,
    nearest: Nearest, queue: Moments, frames: Frames, body_queue: BodyQueue, sets: Sets, faces: Faces,
    counts: Counts,
):  # fmt: skip
    """Faces that each queued body may come near to."""
    for i in range(first + wp.tid(), wp.min(counts.n[SETS], sets.of.shape[0]), lanes):
        m = sets.of[i]
        s = body_queue.interval[m]
        b = body_queue.body[m]
        trial = queue.trial[s]
        hand = bodies.hand[trial]
        known = compared_with(tolerance, body_queue.known[m], nearest.above[trial])
        allowed = allowed_of(tolerance, known)
        waits = body_queue.waits[m]
        body = moving_body_of(world, bodies, frames, s, trial, b)
        for face in range(sets.first[i], sets.last[i]):
            ball = mesh.face_ball[hand * mesh.n_faces + face]
            if is_behind(sets, i, ball, known - allowed):
                continue
            bound = bound_of_face(world, body, ball, known, allowed, waits)
            if bound == WAITS:
                waits = 1
            if bound == ASK:
                row = take(counts, FACES, faces.of.shape[0])
                if row >= 0:
                    faces.of[row] = m
                    faces.face[row] = face
                    faces.known[row] = known
        if waits == 1:
            stays_open(frames, s, HAND, wp.int64(1) << wp.int64(b))


# In a hull but clear of all faces: in a hollow of the mesh, or wholly inside the hand. What is known of the trial is not asked
# here, as other threads write it: only what was known when the level began, and the body's own faces.
@wp.kernel
def safe_insides(
    first: int, lanes: int, mesh: HandMesh, bodies: TrialBodies, nearest: Nearest, queue: Moments,
    frames: Frames, body_queue: BodyQueue, faces: Faces, counts: Counts,
):  # fmt: skip
    """Adds bodies that are wholly inside the hand to the queue of faces, as deep as their nearest face is far."""
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    for i in range(first + wp.tid(), wp.min(counts.n[BODIES], body_queue.interval.shape[0]), lanes):
        if body_queue.meets[i] == 0:
            continue
        distance = wp.min(body_queue.known[i], body_queue.nearest[i])
        if distance <= 0.0:
            continue
        s = body_queue.interval[i]
        trial = queue.trial[s]
        if inside_mesh(mesh, bodies.hand[trial], body_queue.p[i], tri):
            value = wp.min(-distance, -TOUCH_M)
            wp.atomic_min(nearest.distance, trial, value)
            stays_open(frames, s, HAND, wp.int64(1) << wp.int64(body_queue.body[i]))
            row = take(counts, FACES, faces.of.shape[0])
            if row >= 0:
                faces.of[row] = i
                faces.face[row] = NO_FACE
                faces.value[row] = value
