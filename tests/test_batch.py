"""A trial's verdict does not depend on who else is in its batch: bitwise equal Scores on one device."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
import torch
from problems import Batch, assert_same, default_evaluator, make_batch
from rounds import each

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
    twin = copy.copy(default_evaluator())
    twin.config, twin.threads = replace(twin.config, chunk=chunk), threads
    return twin


@every_stage
def test_smaller_batches_give_the_same_rows(stages):
    """Rows alone too: of paths that were searched, for RRT-Connect's random numbers belong to the trial."""
    s = reference()
    assert {Outcome.SUCCESS, Outcome.PLAN, Outcome.REACH} <= {Outcome(int(x)) for x in s.outcome}
    searched = torch.nonzero(s.path_len > 2).flatten().tolist()
    assert len(searched) >= 3 and (s.path_len == 0).any()
    alone = [slice(i, i + 1) for i in (0, *searched[:3])]
    for rows in (*alone, slice(0, 33), slice(33, 35), slice(35, SIZE)):
        assert_same(reference(stages)[rows], score(batch(SIZE).rows(rows), None, stages))


@every_stage
def test_an_empty_batch_gives_empty_scores_of_the_same_types(stages):
    empty = score(batch(SIZE).rows(slice(0, 0)), None, stages)
    for f in each(fields(Scores)):
        x, y = getattr(empty, f.name), getattr(reference(stages), f.name)
        assert x.shape == (0, *y.shape[1:]) and x.dtype == y.dtype, f.name


@every_stage
def test_order_chunk_size_and_thread_count_change_no_row(stages):
    order = torch.from_numpy(np.random.default_rng(2).permutation(SIZE))
    assert_same(reference(stages)[order], score(batch(SIZE).rows(order), evaluator_with(7, 5), stages))


def test_random_numbers_follow_the_trial_id_and_not_the_row():
    """The same handover under another trial id may find another path, but its geometry is judged the same."""
    b = batch(SIZE)
    other = Batch(replace(b.trials, trial_id=b.trials.trial_id + 1000), b.T_obj_ee, b.T_world_ee)
    s = score(other)
    assert torch.equal(s.margin[:, [0, 2]], reference().margin[:, [0, 2]])
    assert torch.equal(s.plan_reason == 2, reference().plan_reason == 2)
    straight = reference().path_len == 2
    assert torch.equal(s.path[straight], reference().path[straight])


def test_threads_of_a_program_may_share_an_evaluator():
    parts = [slice(i, i + 16) for i in range(4)]

    def many(rows: slice) -> None:
        for _ in range(8):
            assert_same(reference("pose")[rows], score(batch(SIZE).rows(rows), None, "pose"))

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(many, parts)) == [None] * 4  # an assert that fails there is raised here


def test_scores_of_another_configuration_are_its_own():
    evaluator, b = copy.copy(default_evaluator()), batch(SIZE)
    evaluator.config = replace(evaluator.config, thresholds=replace(evaluator.config.thresholds, reach_radius_m=0.02))
    tight = score(b, evaluator, "pose")
    assert int(tight.passed[:, 2].sum()) < int(reference("pose").passed[:, 2].sum())
    assert_same(reference("pose"), score(b, None, "pose"))
