"""Table rows: the documented schemas for any number of trials."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from made_runs import NAMES, made_trials, make_predictions, make_scores

from r2h_batch.runs.rows import DETAIL_SCHEMA, FAILURE_SCHEMA, PATH_SCHEMA, POSE_SCHEMA, TRIAL_SCHEMA
from r2h_batch.sweep.rows import detail_rows, failure_rows, missing_rows, path_rows, pose_rows, score_rows
from r2h_batch.types import CollidingPair, GivenScores, Outcome


@pytest.mark.check
@pytest.mark.parametrize("n", [0, 1, 2, 33])
def test_rows_of_any_number_of_trials_have_the_schemas(n):
    trials = made_trials(n, 0)
    scores = make_scores(trials, np.arange(n) % 3)
    tables = (
        (score_rows(trials, scores, NAMES, torch.zeros(n)), TRIAL_SCHEMA),
        (missing_rows(trials, NAMES), TRIAL_SCHEMA),
        (detail_rows(trials, scores, NAMES), DETAIL_SCHEMA),
        (pose_rows(make_predictions(trials)), POSE_SCHEMA),
        (path_rows(scores), PATH_SCHEMA),
        (failure_rows(trials, make_predictions(trials), scores, NAMES), FAILURE_SCHEMA),
    )
    for table, schema in tables:
        table.validate(full=True)
        assert table.schema.equals(schema)
    assert [t.num_rows for t, _ in tables[:4]] == [n] * 4


def test_a_pair_is_of_the_path_or_of_what_prevents_one_and_no_grasp_is_a_number():
    trials = made_trials(4, 0)
    own = make_scores(trials, np.array([Outcome.SUCCESS, Outcome.PLAN, Outcome.SUCCESS, Outcome.REACH]))
    pair = [CollidingPair.TABLE, CollidingPair.OBJECT_HAND, CollidingPair.NONE, CollidingPair.HAND]
    two = {
        k: torch.cat([getattr(own, k)] + [getattr(own, k)[:, :1]] * 2, 1)
        for k in ("passed", "evaluated", "margin", "margin_kind")
    }
    asked = (
        {f.name: getattr(own, f.name) for f in fields(own)} | two | {"plan_pair": torch.tensor(pair, dtype=torch.int8)}
    )
    receives = torch.tensor([[0, 3, 0], [1, 0, -1], [-1, -1, -1], [0, 1, 2]], dtype=torch.int32)
    pick = torch.tensor([[0, int(CollidingPair.NONE), -1]] * 4, dtype=torch.int32)
    rows = score_rows(trials, GivenScores(**asked, pick=pick, receives=receives), NAMES).to_pylist()
    assert [r["nearest_pair"] for r in rows] == ["table", None, None, "hand"]
    assert [r["plan_pair"] for r in rows] == [None, "object_hand", None, None]
    assert [r["received_grasps"] for r in rows] == [3, 0, None, 1]


def test_what_the_simulator_failed_on_can_be_run_again_from_its_row():
    trials = made_trials(3, 2)
    outcome = np.array([Outcome.SUCCESS, Outcome.INVALID_SIM, Outcome.SUCCESS, Outcome.INVALID_SIM, Outcome.PLAN])
    scores, predictions = make_scores(trials, outcome), make_predictions(trials)
    scores.motion_len[1], scores.motion[1, 2:] = 4, torch.nan
    rows = failure_rows(trials, predictions, scores, NAMES).to_pylist()
    assert [r["trial_id"] for r in rows] == trials.trial_id[[1, 3]].tolist()
    for row, i in zip(rows, (1, 3)):
        for name, T in (
            ("T_world_hand", trials.T_world_hand),
            ("T_obj_ee", predictions.T_obj_ee),
            ("T_world_ee", predictions.T_world_ee),
        ):
            assert np.array_equal(np.array(row[name], np.float32).reshape(4, 4), T[i].numpy())
        assert row["hand_index"] == int(trials.hand_index[i])
    q = np.array(rows[0]["executed_q"], np.float32)
    assert np.array_equal(q, scores.motion[1, :4].numpy(), equal_nan=True) and np.isnan(q[2:]).all()
    assert rows[1]["executed_q"] is None and rows[1]["failed_state"] == [9.0, 10.0, 11.0]
