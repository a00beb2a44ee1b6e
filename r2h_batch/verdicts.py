"""The words of a verdict: splits, sides, criteria, outcomes and reasons. Standard library only.

Whoever reads stored rows needs these and no tensor; `r2h_batch.types` offers them too.
"""

from enum import IntEnum
from typing import NamedTuple

SPLITS = ("S0", "S1")
"""S0: free handover; S1: functional, the receiver wants a certain part of the object."""

SEXES = ("male", "female")
"""Place in this tuple = code in every table of people."""

PERSON = ("age_years", "female", "stature_m", "hand_length_m", "seated", "redrawn")
"""Columns of `Trials.person`."""

SIDES = ("right", "left")
"""Which hand receives; place in this tuple = code in every table of hands."""


class CriterionEntry(NamedTuple):
    """Description of a criterion without its equation (`judge.metrics` has the equation)."""

    name: str  # stored columns are passed_NAME and margin_NAME_m; the outcome is NAME in capitals
    rate: str  # key of the rate of trials that fail here first
    heading: str  # of that rate in tables
    column: int  # place of that heading among the criteria's columns of Table I
    color: str  # in charts
    splits: tuple[str, ...]  # in which every success must have been judged by it
    touching_passes: bool  # whether a margin of exactly 0 passes
    since: str = (
        ""  # the first version that judges by it; empty: all do. Older rows are not judged by it
    )


REGISTRY = (
    CriterionEntry("stability", "f_stab", "F_stab", 3, "#e69f00", SPLITS, True),
    CriterionEntry("plan", "f_plan", "F_plan", 0, "#0072b2", SPLITS, False),
    CriterionEntry("reach", "f_reach", "F_reach", 1, "#56b4e9", SPLITS, True),
    CriterionEntry("affordance", "f_afford", "F_afford", 4, "#cc79a7", ("S1",), False),
    CriterionEntry("safe", "f_safe", "F_safe", 2, "#d55e00", SPLITS, False),
)
"""The criteria in the order in which the first failure is looked for. Stored columns, outcomes,
rates, headings, charts and re-scoring follow it. A new criterion needs an entry here, a member of
`Outcome` at the same place, and a function in `judge.metrics`."""

CRITERIA = tuple(entry.name for entry in REGISTRY)
"""Column order of every (B, C) tensor of criteria."""

MOST_SECONDS = 1e9
"""A stored time is at most this long (30 years): what is longer was made up."""


class Outcome(IntEnum):
    """A trial's verdict: success, the first criterion that failed (its place in `CRITERIA` + 1), or
    why it was not judged. Rows store names, so that numbers may change when a criterion is added."""

    SUCCESS = 0
    STABILITY = 1
    PLAN = 2
    REACH = 3
    AFFORDANCE = 4
    SAFE = 5
    INVALID_INPUT = 6
    INVALID_SIM = 7


if tuple(Outcome.__members__)[1 : len(REGISTRY) + 1] != tuple(c.upper() for c in CRITERIA):
    raise ValueError(
        f"Outcome and REGISTRY differ; Outcome must name {', '.join(CRITERIA)} in order"
    )


class MarginKind(IntEnum):
    """Meaning of a stored margin (`Scores.margin_kind`). Averages of margins leave `CAP` out."""

    NONE = 0
    """Not evaluated: there is no margin."""
    DISTANCE = 1
    """A length, to 0.1 mm: a clearance or a width; how far a target is out of reach."""
    BOUND = 2
    """Below 0: bodies overlap. The penetration depth (the length of the shortest translation that
    parts them) is at least this."""
    CAP = 3
    """No length: the clearance is this or more, or there is nothing to measure (-inf; nothing
    between the pads)."""


class PlanReason(IntEnum):
    """Why Plan passed or failed; `IK_UNREACHABLE` and `IK_IN_COLLISION` are proven,
    `NO_PATH_IN_BUDGET` is not; `NOT_SETTLED`: the motion did not come to rest.

    An arm without a closed form has `IK_NOT_FOUND` where no seed led to the target, and
    `NO_FREE_POSTURE_FOUND` where all postures found collide; neither is proven.

    With `PlanConfig.goals = "one"` only one branch is looked at: `IK_IN_COLLISION` then says
    nothing about the others. Where the wrist is singular (sin q5 = 0) solutions are a line, of
    which points are tried: if all collide, that is no proof and the reason is `NO_PATH_IN_BUDGET`.
    `MOTION_*` and `BEYOND_*` are of motions that the caller gives (`Evaluator.score_motion`).
    """

    OK = 0
    START_IN_COLLISION = 1
    IK_UNREACHABLE = 2
    IK_IN_COLLISION = 3
    NO_PATH_IN_BUDGET = 4
    NOT_EVALUATED = 5
    NOT_SETTLED = 6
    MOTION_IN_COLLISION = 7
    BEYOND_JOINT_LIMITS = 8
    BEYOND_SPEED_LIMITS = 9
    IK_NOT_FOUND = 10
    NO_FREE_POSTURE_FOUND = 11


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
