"""RRT-Connect to the set of goals. One thread per problem.

RRT-Connect after Kuffner and LaValle (2000): one tree grows from the start, the other one from the goals, all of which are its
roots: any free branch of the pose will do, and the search finds out which one can be reached. In each iteration the
smaller tree takes one step (EXTEND) towards a random posture, then the other one takes steps towards what was added
(CONNECT) until it gets there, and a path is found, or is blocked.

Random numbers are keyed by (seed, key of the trial), so a problem's path does not depend on its batch.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import BRANCHES, FREE

from ..robot.joints import JOINTS, vecq
from ..robot.posture import load, store_waypoint
from ..robot.world import TrialBodies, World
from .edge import edge

wp.set_module_options(OPTIONS | {"max_unroll": 0})  # unrolled, the code outgrows every cache

HALF_TURN = wp.constant(3.1415926)
FULL_TURN = wp.constant(6.2831853)

# What a tree does in RRT-Connect.
EXTEND = wp.constant(0)  # one step towards a random posture
CONNECT = wp.constant(1)  # the other tree's first step towards the new node, from its nearest one
CONNECT_ON = wp.constant(2)  # its further steps, each from the one before

RANGE = wp.constant(JOINTS)
"""Column of a node's range, its longest step (rad), after its posture."""
LEAST_RANGE = wp.constant(0.05)
"""A node's range is range_rad at first; blocked steps shorten it to this share of it at least."""
FULL_RANGE = wp.constant(3)
"""Every third random posture is stepped to as far as range_rad all the same."""


@wp.func
def add_node(
    nodes: wp.array2d(dtype=float), parents: wp.array(dtype=int), row: int, q: vecq, parent: int, step_rad: float
):
    """Writes a node, with how far its next step may go."""
    for j in range(JOINTS):
        nodes[row, j] = q[j]
    nodes[row, RANGE] = step_rad
    parents[row] = parent


@wp.func
def squared_distance(nodes: wp.array2d(dtype=float), row: int, q: vecq):
    """Squared Euclidean distance of a node from q in joint space."""
    d = float(0.0)
    for j in range(JOINTS):
        e = nodes[row, j] - q[j]
        d += e * e
    return d


@wp.func
def nearest_node(nodes: wp.array2d(dtype=float), base: int, n: int, q: vecq):
    """The node nearest to q (joint space, Euclidean) of the first n from `base` on; of equal ones the first."""
    best = float(1.0e30)
    at = int(0)
    for i in range(n):
        d = squared_distance(nodes, base + i, q)
        if d < best:
            best = d
            at = i
    return at


@wp.func
def depth_of(parents: wp.array(dtype=int), base: int, node: int):
    """How many nodes lie between a node and its root, both counted."""
    n = int(0)
    i = int(node)
    while i >= 0:
        n += 1
        i = parents[base + i]
    return n


