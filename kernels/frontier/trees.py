"""RRT-Connect on the frontier: many lanes of a problem grow the same two trees, each lane one edge at a time (`rrt_step`).

Each lane draws its own random posture and takes a step towards it from the nearest node of the smaller tree. Then the other tree
steps towards the node that was added. Between two steps the lane's edge is certified, which takes as many levels as its
bisection has; lanes do not wait for each other. After each level the kernel enters the lanes' results in their order. So a
problem's trees depend only on (seed, key of the trial, number of the random posture). pRRTC (Huang et al. 2025) grows two
trees on a GPU in a similar way.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import BRANCHES, CERTIFY

from ..plan.rrt import (
    CONNECT,
    CONNECT_ON,
    EXTEND,
    FULL_REACH,
    LEAST_REACH,
    REACH,
    add_node,
    random_posture,
    rrt_step,
    squared_distance,
    write_path,
)
from ..robot.joints import JOINTS
from ..robot.posture import load
from ..robot.world import World
from .intervals import add_edge
from .queues import NOTHING, REQUESTS, Counts, Edges, Intervals, key_of, order_in, take

wp.set_module_options(OPTIONS | {"max_unroll": 0})

IDLE = wp.constant(-1)
"""Phase of a lane without an edge."""
SLICES = wp.constant(8)
"""Threads that look for one nearest node."""

# State of a problem.
SEARCHING = wp.constant(0)
OVER = wp.constant(1)


@wp.struct
class Trees:
    """Two trees for each problem, and how far its search is (P,)."""

    trial: wp.array(dtype=int)
    nodes: wp.array2d(dtype=float)  # (P * 2 * capacity, JOINTS + 1), as plan/rrt.py has them
    parents: wp.array(dtype=int)
    size: wp.array2d(dtype=int)  # (P, 2) nodes
    drawn: wp.array(dtype=int)  # random postures so far
    state: wp.array(dtype=int)


@wp.struct
class Growers:
    """Lanes (P * K): what each is about to do, or waits for."""

    phase: wp.array(dtype=int)
    grow: wp.array(dtype=int)  # the tree that grows
    requests: wp.array(dtype=int)  # queue of lanes whose next edge has to be made
    nearest: wp.array(dtype=wp.int64)  # key (distance, node) of the nearest node so far
    number: wp.array(dtype=int)  # of its random posture
    near: wp.array(dtype=int)  # the node that the edge begins at
    origin: wp.array(dtype=int)  # the node where the line to the target begins
    node: wp.array(dtype=int)  # the node of the other tree that is the target
    reached: wp.array(dtype=int)  # whether the edge ends at the target
    reach: wp.array(dtype=float)
    target: wp.array2d(dtype=float)


@wp.kernel
def plant_trees(
    first: int, capacity: int, range_rad: float, lanes_each: int, edges: Edges, trees: Trees, growers: Growers,
    start_in: wp.array2d(dtype=float),  # (B, JOINTS)
    goals_in: wp.array2d(dtype=float),  # (B * 8, JOINTS)
    n_goals_in: wp.array(dtype=int),  # (B,)
    margin_in: wp.array(dtype=float),  # (B,)
    length_in: wp.array(dtype=int),  # (B,) a trial that has a path is passed over
):  # fmt: skip
    """Each problem's trees with their roots alone, and lanes without an edge."""
    problem = first + wp.tid()
    trial = trees.trial[problem]
    base = problem * 2 * capacity
    n = n_goals_in[trial]
    add_node(trees.nodes, trees.parents, base, load(start_in, trial), -1, range_rad)
    for g in range(n):
        add_node(trees.nodes, trees.parents, base + capacity + g, load(goals_in, trial * BRANCHES + g), -1, range_rad)
    trees.size[problem, 0] = 1
    trees.size[problem, 1] = n
    trees.drawn[problem] = 0
    trees.state[problem] = wp.where(length_in[trial] > 0 or n == 0, OVER, SEARCHING)
    for k in range(lanes_each):
        e = problem * lanes_each + k
        growers.phase[e] = IDLE
        edges.trial[e] = trial
        edges.owner[e] = e
        edges.hand_margin[e] = margin_in[trial]
        edges.left[e] = 0


