"""Path search: goal postures, straight lines, RRT-Connect to the set of goals, shortcuts. One thread per problem.

RRT-Connect after Kuffner and LaValle (2000): one tree grows from home, the other one from the goals, all of which are its
roots: any free branch of the pose will do, and the search finds out which one can be reached. In each iteration the
smaller tree takes one step (EXTEND) towards a random posture, then the other one takes steps towards what was added
(CONNECT) until it gets there, and a path is found, or is blocked.

Random numbers are keyed by (seed, key of the trial), so a problem's path does not depend on its batch.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import BRANCHES, CLEARANCE, FREE, POSTURE
from r2h_batch.kernels.plan.edge import edge
from r2h_batch.kernels.robot.posture import load, load_waypoint, store_waypoint
from r2h_batch.kernels.robot.trapezoid import duration
from r2h_batch.kernels.robot.world import TrialBodies, World, vec6

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache

CLEARANCE_CAP = wp.constant(0.0065)
"""A little over twice what a path has to keep (m): a goal's clearance matters below that."""
HALF_TURN = wp.constant(3.1415926)
FULL_TURN = wp.constant(6.2831853)

# What a tree does in RRT-Connect.
EXTEND = wp.constant(0)  # one step towards a random posture
CONNECT = wp.constant(1)  # the other tree's first step towards the new node, from its nearest one
CONNECT_ON = wp.constant(2)  # its further steps, each from the one before


@wp.kernel
def check_postures(
    first: int,
    per_trial: int,
    # tables
    world: World,
    bodies: TrialBodies,
    # postures
    active_in: wp.array(dtype=wp.bool),  # (B * per_trial,)
    q_in: wp.array2d(dtype=float),  # (B * per_trial, 6)
    # out
    clear_out: wp.array(dtype=wp.bool),
    pair_out: wp.array(dtype=int),
    hand_clearance_out: wp.array(dtype=float),
):
    """Is each posture free of all pairs, what does it collide with, and its hand clearance up to CLEARANCE_CAP."""
    row = first + wp.tid()
    trial = row / per_trial
    if not active_in[row]:
        return
    q = load(q_in, row)
    for step in range(2):
        if step == 0 or clear_out[row]:
            found = edge(
                world, bodies, trial, q, q, 0.0, 0.0, CLEARANCE_CAP, 0.0, wp.where(step == 0, POSTURE, CLEARANCE), step
            )
            if step == 0:
                clear_out[row] = found.status == FREE
                pair_out[row] = found.pair
            else:
                hand_clearance_out[row] = found.best


@wp.kernel
def straight_lines(
    first: int,
    moveit: int,  # how edges are checked: CERTIFY or SAMPLES
    # tables
    world: World,
    bodies: TrialBodies,
    home_in: wp.array2d(dtype=float),  # (1, 6)
    # trials
    goals_in: wp.array2d(dtype=float),  # (B * 8, 6) nearest first
    n_goals_in: wp.array(dtype=int),  # (B,)
    goal_margin_in: wp.array(dtype=float),  # (B * 8,) hand clearance that a path to this goal keeps
    # out
    chosen_out: wp.array(dtype=int),
):
    """The first goal whose straight line from home is free, or -1."""
    trial = first + wp.tid()
    home = load(home_in, 0)
    chosen_out[trial] = -1
    for g in range(n_goals_in[trial]):
        row = trial * BRANCHES + g
        found = edge(world, bodies, trial, home, load(goals_in, row), goal_margin_in[row], 0.0, 0.0, 0.0, moveit, 0)
        if found.status == FREE:
            chosen_out[trial] = g
            break


@wp.func
def _add(nodes: wp.array2d(dtype=float), parents: wp.array(dtype=int), row: int, q: vec6, parent: int):
    """Writes a node."""
    for j in range(6):
        nodes[row, j] = q[j]
    parents[row] = parent


@wp.func
def _nearest(nodes: wp.array2d(dtype=float), base: int, n: int, q: vec6):
    """The node nearest to q (joint space, Euclidean) of the first n from `base` on; of equal ones the first."""
    best = float(1.0e30)
    at = int(0)
    for i in range(n):
        d = float(0.0)
        for j in range(6):
            e = nodes[base + i, j] - q[j]
            d += e * e
        if d < best:
            best = d
            at = i
    return at


@wp.func
def _depth(parents: wp.array(dtype=int), base: int, node: int):
    """How many nodes lie between a node and its root, both counted."""
    n = int(0)
    i = int(node)
    while i >= 0:
        n += 1
        i = parents[base + i]
    return n


@wp.func
def _write_branch(
    nodes: wp.array2d(dtype=float), parents: wp.array(dtype=int), base: int, node: int,
    path: wp.array3d(dtype=float), trial: int, k: int, step: int,
):  # fmt: skip
    """Writes the nodes from `node` to its root to the waypoints k, k + step, ..."""
    at = int(k)
    i = int(node)
    while i >= 0:
        store_waypoint(path, trial, at, load(nodes, base + i))
        i = parents[base + i]
        at += step


