"""Predictions files: every fault of rows 12 to 16 of the fault matrix is refused with a line that says what to do."""

import numpy as np
import pytest
import torch
from made_runs import made_trials, make_predictions
from prediction_files import arrays, refused, store

from r2h_batch.base import se3
from r2h_batch.base.errors import FileError
from r2h_batch.trials.predictions import Motions, align, doubts, faults, load_predictions, write_predictions
from r2h_batch.types import Predictions


@pytest.mark.parametrize("timed", [False, True])
def test_written_predictions_are_read_back_equal(tmp_path, timed):
    n = 33
    seconds = torch.arange(n, dtype=torch.float32) if timed else None
    made = make_predictions(made_trials(n, 0), method="Contact-Handover (é)")
    made = Predictions(made.trial_id, made.T_obj_ee, made.T_world_ee, seconds, made.method)
    write_predictions(tmp_path / "p.npz", made)
    read = load_predictions(tmp_path / "p.npz")
    assert read.method == made.method
    for name in ("trial_id", "T_obj_ee", "T_world_ee"):
        assert getattr(read, name).numpy().tobytes() == getattr(made, name).numpy().tobytes()
        assert getattr(read, name).dtype == getattr(made, name).dtype
    assert (read.t_method_s is None) if seconds is None else torch.equal(read.t_method_s, seconds)
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


# --- schema ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"T_world_ee": None}, ["has no T_world_ee; needed are trial_id, T_obj_ee, T_world_ee;"]),
        ({"T_obj_eee": np.zeros(3)}, ["unknown", "T_obj_eee", "allowed are trial_id"]),
        ({"T_obj_ee": np.zeros((5, 3, 4), np.float32)}, ["T_obj_ee is (5, 3, 4)", "need 5 x 4 x 4"]),
        ({"T_obj_ee": np.zeros((5, 4, 4), int)}, ["T_obj_ee", "int64", "float32 or float64"]),
        ({"trial_id": np.arange(5.0)}, ["trial_id", "float64", "whole numbers"]),
        ({"trial_id": np.full(5, 2**63, np.uint64)}, ["does not fit int64"]),
        ({"t_method_s": np.full(5, -1.0)}, ["'t_method_s'", "is -1; 0 to 1e+09"]),
    ],
    ids=str,
)
def test_a_wrong_schema_is_refused_naming_file_key_and_what_is_allowed(tmp_path, changes, parts):
    refused(store(tmp_path / "p.npz", arrays(**changes)), *parts)


# --- trials ------------------------------------------------------------------------------------------------------


def predictions_for(ids) -> Predictions:
    ids = torch.tensor(ids, dtype=torch.int64)
    poses = torch.zeros(len(ids), 4, 4)
    return Predictions(ids, poses, poses)


def test_rows_in_any_order_are_aligned_by_trial_id():
    planned = torch.tensor([10, 11, 12, 500, 501])
    given = predictions_for([501, 11, 500, 12, 10])
    rows = align(given, planned, source="p.npz")
    assert torch.equal(given.trial_id[rows], planned)


@pytest.mark.parametrize(
    ("given", "count", "what", "listed"),
    [
        ([*range(40), *range(30)], 30, "given more than once", "0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...;"),
        ([*range(41)], 1, "not in the plan", "40;"),
    ],
)
def test_duplicate_and_unknown_ids_are_refused_with_the_first_ten(given, count, what, listed):
    with pytest.raises(FileError) as error:
        align(predictions_for(given), torch.arange(40), source="my.npz", allow_missing=True)
    ids = "1 trial id is" if count == 1 else f"{count} trial ids are"
    assert str(error.value).startswith(f"my.npz: {ids} {what}: {listed}")


def test_missing_ids_are_refused_with_the_first_ten_and_the_flag_that_allows_them():
    with pytest.raises(FileError) as error:
        align(predictions_for(range(20, 40)), torch.arange(40), source="my.npz")
    assert str(error.value).startswith(
        "my.npz: 20 trial ids are planned but missing: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, ...;"
    )
    assert "--allow-missing" in str(error.value)