@wp.func
def write_branch(
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


@wp.func
def random_posture(world: World, start: wp.array2d(dtype=float), trial: int, number: int, state: wp.uint32):
    """Random posture `number` of a search (rad), and the generator's next state.

    It lies within half a turn of the start, where paths are short; every fourth lies anywhere within the limits.
    """
    rng = wp.uint32(state)
    q = vecq()
    around = wp.where(number % 4 == 0, FULL_TURN, HALF_TURN)
    for j in range(JOINTS):
        lo = wp.max(world.lower[j], start[trial, j] - around)
        hi = wp.min(world.upper[j], start[trial, j] + around)
        q[j] = lo + (hi - lo) * wp.randf(rng)
    return q, rng


@wp.func
def rrt_step(
    nodes: wp.array2d(dtype=float), base: int, near: int, origin: int, target: vecq, number: int, range_rad: float
):
    """One step from a node towards `target`: its two ends, the node's range (rad), and whether it gets there.

    All nodes of one line hang on `origin`, where the line begins. The new posture is taken on the line from there.
    """
    q_near = load(nodes, base + near)
    q_new = target
    dist = wp.length(target - q_near)
    step_rad = nodes[base + near, RANGE]
    if number % FULL_RANGE == 1:
        step_rad = range_rad
    reached = dist <= step_rad
    if not reached:
        q_origin = load(nodes, base + origin)
        whole = wp.length(target - q_origin)
        q_new = q_origin + ((whole - dist + step_rad) / whole) * (target - q_origin)
    return q_near, q_new, step_rad, reached


@wp.func
def write_path(
    nodes: wp.array2d(dtype=float), parents: wp.array(dtype=int), base0: int, base1: int, met0: int, met1: int,
    path: wp.array3d(dtype=float), length: wp.array(dtype=int), trial: int,
):  # fmt: skip
    """Writes start .. meeting posture .. goal; both trees hold the meeting posture. A path that is too long is not written."""
    n_back = depth_of(parents, base0, met0)
    after = parents[base1 + met1]
    n_forth = depth_of(parents, base1, after)
    if n_back + n_forth <= path.shape[1]:
        write_branch(nodes, parents, base0, met0, path, trial, n_back - 1, -1)
        write_branch(nodes, parents, base1, after, path, trial, n_back, 1)
        length[trial] = n_back + n_forth


# RRT-Connect (Kuffner and LaValle 2000). Tree 0 grows from the start, tree 1 from all goals; edges are certified (edge.py). As
# one loop, each turn of which adds at most one node, in one of three phases:
#
#     EXTEND      the smaller tree takes one step of at most the node's range towards a random posture. Blocked: the node's
#                 range shrinks, and again; free: CONNECT
#     CONNECT     the other tree steps towards the node just added, from its own nearest node. Free: CONNECT_ON, or met
#     CONNECT_ON  it goes on from where it came to, without asking for its nearest node, until it is blocked or has met
#
# A goal beside the hand can mostly be left in few directions, and only for a little way before the arm has to turn: with
# steps of one length thousands of them fail from the same node. With a range for each node (dynamic-domain RRTs give a
# radius to nodes that keep failing; Yershova et al. 2005) it is left after some tens. Nodes of one line to a target all hang
# on the node where it begins, so the path has one waypoint for it.
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
    shorter: float,  # factor on a node's range when a step from it is blocked; 1: all steps have one length
    seed: int,
    edge_mode: int,  # how edges are checked: CERTIFY or SAMPLES
    # tables
    world: World, bodies: TrialBodies,
    # trials
    start_in: wp.array2d(dtype=float),  # (B, JOINTS)
    trial_in: wp.array(dtype=int),  # (P,) rows of the problems
    key_in: wp.array(dtype=int),  # (B,) random key of each trial
    goals_in: wp.array2d(dtype=float),  # (B * 8, JOINTS)
    n_goals_in: wp.array(dtype=int),  # (B,)
    margin_in: wp.array(dtype=float),  # (B,) hand clearance kept by the whole path
    # scratch
    nodes_scratch: wp.array2d(dtype=float),  # (P * 2 * capacity, JOINTS + 1) postures, and how far a next step may go (rad)
    parents_scratch: wp.array(dtype=int),  # (P * 2 * capacity,) within the same tree, -1: a root
    # out
    path_out: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_inout: wp.array(dtype=int),  # (B,) waypoints, 0: not found; a trial that has some is passed over
):  # fmt: skip
    """A collision-free polyline from the start to one of the goals, within a number of iterations.

    Tree 0 (rows base0 ..) has the start as its root, tree 1 (rows base1 ..) all goals. A node's edge to its parent is free. The
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
    add_node(nodes_scratch, parents_scratch, base0, load(start_in, trial), -1, range_rad)
    n1 = int(n_goals_in[trial])
    for g in range(n1):
        add_node(nodes_scratch, parents_scratch, base1 + g, load(goals_in, trial * BRANCHES + g), -1, range_rad)
    rng = wp.rand_init(seed, key_in[trial])
    margin = margin_in[trial]

    phase = int(EXTEND)
    grow = int(0)  # the tree that grows now
    target = vecq()  # where it grows to
    near = int(0)  # the node that it grows from
    origin = int(0)  # the node where the line to `target` begins: further steps along a line have the same parent
    met0 = int(-1)
    met1 = int(-1)
    count = int(0)
    while count < iterations and n0 < capacity and n1 < capacity and met0 < 0:
        if phase == EXTEND:
            count += 1
            grow = wp.where(n0 <= n1, 0, 1)
            target, rng = random_posture(world, start_in, trial, count, rng)
        base = wp.where(grow == 0, base0, base1)
        n = wp.where(grow == 0, n0, n1)
        if phase != CONNECT_ON:
            near = nearest_node(nodes_scratch, base, n, target)
            origin = near
        q_near, q_new, step_rad, reached = rrt_step(nodes_scratch, base, near, origin, target, count, range_rad)
        found = edge(world, bodies, trial, q_near, q_new, margin, 0.0, 0.0, 0.0, edge_mode)
        if found.status == FREE:
            add_node(nodes_scratch, parents_scratch, base + n, q_new, origin, range_rad)
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
            if phase == EXTEND and count % FULL_RANGE != 1:
                nodes_scratch[base + near, RANGE] = wp.max(shorter * step_rad, LEAST_RANGE * range_rad)
            phase = EXTEND
    if met0 >= 0:
        write_path(nodes_scratch, parents_scratch, base0, base1, met0, met1, path_out, length_inout, trial)