# RRT-Connect (Kuffner and LaValle 2000). Tree 0 grows from home, tree 1 from all goals; edges are certified (edge.py). As
# one loop, each turn of which adds at most one node, in one of three phases:
#
#     EXTEND      the smaller tree takes one step of at most range_rad towards a random posture. Blocked: again; free: CONNECT
#     CONNECT     the other tree steps towards the node just added, from its own nearest node. Free: CONNECT_ON, or met
#     CONNECT_ON  it goes on from where it came to, without asking for its nearest node, until it is blocked or has met
#
# Nodes lie in rows of one array, parents as numbers within the tree; the path is read back from the meeting nodes. An
# iteration is one random posture. Numbers come from (seed, key of the trial) alone: batch and device do not matter.
@wp.kernel
def rrt_connect(
    first: int,
    # search
    iterations: int,
    capacity: int,  # nodes of one tree
    range_rad: float,
    seed: int,
    moveit: int,  # how edges are checked: CERTIFY or SAMPLES
    # tables
    world: World,
    bodies: TrialBodies,
    home_in: wp.array2d(dtype=float),  # (1, 6)
    # trials
    trial_in: wp.array(dtype=int),  # (P,) rows of the problems
    key_in: wp.array(dtype=int),  # (B,) random key of each trial
    goals_in: wp.array2d(dtype=float),  # (B * 8, 6)
    n_goals_in: wp.array(dtype=int),  # (B,)
    margin_in: wp.array(dtype=float),  # (B,) hand clearance kept by the whole path
    # scratch
    nodes_scratch: wp.array2d(dtype=float),  # (P * 2 * capacity, 6)
    parents_scratch: wp.array(dtype=int),  # (P * 2 * capacity,) within the same tree, -1: a root
    # out
    path_out: wp.array3d(dtype=float),  # (B, W, 6)
    length_inout: wp.array(dtype=int),  # (B,) waypoints, 0: not found; a trial that has some is passed over
):
    """A collision-free polyline from home to one of the goals, within a number of iterations.

    Tree 0 (rows base0 ..) has home as its root, tree 1 (rows base1 ..) all goals. A node's edge to its parent is free. The
    steps of an iteration go through one call of `edge`, which holds the whole collision check: two of them would double
    the code of this kernel.
    """
    problem = first + wp.tid()
    trial = trial_in[problem]
    if length_inout[trial] > 0:
        return
    base0 = problem * 2 * capacity
    base1 = base0 + capacity
    n0 = int(1)
    _add(nodes_scratch, parents_scratch, base0, load(home_in, 0), -1)
    n1 = int(n_goals_in[trial])
    for g in range(n1):
        _add(nodes_scratch, parents_scratch, base1 + g, load(goals_in, trial * BRANCHES + g), -1)
    rng = wp.rand_init(seed, key_in[trial])
    margin = margin_in[trial]

    phase = int(EXTEND)
    grow = int(0)  # the tree that grows now
    target = vec6()  # where it grows to
    near = int(0)  # the node that it grows from
    met0 = int(-1)
    met1 = int(-1)
    count = int(0)
    while count < iterations and n0 < capacity and n1 < capacity and met0 < 0:
        if phase == EXTEND:
            count += 1
            grow = wp.where(n0 <= n1, 0, 1)
            # mostly within half a turn of home, where paths are short; every fourth time anywhere within the limits
            around = wp.where(count % 4 == 0, FULL_TURN, HALF_TURN)
            for j in range(6):
                lo = wp.max(world.lower[j], home_in[0, j] - around)
                hi = wp.min(world.upper[j], home_in[0, j] + around)
                target[j] = lo + (hi - lo) * wp.randf(rng)
        base = wp.where(grow == 0, base0, base1)
        n = wp.where(grow == 0, n0, n1)
        if phase != CONNECT_ON:
            near = _nearest(nodes_scratch, base, n, target)
        q_near = load(nodes_scratch, base + near)
        q_new = target
        dist = wp.length(target - q_near)
        reached = dist <= range_rad
        if not reached:
            q_new = q_near + (range_rad / dist) * (target - q_near)
        found = edge(world, bodies, trial, q_near, q_new, margin, 0.0, 0.0, 0.0, moveit, 0)
        if found.status == FREE:
            _add(nodes_scratch, parents_scratch, base + n, q_new, near)
            if grow == 0:
                n0 += 1
            else:
                n1 += 1
            if phase == EXTEND:
                target = q_new  # now the other tree tries to come here
                grow = 1 - grow
                phase = CONNECT
            elif reached:
                met0 = n0 - 1
                met1 = n1 - 1
            else:
                near = n  # go on from the node just added
                phase = CONNECT_ON
        else:
            phase = EXTEND
    if met0 < 0:
        return

    # home .. meeting point .. goal; the two trees hold the meeting posture once each
    n_back = _depth(parents_scratch, base0, met0)
    after = parents_scratch[base1 + met1]
    n_forth = _depth(parents_scratch, base1, after)
    if n_back + n_forth > path_out.shape[1]:
        return
    _write_branch(nodes_scratch, parents_scratch, base0, met0, path_out, trial, n_back - 1, -1)
    _write_branch(nodes_scratch, parents_scratch, base1, after, path_out, trial, n_back, 1)
    length_inout[trial] = n_back + n_forth


