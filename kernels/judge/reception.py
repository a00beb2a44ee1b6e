"""Can a person take the object with a given grasp: the arm that brings the hand there, the gripper beside the hand, the
robot beside the arm, and the way from where the hand waits.

A pair is a trial and one receiving grasp of its object. Objects of revolution may be turned about their axis: a pair has an
angle of its own, and all its work is done in the object's frame turned by it.
"""

import warp as wp

from r2h_batch.kernels.geometry.angles import angle_of, arc_cosine, sin_cos
from r2h_batch.kernels.geometry.closest import from_segment
from r2h_batch.kernels.geometry.gjk import gjk
from r2h_batch.kernels.geometry.shape import BOX, CAPSULE, Shape
from r2h_batch.kernels.geometry.surface import inverse_pose
from r2h_batch.kernels.methods.hand_clearance import PosedHands, gripper_distance, gripper_overlap
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.receiver.grasps import Receiving, about_axis, unit, way_direction
from r2h_batch.kernels.robot.gripper import Gripper, drive_from_gap

from ..robot.joints import FRAMES, GRIPPER, vecq
from ..robot.world import (
    TrialBodies,
    World,
    body_pose,
    forward_kinematics,
    link_frame,
    object_shape,
    robot_shape,
)

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, it takes many times as long to compile

vec7 = wp.types.vector(length=7, dtype=float)
"""Angles of an arm, degrees: shoulder flexion and abduction, elbow, forearm (+ supinated), wrist flexion and deviation
(+ ulnar), lean of the trunk."""

SWIVEL_LOW = wp.constant(-30)
SWIVELS = wp.constant(16)
SWIVEL_STEP = wp.constant(10)
ELBOW_DEG = wp.constant(150.0)
TURN_DEG = wp.constant(80.0)
FLEXION_DEG = wp.constant(80.0)
EXTENSION_DEG = wp.constant(70.0)
RADIAL_DEG = wp.constant(20.0)
ULNAR_DEG = wp.constant(30.0)
SHOULDER_FLEXION_DEG = wp.constant(180.0)
SHOULDER_EXTENSION_DEG = wp.constant(60.0)
SHOULDER_ABDUCTION_DEG = wp.constant(180.0)
SHOULDER_ADDUCTION_DEG = wp.constant(75.0)
"""Ranges of the arm's joints (AAOS; docs/r2h_v3.md); those of the shoulder scale its effort and exclude no posture."""
ROUNDING = wp.constant(1.0e-4)
TAN_ULNAR, TAN_RADIAL = wp.constant(0.57736), wp.constant(0.36398)
"""Just beyond tan 30 and tan 20 degrees."""
MOST_FLEXED, MOST_EXTENDED = wp.constant(-0.98482), wp.constant(0.93971)
LEAST_INWARDS = wp.constant(0.030150)
"""Just beyond -sin 80, sin 70 and cos^2 80 degrees."""
PALM_M = wp.constant(0.10)
"""From the wrist to about the middle of the palm: how far angles of forearm and wrist move it [choice]."""
HEAD = wp.constant(3)
"""The last limb: forearm, upper arm, torso, head."""
FOREARM_POINTS = wp.constant(9)
"""Points of the forearm that must lie outside the torso's box, as when persons are placed (trials/draw/receivers.py)."""

WAY_M = wp.constant(0.10)
"""Length of the straight ends of the ways: of the hand to the grasp, and of the gripper back from the object."""
WAYS = wp.constant(3)
TOUCH_M = wp.constant(1.0e-4)
NEAR_M = wp.constant(0.03)
FAR_M = wp.constant(0.05)
"""Distances are computed up to these: to know whether bodies meet, for a step of a straight end, for one of the whole way."""
SLACK_M = wp.constant(1.0e-3)
"""A distance that was found may be smaller than the true one, by much less than this."""
MOST_STEPS = wp.constant(256)
LEAST_STEP = wp.constant(1.0 / 1024.0)
"""Of the way's parameter, where its rooms are measured."""
MOST_MEASURED = wp.constant(2050)
"""Steps that lead from 0 over 1 to 2, all of them the least."""


@wp.struct
class Arm:
    """A person's arm and trunk in one posture, world or hand frame."""

    shoulder: wp.vec3
    elbow: wp.vec3
    wrist: wp.vec3
    upper_radius: float
    lower_radius: float
    torso: wp.vec3  # the box's middle
    axes: wp.mat33  # its axes as columns: ahead, left, up
    half: wp.vec3
    chin: wp.vec3  # the head's capsule
    crown: wp.vec3
    head_radius: float


@wp.func
def rotation(T: wp.mat44):
    return wp.mat33(T[0, 0], T[0, 1], T[0, 2], T[1, 0], T[1, 1], T[1, 2], T[2, 0], T[2, 1], T[2, 2])


@wp.func
def position(T: wp.mat44):
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@wp.func
def trunk_axes(receiver: wp.array2d(dtype=wp.vec4), row: int, lean_deg: float):
    """Axes of the torso as columns (ahead, left, up), turned forwards by `lean_deg` about the hip; and the hip."""
    torso = receiver[row, 3]
    half = receiver[row, 4]
    s, c = sin_cos(wp.radians(lean_deg))
    ahead = wp.vec3(torso[3], half[3], 0.0)
    left = wp.vec3(-half[3], torso[3], 0.0)
    up = wp.vec3(0.0, 0.0, 1.0)
    axes = wp.matrix_from_cols(c * ahead - s * up, left, c * up + s * ahead)
    return axes, wp.vec3(torso[0], torso[1], torso[2] - half[2])


@wp.func
def leaned(receiver: wp.array2d(dtype=wp.vec4), row: int, lean_deg: float) -> Arm:
    """Trunk and shoulder of a person who leans; the elbow and wrist of the waiting posture."""
    upright, hip = trunk_axes(receiver, row, 0.0)
    axes, hip = trunk_axes(receiver, row, lean_deg)
    arm = Arm()
    arm.half = wp.vec3(receiver[row, 4][0], receiver[row, 4][1], receiver[row, 4][2])
    shoulder = wp.vec3(receiver[row, 0][0], receiver[row, 0][1], receiver[row, 0][2])
    arm.shoulder = hip + axes * (wp.transpose(upright) * (shoulder - hip))
    arm.elbow = wp.vec3(receiver[row, 1][0], receiver[row, 1][1], receiver[row, 1][2])
    arm.wrist = wp.vec3(receiver[row, 2][0], receiver[row, 2][1], receiver[row, 2][2])
    arm.upper_radius = receiver[row, 0][3]
    arm.lower_radius = receiver[row, 1][3]
    arm.torso = hip + axes * wp.vec3(0.0, 0.0, arm.half[2])
    arm.axes = axes
    return arm


