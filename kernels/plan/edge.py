"""Edges of joint space: certified free by conservative advancement, or sampled as MoveIt does; smallest clearance.

An interval of an edge is its middle posture q and half its length d: the postures q + s d with -1 <= s <= 1. A point of a
body travels at most L = sum_j |d_j| r_j from where it is in the middle (`motion`; r_j, the motion radius: the largest
distance of the body's points from the axis of joint j). So a pair at distance D in the middle keeps D - L on the whole
interval:

    D - L >= margin    =>    the pair is free on the whole interval.

Where that fails, the way it really goes may still be clear. With n the direction from the obstacle to the body in the
middle, a point x of the body has n . x(s) >= n . x + s n . v + s^2 / 2 n . a - |s|^3 / 6 T, with its velocity v and its
acceleration a relative to the obstacle, both known in the middle, and T a bound on the third derivative (`bends`); or without a
and T, -s^2 / 2 C with a bound C on any acceleration. The least of it over the body and over s (`swept_support`) less the
obstacle's largest n . x is a distance that holds on the whole interval, and what the bound gives away falls with the cube of the
interval's length: with motion radii of 0.7 m and 0.4 rad to either side, summed over the joints, 56 mm with C, 7 mm with a and T.

What neither settles is bisected. That is conservative advancement (Mirtich 1996) made to halve intervals instead of
following time, as Schwarzer, Saha and Latombe (2005) do for articulated robots.
"""

import warp as wp

from r2h_batch.kernels.geometry.bisection import MAX_LEVEL, descend, half_width, middle, next_interval
from r2h_batch.kernels.options import OPTIONS
from r2h_batch.kernels.plan.codes import (
    BLOCKED,
    CLEARANCE,
    CLOSELY,
    FREE,
    MAX_OBSTACLES,
    OPEN,
    POSTURE,
    SAMPLES,
)

from ..robot.joints import FIELDS, FRAMES, JOINTS, vecq
from ..robot.world import TrialBodies, World
from .check import Finding, check_interval
from .obstacles import Query

wp.set_module_options(OPTIONS)

SECTION_RAD = wp.constant(1.6)
"""Longest section of an edge, summed over the joints, that starts as one interval; longer ones were never settled."""
MOVEIT_SEGMENT_RAD = wp.constant(0.691)
"""MoveIt's longest valid segment: 0.01 of the space's extent (69.1 rad summed over the joints of a UR5e)."""


@wp.func
def edge(
    world: World, bodies: TrialBodies, trial: int, a: vecq, b: vecq, hand_margin: float, other_margin: float,
    best: float, tolerance: float,
    mode: int,  # CERTIFY, CLOSELY, SAMPLES, CLEARANCE (below `best`) or POSTURE (a alone)
):  # fmt: skip
    """FREE or BLOCKED for the straight joint-space edge a-b; with CLEARANCE the smallest clearance along it.

    CERTIFY: bisection of each section of SECTION_RAD; FREE when every interval is, BLOCKED as soon as one middle is, or when a
    interval of 2^-14 of a section is still undecided. CLOSELY: the same with exact distances. CLEARANCE: the same walk as
    branch and bound; a pair is settled when it cannot come nearer than `best` less `tolerance` on the interval, `best` falls
    with every middle, and what is undecided at the end counts as settled. It stops where bodies meet. SAMPLES: postures at
    most MOVEIT_SEGMENT_RAD apart, b included, a not. POSTURE: a alone, and its smallest distance to the hand if that is
    below `best`.

    All modes share one call of `check_interval`: inlined, it is most of the code of a planning kernel.
    """
    R = wp.zeros(shape=FRAMES, dtype=wp.mat33)
    p = wp.zeros(shape=FRAMES, dtype=wp.vec3)
    w = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    v = wp.zeros(shape=FIELDS, dtype=wp.vec3)
    obstacle = wp.zeros(shape=MAX_OBSTACLES, dtype=int)
    masks = wp.zeros(shape=3, dtype=wp.uint64)
    stack = wp.zeros(shape=48, dtype=wp.uint64)  # per level of the bisection: the masks that its intervals start from
    everything = ~wp.uint64(0)
    # base and shoulder stand on the table
    tabled = everything << wp.uint64(world.table_from)
    stack[0] = everything
    stack[1] = tabled
    stack[2] = everything

    result = Finding()
    result.status = FREE
    result.best = best
    result.body = -1
    query = Query()
    query.hand_margin = hand_margin
    query.other_margin = other_margin
    query.aim = wp.where(mode == CLEARANCE, 1, wp.where(mode == POSTURE and best > 0.0, 2, 0))
    query.tolerance = tolerance
    query.closely = mode == CLOSELY
    delta = b - a
    length = float(0.0)
    for j in range(JOINTS):
        length += wp.abs(delta[j])
    steps = int(1)
    if mode == SAMPLES:
        steps = wp.max(int(wp.ceil(length / MOVEIT_SEGMENT_RAD)), 1)
    level = int(0)
    index = int(0)
    bisected = mode != SAMPLES and mode != POSTURE
    # equal sections of the edge, in leaps from the middle on: a body that blocks it is mostly found in the first ones
    sections = int(1)
    if bisected:
        sections = wp.max(int(wp.ceil(length / SECTION_RAD)), 1)
    stride = wp.where(sections % 3 == 0, wp.where(sections % 5 == 0, 7, 5), 3)
    turn = int(0)
    section = sections / 2
    one = 1.0 / float(sections)
    running = bool(True)
    while running:
        if not bisected:
            t = float(index) / float(steps)
            if mode == SAMPLES:
                t = float(index + 1) / float(steps)
            query.q = a + t * delta
            masks[0] = everything
            masks[1] = tabled
            masks[2] = everything
        else:
            query.q = a + ((float(section) + middle(level, index)) * one) * delta
            query.d = (half_width(level) * one) * delta
            masks[0] = stack[3 * level]
            masks[1] = stack[3 * level + 1]
            masks[2] = stack[3 * level + 2]
        moving = wp.dot(query.d, query.d) > 0.0
        found = check_interval(world, bodies, trial, query, moving, result.best, masks, R, p, w, v, obstacle)
        if mode == CLEARANCE:
            if found.best < result.best:
                result.best = found.best
                result.pair = found.pair
                result.body = found.body
        elif found.status != FREE:
            result.pair = found.pair
            result.body = found.body
        if mode == CLEARANCE and result.best < 0.0:
            running = False  # bodies meet: how deep is not measured, and a long overlap would be halved without end
        elif not bisected:
            result.best = found.best
            index += 1
            if found.status != FREE:
                result.status = BLOCKED
                running = False
            elif index >= steps:
                running = False
        elif found.status == BLOCKED:
            result.status = BLOCKED
            running = False
        elif found.status == OPEN and level + 1 < MAX_LEVEL:
            level, index = descend(level, index)
            stack[3 * level] = masks[0]
            stack[3 * level + 1] = masks[1]
            stack[3 * level + 2] = masks[2]
        elif found.status == OPEN and mode != CLEARANCE:
            result.status = BLOCKED
            running = False
        else:
            level, index = next_interval(level, index)
            if level == 0:
                index = 0
                turn += 1
                section = (sections / 2 + turn * stride) % sections
                running = turn < sections
    return result
