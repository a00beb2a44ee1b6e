"""A first guess of the robot's distance to the hand's mesh: never too small, quick, and mostly within a millimetre."""

import warp as wp

from r2h_batch.kernels.geometry.balls import nearest_ball, nearest_center
from r2h_batch.kernels.geometry.closest import closest_on_triangle, from_point, inscribed
from r2h_batch.kernels.geometry.hand_mesh import HandMesh, triangle_points
from r2h_batch.kernels.geometry.shape import from_ball
from r2h_batch.kernels.options import OPTIONS

from ..robot.joints import OBJECT
from ..robot.world import TrialBodies, World, body_pose, link_frame, robot_shape

wp.set_module_options(OPTIONS | {"max_unroll": 0})

NEARER = wp.constant(1.0e-5)
"""Rounding error of a distance, m, which is added to a guess."""
PROJECTIONS = wp.constant(3)


# Which robot body and which piece of the hand have bounding volumes that are nearest, or meet deepest; of that piece the face
# whose middle is nearest to the body; then to and fro between the face and the body, each time to the other's nearest point.
# Whatever these choices are, the last is a distance between two points of hand and robot.
@wp.func
def guessed_distance(
    world: World, mesh: HandMesh, bodies: TrialBodies, trial: int, cap: float,
    R: wp.array(dtype=wp.mat33),  # (7,) link frames
    p: wp.array(dtype=wp.vec3),
    tri: wp.array(dtype=wp.vec3),  # (3,) scratch: a face
):  # fmt: skip
    """At least the robot's distance to the hand, 0 for an overlap (m); above `cap` where bounding volumes keep that apart."""
    hand = bodies.hand[trial]
    center = world.hand_center[hand]
    least = cap + NEARER
    body = int(-1)
    piece = int(0)
    for back in range(OBJECT):  # the gripper first: it mostly is nearest
        link = OBJECT - 1 - back
        k = link_frame(link)
        c0 = R[k] * world.link_c0[link] + p[k]
        c1 = R[k] * world.link_c1[link] + p[k]
        if wp.length(from_point(center, c0, c1)) - world.hand_radius[hand] - world.link_radius[link] >= least:
            continue
        for b in range(world.link_first[link], world.link_first[link + 1]):
            Rb, pb = body_pose(world, bodies, trial, R, p, b)
            axis = Rb * world.cap_axis[b]
            c0 = pb - axis
            c1 = pb + axis
            if wp.length(from_point(center, c0, c1)) - world.hand_radius[hand] - world.cap_radius[b] >= least:
                continue
            found = nearest_ball(world.piece_center, world.piece_radius, hand * world.n_pieces, world.n_pieces, c0, c1)
            if found[0] - world.cap_radius[b] < least:
                least = found[0] - world.cap_radius[b]
                body = b
                piece = int(found[1])
    guess = cap + NEARER
    if body >= 0:
        shape = inscribed(robot_shape(world, body))
        Rb, pb = body_pose(world, bodies, trial, R, p, body)
        start = mesh.piece_face[piece]
        face = start + nearest_center(
            mesh.face_ball, hand * mesh.n_faces + start, mesh.piece_face[piece + 1] - start,
            shape.kind, shape.size, Rb, pb,
        )  # fmt: skip
        triangle_points(mesh, hand, face, tri)
        Rt = wp.transpose(Rb)
        t0 = Rt * (tri[0] - pb)
        t1 = Rt * (tri[1] - pb)
        t2 = Rt * (tri[2] - pb)
        y = (t0 + t1 + t2) / 3.0
        guess = float(1.0e30)
        for _ in range(PROJECTIONS):
            toward = from_ball(shape, y)
            guess = wp.min(guess, wp.length(toward))
            y = closest_on_triangle(y + toward, t0, t1, t2)
        guess = wp.min(wp.min(guess, wp.length(from_ball(shape, y))) + NEARER, cap)
    return guess
