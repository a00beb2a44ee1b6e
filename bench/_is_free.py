"""The kernel of bench/collision.py: is a posture free, and nothing else asked."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import FREE, POSTURE
from r2h_batch.kernels.plan.edge import edge
from r2h_batch.kernels.robot.posture import load
from r2h_batch.kernels.robot.world import TrialBodies, World

wp.set_module_options(OPTIONS)


@wp.kernel
def is_free(
    first: int,
    per_trial: int,
    world: World,
    bodies: TrialBodies,
    q_in: wp.array2d(dtype=float),
    free_out: wp.array(dtype=wp.bool),
):
    row = first + wp.tid()
    q = load(q_in, row)
    found = edge(world, bodies, row / per_trial, q, q, 0.0, 0.0, 0.0, 0.0, POSTURE)
    free_out[row] = found.status == FREE