@wp.func
def leaned_with_head(
    receiver: wp.array2d(dtype=wp.vec4), head: wp.array2d(dtype=wp.vec4), row: int, lean_deg: float
) -> Arm:
    """The same with the head (`scene.person.heads_of`), which leans with the trunk."""
    arm = leaned(receiver, row, lean_deg)
    upright, hip = trunk_axes(receiver, row, 0.0)
    turn = arm.axes * wp.transpose(upright)
    arm.chin = hip + turn * (wp.vec3(head[row, 0][0], head[row, 0][1], head[row, 0][2]) - hip)
    arm.crown = hip + turn * (wp.vec3(head[row, 1][0], head[row, 1][1], head[row, 1][2]) - hip)
    arm.head_radius = head[row, 0][3]
    return arm


@wp.func
def crosses_torso(arm: Arm):
    """Whether a point along the forearm lies in the torso's box."""
    for k in range(FOREARM_POINTS):
        t = float(k) / float(FOREARM_POINTS - 1)
        d = wp.transpose(arm.axes) * (arm.elbow + t * (arm.wrist - arm.elbow) - arm.torso)
        if wp.abs(d[0]) < arm.half[0] and wp.abs(d[1]) < arm.half[1] and wp.abs(d[2]) < arm.half[2]:
            return True
    return False


@wp.func
def share(angle: float, above: float, below: float):
    """An angle over its joint's range on its side."""
    return wp.where(angle >= 0.0, angle / above, angle / below)


@wp.func
def arm_angles(arm: Arm, outwards: float, along: wp.vec3, normal: wp.vec3) -> vec7:
    """The arm's joint angles in degrees (lean 0), from where its hand points and its palm faces (unit vectors).

    The inverse of how r2h-v1 draws a posture (`_hand_axes` of receivers.py): the forearm turns, then the wrist bends,
    then it goes aside.
    """
    u = unit(arm.elbow - arm.shoulder)
    f = unit(arm.wrist - arm.elbow)
    t = unit(wp.dot(u, f) * f - u)
    i = -outwards * wp.cross(t, f)
    n_f = wp.clamp(wp.dot(normal, f), -1.0, 1.0)
    turn = angle_of(wp.dot(normal, t), wp.dot(normal, i))
    s, c = sin_cos(turn)
    aside = c * t - s * i
    flexion = arc_cosine(n_f) - 1.5707963267948966  # -asin
    deviation = angle_of(-wp.dot(along, aside), wp.dot(along, unit(f - n_f * normal)))
    upper = wp.transpose(arm.axes) * u
    out = vec7()
    out[0] = wp.degrees(angle_of(upper[0], -upper[2]))
    out[1] = 90.0 - wp.degrees(arc_cosine(wp.clamp(outwards * upper[1], -1.0, 1.0)))
    out[2] = wp.degrees(arc_cosine(wp.clamp(wp.dot(u, f), -1.0, 1.0)))
    out[3] = wp.degrees(turn)
    out[4] = wp.degrees(flexion)
    out[5] = wp.degrees(deviation)
    return out


@wp.func
def square(x: float):
    return x * x


@wp.func
def forearm_may_turn(upper: wp.vec3, forearm: wp.vec3, outwards: float, normal: wp.vec3):
    """Whether the wrist's flexion and the forearm's turn can be within their ranges, without an arc: most postures end here.

    `arm_angles` and `within_ranges` decide what passes here.
    """
    # of the thumb's direction t only u - (u . f) f counts, however long it is: both parts of the turn scale with it
    n_f = wp.dot(normal, forearm)
    ahead = wp.dot(upper, forearm) * n_f - wp.dot(normal, upper)
    inwards = outwards * wp.dot(normal, wp.cross(upper, forearm))
    return (
        n_f >= MOST_FLEXED
        and n_f <= MOST_EXTENDED
        and inwards >= 0.0
        and square(inwards) >= LEAST_INWARDS * (square(ahead) + square(inwards))
    )


@wp.struct
class Swivels:
    """Palm and hand against upper arm u and forearm f while the elbow swivels about the line from shoulder to wrist: few
    products of numbers say of most swivels that a joint is out of its range.

    With t along that line, h hanging and a outwards, both at right angles to it, and p = c h + s a:
    u = (m / U) t + (b / U) p, f = ((r - m) / L) t - (b / L) p, u x f = -(b r / (U L)) t x p.
    """

    f_t: float  # (r - m) / L
    f_p: float  # b / L
    u_t: float  # m / U
    u_p: float  # b / U
    u_f: float  # u . f
    across: float  # b r / (U L)
    normal: wp.vec3  # along t, h, a
    along: wp.vec3
    thumb: wp.vec3  # along x normal, times `outwards`
    slant: float  # along . normal


@wp.func
def swivels_of(
    to: wp.vec3, hanging: wp.vec3, aside: wp.vec3, normal: wp.vec3, along: wp.vec3, outwards: float, r: float,
    middle: float, offset: float, upper: float, lower: float,
) -> Swivels:  # fmt: skip
    w = Swivels()
    w.f_t = (r - middle) / lower
    w.f_p = offset / lower
    w.u_t = middle / upper
    w.u_p = offset / upper
    w.u_f = (r * r - upper * upper - lower * lower) / (2.0 * upper * lower)
    w.across = offset * r / (upper * lower)
    frame = wp.matrix_from_rows(to, hanging, aside)
    w.normal = frame * normal
    w.along = frame * along
    w.thumb = outwards * (frame * wp.cross(along, normal))
    w.slant = wp.dot(along, normal)
    return w


