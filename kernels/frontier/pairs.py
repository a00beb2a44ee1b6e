"""GJK of all queued pairs, an iteration at a time, so that no lane of a warp waits for another's pair.

A lane takes the next pair as soon as its own is done.
"""

import warp as wp

from r2h_batch.kernels.frontier.iteration import first_direction, iterate
from r2h_batch.kernels.geometry.gjk import MAX_ITERATIONS
from r2h_batch.kernels.geometry.shape import BOX, ROUNDING_M, Shape, support
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import HAND, SELF, TABLE

from ..robot.posture import load
from ..robot.world import TrialBodies, World, object_shape, piece_shape, robot_shape
from .queues import PAIRS, TAKEN, Counts, Edges, Frames, Intervals, Pairs, key_of, order_of

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.func
def shape_of(world: World, bodies: TrialBodies, trial: int, b: int):
    """The shape of a body of the robot, or of a hull of the trial's object."""
    out = Shape()
    if b < world.n_robot:
        out = robot_shape(world, b)
    else:
        out = object_shape(world, world.hull_first[bodies.object[trial]] + b - world.n_robot)
    return out


@wp.func
def obstacle_of(world: World, bodies: TrialBodies, trial: int, other: int):
    """The shape of an obstacle, and the point of it that GJK starts from."""
    out = Shape()
    center = wp.vec3(0.0, 0.0, 0.0)
    kind = other / 256
    if kind == HAND:
        piece = bodies.hand[trial] * world.n_pieces + other
        out = piece_shape(world, piece)
        center = world.piece_center[piece]
    elif kind == TABLE:
        out.kind = BOX
        out.size = world.table_half
    else:
        out = robot_shape(world, other - 256 * SELF)
    return out, center


@wp.func
def note_distance(edges: Edges, edge: int, aim: int, gap: float, margin: float, order: int, lower: float, upper: float):
    """Keeps the smallest clearance of an owner, or the first pair that blocks it."""
    owner = edges.owner[edge]
    if aim == 1:
        # a core that is met has no clearance, only an overlap that GJK does not measure
        value = wp.max(lower, -1.0e-6)
        if upper <= 0.0 and lower > -1.0e-6:
            value = -1.0e-6
        wp.atomic_min(edges.found, owner, key_of(value, order))
    elif upper <= margin or (gap == 0.0 and lower < margin):
        wp.atomic_min(edges.found, owner, key_of(0.0, order))


# A lane's turn, so that all lanes of a warp iterate together:
#
# 1. a lane whose pair is done takes the next one: shapes, pose, GJK's first direction. It ends when there are no more;
# 2. one iteration (iteration.py): support points, the bound from below, the simplex and its nearest point. It has changed the
#    lane's state when it comes back, and says whether it was the last;
# 3. was it the last, the distance is written, and the owner's key: its smallest clearance, or the first pair that blocks it.
#
# Keys are not read here: what GJK has to prove was written with the pair, so a distance does not depend on who came first.
@wp.kernel
def pair_distances(
    first: int, aim: int, world: World, bodies: TrialBodies, edges: Edges, queue: Intervals, frames: Frames,
    pairs: Pairs, counts: Counts,
):  # fmt: skip
    """Distance of each queued pair: certified lower bound, estimate, and the vector between the nearest points."""
    n_pairs = wp.min(counts.n[PAIRS], pairs.interval.shape[0])
    i = int(-1)
    fresh = bool(True)
    a = Shape()
    b = Shape()
    R = wp.mat33()
    p = wp.vec3()
    gap = float(0.0)
    needed = float(0.0)
    v = wp.vec3()
    lower = float(0.0)
    upper = float(0.0)
    n = int(0)
    steps = int(0)
    s0 = wp.vec3()
    s1 = wp.vec3()
    s2 = wp.vec3()
    best_v = wp.vec3()
    radii = float(0.0)
    while i < n_pairs:
        if fresh:
            i = wp.atomic_add(counts.n, TAKEN, 1)
            if i >= n_pairs:
                break
            s = pairs.interval[i]
            trial = edges.trial[queue.edge[s]]
            a = shape_of(world, bodies, trial, pairs.body[i])
            b, center = obstacle_of(world, bodies, trial, pairs.other[i])
            R = pairs.R[i]
            p = pairs.p[i]
            needed = pairs.needed[i]
            radii = a.radius + b.radius
            # GJK may stop 5 % short of the distance where a shorter interval asks again
            d = load(frames.d, s)
            gap = wp.where(aim == 0 and wp.dot(d, d) > 0.0, 0.05, 0.0)
            v = first_direction(p, center)
            best_v = v
            lower = -1.0e30
            upper = 1.0e30
            n = 0
            steps = 0
        steps += 1
        w = R * support(a, world.points, wp.transpose(R) * (-v)) + p
        w = w - support(b, world.points, v)
        fresh, v, best_v, lower, upper, n, s0, s1, s2 = iterate(
            w, radii, needed, gap, v, best_v, lower, upper, n, s0, s1, s2
        )
        fresh = fresh or steps >= MAX_ITERATIONS
        if fresh:
            low = lower - radii - ROUNDING_M
            high = upper - radii
            pairs.lower[i] = low
            pairs.upper[i] = high
            pairs.v[i] = best_v
            edge = queue.edge[pairs.interval[i]]
            margin = wp.where(pairs.other[i] < 256, edges.hand_margin[edge], 0.0)
            order = order_of(pairs.body[i], pairs.other[i])
            note_distance(edges, edge, aim, gap, margin, order, low, high)
