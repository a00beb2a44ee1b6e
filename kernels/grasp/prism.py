"""The prism of the finger pads, and runs of material along its axis: disjoint intervals [low, high] of y."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def corner(i: int, half_x: float, z_low: float, z_high: float):
    """x, z of the prism's corner line i = 0 .. 3."""
    return wp.where(i < 2, -half_x, half_x), wp.where(i % 2 == 0, z_low, z_high)


MAX_RUNS = wp.constant(24)
JOIN_M = wp.constant(1.0e-6)
COVERED_M = wp.constant(1.0e-7)
FAR = wp.constant(1.0e30)


@wp.func
def outermost(run_low: wp.array(dtype=float), run_high: wp.array(dtype=float), runs: int, half_gap: float):
    """Lowest and highest y of the runs that meet |y| < half_gap (low > high: none)."""
    low = float(FAR)
    high = float(-FAR)
    for i in range(runs):
        if run_high[i] > -half_gap and run_low[i] < half_gap:
            low = wp.min(low, run_low[i])
            high = wp.max(high, run_high[i])
    return low, high
