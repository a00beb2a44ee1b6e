"""The words of a verdict: splits, sides, criteria, outcomes and reasons. Standard library only.

Whoever reads stored rows needs these and no tensor; `r2h_batch.types` offers them too.
"""

import re
from collections.abc import Callable, Sequence
from enum import IntEnum
from itertools import combinations
from typing import Any, Literal, NamedTuple

from r2h_batch.plugins import PackageError, Registry
from r2h_batch.strangers import stranger, words_of

SPLITS = ("S0", "S1")
"""S0: free handover; S1: functional, the receiver wants a certain part of the object."""

SEXES = ("male", "female")
"""Place in this tuple = code in every table of people."""

PERSON = ("age_years", "female", "stature_m", "hand_length_m", "seated", "redrawn")
"""Columns of `Trials.person`."""

SIDES = ("right", "left")
"""Which hand receives; place in this tuple = code in every table of hands."""


class Unit(NamedTuple):
    """A unit of margins, and how margins in it are shown."""

    shown: str  # the unit in which people read them
    scale: float  # shown number / stored number
    borderline: float  # float32 geometry does not decide a margin that is nearer to 0
    low: float  # ends of their histograms
    high: float
    worth_m: float  # one unit beside lengths, in rewards


UNITS = {
    "m": Unit("mm", 1e3, 1e-4, -0.06, 0.12, 1.0),
    "deg": Unit("deg", 1.0, 0.05, -60.0, 120.0, 0.002),
}
"""Unit of a criterion's margin -> how it is shown. A degree counts as 2 mm, the arc at 11.5 cm."""


class CriterionEntry(NamedTuple):
    """A criterion: all that there is to know of it without torch. Ours and those of other packages are such values, and
    nothing else says which criteria there are."""

    name: (
        str  # stored columns are passed_NAME and margin_NAME_UNIT; the outcome is NAME in capitals
    )
    rate: str  # key of the rate of trials that fail here first
    heading: str  # of that rate in tables
    column: int  # place of that heading among the criteria's columns of Table I
    color: str  # in charts
    splits: tuple[str, ...]  # in which every success must have been judged by it
    touching_passes: bool  # whether a margin of exactly 0 passes
    since: str = (
        ""  # the first version that judges by it; empty: all do. Older rows are not judged by it
    )
    unit: str = "m"  # of its margins: a key of `UNITS`
    applies: Callable[[Any], bool] | None = None  # whether it concerns an object (an ObjectModel)
    function: str = ""  # module:name of the equation; empty: that of its name in judge/metrics.py
    means: str = ""  # what its margin is, in words
    fails: str = ""  # what it means that it fails, in words; by how much is added to them
    asked: bool = (
        False  # whether only benchmarks that ask for it are judged by it (`Benchmark.asks`)
    )
    behind: str = ""  # whose failure is looked for right before; empty: that of the entry before it

    @property
    def margin_column(self) -> str:
        """The stored column of its margins."""
        return f"margin_{self.name}_{self.unit}"

    @property
    def passed_column(self) -> str:
        """The stored column of its verdicts."""
        return f"passed_{self.name}"

    @property
    def kind_column(self) -> str:
        """The stored column of what its margins mean (`MarginKind`)."""
        return f"margin_kind_{self.name}"

    def concerns(self, model: Any) -> bool:
        """Whether an object is judged by it.

        Args:
            model: an ObjectModel.

        Raises:
            PackageError: `applies` of another package raised something.
        """
        if self.applies is None:
            return True
        whose = CRITERION.entry(self.name)
        try:
            with stranger(whose, self.applies.__module__):
                return bool(self.applies(model))
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # SystemExit too
            raise PackageError(f"{whose}: its `applies` raised {words_of(error)}") from error

    @property
    def equation(self) -> tuple[str, str]:
        """Module and name of the function that judges by it, from `judge.metrics.Evidence` to `Criterion`."""
        module, _, name = self.function.rpartition(":")
        return (module, name) if module else ("r2h_batch.judge.metrics", self.name)


