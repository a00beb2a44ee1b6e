"""Walk over an edge that is halved where its middle does not settle it: depth first, from its start to its end.

An interval is (level, index): the edge cut into 2^level equal parts, of which this is number `index`. What is known of a
interval is kept once per level, because a right half starts from what its parent knew: the left half's verdict says
nothing about it, and no other interval of that level is waiting. A stack of MAX_LEVEL rows holds the whole walk.
"""

import warp as wp

from r2h_batch.kernels.options import OPTIONS

wp.set_module_options(OPTIONS)

MAX_LEVEL = wp.constant(15)
"""Levels of a walk: the shortest interval is 2^-14 of the edge."""


@wp.func
def half_width(level: int):
    """Half the length of an interval, as a fraction of the edge."""
    return 1.0 / float(2 << level)


@wp.func
def middle(level: int, index: int):
    """Where the middle of an interval lies on the edge, 0..1."""
    return float(2 * index + 1) * half_width(level)


@wp.func
def descend(level: int, index: int):
    """The left half of an interval."""
    return level + 1, 2 * index


@wp.func
def next_interval(level: int, index: int):
    """The interval after a settled one: its right neighbour on the finest level that has one. Level 0: the edge is
    done."""
    while level > 0 and (index & 1) == 1:
        index = index >> 1
        level -= 1
    if level > 0:
        index += 1
    return level, index
