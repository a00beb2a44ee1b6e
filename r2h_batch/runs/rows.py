"""Scores as table rows: the documented Parquet schemas of a run folder and the way from tensors to
them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from r2h_batch.verdicts import (
    CRITERIA,
    SIDES,
    SPLITS,
    CollidingPair,
    MarginKind,
    Outcome,
    PlanReason,
)

if TYPE_CHECKING:  # readers of rows need no torch
    from r2h_batch.closed_loop.env import Episodes
    from r2h_batch.types import Predictions, Scores, Trials

MISSING = max(Outcome) + 1
"""Outcome code of a planned trial for which the method gave no prediction: it counts as a failure
of its own kind."""

OUTCOME_NAMES = (*(o.name.lower() for o in Outcome), "missing")
"""Name of every outcome code, in order."""

KINDS = tuple(k.name.lower() for k in MarginKind if k != MarginKind.NONE)
"""Name of every kind of margin, in order from code 1."""

_NAME = pa.dictionary(pa.int32(), pa.string())
_POSE = pa.list_(pa.float32(), 16)

ENDS = ("running", "success", "contact", "collision", "drop", "not_received", "timeout")
"""How an episode of a closed loop ends, in the order of `closed_loop.env.End`."""

EPISODE_NUMBERS = (
    "time_s", "least_m", "slack_m", "near_speed_m_s", "ssm_s", "ssm_depth_m", "pfl_share", "robot_idle", "human_idle",
    "concurrent", "delay", "hand_path_m",
)  # fmt: skip

TRIAL_SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("object", _NAME, nullable=False),
        pa.field("split", _NAME, nullable=False),
        pa.field("side", _NAME, nullable=False),  # of the receiving hand: right, left
        pa.field("outcome", _NAME, nullable=False),  # OUTCOME_NAMES
        *(pa.field(f"passed_{c}", pa.bool_()) for c in CRITERIA),  # null: not evaluated
        # positive: passes; null: none is defined
        *(pa.field(f"margin_{c}_m", pa.float32()) for c in CRITERIA),
        # distance, bound or cap (verdicts.MarginKind); null: no margin
        *(pa.field(f"margin_kind_{c}", _NAME) for c in CRITERIA),
        pa.field("plan_reason", _NAME),  # verdicts.PlanReason
        # what met where Plan failed: verdicts.CollidingPair, null: none
        pa.field("plan_pair", _NAME),
        # what is nearest along a path: verdicts.CollidingPair, null: none below 5 cm
        pa.field("nearest_pair", _NAME),
        pa.field("width_m", pa.float32()),  # of the material between the pads; null: nothing there
        pa.field("borderline", pa.bool_()),
        pa.field("presented", pa.bool_()),  # null: the object has no receiver's region
        pa.field("presented_angle_deg", pa.float32()),
        pa.field("presented_distance_m", pa.float32()),
        # amortised: batch wall time / B; null: planning did not run
        pa.field("t_plan_s", pa.float32()),
        pa.field("t_exec_s", pa.float32()),  # null: no path
        pa.field("t_method_s", pa.float32()),  # null: not measured
        # robot to the receiver's arm and torso; null: no body, or no motion
        pa.field("body_m", pa.float32()),
    ]
)
LATER_COLUMNS = (
    *(f"margin_kind_{c}" for c in CRITERIA),
    *("nearest_pair", "width_m", "presented", "presented_angle_deg"),
    *("presented_distance_m", "body_m"),
)
"""Columns of `TRIAL_SCHEMA` that older runs lack; they are read as null there."""

DETAIL_SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("hand_index", pa.int32(), nullable=False),
        pa.field("width_m", pa.float32()),
        pa.field("opening_m", pa.float32()),
        pa.field("grasp_shift_m", pa.float32()),
        pa.field("slip_m", pa.float32()),  # in the shake; null: not shaken
        pa.field("q_goal", pa.list_(pa.float32(), 6)),  # rad, UR order; null: no goal
        # robot part of Plan's and of Safe's smallest clearance
        pa.field("witness_plan_part", _NAME),
        pa.field("witness_safe_part", _NAME),
        pa.field("witness_time_s", pa.float32()),  # of Safe's
        pa.field("witness_point_m", pa.list_(pa.float32(), 3)),  # of Safe's, world frame
    ]
)
POSE_SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("T_obj_ee", _POSE, nullable=False),  # row-major 4x4
        pa.field("T_world_ee", _POSE, nullable=False),
    ]
)
PATH_SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("q_goal", pa.list_(pa.float32(), 6)),
        pa.field("time_s", pa.list_(pa.float32()), nullable=False),  # W
        pa.field("q", pa.list_(pa.list_(pa.float32(), 6)), nullable=False),  # W x 6 rad, UR order
        # every run.json motion.sample_s; null: not simulated
        pa.field("executed_q", pa.list_(pa.list_(pa.float32(), 6))),
        # of motions in a file: the plan, where q is what was executed; null: q is the plan
        pa.field("planned_q", pa.list_(pa.list_(pa.float32(), 6))),
    ]
)

EPISODE_SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("end", _NAME, nullable=False),  # ENDS
        pa.field("robot_touched", pa.bool_()),  # null: no contact
        *(pa.field(name, pa.float32(), nullable=False) for name in EPISODE_NUMBERS),
    ]
)
"""A row for each answered trial of a closed loop; columns as in `closed_loop.env.Episodes`."""

FAILURE_SCHEMA = pa.schema(
    [
        pa.field("trial_id", pa.int64(), nullable=False),
        pa.field("object", _NAME, nullable=False),
        pa.field("hand_index", pa.int32(), nullable=False),
        pa.field("T_world_hand", _POSE, nullable=False),  # row-major 4x4
        pa.field("T_obj_ee", _POSE, nullable=False),
        pa.field("T_world_ee", _POSE, nullable=False),
        pa.field("opening_m", pa.float32()),
        pa.field("time_s", pa.list_(pa.float32()), nullable=False),  # W
        # W x 6 rad: the reference
        pa.field("q", pa.list_(pa.list_(pa.float32(), 6)), nullable=False),
        # what the simulator made of it, NaN and all
        pa.field("executed_q", pa.list_(pa.list_(pa.float32(), 6))),
        # qpos and qvel of the model before it failed
        pa.field("failed_state", pa.list_(pa.float64())),
    ]
)
"""Everything needed to run a trial again whose simulation failed, and how far it came."""


@dataclass(frozen=True)
class TrialNames:
    """Names behind the indices of `Trials` and `Scores`: objects with their splits, sides of hands,
    robot parts."""

    objects: Sequence[str]
    object_splits: Sequence[str]
    hand_sides: Sequence[str]
    parts: Sequence[str] = ()

    @classmethod
    def of(cls, scene: Any) -> "TrialNames":
        """Of the rows that are judged in a `Scene`."""
        return cls(
            objects=[o.name for o in scene.objects],
            object_splits=[o.split for o in scene.objects],
            hand_sides=[SIDES[s] for s in scene.hands.set.side.tolist()],
            parts=scene.part_names,
        )


def _array(values: Any) -> np.ndarray:
    return values.detach().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)


def _named(codes: Any, names: Sequence[str]) -> pa.DictionaryArray:
    """Dictionary column; a code outside the names is null."""
    codes = _array(codes).astype(np.int32)
    outside = (codes < 0) | (codes >= len(names))
    return pa.DictionaryArray.from_arrays(
        pa.array(codes, mask=outside), pa.array(list(names), pa.string())
    )


def _floats(values: Any) -> pa.Array:
    """float32 column, NaN as null."""
    return pa.array(_array(values).astype(np.float32), pa.float32(), from_pandas=True)


def _vectors(values: Any) -> pa.Array:
    """Column of fixed-size lists from (B, n); a row with NaN in it is null."""
    values = _array(values).astype(np.float32)
    flat = pa.array(values.reshape(-1), pa.float32())
    mask = pa.array(np.isnan(values).any(axis=1), pa.bool_())
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1], mask=mask)


def _trial_columns(trials: "Trials", names: TrialNames) -> dict[str, Any]:
    objects = _array(trials.object_index)
    split_of = np.array([SPLITS.index(s) for s in names.object_splits], np.int32)
    side_of = np.array([SIDES.index(s) for s in names.hand_sides], np.int32)
    return {
        "trial_id": pa.array(_array(trials.trial_id), pa.int64()),
        "object": _named(objects, names.objects),
        "split": _named(split_of[objects], SPLITS),
        "side": _named(side_of[_array(trials.hand_index)], SIDES),
    }


_SCORE_FLOATS = (
    *("width_m", "presented_angle_deg", "presented_distance_m"),
    *("t_plan_s", "t_exec_s", "body_m"),
)


def score_rows(
    trials: "Trials", scores: "Scores", names: TrialNames, t_method_s: Any = None
) -> pa.Table:
    """Rows of `TRIAL_SCHEMA` for B scored trials; `t_method_s` (B,) or None where it was not
    measured."""
    ids = _array(scores.trial_id)
    if not np.array_equal(ids, _array(trials.trial_id)):
        raise ValueError("scores and trials must have the same trial_id in the same order")
    passed, evaluated, margin, kind = (
        _array(getattr(scores, k)) for k in ("passed", "evaluated", "margin", "margin_kind")
    )
    pair, has_path = _array(scores.plan_pair).astype(np.int32), _array(scores.path_len) > 0
    pairs = [p.name.lower() for p in CollidingPair]
    seconds = np.full(len(ids), np.nan, np.float32) if t_method_s is None else t_method_s
    nowhere = np.isnan(_array(scores.presented_angle_deg))
    columns = {
        **_trial_columns(trials, names),
        "outcome": _named(scores.outcome, OUTCOME_NAMES),
        "plan_reason": _named(scores.plan_reason, [r.name.lower() for r in PlanReason]),
        "plan_pair": _named(np.where(has_path | (pair == CollidingPair.NONE), -1, pair), pairs),
        "nearest_pair": _named(np.where(has_path & (pair != CollidingPair.NONE), pair, -1), pairs),
        "borderline": pa.array(_array(scores.borderline), pa.bool_()),
        "presented": pa.array(_array(scores.presented), pa.bool_(), mask=nowhere),
        "t_method_s": _floats(seconds),
        **{name: _floats(getattr(scores, name)) for name in _SCORE_FLOATS},
    }
    for i, c in enumerate(CRITERIA):
        columns[f"passed_{c}"] = pa.array(passed[:, i], pa.bool_(), mask=~evaluated[:, i])
        columns[f"margin_{c}_m"] = _floats(margin[:, i])
        columns[f"margin_kind_{c}"] = _named(kind[:, i] - 1, KINDS)
    return pa.table([columns[f.name] for f in TRIAL_SCHEMA], schema=TRIAL_SCHEMA)


_DETAIL_FLOATS = ("width_m", "opening_m", "grasp_shift_m", "slip_m", "witness_time_s")


def detail_rows(trials: "Trials", scores: "Scores", names: TrialNames) -> pa.Table:
    """Rows of `DETAIL_SCHEMA` for B scored trials: what one looks at when one looks at a trial."""
    part = _array(scores.witness_part)
    columns = {
        "trial_id": pa.array(_array(trials.trial_id), pa.int64()),
        "hand_index": pa.array(_array(trials.hand_index), pa.int32()),
        **{k: _floats(getattr(scores, k)) for k in _DETAIL_FLOATS},
        "q_goal": _vectors(scores.q_goal),
        "witness_plan_part": _named(part[:, 0], names.parts),
        "witness_safe_part": _named(part[:, 1], names.parts),
        "witness_point_m": _vectors(scores.witness_point),
    }
    schema = of_joints(DETAIL_SCHEMA, scores.q_goal.shape[1])
    return pa.table([columns[f.name] for f in DETAIL_SCHEMA], schema=schema)


def missing_rows(trials: "Trials", names: TrialNames) -> pa.Table:
    """Rows of `TRIAL_SCHEMA` for trials without a prediction: outcome `missing`, nothing else."""
    n = len(trials)
    columns = {
        **_trial_columns(trials, names),
        "outcome": _named(np.full(n, MISSING), OUTCOME_NAMES),
    }
    arrays = [columns[f.name] if f.name in columns else pa.nulls(n, f.type) for f in TRIAL_SCHEMA]
    return pa.table(arrays, schema=TRIAL_SCHEMA)


def pose_rows(predictions: "Predictions") -> pa.Table:
    """Rows of `POSE_SCHEMA`, bit for bit what was scored."""
    arrays = [_poses(p) for p in (predictions.T_obj_ee, predictions.T_world_ee)]
    return pa.table(
        [pa.array(_array(predictions.trial_id), pa.int64()), *arrays], schema=POSE_SCHEMA
    )


def episode_rows(trial_id: Any, episodes: "Episodes") -> pa.Table:
    """Rows of `EPISODE_SCHEMA`."""
    end, by_robot = _array(episodes.end), _array(episodes.robot_touched)
    arrays = [
        pa.array(_array(trial_id), pa.int64()),
        _named(end, ENDS),
        pa.array(by_robot, pa.bool_(), mask=end != ENDS.index("contact")),
        *(_floats(getattr(episodes, name)) for name in EPISODE_NUMBERS),
    ]
    return pa.table(arrays, schema=EPISODE_SCHEMA)


def path_rows(scores: "Scores", planned: tuple[Any, Any] | None = None) -> pa.Table:
    """Rows of `PATH_SCHEMA` for the trials that have a path; `planned`: (B, P, 6) postures and (B,)
    lengths of the plans of motions that were given."""
    rows = np.flatnonzero(_array(scores.path_len) > 0)
    first = [
        pa.array(_array(scores.trial_id)[rows], pa.int64()),
        _vectors(_array(scores.q_goal)[rows]),
    ]
    schema = of_joints(PATH_SCHEMA, scores.q_goal.shape[1])
    last = pa.nulls(len(rows), schema.field("planned_q").type)
    if planned is not None:
        q, length = (_array(x)[rows] for x in planned)
        last = _postures(q, length.astype(np.int64))
    return pa.table([*first, *_motion_columns(scores, rows), last], schema=schema)


def of_joints(schema: pa.Schema, joints: int) -> pa.Schema:
    """The schema with postures of so many joints in place of a UR's six."""
    goal = pa.list_(pa.float32(), joints)
    for name in set(schema.names) & {"q_goal", "q", "executed_q", "planned_q"}:
        at = schema.get_field_index(name)
        kind = goal if name == "q_goal" else pa.list_(goal)
        schema = schema.set(at, schema.field(at).with_type(kind))
    return schema


