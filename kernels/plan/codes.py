"""Codes and sizes that several kernels share with each other or with the host.

The host imports the sizes; the enums of r2h_batch.types are compared with the codes by tests/kernels/test_codes.py.
"""

import warp as wp

# Result of a check of a posture or an interval of motion.
FREE = wp.constant(0)  # every pair keeps its margin
BLOCKED = wp.constant(1)  # some pair does not
OPEN = wp.constant(2)  # undecided: the interval is too long for its middle to speak for all of it

# Question about an edge (plan/edge.py).
CERTIFY = wp.constant(0)  # proven free, by conservative advancement
SAMPLES = wp.constant(1)  # free at samples as far apart as MoveIt's
CLEARANCE = wp.constant(2)  # the smallest clearance along it
POSTURE = wp.constant(3)  # whether its first posture is free
CLOSELY = wp.constant(
    4
)  # as CERTIFY, each distance as near as it goes: dearer, and right beside the hand it proves more

# What a body may meet: the kind of a pair.
HAND = wp.constant(0)
TABLE = wp.constant(1)
SELF = wp.constant(2)

# Which two bodies meet: r2h_batch.types.CollidingPair. The first three are met by the robot itself.
PAIR_NONE = wp.constant(0)
PAIR_HAND = wp.constant(1)
PAIR_TABLE = wp.constant(2)
PAIR_SELF = wp.constant(3)
PAIR_OF_OBJECT = wp.constant(3)  # added where it is the object that meets them

# Why there is no path, as far as kernels say it: r2h_batch.types.PlanReason.
REASON_OK = wp.constant(0)
REASON_START_IN_COLLISION = wp.constant(1)
REASON_IK_UNREACHABLE = wp.constant(2)
REASON_IK_IN_COLLISION = wp.constant(3)
REASON_NOT_EVALUATED = wp.constant(5)

MEETING_M = wp.constant(-1.0e-6)
"""Clearance of bodies whose cores meet, in metres: there is no smaller one, as how deep they meet is not measured."""

# Sizes.
WAYPOINTS = wp.constant(32)
"""Longest path that is stored; RRT-Connect's raw paths have 3 to 12."""
BRANCHES = wp.constant(8)
"""IK branches of a pose (r2h_batch.judge.ik), and so goals of a trial."""
MAX_OBSTACLES = wp.constant(64)
"""Number of bodies that one body may be near to in `check`: the hand's pieces, the table and the arm's bodies fit
(scene/tables.py)."""
MAX_ARM_BODIES = wp.constant(24)
"""Primitives of the arm that `posture_clearance` keeps in place; a UR5e has 21. On a GPU each takes 24 bytes of stack."""
