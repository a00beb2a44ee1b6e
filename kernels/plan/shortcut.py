"""Shorter paths, measured by the time law. One thread per problem.

First a path of n waypoints becomes its quickest subset. The waypoints are numbered along the path, a straight line may join any
two, and the quickest way from the first to the last is a shortest path in a graph without cycles. A check whether a line is free
costs a thousand times as much as its time. So a line counts as free until it is checked, and only lines on the quickest way are
checked (LazySP, Dellin and Srinivasa 2016).

Then waypoints move towards the line between their neighbours, in all joints or some (partial shortcuts, Geraerts and Overmars
2007), and lines join points of different segments. A path that is nearly as quick as the straight line between its ends stays
as it is.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import FREE

from ..robot.joints import JOINTS, vecq
from ..robot.posture import Pace, duration, load_waypoint, store_waypoint
from ..robot.world import TrialBodies, World
from .edge import edge

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache

MOST_LINES = wp.constant(64)
"""Lines between waypoints that one pass checks at most."""
LEAST_SAVED_S = wp.constant(0.001)
"""Seconds that a change has to save before its edges are checked."""

FIRST_SHARE = wp.constant(0.9)
"""By how much of its way a waypoint is pulled at first; half of that after each pull that is not free."""

# What is tried (`shortcut`).
SUBSET = wp.constant(0)  # a line between two waypoints, which the quickest way would use
JOIN = wp.constant(1)  # a line between points of two segments
PULL = wp.constant(2)  # a waypoint nearer to the line between its neighbours: the line to it
PULL_ON = wp.constant(3)  # and the line from it

# Postures of what is tried.
FROM = wp.constant(0)
TO = wp.constant(1)
MOVED = wp.constant(2)  # the waypoint that is pulled, where it would be then


@wp.func(inline=False)
def segment_time(a: vecq, b: vecq, pace: Pace):
    """Time of a segment, stopping at both ends: the joint with the farthest to go, by its weight, sets the pace."""
    d = float(0.0)
    for j in range(JOINTS):
        d = wp.max(d, wp.abs(b[j] - a[j]) * pace.weight[j])
    return duration(d, pace.speed, pace.acceleration)


@wp.func(inline=False)
def _saved(path: wp.array3d(dtype=float), trial: int, i: int, j: int, a: vecq, b: vecq, pace: Pace):
    """Time saved when a on segment i and b on segment j > i are joined by a straight line."""
    saved = float(0.0)
    for m in range(i, j + 1):
        saved += segment_time(load_waypoint(path, trial, m), load_waypoint(path, trial, m + 1), pace)
    a0 = load_waypoint(path, trial, i)
    saved -= segment_time(a0, a, pace) + segment_time(a, b, pace)
    saved -= segment_time(b, load_waypoint(path, trial, j + 1), pace)
    return saved


@wp.func(inline=False)
def _splice(path: wp.array3d(dtype=float), trial: int, n: int, i: int, j: int, a: vecq, b: vecq):
    """Waypoints i + 1 .. j give way to a and b. The new number of waypoints; n, and nothing done, if there is no room."""
    removed = j - i
    if removed == 1 and n >= path.shape[1]:
        return n
    if removed == 1:
        m = int(n)
        while m > j + 1:
            store_waypoint(path, trial, m, load_waypoint(path, trial, m - 1))
            m -= 1
    else:
        for m in range(j + 1, n):
            store_waypoint(path, trial, m - removed + 2, load_waypoint(path, trial, m))
    store_waypoint(path, trial, i + 1, a)
    store_waypoint(path, trial, i + 2, b)
    return n - removed + 2


@wp.func(inline=False)
def time_of(path: wp.array3d(dtype=float), trial: int, n: int, pace: Pace):
    """Time of a whole path."""
    time = float(0.0)
    for m in range(n - 1):
        time += segment_time(load_waypoint(path, trial, m), load_waypoint(path, trial, m + 1), pace)
    return time


@wp.func(inline=False)
def _quickest(
    path: wp.array3d(dtype=float), trial: int, n: int, pace: Pace,
    blocked: wp.array(dtype=wp.uint32), cost: wp.array(dtype=float), before: wp.array(dtype=int),
):  # fmt: skip
    """Writes which waypoint comes before each on the quickest way there that uses no line known to be blocked."""
    cost[0] = 0.0
    for k in range(1, n):
        cost[k] = 1.0e30
        waypoint = load_waypoint(path, trial, k)
        for i in range(k):
            if (blocked[i] >> wp.uint32(k)) & wp.uint32(1) == wp.uint32(0):
                t = cost[i] + segment_time(load_waypoint(path, trial, i), waypoint, pace)
                if t < cost[k]:
                    cost[k] = t
                    before[k] = i


@wp.func(inline=False)
def _unknown(known: wp.array(dtype=wp.uint32), before: wp.array(dtype=int), n: int):
    """The end waypoint of the quickest way's last unchecked line; 0 when all are checked."""
    k = int(n - 1)
    while k > 0 and (known[before[k]] >> wp.uint32(k)) & wp.uint32(1) == wp.uint32(1):
        k = before[k]
    return k


