"""Rewards from scores: values, order, ties, and no NaN."""

from dataclasses import replace

import pytest
import torch
from problems import default_evaluator, make_batch

from r2h_batch import reward
from r2h_batch.types import CRITERIA, Outcome, Scores

N, K = 16, 6


@pytest.fixture(scope="module")
def scores() -> Scores:
    b = make_batch(default_evaluator().scene, N * K, random_share=0.4)
    T_obj_ee = b.T_obj_ee.clone()
    T_obj_ee[::17] = torch.nan
    return default_evaluator().score(T_obj_ee, b.T_world_ee, b.trials, "pose")


def test_margins_are_finite_clipped_and_agree_with_the_verdict(scores):
    for limit in (0.05, 0.01, 1.0):
        m = reward.margin_vector(scores, limit_m=limit)
        assert m.shape == (N * K, len(CRITERIA)) and torch.isfinite(m).all() and (m.abs() <= limit).all()
        judged = scores.outcome < int(Outcome.INVALID_INPUT)
        assert (m[~judged] == -limit).all() and (~judged).any()
        inside = scores.evaluated & (scores.margin.abs() < limit)
        assert torch.equal(m[inside], scores.margin[inside]) and inside.any()
        assert (m[judged].amin(1) > 0).eq(scores.success[judged]).all()
        s0 = judged & ~scores.evaluated[:, CRITERIA.index("affordance")]
        assert s0.any() and (m[s0, CRITERIA.index("affordance")] == limit).all()
    # no path within the budget: Plan's margin is -inf
    none = replace(scores, margin=scores.margin.index_fill(1, torch.tensor([1]), -torch.inf))
    assert torch.isfinite(reward.margin_vector(none)).all()


def test_success_and_the_first_failure_name_the_outcome(scores):
    assert torch.equal(reward.success(scores) == 1, scores.success) and scores.success.any()
    for outcome, column in zip(scores.outcome.tolist(), reward.first_failure(scores).tolist(), strict=True):
        if outcome == Outcome.SUCCESS:
            assert column == reward.NO_FAILURE
        elif outcome in (Outcome.INVALID_INPUT, Outcome.INVALID_SIM):
            assert column == reward.NOT_JUDGED
        else:
            assert CRITERIA[column] == Outcome(outcome).name.lower()


def test_quality_puts_every_success_above_every_failure_and_deeper_inside_above_nearer(scores):
    q = reward.quality(scores)
    assert torch.isfinite(q).all()
    assert q[scores.success].min() > q[~scores.success].max()
    worst = reward.margin_vector(scores).amin(1)
    best = torch.nonzero(scores.success).flatten()
    i, j = best[worst[best].argmax()], best[worst[best].argmin()]
    assert worst[i] > worst[j] and q[i] > q[j]


def slow_ranks(row: list[float]) -> list[int]:
    """Rank by value, NaN last, ties by position: one comparison at a time."""

    def before(a: int, b: int) -> bool:
        x, y = row[a], row[b]
        if x != x or y != y:
            return (x == x, -a) > (y == y, -b)
        return x > y or (x == y and a < b)

    return [sum(before(b, a) for b in range(len(row)) if b != a) for a in range(len(row))]


def test_ranks_and_the_best_of_k_equal_a_slow_count_with_ties_and_nan():
    g = torch.Generator().manual_seed(0)
    value = torch.randint(-2, 3, (40, K), generator=g).float()
    value[torch.rand(40, K, generator=g) < 0.2] = torch.nan
    value[torch.rand(40, K, generator=g) < 0.1] = -torch.inf
    value[0], value[1], value[2] = 1.0, torch.nan, -torch.inf
    ranks = reward.rank_of_k(value.flatten(), K)
    assert ranks.tolist() == [slow_ranks(row) for row in value.tolist()]
    best = reward.best_of_k(value.flatten(), K)
    assert torch.equal(ranks.gather(1, best[:, None]), torch.zeros(40, 1, dtype=torch.long))
    assert reward.best_of_k(value.flatten(), 1).eq(0).all() and reward.rank_of_k(value[:0].flatten(), K).shape == (0, K)
    with pytest.raises(ValueError, match="k is 7"):
        reward.rank_of_k(value.flatten(), 7)


def test_not_evaluated_never_counts_as_a_failure(scores):
    blank = replace(
        scores,
        evaluated=torch.zeros_like(scores.evaluated),
        margin=torch.full_like(scores.margin, torch.nan),
        outcome=torch.zeros_like(scores.outcome),
    )
    assert (reward.margin_vector(blank) == 0.05).all()


def test_all_of_it_takes_scores_by_trial(scores):
    rows = scores[: len(scores) // K * K]
    by_trial = rows.by_trial(K)
    for of in (reward.success, reward.labels, reward.margin_vector, reward.first_failure, reward.quality):
        flat = of(rows)
        assert torch.equal(of(by_trial).nan_to_num(nan=7.0), flat.unflatten(0, (-1, K)).nan_to_num(nan=7.0)), (
            of.__name__
        )
    soft = by_trial.soft(temperature_m=0.01)
    assert torch.equal(soft, rows.soft(temperature_m=0.01).view(-1, K)) and soft.shape == (len(rows) // K, K)
    value = reward.quality(rows)
    for of in (reward.rank_of_k, reward.best_of_k):
        assert torch.equal(of(value.view(-1, K), K), of(value, K))
        with pytest.raises(ValueError, match=f"k is {K + 1}, and value is "):
            of(value.view(-1, K), K + 1)
