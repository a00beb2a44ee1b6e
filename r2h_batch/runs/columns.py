"""The table of stored columns: name, type, unit, meaning, and the version that stored it first.

Schemas (`schema_of_kind`), the reading of older rows (`later`) and the tables of the site's page of files
(`tools/columns.py`) follow it. A new column is one entry here. Its value is the attribute of `Scores`
with its name, unless `runs/rows.py` makes it from several.
"""

from collections.abc import Container, Iterable
from typing import NamedTuple

import pyarrow as pa

from r2h_batch.verdicts import (
    EVERY,
    CollidingPair,
    CriterionEntry,
    Nearer,
    PickReason,
    PlanReason,
    ReceiveReason,
    Room,
)

NAME = pa.dictionary(pa.int32(), pa.string())
"""A word: of a name or of an enumeration, in lower case."""
POSE = pa.list_(pa.float32(), 16)
"""A row-major 4x4 matrix."""
POSTURE = pa.list_(pa.float32(), 6)
"""Joint angles: six, or as many as the run's robot has joints (`schema_of_kind`)."""
POSTURES = pa.list_(POSTURE)
POINT = pa.list_(pa.float32(), 3)


class Column(NamedTuple):
    """One stored column.

    Attributes:
        name: in the Parquet file.
        type: in the Parquet file, for an arm of six joints.
        meaning: one or two sentences for the page of files.
        unit: m, s, deg, rad, m/s, N, years; empty: it has none.
        nullable: whether a row may lack a value.
        since: the first version of the package that stores it; empty: every version does. Rows of older
            versions are read with null here.
        asked: the criterion without which a run has no such column: one that not all benchmarks ask for.
    """

    name: str
    type: pa.DataType
    meaning: str
    unit: str = ""
    nullable: bool = True
    since: str = ""
    asked: str = ""


ENDS = ("running", "success", "contact", "collision", "drop", "not_received", "timeout")
"""How an episode of a closed loop ends, in the order of `closed_loop.env.End`."""


def _words(names: Iterable[str]) -> str:
    return ", ".join(f"`{name.lower()}`" for name in names)


FLOAT, BOOL = pa.float32(), pa.bool_()
_FAILURES = _words(entry.name for entry in EVERY)
_PAIRS = _words(pair.name for pair in CollidingPair if pair != CollidingPair.NONE)
_REASONS = _words(reason.name for reason in PlanReason)


def _asked(entry: CriterionEntry) -> str:
    return entry.name if entry.asked else ""


# fmt: off
_ID = Column("trial_id", pa.int64(), "number of the trial, in the benchmark's order", nullable=False)
_OBJECT = Column("object", NAME, "name of the object", nullable=False)
_HAND = Column("hand_index", pa.int32(), "row of the hand set", nullable=False)
_OPENING = Column("opening_m", FLOAT, "gap between the pads on the object", "m")
_GOAL = Column("q_goal", POSTURE, "joint goal; null: no goal", "rad")
_TIMES = Column("time_s", pa.list_(FLOAT), "times of the waypoints, from the start", "s", False)
_POSES = (
    Column("T_obj_ee", POSE, "grasp: ee in the object's frame, row-major 4x4", "m", False),
    Column("T_world_ee", POSE, "handover pose: ee in the world, row-major 4x4", "m", False),
)

