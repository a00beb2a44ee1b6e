"""How long a shard is, and which trials it holds."""

from dataclasses import replace

import fake_bench
import pytest
import torch

from r2h_batch.runs.store import load_run
from r2h_batch.runs.writing import open_run
from r2h_batch.sweep import jobs, scoring
from r2h_batch.sweep.options import Options
from r2h_batch.sweep.request import requested
from r2h_batch.types import Outcome


class Failing(fake_bench.FakeEvaluator):
    """Its simulator fails on every trial whose id is a multiple of 5."""

    def score(self, T_obj_ee, T_world_ee, trials, *, keep_motion=False):
        scores = super().score(T_obj_ee, T_world_ee, trials)
        failed = trials.trial_id % 5 == 0
        outcome = torch.where(failed, int(Outcome.INVALID_SIM), scores.outcome)
        judged = ~failed[:, None]  # such a row is judged by nothing
        return replace(
            scores,
            outcome=outcome.to(torch.int8),
            success=outcome == int(Outcome.SUCCESS),
            passed=scores.passed & judged,
            evaluated=scores.evaluated & judged,
            margin=torch.where(judged, scores.margin, torch.nan),
            margin_kind=scores.margin_kind * judged,
        )


def test_trials_that_the_simulator_failed_on_are_dumped_into_the_run_folder_and_others_are_not(tmp_path):
    bench = replace(fake_bench.set_up(requested(Options(method=("random",), trials=12, chunk=5))), evaluator=Failing())
    run = open_run(tmp_path / "run", {**bench.header, "shard_trials": 8})
    run.register("m", {"kind": "test"})
    for shard in run.todo("m"):
        with run.write("m", shard) as writer:
            scoring.score_shard(jobs.Job("m", {}, predict), shard, writer, bench)
    stored = load_run(tmp_path / "run")
    assert stored.failures("m")["trial_id"].to_pylist() == [0, 5, 10, 15, 20]
    assert stored.trials("m")["outcome"].to_pylist().count("invalid_sim") == 5
    assert ["failures" in shard.kinds for shard in stored.entry("m").shards.values()].count(True) >= 1
    stored.verify()


def predict(trials, _):
    T = torch.eye(4).repeat(len(trials), 1, 1)
    return jobs.Predictions(trials.trial_id, T, T)


@pytest.mark.parametrize("splits", [("S1",), ("S1", "S0")])
def test_planned_ids_are_those_of_the_protocol_in_any_range(splits):
    from r2h_batch import load_benchmark

    plan = jobs.set_up(requested(Options(method=("random",), trials=11, splits=splits)))
    expected = load_benchmark().trials(11, splits=[s for s in ("S0", "S1") if s in splits])
    assert plan.planned == len(expected)
    assert plan.ids(0, plan.planned).tolist() == expected.trial_id.tolist()
    for first, last in ((0, 0), (3, 4), (5, plan.planned)):
        ids = plan.ids(first, last)
        assert ids.tolist() == expected.trial_id[first:last].tolist()
        assert torch.equal(plan.trials(ids).T_world_hand, expected.T_world_hand[first:last])
