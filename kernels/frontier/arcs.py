"""Arcs that the lanes of a path propose (shortcuts.py): the points that they go through, and the lines to be certified."""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import CERTIFY, WAYPOINTS

from ..plan.shortcut import FIRST_SHARE, LEAST_SAVED_S, segment_time
from ..robot.joints import JOINTS, vecq
from ..robot.posture import Pace, load, load_waypoint
from ..robot.world import World
from .intervals import add_edge
from .queues import NOTHING, REQUESTS, Counts, Edges, Intervals

wp.set_module_options(OPTIONS | {"max_unroll": 0})

LANES = wp.constant(8)
"""Shortcuts that a problem proposes at once."""
DRAWS = wp.constant(4)
"""Random numbers that a lane tries for a shortcut that saves time; none does: it proposes nothing."""

# What a lane proposes.
IDLE = wp.constant(0)  # nothing
LINE = wp.constant(1)  # a line between two waypoints
CHANGE = wp.constant(2)  # to be drawn: a waypoint to be pulled, or two points to be joined
CHANGED = wp.constant(3)  # drawn

# Ways to change a path, by turns.
PULL = wp.constant(0)
JOIN = wp.constant(1)
PULL_SOME = wp.constant(2)
LESS = wp.constant(0.6)
"""By how much less a waypoint is pulled each time."""

# State of a problem.
RUNNING = wp.constant(0)
OVER = wp.constant(1)


@wp.struct
class Paths:
    """Paths that become shorter (P,)."""

    trial: wp.array(dtype=int)
    state: wp.array(dtype=int)
    rounds: wp.array(dtype=int)  # rounds so far
    known: wp.array2d(dtype=wp.int64)  # (P, W) bit j of entry i: the line from i to j > i is checked
    copy: wp.array3d(dtype=float)  # (P, W, JOINTS) scratch


@wp.struct
class Arcs:
    """Lanes (P * LANES): what each proposes. Edges 2 l and 2 l + 1 are its lines, its own entry in `found` what blocks them."""

    kind: wp.array(dtype=int)
    number: wp.array(dtype=int)  # CHANGE: its place among the round's changes
    lo: wp.array(dtype=int)  # waypoints between which it leads
    hi: wp.array(dtype=int)
    n: wp.array(dtype=int)  # points in between
    point: wp.array2d(dtype=float)  # (P * LANES * 2, JOINTS)
    time: wp.array(dtype=float)  # from lo to hi, s
    requests: wp.array(dtype=int)  # queue of lanes whose edges have to be made


@wp.func
def _write_edge(world: World, edges: Edges, queue: Intervals, counts: Counts, parity: int, e: int, a: vecq, b: vecq):
    for j in range(JOINTS):
        edges.a[e, j] = a[j]
        edges.b[e, j] = b[j]
    add_edge(world, edges, queue, counts, parity, e, CERTIFY, 0)


