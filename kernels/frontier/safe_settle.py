"""Verdict by the distances of faces: which place has the smallest distance, and which intervals have to be halved."""

import warp as wp

from r2h_batch.kernels.frontier.safe_queues import (
    FACES,
    GOAL_LEVEL,
    NO_FACE,
    NOWHERE,
    BodyQueue,
    Faces,
    Moments,
    Nearest,
    fields_of_place,
    place_of,
)
from r2h_batch.kernels.geometry.closest import rounded
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.hand_mesh import HandMesh, triangle_points
from r2h_batch.kernels.geometry.shape import triangle_shape
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import HAND

from ..judge.hand_bounds import allowed_of
from ..judge.hand_distance import face_may_come_nearer, is_edged, point_of_face
from ..robot.joints import FRAMES
from ..robot.world import TrialBodies, World, body_pose, forward_kinematics, robot_shape
from .bodies import moving_body_of, stays_open
from .queues import Counts, Frames
from .safe_bodies import FAR
from .safe_intervals import interval_of

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.kernel
def settle_faces(
    first: int, lanes: int, tolerance: float, world: World, mesh: HandMesh, bodies: TrialBodies,
    nearest: Nearest, queue: Moments, frames: Frames, body_queue: BodyQueue, faces: Faces, counts: Counts,
):  # fmt: skip
    """Keeps the place of each trial's smallest distance, and notes which faces may come nearer within the interval."""
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    for i in range(first + wp.tid(), wp.min(counts.n[FACES], faces.of.shape[0]), lanes):
        m = faces.of[i]
        s = body_queue.interval[m]
        b = body_queue.body[m]
        trial = queue.trial[s]
        distance = nearest.distance[trial]
        value = faces.value[i]
        face = faces.face[i]
        if value == distance:
            place = place_of(queue.segment[s], queue.level[s], queue.section[s], queue.index[s], b, face)
            wp.atomic_min(nearest.place, trial, place)
        if queue.level[s] > GOAL_LEVEL and face != NO_FACE and body_queue.waits[m] == 0:
            body = moving_body_of(world, bodies, frames, s, trial, b)
            triangle_points(mesh, bodies.hand[trial], face, tri)
            allowed = allowed_of(tolerance, distance)
            if face_may_come_nearer(world, body, tri, value, faces.v[i], distance, allowed) == 1:
                stays_open(frames, s, HAND, wp.int64(1) << wp.int64(b))


# GJK of the body and the face where it was found, once more: the levels keep distances alone. A body with edges that meets the
# face is measured from its core (judge/hand_distance.py); the witness of a body wholly inside the hand is the body's middle.
@wp.kernel
def safe_witness(
    first: int, world: World, mesh: HandMesh, bodies: TrialBodies, nearest: Nearest,
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
    # out
    distance_out: wp.array(dtype=float), body_out: wp.array(dtype=int), segment_out: wp.array(dtype=int),
    fraction_out: wp.array(dtype=float),
    point_out: wp.array(dtype=wp.vec3),  # world frame
):  # fmt: skip
    """The smallest distance of each trial, the moment, the robot's body and the hand's point that it belongs to."""
    trial = first + wp.tid()
    length = length_in[trial]
    if length == 0:
        return
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    distance = nearest.distance[trial]
    place = nearest.place[trial]
    body = int(-1)
    segment = int(length - 2)
    fraction = float(1.0)
    point = wp.vec3(0.0, 0.0, 0.0)
    if place != wp.int64(NOWHERE):
        segment, level, section, index, body, face = fields_of_place(place)
        q, _d, fraction = interval_of(path_in, trial, segment, section, level, index)
        forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q, R, p)
        Rb, pb = body_pose(world, bodies, trial, R, p, body)
        point = pb
        if face != NO_FACE:
            hand = bodies.hand[trial]
            triangle_points(mesh, hand, face, tri)
            shape = robot_shape(world, body)
            if distance < 0.0 and is_edged(shape):
                shape = rounded(shape.kind, shape.size)
            ball = mesh.face_ball[hand * mesh.n_faces + face]
            center = wp.vec3(ball[0], ball[1], ball[2])
            found = gjk(shape, Rb, pb, world.points, triangle_shape(0), tri, center, FAR, 0.0)
            point = point_of_face(found.point, found.v, tri)
    distance_out[trial] = distance
    body_out[trial] = body
    segment_out[trial] = segment
    fraction_out[trial] = fraction
    point_out[trial] = wp.transpose(bodies.R_hand_world[trial]) * (point - bodies.p_hand_world[trial])
