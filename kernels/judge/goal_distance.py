"""How far the robot is from the hand at one posture."""

import warp as wp

from r2h_batch.kernels.geometry.closest import TOUCH_M
from r2h_batch.kernels.geometry.hand_mesh import HandMesh
from r2h_batch.kernels.options import OPTIONS, on_cuda

from ..robot.joints import FIELDS, FRAMES, vecq
from ..robot.posture import load
from ..robot.world import TrialBodies, World, forward_kinematics
from .hand_distance import HandDistance, posture_distance
from .nearness import guessed_distance

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache


# A guess (nearness.py) to start from leaves fewer faces to check than `cap` does. The result must be the same as from `cap`. Any
# distance below the start, and its witness, do not depend on the start. Three results do, and the search repeats them from `cap`:
# nothing below the guess (rounding); a body wholly inside the hand (its depth is measured from the distance known before); bodies
# that only touch (their witness is where GJK stopped).
@wp.kernel
def goal_safe_distance(
    first: int, cap: float, world: World, mesh: HandMesh, bodies: TrialBodies,
    # trials
    active_in: wp.array(dtype=wp.bool),  # (B,)
    q_in: wp.array2d(dtype=float),  # (B, JOINTS)
    # out
    distance_out: wp.array(dtype=float), body_out: wp.array(dtype=int),
    point_out: wp.array(dtype=wp.vec3),  # world frame
):  # fmt: skip
    """Signed distance of the robot to the hand's exact mesh at one posture: exact below `cap`, an overlap bound below 0."""
    trial = first + wp.tid()
    distance_out[trial] = cap
    body_out[trial] = -1
    point_out[trial] = wp.vec3(wp.nan, wp.nan, wp.nan)
    if not active_in[trial]:
        return
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    w = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    v = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    mask = wp.zeros(shape=1, dtype=wp.uint64)
    q = load(q_in, trial)
    best = float(cap)
    if on_cuda() == 0:  # there threads wait for the slowest, and the guess does not pay
        forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q, R, p)
        best = guessed_distance(world, mesh, bodies, trial, cap, R, p, tri)
        if best > cap:
            return
    found = HandDistance()
    looking = bool(True)
    while looking:
        mask[0] = (wp.uint64(1) << wp.uint64(world.n_robot)) - wp.uint64(1)
        found = posture_distance(world, mesh, bodies, trial, q, vecq(), best, 0.0, mask, R, p, w, v, tri)
        looking = best < cap and (found.body < 0 or found.inside == 1 or found.distance == -TOUCH_M)
        best = cap
    distance_out[trial] = wp.where(found.body >= 0, found.distance, cap)
    body_out[trial] = found.body
    if found.body >= 0:
        point_out[trial] = wp.transpose(bodies.R_hand_world[trial]) * (found.point - bodies.p_hand_world[trial])
