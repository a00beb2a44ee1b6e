"""Path search: goal postures, straight lines, RRT-Connect to the set of goals, shortcuts. One thread per problem.

RRT-Connect after Kuffner and LaValle (2000): two trees, the smaller one grows towards a random posture, the other one
connects to what was added. Random numbers are keyed by (seed, trial id), so a problem's path does not depend on its batch.
"""

import warp as wp

from r2h_batch.kernels.check import FREE
from r2h_batch.kernels.edge import edge
from r2h_batch.kernels.world import TrialBodies, World, vec6

wp.set_module_options({"enable_backward": False, "max_unroll": 0})  # unrolled, the code outgrows every cache

GOALS = wp.constant(8)
CLEARANCE_CAP = wp.constant(
    0.0065
)  # a little over twice what a path has to keep: a goal's clearance matters below that


@wp.func
def _load(q: wp.array2d(dtype=float), row: int):
    return vec6(q[row, 0], q[row, 1], q[row, 2], q[row, 3], q[row, 4], q[row, 5])


@wp.kernel
def check_postures(
    first: int,
    per_trial: int,
    world: World,
    bodies: TrialBodies,
    active_in: wp.array(dtype=wp.bool),  # (B * per_trial,)
    q_in: wp.array2d(dtype=float),  # (B * per_trial, 6)
    clear_out: wp.array(dtype=wp.bool),
    pair_out: wp.array(dtype=int),
    hand_clearance_out: wp.array(dtype=float),
):
    """Is each posture free of all pairs, what does it collide with, and its hand clearance up to CLEARANCE_CAP."""
    row = first + wp.tid()
    trial = row / per_trial
    if not active_in[row]:
        return
    q = _load(q_in, row)
    for step in range(2):
        if step == 0 or clear_out[row]:
            found = edge(world, bodies, trial, q, q, 0.0, 0.0, CLEARANCE_CAP, 0.0, wp.where(step == 0, 3, 2), step)
            if step == 0:
                clear_out[row] = found.status == FREE
                pair_out[row] = found.pair
            else:
                hand_clearance_out[row] = found.best


@wp.kernel
def straight_lines(
    first: int,
    moveit: int,
    world: World,
    bodies: TrialBodies,
    home_in: wp.array2d(dtype=float),  # (1, 6)
    goals_in: wp.array2d(dtype=float),  # (B * 8, 6) nearest first
    n_goals_in: wp.array(dtype=int),
    goal_margin_in: wp.array(dtype=float),  # (B * 8,) hand clearance that a path to this goal keeps
    chosen_out: wp.array(dtype=int),
):
    """The first goal whose straight line from home is free, or -1."""
    trial = first + wp.tid()
    home = _load(home_in, 0)
    chosen_out[trial] = -1
    for g in range(n_goals_in[trial]):
        row = trial * GOALS + g
        found = edge(world, bodies, trial, home, _load(goals_in, row), goal_margin_in[row], 0.0, 0.0, 0.0, moveit, 0)
        if found.status == FREE:
            chosen_out[trial] = g
            break


@wp.func
def _node(nodes: wp.array2d(dtype=float), row: int):
    return vec6(nodes[row, 0], nodes[row, 1], nodes[row, 2], nodes[row, 3], nodes[row, 4], nodes[row, 5])


@wp.func
def _add(nodes: wp.array2d(dtype=float), parents: wp.array(dtype=int), row: int, q: vec6, parent: int):
    for j in range(6):
        nodes[row, j] = q[j]
    parents[row] = parent


@wp.func
def _nearest(nodes: wp.array2d(dtype=float), base: int, n: int, q: vec6):
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


