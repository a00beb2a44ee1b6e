"""A gripper's fingers: where every gripper primitive stands in the ee frame at an opening (gap between the pads).

Fingers that a table moves (jaws on slides: of two samples): the drive is minus half the gap (m), so that a larger drive closes.
The 2F-85's closed-form linkage: half the gap = offset + pin_y cos q - pin_z sin q = offset + r cos(q + phi) at drive angle
q, so q = acos((gap / 2 - offset) / r) - phi. `side` is -1 for the finger at -y, +1 for the finger at +y, 0 for the palm.
"""

import warp as wp

from r2h_batch.kernels.geometry.angles import angle_of, arc_cosine, sin_cos
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

FIXED = wp.constant(0)
DRIVER = wp.constant(1)
PIN = wp.constant(2)
INNER_KNUCKLE = wp.constant(3)
TABLE = wp.constant(4)  # and beyond: TABLE + row of the table


@wp.struct
class Gripper:
    """Linkage (m, rad; the +y finger's, gripper frame) and the G primitives at drive 0 in the ee frame."""

    samples: int  # of the table, 0: the linkage
    table_gap: float  # gap (m) of its first sample, and from one to the next
    table_step: float
    table: wp.array2d(dtype=wp.vec3)  # (rows, samples) y, z, turn about the ee frame's x; row 0 moves the pads
    driver_pivot_y: float
    driver_pivot_z: float
    pin_y: float  # from the driver pivot
    pin_z: float
    inner_knuckle_pivot_y: float
    inner_knuckle_pivot_z: float
    gap_offset: float
    pad_z: float  # pad centre above the pin's end, less the ee frame's height: pad centre in ee = pad_z + pin part
    z_ee_gripper: float  # gripper frame's origin in the ee frame
    drive_lower: float
    drive_upper: float
    pad_half_x: float
    pad_half_z: float
    kind: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.vec3)
    motion: wp.array(dtype=wp.int32)
    side: wp.array(dtype=wp.float32)
    R: wp.array(dtype=wp.mat33)
    p: wp.array(dtype=wp.vec3)


@wp.func
def table_interval(g: Gripper, gap: float):
    """The sample at or below a gap, which has one above it, and the share of the way to that one."""
    f = wp.clamp((gap - g.table_gap) / g.table_step, 0.0, float(g.samples - 1))
    i = wp.min(int(f), g.samples - 2)
    return i, f - float(i)


@wp.func
def table_at(g: Gripper, row: int, gap: float) -> wp.vec3:
    """A row of the table at a gap."""
    i, t = table_interval(g, gap)
    return g.table[row, i] + t * (g.table[row, i + 1] - g.table[row, i])


@wp.func
def drive_from_gap(g: Gripper, gap: float) -> float:
    """Drive angle (rad) at which the pads are `gap` (m) apart, clipped to its range."""
    if g.samples > 0:
        return wp.clamp(-0.5 * gap, g.drive_lower, g.drive_upper)
    # half the gap = offset + r cos(q + phi) solved for q; gaps beyond the linkage give its ends
    r = wp.sqrt(g.pin_y * g.pin_y + g.pin_z * g.pin_z)
    c = wp.clamp((0.5 * gap - g.gap_offset) / r, -1.0, 1.0)
    return wp.clamp(arc_cosine(c) - angle_of(g.pin_z, g.pin_y), g.drive_lower, g.drive_upper)


@wp.func
def gap_from_drive(g: Gripper, drive: float) -> float:
    """Gap between the pads (m) at a drive angle."""
    if g.samples > 0:
        return -2.0 * drive
    s, c = sin_cos(drive)
    return 2.0 * (g.gap_offset + g.pin_y * c - g.pin_z * s)


@wp.func
def pad_center_z(g: Gripper, drive: float) -> float:
    """z of the pads' centres in the ee frame (0 at half stroke)."""
    if g.samples > 0:
        at = table_at(g, 0, -2.0 * drive)
        return g.pad_z + at[1]
    s, c = sin_cos(drive)
    return g.pad_z + g.pin_z * c + g.pin_y * s


@wp.func
def pad_center_z_range(g: Gripper, gap_low: float, gap_high: float):
    """Smallest and largest z (ee frame) that the pads' centres take while the gap goes from gap_high to gap_low."""
    if g.samples > 0:  # linear in between: the ends, and the samples among them
        at_low = table_at(g, 0, gap_low)
        at_high = table_at(g, 0, gap_high)
        z_low = wp.min(at_low[1], at_high[1])
        z_high = wp.max(at_low[1], at_high[1])
        first, _t = table_interval(g, gap_low)
        last, _u = table_interval(g, gap_high)
        for i in range(first + 1, last + 1):
            at = g.table[0, i]
            z_low = wp.min(z_low, at[1])
            z_high = wp.max(z_high, at[1])
        return g.pad_z + z_low, g.pad_z + z_high
    q_open = drive_from_gap(g, gap_high)
    q_closed = drive_from_gap(g, gap_low)
    a = pad_center_z(g, q_open)
    b = pad_center_z(g, q_closed)
    low = wp.min(a, b)
    high = wp.max(a, b)
    q_top = angle_of(g.pin_y, g.pin_z)  # the pin's arc is highest here
    if q_top > q_open and q_top < q_closed:
        high = wp.max(high, pad_center_z(g, q_top))
    return low, high


@wp.func
def finger_pose(g: Gripper, i: int, drive: float):
    """R, p of primitive i in the ee frame at a drive angle (rad)."""
    R = g.R[i]
    p = g.p[i]
    motion = g.motion[i]
    # the finger at -y is the mirror image: it turns the other way
    if motion != FIXED:
        side = g.side[i]
        if motion >= TABLE:
            at = table_at(g, motion - TABLE, -2.0 * drive)
            shift = wp.vec3(0.0, side * at[0], at[1])
            if at[2] == 0.0:
                return R, p + shift
            st, ct = sin_cos(at[2])
            st = side * st
            about_x = wp.mat33(1.0, 0.0, 0.0, 0.0, ct, -st, 0.0, st, ct)
            return about_x * R, about_x * p + shift
        sine, c = sin_cos(drive)
        s = side * sine
        if motion == PIN:  # the parallelogram carries inner finger and pad along the pin's arc without turning them
            y = side * g.pin_y
            p = p + wp.vec3(0.0, c * y - s * g.pin_z - y, s * y + c * g.pin_z - g.pin_z)
        else:
            pivot = wp.vec3(0.0, side * g.driver_pivot_y, g.driver_pivot_z + g.z_ee_gripper)
            if motion == INNER_KNUCKLE:
                pivot = wp.vec3(0.0, side * g.inner_knuckle_pivot_y, g.inner_knuckle_pivot_z + g.z_ee_gripper)
            turn = wp.mat33(1.0, 0.0, 0.0, 0.0, c, -s, 0.0, s, c)
            R = turn * R
            p = turn * (p - pivot) + pivot
    return R, p


@wp.kernel
def gripper_poses(
    first: int, gripper: Gripper, opening_in: wp.array(dtype=wp.float32), R_out: wp.array2d(dtype=wp.mat33),
    p_out: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Poses (B, G) of all gripper primitives in the ee frame at each trial's opening (m)."""
    trial = first + wp.tid()
    drive = drive_from_gap(gripper, opening_in[trial])
    for i in range(gripper.kind.shape[0]):
        R, p = finger_pose(gripper, i, drive)
        R_out[trial, i] = R
        p_out[trial, i] = p
