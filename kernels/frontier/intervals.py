"""Intervals: the first ones of each edge, where the arm's links are in the middle of each, and the halves of those left open."""

import warp as wp

from r2h_batch.kernels.geometry.bisection import MAX_LEVEL, half_width, middle
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import CERTIFY, CLEARANCE, HAND, SAMPLES, SELF, TABLE

from ..plan.edge import MOVEIT_SEGMENT_RAD, SECTION_RAD
from ..robot.joints import JOINTS, vecq
from ..robot.posture import load
from ..robot.world import TrialBodies, World, forward_kinematics, twists
from .queues import (
    BODIES,
    EDGES,
    NOTHING,
    NOW,
    PAIRS,
    PIECES,
    POSTURE_LEVEL,
    TAKEN,
    Counts,
    Edges,
    Frames,
    Intervals,
    is_done,
    key_of,
    take,
)

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.func
def sections_of(a: vecq, b: vecq, step: float):
    """Into how many equal sections of at most `step` (rad, summed over the joints) an edge is cut."""
    length = float(0.0)
    for j in range(JOINTS):
        length += wp.abs(b[j] - a[j])
    return wp.max(int(wp.ceil(length / step)), 1)


@wp.func
def add_interval(
    queue: Intervals, row: int, edge: int, section: int, level: int, index: int,
    hand: wp.int64, table: wp.int64, self_bits: wp.int64,
):  # fmt: skip
    """Writes an interval to its row."""
    queue.edge[row] = edge
    queue.section[row] = section
    queue.level[row] = level
    queue.index[row] = index
    queue.look[row, HAND] = hand
    queue.look[row, TABLE] = table
    queue.look[row, SELF] = self_bits


@wp.func
def add_edge(
    world: World, edges: Edges, queue: Intervals, counts: Counts, parity: int, i: int, mode: int, hand_only: int
):
    """Queues the first intervals of an edge: its sections, its samples, or its first posture, as plan/edge.py has them."""
    a = load(edges.a, i)
    b = load(edges.b, i)
    everything = wp.int64(-1)
    others = wp.where(hand_only == 1, wp.int64(0), everything)
    tabled = others << wp.int64(world.table_from)  # base and shoulder stand on the table
    n = int(1)
    level = int(POSTURE_LEVEL)
    if mode == CERTIFY or mode == CLEARANCE:  # noqa: SIM109 (Warp has no `in`)
        n = sections_of(a, b, SECTION_RAD)
        level = 0
    elif mode == SAMPLES:
        n = sections_of(a, b, MOVEIT_SEGMENT_RAD)
    for k in range(n):
        row = take(counts, NOW + parity, queue.edge.shape[0])
        if row >= 0:
            if level == 0:
                add_interval(queue, row, i, k, 0, 0, everything, tabled, others)
            elif mode == SAMPLES:
                add_interval(queue, row, i, n, level, k, everything, tabled, others)
            else:
                add_interval(queue, row, i, 1, level, -1, everything, tabled, others)


@wp.kernel
def queue_edges(
    first: int, parity: int,
    mode: int,  # CERTIFY, CLEARANCE, SAMPLES or POSTURE (plan/codes.py)
    hand_only: int, world: World, edges: Edges, queue: Intervals,
    used_in: wp.array(dtype=wp.bool),  # (E,) edges to be checked
    counts: Counts,
):  # fmt: skip
    """Queues the first intervals of all edges in use."""
    i = first + wp.tid()
    if used_in[i]:
        add_edge(world, edges, queue, counts, parity, i, mode, hand_only)


@wp.kernel
def queue_paths(
    first: int, parity: int,
    row: int,  # of the first edge that is not in use
    world: World, edges: Edges, queue: Intervals,
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
    counts: Counts,
):  # fmt: skip
    """Makes an edge of every segment of each path, for its smallest clearance, and queues it."""
    trial = first + wp.tid()
    for k in range(length_in[trial] - 1):
        i = row + take(counts, EDGES, edges.trial.shape[0] - row)
        if i >= row:
            edges.trial[i] = trial
            edges.owner[i] = trial
            edges.hand_margin[i] = 0.0
            for j in range(JOINTS):
                edges.a[i, j] = path_in[trial, k, j]
                edges.b[i, j] = path_in[trial, k + 1, j]
            add_edge(world, edges, queue, counts, parity, i, CLEARANCE, 0)


@wp.kernel
def interval_frames(
    first: int, lanes: int, parity: int, world: World, bodies: TrialBodies, edges: Edges, queue: Intervals,
    frames: Frames, counts: Counts,
):  # fmt: skip
    """Link frames in the middle of each interval, and their twists along it; opens an empty round of the other queues."""
    if first + wp.tid() == 0:
        counts.n[BODIES + HAND] = 0
        counts.n[BODIES + TABLE] = 0
        counts.n[BODIES + SELF] = 0
        counts.n[BODIES + PIECES] = 0
        counts.n[PAIRS] = 0
        counts.n[TAKEN] = 0
    for s in range(first + wp.tid(), wp.min(counts.n[NOW + parity], queue.edge.shape[0]), lanes):
        for k in range(3):
            frames.open[s, k] = wp.int64(0)
        edge = queue.edge[s]
        trial = edges.trial[edge]
        a = load(edges.a, edge)
        delta = load(edges.b, edge) - a
        q = vecq()
        d = vecq()
        level = queue.level[s]
        if level < 0:
            q = a + (float(queue.index[s] + 1) / float(queue.section[s])) * delta
        else:
            one = 1.0 / float(sections_of(a, load(edges.b, edge), SECTION_RAD))
            q = a + ((float(queue.section[s]) + middle(level, queue.index[s])) * one) * delta
            d = (half_width(level) * one) * delta
        for j in range(JOINTS):
            frames.d[s, j] = d[j]
        forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q, frames.R[s], frames.p[s])
        twists(d, frames.R[s], frames.p[s], frames.w[s], frames.v[s])


@wp.kernel
def halve(
    first: int, lanes: int, parity: int, aim: int,
    certify: int,  # 1: an interval that is open on the finest level blocks; 0: it counts as settled
    edges: Edges, queue: Intervals, later: Intervals, frames: Frames, counts: Counts,
):  # fmt: skip
    """Queues both halves of open intervals for the next level."""
    for s in range(first + wp.tid(), wp.min(counts.n[NOW + parity], queue.edge.shape[0]), lanes):
        edge = queue.edge[s]
        owner = edges.owner[edge]
        hand = frames.open[s, HAND]
        table = frames.open[s, TABLE]
        self_bits = frames.open[s, SELF]
        level = queue.level[s]
        if level >= 0 and (hand | table | self_bits) != wp.int64(0) and not is_done(aim, edges.found[owner]):
            if level + 1 < MAX_LEVEL:
                for half in range(2):
                    row = take(counts, NOW + 1 - parity, later.edge.shape[0])
                    if row >= 0:
                        add_interval(
                            later,
                            row,
                            edge,
                            queue.section[s],
                            level + 1,
                            2 * queue.index[s] + half,
                            hand,
                            table,
                            self_bits,
                        )
            elif certify == 1:
                wp.atomic_min(edges.found, owner, key_of(0.0, NOTHING - 1))
