"""Whole intervals settled by GJK's distances: plan/check.py's step 4, a thread for each pair."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import HAND, SELF

from ..plan.obstacles import pair_motion, settle_pair
from ..robot.posture import load
from ..robot.world import TrialBodies, World
from .bodies import moving_body_of
from .pairs import obstacle_of
from .queues import PAIRS, Counts, Edges, Frames, Intervals, Pairs, bit_of, is_done, link_of, target_of

wp.set_module_options(OPTIONS | {"max_unroll": 0})


# `settle_pair` (plan/obstacles.py), once all pairs of this level have been measured. A posture has no interval to be settled: GJK
# alone says whether it is free.
@wp.kernel
def settle_pairs(
    first: int, lanes: int, aim: int, tolerance: float, world: World, bodies: TrialBodies, edges: Edges,
    queue: Intervals, frames: Frames, pairs: Pairs, counts: Counts,
):  # fmt: skip
    """Notes which pairs do not keep their margin on the whole interval (`settle_pair`)."""
    for i in range(first + wp.tid(), wp.min(counts.n[PAIRS], pairs.interval.shape[0]), lanes):
        s = pairs.interval[i]
        b = pairs.body[i]
        edge = queue.edge[s]
        key = edges.found[edges.owner[edge]]
        d = load(frames.d, s)
        if is_done(aim, key) or wp.dot(d, d) == 0.0:
            continue
        trial = edges.trial[edge]
        kind = pairs.other[i] / 256
        other = pairs.other[i] & 255
        k = int(0)  # the link whose motion the pair sees
        if kind == SELF:
            k = world.body_link[other]
        travel, second, third = pair_motion(world, bodies, trial, link_of(world, b), b, k, d)
        margin = target_of(aim, tolerance, key, wp.where(kind == HAND, edges.hand_margin[edge], 0.0))
        shape, _center = obstacle_of(world, bodies, trial, pairs.other[i])
        body = moving_body_of(world, bodies, frames, s, trial, b)
        if not settle_pair(
            world, bodies, trial, body, kind, other, shape, pairs.lower[i], pairs.upper[i], pairs.v[i],
            margin, travel, second, third, True, frames.R[s], frames.p[s], frames.w[s], frames.v[s],
        ):  # fmt: skip
            wp.atomic_or(frames.open, s, kind, bit_of(world, b))
