"""The registry of all that tables say in numbers: rates of outcomes, mean times, shares of rows. What each counts and of which
rows, its words, its unit, and whether more of it is better."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import pyarrow as pa
import pyarrow.compute as pc

from r2h_batch.config import BORDERLINE_M, UPRIGHT_DEG
from r2h_batch.plugins import Registry
from r2h_batch.runs import columns
from r2h_batch.verdicts import ASKED, OTHER_KEYS, REGISTRY, CriterionEntry, Outcome


@dataclass(frozen=True)
class Share:
    """A number of tables; as packages name it (`share.NAME`) a share of a method's rows, no part of SR.

    Attributes:
        heading: in tables.
        caption: what is counted, of which rows; a sentence.
        needs: stored columns of trials that it is made of; rows of older versions have null there.
        of: a table with these columns -> (N,) bool, whether the row counts; null: the row is not of those. None: no
            stored column says it.
        outcomes: those that it counts, of all planned trials. Each outcome is in exactly one rate, so these sum to 100.
        criterion: that fails first in these trials.
        unit: percent of rows, or mean seconds.
        higher: whether more is better; None: neither is.
    """

    heading: str
    caption: str
    needs: tuple[str, ...] = ()
    of: Callable[[pa.Table], pa.ChunkedArray] | None = None
    outcomes: tuple[str, ...] = ()
    criterion: CriterionEntry | None = None
    unit: str = "%"
    higher: bool | None = None

    @property
    def is_share(self) -> bool:
        """Whether it is of rows that it chooses itself, so no part of the sum of the outcomes."""
        return not self.outcomes and self.unit == "%"


def _failure(entry: CriterionEntry) -> Share:
    caption = f"Trials that fail {entry.name.capitalize()} first."
    return Share(entry.heading, caption, outcomes=(entry.name,), criterion=entry, higher=False)


def _time(heading: str, caption: str) -> Share:
    return Share(heading, caption, unit="s", higher=False)


def _of_successes(rows: pa.Table, passes: pa.ChunkedArray) -> pa.ChunkedArray:
    success = pc.equal(rows["outcome"].cast(pa.string()), Outcome.SUCCESS.name.lower())
    return pc.if_else(success, passes, None)


def _presented(rows: pa.Table) -> pa.ChunkedArray:
    return _of_successes(rows, pc.greater_equal(rows["presented_margin_m"], 0))


def _upright(rows: pa.Table) -> pa.ChunkedArray:
    return _of_successes(rows, pc.less_equal(rows["tilt_deg"], UPRIGHT_DEG))


def _presented_before(rows: pa.Table) -> pa.ChunkedArray:
    return rows[columns.PRESENTED_BEFORE]


def _body_met(rows: pa.Table) -> pa.ChunkedArray:
    return pc.less(rows["body_m"], 0)


def _through(rows: pa.Table) -> pa.ChunkedArray:
    """By more than float32's doubt."""
    return _of_successes(rows, pc.less(rows["margin_plan_m"], -BORDERLINE_M))


THROUGH = "through"
PICK = "pick"
PRESENTED, UPRIGHT, PRESENTED_BEFORE = "presented", "upright", "presented_before_0_4"

