"""Scores as rows of a run folder: from tensors to the columns of `runs/columns.py`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa

from r2h_batch.runs.columns import BOOL, DETAILS, ENDS, TRIALS, Column, schema_of_kind
from r2h_batch.runs.rows import (
    EPISODE_SCHEMA,
    KINDS,
    MISSING,
    OUTCOME_NAMES,
    POSE_SCHEMA,
    SEES_SCHEMA,
)
from r2h_batch.scene.scene import Scene
from r2h_batch.types import Predictions, Scores, Trials
from r2h_batch.verdicts import (
    PERSON,
    SEXES,
    SIDES,
    SPLITS,
    CollidingPair,
    Nearer,
    Outcome,
    PickReason,
    PlanReason,
    ReceiveReason,
    Room,
)


@dataclass(frozen=True)
class TrialNames:
    """Names behind the indices of `Trials` and `Scores`: objects with their splits, sides of hands,
    robot parts."""

    objects: Sequence[str]
    object_splits: Sequence[str]
    hand_sides: Sequence[str]
    parts: Sequence[str] = ()

    @classmethod
    def of(cls, scene: Scene) -> "TrialNames":
        """Names for the rows that are judged in a scene."""
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


def _trial_columns(trials: Trials, names: TrialNames) -> dict[str, Any]:
    objects = _array(trials.object_index)
    split_of = np.array([SPLITS.index(s) for s in names.object_splits], np.int32)
    side_of = np.array([SIDES.index(s) for s in names.hand_sides], np.int32)
    return {
        "trial_id": pa.array(_array(trials.trial_id), pa.int64()),
        "object": _named(objects, names.objects),
        "split": _named(split_of[objects], SPLITS),
        "side": _named(side_of[_array(trials.hand_index)], SIDES),
    }


def _person_columns(trials: Trials) -> dict[str, Any]:
    """Who the receivers are; null without `Trials.person`."""
    n = len(_array(trials.trial_id))
    person = np.full((n, len(PERSON)), np.nan) if trials.person is None else _array(trials.person)
    found = dict(zip(PERSON, person.T, strict=True))
    unknown = np.isnan(found["female"])
    floats = ("age_years", "stature_m", "hand_length_m", "redrawn")
    return {
        **{name: _floats(found[name]) for name in floats},
        "sex": _named(np.where(unknown, -1, found["female"]), SEXES),
        "seated": pa.array(found["seated"] > 0, BOOL, mask=unknown),
    }


def _stored(scores: Scores, columns: Sequence[Column], made: dict[str, Any]) -> list[pa.Array]:
    """Arrays of a table's columns: those `made` from several fields, and the attributes of `scores` that
    have a column's name."""

    def own(column: Column) -> pa.Array:
        values = getattr(scores, column.name)
        return pa.array(_array(values), BOOL) if column.type == BOOL else _floats(values)

    return [made[c.name] if c.name in made else own(c) for c in columns]


def score_rows(
    trials: Trials, scores: Scores, names: TrialNames, t_method_s: Any = None
) -> pa.Table:
    """Rows of trials for B scored ones, with the columns of the criteria that they were judged by; `t_method_s` (B,) or
    None where it was not measured."""
    ids = _array(scores.trial_id)
    if not np.array_equal(ids, _array(trials.trial_id)):
        raise ValueError("scores and trials must have the same trial_id in the same order")
    passed, evaluated, margin, kind = (
        _array(getattr(scores, k)) for k in ("passed", "evaluated", "margin", "margin_kind")
    )
    pair, has_path = _array(scores.plan_pair).astype(np.int32), _array(scores.path_len) > 0
    pairs = [p.name.lower() for p in CollidingPair]
    seconds = np.full(len(ids), np.nan, np.float32) if t_method_s is None else t_method_s
    columns = {
        **_trial_columns(trials, names),
        "outcome": _named(scores.outcome, OUTCOME_NAMES),
        "plan_reason": _named(scores.plan_reason, [r.name.lower() for r in PlanReason]),
        "plan_pair": _named(np.where(has_path | (pair == CollidingPair.NONE), -1, pair), pairs),
        "nearest_pair": _named(np.where(has_path & (pair != CollidingPair.NONE), pair, -1), pairs),
        "presented_by": _named(scores.presented_by, [n.name.lower() for n in Nearer]),
        "t_method_s": _floats(seconds),
    }
    columns |= _person_columns(trials)
    if "pick" in scores.criteria:
        reason, met, part = _array(vars(scores)["pick"]).T
        columns["pick_reason"] = _named(reason, [r.name.lower() for r in PickReason])
        columns["pick_pair"] = _named(np.where(met == CollidingPair.NONE, -1, met), pairs)
        columns["pick_part"] = _named(part, names.parts)
    if "received" in scores.criteria:
        reason, grasps, room = _array(vars(scores)["receives"]).T
        columns["received_reason"] = _named(reason, [r.name.lower() for r in ReceiveReason])
        columns["received_grasps"] = pa.array(grasps, pa.int32(), mask=grasps < 0)
        columns["received_by"] = _named(room, [r.name.lower() for r in Room])
    for i, entry in enumerate(scores.entries):
        columns[entry.passed_column] = pa.array(passed[:, i], pa.bool_(), mask=~evaluated[:, i])
        columns[entry.margin_column] = _floats(margin[:, i])
        columns[entry.kind_column] = _named(kind[:, i] - 1, KINDS)
    schema = schema_of_kind("trials", asks=scores.criteria)
    own = [c for c in TRIALS if c.name in schema.names]
    return pa.table(_stored(scores, own, columns), schema=schema)