@wp.kernel
def rrt_connect(
    first: int,
    iterations: int,
    capacity: int,  # nodes of one tree
    range_rad: float,
    seed: int,
    moveit: int,
    world: World,
    bodies: TrialBodies,
    home_in: wp.array2d(dtype=float),
    trial_in: wp.array(dtype=int),  # (P,) rows of the problems
    key_in: wp.array(dtype=int),  # (B,) random key of each trial
    goals_in: wp.array2d(dtype=float),
    n_goals_in: wp.array(dtype=int),
    margin_in: wp.array(dtype=float),  # (B,) hand clearance kept by the whole path
    nodes: wp.array2d(dtype=float),  # (P * 2 * capacity, 6) scratch
    parents: wp.array(dtype=int),
    path_out: wp.array3d(dtype=float),  # (B, W, 6)
    length_out: wp.array(dtype=int),  # (B,) waypoints, 0: not found
):
    """A collision-free polyline from home to one of the goals, within a number of iterations."""
    problem = first + wp.tid()
    trial = trial_in[problem]
    length_out[trial] = 0
    base0 = problem * 2 * capacity
    base1 = base0 + capacity
    n0 = int(1)
    _add(nodes, parents, base0, _load(home_in, 0), -1)
    n1 = int(n_goals_in[trial])
    for g in range(n1):
        _add(nodes, parents, base1 + g, _load(goals_in, trial * GOALS + g), -1)
    rng = wp.rand_init(seed, key_in[trial])
    margin = margin_in[trial]

    # One edge check serves both halves of an iteration: `connecting` says which half this is.
    grow = int(0)  # the tree that grows now
    target = vec6()
    connecting = int(0)
    near = int(0)
    met0 = int(-1)
    met1 = int(-1)
    count = int(0)
    while count < iterations and n0 < capacity and n1 < capacity and met0 < 0:
        if connecting == 0:
            count += 1
            grow = wp.where(n0 <= n1, 0, 1)
            # mostly within half a turn of home, where paths are short; every fourth time anywhere within the limits
            around = wp.where(count % 4 == 0, 6.2831853, 3.1415926)
            for j in range(6):
                lo = wp.max(world.lower[j], home_in[0, j] - around)
                hi = wp.min(world.upper[j], home_in[0, j] + around)
                target[j] = lo + (hi - lo) * wp.randf(rng)
        base = wp.where(grow == 0, base0, base1)
        n = wp.where(grow == 0, n0, n1)
        if connecting < 2:
            near = _nearest(nodes, base, n, target)
        q_near = _node(nodes, base + near)
        q_new = target
        dist = wp.length(target - q_near)
        reached = dist <= range_rad
        if not reached:
            q_new = q_near + (range_rad / dist) * (target - q_near)
        found = edge(world, bodies, trial, q_near, q_new, margin, 0.0, 0.0, 0.0, moveit, 0)
        if found.status == FREE:
            _add(nodes, parents, base + n, q_new, near)
            if grow == 0:
                n0 += 1
            else:
                n1 += 1
            if connecting == 0:
                target = q_new  # now the other tree tries to come here
                grow = 1 - grow
                connecting = 1
            elif reached:
                met0 = n0 - 1
                met1 = n1 - 1
            else:
                near = n  # go on from the node just added
                connecting = 2
        else:
            connecting = 0
    if met0 < 0:
        return

    # home .. meeting point .. goal; the two trees hold the meeting posture once each
    width = path_out.shape[1]
    n_back = int(0)
    i = met0
    while i >= 0:
        n_back += 1
        i = parents[base0 + i]
    n_forth = int(0)
    i = parents[base1 + met1]
    while i >= 0:
        n_forth += 1
        i = parents[base1 + i]
    if n_back + n_forth > width:
        return
    i = met0
    k = n_back - 1
    while i >= 0:
        for j in range(6):
            path_out[trial, k, j] = nodes[base0 + i, j]
        i = parents[base0 + i]
        k -= 1
    i = parents[base1 + met1]
    k = n_back
    while i >= 0:
        for j in range(6):
            path_out[trial, k, j] = nodes[base1 + i, j]
        i = parents[base1 + i]
        k += 1
    length_out[trial] = n_back + n_forth


@wp.func
def _waypoint(path: wp.array3d(dtype=float), trial: int, k: int):
    return vec6(
        path[trial, k, 0], path[trial, k, 1], path[trial, k, 2], path[trial, k, 3], path[trial, k, 4], path[trial, k, 5]
    )


