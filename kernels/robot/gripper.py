"""A gripper's fingers: where every gripper primitive stands in the ee frame at an opening (gap between the pads).

Parallel jaws on slides: the drive is minus half the gap (m), so that a larger drive closes.
The 2F-85's closed-form linkage: half the gap = offset + pin_y cos q - pin_z sin q = offset + r cos(q + phi) at drive angle
q, so q = acos((gap / 2 - offset) / r) - phi. `side` is -1 for the finger at -y, +1 for the finger at +y, 0 for the body.
"""

import warp as wp

from r2h_batch.kernels.geometry.angles import angle_of, arc_cosine, sin_cos
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

FIXED = wp.constant(0)
DRIVER = wp.constant(1)
PIN = wp.constant(2)
INNER_KNUCKLE = wp.constant(3)
SLIDE = wp.constant(4)


@wp.struct
class Gripper:
    """Linkage (m, rad; the +y finger's, gripper frame) and the G primitives at drive 0 in the ee frame."""

    slide: int  # 1: parallel jaws, no linkage
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
def drive_from_gap(g: Gripper, gap: float) -> float:
    """Drive angle (rad) at which the pads are `gap` (m) apart, clipped to its range."""
    if g.slide == 1:
        return wp.clamp(-0.5 * gap, g.drive_lower, g.drive_upper)
    # half the gap = offset + r cos(q + phi) solved for q; gaps beyond the linkage give its ends
    r = wp.sqrt(g.pin_y * g.pin_y + g.pin_z * g.pin_z)
    c = wp.clamp((0.5 * gap - g.gap_offset) / r, -1.0, 1.0)
    return wp.clamp(arc_cosine(c) - angle_of(g.pin_z, g.pin_y), g.drive_lower, g.drive_upper)


@wp.func
def gap_from_drive(g: Gripper, drive: float) -> float:
    """Gap between the pads (m) at a drive angle."""
    if g.slide == 1:
        return -2.0 * drive
    s, c = sin_cos(drive)
    return 2.0 * (g.gap_offset + g.pin_y * c - g.pin_z * s)


@wp.func
def pad_center_z(g: Gripper, drive: float) -> float:
    """z of the pads' centres in the ee frame (0 at half stroke)."""
    if g.slide == 1:
        return g.pad_z
    s, c = sin_cos(drive)
    return g.pad_z + g.pin_z * c + g.pin_y * s


@wp.func
def pad_center_z_range(g: Gripper, gap_low: float, gap_high: float):
    """Smallest and largest z (ee frame) that the pads' centres take while the gap goes from gap_high to gap_low."""
    if g.slide == 1:
        return g.pad_z, g.pad_z
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
        sine, c = sin_cos(drive)
        s = side * sine
        if motion == SLIDE:
            p = p - wp.vec3(0.0, side * drive, 0.0)
        elif motion == PIN:  # the parallelogram carries inner finger and pad along the pin's arc without turning them
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
    first: int,
    gripper: Gripper,
    opening_in: wp.array(dtype=wp.float32),
    R_out: wp.array2d(dtype=wp.mat33),
    p_out: wp.array2d(dtype=wp.vec3),
):
    """Poses (B, G) of all gripper primitives in the ee frame at each trial's opening (m)."""
    trial = first + wp.tid()
    drive = drive_from_gap(gripper, opening_in[trial])
    for i in range(gripper.kind.shape[0]):
        R, p = finger_pose(gripper, i, drive)
        R_out[trial, i] = R
        p_out[trial, i] = p
