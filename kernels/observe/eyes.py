"""The bodies that hide points of objects from the eyes of the person who receives them."""

import warp as wp

from r2h_batch.kernels.observe.rays import (
    FOREARM,
    HAND,
    OBJECT,
    ROBOT,
    TABLE,
    UPPER_ARM,
    Bodies,
    box_hit,
    capsule_hit,
    first_three,
    mesh_met,
    origin,
    rotation,
)
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

EYES = wp.constant(2)
SKIN_M = wp.constant(1.0e-4)
"""Surfaces this near before a point do not hide it: its own, in float32."""


@wp.func
def hider(
    bodies: Bodies, parts: int, part_mesh: wp.array(dtype=wp.uint64), part_ball: wp.array(dtype=wp.vec4),
    T_world_part: wp.array2d(dtype=wp.mat44), i: int, o: int, T_world_obj: wp.mat44, h: int, T_world_hand: wp.mat44,
    receiver: wp.array2d(dtype=wp.vec4), eye: wp.vec3, d: wp.vec3, best: float,
):  # fmt: skip
    """The first body, in this order, that a ray from an eye meets before `best`; 0: none."""
    if mesh_met(T_world_obj, bodies.object_mesh[o], bodies.object_ball[o], eye, d, best)[0] < best:
        return OBJECT
    for k in range(parts):
        if mesh_met(T_world_part[i, k], part_mesh[k], part_ball[k], eye, d, best)[0] < best:
            return ROBOT
    if mesh_met(T_world_hand, bodies.hand_mesh[h], bodies.hand_ball[h], eye, d, best)[0] < best:
        return HAND
    shoulder = first_three(receiver[i, 0])
    elbow = first_three(receiver[i, 1])
    if capsule_hit(eye, d, elbow, first_three(receiver[i, 2]), receiver[i, 1][3]) < best:
        return FOREARM
    if capsule_hit(eye, d, shoulder, elbow, receiver[i, 0][3]) < best:
        return UPPER_ARM
    if box_hit(eye - bodies.table_center, d, bodies.table_half) < best:
        return TABLE
    return 0


@wp.kernel
def hidden(
    first: int, parts: int,
    bodies: Bodies,  # its robot at home is not asked
    part_mesh_in: wp.array(dtype=wp.uint64), part_ball_in: wp.array(dtype=wp.vec4),  # the robot's parts
    T_world_part_in: wp.array2d(dtype=wp.mat44),  # (n, parts)
    eye_in: wp.array2d(dtype=wp.vec3),  # (n, 2) world
    point_in: wp.array2d(dtype=wp.vec3), normal_in: wp.array2d(dtype=wp.vec3),  # (objects, k) object frame
    object_in: wp.array(dtype=int), T_world_obj_in: wp.array(dtype=wp.mat44),
    hand_in: wp.array(dtype=int), T_world_hand_in: wp.array(dtype=wp.mat44),
    receiver_in: wp.array2d(dtype=wp.vec4),  # (n, 5) `Trials.receiver`
    label_out: wp.array2d(dtype=wp.uint8),
):  # fmt: skip
    """The body that hides each point of an object's surface; 0: an eye sees it.

    Hidden by several bodies, it is the first one's in the order of the code. Hidden from both eyes, it is the left one's,
    but the object's only where the object hides it from both.
    """
    i, j = wp.tid()
    i += first
    T = T_world_obj_in[i]
    o = object_in[i]
    p = rotation(T) * point_in[o, j] + origin(T)
    normal = rotation(T) * normal_in[o, j]
    found = int(OBJECT)
    for e in range(EYES):
        d = p - eye_in[i, e]
        far = wp.length(d)
        d = d / far
        what = int(OBJECT)  # it faces away
        if wp.dot(normal, d) < 0.0:
            what = hider(
                bodies, parts, part_mesh_in, part_ball_in, T_world_part_in, i, o, T, hand_in[i], T_world_hand_in[i],
                receiver_in, eye_in[i, e], d, far - SKIN_M,
            )  # fmt: skip
        if what == 0 or found == OBJECT:
            found = what
    label_out[i, j] = wp.uint8(found)
