"""What GJK's distances say of whole stretches: plan/check.py's step 4, a thread for each pair."""

import warp as wp

from r2h_batch.kernels.geometry.body import support, swept_support
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.partners import least_rest
from r2h_batch.kernels.robot.posture import load
from r2h_batch.kernels.robot.world import (
    CHANGES,
    OBJECT,
    TrialBodies,
    World,
    acceleration_along,
    acceleration_seen_along,
    bends,
    body_pose,
    link_frame,
    motion,
)
from r2h_batch.kernels.wave.pairs import partner_of, shape_of
from r2h_batch.kernels.wave.queues import (
    HAND,
    PAIRS,
    SELF,
    Counts,
    Edges,
    Frames,
    Pairs,
    Stretches,
    bit_of,
    is_done,
    link_of,
    target_of,
)

wp.set_module_options(OPTIONS | {"max_unroll": 0})


# With D GJK's lower bound in the middle, L what the levers allow the pair to travel, and the margin (or what is known less the
# tolerance, once all pairs of this wave have been measured):
#
# 1. D - L >= margin: settled;
# 2. D - `least_rest` short of the margin, or bodies that meet: no plane can settle it, it stays open;
# 3. else the plane between the nearest points, with the motion as the partner sees it: a piece stands still in the hand's
#    frame, the table in the world's, a body in its link's (plan/edge.py). Not enough: open.
#
# A posture has no stretch to be settled: GJK alone has said what is to be said.
@wp.kernel
def settle_pairs(
    first: int,
    lanes: int,
    track: int,
    tolerance: float,
    world: World,
    bodies: TrialBodies,
    edges: Edges,
    queue: Stretches,
    frames: Frames,
    pairs: Pairs,
    counts: Counts,
):
    """Notes which pairs do not keep their margin on the whole stretch: as far as the levers allow, then along GJK's plane."""
    for i in range(first + wp.tid(), wp.min(counts.n[PAIRS], pairs.stretch.shape[0]), lanes):
        s = pairs.stretch[i]
        b = pairs.body[i]
        edge = queue.edge[s]
        key = edges.found[edges.owner[edge]]
        d = load(frames.d, s)
        if is_done(track, key) or wp.dot(d, d) == 0.0:
            continue
        trial = edges.trial[edge]
        kind = pairs.other[i] / 256
        other = pairs.other[i] & 255
        link = link_of(world, b)
        k = int(0)  # the link whose motion the pair sees
        if kind == SELF:
            k = world.body_link[other]
        travel = float(0.0)
        second = float(0.0)
        third = float(0.0)
        if link == OBJECT:
            travel = motion(bodies.object_lever, trial, k, d)
            second, third = bends(bodies.object_lever, trial, k, d)
        else:
            travel = motion(world.lever, b, k, d)
            second, third = bends(world.lever, b, k, d)
        margin = target_of(track, tolerance, key, wp.where(kind == HAND, edges.hand_margin[edge], 0.0))
        apart = pairs.lower[i]
        if apart < margin + travel and apart > margin + least_rest(second, third) and pairs.upper[i] > 0.0:
            n_hat = pairs.v[i] / wp.length(pairs.v[i])
            shape, _center = partner_of(world, bodies, trial, pairs.other[i])
            beside = wp.dot(n_hat, support(shape, world.points, n_hat)) + shape.radius
            j = link_frame(link)
            w = frames.w[s, j]
            v = frames.v[s, j]
            a = frames.w[s, CHANGES + j]
            c = frames.v[s, CHANGES + j]
            n = n_hat
            g = wp.vec3(0.0, 0.0, 0.0)
            along = float(0.0)
            if kind == SELF:
                Ro, po = body_pose(world, bodies, trial, frames.R[s], frames.p[s], other)
                n = Ro * n_hat
                beside += wp.dot(n, po)
                g, along = acceleration_seen_along(n, w, v, a, c, k, frames.w[s], frames.v[s])
                w = w - frames.w[s, k]
                v = v - frames.v[s, k]
            else:
                if kind != HAND:
                    R_hand_world = bodies.R_hand_world[trial]
                    n = R_hand_world * n_hat
                    beside += wp.dot(n, R_hand_world * world.table_center + bodies.p_hand_world[trial])
                g, along = acceleration_along(n, w, a, c)
            Rb, pb = body_pose(world, bodies, trial, frames.R[s], frames.p[s], b)
            mover = shape_of(world, bodies, trial, b)
            apart = travel - beside + swept_support(mover, Rb, pb, world.points, n, w, v, g, along, second, third)
        if apart < margin + travel:
            wp.atomic_or(frames.open, s, kind, bit_of(world, b))
