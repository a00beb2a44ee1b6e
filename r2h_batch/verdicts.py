"""The words of a verdict: splits, sides, criteria, outcomes and reasons. Standard library only.

Whoever reads stored rows needs these and no tensor; `r2h_batch.types` offers them too.
"""

from enum import IntEnum

SPLITS = ("S0", "S1")
"""S0: free handover; S1: functional, the receiver wants a certain part of the object."""

SIDES = ("right", "left")
"""Which hand receives; place in this tuple = code in every table of hands."""

CRITERIA = ("stability", "plan", "reach", "affordance", "safe")
"""Column order of every (B, 5) tensor, and the order in which the first failure is looked for."""

MOST_SECONDS = 1e9
"""A stored time is at most this long (30 years): what is longer was made up."""


class Outcome(IntEnum):
    """A trial's verdict: success, the first criterion that failed, or why it was not judged."""

    SUCCESS = 0
    STABILITY = 1
    PLAN = 2
    REACH = 3
    AFFORDANCE = 4
    SAFE = 5
    INVALID_INPUT = 6
    INVALID_SIM = 7


class PlanReason(IntEnum):
    """Why Plan passed or failed; `IK_*` are proven, `NO_PATH_IN_BUDGET` is not; `NOT_SETTLED`: the
    motion did not come to rest.

    With `PlanConfig.goals = "one"` only one branch is looked at: `IK_IN_COLLISION` then says
    nothing about the others. Where the wrist is singular (sin q5 = 0) solutions are a line, of
    which points are tried: if all collide, that is no proof and the reason is `NO_PATH_IN_BUDGET`.
    """

    OK = 0
    START_IN_COLLISION = 1
    IK_UNREACHABLE = 2
    IK_IN_COLLISION = 3
    NO_PATH_IN_BUDGET = 4
    NOT_EVALUATED = 5
    NOT_SETTLED = 6


class CollidingPair(IntEnum):
    """Which two bodies met, or are nearest along a path (`Scores.plan_pair`); HAND, TABLE, SELF:
    with the robot itself."""

    NONE = 0
    HAND = 1
    TABLE = 2
    SELF = 3
    OBJECT_HAND = 4
    OBJECT_TABLE = 5
    OBJECT_ROBOT = 6
