"""How long a shard is, and which trials it holds."""

import time

import fake_bench
import pytest
import torch

from r2h_batch import engine, jobs
from r2h_batch.manifest import SHARD_TRIALS
from r2h_batch.options import Options


class Slow(fake_bench.FakeEvaluator):
    """Takes a millisecond a trial."""

    def score(self, T_obj_ee, T_world_ee, trials):
        time.sleep(0.001 * len(trials))
        return super().score(T_obj_ee, T_world_ee, trials)


def predict(trials, _):
    T = torch.eye(4).repeat(len(trials), 1, 1)
    return jobs.Predictions(trials.trial_id, T, T)


JOB = jobs.Job("m", {}, predict, warm=True)


def bench(trials, evaluator):
    made = fake_bench.prepare(Options(method=("random",), trials=trials))
    return jobs.Bench(evaluator, made.header, made.ids, made.trials)


def test_a_shard_is_what_is_done_in_a_minute_and_at_most_100000_trials(monkeypatch):
    monkeypatch.setattr(engine, "SHARD_SECONDS", 1.0)
    size = engine.shard_size(bench(600, Slow()), [JOB])
    assert size % engine.CPU_CHUNK == 0 and 256 <= size <= 1024
    monkeypatch.setattr(engine, "SHARD_SECONDS", 0.01)
    assert engine.shard_size(bench(600, Slow()), [JOB]) == engine.CPU_CHUNK
    monkeypatch.setattr(engine, "SHARD_SECONDS", 1e9)
    assert engine.shard_size(bench(600, fake_bench.FakeEvaluator()), [JOB]) == SHARD_TRIALS


def test_a_small_plan_is_not_probed():
    evaluator = fake_bench.FakeEvaluator()
    assert engine.shard_size(bench(500, evaluator), [JOB]) == SHARD_TRIALS and evaluator.sizes == []


@pytest.mark.parametrize("splits", [("S0", "S1"), ("S1",), ("S0",), ("S1", "S0")])
def test_planned_ids_are_those_of_the_protocol_in_any_range(splits):
    from r2h_batch.trials import make_trials

    plan = jobs.prepare(Options(method=("random",), trials=11, splits=splits))
    expected = make_trials([s for s in ("S0", "S1") if s in splits], 11)
    assert plan.planned == len(expected)
    assert plan.ids(0, plan.planned).tolist() == expected.trial_id.tolist()
    for first, last in ((0, 0), (3, 4), (5, plan.planned)):
        ids = plan.ids(first, last)
        assert ids.tolist() == expected.trial_id[first:last].tolist()
        assert torch.equal(plan.trials(ids).T_world_hand, expected.T_world_hand[first:last])