# One problem's lanes in their order. A lane whose edge is settled goes on as in plan/rrt.py:
#
#     free, EXTEND               the node is added; the other tree tries to come here (CONNECT)
#     free, not at the target    the node is added; on along the same line (CONNECT_ON)
#     free, at the target        the trees have met: the path is written, the search is over
#     blocked                    after EXTEND its node's reach shrinks; the next random posture
#
# The search is over as well when a tree is full, or all random postures are drawn and no lane waits for an edge.
@wp.kernel
def enter_edges(
    first: int, iterations: int, capacity: int, range_rad: float, shorter: float, lanes_each: int, edges: Edges,
    trees: Trees, growers: Growers, counts: Counts,
    path_out: wp.array3d(dtype=float),  # (B, W, JOINTS)
    length_out: wp.array(dtype=int),  # (B,)
):  # fmt: skip
    """Adds the nodes that settled edges lead to, and says what each lane does next."""
    problem = first + wp.tid()
    if trees.state[problem] == OVER:
        return
    base0 = problem * 2 * capacity
    busy = int(0)
    for k in range(lanes_each):
        e = problem * lanes_each + k
        phase = growers.phase[e]
        if phase != IDLE and edges.left[e] > 0:
            busy += 1
            continue
        grow = growers.grow[e]
        base = base0 + grow * capacity
        next_phase = int(IDLE)
        if phase != IDLE and (edges.found[e] & wp.int64(NOTHING)) == wp.int64(NOTHING):
            n = trees.size[problem, grow]
            if n >= capacity:
                trees.state[problem] = OVER
                return
            q = load(edges.b, e)
            add_node(trees.nodes, trees.parents, base + n, q, growers.origin[e], range_rad)
            trees.size[problem, grow] = n + 1
            if phase == EXTEND:
                growers.grow[e] = 1 - grow
                growers.node[e] = n
                for j in range(JOINTS):
                    growers.target[e, j] = q[j]
                next_phase = CONNECT
            elif growers.reached[e] == 1:
                met0 = wp.where(grow == 0, n, growers.node[e])
                met1 = wp.where(grow == 0, growers.node[e], n)
                trees.state[problem] = OVER
                write_path(
                    trees.nodes, trees.parents, base0, base0 + capacity, met0, met1,
                    path_out, length_out, trees.trial[problem],
                )  # fmt: skip
                return
            else:
                growers.near[e] = n
                next_phase = CONNECT_ON
        elif phase == EXTEND and growers.number[e] % FULL_REACH != 1:
            near = base + growers.near[e]
            trees.nodes[near, REACH] = wp.max(shorter * trees.nodes[near, REACH], LEAST_REACH * range_rad)
        if next_phase == IDLE and trees.drawn[problem] < iterations:
            next_phase = EXTEND
            trees.drawn[problem] = trees.drawn[problem] + 1
            growers.number[e] = trees.drawn[problem]
            growers.grow[e] = wp.where(trees.size[problem, 0] <= trees.size[problem, 1], 0, 1)
        growers.phase[e] = next_phase
        if next_phase != IDLE:
            busy += 1
            row = take(counts, REQUESTS, growers.requests.shape[0])
            if row >= 0:
                growers.requests[row] = e
    if busy == 0:
        trees.state[problem] = OVER


@wp.kernel
def draw_targets(
    first: int, lanes: int, seed: int, lanes_each: int, world: World, counts: Counts, trees: Trees,
    growers: Growers,
    start_in: wp.array2d(dtype=float),  # (B, JOINTS)
    key_in: wp.array(dtype=int),  # (B,)
):  # fmt: skip
    """The random posture of each lane that asks for one, of a problem that is not over."""
    for i in range(first + wp.tid(), wp.min(counts.n[REQUESTS], growers.requests.shape[0]), lanes):
        e = growers.requests[i]
        problem = e / lanes_each
        growers.nearest[e] = (wp.int64(NOTHING) << wp.int64(32)) | wp.int64(NOTHING)
        if growers.phase[e] == EXTEND and trees.state[problem] != OVER:
            number = growers.number[e]
            rng = wp.rand_init(wp.int32(wp.rand_init(seed, key_in[trees.trial[problem]])), number)
            q, _rng = random_posture(world, start_in, trees.trial[problem], number, rng)
            for j in range(JOINTS):
                growers.target[e, j] = q[j]


@wp.kernel
def nearest_nodes(
    first: int, lanes: int, capacity: int, lanes_each: int, counts: Counts, trees: Trees, growers: Growers
):
    """The node of the growing tree that is nearest to each target (of equal ones the first), SLICES threads a lane."""
    for i in range(first + wp.tid(), SLICES * wp.min(counts.n[REQUESTS], growers.requests.shape[0]), lanes):
        e = growers.requests[i / SLICES]
        problem = e / lanes_each
        if growers.phase[e] != CONNECT_ON and trees.state[problem] != OVER:
            grow = growers.grow[e]
            base = (2 * problem + grow) * capacity
            target = load(growers.target, e)
            n = trees.size[problem, grow]
            least = float(1.0e30)
            at = int(-1)
            for node in range(i % SLICES, n, SLICES):
                d = squared_distance(trees.nodes, base + node, target)
                if d < least:
                    least = d
                    at = node
            if at >= 0:
                wp.atomic_min(growers.nearest, e, key_of(least, at))


@wp.kernel
def next_edges(
    first: int, lanes: int, parity: int, capacity: int, range_rad: float, lanes_each: int, world: World,
    edges: Edges, queue: Intervals, counts: Counts, trees: Trees, growers: Growers,
):  # fmt: skip
    """The edge that each lane asks for: one step from the nearest node towards its target; queued."""
    for i in range(first + wp.tid(), wp.min(counts.n[REQUESTS], growers.requests.shape[0]), lanes):
        e = growers.requests[i]
        problem = e / lanes_each
        if trees.state[problem] == OVER:
            continue
        base = (2 * problem + growers.grow[e]) * capacity
        if growers.phase[e] != CONNECT_ON:
            nearest = order_in(growers.nearest[e])
            growers.near[e] = nearest
            growers.origin[e] = nearest
        target = load(growers.target, e)
        near = growers.near[e]
        q_near, q_new, _reach, reached = rrt_step(
            trees.nodes, base, near, growers.origin[e], target, growers.number[e], range_rad
        )
        growers.reached[e] = wp.where(reached, 1, 0)
        for j in range(JOINTS):
            edges.a[e, j] = q_near[j]
            edges.b[e, j] = q_new[j]
        edges.found[e] = (wp.int64(NOTHING) << wp.int64(32)) | wp.int64(NOTHING)
        add_edge(world, edges, queue, counts, parity, e, CERTIFY, 0)
