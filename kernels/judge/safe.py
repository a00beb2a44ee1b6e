"""Safe: smallest distance between the robot and the hand's exact mesh along a path (branch and bound over time)."""

import warp as wp

from r2h_batch.kernels.geometry.bisection import MAX_LEVEL, descend, half_width, middle, next_interval
from r2h_batch.kernels.geometry.hand_mesh import HandMesh
from r2h_batch.kernels.options import OPTIONS

from ..plan.edge import SECTION_RAD
from ..robot.joints import FIELDS, FRAMES, JOINTS
from ..robot.posture import load_waypoint
from ..robot.world import TrialBodies, World
from .hand_bounds import allowed_of
from .hand_distance import posture_distance

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache


# Branch and bound over time. `best` is an upper bound of the smallest distance, taken at postures, and falls; an interval of
# the path is dropped as soon as none of its postures can be below `best` less what is allowed:
#
# 1. the goal posture alone (step 0), which is nearest of all most of the time;
# 2. the segments from the last to the first; each is halved depth first (bisection.py), level and index naming an interval;
# 3. `stack` keeps per level the bodies that the halves have to look at: what was settled for an interval is for its halves;
# 4. what is allowed grows with `best`, max(tol, 0.2 %): a distance of 5 cm need not be known to a tenth of a millimetre.
#    Overlaps are located to half their size only: how deep is asked for a slope, not for a verdict.
@wp.kernel
def safe_distance(
    first: int, cap: float, tolerance: float,
    # tables
    world: World, mesh: HandMesh, bodies: TrialBodies,
    # trials
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
    # out
    distance_out: wp.array(dtype=float), body_out: wp.array(dtype=int), segment_out: wp.array(dtype=int),
    fraction_out: wp.array(dtype=float),
    point_out: wp.array(dtype=wp.vec3),  # world frame
):  # fmt: skip
    """Smallest signed robot-hand distance along each path: exact to `tolerance` (or 0.2 %) below `cap`, a lower bound above.

    The goal posture comes first: it is usually the nearest, and prunes the rest. Overlaps are negative and grow with the
    depth of the deepest triangle in a primitive; they are located to half their size.
    """
    trial = first + wp.tid()
    n = length_in[trial]
    if n == 0:
        return
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    tri = wp.zeros(shape=3, dtype=wp.vec3)
    w = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    v = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    mask = wp.zeros(shape=1, dtype=wp.uint64)
    stack = wp.zeros(shape=16, dtype=wp.uint64)  # per level of the bisection: the mask that its intervals start from
    everything = (wp.uint64(1) << wp.uint64(world.n_robot)) - wp.uint64(1)
    best = float(cap)
    body = int(-1)
    segment = int(n - 2)
    fraction = float(1.0)
    point = wp.vec3(0.0, 0.0, 0.0)
    # step 0 is the goal posture alone, step k > 0 the k-th segment from the end
    for step in range(n):
        i = wp.max(n - 1 - wp.max(step, 1), 0)
        a = load_waypoint(path_in, trial, i)
        delta = load_waypoint(path_in, trial, i + 1) - a
        length = float(0.0)
        for j in range(JOINTS):
            length += wp.abs(delta[j])
        sections = wp.max(int(wp.ceil(length / SECTION_RAD)), 1)
        section = sections - 1
        one = 1.0 / float(sections)
        stack[0] = everything
        level = int(0)
        index = int(0)
        running = bool(True)
        while running:
            t = (float(section) + middle(level, index)) * one
            d = (half_width(level) * one) * delta
            if step == 0:
                t = 1.0
                d = 0.0 * delta
            mask[0] = stack[level]
            allowed = allowed_of(tolerance, best)
            found = posture_distance(world, mesh, bodies, trial, a + t * delta, d, best, allowed, mask, R, p, w, v, tri)
            if found.changed == 1:
                best = found.distance
                body = found.body
                segment = i
                fraction = t
                point = found.point
            if step == 0:
                running = False
            elif found.open == 1 and level + 1 < MAX_LEVEL:
                level, index = descend(level, index)
                stack[level] = mask[0]
            else:
                level, index = next_interval(level, index)
                if level == 0:
                    index = 0
                    section -= 1
                    running = section >= 0
    distance_out[trial] = best
    body_out[trial] = body
    segment_out[trial] = segment
    fraction_out[trial] = fraction
    point_out[trial] = wp.transpose(bodies.R_hand_world[trial]) * (point - bodies.p_hand_world[trial])