@wp.func
def _segment_time(a: vec6, b: vec6, speed: float, acceleration: float):
    """Time of a segment, stopping at both ends: the joint with the farthest to go sets the pace."""
    d = float(0.0)
    for j in range(6):
        d = wp.max(d, wp.abs(b[j] - a[j]))
    return duration(d, speed, acceleration)


@wp.func
def _saved(
    path: wp.array3d(dtype=float), trial: int, i: int, j: int, a: vec6, b: vec6, speed: float, acceleration: float
):
    """Time saved when a on segment i and b on segment j > i are joined by a straight line."""
    saved = float(0.0)
    for m in range(i, j + 1):
        saved += _segment_time(load_waypoint(path, trial, m), load_waypoint(path, trial, m + 1), speed, acceleration)
    a0 = load_waypoint(path, trial, i)
    saved -= _segment_time(a0, a, speed, acceleration) + _segment_time(a, b, speed, acceleration)
    saved -= _segment_time(b, load_waypoint(path, trial, j + 1), speed, acceleration)
    return saved


@wp.func
def _splice(path: wp.array3d(dtype=float), trial: int, n: int, i: int, j: int, a: vec6, b: vec6):
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


# Two passes in one loop around one call of `edge`:
#
# 1. leave waypoints out (k goes along the path): where k - 1 and k + 1 can be joined straight, k goes, and its neighbour
#    before is asked again, as its edge is new;
# 2. then `tries` times: two random points on different segments (Geraerts and Overmars 2007) are joined if that saves time
#    under the time law, which stops at every waypoint, and if the edge is free.
#
# Time is asked before the edge: it costs nothing, and most candidates save none. Within one segment nothing can be saved. A
# splice puts two waypoints in place of those between; where the array has no room for one more it is left out (`_splice`).
@wp.kernel
def shortcut(
    first: int,
    # search
    tries: int,
    speed: float,  # of the time law, rad/s and rad/s^2
    acceleration: float,
    seed: int,
    moveit: int,  # how edges are checked: CERTIFY or SAMPLES
    # tables
    world: World,
    bodies: TrialBodies,
    # trials
    trial_in: wp.array(dtype=int),  # (P,) rows of the problems
    key_in: wp.array(dtype=int),  # (B,)
    margin_in: wp.array(dtype=float),  # (B,)
    # in and out
    path_inout: wp.array3d(dtype=float),  # (B, W, 6)
    length_inout: wp.array(dtype=int),  # (B,)
):
    """Shortens paths in place: first every waypoint that can be skipped, then random shortcuts that save time.

    The arm stops at waypoints, so a shortcut that adds one has to save more than a stop: asked before its edge is checked.
    """
    trial = trial_in[first + wp.tid()]
    n = int(length_inout[trial])
    rng = wp.rand_init(seed + 1, key_in[trial])
    margin = margin_in[trial]
    k = int(1)  # the waypoint that may be left out next
    tried = int(0)
    while n > 2 and (k < n - 1 or tried < tries):
        i = int(0)
        j = int(0)
        a = vec6()
        b = vec6()
        drop = k < n - 1
        if drop:
            i = k - 1
            j = k + 1
            a = load_waypoint(path_inout, trial, i)
            b = load_waypoint(path_inout, trial, j)
        else:
            tried += 1
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
            if _saved(path_inout, trial, i, j, a, b, speed, acceleration) <= 0.0:
                continue
        found = edge(world, bodies, trial, a, b, margin, 0.0, 0.0, 0.0, moveit, 0)
        if found.status != FREE:
            if drop:
                k += 1
            continue
        if drop:
            for m in range(k, n - 1):
                store_waypoint(path_inout, trial, m, load_waypoint(path_inout, trial, m + 1))
            n -= 1
            k = wp.max(k - 1, 1)
        else:
            n = _splice(path_inout, trial, n, i, j, a, b)
    length_inout[trial] = n


@wp.kernel
def path_clearance(
    first: int,
    cap: float,
    tolerance: float,
    # tables
    world: World,
    bodies: TrialBodies,
    # trials
    path_in: wp.array3d(dtype=float),  # (B, W, 6)
    length_in: wp.array(dtype=int),  # (B,)
    # out
    clearance_out: wp.array(dtype=float),
    pair_out: wp.array(dtype=int),
    body_out: wp.array(dtype=int),
):
    """Smallest clearance over all pairs along each path, exact to `tolerance` below `cap`."""
    trial = first + wp.tid()
    n = length_in[trial]
    if n == 0:
        return
    best = float(cap)
    # the goal first: it is usually the tightest, and prunes the rest
    for k in range(n):
        i = n - 1 - k
        a = load_waypoint(path_in, trial, i)
        b = load_waypoint(path_in, trial, wp.min(i + 1, n - 1))
        found = edge(world, bodies, trial, a, b, 0.0, 0.0, best, tolerance, CLEARANCE, 0)
        if found.best < best:
            best = found.best
            pair_out[trial] = found.pair
            body_out[trial] = found.body
    clearance_out[trial] = best
