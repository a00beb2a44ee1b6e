"""Clean poses and the closed gripper, row by row: which poses are valid, Stability's margin, the attached grasp, the ball.

These are a few dozen multiplications a row. As tensor operations a small batch paid for some two hundred of them what all
its geometry costs twice over. Every product is rounded before it is added (`fuse_fp` off), as in `r2h_batch.base.se3`, which says
the same row by row in torch; quotients and square roots are those of IEEE 754: these bits are the same on every processor.
"""

import warp as wp

from r2h_batch.kernels.judge.verdict import KIND_CAP, KIND_DISTANCE
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

ROTATION_TOLERANCE = wp.constant(1.0e-3)
"""As `r2h_batch.base.se3.ROTATION_TOLERANCE`."""


@wp.func
def column(T: wp.mat44, k: int) -> wp.vec3:
    """Upper three numbers of a column."""
    return wp.vec3(T[0, k], T[1, k], T[2, k])


@wp.func
def sum3(a: wp.vec3, b: wp.vec3) -> float:
    """a . b from left to right."""
    return (a[0] * b[0] + a[1] * b[1]) + a[2] * b[2]


@wp.func
def difference(a: float, b: float, c: float, d: float) -> float:
    """a b - c d with the first product exact: in float64 it has room (torch's cross product has it from one instruction)."""
    return float(wp.float64(a) * wp.float64(b) - wp.float64(c * d))


@wp.func
def cross3(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """a x b."""
    return wp.vec3(
        difference(a[1], b[2], a[2], b[1]), difference(a[2], b[0], a[0], b[2]), difference(a[0], b[1], a[1], b[0])
    )


@wp.func
def is_pose(T: wp.mat44) -> bool:
    """As `r2h_batch.base.se3.is_pose`: finite, R R^T = I within 1e-3, det R > 0, bottom row (0, 0, 0, 1), within a kilometre."""
    for i in range(4):
        for j in range(4):
            if not wp.isfinite(T[i, j]):
                return False
    x = column(T, 0)
    y = column(T, 1)
    z = column(T, 2)
    p = column(T, 3)
    off = wp.max(wp.abs(sum3(x, x) - 1.0), wp.max(wp.abs(sum3(y, y) - 1.0), wp.abs(sum3(z, z) - 1.0)))
    off = wp.max(off, wp.max(wp.abs(sum3(x, y)), wp.max(wp.abs(sum3(x, z)), wp.abs(sum3(y, z)))))
    bottom = wp.max(wp.abs(T[3, 0]), wp.max(wp.abs(T[3, 1]), wp.max(wp.abs(T[3, 2]), wp.abs(T[3, 3] - 1.0))))
    far = wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))
    return off <= ROTATION_TOLERANCE and sum3(cross3(x, y), z) > 0.0 and bottom <= 1.0e-6 and far < 1.0e3


@wp.func
def pose_of(x: wp.vec3, y: wp.vec3, z: wp.vec3, p: wp.vec3) -> wp.mat44:
    """The rigid transform with these columns."""
    return wp.mat44(
        x[0], y[0], z[0], p[0], x[1], y[1], z[1], p[1], x[2], y[2], z[2], p[2], 0.0, 0.0, 0.0, 1.0
    )  # fmt: skip


@wp.func
def orthonormal(T: wp.mat44) -> wp.mat44:
    """As `r2h_batch.base.se3.orthonormalise`: z keeps its direction, y is taken off z, x is y x z (Gram-Schmidt)."""
    y = column(T, 1)
    z = column(T, 2)
    length = wp.sqrt(sum3(z, z))
    z = wp.vec3(z[0] / length, z[1] / length, z[2] / length)
    along = sum3(y, z)
    y = wp.vec3(y[0] - z[0] * along, y[1] - z[1] * along, y[2] - z[2] * along)
    length = wp.sqrt(sum3(y, y))
    y = wp.vec3(y[0] / length, y[1] / length, y[2] / length)
    return pose_of(cross3(y, z), y, z, column(T, 3))