@wp.func
def _draw(
    arcs: Arcs, lane: int, way: int, share: float, path: wp.array3d(dtype=float), trial: int, n: int, rng: wp.uint32,
    pace: Pace,
):  # fmt: skip
    """One change as `arcs` has it: what it saves (s; nothing: 0 or less), and the random number's state after it."""
    saved = float(0.0)
    now = float(0.0)
    x0 = vecq()
    x1 = vecq()
    lo = int(0)
    hi = int(0)
    if way == JOIN:
        lo = wp.min(int(wp.randf(rng) * float(n - 1)), n - 2)
        hi = wp.min(int(wp.randf(rng) * float(n - 1)), n - 2)
        s = wp.randf(rng)
        t = wp.randf(rng)
        if lo > hi:
            lo, hi = hi, lo
        # two points in place of one: is there room for that at every second waypoint?
        if lo < hi and (hi > lo + 1 or n + (n - 1) / 2 <= WAYPOINTS):
            # from the point s of segment lo to the point t of segment hi
            a = load_waypoint(path, trial, lo)
            b = load_waypoint(path, trial, hi)
            c = load_waypoint(path, trial, hi + 1)
            x0 = a + s * (load_waypoint(path, trial, lo + 1) - a)
            x1 = b + t * (c - b)
            now = segment_time(a, x0, pace) + segment_time(x0, x1, pace)
            now += segment_time(x1, c, pace)
            for m in range(lo, hi + 1):
                saved += segment_time(load_waypoint(path, trial, m), load_waypoint(path, trial, m + 1), pace)
            saved -= now
            hi += 1
    else:
        lo = arcs.number[lane] % (n - 2)
        hi = lo + 2
        a = load_waypoint(path, trial, lo)
        x0 = load_waypoint(path, trial, lo + 1)
        b = load_waypoint(path, trial, hi)
        t0 = segment_time(a, x0, pace)
        t1 = segment_time(x0, b, pace)
        by = wp.where(way == PULL_SOME, wp.randf(rng), share)
        for m in range(JOINTS):
            on_line = a[m] + (t0 / (t0 + t1)) * (b[m] - a[m])
            if way == PULL or wp.randf(rng) < 0.5:
                x0[m] = x0[m] + by * (on_line - x0[m])
        now = segment_time(a, x0, pace) + segment_time(x0, b, pace)
        saved = t0 + t1 - now
    arcs.lo[lane] = lo
    arcs.hi[lane] = hi
    arcs.n[lane] = wp.where(way == JOIN, 2, 1)
    arcs.time[lane] = now
    for j in range(JOINTS):
        arcs.point[2 * lane, j] = x0[j]
        arcs.point[2 * lane + 1, j] = x1[j]
    return saved, rng


# Changes of a round, for each waypoint between the ends in turn, three ways by turns:
#
#     PULL         all joints, nearer to where it would be on the line between its neighbours; by less each time
#     JOIN         two random points of different segments
#     PULL_SOME    some joints, by a random share
#
# A change that saves no time is drawn again, DRAWS times in all. This costs nothing, because no edge is checked.
@wp.kernel
def draw_arcs(
    first: int, lanes: int, parity: int, pace: Pace, seed: int, world: World, edges: Edges, queue: Intervals,
    counts: Counts, paths: Paths, arcs: Arcs,
    key_in: wp.array(dtype=int),  # (B,)
    path_in: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_in: wp.array(dtype=int),  # (B,)
):  # fmt: skip
    """The lines of what each lane proposes, queued; changes are drawn first, and have to save time."""
    for i in range(first + wp.tid(), wp.min(counts.n[REQUESTS], arcs.requests.shape[0]), lanes):
        lane = arcs.requests[i]
        problem = lane / LANES
        trial = paths.trial[problem]
        if arcs.kind[lane] != LINE:
            n = length_in[trial]
            turn = arcs.number[lane] / (n - 2)
            share = float(FIRST_SHARE)
            for _less in range(turn / 3):
                share = LESS * share
            rng = wp.rand_init(
                wp.int32(wp.rand_init(seed + 1, key_in[trial])), paths.rounds[problem] * LANES + lane % LANES
            )
            arcs.kind[lane] = IDLE
            for _draw_again in range(DRAWS):
                if arcs.kind[lane] == IDLE:
                    saved, rng = _draw(arcs, lane, turn % 3, share, path_in, trial, n, rng, pace)
                    if saved > LEAST_SAVED_S:
                        arcs.kind[lane] = CHANGED
        if arcs.kind[lane] == IDLE:
            continue
        edges.found[lane] = (wp.int64(NOTHING) << wp.int64(32)) | wp.int64(NOTHING)
        a = load_waypoint(path_in, trial, arcs.lo[lane])
        b = load_waypoint(path_in, trial, arcs.hi[lane])
        if arcs.kind[lane] == CHANGED:
            x0 = load(arcs.point, 2 * lane)
            if arcs.n[lane] == 1:
                _write_edge(world, edges, queue, counts, parity, 2 * lane + 1, x0, b)
                b = x0
            else:
                a = x0
                b = load(arcs.point, 2 * lane + 1)
        _write_edge(world, edges, queue, counts, parity, 2 * lane, a, b)