_OURS = (
    CriterionEntry("stability", "f_stab", "F_stab", 3, "#e69f00", SPLITS, True,
                   means="room left between the pads and at the ends of their stroke",
                   fails="the gripper does not hold it"),
    CriterionEntry("plan", "f_plan", "F_plan", 0, "#0072b2", SPLITS, False,
                   means="smallest distance to an obstacle along the path"),
    CriterionEntry("reach", "f_reach", "F_reach", 1, "#56b4e9", SPLITS, True,
                   means="how far the object reaches into the ball in front of the palm",
                   fails="the hand does not reach the object"),
    CriterionEntry("affordance", "f_afford", "F_afford", 4, "#cc79a7", ("S1",), False,
                   means="distance from the fingers to the receiver's part of the object",
                   fails="the gripper holds the receiver's part"),
    CriterionEntry("safe", "f_safe", "F_safe", 2, "#d55e00", SPLITS, False,
                   means="smallest distance from the robot to the hand",
                   fails="the robot meets the hand"),
    CriterionEntry("pick", "f_pick", "F_pick", 6, "#7f6a52", SPLITS, True, since="0.3.0",
                   asked=True, behind="stability"),
    CriterionEntry("presented", "f_pres", "F_pres", 7, "#b5a642", SPLITS, True, since="0.4.0",
                   means="how far the wanted part reaches into the ball, or what it is ahead of gripper and sharp parts, by the"
                   " way to the palm",
                   fails="the wanted part is not what the hand comes to first", asked=True),
    CriterionEntry("received", "f_recv", "F_recv", 8, "#6a9a3d", SPLITS, True, since="0.3.0",
                   asked=True),
)  # fmt: skip
"""A new criterion is an entry here and a function in `judge.metrics`."""

CRITERION: Registry[CriterionEntry] = Registry("criterion", {entry.name: entry for entry in _OURS})
"""All criteria by name, with those that other packages name as `criterion.NAME` (`r2h_batch.plugins`). Their modules are
imported here, so they may import this file and the standard library alone."""


NO_LONGER = ("taken",)
"""Criteria that rows of r2h_batch 0.3 and before may be judged by, and no benchmark asks for any more. Such rows keep the
outcomes of these names; their columns are not read."""

ELSEWHERE = "other_criterion"
"""Read in the place of the outcome of a criterion that is not known here: its package is not installed. No row is stored so."""

NO_CRITERION = (
    "success",
    "invalid_input",
    "invalid_sim",
    "missing",
    ELSEWHERE,
    *NO_LONGER,
    "s0",
    "s1",
    "avg",
)
"""Words that stand beside criteria in stored rows and tables."""

NUMBERS = (
    *(
        "sr",
        "t_plan_s",
        "t_exec_s",
        "t_tot_s",
        "t_method_s",
        "invalid",
        "missing",
        "presented",
        "upright",
    ),
    *("presented_before_0_4", "body_met", "through", "pick"),
)
"""Keys of tables that are rates of no criterion."""

OTHER_KEYS = re.compile("split|method|object|few|(n|sr|turn)(_.*)?|.*_(low|high|of|n)")
"""Names of other values of a record."""

_KINDS = {
    **dict.fromkeys(("name", "rate", "heading", "color", "since", "unit", "function", "means", "fails", "behind"), str),
    "column": int, "splits": tuple, "touching_passes": bool, "asked": bool,
}  # fmt: skip


