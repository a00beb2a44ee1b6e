"""Shortcuts on the frontier: LANES changes of each path at once, where plan/shortcut.py tries one after the other.

A shortcut is an arc from one waypoint to a later one with no, one or two points between: a straight line, a waypoint that is
pulled towards the line between its neighbours, or two points of different segments that are joined. In each round every lane
proposes an arc, and all arcs are certified together. Then the path becomes the quickest way from its first waypoint to its last
through its segments and the free arcs: a shortest path in a graph without cycles. So the path never takes longer than before.

Problems do not wait for each other. A lane's arcs depend on its path and on (seed, key of the trial, number) only.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import WAYPOINTS

from ..plan.shortcut import LEAST_SAVED_S, segment_time, time_of
from ..robot.posture import Pace, load, load_waypoint, store_waypoint
from .arcs import CHANGE, IDLE, LANES, LINE, OVER, RUNNING, Arcs, Paths
from .queues import NOTHING, REQUESTS, Counts, Edges, take

wp.set_module_options(OPTIONS | {"max_unroll": 0})


@wp.func
def _bit(i: int):
    return wp.int64(1) << wp.int64(i)


@wp.func
def _is_known(paths: Paths, problem: int, i: int, j: int):
    """Whether the line from waypoint i to j is checked, or is a segment."""
    return (paths.known[problem, i] >> wp.int64(j)) & wp.int64(1) == wp.int64(1)


@wp.kernel
def begin_shortcuts(
    first: int, edges: Edges, paths: Paths, arcs: Arcs,
    margin_in: wp.array(dtype=float),  # (B,)
    length_in: wp.array(dtype=int),  # (B,)
):  # fmt: skip
    """Lanes without a proposal. Paths with two waypoints or none are over."""
    problem = first + wp.tid()
    trial = paths.trial[problem]
    n = length_in[trial]
    paths.rounds[problem] = 0
    paths.state[problem] = wp.where(n > 2, RUNNING, OVER)
    for i in range(n - 1):
        paths.known[problem, i] = _bit(i + 1)
    if n > 2:  # the line from end to end is blocked, or there would have been no search
        paths.known[problem, 0] = _bit(1) | _bit(n - 1)
    for k in range(LANES):
        lane = problem * LANES + k
        arcs.kind[lane] = IDLE
        for m in range(2):
            e = 2 * lane + m
            edges.trial[e] = trial
            edges.owner[e] = lane
            edges.hand_margin[e] = margin_in[trial]
            edges.left[e] = 0


@wp.func
def _find_quickest(
    edges: Edges, paths: Paths, arcs: Arcs, problem: int, path: wp.array3d(dtype=float), n: int,
    pace: Pace, by: wp.array(dtype=int),
):  # fmt: skip
    """Writes which arc the quickest way to each waypoint ends with (-1: its segment); what the way to the last one saves, s."""
    trial = paths.trial[problem]
    cost = wp.zeros(shape=WAYPOINTS, dtype=float)
    total = float(0.0)
    for h in range(1, n):
        t = segment_time(load_waypoint(path, trial, h - 1), load_waypoint(path, trial, h), pace)
        total += t
        cost[h] = cost[h - 1] + t
        by[h] = -1
        for k in range(LANES):
            lane = problem * LANES + k
            if arcs.kind[lane] != IDLE and arcs.hi[lane] == h:
                lo = arcs.lo[lane]
                if arcs.kind[lane] == LINE:
                    paths.known[problem, lo] = paths.known[problem, lo] | _bit(h)
                free = (edges.found[lane] & wp.int64(NOTHING)) == wp.int64(NOTHING)
                if free and cost[lo] + arcs.time[lane] < cost[h]:
                    cost[h] = cost[lo] + arcs.time[lane]
                    by[h] = lane
    return total - cost[n - 1]


# With the arc that each waypoint is come to by:
#
# 1. back from the last waypoint: which one comes `after` each;
# 2. forth from the first: the waypoints and the arcs' points are written to the copy, with the number that each `was`;
# 3. the copy becomes the path; the waypoints that are still there keep the results of their lines.
@wp.func
def _take_quickest(
    edges: Edges, paths: Paths, arcs: Arcs, problem: int, path: wp.array3d(dtype=float), n: int,
    pace: Pace,
):  # fmt: skip
    """The path becomes the quickest way through its segments and the arcs that are free; its number of waypoints."""
    trial = paths.trial[problem]
    by = wp.zeros(shape=WAYPOINTS, dtype=int)
    after = wp.zeros(shape=WAYPOINTS, dtype=int)
    was = wp.zeros(shape=WAYPOINTS, dtype=int)  # -1: it is new
    if _find_quickest(edges, paths, arcs, problem, path, n, pace, by) < LEAST_SAVED_S:
        return n
    h = int(n - 1)
    while h > 0:
        lo = int(h - 1)
        if by[h] >= 0:
            lo = arcs.lo[by[h]]
        after[lo] = h
        h = lo
    m = int(1)
    while h < n - 1:
        h = after[h]
        if by[h] >= 0:
            for i in range(arcs.n[by[h]]):
                store_waypoint(paths.copy, problem, m, load(arcs.point, 2 * by[h] + i))
                was[m] = -1
                m += 1
        store_waypoint(paths.copy, problem, m, load_waypoint(path, trial, h))
        was[m] = h
        m += 1
    for i in range(1, m):
        store_waypoint(path, trial, i, load_waypoint(paths.copy, problem, i))
    checked = wp.zeros(shape=WAYPOINTS, dtype=wp.int64)
    for i in range(m - 1):
        checked[i] = _bit(i + 1)
        for j in range(i + 2, m):
            if was[i] >= 0 and was[j] >= 0 and _is_known(paths, problem, wp.max(was[i], 0), wp.max(was[j], 0)):
                checked[i] = checked[i] | _bit(j)
    for i in range(m - 1):
        paths.known[problem, i] = checked[i]
    return m


@wp.func
def _propose_lines(paths: Paths, arcs: Arcs, problem: int, path: wp.array3d(dtype=float), n: int, pace: Pace):
    """Gives the first lanes unchecked lines, those of the quickest ways first; returns how many lanes have one.

    A way through a line is as quick as the quickest ways to it and on from it if all unchecked lines are free.
    """
    trial = paths.trial[problem]
    to = wp.zeros(shape=WAYPOINTS, dtype=float)
    on = wp.zeros(shape=WAYPOINTS, dtype=float)
    rank = wp.zeros(shape=LANES, dtype=float)
    for h in range(1, n):
        to[h] = 1.0e30
        waypoint = load_waypoint(path, trial, h)
        for i in range(h):
            if h == i + 1 or not _is_known(paths, problem, i, h):
                t = segment_time(load_waypoint(path, trial, i), waypoint, pace)
                to[h] = wp.min(to[h], to[i] + t)
    for back in range(1, n):
        i = n - 1 - back
        on[i] = 1.0e30
        waypoint = load_waypoint(path, trial, i)
        for h in range(i + 1, n):
            if h == i + 1 or not _is_known(paths, problem, i, h):
                t = segment_time(waypoint, load_waypoint(path, trial, h), pace)
                on[i] = wp.min(on[i], on[h] + t)
    least = time_of(path, trial, n, pace) - LEAST_SAVED_S
    found = int(0)
    for i in range(n - 2):
        waypoint = load_waypoint(path, trial, i)
        for h in range(i + 2, n):
            if not _is_known(paths, problem, i, h):
                t = segment_time(waypoint, load_waypoint(path, trial, h), pace)
                way = to[i] + t + on[h]
                if way < least and (found < LANES or way < rank[LANES - 1]):
                    k = wp.min(found, LANES - 1)
                    while k > 0:
                        if rank[k - 1] <= way:
                            break
                        rank[k] = rank[k - 1]
                        _move(arcs, problem * LANES + k - 1, problem * LANES + k)
                        k -= 1
                    rank[k] = way
                    lane = problem * LANES + k
                    arcs.kind[lane] = LINE
                    arcs.lo[lane] = i
                    arcs.hi[lane] = h
                    arcs.n[lane] = 0
                    arcs.time[lane] = t
                    found = wp.min(found + 1, LANES)
    return found


@wp.func
def _move(arcs: Arcs, a: int, b: int):
    """What lane a proposes, a line, as lane b's proposal."""
    arcs.kind[b] = LINE
    arcs.lo[b] = arcs.lo[a]
    arcs.hi[b] = arcs.hi[a]
    arcs.n[b] = 0
    arcs.time[b] = arcs.time[a]


