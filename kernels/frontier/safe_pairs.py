"""GJK of Safe's bodies with the hand's hulls and faces, an iteration at a time; a lane takes the next one when its own is done.

As pairs.py does for planning. Where a body meets a piece or face, a second GJK from its `rounded` core gives the depth.
"""

import warp as wp

from r2h_batch.kernels.frontier.iteration import first_direction, iterate
from r2h_batch.kernels.frontier.safe_queues import FACES, PIECES, TAKEN, BodyQueue, Faces, Moments, Nearest, Pieces
from r2h_batch.kernels.geometry.closest import TOUCH_M, rounded
from r2h_batch.kernels.geometry.gjk import MAX_ITERATIONS
from r2h_batch.kernels.geometry.hand_mesh import HandMesh
from r2h_batch.kernels.geometry.shape import ROUNDING_M, Shape, support
from r2h_batch.kernels.options import OPTIONS

from ..judge.hand_bounds import HULL_GAP, allowed_of
from ..judge.hand_distance import face_distance, is_edged
from ..robot.world import TrialBodies, World, piece_shape, robot_shape
from .queues import Counts

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.func
def farthest_corner(x: wp.vec3, y: wp.vec3, z: wp.vec3, d: wp.vec3):
    """A triangle's corner that is farthest along d; of equal ones the first, as `support` has it."""
    best = wp.dot(x, d)
    p = wp.vec3(x)
    t = wp.dot(y, d)
    if t > best:
        best = t
        p = y
    if wp.dot(z, d) > best:
        p = z
    return p


# A lane's turn, so that all lanes of a warp iterate together:
#
# 1. a lane whose pair is done takes the next one: shapes, pose, how much has to be proved. It ends when there are no more;
# 2. one iteration (iteration.py);
# 3. after the last one the body may have to be asked again, as its core: where they meet and an overlap is known already, for
#    then only deeper pieces count. The lane keeps its pair and starts afresh;
# 4. else the distance is written. What it means for the interval says safe_faces.py.
#
# The trial's distance is read as it was when the level began (`BodyQueue.known`).
@wp.kernel
def hull_distances(first: int, tolerance: float, world: World, body_queue: BodyQueue, pieces: Pieces, counts: Counts):
    """Distance of each queued body to a piece's hull: whether they meet, a certified lower bound, the vector between them."""
    n_pairs = wp.min(counts.n[PIECES], pieces.of.shape[0])
    i = int(-1)
    fresh = bool(True)
    cored = int(0)
    a = Shape()
    b = Shape()
    R = wp.mat33()
    p = wp.vec3()
    center = wp.vec3()
    needed = float(0.0)
    limit = float(0.0)
    known = float(0.0)
    v = wp.vec3()
    best_v = wp.vec3()
    lower = float(0.0)
    upper = float(0.0)
    n = int(0)
    steps = int(0)
    s0 = wp.vec3()
    s1 = wp.vec3()
    s2 = wp.vec3()
    while i < n_pairs:
        if fresh:
            if cored == 0:
                i = wp.atomic_add(counts.n, TAKEN, 1)
                if i >= n_pairs:
                    break
                m = pieces.of[i]
                a = robot_shape(world, body_queue.body[m])
                R = body_queue.R[m]
                p = body_queue.p[m]
                b = piece_shape(world, pieces.piece[i])
                center = world.piece_center[pieces.piece[i]]
                known = body_queue.known[m]
                limit = known - allowed_of(tolerance, known) + body_queue.travel[m]
                needed = wp.max(limit, known)
            v = first_direction(p, center)
            best_v = v
            lower = -1.0e30
            upper = 1.0e30
            n = 0
            steps = 0
        steps += 1
        w = R * support(a, world.points, wp.transpose(R) * (-v)) + p
        w = w - support(b, world.points, v)
        radii = a.radius + b.radius
        fresh, v, best_v, lower, upper, n, s0, s1, s2 = iterate(
            w, radii, needed, HULL_GAP, v, best_v, lower, upper, n, s0, s1, s2
        )
        fresh = fresh or steps >= MAX_ITERATIONS
        if fresh:
            met = upper - radii <= TOUCH_M
            if cored == 0 and met and known < 0.0:
                cored = 1
                a = rounded(a.kind, a.size)
                needed = limit
            else:
                pieces.meets[i] = wp.where(met or cored == 1, 1, 0)
                pieces.lower[i] = lower - radii - ROUNDING_M
                pieces.v[i] = best_v
                cored = 0