def _checked(entry: CriterionEntry, place: str) -> CriterionEntry:
    """An entry that somebody added.

    Raises:
        PackageError: one line: what is wrong with it, and what is allowed.
    """
    whose = CRITERION.entry(place)
    if not isinstance(entry, CriterionEntry) or entry.name != place:
        raise PackageError(f"{whose}: is {entry!r:.100}; it must be a CriterionEntry of that name")
    for field, kind in _KINDS.items():
        if not isinstance(value := getattr(entry, field), kind):
            raise PackageError(f"{whose}: {field} is {value!r:.100}; it must be a {kind.__name__}")
    wrong = {
        "name": not re.fullmatch("[a-z][a-z0-9_]{0,40}", entry.name) or entry.name in NO_CRITERION,
        "rate": not re.fullmatch("[a-z][a-z0-9_]{0,40}", entry.rate)
        or entry.rate in (*NUMBERS, *(own.rate for own in _OURS))
        or bool(OTHER_KEYS.fullmatch(entry.rate)),
        "heading": not entry.heading.isprintable()
        or entry.heading in ("", *(own.heading for own in _OURS)),
        "color": not re.fullmatch("#[0-9a-f]{6}", entry.color),
        "applies": entry.applies is not None and not callable(entry.applies),
        "function": not re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", entry.function),
        "unit": entry.unit not in UNITS,
        "splits": not entry.splits or not set(entry.splits) <= set(SPLITS),
        "since": not entry.since,
        "asked": entry.asked,
        "behind": entry.behind not in ("", *(own.name for own in _OURS)),
    }
    if bad := [field for field, is_wrong in wrong.items() if is_wrong]:
        value = getattr(entry, bad[0])
        raise PackageError(
            f"{whose}: {bad[0]} is {value!r:.100}; name: small letters, none of {', '.join(NO_CRITERION)}, rate: small letters,"
            f" and the key of no other number, heading: of no other criterion, color: #rrggbb, function: module:function, unit:"
            f" {' or '.join(UNITS)}, splits: one of {', '.join(SPLITS)} or both (`applies` says for which objects), since: the"
            " version that judges by it first, asked: False (benchmarks ask for ours alone), behind: one of ours, or empty"
        )
    return entry


def _declared() -> tuple[CriterionEntry, ...]:
    """Those of other packages.

    Raises:
        PackageError: one is wrong, or two have one rate or heading.
    """
    found = [_checked(CRITERION[name], name) for name in CRITERION.declared]
    for k, entry in enumerate(found):
        for other in found[:k]:
            for field in ("rate", "heading"):
                if getattr(entry, field) == getattr(other, field):
                    raise PackageError(
                        f"{CRITERION.entry(entry.name)}: its {field} {getattr(entry, field)!r} is that of"
                        f" {CRITERION.entry(other.name)}; rename it in one of the packages, or uninstall one"
                    )
    return tuple(found)


_ALL = (*_OURS, *_declared())

REGISTRY = tuple(entry for entry in _ALL if not entry.asked)
"""The criteria of every benchmark."""

CRITERIA = tuple(entry.name for entry in REGISTRY)
"""Column order of every (B, C) tensor of criteria."""

ASKED = tuple(entry for entry in _ALL if entry.asked)
"""Criteria that a benchmark asks for beside `CRITERIA`: others judge by none of them."""

UNTIL: tuple[Literal["present", "received"], ...] = ("present", "received")
"""Where a benchmark that asks for `ASKED` may end: with the arm at rest, or once the person has the object."""

EVERY = (*REGISTRY, *ASKED)
"""All criteria. The columns of (B, C) tensors are in this order, without those that a benchmark does not ask for. Stored
columns, rates, headings, charts and re-scoring follow it."""

ASKED_NAMES = tuple(entry.name for entry in ASKED)

MAY_ASK = tuple(
    names
    for n in range(len(ASKED_NAMES) + 1)
    for names in combinations(ASKED_NAMES, n)
    if "received" not in names or "pick" in names
)
"""What a benchmark may ask for: some of `ASKED_NAMES`, in their order. A person can take what was picked up alone."""


