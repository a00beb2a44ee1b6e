"""A trial's verdict does not depend on who else is in its batch: bitwise equal Scores on one device."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
import torch
from problems import Batch, assert_same, default_evaluator, make_batch

from r2h_batch.evaluate import Evaluator
from r2h_batch.types import Outcome, Scores

SIZE = 66


@cache
def batch(n: int) -> Batch:
    """Trials of both splits, sensible and random predictions, among them searched paths and failures of all kinds."""
    return make_batch(default_evaluator().scene, n, random_share=0.4)


def score(b: Batch, evaluator: Evaluator | None = None, stages: str = "all") -> Scores:
    return (evaluator or default_evaluator()).score(b.T_obj_ee, b.T_world_ee, b.trials, stages)


@cache
def reference(stages: str = "all") -> Scores:
    return score(batch(SIZE), None, stages)


every_stage = pytest.mark.parametrize("stages", ["all", "pose"])


@cache
def evaluator_with(chunk: int, threads: int | None) -> Evaluator:
    """The default evaluator's tables under another chunk size and thread count."""
    twin = object.__new__(Evaluator)
    base = default_evaluator()
    twin.config, twin.scene, twin.threads = replace(base.config, chunk=chunk), base.scene, threads
    return twin


def test_the_reference_batch_holds_every_kind_of_row():
    s = reference()
    assert {Outcome.SUCCESS, Outcome.PLAN, Outcome.REACH} <= {Outcome(int(x)) for x in s.outcome}
    assert (s.path_len > 2).any() and (s.path_len == 0).any()


@every_stage
@pytest.mark.parametrize("n", [1, 2, 33, SIZE])
def test_smaller_batches_give_the_same_rows(n, stages):
    for first in range(0, SIZE, n)[: 5 if n == 1 else None]:
        rows = slice(first, first + n)
        assert_same(reference(stages)[rows], score(batch(SIZE).rows(rows), None, stages))


@every_stage
def test_the_order_of_a_batch_changes_no_row(stages):
    order = torch.from_numpy(np.random.default_rng(2).permutation(SIZE))
    assert_same(reference(stages)[order], score(batch(SIZE).rows(order), None, stages))


def test_searched_paths_do_not_depend_on_their_batch():
    """Rows with a path of more than two waypoints alone: RRT-Connect's random numbers belong to the trial."""
    rows = torch.nonzero(reference().path_len > 2).flatten()
    assert len(rows) >= 3
    for row in rows[:6].tolist():
        assert_same(reference()[row : row + 1], score(batch(SIZE).rows(slice(row, row + 1))))


@every_stage
def test_an_empty_batch_gives_empty_scores_of_the_same_types(stages):
    empty = score(batch(SIZE).rows(slice(0, 0)), None, stages)
    for f in fields(Scores):
        x, y = getattr(empty, f.name), getattr(reference(stages), f.name)
        assert x.shape == (0, *y.shape[1:]) and x.dtype == y.dtype, f.name


@pytest.mark.parametrize(("chunk", "threads"), [(1, 1), (7, 2), (2048, 5)])
@every_stage
def test_chunk_size_and_thread_count_change_nothing(chunk, threads, stages):
    assert_same(reference(stages), score(batch(SIZE), evaluator_with(chunk, threads), stages))


def test_one_bad_row_among_4096_poses_changes_no_other():
    small = batch(SIZE)
    rows = torch.arange(4096) % SIZE
    b = small.rows(rows)
    b.T_obj_ee[77] = torch.nan
    s = score(b, None, "pose")
    assert int(s.outcome[77]) == Outcome.INVALID_INPUT and (s.outcome == int(Outcome.INVALID_INPUT)).sum() == 1
    keep = torch.arange(4096) != 77
    assert_same(s[keep], reference("pose")[rows[keep]])


def test_random_numbers_follow_the_trial_id_and_not_the_row():
    """The same handover under another trial id may find another path, but its geometry is judged the same."""
    b = batch(SIZE)
    other = Batch(replace(b.trials, trial_id=b.trials.trial_id + 1000), b.T_obj_ee, b.T_world_ee)
    s = score(other)
    assert torch.equal(s.margin[:, [0, 2]], reference().margin[:, [0, 2]])
    assert torch.equal(s.plan_reason == 2, reference().plan_reason == 2)
    straight = reference().path_len == 2
    assert torch.equal(s.path[straight], reference().path[straight])


@every_stage
def test_tensors_of_any_kind_give_the_same_rows(stages):
    """Strided, one tensor for both poses, in every gradient mode."""
    b = batch(SIZE)
    wide = torch.zeros(SIZE, 4, 8)
    wide[:, :, ::2] = b.T_obj_ee
    twice, once_each = Batch(b.trials, b.T_obj_ee, b.T_obj_ee), Batch(b.trials, b.T_obj_ee, b.T_obj_ee.clone())
    modes = (torch.inference_mode, torch.no_grad, torch.enable_grad)
    for mode in modes if stages == "pose" else modes[:1]:
        with mode():
            assert_same(reference(stages), score(Batch(b.trials, wide[:, :, ::2], b.T_world_ee), None, stages))
            assert_same(score(once_each, None, stages), score(twice, None, stages))


def test_threads_of_a_program_may_share_an_evaluator():
    parts = [slice(i, i + 16) for i in range(4)]

    def many(rows: slice) -> None:
        for _ in range(20):
            assert_same(reference("pose")[rows], score(batch(SIZE).rows(rows), None, "pose"))

    with ThreadPoolExecutor(4) as pool:
        for done in [pool.submit(many, rows) for rows in parts]:
            done.result()


def test_scores_of_another_configuration_are_its_own():
    evaluator, b = copy.copy(default_evaluator()), batch(SIZE)
    evaluator.config = replace(evaluator.config, thresholds=replace(evaluator.config.thresholds, reach_radius_m=0.02))
    tight = score(b, evaluator, "pose")
    assert int(tight.passed[:, 2].sum()) < int(reference("pose").passed[:, 2].sum())
    assert_same(reference("pose"), score(b, None, "pose"))