TRIALS = (
    _ID,
    _OBJECT,
    Column("split", NAME, "`S0` or `S1`", nullable=False),
    Column("side", NAME, "the receiving hand: `right` or `left`", nullable=False),
    Column("outcome", NAME,
           f"`success`, the first failure ({_FAILURES}), `invalid_input`, `invalid_sim`, or `missing`: no answer",
           nullable=False),
    *(Column(entry.passed_column, BOOL, "whether the criterion passed; null: not evaluated", since=entry.since,
             asked=_asked(entry))
      for entry in EVERY),
    *(Column(entry.margin_column, FLOAT,
             "positive when the criterion passes, except for Plan with [sampled edges](choices.md#plan)", entry.unit,
             since=entry.since, asked=_asked(entry))
      for entry in EVERY),
    *(Column(entry.kind_column, NAME,
             "[`distance`, `bound` or `cap`](choices.md#margins). Leave caps out of averages",
             since=entry.since or "0.2.0", asked=_asked(entry))
      for entry in EVERY),
    Column("plan_reason", NAME,
           f"why Plan passed or failed: {_REASONS}. `motion_*` and `beyond_*`: of motions from a file"),
    Column("plan_pair", NAME,
           f"the pair that collides at start or goal: {_PAIRS}. With `--receiver body` arm, torso and head are `hand`"),
    Column("nearest_pair", NAME, "the nearest pair along a path; null beyond 5 cm", since="0.2.0"),
    Column("pick_reason", NAME, f"[why Pick passed or failed](r2h_v3.md#pick): {_words(r.name for r in PickReason)}",
           since="0.3.0", asked="pick"),
    Column("pick_pair", NAME, "the pair that Pick's margin is about; null where no two bodies decide", since="0.3.0",
           asked="pick"),
    Column("pick_part", NAME, "robot part of that pair", since="0.3.0", asked="pick"),
    Column("received_reason", NAME,
           f"[why the person cannot take it](r2h_v3.md#received): {_words(r.name for r in ReceiveReason)}; null: not judged",
           since="0.3.0", asked="received"),
    Column("received_grasps", pa.int32(), "receiving grasps that pass every step", since="0.3.0", asked="received"),
    Column("received_by", NAME,
           f"what [Received's margin](r2h_v3.md#received) is of: {_words(r.name for r in Room)}; null: not received",
           since="0.4.0", asked="received"),
    Column("width_m", FLOAT, "extent along y of the material between the pads; null: no material", "m", since="0.2.0"),
    Column("borderline", BOOL, "[a margin is within 0.1 mm of its threshold](choices.md#margins)"),
    Column("presented_margin_m", FLOAT,
           "margin of [Presented](choices.md#presented), whether or not the benchmark asks for it: 0 and more passes; null: not"
           " judged", "m", since="0.4.0"),
    Column("presented_by", NAME, f"what that margin is about: {_words(n.name for n in Nearer)}", since="0.4.0"),
    Column("tilt_deg", FLOAT, "angle between an open vessel's opening and the world's up; null: no vessel", "deg",
           since="0.4.0"),
    Column("t_plan_s", FLOAT, "wall time of planning a batch / its size; null: planning did not run", "s"),
    Column("t_exec_s", FLOAT, "until the arm stays at its goal; null: no path", "s"),
    Column("t_method_s", FLOAT, "the method's own time, as it says; else the sweep's time for a chunk / its trials", "s"),
    Column("body_m", FLOAT,
           "trials of people: distance of the robot to the receiver's arm, torso and head (to 0.3.0: arm and torso). Exact below"
           " 5 cm; 0.05 beyond. Negative: they overlap by at least this much", "m", since="0.2.0"),
    Column("age_years", FLOAT, "the receiver's age; null here and below: a sweep without `people`", "years", since="0.2.0"),
    Column("sex", NAME, "`male` or `female`", since="0.2.0"),
    Column("stature_m", FLOAT, "the receiver's stature", "m", since="0.2.0"),
    Column("hand_length_m", FLOAT, "from the wrist to the tip of the straight middle finger", "m", since="0.2.0"),
    Column("seated", BOOL, "whether the receiver sits", since="0.2.0"),
    Column("redrawn", FLOAT, "people drawn before in vain: no posture of theirs fitted", since="0.2.0"),
)

DETAILS = (
    _ID,
    _HAND,
    Column("width_m", FLOAT, "as in trials", "m"),
    _OPENING,
    Column("grasp_shift_m", FLOAT, "how far closing moves the object along y", "m"),
    Column("slip_m", FLOAT, "slip of the object in the shake (`--stability physics`); null: not shaken", "m"),
    _GOAL,
    Column("witness_plan_part", NAME, "robot part of Plan's smallest clearance"),
    Column("witness_safe_part", NAME, "robot part of Safe's smallest clearance"),
    Column("witness_time_s", FLOAT, "when Safe's smallest clearance occurs", "s"),
    Column("witness_point_m", POINT, "where Safe's smallest clearance occurs, in the world", "m"),
)

POSES = (_ID, *_POSES)

PATHS = (
    _ID,
    _GOAL,
    _TIMES,
    Column("q", POSTURES, "postures at these times", "rad", False),
    Column("executed_q", POSTURES,
           "the simulated motion, from time 0 every `motion.sample_s` of run.json; null with `--execute.sim none`", "rad"),
    Column("planned_q", POSTURES, "the plan behind a motion from a file; null: `q` is the plan", "rad"),
)