@wp.func
def swivel_may_turn(w: Swivels, s: float, c: float):
    """Whether forearm and wrist may be within their ranges: False only where `forearm_may_turn` or `within_ranges` is."""
    n_p = c * w.normal[1] + s * w.normal[2]
    n_f = w.f_t * w.normal[0] - w.f_p * n_p
    ahead = w.u_f * n_f - (w.u_t * w.normal[0] + w.u_p * n_p)
    inwards = w.across * (s * w.normal[1] - c * w.normal[2])
    # the wrist's deviation has the tangent y / x: `arm_angles`' axis aside is outwards * normal x f, but for its length
    y = w.f_p * (c * w.thumb[1] + s * w.thumb[2]) - w.f_t * w.thumb[0]
    x = w.f_t * w.along[0] - w.f_p * (c * w.along[1] + s * w.along[2]) - n_f * w.slant
    return (
        n_f >= MOST_FLEXED - ROUNDING
        and n_f <= MOST_EXTENDED + ROUNDING
        and inwards >= -ROUNDING
        and square(inwards) + ROUNDING >= LEAST_INWARDS * (square(ahead) + square(inwards))
        and x >= -ROUNDING
        and y <= TAN_ULNAR * x + ROUNDING
        and y >= -TAN_RADIAL * x - ROUNDING
    )


@wp.func
def effort_of(a: vec7):
    """Mean square of the angles over their ranges, and of the lean over 60 degrees."""
    c = square(share(a[0], SHOULDER_FLEXION_DEG, SHOULDER_EXTENSION_DEG))
    c += square(share(a[1], SHOULDER_ABDUCTION_DEG, SHOULDER_ADDUCTION_DEG))
    c += square((a[2] - 80.0) / 75.0)
    c += square(a[3] / TURN_DEG)
    c += square(share(a[4], FLEXION_DEG, EXTENSION_DEG))
    c += square(share(a[5], ULNAR_DEG, RADIAL_DEG))
    return c / 6.0 + square(a[6] / 60.0)


@wp.func
def within_ranges(a: vec7):
    return (
        a[2] <= ELBOW_DEG
        and wp.abs(a[3]) <= TURN_DEG
        and a[4] <= FLEXION_DEG
        and a[4] >= -EXTENSION_DEG
        and a[5] <= ULNAR_DEG
        and a[5] >= -RADIAL_DEG
    )


@wp.func
def beyond_ranges(a: vec7, lower: float):
    """How far (m) an arm's joint is beyond its range, of the worst one; below 0: all are within. An angle counts as the way
    of what it moves: the wrist by the elbow, the palm by forearm and wrist."""
    most = (a[2] - ELBOW_DEG) * lower
    most = wp.max(most, (wp.abs(a[3]) - TURN_DEG) * PALM_M)
    most = wp.max(most, wp.max(a[4] - FLEXION_DEG, -EXTENSION_DEG - a[4]) * PALM_M)
    most = wp.max(most, wp.max(a[5] - ULNAR_DEG, -RADIAL_DEG - a[5]) * PALM_M)
    return wp.radians(most)


@wp.kernel
def arm_rooms(
    first: int, receiver: wp.array2d(dtype=wp.vec4), trial_in: wp.array(dtype=int), angles_in: wp.array(dtype=vec7),
    rooms_out: wp.array(dtype=wp.vec2),
):  # fmt: skip
    """By how much (m) the arm of each pair's posture is longer than it is stretched, and its joints are within their ranges."""
    pair = first + wp.tid()
    arm = leaned(receiver, trial_in[pair], 0.0)
    upper = wp.length(arm.elbow - arm.shoulder)
    lower = wp.length(arm.wrist - arm.elbow)
    a = angles_in[pair]
    _, bent = sin_cos(wp.radians(a[2]))
    stretched = wp.sqrt(upper * upper + lower * lower + 2.0 * upper * lower * bent)
    # upper + lower - stretched, of which float32 leaves little where the arm is nearly straight
    half_sine, _ = sin_cos(wp.radians(0.5 * a[2]))
    longer = 4.0 * upper * lower * half_sine * half_sine / (upper + lower + stretched)
    rooms_out[pair] = wp.vec2(longer, -beyond_ranges(a, lower))


@wp.kernel
def short_of_reach(
    first: int,
    grasps: Receiving, lean_in: wp.array(dtype=float),
    asked_in: wp.array(dtype=wp.bool), row_in: wp.array(dtype=int), count_in: wp.array(dtype=int),
    object_in: wp.array(dtype=int), outwards_in: wp.array(dtype=float), T_world_obj_in: wp.array(dtype=wp.mat44),
    receiver_in: wp.array2d(dtype=wp.vec4), turn_in: wp.array2d(dtype=float),
    short_out: wp.array2d(dtype=float),
):  # fmt: skip
    """What the arm lacks (m) of grasp k of each trial that is asked: of the posture that lacks least, of those leans and
    swivels that `reach_with_arm` tries and whose forearm does not pass through the torso. Too far away, or too near the
    shoulder: by how much; else how far a joint is beyond its range."""
    i, k = wp.tid()
    trial = first + i
    least = float(1.0e30)
    if asked_in[trial] and k < count_in[trial]:
        row = row_in[trial] + k
        R_turn, p_turn = about_axis(grasps, object_in[trial], turn_in[trial, k])
        R = rotation(T_world_obj_in[trial]) * R_turn
        wrist = R * grasps.wrist[row] + rotation(T_world_obj_in[trial]) * p_turn + position(T_world_obj_in[trial])
        waiting = leaned(receiver_in, trial, 0.0)
        upper = wp.length(waiting.elbow - waiting.shoulder)
        lower = wp.length(waiting.wrist - waiting.elbow)
        for j in range(lean_in.shape[0]):
            arm = leaned(receiver_in, trial, lean_in[j])
            arm.wrist = wrist
            to = wrist - arm.shoulder
            r = wp.length(to)
            apart = wp.max(r - (upper + lower), wp.abs(upper - lower) - r)
            if apart >= 0.0:
                least = wp.min(least, apart)
            else:
                to = to / r
                middle = (upper * upper - lower * lower + r * r) / (2.0 * r)
                offset = wp.sqrt(wp.max(upper * upper - middle * middle, 0.0))
                down = wp.vec3(0.0, 0.0, -1.0)
                hanging = unit(down - wp.dot(down, to) * to)
                aside = outwards_in[trial] * wp.cross(to, hanging)
                for swivel in range(SWIVELS):
                    s, c = sin_cos(wp.radians(float(SWIVEL_LOW + SWIVEL_STEP * swivel)))
                    arm.elbow = arm.shoulder + middle * to + offset * (c * hanging + s * aside)
                    a = arm_angles(arm, outwards_in[trial], R * grasps.along[row], R * grasps.normal[row])
                    beyond = wp.max(beyond_ranges(a, lower), 0.0)
                    if beyond < least and not crosses_torso(arm):
                        least = beyond
    short_out[trial, k] = least


