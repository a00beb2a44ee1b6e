"""Queues of one level of Safe: intervals of motions, bodies on them, pieces and faces of the hand that these may meet.

A level of all trials' motions goes through these stages (queues.py has the rules that hold here too):

    intervals -> frames -> links -> bodies -> pieces by their balls -> GJK -> by their hulls -> faces by their balls -> GJK
        -> the smallest distance, open intervals -> halves

A kernel that reads a trial's smallest distance never writes it. Therefore results depend neither on the number of threads nor on
other trials.
"""

import warp as wp

from r2h_batch.kernels.geometry.bisection import MAX_LEVEL
from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

# Entries of `Counts.n` (queues.py, whose NOW and FULL are the same here).
BODIES = wp.constant(2)
PIECES = wp.constant(3)
SETS = wp.constant(4)
FACES = wp.constant(5)
TAKEN = wp.constant(6)

GOAL_LEVEL = wp.constant(-1)
"""Level of an interval that is the last posture alone."""
SET = wp.constant(16)
"""Faces of a piece that one thread checks together."""
NO_FACE = wp.constant(0x7FFF)
"""In place of a face: the body is wholly within the hand."""
SEGMENTS = wp.constant(32)
"""Segments of each motion that are halved at the same time, from its end on."""
NOWHERE = wp.constant(0x7FFFFFFFFFFFFFFF)
"""Place of a distance that nothing has."""


@wp.struct
class Nearest:
    """The result of each trial so far (B,)."""

    distance: wp.array(dtype=float)  # smallest so far
    above: wp.array(dtype=float)  # some point of the hand is that near at some moment
    place: wp.array(dtype=wp.int64)  # where `distance` is (`place_of`)


@wp.struct
class Moments:
    """One queue of intervals (N,)."""

    trial: wp.array(dtype=int)
    segment: wp.array(dtype=int)
    section: wp.array(dtype=int)
    level: wp.array(dtype=int)
    index: wp.array(dtype=int)
    look: wp.array(dtype=wp.int64)  # bit = body to be checked


@wp.struct
class BodyQueue:
    """Bodies on intervals (M,)."""

    interval: wp.array(dtype=int)
    body: wp.array(dtype=int)
    R: wp.array(dtype=wp.mat33)
    p: wp.array(dtype=wp.vec3)
    travel: wp.array(dtype=float)
    known: wp.array(dtype=float)  # the trial's smallest distance when the level began
    waits: wp.array(dtype=int)  # 1: the interval has to be halved for this body anyway
    meets: wp.array(dtype=int)  # 1: a piece's hull meets the body
    nearest: wp.array(dtype=float)  # smallest distance of a face of a piece, FAR without one


@wp.struct
class Pieces:
    """Pieces of the hand that a body may come near to (P,), and what GJK says of their hulls."""

    of: wp.array(dtype=int)  # row of the body
    piece: wp.array(dtype=int)  # numbered over all hands
    meets: wp.array(dtype=int)  # 1: the body meets the hull; then GJK's numbers are those of its core
    lower: wp.array(dtype=float)
    v: wp.array(dtype=wp.vec3)


@wp.struct
class Sets:
    """Up to SET faces of a piece that the body may come near to (A,)."""

    of: wp.array(dtype=int)
    first: wp.array(dtype=int)
    last: wp.array(dtype=int)  # one behind
    n: wp.array(dtype=wp.vec3)  # `bound_of_hull`
    beyond: wp.array(dtype=float)


@wp.struct
class Faces:
    """Faces that bounds do not settle (F,), and what GJK says of them."""

    of: wp.array(dtype=int)
    face: wp.array(dtype=int)
    known: wp.array(dtype=float)  # what the face was compared with
    value: wp.array(dtype=float)
    v: wp.array(dtype=wp.vec3)


# From the highest bits: the block of segments (later blocks come first, as smaller numbers are of later levels), the level
# (finer ones are of later levels), then what tells apart entries of one level. So where a distance falls in a level, its place is
# smaller than that of any level before, and the smallest place wins without anybody having to forget the old one.
@wp.func
def place_of(segment: int, level: int, section: int, index: int, body: int, face: int):
    """An interval's middle, a body and a face as one number of 63 bits."""
    place = wp.int64(segment / SEGMENTS)
    place = (place << wp.int64(4)) | wp.int64(MAX_LEVEL - 1 - level)
    place = (place << wp.int64(5)) | wp.int64(segment % SEGMENTS)
    place = (place << wp.int64(6)) | wp.int64(section)
    place = (place << wp.int64(14)) | wp.int64(index)
    place = (place << wp.int64(6)) | wp.int64(body)
    return (place << wp.int64(15)) | wp.int64(face)


@wp.func
def bits_of(place: wp.int64, first: int, count: int):
    """`count` bits of a place from number `first` on."""
    return wp.int32((place >> wp.int64(first)) & ((wp.int64(1) << wp.int64(count)) - wp.int64(1)))


@wp.func
def fields_of_place(place: wp.int64):
    """Segment, level, section and index of a place, its robot body and its face."""
    segment = SEGMENTS * bits_of(place, 50, 13) + bits_of(place, 41, 5)
    level = MAX_LEVEL - 1 - bits_of(place, 46, 4)
    return segment, level, bits_of(place, 35, 6), bits_of(place, 21, 14), bits_of(place, 15, 6), bits_of(place, 0, 15)