EPISODES = (
    _ID,
    Column("end", NAME, f"how the episode ended: {_words(ENDS[1:])}", nullable=False),
    Column("robot_touched", BOOL, "whether the robot caused the contact, not the hand; null: no contact"),
    Column("time_s", FLOAT, "end of the episode; of a success the handover", "s", False),
    Column("least_m", FLOAT, "least distance of robot and hand at the steps, until the hand sets out to take the object;"
           " with `--receiver body` of arm, torso and head too", "m", False),
    Column("slack_m", FLOAT, "between steps the distance is at most this much below `least_m`", "m", False),
    Column("near_speed_m_s", FLOAT, "largest speed of the robot near the hand, a bound for its fastest point", "m/s", False),
    Column("ssm_s", FLOAT, "how long robot and hand were nearer than ISO/TS 15066's protective distance", "s", False),
    Column("ssm_depth_m", FLOAT, "largest shortfall from that protective distance", "m", False),
    Column("pfl_share", FLOAT,
           "`near_speed_m_s` / the speed that reaches ISO/TS 15066's transient force limit of a hand", "", False),
    Column("robot_idle", FLOAT, "share of the time in which the robot stands", "", False),
    Column("human_idle", FLOAT, "share of the time in which the hand stands", "", False),
    Column("concurrent", FLOAT, "share of the time in which both move", "", False),
    Column("delay", FLOAT, "share of the time in which neither moves", "", False),
    Column("hand_path_m", FLOAT, "length of the wrist's path", "m", False),
    Column("overlap_m", FLOAT, "largest overlap of hand and gripper while the hand takes the object; 0: none", "m",
           since="0.2.0"),
)

SEES = (
    _ID,
    Column("t_sees_s", FLOAT, "wall time of looking at a chunk / its trials", "s", False),
    Column("seen_px", pa.int32(), "pixels of all cameras with the object's label and a depth", "", False),
    Column("seen_share", FLOAT, "share of the object's surface with a seen point within 8 mm", "", False),
    Column("pick", BOOL,
           "whether some posture takes the object up where it lay: in reach, and with the object lifted by 5 mm free of table"
           " and person; null: the answer is no pose"),
)

FAILURES = (
    _ID,
    _OBJECT,
    _HAND,
    Column("T_world_hand", POSE, "the hand in the world, row-major 4x4", "m", False),
    *_POSES,
    _OPENING,
    _TIMES,
    Column("q", POSTURES, "postures at these times: the reference of the simulation", "rad", False),
    Column("executed_q", POSTURES, "the simulated motion up to the failure, NaN and all", "rad"),
    Column("failed_state", pa.list_(pa.float64()), "qpos, then qvel of the model before the failure"),
)
# fmt: on

TABLES = {
    "trials": TRIALS,
    "details": DETAILS,
    "poses": POSES,
    "paths": PATHS,
    "episodes": EPISODES,
    "sees": SEES,
    "failures": FAILURES,
}
"""Kind of table in a run folder -> its columns, in order."""


PRESENTED_BEFORE = "presented"
"""The column that said before 0.4 whether the receiver's region faces the palm, seen from the TCP, within reach. Presented asks
for something else, and no table mixes the two."""

BEFORE = {
    "borderline": {
        PRESENTED_BEFORE: BOOL,
        "presented_angle_deg": FLOAT,
        "presented_distance_m": FLOAT,
    }
}
"""A column of the trials -> those behind it that versions before 0.4 stored."""

UNREAD = {
    "passed_received": {"passed_taken": BOOL},
    "margin_received_m": {"margin_taken_m": FLOAT},
    "margin_kind_received": {"margin_kind_taken": NAME},
    "received_grasps": {
        "transfer_end": NAME,
        "transfer_undecided": BOOL,
        **dict.fromkeys(
            ("transfer_slip_m", "transfer_turn_deg", "transfer_pull_n", "transfer_s"), FLOAT
        ),
    },
}
"""A column of the trials -> the columns behind it that r2h_batch 0.3 stored for benchmarks that asked for Taken. Nobody reads
them any more; the digests of such rows cover them."""


def schema_of_kind(
    kind: str, joints: int = 6, asks: Container[str] = (), *, unread: bool = False
) -> pa.Schema:
    """The Arrow schema of a kind of table.

    Args:
        kind: a key of `TABLES`.
        joints: of the run's robot; the length of postures.
        asks: criteria that the run's benchmark asks for beside those of all.
        unread: with the columns that only older rows have (`BEFORE`, `UNREAD`).
    """
    older = {}
    if unread and kind == "trials":
        older = BEFORE | (UNREAD if "taken" in asks else {})
    fields = []
    for c in TABLES[kind]:
        if c.asked and c.asked not in asks:
            continue
        fields.append(pa.field(c.name, _sized(c.type, joints), c.nullable))
        fields += [pa.field(name, type_) for name, type_ in older.get(c.name, {}).items()]
    return pa.schema(fields)


def _sized(kind: pa.DataType, joints: int) -> pa.DataType:
    """The type with postures of this many joints."""
    posture = pa.list_(pa.float32(), joints)
    return {POSTURE: posture, POSTURES: pa.list_(posture)}.get(kind, kind)


def later(kind: str) -> dict[str, str]:
    """Columns of a kind that older rows may lack -> the first version that stores them."""
    return {c.name: c.since for c in TABLES[kind] if c.since}


def earlier(kind: str) -> tuple[str, ...]:
    """Columns of a kind that rows of this version lack."""
    return tuple(n for more in BEFORE.values() for n in more) if kind == "trials" else ()
