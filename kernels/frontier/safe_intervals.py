"""Intervals of Safe: the last posture of each motion, its segments, the frames of the links, the halves of open intervals."""

import warp as wp

from r2h_batch.kernels.frontier.safe_queues import (
    BODIES,
    FACES,
    GOAL_LEVEL,
    NOWHERE,
    PIECES,
    SEGMENTS,
    SETS,
    TAKEN,
    Moments,
    Nearest,
)
from r2h_batch.kernels.geometry.bisection import MAX_LEVEL, half_width, middle
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import HAND

from ..plan.edge import SECTION_RAD
from ..robot.joints import JOINTS, vecq
from ..robot.posture import load_waypoint
from ..robot.world import TrialBodies, World, forward_kinematics, twists
from .intervals import sections_of
from .queues import NOW, Counts, Frames, take

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.func
def put_interval(
    queue: Moments, row: int, trial: int, segment: int, section: int, level: int, index: int, look: wp.int64
):
    """Writes an interval to its row."""
    queue.trial[row] = trial
    queue.segment[row] = segment
    queue.section[row] = section
    queue.level[row] = level
    queue.index[row] = index
    queue.look[row] = look


@wp.func
def all_bodies(world: World):
    """Bits of all robot bodies."""
    return (wp.int64(1) << wp.int64(world.n_robot)) - wp.int64(1)


@wp.func
def interval_of(
    path: wp.array3d(dtype=float), trial: int, segment: int, section: int, level: int, index: int
):  # fmt: skip
    """An interval's middle posture, half its length, and the fraction of its segment where the middle is."""
    a = load_waypoint(path, trial, segment)
    b = load_waypoint(path, trial, segment + 1)
    delta = b - a
    fraction = float(1.0)
    d = vecq()
    if level > GOAL_LEVEL:
        one = 1.0 / float(sections_of(a, b, SECTION_RAD))
        fraction = (float(section) + middle(level, index)) * one
        d = (half_width(level) * one) * delta
    return a + fraction * delta, d, fraction


@wp.kernel
def queue_goals(
    first: int, cap: float, world: World, queue: Moments, nearest: Nearest,
    length_in: wp.array(dtype=int),  # (B,)
    counts: Counts,
):  # fmt: skip
    """Nothing nearer than `cap` is known of any trial; queues the last posture of each motion."""
    trial = first + wp.tid()
    nearest.distance[trial] = cap
    nearest.above[trial] = cap
    nearest.place[trial] = wp.int64(NOWHERE)
    if length_in[trial] > 0:
        row = take(counts, NOW, queue.trial.shape[0])
        if row >= 0:
            put_interval(queue, row, trial, wp.max(length_in[trial] - 2, 0), 0, GOAL_LEVEL, 0, all_bodies(world))


@wp.kernel
def queue_segments(
    first: int, block: int, world: World, queue: Moments,
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
    counts: Counts,
):  # fmt: skip
    """Queues all sections of a segment; SEGMENTS threads a trial, for the segments of one block."""
    i = first + wp.tid()
    trial = i / SEGMENTS
    segment = block * SEGMENTS + i % SEGMENTS
    if segment < length_in[trial] - 1:
        a = load_waypoint(path_in, trial, segment)
        b = load_waypoint(path_in, trial, segment + 1)
        for section in range(sections_of(a, b, SECTION_RAD)):
            row = take(counts, NOW, queue.trial.shape[0])
            if row >= 0:
                put_interval(queue, row, trial, segment, section, 0, 0, all_bodies(world))


@wp.kernel
def safe_frames(
    first: int, lanes: int, parity: int, world: World, bodies: TrialBodies, queue: Moments, frames: Frames,
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    counts: Counts,
):  # fmt: skip
    """Link frames in the middle of each interval, and their twists along it; opens an empty round of the other queues."""
    if first + wp.tid() == 0:
        counts.n[BODIES] = 0
        counts.n[PIECES] = 0
        counts.n[SETS] = 0
        counts.n[FACES] = 0
        counts.n[TAKEN] = 0
    for s in range(first + wp.tid(), wp.min(counts.n[NOW + parity], queue.trial.shape[0]), lanes):
        trial = queue.trial[s]
        frames.open[s, HAND] = wp.int64(0)
        q, d, _fraction = interval_of(
            path_in, trial, queue.segment[s], queue.section[s], queue.level[s], queue.index[s]
        )
        for j in range(JOINTS):
            frames.d[s, j] = d[j]
        forward_kinematics(world, bodies.R_hand_world[trial], bodies.p_hand_world[trial], q, frames.R[s], frames.p[s])
        twists(d, frames.R[s], frames.p[s], frames.w[s], frames.v[s])


@wp.kernel
def safe_halves(first: int, lanes: int, parity: int, queue: Moments, later: Moments, frames: Frames, counts: Counts):
    """Queues both halves of open intervals for the next level."""
    for s in range(first + wp.tid(), wp.min(counts.n[NOW + parity], queue.trial.shape[0]), lanes):
        look = frames.open[s, HAND]
        level = queue.level[s]
        if look != wp.int64(0) and level > GOAL_LEVEL and level + 1 < MAX_LEVEL:
            for half in range(2):
                row = take(counts, NOW + 1 - parity, later.trial.shape[0])
                if row >= 0:
                    index = 2 * queue.index[s] + half
                    put_interval(later, row, queue.trial[s], queue.segment[s], queue.section[s], level + 1, index, look)
