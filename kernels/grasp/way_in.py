"""Clearance between the open gripper and a solid, all the way straight in to a grasp."""

import warp as wp

from r2h_batch.kernels.geometry.bisection import descend, half_width, middle, next_interval
from r2h_batch.kernels.geometry.surface import Surfaces
from r2h_batch.kernels.grasp.region import UNASKED, least_clearance
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.robot.gripper import Gripper

wp.set_module_options(OPTIONS)

FIRST_LEVEL = wp.constant(4)
"""The part before the grasp is a sixteenth of the way at first, the one behind it as long, and each further one twice as long as
the one before it: the farther from the grasp, the larger the clearance mostly is."""
LEVELS = wp.constant(16)
"""Halvings at most: parts of a way of 10 cm are below the tolerance after ten."""


@wp.func
def _before(T_obj_ee: wp.mat44, back: float):
    """The grasp moved back along its axis."""
    T = T_obj_ee
    for k in range(3):
        T[k, 3] = T[k, 3] - back * T[k, 2]
    return T


# Branch and bound from the grasp outwards: the clearance in the middle of a part, less half its length, is a lower bound on the
# part. It is measured as far as it tells whether the part has to be halved.
@wp.kernel
def way_in_clearance(
    first: int,
    # tables
    gripper: Gripper, surfaces: Surfaces, used: int,
    way: float, opening: float, tolerance: float, share: float,
    # trials
    T_obj_ee_in: wp.array(dtype=wp.mat44), object_index_in: wp.array(dtype=wp.int32), cap_in: wp.array(dtype=wp.float32),
    # scratch: (B, G) object to primitive frame
    R_scratch: wp.array2d(dtype=wp.mat33), p_scratch: wp.array2d(dtype=wp.vec3),
    # out
    clearance_out: wp.array(dtype=wp.float32), witness_out: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Least clearance (m) on the way of length `way` along the gripper's axis to each grasp, and the primitive that has it.

    Exact below the trial's cap to `tolerance` or the `share` of it, what is more; the cap and -1 beyond.
    """
    trial = first + wp.tid()
    s = object_index_in[trial]
    T = T_obj_ee_in[trial]
    best = float(cap_in[trial])
    witness = int(-1)
    for end in range(2):
        found, i = least_clearance(
            gripper, surfaces, s, used, 1, best, UNASKED, _before(T, float(end) * way), opening, trial, R_scratch, p_scratch
        )  # fmt: skip
        if found < best:
            best = found
            witness = i
    level = int(FIRST_LEVEL)
    index = int(0)
    while level > 0:
        half = way * half_width(level)
        back = way * middle(level, index)
        found, i = least_clearance(
            gripper, surfaces, s, used, 1, best + half, UNASKED, _before(T, back), opening, trial, R_scratch, p_scratch
        )
        if found < best:
            best = found
            witness = i
        allowed = wp.max(tolerance, share * wp.abs(best))
        if found - half < best - allowed and level + 1 < LEVELS:
            level, index = descend(level, index)
        else:
            level, index = next_interval(level, index)
    clearance_out[trial] = best
    witness_out[trial] = witness