@wp.func(inline=False)
def _keep_quickest(path: wp.array3d(dtype=float), trial: int, n: int, before: wp.array(dtype=int)):
    """Leaves out all waypoints but those of the quickest way; the new number."""
    kept = wp.uint64(0)
    k = int(n - 1)
    while k > 0:
        kept = kept | (wp.uint64(1) << wp.uint64(k))
        k = before[k]
    m = int(1)
    for i in range(1, n):
        if (kept >> wp.uint64(i)) & wp.uint64(1) == wp.uint64(1):
            store_waypoint(path, trial, m, load_waypoint(path, trial, i))
            m += 1
    return m


# Three phases in one loop around one call of `edge`:
#
# 1. SUBSET: the quickest subset of the waypoints, line by line (the head of this file);
# 2. `tries` times, in turn: PULL, the next waypoint moves by a share of the way to where it would be on the line between its
#    neighbours, first in all joints, then in some; or JOIN, two random points on different segments are joined;
# 3. SUBSET once more if something changed: a waypoint that has moved may be one to leave out.
#
# The time comes before the edge, because it costs nothing. A change that saves none is not a try; 4 `tries` are drawn at most.
# A splice puts two waypoints in place of those between; where the array has no room for one more it is left out (`_splice`).
@wp.kernel
def shortcut(
    first: int,
    # search
    tries: int,
    enough: float,  # a path that takes at most this times the straight line between its ends is left as it is
    pace: Pace, seed: int,
    edge_mode: int,  # how edges are checked: CERTIFY or SAMPLES
    # tables
    world: World, bodies: TrialBodies,
    # trials
    trial_in: wp.array(dtype=int),  # (P,) rows of the problems
    key_in: wp.array(dtype=int),  # (B,)
    margin_in: wp.array(dtype=float),  # (B,)
    # in and out
    path_inout: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_inout: wp.array(dtype=int),  # (B,)
):  # fmt: skip
    """Shortens paths in place: the quickest subset of the waypoints, then changes that save time, the subset once more.

    Rows with two waypoints or none are passed over.

    The arm stops at waypoints, so a shortcut that adds one has to save more than a stop takes.
    """
    trial = trial_in[first + wp.tid()]
    n = int(length_inout[trial])
    if n <= 2:
        return
    rng = wp.rand_init(seed + 1, key_in[trial])
    margin = margin_in[trial]
    known = wp.zeros(shape=32, dtype=wp.uint32)  # bit j of entry i: the line from i to j > i is checked
    blocked = wp.zeros(shape=32, dtype=wp.uint32)
    cost = wp.zeros(shape=32, dtype=float)
    before = wp.zeros(shape=32, dtype=int)
    share = wp.zeros(shape=32, dtype=float)  # by how much a waypoint is pulled next
    for i in range(n - 1):
        known[i] = wp.uint32(1) << wp.uint32(i + 1)
    straight = segment_time(load_waypoint(path_inout, trial, 0), load_waypoint(path_inout, trial, n - 1), pace)
    # the line from end to end is blocked, or there would have been no search
    known[0] = known[0] | (wp.uint32(1) << wp.uint32(n - 1))
    blocked[0] = wp.uint32(1) << wp.uint32(n - 1)
    kind = int(0)
    changed = int(0)
    phase = int(SUBSET)
    passes = int(0)
    looked = int(0)
    tried = int(0)
    proposed = int(0)
    i = int(0)
    j = int(0)
    line = wp.zeros(shape=3, dtype=vecq)  # in memory: as values they would be copied wherever branches meet
    running = bool(True)
    while running:
        if phase == SUBSET:
            _quickest(path_inout, trial, n, pace, blocked, cost, before)
            j = _unknown(known, before, n)
            i = before[j]
            if looked >= MOST_LINES:  # the rest counts as blocked
                for m in range(n - 1):
                    blocked[m] = blocked[m] | ~known[m]
                _quickest(path_inout, trial, n, pace, blocked, cost, before)
                j = 0
            if j > 0:
                line[FROM] = load_waypoint(path_inout, trial, i)
                line[TO] = load_waypoint(path_inout, trial, j)
                looked += 1
            else:
                n = _keep_quickest(path_inout, trial, n, before)
                passes += 1
                phase = JOIN
                for m in range(n):
                    share[m] = FIRST_SHARE
                if passes == 2 or n == 2 or time_of(path_inout, trial, n, pace) <= enough * straight:
                    running = False
                continue
        elif phase != PULL_ON:
            proposed += 1
            if tried >= tries or proposed > 4 * tries:
                if changed == 0:
                    break
                phase = SUBSET
                looked = 0
                for m in range(n - 1):
                    blocked[m] = wp.uint32(0)
                    known[m] = wp.uint32(1) << wp.uint32(m + 1)
                known[0] = known[0] | (wp.uint32(1) << wp.uint32(n - 1))
                blocked[0] = wp.uint32(1) << wp.uint32(n - 1)
                continue
            kind = proposed % 3
            phase = wp.where(kind == 0, JOIN, PULL)
            if phase == JOIN:
                i = wp.min(int(wp.randf(rng) * float(n - 1)), n - 2)
                j = wp.min(int(wp.randf(rng) * float(n - 1)), n - 2)
                s = wp.randf(rng)
                t = wp.randf(rng)
                if i == j:
                    continue
                # from the point s of segment i to the point t of segment j
                if i > j:
                    i, j = j, i
                a0 = load_waypoint(path_inout, trial, i)
                b0 = load_waypoint(path_inout, trial, j)
                a = a0 + s * (load_waypoint(path_inout, trial, i + 1) - a0)
                b = b0 + t * (load_waypoint(path_inout, trial, j + 1) - b0)
                if _saved(path_inout, trial, i, j, a, b, pace) <= LEAST_SAVED_S:
                    continue
                line[FROM] = a
                line[TO] = b
            else:
                i = 1 + (proposed / 3) % (n - 2)
                a = load_waypoint(path_inout, trial, i - 1)
                moved = load_waypoint(path_inout, trial, i)
                b = load_waypoint(path_inout, trial, i + 1)
                t0 = segment_time(a, moved, pace)
                t1 = segment_time(moved, b, pace)
                some = kind == 2
                by = wp.where(some, wp.randf(rng), share[i])
                for m in range(JOINTS):
                    on_line = a[m] + (t0 / (t0 + t1)) * (b[m] - a[m])
                    if not some or wp.randf(rng) < 0.5:
                        moved[m] = moved[m] + by * (on_line - moved[m])
                now = segment_time(a, moved, pace) + segment_time(moved, b, pace)
                if now >= t0 + t1 - LEAST_SAVED_S:
                    continue
                line[FROM] = a
                line[TO] = moved
                line[MOVED] = moved
            tried += 1
        else:  # PULL_ON: the line from the moved waypoint
            line[FROM] = line[MOVED]
            line[TO] = load_waypoint(path_inout, trial, i + 1)
        found = edge(world, bodies, trial, line[FROM], line[TO], margin, 0.0, 0.0, 0.0, edge_mode)
        free = found.status == FREE
        if phase == SUBSET:
            known[i] = known[i] | (wp.uint32(1) << wp.uint32(j))
            if not free:
                blocked[i] = blocked[i] | (wp.uint32(1) << wp.uint32(j))
        elif phase == JOIN:
            if free:
                changed = 1
                n = _splice(path_inout, trial, n, i, j, line[FROM], line[TO])
                for m in range(n):
                    share[m] = FIRST_SHARE
        elif phase == PULL and free:
            phase = PULL_ON
        else:
            if free:
                store_waypoint(path_inout, trial, i, line[MOVED])
                changed = 1
                if time_of(path_inout, trial, n, pace) <= enough * straight:
                    tried = tries
            elif kind != 2:
                share[i] = 0.5 * share[i]
            phase = PULL
    length_inout[trial] = n
