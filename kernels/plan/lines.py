"""Postures and straight lines: which goals are free, which of them a straight line leads to, a path's smallest clearance."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import BRANCHES, CLEARANCE, FREE, MEETING_M, PAIR_NONE, POSTURE

from ..robot.posture import load, load_waypoint
from ..robot.world import TrialBodies, World
from .edge import edge

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache

CLEARANCE_CAP = wp.constant(0.0065)
"""Goal clearances are measured up to this value (m). It bounds `PlanConfig.hand_clearance_m`."""


@wp.kernel
def check_postures(
    first: int, per_trial: int,
    # tables
    world: World, bodies: TrialBodies,
    # postures
    active_in: wp.array(dtype=wp.bool),  # (B * per_trial,)
    q_in: wp.array2d(dtype=float),  # (B * per_trial, 6)
    # out
    clear_out: wp.array(dtype=wp.bool), pair_out: wp.array(dtype=int),
    hand_clearance_out: wp.array(dtype=float),
):  # fmt: skip
    """Is each posture free of all pairs, what does it collide with, and its hand clearance up to CLEARANCE_CAP."""
    row = first + wp.tid()
    trial = row / per_trial
    if not active_in[row]:
        return
    q = load(q_in, row)
    found = edge(world, bodies, trial, q, q, 0.0, 0.0, CLEARANCE_CAP, 0.0, POSTURE)
    clear_out[row] = found.status == FREE
    pair_out[row] = found.pair
    if found.status == FREE:
        hand_clearance_out[row] = found.best


@wp.kernel
def straight_lines(
    first: int,
    edge_mode: int,  # how edges are checked: CERTIFY or SAMPLES
    # tables
    world: World, bodies: TrialBodies,
    # trials
    start_in: wp.array2d(dtype=float),  # (B, JOINTS)
    goals_in: wp.array2d(dtype=float),  # (B * 8, JOINTS) nearest first
    n_goals_in: wp.array(dtype=int),  # (B,)
    goal_margin_in: wp.array(dtype=float),  # (B * 8,) hand clearance that a path to this goal keeps
    # out
    chosen_out: wp.array(dtype=int),
):  # fmt: skip
    """The first goal whose straight line from the start is free, or -1."""
    trial = first + wp.tid()
    start = load(start_in, trial)
    chosen_out[trial] = -1
    for g in range(n_goals_in[trial]):
        row = trial * BRANCHES + g
        found = edge(world, bodies, trial, start, load(goals_in, row), goal_margin_in[row], 0.0, 0.0, 0.0, edge_mode)
        if found.status == FREE:
            chosen_out[trial] = g
            break


@wp.kernel
def path_clearance(
    first: int, cap: float, tolerance: float,
    without: float,  # the clearance of rows without a path
    # tables
    world: World, bodies: TrialBodies,
    # trials
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
    # out
    clearance_out: wp.array(dtype=float), pair_out: wp.array(dtype=int), body_out: wp.array(dtype=int),
):  # fmt: skip
    """Smallest clearance over all pairs along each path, exact to `tolerance` below `cap`."""
    trial = first + wp.tid()
    n = length_in[trial]
    pair_out[trial] = PAIR_NONE
    body_out[trial] = -1
    if n == 0:
        clearance_out[trial] = without
        return
    best = float(cap)
    # the goal first: it is usually the tightest, and prunes the rest
    for k in range(n):
        i = n - 1 - k
        a = load_waypoint(path_in, trial, i)
        b = load_waypoint(path_in, trial, wp.min(i + 1, n - 1))
        found = edge(world, bodies, trial, a, b, 0.0, 0.0, best, tolerance, CLEARANCE)
        if found.best < best:
            best = found.best
            pair_out[trial] = found.pair
            body_out[trial] = found.body
        if best <= MEETING_M:  # no clearance is smaller
            break
    clearance_out[trial] = best