def detail_rows(trials: Trials, scores: Scores, names: TrialNames) -> pa.Table:
    """Rows of `DETAIL_SCHEMA` for B scored trials: what one looks at when one looks at a trial."""
    part = _array(scores.witness_part)
    columns = {
        "trial_id": pa.array(_array(trials.trial_id), pa.int64()),
        "hand_index": pa.array(_array(trials.hand_index), pa.int32()),
        "q_goal": _vectors(scores.q_goal),
        "witness_plan_part": _named(part[:, 0], names.parts),
        "witness_safe_part": _named(part[:, 1], names.parts),
        "witness_point_m": _vectors(scores.witness_point),
    }
    schema = schema_of_kind("details", scores.q_goal.shape[1])
    return pa.table(_stored(scores, DETAILS, columns), schema=schema)


def missing_rows(trials: Trials, names: TrialNames, asks: Sequence[str] = ()) -> pa.Table:
    """Rows of trials without a prediction: outcome `missing`, nothing else. `asks`: as of `schema_of_kind`."""
    n, schema = len(trials), schema_of_kind("trials", asks=asks)
    columns = {
        **_trial_columns(trials, names),
        "outcome": _named(np.full(n, MISSING), OUTCOME_NAMES),
    }
    arrays = [columns[f.name] if f.name in columns else pa.nulls(n, f.type) for f in schema]
    return pa.table(arrays, schema=schema)


def pose_rows(predictions: Predictions) -> pa.Table:
    """Rows of `POSE_SCHEMA`, bit for bit what was scored."""
    arrays = [_poses(p) for p in (predictions.T_obj_ee, predictions.T_world_ee)]
    return pa.table(
        [pa.array(_array(predictions.trial_id), pa.int64()), *arrays], schema=POSE_SCHEMA
    )


def episode_rows(trial_id: Any, episodes: Mapping[str, Any]) -> pa.Table:
    """Rows of `EPISODE_SCHEMA`; `episodes`: its columns by name, tensors or arrays of (B,)."""
    end, by_robot = _array(episodes["end"]), _array(episodes["robot_touched"])
    arrays = [
        pa.array(_array(trial_id), pa.int64()),
        _named(end, ENDS),
        pa.array(by_robot, pa.bool_(), mask=end != ENDS.index("contact")),
        *(_floats(episodes[name]) for name in EPISODE_SCHEMA.names[3:]),
    ]
    return pa.table(arrays, schema=EPISODE_SCHEMA)


def sees_rows(looked: Mapping[str, Any]) -> pa.Table:
    """Rows of `SEES_SCHEMA`; `looked`: its columns by name, tensors or arrays of (B,), and `pick_judged`."""
    arrays = [
        pa.array(_array(looked["trial_id"]), pa.int64()),
        _floats(looked["t_sees_s"]),
        pa.array(_array(looked["seen_px"]), pa.int32()),
        _floats(looked["seen_share"]),
        pa.array(_array(looked["pick"]), pa.bool_(), mask=~_array(looked["pick_judged"])),
    ]
    return pa.table(arrays, schema=SEES_SCHEMA)


def path_rows(scores: Scores, planned: tuple[Any, Any] | None = None) -> pa.Table:
    """Rows of `PATH_SCHEMA` for the trials that have a path; `planned`: (B, P, 6) postures and (B,)
    lengths of the plans of motions that were given."""
    rows = np.flatnonzero(_array(scores.path_len) > 0)
    first = [
        pa.array(_array(scores.trial_id)[rows], pa.int64()),
        _vectors(_array(scores.q_goal)[rows]),
    ]
    schema = schema_of_kind("paths", scores.q_goal.shape[1])
    last = pa.nulls(len(rows), schema.field("planned_q").type)
    if planned is not None:
        q, length = (_array(x)[rows] for x in planned)
        last = _postures(q, length.astype(np.int64))
    return pa.table([*first, *_motion_columns(scores, rows), last], schema=schema)


def failure_rows(
    trials: Trials, predictions: Predictions, scores: Scores, names: TrialNames
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
    return pa.table(arrays, schema=schema_of_kind("failures", scores.q_goal.shape[1]))


def _motion_columns(scores: Scores, rows: np.ndarray) -> list[pa.ListArray]:
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