@wp.kernel
def reach_with_arm(
    first: int,
    # tables
    grasps: Receiving,
    lean_in: wp.array(dtype=float),  # degrees, the leans that are tried
    # trials
    row_in: wp.array(dtype=int), count_in: wp.array(dtype=int), object_in: wp.array(dtype=int),
    outwards_in: wp.array(dtype=float),  # -1 of right arms, 1 of left ones
    T_world_obj_in: wp.array(dtype=wp.mat44), T_world_hand_in: wp.array(dtype=wp.mat44),
    receiver_in: wp.array2d(dtype=wp.vec4),
    # out
    effort_out: wp.array2d(dtype=float), turn_out: wp.array2d(dtype=float), angles_out: wp.array2d(dtype=vec7),
    elbow_out: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """The posture of least effort that brings the hand to grasp k of each trial; effort -1 where no posture does.

    Leans and swivels of the elbow about the line from shoulder to wrist are tried; the rest follows. Every second grasp of an
    object of revolution is turned to where the hand turns least from how it waits.
    """
    i, k = wp.tid()
    trial = first + i
    effort_out[trial, k] = -1.0
    if k >= count_in[trial]:
        return
    row = row_in[trial] + k
    obj = object_in[trial]
    outwards = outwards_in[trial]
    R_world_obj = rotation(T_world_obj_in[trial])
    turn = float(0.0)
    u = grasps.axis[obj]
    if k % 2 == 1 and wp.length_sq(u) > 0.0:
        # the turn that maximises trace(R_wait^T R_world_obj Rot(u, turn) R_grasp)
        M = grasps.R[row] * wp.transpose(rotation(T_world_hand_in[trial])) * R_world_obj
        v = wp.vec3(M[1, 2] - M[2, 1], M[2, 0] - M[0, 2], M[0, 1] - M[1, 0])
        turn = angle_of(wp.dot(u, v), M[0, 0] + M[1, 1] + M[2, 2] - wp.dot(u, M * u))
    turn_out[trial, k] = turn
    R_turn, p_turn = about_axis(grasps, obj, turn)
    R = R_world_obj * R_turn
    wrist = R * grasps.wrist[row] + R_world_obj * p_turn + position(T_world_obj_in[trial])
    along = R * grasps.along[row]
    normal = R * grasps.normal[row]

    waiting = leaned(receiver_in, trial, 0.0)
    upper = wp.length(waiting.elbow - waiting.shoulder)
    lower = wp.length(waiting.wrist - waiting.elbow)
    best = float(1.0e30)
    turns = wp.zeros(shape=SWIVELS, dtype=wp.vec2)
    for swivel in range(SWIVELS):
        sine, cosine = sin_cos(wp.radians(float(SWIVEL_LOW + SWIVEL_STEP * swivel)))
        turns[swivel] = wp.vec2(sine, cosine)
    for j in range(lean_in.shape[0]):
        arm = leaned(receiver_in, trial, lean_in[j])
        arm.wrist = wrist
        to = wrist - arm.shoulder
        r = wp.length(to)
        if r < upper + lower and r > wp.abs(upper - lower) and square(lean_in[j] / 60.0) < best:
            to = to / r
            middle = (upper * upper - lower * lower + r * r) / (2.0 * r)
            offset = wp.sqrt(wp.max(upper * upper - middle * middle, 0.0))
            down = wp.vec3(0.0, 0.0, -1.0)
            hanging = unit(down - wp.dot(down, to) * to)
            aside = outwards * wp.cross(to, hanging)
            all_of = swivels_of(to, hanging, aside, normal, along, outwards, r, middle, offset, upper, lower)
            for swivel in range(SWIVELS):
                s = turns[swivel][0]
                c = turns[swivel][1]
                if swivel_may_turn(all_of, s, c):
                    out = middle * to + offset * (c * hanging + s * aside)
                    arm.elbow = arm.shoulder + out
                    if forearm_may_turn(out / upper, (wrist - arm.elbow) / lower, outwards, normal):
                        a = arm_angles(arm, outwards, along, normal)
                        a[6] = lean_in[j]
                        effort = effort_of(a)
                        if effort < best and within_ranges(a) and not crosses_torso(arm):
                            best = effort
                            effort_out[trial, k] = effort
                            angles_out[trial, k] = a
                            elbow_out[trial, k] = arm.elbow


@wp.func
def free_straight(
    gripper: Gripper, hands: PosedHands, row: int, R: wp.mat33, p: wp.vec3, drive: float, step: wp.vec3, eps: float,
    begin: float,
):  # fmt: skip
    """How far (m) gripper and hand keep more than `eps` while the hand goes by `step` per metre, ee frame: WAY_M or more is
    the whole way; `begin`: their distance before, up to NEAR_M.

    Certified: no point moves farther than the parameter, so nothing meets within a distance that was measured.
    """
    s = float(0.0)
    d = float(begin)
    for _ in range(MOST_STEPS):
        if d <= eps:
            break
        s += d
        if s >= WAY_M:
            break
        # after a way of d the hand is no farther away than 2 d
        d = gripper_distance(gripper, hands, row, R, p + s * step, drive, wp.min(2.0 * d + SLACK_M, NEAR_M))
    return s


@wp.func
def in_turned_object(grasps: Receiving, obj: int, turn: float, attached: wp.mat44):
    """R, p from the object's frame, turned about its axis of revolution, to ee."""
    R_ee, p_ee = inverse_pose(attached)
    R_turn, p_turn = about_axis(grasps, obj, turn)
    return R_ee * R_turn, R_ee * p_turn + p_ee


@wp.kernel
def come_to_object(
    first: int,
    # tables
    gripper: Gripper, hands: PosedHands, grasps: Receiving, eps: float,
    # pairs
    row_in: wp.array(dtype=int), turn_in: wp.array(dtype=float), object_in: wp.array(dtype=int),
    attached_in: wp.array(dtype=wp.mat44),  # of each pair's trial, as are the openings
    opening_in: wp.array(dtype=float),
    # out
    free_out: wp.array(dtype=wp.bool), way_out: wp.array(dtype=int), far_out: wp.array(dtype=float),
):  # fmt: skip
    """Whether each pair's hand is clear of the closed gripper, the first direction from which it can come (-1: none), and the
    farthest (m) that one of those before it is free, from the grasp on."""
    pair = first + wp.tid()
    row = row_in[pair]
    R, p = in_turned_object(grasps, object_in[pair], turn_in[pair], attached_in[pair])
    drive = drive_from_gap(gripper, opening_in[pair])
    way = int(-1)
    far = float(0.0)
    free = gripper_distance(gripper, hands, row, R, p, drive, eps + 1.0e-4) > eps
    if free:
        begin = gripper_distance(gripper, hands, row, R, p, drive, NEAR_M)
        for which in range(WAYS):
            if way < 0:
                step = -(R * way_direction(grasps, row, which))
                along = free_straight(gripper, hands, row, R, p, drive, step, eps, begin)
                far = wp.max(far, along)
                if along >= WAY_M:
                    way = which
    free_out[pair] = free
    way_out[pair] = way
    far_out[pair] = far


@wp.kernel
def overlap_of_hand(
    first: int, gripper: Gripper, hands: PosedHands, grasps: Receiving, eps: float,
    row_in: wp.array(dtype=int), turn_in: wp.array(dtype=float), object_in: wp.array(dtype=int),
    attached_in: wp.array(dtype=wp.mat44), opening_in: wp.array(dtype=float),
    room_out: wp.array(dtype=float),
):  # fmt: skip
    """The room (m) beyond `eps` between each pair's hand and the closed gripper, where `come_to_object` finds none: 0 at most,
    and lower by how deep they meet."""
    pair = first + wp.tid()
    R, p = in_turned_object(grasps, object_in[pair], turn_in[pair], attached_in[pair])
    drive = drive_from_gap(gripper, opening_in[pair])
    d = gripper_distance(gripper, hands, row_in[pair], R, p, drive, eps)
    if d <= 0.0:
        d = gripper_overlap(gripper, hands, row_in[pair], R, p, drive)
    room_out[pair] = d - eps


@wp.kernel
def let_go(
    first: int, gripper: Gripper, hands: PosedHands, grasps: Receiving, eps: float, open_gap: float,
    row_in: wp.array(dtype=int), turn_in: wp.array(dtype=float), object_in: wp.array(dtype=int),
    attached_in: wp.array(dtype=wp.mat44), opening_in: wp.array(dtype=float),
    back_out: wp.array(dtype=float),
):  # fmt: skip
    """How far (m) the fingers can back off with the object in each pair's hand, once they have opened (looked at in three
    openings): WAY_M or more is all that is asked; 0: they cannot open."""
    pair = first + wp.tid()
    row = row_in[pair]
    R, p = in_turned_object(grasps, object_in[pair], turn_in[pair], attached_in[pair])
    gap = opening_in[pair]
    opens = bool(True)
    for k in range(2):  # the third is where the gripper begins to back off
        wider = drive_from_gap(gripper, gap + (open_gap - gap) * float(k + 1) / 3.0)
        if opens and gripper_distance(gripper, hands, row, R, p, wider, eps + 1.0e-4) <= eps:
            opens = bool(False)
    back = float(0.0)
    if opens:
        # the gripper backs off along its -z: seen from it, the hand goes along z
        opened = drive_from_gap(gripper, open_gap)
        begin = gripper_distance(gripper, hands, row, R, p, opened, NEAR_M)
        back = free_straight(gripper, hands, row, R, p, opened, wp.vec3(0.0, 0.0, 1.0), eps, begin)
    back_out[pair] = back


@wp.func
def frame_along(z: wp.vec3):
    """A rotation whose third column is z."""
    helper = wp.where(wp.abs(z[0]) > 0.7, wp.vec3(0.0, 1.0, 0.0), wp.vec3(1.0, 0.0, 0.0))
    x = unit(wp.cross(helper, z))
    return wp.matrix_from_cols(x, wp.cross(z, x), z)


@wp.func
def limb_gap(arm: Arm, limb: int, c0: wp.vec3, c1: wp.vec3):
    """Lower bound (m) on the distance of a segment from a limb: forearm, upper arm, the torso's box, or the head."""
    if limb == 2:
        # of the box around the segment, along the torso's axes
        a = wp.transpose(arm.axes) * (c0 - arm.torso)
        b = wp.transpose(arm.axes) * (c1 - arm.torso)
        gap = wp.vec3(0.0, 0.0, 0.0)
        for k in range(3):
            gap[k] = wp.max(wp.max(wp.min(a[k], b[k]), -wp.max(a[k], b[k])) - arm.half[k], 0.0)
        return wp.length(gap)
    if limb == HEAD:
        return wp.length(from_segment(arm.chin, arm.crown, c0, c1)) - arm.head_radius
    if limb == 1:
        return wp.length(from_segment(arm.shoulder, arm.elbow, c0, c1)) - arm.upper_radius
    return wp.length(from_segment(arm.elbow, arm.wrist, c0, c1)) - arm.lower_radius


@wp.func
def limb_shape(arm: Arm, limb: int):
    """A limb as a shape, and its frame: R, p."""
    shape = Shape()
    if limb == 2:
        shape.kind = BOX
        shape.size = arm.half
        return shape, arm.axes, arm.torso
    a = wp.where(limb == 0, arm.elbow, arm.shoulder)
    b = wp.where(limb == 0, arm.wrist, arm.elbow)
    shape.kind = CAPSULE
    shape.radius = wp.where(limb == 0, arm.lower_radius, arm.upper_radius)
    if limb == HEAD:
        a = arm.chin
        b = arm.crown
        shape.radius = arm.head_radius
    shape.size = wp.vec3(shape.radius, 0.5 * wp.length(b - a), 0.0)
    return shape, frame_along(unit(b - a)), 0.5 * (a + b)


@wp.func
def above_floor(lower: float, upper: float, floor: float):
    """A distance by its bounds: below 0 the upper one, which is no deeper than bodies meet."""
    d = wp.max(lower, 0.0)
    if floor < 0.0 and lower < 0.0:
        d = wp.max(wp.min(upper, 0.0), floor)
    return d


@wp.func
def arm_distance(
    world: World, bodies: TrialBodies, trial: int, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), arm: Arm,
    cap: float, floor: float,
):  # fmt: skip
    """Distance (m) of the robot (without the object) from forearm, upper arm, torso and head, all in the world's hand frame:
    `cap` at most. Where they meet it is 0, or with a `floor` below 0 minus how deep, as far as radii tell. R, p: the links'
    frames (`forward_kinematics`)."""
    best = float(cap)
    none = wp.vec3(0.0, 0.0, 0.0)
    for link in range(GRIPPER + 1):
        k = link_frame(link)
        l0 = R[k] * world.link_c0[link] + p[k]
        l1 = R[k] * world.link_c1[link] + p[k]
        for limb in range(HEAD + 1):
            if best > floor and limb_gap(arm, limb, l0, l1) - world.link_radius[link] < best:
                other, frame, middle = limb_shape(arm, limb)
                inverse = wp.transpose(frame)
                for b in range(world.link_first[link], world.link_first[link + 1]):
                    Rb, pb = body_pose(world, bodies, trial, R, p, b)
                    axis = Rb * world.cap_axis[b]
                    if best > floor and limb_gap(arm, limb, pb - axis, pb + axis) - world.cap_radius[b] < best:
                        d = gjk(
                            robot_shape(world, b), inverse * Rb, inverse * (pb - middle), world.points,
                            other, world.points, none, best, 0.0,
                        )  # fmt: skip
                        best = wp.min(best, above_floor(d.lower, d.upper, floor))
    return best