def test_poses_in_millimetres_and_transposed_ones_are_said_before_they_are_scored():
    """The table would be one of zeros, and the file would look as if it had been understood."""
    T = torch.eye(4).repeat(5, 1, 1)
    T[:, :3, 3] = torch.tensor([0.4, 0.1, 0.5])
    ids = torch.tensor([7, 3, 0, 1, 2])
    grasps = T.clone()
    grasps[:, 0, 3] = 0.05
    assert doubts(Predictions(ids, grasps, T)) == []
    T_bad, far = T.clone(), T.clone()
    T_bad[1:, :3, 3], T_bad[1:, 3, :3] = 0.0, T[1:, :3, 3]
    far[2:, :3, 3] *= 1000
    assert doubts(Predictions(ids, T_bad, far)) == [
        "4 of 5 grasps (T_obj_ee; the first of trial 3) are not rigid poses and count as invalid: all are transposed: pass"
        " T.transpose(-1, -2)",
        "3 of 5 handover poses (T_world_ee; the first of trial 0) are more than 10 m away: lengths are in metres (a file may"
        " declare length_unit=mm)",
    ]
    far[0, 0, 0] = torch.nan
    assert (
        "1 of 5 handover poses (T_world_ee; the first of trial 7) are not rigid poses"
        in doubts(Predictions(ids, T, far))[0]
    )


def test_what_is_wrong_with_a_pose_is_told_of_each_kind():
    T = torch.eye(4).repeat(8, 1, 1)
    T[:, :3, 3] = torch.tensor([0.1, 0.1, 0.1])
    T[1, 0, 0] = torch.nan
    T[2] = T[2].T.clone()
    T[3, 3, 3] = 0.5
    T[4, :3, :3] = 0.0
    T[5, 0, 0] = -1.0
    T[6, :3, :3] *= 1000.0
    T[7, 0, 1] = 0.3
    assert faults(T.numpy()).tolist() == list(range(8))
    (line,) = doubts(Predictions(torch.arange(8), T, torch.eye(4).repeat(8, 1, 1)))
    assert line.startswith("7 of 8 grasps (T_obj_ee; the first of trial 1)") and line.count(";") == 7


def test_times_of_answers_that_look_like_milliseconds_are_told():
    T = torch.eye(4).repeat(4, 1, 1)
    T[:, :3, 3] = torch.tensor([0.02, 0.01, 0.1])
    told = doubts(Predictions(torch.arange(4), T, T @ T, torch.tensor([250.0, torch.nan, 240.0, 3.0])))
    assert len(told) == 1 and "240 s a trial" in told[0] and "time_unit=ms" in told[0]
    for seconds in ([90.0, torch.nan, 1e4, 2.0], [torch.nan] * 4):
        assert doubts(Predictions(torch.arange(4), T, T @ T, torch.tensor(seconds))) == []


ODD = {
    "a translation without numbers": ((0, 3), torch.nan, "hold NaN"),
    "an infinite one": ((2, 3), torch.inf, "hold NaN"),
    "a rotation that is off by 0.004": ((0, 0), 1.002, "orthonormalise"),
    "a last row that is off by 0.001": ((3, 1), 0.001, "last row"),
}
"""What the judge does not take: where, the number there, and how it is told."""


@pytest.mark.parametrize("name", ODD)
def test_whatever_counts_as_invalid_is_told_before(name):
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, :3, 3] = torch.tensor([0.02, 0.01, 0.1])
    place, value, words = ODD[name]
    T[1][place] = value
    assert se3.is_pose(T).tolist() == [True, False, True] and faults(T.numpy()).astype(bool).tolist() == [
        False,
        True,
        False,
    ]
    (line,) = doubts(Predictions(torch.arange(3), T, torch.eye(4).repeat(3, 1, 1)))
    assert line.startswith("1 of 3 grasps (T_obj_ee; the first of trial 1)") and words in line


def test_a_pose_that_is_far_away_is_told_by_its_unit_and_not_as_no_pose():
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 2, 3] = 5e5  # micrometres
    assert faults(T.numpy()).tolist() == [0, 0, 0]
    assert "more than 10 m away" in doubts(Predictions(torch.arange(3), torch.eye(4).repeat(3, 1, 1), T))[0]


def test_grasps_in_the_place_of_handover_poses_are_told():
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, 2, 3] = 0.1
    (line,) = doubts(Predictions(torch.arange(3), T, T))
    assert line.startswith("3 of 3 handover poses (T_world_ee) equal the grasps (T_obj_ee): T_world_ee is")


def test_motions_without_numbers_are_told():
    q, time_s = torch.zeros(7, 6), torch.arange(7.0)
    q[3, 2] = torch.nan
    T = torch.eye(4).repeat(3, 1, 1)
    motions = Motions(q, time_s, torch.tensor([3, 0, 4]))
    W = T.clone()
    W[:, 0, 3] = 0.5
    assert doubts(Predictions(torch.tensor([4, 6, 8]), T, W), motions) == [
        "1 of 3 motions (the first of trial 8) hold NaN or infinity and count as invalid"
    ]


def test_ids_that_begin_at_one_are_told():
    with pytest.raises(FileError, match="each is the id of a planned trial plus 1: ids begin at 0"):
        align(predictions_for([1, 2, 3, 4]), torch.tensor([0, 2, 1, 3]), source="my.npz")