# A problem whose lines are all settled:
#
# 1. its path becomes the quickest way through what is free (`_take_quickest`);
# 2. over, when that is nearly as quick as the straight line between its ends, or after `rounds` rounds;
# 3. lanes get unchecked lines, the others changes; `draw_arcs` (arcs.py) makes their edges.
@wp.kernel
def take_arcs(
    first: int, rounds: int,
    changes: int,  # 0: lines alone
    enough: float,  # a path that takes at most this times the straight line between its ends is left as it is
    pace: Pace, edges: Edges, paths: Paths, arcs: Arcs, counts: Counts,
    path_inout: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_inout: wp.array(dtype=int),  # (B,)
):  # fmt: skip
    """Takes what the settled arcs of each problem save, and says what its lanes propose next."""
    problem = first + wp.tid()
    if paths.state[problem] == OVER:
        return
    for e in range(2 * LANES):
        if edges.left[2 * LANES * problem + e] > 0:
            return
    trial = paths.trial[problem]
    n = int(length_inout[trial])
    if paths.rounds[problem] > 0:
        n = _take_quickest(edges, paths, arcs, problem, path_inout, n, pace)
        length_inout[trial] = n
        straight = segment_time(load_waypoint(path_inout, trial, 0), load_waypoint(path_inout, trial, n - 1), pace)
        if n == 2 or time_of(path_inout, trial, n, pace) <= enough * straight:
            paths.state[problem] = OVER
            return
    lines = int(0)
    if paths.rounds[problem] < rounds:
        lines = _propose_lines(paths, arcs, problem, path_inout, n, pace)
    if paths.rounds[problem] == rounds or (lines == 0 and changes == 0):
        paths.state[problem] = OVER
        return
    paths.rounds[problem] = paths.rounds[problem] + 1
    for k in range(lines, LANES):
        lane = problem * LANES + k
        arcs.kind[lane] = wp.where(changes == 1, CHANGE, IDLE)
        arcs.number[lane] = k - lines
    for k in range(LANES):
        if arcs.kind[problem * LANES + k] != IDLE:
            row = take(counts, REQUESTS, arcs.requests.shape[0])
            if row >= 0:
                arcs.requests[row] = problem * LANES + k