@wp.func
def head_distance(
    world: World, bodies: TrialBodies, trial: int, R: wp.array(dtype=wp.mat33), p: wp.array(dtype=wp.vec3), arm: Arm,
    cap: float, floor: float,
):  # fmt: skip
    """Distance (m) of the head from the object in the gripper, whose hulls are those of planning; as of `arm_distance`."""
    best = float(cap)
    none = wp.vec3(0.0, 0.0, 0.0)
    Rb, pb = body_pose(world, bodies, trial, R, p, world.n_robot)
    other, frame, middle = limb_shape(arm, HEAD)
    inverse = wp.transpose(frame)
    obj = bodies.object[trial]
    for hull in range(world.hull_first[obj], world.hull_first[obj + 1]):
        c0 = Rb * world.hull_c0[hull] + pb
        c1 = Rb * world.hull_c1[hull] + pb
        if best > floor and limb_gap(arm, HEAD, c0, c1) - world.hull_radius[hull] < best:
            d = gjk(
                object_shape(world, hull), inverse * Rb, inverse * (pb - middle), world.points,
                other, world.points, none, best, 0.0,
            )  # fmt: skip
            best = wp.min(best, above_floor(d.lower, d.upper, floor))
    return best


@wp.func
def into_hand_frame(arm: Arm, R: wp.mat33, p: wp.vec3) -> Arm:
    """The arm in the frame in which the robot's bodies are: `TrialBodies`' R_hand_world, p_hand_world."""
    arm.shoulder = R * arm.shoulder + p
    arm.elbow = R * arm.elbow + p
    arm.wrist = R * arm.wrist + p
    arm.torso = R * arm.torso + p
    arm.axes = R * arm.axes
    arm.chin = R * arm.chin + p
    arm.crown = R * arm.crown + p
    return arm


