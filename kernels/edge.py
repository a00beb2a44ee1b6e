"""Edges of joint space: certified free by conservative advancement, or sampled as MoveIt does; smallest clearance."""

import warp as wp

from r2h_batch.kernels.check import BLOCKED, FREE, OPEN, Finding, examine
from r2h_batch.kernels.partners import Query
from r2h_batch.kernels.world import TrialBodies, World, vec6

wp.set_module_options({"enable_backward": False})

MAX_LEVEL = wp.constant(15)
MOVEIT_SEGMENT_RAD = wp.constant(0.691)
"""MoveIt's longest valid segment: 0.01 of the space's extent (69.1 rad summed over the joints of a UR5e)."""


@wp.func
def edge(
    world: World,
    bodies: TrialBodies,
    trial: int,
    a: vec6,
    b: vec6,
    hand_margin: float,
    other_margin: float,
    best: float,
    tolerance: float,
    mode: int,  # 0: certify, 1: samples at MoveIt's resolution, 2: smallest clearance below `best`, 3: posture a alone
    hand_only: int,
):
    """FREE or BLOCKED for the straight joint-space edge a-b; with mode 2 the smallest clearance along it.

    The edge is bisected: a stretch is free when every pair is farther apart in its middle than it can move to either
    end. What one level settles, its halves do not look at again. Below 2^-15 of the edge an undecided stretch counts as
    blocked (mode 2: as settled to the tolerance).
    """
    R = wp.zeros(shape=7, dtype=wp.mat33)
    p = wp.zeros(shape=7, dtype=wp.vec3)
    w = wp.zeros(shape=7, dtype=wp.vec3)
    v = wp.zeros(shape=7, dtype=wp.vec3)
    partner = wp.zeros(shape=64, dtype=int)
    masks = wp.zeros(shape=3, dtype=wp.uint64)
    stack = wp.zeros(shape=48, dtype=wp.uint64)
    everything = ~wp.uint64(0)
    others = wp.where(hand_only == 1, wp.uint64(0), everything)
    tabled = others << wp.uint64(world.table_from)
    stack[0] = everything
    stack[1] = tabled
    stack[2] = others

    result = Finding()
    result.status = FREE
    result.best = best
    result.body = -1
    query = Query()
    query.hand_margin = hand_margin
    query.other_margin = other_margin
    query.track = wp.where(mode == 2, 1, 0)
    query.tolerance = tolerance
    delta = b - a
    length = float(0.0)
    for j in range(6):
        length += wp.abs(delta[j])
    steps = int(1)
    if mode == 1:
        steps = wp.max(int(wp.ceil(length / MOVEIT_SEGMENT_RAD)), 1)
    level = int(0)
    index = int(0)
    running = bool(True)
    while running:
        if mode == 1 or mode == 3:
            t = float(index) / float(steps)
            if mode == 1:
                t = float(index + 1) / float(steps)
            query.q = a + t * delta
            masks[0] = everything
            masks[1] = tabled
            masks[2] = others
        else:
            half = 1.0 / float(2 << level)
            query.q = a + (float(2 * index + 1) * half) * delta
            query.d = half * delta
            masks[0] = stack[3 * level]
            masks[1] = stack[3 * level + 1]
            masks[2] = stack[3 * level + 2]
        found = examine(world, bodies, trial, query, result.best, masks, R, p, w, v, partner)
        if mode == 2:
            if found.best < result.best:
                result.best = found.best
                result.pair = found.pair
                result.body = found.body
        elif found.status != FREE:
            result.pair = found.pair
            result.body = found.body
        if mode == 2 and result.best < 0.0:
            running = False  # bodies meet: how deep is not measured, and a long overlap would be halved without end
        elif mode == 1 or mode == 3:
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
            level += 1
            index = 2 * index
            stack[3 * level] = masks[0]
            stack[3 * level + 1] = masks[1]
            stack[3 * level + 2] = masks[2]
        elif found.status == OPEN and mode == 0:
            result.status = BLOCKED
            running = False
        else:
            while level > 0 and (index & 1) == 1:
                index = index >> 1
                level -= 1
            if level == 0:
                running = False
            else:
                index += 1
    return result