# As above, of bodies and triangles:
#
# 1. a lane takes the next face. Where the body stands still and an overlap is known only faces that meet it matter: a body with
#    edges is asked as its core at once;
# 2. one iteration;
# 3. a body with edges that meets the face is asked again as its core: how far that is away says how deep;
# 4. else the signed distance is written, and what is the smallest of the body and of the trial. Nobody reads these here, so a
#    distance does not depend on who came first: what it has to prove was written with the face.
@wp.kernel
def face_distances(
    first: int, tolerance: float, world: World, mesh: HandMesh, bodies: TrialBodies, nearest: Nearest,
    queue: Moments, body_queue: BodyQueue, faces: Faces, counts: Counts,
):  # fmt: skip
    """Signed distance of each queued body to a face, and the smallest of each trial and of each body."""
    n_pairs = wp.min(counts.n[FACES], faces.of.shape[0])
    i = int(-1)
    fresh = bool(True)
    again = int(0)
    cored = int(0)
    a = Shape()
    R = wp.mat33()
    p = wp.vec3()
    center = wp.vec3()
    x = wp.vec3()
    y = wp.vec3()
    z = wp.vec3()
    needed = float(0.0)
    v = wp.vec3()
    best_v = wp.vec3()
    lower = float(0.0)
    upper = float(0.0)
    n = int(0)
    steps = int(0)
    s0 = wp.vec3()
    s1 = wp.vec3()
    s2 = wp.vec3()
    while i < n_pairs:
        if fresh:
            if again == 0:
                i = wp.atomic_add(counts.n, TAKEN, 1)
                if i >= n_pairs:
                    break
                m = faces.of[i]
                hand = bodies.hand[queue.trial[body_queue.interval[m]]]
                face = faces.face[i]
                a = robot_shape(world, body_queue.body[m])
                R = body_queue.R[m]
                p = body_queue.p[m]
                base = hand * mesh.n_vertices
                x = mesh.vertices[base + mesh.faces[face, 0]]
                y = mesh.vertices[base + mesh.faces[face, 1]]
                z = mesh.vertices[base + mesh.faces[face, 2]]
                ball = mesh.face_ball[hand * mesh.n_faces + face]
                center = wp.vec3(ball[0], ball[1], ball[2])
                known = faces.known[i]
                travel = body_queue.travel[m]
                needed = wp.max(known - allowed_of(tolerance, known) + travel, known)
                cored = 0
                if travel == 0.0 and known < 0.0 and is_edged(a):
                    cored = 1
                    a = rounded(a.kind, a.size)
            again = 0
            v = first_direction(p, center)
            best_v = v
            lower = -1.0e30
            upper = 1.0e30
            n = 0
            steps = 0
        steps += 1
        w = R * support(a, world.points, wp.transpose(R) * (-v)) + p
        w = w - farthest_corner(x, y, z, v)
        fresh, v, best_v, lower, upper, n, s0, s1, s2 = iterate(
            w, a.radius, needed, 0.0, v, best_v, lower, upper, n, s0, s1, s2
        )
        fresh = fresh or steps >= MAX_ITERATIONS
        if fresh:
            high = upper - a.radius
            if cored == 0 and high <= TOUCH_M and is_edged(a):
                again = 1
                cored = 1
                a = rounded(a.kind, a.size)
            else:
                value = face_distance(lower - a.radius - ROUNDING_M, high, a.radius, cored)
                faces.value[i] = value
                faces.v[i] = best_v
                m = faces.of[i]
                wp.atomic_min(body_queue.nearest, m, value)
                wp.atomic_min(nearest.distance, queue.trial[body_queue.interval[m]], value)