@wp.func
def arm_at(
    bodies: TrialBodies, receiver: wp.array2d(dtype=wp.vec4), head: wp.array2d(dtype=wp.vec4), trial: int, lean: float,
    elbow: wp.vec3, wrist: wp.vec3,
):  # fmt: skip
    """A trial's arm, trunk and head in a posture that reaches a grasp, in the hand's frame."""
    arm = leaned_with_head(receiver, head, trial, lean)
    arm.elbow = elbow
    arm.wrist = wrist
    return into_hand_frame(arm, bodies.R_hand_world[trial], bodies.p_hand_world[trial])


@wp.kernel
def arm_clears_robot(
    first: int, world: World, bodies: TrialBodies, receiver: wp.array2d(dtype=wp.vec4), head: wp.array2d(dtype=wp.vec4),
    q: wp.array(dtype=vecq), trial_in: wp.array(dtype=int), lean_in: wp.array(dtype=float), elbow_in: wp.array(dtype=wp.vec3),
    wrist_in: wp.array(dtype=wp.vec3), clear_out: wp.array(dtype=wp.bool),
):  # fmt: skip
    """Whether the robot at its goal meets neither arm, torso nor head of each pair's posture, and the object not the head."""
    pair = first + wp.tid()
    trial = trial_in[pair]
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q[trial], R, p)
    arm = arm_at(bodies, receiver, head, trial, lean_in[pair], elbow_in[pair], wrist_in[pair])
    clear = head_distance(world, bodies, trial, R, p, arm, TOUCH_M, 0.0) > 0.0
    clear_out[pair] = clear and arm_distance(world, bodies, trial, R, p, arm, TOUCH_M, 0.0) > 0.0


@wp.kernel
def overlap_of_person(
    first: int, world: World, bodies: TrialBodies, receiver: wp.array2d(dtype=wp.vec4), head: wp.array2d(dtype=wp.vec4),
    q: wp.array(dtype=vecq), trial_in: wp.array(dtype=int), lean_in: wp.array(dtype=float), elbow_in: wp.array(dtype=wp.vec3),
    wrist_in: wp.array(dtype=wp.vec3), room_out: wp.array(dtype=float),
):  # fmt: skip
    """Minus how deep (m) the robot and each pair's arm, torso and head meet, or the object and the head."""
    pair = first + wp.tid()
    trial = trial_in[pair]
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q[trial], R, p)
    arm = arm_at(bodies, receiver, head, trial, lean_in[pair], elbow_in[pair], wrist_in[pair])
    room = head_distance(world, bodies, trial, R, p, arm, TOUCH_M, -1.0)
    room_out[pair] = wp.min(arm_distance(world, bodies, trial, R, p, arm, room, -1.0), 0.0)