def failure_rows(
    trials: "Trials", predictions: "Predictions", scores: "Scores", names: TrialNames
) -> pa.Table:
    """Rows of `FAILURE_SCHEMA` for the trials whose simulation failed."""
    rows = np.flatnonzero(_array(scores.outcome) == Outcome.INVALID_SIM)
    arrays = [
        pa.array(_array(trials.trial_id)[rows], pa.int64()),
        _named(_array(trials.object_index)[rows], names.objects),
        pa.array(_array(trials.hand_index)[rows], pa.int32()),
        *(
            _poses(_array(p)[rows])
            for p in (trials.T_world_hand, predictions.T_obj_ee, predictions.T_world_ee)
        ),
        _floats(_array(scores.opening_m)[rows]),
        *_motion_columns(scores, rows),
        pa.array(list(_array(scores.failed_state)[rows]), pa.list_(pa.float64())),
    ]
    return pa.table(arrays, schema=of_joints(FAILURE_SCHEMA, scores.q_goal.shape[1]))


def _motion_columns(scores: "Scores", rows: np.ndarray) -> list[pa.ListArray]:
    """Times and postures of the waypoints, and the postures that the simulator went through."""
    length, moved = (_array(n).astype(np.int64)[rows] for n in (scores.path_len, scores.motion_len))
    time = _array(scores.path_time_s).astype(np.float32)[rows]
    kept = np.arange(time.shape[1]) < length[:, None]
    offsets = pa.array(np.concatenate([[0], np.cumsum(length)]), pa.int32())
    return [
        pa.ListArray.from_arrays(offsets, pa.array(time[kept], pa.float32())),
        _postures(_array(scores.path)[rows], length),
        _postures(_array(scores.motion)[rows], moved, pa.array(moved == 0)),
    ]


def _poses(T: Any) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(
        pa.array(_array(T).astype(np.float32).reshape(-1), pa.float32()), 16
    )


def _postures(q: np.ndarray, length: np.ndarray, mask: pa.Array | None = None) -> pa.ListArray:
    """Column of lists of joint angles: of each row (W, N) the first `length`; masked rows are
    null."""
    kept = np.arange(q.shape[1]) < length[:, None]
    offsets = pa.array(np.concatenate([[0], np.cumsum(length)]), pa.int32())
    flat = pa.FixedSizeListArray.from_arrays(
        pa.array(q[kept].astype(np.float32).reshape(-1), pa.float32()), q.shape[-1]
    )
    return pa.ListArray.from_arrays(offsets, flat, mask=mask)
