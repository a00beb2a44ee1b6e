"""How deep bodies meet along a motion that is known to touch something: for paths that were sampled, and for Safe's failures.

The searches that decide (plan/edge.py, judge/safe.py) stop at the first overlap, or locate it roughly: how deep is no part of
a verdict. Here the deepest posture is looked for: every STEP_RAD along a path, then by halving about the deepest one found.
"""

import warp as wp

from r2h_batch.kernels.geometry.closest import signed_distance
from r2h_batch.kernels.geometry.depth import core_depth
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.hand_mesh import HandMesh, triangle_points
from r2h_batch.kernels.geometry.shape import BLOCKS, ROUNDING_M
from r2h_batch.kernels.grasp.triangle import triangle_clearance
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import PAIR_HAND, PAIR_OF_OBJECT

from ..plan.posture import BodyInPlace, Obstacle, PairClearance, in_place, obstacle_of, posture_clearance
from ..robot.joints import FRAMES, JOINTS, OBJECT
from ..robot.posture import load_waypoint
from ..robot.world import TrialBodies, World, body_pose, forward_kinematics, points_of

wp.set_module_options(OPTIONS | {"max_unroll": 0})

STEP_RAD = wp.constant(0.04)
"""Distance between two sampled postures, summed over the joints."""
HALVINGS = wp.constant(10)


@wp.func
def _posture(path: wp.array3d(dtype=float), trial: int, last: int, s: float):
    """The posture at s, counted in waypoints: 0 the start, `last` the end (0: the only one)."""
    t = wp.clamp(s, 0.0, float(last))
    i = wp.min(int(t), wp.max(last - 1, 0))
    a = load_waypoint(path, trial, i)
    return a + (t - float(i)) * (load_waypoint(path, trial, wp.min(i + 1, last)) - a)


@wp.func
def _pair_depth(world: World, body: BodyInPlace, obstacle: Obstacle):
    """A lower bound of how deep two bodies overlap: of their cores plus the radii, or the radii less their cores' distance."""
    Rt = wp.transpose(obstacle.R)
    R = Rt * body.R
    p = Rt * (body.p - obstacle.p)
    points = points_of(world, obstacle.shape)
    found = gjk(body.shape, R, p, world.points, obstacle.shape, points, obstacle.center, 1.0e30, 0.0)
    depth = -found.upper - ROUNDING_M
    core = core_depth(body.shape, R, p, world.points, obstacle.shape, points)
    if core > 0.0:
        depth = wp.max(depth, core + body.shape.radius + obstacle.shape.radius)
    return depth