_OURS = (
    ("sr", Share("SR", "Trials that succeed.", outcomes=("success",), higher=True)),
    ("t_plan_s", _time("T_plan", "Planning time of a batch, divided by its trials.")),
    ("t_exec_s", _time("T_exec", "Trials whose arm came to rest at its goal.")),
    ("t_tot_s", _time("T_tot", "T_plan and T_exec.")),
    ("t_method_s", _time("T_method", "The method's own time per trial.")),
    *((e.rate, _failure(e)) for e in (*sorted(REGISTRY, key=lambda e: e.column), *ASKED)),
    (
        "invalid",
        Share(
            "invalid", "Trials not judged.", outcomes=("invalid_input", "invalid_sim"), higher=False
        ),
    ),
    ("missing", Share("missing", "Trials without an answer.", outcomes=("missing",), higher=False)),
    (
        PRESENTED,
        Share(
            "Presented",
            "Successes whose wanted part comes to the hand first, before gripper and sharp parts (not in SR).",
            ("outcome", "presented_margin_m"),
            _presented,
        ),
    ),
    (
        UPRIGHT,
        Share(
            "Upright",
            f"Successes with an open vessel (cup, bowl, wineglass) whose opening is within {UPRIGHT_DEG:g} degrees of up (not in"
            " SR).",
            ("outcome", "tilt_deg"),
            _upright,
        ),
    ),
    (
        PRESENTED_BEFORE,
        Share(
            "Presented, before 0.4",
            "Trials of S1, failed ones too, whose region faces the palm within 90 degrees, seen from the TCP, and in reach (not"
            " in SR).",
            (columns.PRESENTED_BEFORE,),
            _presented_before,
        ),
    ),
    (
        "body_met",
        Share(
            "Body met",
            "Motions that meet the receiver's arm, torso or head, or come nearer to the head than the benchmark allows (to 0.3.0:"
            " arm or torso; part of Safe with --receiver body).",
            ("body_m",),
            _body_met,
        ),
    ),
    (
        THROUGH,
        Share(
            "Through",
            "Successes whose path passes through something by more than 0.1 mm between two samples (edge_check moveit).",
            ("outcome", "margin_plan_m"),
            _through,
        ),
    ),
    (
        PICK,
        Share(
            "Pick posture",
            "Trials of a method that sees in which some posture takes the object up where it lay (not in SR).",
        ),
    ),
)


_COLUMNS = frozenset(column.name for column in columns.TRIALS)


def _no_share(name: str, thing: object) -> str:
    """What is wrong with a share of another package."""
    if name in dict(_OURS):
        return ""
    if not isinstance(thing, Share) or not (thing.of is None or callable(thing.of)):
        return f"is {thing!r:.100}; it must be a Share whose `of` is a function of a table"
    if not thing.is_share:
        return "counts outcomes or seconds; a package's share is of rows that it chooses itself"
    if (
        OTHER_KEYS.fullmatch(name)
        or not re.fullmatch("[a-z][a-z0-9_]{0,40}", name)
        or name in _COLUMNS
    ):
        return (
            f"tables keep the name {name!r} for another value (a stored column, n_..., sr_..., ..._low, ..._high, ..._of), or it"
            " is not of small letters; rename it"
        )
    for field in ("heading", "caption"):
        value = getattr(thing, field)
        if not isinstance(value, str) or not value.isprintable() or not value:
            return f"{field} is {value!r:.100}; it must be a text of one line"
    if thing.heading in {own.heading for _, own in _OURS}:
        return f"its heading {thing.heading!r} is that of another number; rename it"
    if not isinstance(thing.needs, tuple) or (
        unknown := [c for c in thing.needs if c not in _COLUMNS]
    ):
        shown = thing.needs if not isinstance(thing.needs, tuple) else unknown[0]
        return f"needs names {shown!r:.100}; it must be a tuple of stored columns of trials"
    return "" if thing.higher in (None, True, False) else "higher must be True, False or None"


RATES: Registry[Share] = Registry("share", wrong=_no_share)
"""Key in csv and json -> what it is: ours, those of criteria that packages name as `criterion.NAME`, and shares that they
name as `share.NAME`. A name that is taken is refused."""
for _name, _rate in _OURS:
    RATES.add(_name, _rate)

FAILURES = {n: r.criterion for n, r in _OURS if r.criterion and r.criterion not in ASKED}
"""Rate of first failures -> its criterion, in the order of Table I's columns."""

ASKED_FAILURES = {n: r.criterion for n, r in _OURS if r.criterion and r.criterion in ASKED}
"""The same of criteria that not all benchmarks ask for; lines of the others have no such rate."""

PARTIAL = {n: entry for n, entry in FAILURES.items() if entry.applies is not None}
"""Those of criteria for some objects: rates of the trials that they concern."""

OF_ALL = {n: r.outcomes for n, r in _OURS if r.outcomes and n not in ASKED_FAILURES}
"""Rate of all planned trials -> the outcomes that it counts."""

TIMES = tuple(n for n, r in _OURS if r.unit == "s")


def shares() -> dict[str, Share]:
    """The shares of rows: ours, then those of other packages.

    Raises:
        PackageError: another package's is wrong, or has a name that is taken.
    """
    return {name: RATES[name] for name in RATES if RATES[name].is_share}
