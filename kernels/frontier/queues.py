"""Queues of one level of the bisection: intervals that are not settled, the bodies and pairs to be checked, and their counts.

All intervals of a level go through these stages together; open ones go to the next level as two halves:

    intervals -> frames -> links -> bodies by kind of pair -> pairs -> GJK -> settled, met or open -> halves

Stages hand over sets of bits, smallest keys, and queues whose order no kernel reads. These do not depend on the order in which
threads run. Therefore results depend neither on the number of threads nor on the other entries of a queue.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

from ..robot.joints import OBJECT
from ..robot.world import World

wp.set_module_options(OPTIONS)

# HAND, TABLE and SELF (plan/codes.py) are the kinds of pairs; each has one of an interval's three sets of bits.
PIECES = wp.constant(3)  # of the hand, one by one: bodies that are near to the ball around the whole of it

KINDS = wp.constant(4)
"""Queues of bodies."""

# Entries of `Counts.n`.
NOW = wp.constant(0)  # intervals of this level; the other parity is the next one's
BODIES = wp.constant(2)  # + HAND, TABLE, SELF or PIECES: bodies to be checked
TAKEN = wp.constant(6)  # pairs that a lane has taken
FULL = wp.constant(7)  # 1: some queue was too short, and nothing counts
EDGES = wp.constant(8)  # edges of paths
PAIRS = wp.constant(9)
COUNTS = wp.constant(10)

POSTURE_LEVEL = wp.constant(-1)
"""Level of an interval that is one posture: number `index` + 1 of `section` steps of its edge."""

NOTHING = wp.constant(0x7FFFFFFF)
"""Order in place of a missing pair."""


@wp.struct
class Counts:
    """How many entries each queue has."""

    n: wp.array(dtype=int)  # (COUNTS,)


@wp.struct
class Edges:
    """Straight lines in joint space (E,), and the result of the edge or path that each belongs to."""

    trial: wp.array(dtype=int)
    owner: wp.array(dtype=int)  # row of `found`: the edge itself, or its path
    a: wp.array2d(dtype=float)  # (E, JOINTS)
    b: wp.array2d(dtype=float)
    hand_margin: wp.array(dtype=float)
    found: wp.array(dtype=wp.int64)  # (owners,) smallest key so far (`key_of`)


@wp.struct
class Intervals:
    """One queue of intervals (N,)."""

    edge: wp.array(dtype=int)
    section: wp.array(dtype=int)
    level: wp.array(dtype=int)
    index: wp.array(dtype=int)
    look: wp.array2d(dtype=wp.int64)  # (N, 3) by kind of pair: bit = body to be checked


@wp.struct
class Frames:
    """The level's intervals (N,): frames, twists, and the bodies that stay open."""

    d: wp.array2d(dtype=float)  # (N, JOINTS) half the interval, rad
    R: wp.array2d(dtype=wp.mat33)  # (N, 7)
    p: wp.array2d(dtype=wp.vec3)
    w: wp.array2d(dtype=wp.vec3)  # (N, FIELDS)
    v: wp.array2d(dtype=wp.vec3)
    open: wp.array2d(dtype=wp.int64)  # (N, 3) by kind of pair: bit = the interval has to be halved for this body


@wp.struct
class BodyQueue:
    """Bodies to be checked (KINDS M,), a section for each kind of pair, and one for those near to the hand."""

    interval: wp.array(dtype=int)
    body: wp.array(dtype=int)
    links: wp.array(dtype=int)  # SELF: bits of the links that it may meet


@wp.struct
class Pairs:
    """Pairs that bounding volumes do not settle (P,), and what GJK says of them."""

    interval: wp.array(dtype=int)
    body: wp.array(dtype=int)
    other: wp.array(dtype=int)  # `pair_of`
    R: wp.array(dtype=wp.mat33)  # the body in its obstacle's frame
    p: wp.array(dtype=wp.vec3)
    needed: wp.array(dtype=float)  # lower bound that settles the pair for the whole interval
    lower: wp.array(dtype=float)
    upper: wp.array(dtype=float)
    v: wp.array(dtype=wp.vec3)


@wp.func
def pair_of(kind: int, other: int):
    """An obstacle as one number."""
    return kind * 256 + other


@wp.func
def order_of(body: int, other: int):
    """The place of a pair among all of a posture, as one number; NOTHING is behind all."""
    return body * 1024 + other


@wp.func
def key_of(value: float, order: int):
    """(value, order of the pair) as one number that is smaller where value is, or else order."""
    bits = wp.cast(value, wp.int32)
    if bits < 0:
        bits = -(bits & 0x7FFFFFFF)  # negative floats run the other way
    return (wp.int64(bits) << wp.int64(32)) | wp.int64(order)


@wp.func
def value_of(key: wp.int64):
    """The value of a key."""
    bits = wp.int32(key >> wp.int64(32))
    if bits < 0:
        bits = (-bits) | wp.int32(-2147483648)
    return wp.cast(bits, wp.float32)


@wp.func
def order_in(key: wp.int64):
    """The order of a key."""
    return wp.int32(key & wp.int64(0xFFFFFFFF))


@wp.func
def bit_of(world: World, body: int):
    """A body's bit; all hulls of the object share one."""
    return wp.int64(1) << wp.int64(wp.min(body, world.n_robot))


@wp.func
def link_of(world: World, body: int):
    """A body's link."""
    link = int(OBJECT)
    if body < world.n_robot:
        link = world.body_link[body]
    return link


@wp.func
def target_of(aim: int, tolerance: float, key: wp.int64, margin: float):
    """Clearance that a pair has to keep: its margin, or what would improve on the smallest clearance so far."""
    return wp.where(aim == 1, value_of(key) - tolerance, margin)


@wp.func
def is_done(aim: int, key: wp.int64):
    """Whether an owner needs no more checks: something blocks it, or bodies meet on it."""
    return wp.where(aim == 1, value_of(key) < 0.0, order_in(key) != NOTHING)


@wp.func
def take(counts: Counts, which: int, capacity: int):
    """The next free row of a queue, -1 where it is full."""
    row = wp.atomic_add(counts.n, which, 1)
    if row >= capacity:
        counts.n[FULL] = 1
        row = -1
    return row