@wp.func
def _deepest_pair(
    world: World, hull_ball: wp.array(dtype=wp.vec4), bodies: TrialBodies, trial: int, found: PairClearance,
    R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The two bodies that `posture_clearance` found to overlap deepest, the links being at R, p."""
    R_hand_world = bodies.R_hand_world[trial]
    up = wp.vec3(R_hand_world[0, 2], R_hand_world[1, 2], R_hand_world[2, 2])
    table_p = R_hand_world * world.table_center + bodies.p_hand_world[trial]
    link = int(OBJECT)
    if found.body < world.n_robot:
        link = world.body_link[found.body]
    hull = world.hull_first[bodies.object[trial]] + found.body - world.n_robot
    body = in_place(world, hull_ball, bodies, trial, link, found.body, hull, R, p)
    kind = PAIR_HAND + (found.pair - PAIR_HAND) % PAIR_OF_OBJECT
    hand = bodies.hand[trial]
    obstacle = obstacle_of(
        world, bodies, trial, body, kind, found.other, hand, R_hand_world, table_p, up, 0.0, 1.0e30, R, p
    )
    return body, obstacle


# One loop, with one call of `posture_clearance`, over postures s of the path (counted in waypoints):
#
# 1. along the path, segment by segment, every STEP_RAD or less. `best` is the deepest so far, in terms of growth, and only
#    what is deeper is looked for, which is quick (posture_clearance with a `cap` below 0), and its depth is measured;
# 2. about the deepest posture `at`: a step to one side, then to the other. Where one is deeper it goes on from there, else
#    the step is halved, HALVINGS times: 2^-10 of a first step of at most STEP_RAD / 2.
#
# Nothing deeper than -1e-7 found: the outputs stay as they are.
@wp.kernel
def path_overlap(
    first: int,
    # tables
    world: World, hull_ball: wp.array(dtype=wp.vec4), bodies: TrialBodies,
    # rows
    row_in: wp.array(dtype=int),  # (n,) trials that are looked at
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
    # in and out, (B,): written where a path's clearance is below 0 and an overlap is found
    clearance_inout: wp.array(dtype=float), pair_inout: wp.array(dtype=int), body_inout: wp.array(dtype=int),
):  # fmt: skip
    """Minus a lower bound of the deepest penetration depth along each path, its pair and the robot's body.

    The search looks for ever larger growth distances (plan/posture.py), which is quick. Of the pairs and postures on its way
    the largest depth counts (geometry/depth.py), mostly to 1 %. Others may be deeper: it is a bound.
    """
    trial = row_in[first + wp.tid()]
    last = length_in[trial] - 1
    if last < 0 or not clearance_inout[trial] < 0.0:
        return
    segments = wp.max(last, 1)  # a path of one posture is one segment without length
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    best = float(-1.0e-7)
    depth = float(0.0)
    at = float(-1.0)
    step = float(1.0)
    # along the path, segment by segment; then about the deepest posture, to both sides, in steps that are halved
    segment = int(0)
    k = int(0)
    steps = int(0)
    halving = wp.where(last == 0, HALVINGS, 0)
    side = int(0)
    while segment < segments or (at >= 0.0 and halving < HALVINGS):
        s = float(0.0)
        if segment < segments:
            if k == 0:
                d = load_waypoint(path_in, trial, wp.min(segment + 1, last)) - load_waypoint(path_in, trial, segment)
                length = float(0.0)
                for j in range(JOINTS):
                    length += wp.abs(d[j])
                steps = wp.max(int(wp.ceil(length / STEP_RAD)), 1)
            s = float(segment) + float(k) / float(steps)
        else:
            s = at + wp.where(side == 0, -step, step)
        found = posture_clearance(
            world, hull_ball, bodies, trial, _posture(path_in, trial, last, s), best, -1.0e30, R, p
        )
        deeper = found.clearance < best
        if deeper:
            best = found.clearance
            at = wp.clamp(s, 0.0, float(last))
            body, obstacle = _deepest_pair(world, hull_ball, bodies, trial, found, R, p)
            pair_depth = wp.max(_pair_depth(world, body, obstacle), -best)
            if pair_depth > depth:
                depth = pair_depth
                clearance_inout[trial] = -depth
                pair_inout[trial] = found.pair
                body_inout[trial] = found.body
        if segment < segments:
            if deeper:
                step = 0.5 / float(steps)
            k += 1
            if k > steps:
                k = 0
                segment += 1
        elif deeper:
            side = 0
        else:
            side += 1
            if side == 2:
                side = 0
                step = 0.5 * step
                halving += 1


# As above, about the moment `at` that the search for the smallest distance knows (halving -1: the moment itself first); a
# first step of a 64th of the motion. At each posture, branch and bound over depths, `best` being the deepest so far:
#
#     body against a piece's ball, then a face's ball     signed_distance(centre) - radius >= best: nothing deeper in there
#     body against the face                               triangle_clearance: bisection on how far the body is eroded
#
# A body that lies wholly within the hand has no face in it: its distance stays what the first search says. Both sides of the
# moment are tried before the step is halved, HALVINGS times: to a few microseconds of an executed motion.
@wp.kernel
def hand_overlap(
    first: int,
    # tables
    world: World, mesh: HandMesh, bodies: TrialBodies,
    # rows
    row_in: wp.array(dtype=int),  # (n,) trials whose motion meets the hand
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
    # in and out, (B,)
    distance_inout: wp.array(dtype=float), body_inout: wp.array(dtype=int), segment_inout: wp.array(dtype=int),
    fraction_inout: wp.array(dtype=float),
    point_inout: wp.array(dtype=wp.vec3),  # world frame
):  # fmt: skip
    """The depth of the hand's deepest point in a robot primitive near the moment that is known, by halving in time.

    `point`: near the deepest one. Exact for what the mesh's faces reach (grasp/region.py); where that is not deeper than
    what is known, nothing changes.
    """
    trial = row_in[first + wp.tid()]
    last = length_in[trial] - 1
    hand = bodies.hand[trial]
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    best = distance_inout[trial]
    at = float(segment_inout[trial]) + fraction_inout[trial]
    step = float(last) / 64.0
    halving = int(-1)  # first the moment itself
    side = int(1)
    while halving < HALVINGS:
        s = wp.clamp(at + wp.where(halving < 0, 0.0, wp.where(side == 0, -step, step)), 0.0, float(last))
        q = _posture(path_in, trial, last, s)
        forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q, R, p)
        deeper = bool(False)
        for b in range(world.n_robot):
            Rb, pb = body_pose(world, bodies, trial, R, p, b)
            back = wp.transpose(Rb)
            kind = world.kind[b]
            if kind == BLOCKS:  # a hull's overlap stays what the first search says
                continue
            size = world.size[b]
            for i in range(world.n_pieces):
                piece = hand * world.n_pieces + i
                x = back * (world.piece_center[piece] - pb)
                if signed_distance(kind, size, x) - world.piece_radius[piece] >= best:
                    continue
                for face in range(mesh.piece_face[i], mesh.piece_face[i + 1]):
                    ball = mesh.face_ball[hand * mesh.n_faces + face]
                    x = back * (wp.vec3(ball[0], ball[1], ball[2]) - pb)
                    if signed_distance(kind, size, x) - ball[3] >= best:
                        continue
                    triangle_points(mesh, hand, face, tri)
                    d = triangle_clearance(tri, 0, kind, size, back, -(back * pb), best)
                    if d < best:
                        best = d
                        deeper = True
                        body_inout[trial] = b
                        # of the face's corners and its middle the one that is deepest
                        point = (tri[0] + tri[1] + tri[2]) / 3.0
                        for k in range(3):
                            if signed_distance(kind, size, back * (tri[k] - pb)) < signed_distance(
                                kind, size, back * (point - pb)
                            ):
                                point = tri[k]
                        point_inout[trial] = wp.transpose(bodies.R_hand_world[trial]) * (
                            point - bodies.p_hand_world[trial]
                        )
        if deeper:
            at = s
            side = 0
        else:
            side += 1
        if halving < 0:
            halving = 0
            side = 0
        elif side >= 2:
            side = 0
            step = 0.5 * step
            halving += 1
    distance_inout[trial] = best
    segment_inout[trial] = wp.min(int(at), last - 1)
    fraction_inout[trial] = at - float(segment_inout[trial])