@wp.kernel
def usable_rows(
    first: int, objects: int, hands: int, T_obj_ee_in: wp.array(dtype=wp.mat44),
    T_world_ee_in: wp.array(dtype=wp.mat44), T_world_hand_in: wp.array(dtype=wp.mat44),
    object_in: wp.array(dtype=wp.int32), hand_in: wp.array(dtype=wp.int32), active_out: wp.array(dtype=wp.bool),
    T_obj_ee_out: wp.array(dtype=wp.mat44), T_world_ee_out: wp.array(dtype=wp.mat44),
    T_world_hand_out: wp.array(dtype=wp.mat44), object_out: wp.array(dtype=wp.int32),
    hand_out: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Rows whose three poses are poses, of bodies that there are, and these poses orthonormal; the identity, 0 elsewhere."""
    row = first + wp.tid()
    o = object_in[row]
    h = hand_in[row]
    known = o >= 0 and o < objects and h >= 0 and h < hands
    G = T_obj_ee_in[row]
    H = T_world_ee_in[row]
    W = T_world_hand_in[row]
    active = known and is_pose(G) and is_pose(H) and is_pose(W)
    if not active:
        G = wp.identity(4, dtype=float)
        H = wp.identity(4, dtype=float)
        W = wp.identity(4, dtype=float)
    active_out[row] = active
    T_obj_ee_out[row] = orthonormal(G)
    T_world_ee_out[row] = orthonormal(H)
    T_world_hand_out[row] = orthonormal(W)
    object_out[row] = wp.where(known, o, 0)
    hand_out[row] = wp.where(known, h, 0)


@wp.func
def turned(T: wp.mat44, v: wp.vec3) -> wp.vec3:
    """R v."""
    return wp.vec3(
        (T[0, 0] * v[0] + T[0, 1] * v[1]) + T[0, 2] * v[2],
        (T[1, 0] * v[0] + T[1, 1] * v[1]) + T[1, 2] * v[2],
        (T[2, 0] * v[0] + T[2, 1] * v[1]) + T[2, 2] * v[2],
    )


@wp.func
def moved(T: wp.mat44, v: wp.vec3) -> wp.vec3:
    """R v + p."""
    u = turned(T, v)
    return wp.vec3(u[0] + T[0, 3], u[1] + T[1, 3], u[2] + T[2, 3])


@wp.func
def inverse(T: wp.mat44) -> wp.mat44:
    """Inverse of a rigid transform."""
    x = column(T, 0)
    y = column(T, 1)
    z = column(T, 2)
    p = column(T, 3)
    q = wp.vec3(-sum3(x, p), -sum3(y, p), -sum3(z, p))
    return pose_of(
        wp.vec3(x[0], y[0], z[0]), wp.vec3(x[1], y[1], z[1]), wp.vec3(x[2], y[2], z[2]), q
    )  # fmt: skip


@wp.func
def product(a: wp.mat44, b: wp.mat44) -> wp.mat44:
    """a b of rigid transforms."""
    return pose_of(turned(a, column(b, 0)), turned(a, column(b, 1)), turned(a, column(b, 2)), moved(a, column(b, 3)))


@wp.func
def material_margin(empty: bool, width: float, w_max: float, w_min: float) -> float:
    """How far what lies between the pads is from being too wide or too thin; nothing is as far below 0 as the widest is above."""
    if empty:
        return -w_max
    return wp.min(w_max - width, width - w_min)


@wp.func
def squeezed(width: float, opening: float, w_max: float, pad_squeeze: float) -> float:
    """As `r2h_batch.judge.grasp.squeezed`: the opening of fingers that hold; of a gripper that stayed open its own."""
    if width <= w_max:
        return wp.max(opening - pad_squeeze, 0.0)
    return opening


@wp.kernel
def close_rows(
    first: int, w_max: float, w_min: float, pad_squeeze: float, reach_offset: float,
    palm_point: wp.array(dtype=wp.vec3), palm_normal: wp.array(dtype=wp.vec3),
    T_obj_ee_in: wp.array(dtype=wp.mat44), T_world_ee_in: wp.array(dtype=wp.mat44),
    T_world_hand_in: wp.array(dtype=wp.mat44), hand_in: wp.array(dtype=wp.int32),
    width_in: wp.array(dtype=wp.float32), opening_in: wp.array(dtype=wp.float32),
    shift_in: wp.array(dtype=wp.float32), empty_in: wp.array(dtype=wp.bool), cut_in: wp.array(dtype=wp.float32),
    margin_out: wp.array(dtype=wp.float32), squeezed_out: wp.array(dtype=wp.float32),
    attached_out: wp.array(dtype=wp.mat44), ball_out: wp.array(dtype=wp.vec3), kind_out: wp.array(dtype=wp.int8),
):  # fmt: skip
    """Result of closing: Stability's margin (and its MarginKind where no clearance is the smallest), the fingers' opening, the
    grasp once the pads have met the object (moved by `shift` along y), and the receiver's ball in that frame."""
    row = first + wp.tid()
    margin = wp.min(material_margin(empty_in[row], width_in[row], w_max, w_min), cut_in[row])
    margin_out[row] = margin
    kind = int(0)
    if margin != cut_in[row]:
        kind = wp.where(empty_in[row], KIND_CAP, KIND_DISTANCE)
    kind_out[row] = wp.int8(kind)
    squeezed_out[row] = squeezed(width_in[row], opening_in[row], w_max, pad_squeeze)
    G = T_obj_ee_in[row]
    y = column(G, 1)
    p = column(G, 3)
    s = shift_in[row]
    p = wp.vec3(p[0] + y[0] * s, p[1] + y[1] * s, p[2] + y[2] * s)
    A = pose_of(column(G, 0), y, column(G, 2), p)
    attached_out[row] = A
    W = T_world_hand_in[row]
    h = hand_in[row]
    point = moved(W, palm_point[h])
    n = turned(W, palm_normal[h])
    c = wp.vec3(point[0] + reach_offset * n[0], point[1] + reach_offset * n[1], point[2] + reach_offset * n[2])
    ball_out[row] = moved(inverse(product(T_world_ee_in[row], inverse(A))), c)


@wp.kernel
def posture_lengths(first: int, active_in: wp.array(dtype=wp.bool), length_out: wp.array(dtype=int)):
    """Waypoints of a path that is one posture: none in rows that are not active."""
    row = first + wp.tid()
    length_out[row] = wp.where(active_in[row], 1, 0)


@wp.kernel
def nearer_rows(
    first: int, distance_in: wp.array(dtype=float), body_in: wp.array(dtype=int), point_in: wp.array(dtype=wp.vec3),
    person_in: wp.array(dtype=float), person_body_in: wp.array(dtype=int),
    distance_out: wp.array(dtype=float), body_out: wp.array(dtype=int), point_out: wp.array(dtype=wp.vec3),
):  # fmt: skip
    """The nearer of the hand and the rest of the person, whose point nobody knows; NaN where either is."""
    row = first + wp.tid()
    person = person_in[row]
    nearer = person < distance_in[row]
    distance_out[row] = wp.where(nearer or wp.isnan(person), person, distance_in[row])
    body_out[row] = wp.where(nearer, person_body_in[row], body_in[row])
    unknown = wp.vec3(wp.nan, wp.nan, wp.nan)
    point_out[row] = wp.where(nearer, unknown, point_in[row])
