"""How margins change with the two poses, to first order, when the points that decide them are carried along.

The change of a number with a pose T is a matrix M: the sum of M[i, j] dT[i, j]. So each number here is such a matrix, taken
at the poses of the witnesses, and a sum or a multiple of numbers is one of their matrices. The last rows stay zero.
"""

import warp as wp

from r2h_batch.kernels.geometry.surface import inverse_pose
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper
from r2h_batch.kernels.witness.closing import EMPTY, MATERIAL, STEP_HIGH, STEP_LOW
from r2h_batch.kernels.witness.surface import finger_velocity

wp.set_module_options(OPTIONS | {"max_unroll": 0})

NOTHING = wp.constant(0)
CUT = wp.constant(1)
TOO_WIDE = wp.constant(2)
TOO_THIN = wp.constant(3)
NO_MATERIAL = wp.constant(4)
"""Deciding Stability: nothing that moves, the open gripper's clearance, the width to either side, a grasp of nothing."""

STEEPEST = wp.constant(0.05)
"""Least 1 - dw/dg: the opening moves by at most 20 times what the material does."""
LEAST_SQUARE = wp.constant(1.0e-18)
"""A root of less counts as 1e-9, and does not move."""

OUT_OF_REACH_M = wp.constant(1.0e10)
"""Where no search for a nearest point begins: beyond `FARTHEST_M`."""

FIXED = wp.constant(-1)
"""A carrier of a point: nothing that moves. The others, for an arm of J joints: 0 to J a link (J with the ee), J + 1 the
gripper, J + 2 the held object."""