@wp.struct
class Way:
    """How hand and arm go from where they wait to a grasp. The wrist's places are in the turned object's frame.

    The wrist goes straight to 10 cm before the grasp while the hand turns about one axis, then straight in (`way_direction`);
    elbow, shoulder and lean go in proportion. The hand has the grasp's shape all the way. The parameter t is 0 where the hand
    waits, 1 before the grasp, 2 there.
    """

    trial: int
    row: int
    R_world: wp.mat33  # from the turned object's frame
    p_world: wp.vec3
    R_ee: wp.mat33
    p_ee: wp.vec3
    drive: float
    waits: wp.vec3
    before: wp.vec3
    target: wp.vec3
    axis: wp.vec3  # from the waiting hand's orientation to the grasp's
    angle: float
    size: float  # of the hand, from the wrist
    lean: float
    elbow_waits: wp.vec3
    elbow: wp.vec3
    joints: float  # no point of shoulder, elbow and trunk goes farther per unit of t


@wp.func
def way_of(
    hands: PosedHands, grasps: Receiving, gripper: Gripper, receiver: wp.array2d(dtype=wp.vec4),
    head: wp.array2d(dtype=wp.vec4), trial: int, row: int, turn: float, which: int, obj: int, attached: wp.mat44,
    opening: float, T_world_obj: wp.mat44, T_world_hand: wp.mat44, lean: float, elbow: wp.vec3,
) -> Way:  # fmt: skip
    way = Way()
    way.trial = trial
    way.row = row
    R_turn, p_turn = about_axis(grasps, obj, turn)
    way.R_world = rotation(T_world_obj) * R_turn
    way.p_world = rotation(T_world_obj) * p_turn + position(T_world_obj)
    R_ee, p_ee = in_turned_object(grasps, obj, turn, attached)
    way.R_ee = R_ee
    way.p_ee = p_ee
    way.drive = drive_from_gap(gripper, opening)

    start = leaned(receiver, trial, 0.0)
    goal = leaned_with_head(receiver, head, trial, lean)
    way.lean = lean
    way.elbow_waits = start.elbow
    way.elbow = elbow
    way.target = grasps.wrist[row]
    way.before = way.target + WAY_M * way_direction(grasps, row, which) * -1.0
    way.waits = wp.transpose(way.R_world) * (start.wrist - way.p_world)
    R_waits = wp.transpose(way.R_world) * rotation(T_world_hand)
    axis, angle = wp.quat_to_axis_angle(wp.quat_from_matrix(grasps.R[row] * wp.transpose(R_waits)))
    if angle > 3.141592653589793:
        angle = 6.283185307179586 - angle
        axis = -axis
    way.axis = axis
    way.angle = angle
    size = float(0.0)
    for piece in range(hands.n_pieces):
        ball = hands.ball[row * hands.n_pieces + piece]
        size = wp.max(size, wp.length(wp.vec3(ball[0], ball[1], ball[2]) - way.target) + ball[3])
    way.size = size

    # no point of trunk and head is farther from the hip, about which they turn
    hip = goal.torso - goal.axes * wp.vec3(0.0, 0.0, goal.half[2])
    top = wp.max(wp.length(goal.chin - hip), wp.length(goal.crown - hip)) + goal.head_radius
    trunk = wp.radians(lean) * wp.max(2.0 * goal.half[2] + wp.length(goal.half), top)
    way.joints = 0.5 * wp.max(wp.max(wp.length(goal.shoulder - start.shoulder), wp.length(elbow - start.elbow)), trunk)
    return way


@wp.func
def speeds_on_way(way: Way, t: float) -> wp.vec2:
    """The farthest (m) that a point of the hand, and of arm, trunk and head, goes per unit of t; both change at 1."""
    travel = WAY_M
    if t < 1.0:
        travel = wp.length(way.before - way.waits)
    speed = travel + wp.where(t < 1.0, way.angle * way.size, 0.0)
    return wp.vec2(wp.max(speed, 1.0e-6), wp.max(wp.max(way.joints, travel), 1.0e-6))


@wp.func
def farther_on_way(way: Way, t: float, d: float, e: float):
    """Where the hand has gone at most `d` from t on, and the body `e`; both speeds change at 1."""
    speeds = speeds_on_way(way, t)
    return wp.min(t + wp.min(d / speeds[0], e / speeds[1]), wp.where(t < 1.0, 1.0, 2.0))


@wp.func
def gaps_on_way(
    world: World, bodies: TrialBodies, gripper: Gripper, hands: PosedHands, receiver: wp.array2d(dtype=wp.vec4),
    head: wp.array2d(dtype=wp.vec4), links: wp.array(dtype=wp.mat33), origins: wp.array(dtype=wp.vec3), way: Way, t: float,
    caps: wp.vec2,
) -> wp.vec2:  # fmt: skip
    """Distances (m, up to `caps`) at t: of hand and gripper; and of arm, torso and head from the robot, or of head and object."""
    wrist = way.before + (t - 1.0) * (way.target - way.before)
    turn_left = float(0.0)
    if t < 1.0:
        wrist = way.waits + t * (way.before - way.waits)
        turn_left = 1.0 - t
    R_back = wp.quat_to_matrix(wp.quat_from_axis_angle(way.axis, -turn_left * way.angle))
    d = gripper_distance(
        gripper, hands, way.row, way.R_ee * R_back, way.R_ee * (wrist - R_back * way.target) + way.p_ee, way.drive, caps[0],
    )  # fmt: skip
    elbow = way.elbow_waits + 0.5 * t * (way.elbow - way.elbow_waits)
    arm = arm_at(bodies, receiver, head, way.trial, 0.5 * t * way.lean, elbow, way.R_world * wrist + way.p_world)
    e = arm_distance(world, bodies, way.trial, links, origins, arm, caps[1], 0.0)
    return wp.vec2(d, wp.min(e, head_distance(world, bodies, way.trial, links, origins, arm, caps[1], 0.0)))


@wp.func
def caps_on_way(gaps: wp.vec2, moved: wp.vec2) -> wp.vec2:
    """No distance is larger than these (m, up to FAR_M) after hand and body have moved."""
    return wp.vec2(wp.min(gaps[0] + moved[0] + SLACK_M, FAR_M), wp.min(gaps[1] + moved[1] + SLACK_M, FAR_M))