@wp.func
def _set(path: wp.array3d(dtype=float), trial: int, k: int, q: vec6):
    for j in range(6):
        path[trial, k, j] = q[j]


@wp.func
def _duration(a: vec6, b: vec6, speed: float, acceleration: float):
    """Time of a segment, stopping at both ends (r2h_batch.execute)."""
    d = float(0.0)
    for j in range(6):
        d = wp.max(d, wp.abs(b[j] - a[j]))
    if d >= speed * speed / acceleration:
        return d / speed + speed / acceleration
    return 2.0 * wp.sqrt(d / acceleration)


@wp.kernel
def shortcut(
    first: int,
    tries: int,
    speed: float,  # of the time law, rad/s and rad/s^2
    acceleration: float,
    seed: int,
    moveit: int,
    world: World,
    bodies: TrialBodies,
    trial_in: wp.array(dtype=int),
    key_in: wp.array(dtype=int),
    margin_in: wp.array(dtype=float),
    path: wp.array3d(dtype=float),
    length: wp.array(dtype=int),
):
    """Shortens paths in place: first every waypoint that can be skipped, then random shortcuts that save time.

    The arm stops at waypoints, so a shortcut that adds one has to save more than a stop: asked before its edge is checked.
    """
    trial = trial_in[first + wp.tid()]
    n = int(length[trial])
    rng = wp.rand_init(seed + 1, key_in[trial])
    margin = margin_in[trial]
    k = int(1)
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
            a = _waypoint(path, trial, i)
            b = _waypoint(path, trial, j)
        else:
            tried += 1
            i = wp.min(int(wp.randf(rng) * float(n - 1)), n - 2)
            j = wp.min(int(wp.randf(rng) * float(n - 1)), n - 2)
            s = wp.randf(rng)
            t = wp.randf(rng)
            if i == j:
                continue
            if i > j:
                i, j = j, i
            a0 = _waypoint(path, trial, i)
            b0 = _waypoint(path, trial, j)
            a = a0 + s * (_waypoint(path, trial, i + 1) - a0)
            b = b0 + t * (_waypoint(path, trial, j + 1) - b0)
            saved = float(0.0)
            for m in range(i, j + 1):
                saved += _duration(_waypoint(path, trial, m), _waypoint(path, trial, m + 1), speed, acceleration)
            saved -= _duration(a0, a, speed, acceleration) + _duration(a, b, speed, acceleration)
            saved -= _duration(b, _waypoint(path, trial, j + 1), speed, acceleration)
            if saved <= 0.0:
                continue
        found = edge(world, bodies, trial, a, b, margin, 0.0, 0.0, 0.0, moveit, 0)
        if found.status != FREE:
            if drop:
                k += 1
            continue
        if drop:
            for m in range(k, n - 1):
                _set(path, trial, m, _waypoint(path, trial, m + 1))
            n -= 1
            k = wp.max(k - 1, 1)
        else:
            # waypoints i+1 .. j give way to a, b
            removed = j - i
            if removed == 1 and n < path.shape[1]:
                m = n
                while m > j + 1:
                    _set(path, trial, m, _waypoint(path, trial, m - 1))
                    m -= 1
                n += 1
            elif removed == 1:
                continue
            else:
                for m in range(j + 1, n):
                    _set(path, trial, m - removed + 2, _waypoint(path, trial, m))
                n = n - removed + 2
            _set(path, trial, i + 1, a)
            _set(path, trial, i + 2, b)
    length[trial] = n


@wp.kernel
def path_clearance(
    first: int,
    cap: float,
    tolerance: float,
    world: World,
    bodies: TrialBodies,
    path_in: wp.array3d(dtype=float),
    length_in: wp.array(dtype=int),
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
        a = _waypoint(path_in, trial, i)
        b = _waypoint(path_in, trial, wp.min(i + 1, n - 1))
        found = edge(world, bodies, trial, a, b, 0.0, 0.0, best, tolerance, 2, 0)
        if found.best < best:
            best = found.best
            pair_out[trial] = found.pair
            body_out[trial] = found.body
    clearance_out[trial] = best