@wp.kernel
def decided_by(
    first: int,
    # tables
    open_gap: float, w_max: float, w_min: float, cut_cap: float, clearance_cap: float, overlap: float, tolerance: float,
    slack: float, safe_margin: float, stability: int, affordance: int, safe: int, unreachable: int, not_found: int,
    start: int, home: wp.array(dtype=float),
    # trials
    active_in: wp.array(dtype=wp.bool), margin_in: wp.array2d(dtype=float), evaluated_in: wp.array2d(dtype=wp.bool),
    cut_in: wp.array(dtype=float), width_in: wp.array(dtype=float), empty_in: wp.array(dtype=wp.bool),
    T_obj_ee_in: wp.array(dtype=wp.mat44), reason_in: wp.array(dtype=int), part_in: wp.array2d(dtype=int),
    q_in: wp.array2d(dtype=float),
    # out
    stability_by_out: wp.array(dtype=int), opened_out: wp.array(dtype=float), cut_bound_out: wp.array(dtype=float),
    region_bound_out: wp.array(dtype=float), holds_region_out: wp.array(dtype=wp.bool),
    safe_body_out: wp.array(dtype=int), safe_distance_out: wp.array(dtype=float),
    q_plan_out: wp.array2d(dtype=float), q_safe_out: wp.array2d(dtype=float), ee_origin_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """Which witnesses each margin needs; -inf, -1 and False: none.

    `ee_origin`: what the nearest material is asked of, OUT_OF_REACH_M where it is not.

    A clearance at its cap is a bound that does not move. Fingers that hold the region overlap it by `overlap`, give or take
    `tolerance`. `q_plan`: where Plan's bodies meet (home, or the goal); `q_safe`: the goal.
    """
    trial = first + wp.tid()
    active = active_in[trial]
    number = margin_in[trial, stability]
    cut = cut_in[trial]
    width = width_in[trial]
    opened_out[trial] = open_gap
    cut_bound_out[trial] = -wp.inf
    kind = NOTHING
    if active:
        if cut < cut_cap and number == cut:
            kind = CUT
            cut_bound_out[trial] = cut + slack
        elif empty_in[trial]:
            kind = NO_MATERIAL
        elif number == width - w_min:
            kind = TOO_THIN
        elif number == w_max - width:
            kind = TOO_WIDE
    stability_by_out[trial] = kind

    apart = margin_in[trial, affordance]
    near = evaluated_in[trial, affordance] and apart < clearance_cap
    region_bound_out[trial] = wp.where(near, apart + slack, -wp.inf)
    holds_region_out[trial] = near and apart < 0.0 and wp.abs(apart + overlap) < tolerance
    T = T_obj_ee_in[trial]
    ee_origin_out[trial] = wp.vec3(T[0, 3], T[1, 3], T[2, 3])
    if kind != NO_MATERIAL and not holds_region_out[trial]:
        ee_origin_out[trial] = wp.vec3(OUT_OF_REACH_M, OUT_OF_REACH_M, OUT_OF_REACH_M)

    reason = reason_in[trial]
    reached = active and reason != unreachable and reason != not_found
    safe_body_out[trial] = wp.where(reached, part_in[trial, 1], -1)
    safe_distance_out[trial] = margin_in[trial, safe] + safe_margin
    for j in range(home.shape[0]):
        at_home = not active or reason == start
        q_plan_out[trial, j] = wp.where(at_home, home[j], q_in[trial, j])
        q_safe_out[trial, j] = wp.where(active, q_in[trial, j], home[j])


@wp.func
def column(T: wp.mat44, k: int) -> wp.vec3:
    """Upper three numbers of a column."""
    return wp.vec3(T[0, k], T[1, k], T[2, k])


@wp.func
def rotated(T: wp.mat44, v: wp.vec3) -> wp.vec3:
    """R v."""
    return column(T, 0) * v[0] + column(T, 1) * v[1] + column(T, 2) * v[2]


@wp.func
def with_columns(x: wp.vec3, y: wp.vec3, z: wp.vec3, p: wp.vec3) -> wp.mat44:
    """The matrix with these columns and a last row of zeros."""
    return wp.mat44(
        x[0], y[0], z[0], p[0], x[1], y[1], z[1], p[1], x[2], y[2], z[2], p[2], 0.0, 0.0, 0.0, 0.0
    )  # fmt: skip


@wp.func
def along(g: wp.vec3, x: wp.vec3) -> wp.mat44:
    """Change of g . (T x) with T."""
    return with_columns(g * x[0], g * x[1], g * x[2], g)


@wp.func
def along_inverse(T: wp.mat44, g: wp.vec3, x: wp.vec3) -> wp.mat44:
    """Change of g . (T^-1 x) with T: that of g . R^T (x - p)."""
    d = x - column(T, 3)
    return with_columns(d * g[0], d * g[1], d * g[2], -rotated(T, g))


@wp.struct
class Closed:
    """Changes with T_obj_ee of width, opening, and how far closing shifts the object."""

    width: wp.mat44
    opening: wp.mat44
    shift: wp.mat44


@wp.func
def at_pad(
    T: wp.mat44, trial: int, k: int, point: wp.array2d(dtype=wp.vec3), slope_x: wp.array2d(dtype=float),
    slope_z: wp.array2d(dtype=float),
) -> wp.mat44:  # fmt: skip
    """y of a point that the pads meet: one that slides along the surface stays on the prism's boundary, and gives back
    slope * (its move across)."""
    return along_inverse(T, wp.vec3(-slope_x[trial, k], 1.0, -slope_z[trial, k]), point[trial, k])


@wp.func
def closed(
    T: wp.mat44, trial: int, open_gap: float, width: float, state: int, lift: float, point: wp.array2d(dtype=wp.vec3),
    slope_x: wp.array2d(dtype=float), slope_z: wp.array2d(dtype=float),
) -> Closed:  # fmt: skip
    """How the closed gripper follows the grasp: the opening g is the fixed point of width and pad height.

    The prism rises with the opening, so w = w(T, g): dg = dw/dT dT + dw/dg dg, thus dg = dw|_g / (1 - dw/dg).
    """
    out = Closed()
    if state == EMPTY:
        return out
    y0 = at_pad(T, trial, 0, point, slope_x, slope_z)
    y1 = at_pad(T, trial, 1, point, slope_x, slope_z)
    y2 = at_pad(T, trial, 2, point, slope_x, slope_z)
    y3 = at_pad(T, trial, 3, point, slope_x, slope_z)
    opening = wp.mat44()
    if state == MATERIAL:
        opening = (y1 - y0) / wp.max(1.0 - (slope_z[trial, 1] - slope_z[trial, 0]) * lift, STEEPEST)
        y0 = y0 + slope_z[trial, 0] * lift * opening
        y1 = y1 + slope_z[trial, 1] * lift * opening
        y2 = y2 + slope_z[trial, 2] * lift * opening
        y3 = y3 + slope_z[trial, 3] * lift * opening
    elif (
        state == STEP_LOW
    ):  # the pads' ends stand at the step's height z: g follows through the linkage, dg = dz / lift
        opening = along_inverse(T, wp.vec3(0.0, 0.0, 1.0 / lift), point[trial, 0])
    elif state == STEP_HIGH:
        opening = along_inverse(T, wp.vec3(0.0, 0.0, 1.0 / lift), point[trial, 1])
    out.width = y3 - y2
    if width <= open_gap:  # NaN: nothing was met
        out.opening = opening
        out.shift = 0.5 * (y0 + y1)
    return out


@wp.func
def of_grasp(M: wp.mat44, T_obj_ee: wp.mat44, shift: float, c: Closed) -> wp.mat44:
    """A change with the attachment as one with T_obj_ee: closing shifts the object along the ee's y."""
    p = column(M, 3)
    out = M + wp.dot(p, column(T_obj_ee, 1)) * c.shift
    for i in range(3):
        out[i, 1] = out[i, 1] + shift * p[i]
    return out


@wp.func
def direction(way: wp.vec3, counts: bool) -> wp.vec3:
    """The unit vector; zero where it does not count."""
    length = wp.length(way)
    if counts and length > 0.0:
        return way / length
    return wp.vec3(0.0, 0.0, 0.0)


@wp.kernel
def object_changes(
    first: int, open_gap: float, stability: int, reach: int, affordance: int,
    # trials
    active_in: wp.array(dtype=wp.bool), evaluated_in: wp.array2d(dtype=wp.bool), T_obj_ee_in: wp.array(dtype=wp.mat44),
    T_world_ee_in: wp.array(dtype=wp.mat44), attached_in: wp.array(dtype=wp.mat44), width_in: wp.array(dtype=float),
    shift_in: wp.array(dtype=float), stability_by_in: wp.array(dtype=int),
    # witnesses
    state_in: wp.array(dtype=int), lift_in: wp.array(dtype=float), point_in: wp.array2d(dtype=wp.vec3),
    slope_x_in: wp.array2d(dtype=float), slope_z_in: wp.array2d(dtype=float),
    cut_part_in: wp.array(dtype=int), cut_point_in: wp.array(dtype=wp.vec3), cut_normal_in: wp.array(dtype=wp.vec3),
    region_part_in: wp.array(dtype=int), region_point_in: wp.array(dtype=wp.vec3),
    region_normal_in: wp.array(dtype=wp.vec3), region_finger_in: wp.array(dtype=wp.vec3),
    material_in: wp.array(dtype=wp.vec3), material_distance_in: wp.array(dtype=float),
    ball_in: wp.array(dtype=wp.vec3), palm_in: wp.array(dtype=wp.vec3), palm_distance_in: wp.array(dtype=float),
    free_in: wp.array(dtype=wp.vec3), free_found_in: wp.array(dtype=wp.bool),
    # out
    opening_out: wp.array(dtype=wp.mat44), shift_out: wp.array(dtype=wp.mat44),
    change_out: wp.array3d(dtype=wp.mat44),
):  # fmt: skip
    """Changes of Stability, Reach and Affordance with T_obj_ee and T_world_ee, `change_out` (B, C, 2); opening and shift
    with T_obj_ee."""
    trial = first + wp.tid()
    if not active_in[trial]:
        return
    T = T_obj_ee_in[trial]
    c = closed(
        T, trial, open_gap, width_in[trial], state_in[trial], lift_in[trial], point_in, slope_x_in, slope_z_in
    )  # fmt: skip
    opening_out[trial] = c.opening
    shift_out[trial] = c.shift
    shift = shift_in[trial]
    R_ee_obj, p_ee_obj = inverse_pose(T)

    if evaluated_in[trial, stability]:
        kind = stability_by_in[trial]
        if kind == CUT and cut_part_in[trial] >= 0:
            change_out[trial, stability, 0] = along_inverse(T, cut_normal_in[trial], cut_point_in[trial])
        elif kind == TOO_WIDE:
            change_out[trial, stability, 0] = -1.0 * c.width
        elif kind == TOO_THIN:
            change_out[trial, stability, 0] = c.width
        elif kind == NO_MATERIAL:  # the number says no more, the way to the nearest material does
            x = material_in[trial]
            way = direction(R_ee_obj * x + p_ee_obj, material_distance_in[trial] > 0.0)
            change_out[trial, stability, 0] = along_inverse(T, -way, x)

    B = attached_in[trial]
    if evaluated_in[trial, reach]:
        x = palm_in[trial]
        R_b, p_b = inverse_pose(B)
        way = R_b * direction(x - ball_in[trial], palm_distance_in[trial] > 0.0)  # ee frame
        change_out[trial, reach, 0] = of_grasp(along_inverse(B, -way, x), T, shift, c)
        change_out[trial, reach, 1] = along(-rotated(T_world_ee_in[trial], way), R_b * x + p_b)

    if evaluated_in[trial, affordance]:
        out = wp.mat44()
        if region_part_in[trial] >= 0:
            n = region_normal_in[trial]
            out = of_grasp(along_inverse(B, n, region_point_in[trial]), T, shift, c)
            out = out - wp.dot(n, region_finger_in[trial]) * c.opening
        x = free_in[trial]
        way = direction(R_ee_obj * x + p_ee_obj, free_found_in[trial])
        change_out[trial, affordance, 0] = out + along_inverse(T, -way, x)


@wp.struct
class Carried:
    """Changes of a point's way along a direction: with T_world_ee, with the attachment, and per metre of opening."""

    world: wp.mat44
    attached: wp.mat44
    opening: float


@wp.func
def carried(
    trial: int, g: wp.vec3, point: wp.vec3, carrier: int, gripper: Gripper, part: int, opening: float, W: wp.mat44,
    B: wp.mat44, axis: wp.array2d(dtype=wp.vec3), origin: wp.array2d(dtype=wp.vec3), inverse: wp.array3d(dtype=float),
) -> Carried:  # fmt: skip
    """How a point (world frame) goes along g with what carries it; W: T_world_ee; `part`: the gripper's primitive.

    A link follows the ee by the arm's inverse Jacobian.
    """
    out = Carried()
    joints = axis.shape[1]
    R_ee, p_ee = inverse_pose(W)
    x = R_ee * point + p_ee
    if carrier >= joints:
        out.world = along(g, x)
        if carrier == joints + 1 and part >= 0:
            out.opening = wp.dot(R_ee * g, finger_velocity(gripper, part, opening, x))
        elif carrier == joints + 2:
            out.attached = along_inverse(B, R_ee * g, wp.vec3(wp.transform_point(B, x)))
    else:
        forward = wp.vec3(0.0, 0.0, 0.0)
        turn = wp.vec3(0.0, 0.0, 0.0)
        for j in range(carrier):
            a = wp.dot(g, wp.cross(axis[trial, j], point - origin[trial, j]))
            for k in range(3):
                forward[k] = forward[k] + a * inverse[trial, j, k]
                turn[k] = turn[k] + a * inverse[trial, j, 3 + k]
        # R = exp([w]) R0 moves each axis by w x a_k; sum_k a_k x (w x a_k) = 2 w gives the turn back
        half = 0.5 * turn
        out.world = with_columns(
            wp.cross(half, column(W, 0)), wp.cross(half, column(W, 1)), wp.cross(half, column(W, 2)), forward
        )  # fmt: skip
    return out


@wp.func
def carrier_of(body: int, links: wp.array(dtype=int), n_robot: int, joints: int) -> int:
    """The carrier of a robot body (`Scene.part_names`)."""
    if body < 0:
        return FIXED
    if body >= n_robot:
        return joints + 2
    return links[body]


@wp.kernel
def body_changes(
    first: int, gripper: Gripper, links: wp.array(dtype=int), n_arm: int, n_robot: int, T_home: wp.mat44, plan: int,
    safe: int, unreachable: int, not_found: int, start: int, self_pair: int, object_pair: int,
    # trials
    active_in: wp.array(dtype=wp.bool), evaluated_in: wp.array2d(dtype=wp.bool), T_obj_ee_in: wp.array(dtype=wp.mat44),
    T_world_ee_in: wp.array(dtype=wp.mat44), attached_in: wp.array(dtype=wp.mat44), opening_in: wp.array(dtype=float),
    shift_in: wp.array(dtype=float), reason_in: wp.array(dtype=int),
    # witnesses
    opening_change_in: wp.array(dtype=wp.mat44), shift_change_in: wp.array(dtype=wp.mat44),
    missed_in: wp.array(dtype=wp.mat44), pair_in: wp.array(dtype=int), body_in: wp.array(dtype=int),
    other_in: wp.array(dtype=int), push_in: wp.array(dtype=wp.vec3), point_in: wp.array(dtype=wp.vec3),
    axis_in: wp.array2d(dtype=wp.vec3), origin_in: wp.array2d(dtype=wp.vec3), inverse_in: wp.array3d(dtype=float),
    safe_body_in: wp.array(dtype=int), found_in: wp.array(dtype=wp.bool), hand_point_in: wp.array(dtype=wp.vec3),
    hand_normal_in: wp.array(dtype=wp.vec3), safe_axis_in: wp.array2d(dtype=wp.vec3),
    safe_origin_in: wp.array2d(dtype=wp.vec3), safe_inverse_in: wp.array3d(dtype=float),
    # out
    change_inout: wp.array3d(dtype=wp.mat44),
):  # fmt: skip
    """Changes of Plan and Safe with T_obj_ee and T_world_ee; `change_inout` (B, C, 2)."""
    trial = first + wp.tid()
    if not active_in[trial]:
        return
    joints = axis_in.shape[1]
    W = T_world_ee_in[trial]
    B = attached_in[trial]
    opening = opening_in[trial]
    c = Closed()
    c.shift = shift_change_in[trial]
    reason = reason_in[trial]
    if evaluated_in[trial, plan]:
        if reason != unreachable and reason != not_found:
            at = wp.where(reason == start, T_home, W)
            body = body_in[trial]
            other = wp.int32(-1)
            if pair_in[trial] == self_pair or pair_in[trial] == object_pair:
                other = other_in[trial]
            total = Carried()
            for side in range(2):
                b = wp.where(side == 0, body, other)
                # fingers of the second body do not move with the opening
                part = wp.where(side == 0 and b < n_robot, b - n_arm, -1)
                g = wp.where(side == 0, push_in[trial], -push_in[trial])
                x = carried(
                    trial, g, point_in[trial], carrier_of(b, links, n_robot, joints), gripper, part, opening, at, B,
                    axis_in, origin_in, inverse_in,
                )  # fmt: skip
                total.world = total.world + x.world
                total.attached = total.attached + x.attached
                total.opening = total.opening + x.opening
            change_inout[trial, plan, 0] = (
                of_grasp(total.attached, T_obj_ee_in[trial], shift_in[trial], c)
                + total.opening * opening_change_in[trial]
            )
            if reason != start:
                change_inout[trial, plan, 1] = total.world
        else:
            change_inout[trial, plan, 1] = -1.0 * missed_in[trial]
    if evaluated_in[trial, safe] and found_in[trial]:
        b = safe_body_in[trial]
        x = carried(
            trial, -hand_normal_in[trial], hand_point_in[trial], carrier_of(b, links, n_robot, joints), gripper,
            wp.where(b < n_robot, b - n_arm, -1), opening, W, B, safe_axis_in, safe_origin_in, safe_inverse_in,
        )  # fmt: skip
        change_inout[trial, safe, 0] = (
            of_grasp(x.attached, T_obj_ee_in[trial], shift_in[trial], c) + x.opening * opening_change_in[trial]
        )
        change_inout[trial, safe, 1] = x.world


@wp.func
def root(square: float) -> float:
    """Square roots, 1e-9 at least."""
    return wp.sqrt(wp.max(square, LEAST_SQUARE))


@wp.func
def slope_of_root(square: float) -> float:
    """d root / d square."""
    return wp.where(square < LEAST_SQUARE, 0.0, 0.5 / root(square))


@wp.kernel
def missed_by_ur(
    first: int, d1: float, a2: float, a3: float, d4: float, d5: float, tool: float,
    T_world_ee_in: wp.array(dtype=wp.mat44), missed_out: wp.array(dtype=wp.mat44),
):  # fmt: skip
    """Change of what a UR arm misses a target by, with the hand turned as asked (m): the closed form of ik/nearest.py.

    The wrist centre may be too near to the axis of joint 1, and beyond or within what both links reach.
    """
    trial = first + wp.tid()
    T = T_world_ee_in[trial]
    z = column(T, 2)
    wrist = column(T, 3) - tool * z
    height = wrist[2] - d1
    # Joint 1 can put the wrist centre only onto a cylinder of radius d4 about its axis or beyond: `off` is missing within
    square = wrist[0] * wrist[0] + wrist[1] * wrist[1]
    r = root(square)
    off = wp.max(d4 - r, 0.0)
    rho_square = square - d4 * d4
    rho = root(rho_square)
    least = float(wp.inf)
    d_off = float(0.0)  # slopes of the least of four: with off, rho, x, y, height, z
    d_rho = float(0.0)
    d_wrist = wp.vec3(0.0, 0.0, 0.0)
    d_z = wp.vec3(0.0, 0.0, 0.0)
    for way in range(4):
        shoulder = wp.where(way < 2, 1.0, -1.0)
        flip = wp.where(way % 2 == 0, 1.0, -1.0)
        c0 = wrist[0] * shoulder * rho + wrist[1] * d4
        s0 = wrist[1] * shoulder * rho - wrist[0] * d4
        norm = root(c0 * c0 + s0 * s0)
        c = c0 / norm
        s = s0 / norm
        # the tool's z axis in the arm's plane (joint 1 turned): its part square to that plane is cos q5
        z_x = c * z[0] + s * z[1]
        sin_square = z_x * z_x + z[2] * z[2]
        sin_q5 = root(sin_square)
        a = shoulder * rho - flip * d5 * z[2] / sin_q5
        b = height + flip * d5 * z_x / sin_q5
        d = root(a * a + b * b)
        beyond = wp.max(d - a2 - a3, wp.abs(a2 - a3) - d)
        sign = wp.where(d - a2 - a3 >= wp.abs(a2 - a3) - d, 1.0, -1.0)
        if beyond < 0.0:
            beyond = 0.0
            sign = 0.0
        lacks = beyond * beyond + off * off
        if root(lacks) < least:
            least = root(lacks)
            slope = 2.0 * slope_of_root(lacks)
            d_off = slope * off
            # backwards through the lines above
            d_d = slope * beyond * sign * 2.0 * slope_of_root(a * a + b * b)
            d_a = d_d * a
            d_b = d_d * b
            d_rho = shoulder * d_a
            d_sin = flip * d5 * (d_a * z[2] - d_b * z_x) / (sin_q5 * sin_q5)
            d_square = 2.0 * d_sin * slope_of_root(sin_square)
            d_zx = flip * d5 * d_b / sin_q5 + d_square * z_x
            d_c = d_zx * z[0]
            d_s = d_zx * z[1]
            d_z = wp.vec3(d_zx * c, d_zx * s, -flip * d5 * d_a / sin_q5 + d_square * z[2])
            d_norm = -2.0 * (d_c * c0 + d_s * s0) / (norm * norm) * slope_of_root(c0 * c0 + s0 * s0)
            d_c0 = d_c / norm + d_norm * c0
            d_s0 = d_s / norm + d_norm * s0
            d_rho = d_rho + shoulder * (d_c0 * wrist[0] + d_s0 * wrist[1])
            d_wrist = wp.vec3(
                d_c0 * shoulder * rho - d_s0 * d4, d_c0 * d4 + d_s0 * shoulder * rho, d_b
            )  # fmt: skip
    d_level = 2.0 * (d_rho * slope_of_root(rho_square) - wp.where(r < d4, d_off, 0.0) * slope_of_root(square))
    d_wrist = d_wrist + d_level * wp.vec3(wrist[0], wrist[1], 0.0)
    missed_out[trial] = with_columns(wp.vec3(), wp.vec3(), d_z - tool * d_wrist, d_wrist)


@wp.kernel
def missed_by_posture(
    first: int, rotation_lever: float,  # m, what a radian counts for
    T_world_ee_in: wp.array(dtype=wp.mat44), T_reached_in: wp.array(dtype=wp.mat44),
    missed_out: wp.array(dtype=wp.mat44),
):  # fmt: skip
    """Change of what a posture misses a target by (m)."""
    trial = first + wp.tid()
    T = T_world_ee_in[trial]
    T0 = T_reached_in[trial]
    away = column(T, 3) - column(T0, 3)
    # sum_k a_k x R a_k = 2 sin(angle) axis, and the trace is 1 + 2 cos(angle)
    turn = wp.vec3(0.0, 0.0, 0.0)
    cosine = float(-1.0)
    for k in range(3):
        turn = turn + wp.cross(column(T0, k), column(T, k))
        cosine = cosine + wp.dot(column(T0, k), column(T, k))
    square = wp.dot(turn, turn)
    sine = root(square)
    total = sine * sine + cosine * cosine
    d_turn = 2.0 * rotation_lever * cosine / total * slope_of_root(square) * turn
    d_cosine = -rotation_lever * sine / total
    missed_out[trial] = with_columns(
        wp.cross(d_turn, column(T0, 0)) + d_cosine * column(T0, 0),
        wp.cross(d_turn, column(T0, 1)) + d_cosine * column(T0, 1),
        wp.cross(d_turn, column(T0, 2)) + d_cosine * column(T0, 2),
        2.0 * slope_of_root(wp.dot(away, away)) * away,
    )


@wp.kernel
def poses_gradient(
    first: int, gradient_in: wp.array2d(dtype=float), change_in: wp.array3d(dtype=wp.mat44),
    evaluated_in: wp.array2d(dtype=wp.bool), T_obj_ee_out: wp.array(dtype=wp.mat44),
    T_world_ee_out: wp.array(dtype=wp.mat44),
):  # fmt: skip
    """The gradient of the two poses from that of the margins (B, C); a margin that was not evaluated counts nothing."""
    trial = first + wp.tid()
    of_grasp_pose = wp.mat44()
    of_ee = wp.mat44()
    for c in range(gradient_in.shape[1]):
        if evaluated_in[trial, c]:
            of_grasp_pose = of_grasp_pose + gradient_in[trial, c] * change_in[trial, c, 0]
            of_ee = of_ee + gradient_in[trial, c] * change_in[trial, c, 1]
    T_obj_ee_out[trial] = of_grasp_pose
    T_world_ee_out[trial] = of_ee