@wp.kernel
def way_to_grasp(
    first: int,
    # tables
    world: World, bodies: TrialBodies, gripper: Gripper, hands: PosedHands, grasps: Receiving,
    receiver: wp.array2d(dtype=wp.vec4), head: wp.array2d(dtype=wp.vec4), q: wp.array(dtype=vecq), eps: float,
    # pairs
    trial_in: wp.array(dtype=int), row_in: wp.array(dtype=int), turn_in: wp.array(dtype=float),
    way_in: wp.array(dtype=int), object_in: wp.array(dtype=int), attached_in: wp.array(dtype=wp.mat44),
    opening_in: wp.array(dtype=float), T_world_obj_in: wp.array(dtype=wp.mat44),
    T_world_hand_in: wp.array(dtype=wp.mat44), lean_in: wp.array(dtype=float),
    elbow_in: wp.array(dtype=wp.vec3),
    # out
    free_out: wp.array(dtype=wp.bool), left_out: wp.array(dtype=float),
):  # fmt: skip
    """Whether hand and arm come from where they wait to the grasp (`Way`) without meeting gripper and robot, and the head keeps
    off the object; and how far (m) the wrist would still have to go from where something meets.

    Certified: with d the distance and L the farthest that a point goes per unit of the parameter, nothing meets within d / L.
    """
    pair = first + wp.tid()
    trial = trial_in[pair]
    links = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    origins = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q[trial], links, origins)
    way = way_of(
        hands, grasps, gripper, receiver, head, trial, row_in[pair], turn_in[pair], way_in[pair], object_in[pair],
        attached_in[pair], opening_in[pair], T_world_obj_in[pair], T_world_hand_in[pair], lean_in[pair], elbow_in[pair],
    )  # fmt: skip
    t = float(0.0)
    free = bool(False)
    caps = wp.vec2(FAR_M, FAR_M)
    for _ in range(MOST_STEPS):
        gaps = gaps_on_way(world, bodies, gripper, hands, receiver, head, links, origins, way, t, caps)
        if gaps[0] <= eps or gaps[1] <= TOUCH_M:
            break
        if t >= 2.0:
            free = bool(True)
            break
        then = farther_on_way(way, t, gaps[0], gaps[1])
        caps = caps_on_way(gaps, (then - t) * speeds_on_way(way, t))
        t = then
    free_out[pair] = free
    left_out[pair] = (2.0 - t) * WAY_M
    if t < 1.0:
        left_out[pair] = (1.0 - t) * wp.length(way.before - way.waits) + WAY_M


@wp.kernel
def rooms_on_way(
    first: int,
    # tables
    world: World, bodies: TrialBodies, gripper: Gripper, hands: PosedHands, grasps: Receiving,
    receiver: wp.array2d(dtype=wp.vec4), head: wp.array2d(dtype=wp.vec4), q: wp.array(dtype=vecq), eps: float,
    tolerance: float, share: float,
    # pairs
    trial_in: wp.array(dtype=int), row_in: wp.array(dtype=int), turn_in: wp.array(dtype=float),
    way_in: wp.array(dtype=int), object_in: wp.array(dtype=int), attached_in: wp.array(dtype=wp.mat44),
    opening_in: wp.array(dtype=float), T_world_obj_in: wp.array(dtype=wp.mat44),
    T_world_hand_in: wp.array(dtype=wp.mat44), lean_in: wp.array(dtype=float),
    elbow_in: wp.array(dtype=wp.vec3), enough_in: wp.array(dtype=float),
    # out
    rooms_out: wp.array(dtype=wp.vec2), capped_out: wp.array(dtype=wp.bool),
):  # fmt: skip
    """The room (m, up to FAR_M) that a free way leaves between hand and gripper, and to arm, torso and head: at the grasp beyond
    what is asked there, before it to touching. Where it is less than `enough`, it is right to the tolerance or the `share` of
    it, what is more, but always to half of it; and never more than the truth. `capped`: nothing is nearer than was looked.

    Certified: steps are so short that nothing comes nearer than the least room so far less what it may be wrong by.
    """
    pair = first + wp.tid()
    trial = trial_in[pair]
    links = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    origins = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q[trial], links, origins)
    way = way_of(
        hands, grasps, gripper, receiver, head, trial, row_in[pair], turn_in[pair], way_in[pair], object_in[pair],
        attached_in[pair], opening_in[pair], T_world_obj_in[pair], T_world_hand_in[pair], lean_in[pair], elbow_in[pair],
    )  # fmt: skip
    far = wp.vec2(FAR_M, FAR_M)
    # the grasp first: mostly there is least room, and then steps are long
    gaps = gaps_on_way(world, bodies, gripper, hands, receiver, head, links, origins, way, 2.0, far)
    rooms = gaps - wp.vec2(eps, TOUCH_M)
    nearest = wp.min(rooms[0], rooms[1])
    gaps = gaps_on_way(world, bodies, gripper, hands, receiver, head, links, origins, way, 0.0, far)
    along = far
    t = float(0.0)
    for _ in range(MOST_MEASURED):
        if t >= 2.0:
            break
        nearest = wp.min(nearest, wp.min(gaps[0], gaps[1]))
        least = wp.min(nearest, enough_in[pair])
        sure = least - wp.max(share * least, wp.min(tolerance, 0.5 * least))
        then = farther_on_way(way, t, gaps[0] - sure, gaps[1] - sure)
        then = wp.max(then, wp.min(t + LEAST_STEP, wp.where(t < 1.0, 1.0, 2.0)))
        # between two places nothing is nearer than both distances and the way between them allow
        moved = (then - t) * speeds_on_way(way, t)
        caps = caps_on_way(gaps, moved)
        after = gaps_on_way(world, bodies, gripper, hands, receiver, head, links, origins, way, then, caps)
        between = 0.5 * (gaps + after - moved)
        along = wp.vec2(wp.min(along[0], between[0]), wp.min(along[1], between[1]))
        gaps = after
        t = then
    # `way_to_grasp` went no farther than the distance at a place, and had more than these at the next: so half of them is
    # left in between
    along = wp.vec2(wp.max(along[0], 0.5 * eps), wp.max(along[1], 0.5 * TOUCH_M))
    rooms_out[pair] = wp.vec2(wp.min(rooms[0], along[0]), wp.min(rooms[1], along[1]))
    capped_out[pair] = nearest >= FAR_M - wp.max(eps, TOUCH_M)