def criteria_of(asks: Sequence[str]) -> tuple[CriterionEntry, ...]:
    """The criteria of a benchmark, in the order of their columns.

    Args:
        asks: those of `ASKED_NAMES` that it asks for.
    """
    return tuple(entry for entry in EVERY if not entry.asked or entry.name in asks)


def _in_order(entries: Sequence[CriterionEntry]) -> tuple[CriterionEntry, ...]:
    found = [entry for entry in entries if not entry.behind]
    for entry in (e for e in entries if e.behind):
        found.insert(1 + [e.name for e in found].index(entry.behind), entry)
    return tuple(found)


IN_ORDER = _in_order(EVERY)
"""All criteria in the order in which the first failure is looked for: a grasp is held, then picked; what is presented is
received."""

PAPER = tuple(entry.name for entry in REGISTRY if not entry.since)
"""Those of the paper: files of the authors' release know no others."""

MOST_SECONDS = 1e9
"""A stored time is at most this long (30 years): what is longer was made up."""


class Outcome(IntEnum):
    """A trial's verdict: success, the first criterion that failed (its place in `EVERY` + 1), or
    why it was not judged. Rows store names, so that numbers may change when a criterion is added."""

    SUCCESS = 0
    STABILITY = 1
    PLAN = 2
    REACH = 3
    AFFORDANCE = 4
    SAFE = 5
    vars().update({entry.name.upper(): 6 + k for k, entry in enumerate(EVERY[5:])})
    INVALID_INPUT = len(EVERY) + 1
    INVALID_SIM = len(EVERY) + 2


if [o.name.lower() for o in Outcome][1:-2] != [entry.name for entry in EVERY]:
    raise ValueError(f"new criteria stand behind {CRITERIA[4]}; REGISTRY has {', '.join(CRITERIA)}")


class MarginKind(IntEnum):
    """Meaning of a stored margin (`Scores.margin_kind`). Averages of margins leave `CAP` out."""

    NONE = 0
    """Not evaluated: there is no margin."""
    DISTANCE = 1
    """A length, to 0.1 mm, or an angle: a clearance or a width; how far a target is out of reach."""
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


class Nearer(IntEnum):
    """What Presented's margin is about: the ball that the wanted part has to meet, or what comes to the palm beside it."""

    BALL = 0
    GRIPPER = 1
    SHARP = 2


class Room(IntEnum):
    """What is left free where a person takes the object (`judge.reception`): the least is Received's margin."""

    HAND = 0
    """Of hand and gripper: at the grasp beyond 0.5 mm, on the way there to touching."""
    BODY = 1
    """Of arm, torso and head beside the robot, and of the head beside the object: at the grasp beyond 0.1 mm, on the way there
    to touching."""
    REACH = 2
    """How much longer the arm is than it is stretched at the grasp."""
    JOINTS = 3
    """How far forearm, elbow and wrist are within their ranges there."""


class ReceiveReason(IntEnum):
    """Why nobody can take the object: the step of reception that the last of the receiving grasps fails
    (`judge.reception.STEPS`). WHOLE_WAY: the hand has no free way to any that passes them. NO_GRASP: none is known for
    this object and hand."""

    OK = 0
    ARM = 1
    FREE = 2
    WAY = 3
    CLEAR = 4
    RELEASE = 5
    HOLD = 6
    WHOLE_WAY = 7
    NO_GRASP = 8


class PickReason(IntEnum):
    """Why an object cannot be picked: the first of these that holds."""

    OK = 0
    OUT_OF_REACH = 1
    GRASP_COLLIDES = 2
    NO_STRAIGHT_WAY = 3
    APPROACH_COLLIDES = 4
    NOTHING_BETWEEN_PADS = 5
    NOT_HELD = 6
    CLOSING_COLLIDES = 7
    LIFT_COLLIDES = 8
    START_IN_COLLISION = 9
    BEFORE_COLLIDES = 10
    NO_PATH_IN_BUDGET = 11
    NOT_EVALUATED = 12
    PATH_COLLIDES = 13
