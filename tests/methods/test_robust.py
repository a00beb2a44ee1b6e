"""The robust search (r2h_batch.methods.robust)."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from problems import default_evaluator
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.config import OBJECT_ERRORS, ObjectErrors
from r2h_batch.judge.object_errors import taken_grasps
from r2h_batch.methods import oracle, robust
from r2h_batch.methods.robust import Sizes, holding
from r2h_batch.trials.noise import PredictorNoise, estimated_hand

EXACT = PredictorNoise().scaled(0.0)
RGB = Sizes(ObjectErrors(*OBJECT_ERRORS["rgb"]), PredictorNoise())
FAR_HAND = Sizes(ObjectErrors(), PredictorNoise().scaled(6.0))
ROUNDS, DRAWS = 12, 6


@cache
def trials():
    return load_benchmark("r2h-v2").trials(6)


@cache
def answers(draws=DRAWS, sizes=RGB):
    evaluator = default_evaluator("r2h-v2")
    return robust.predict(trials(), evaluator.scene, evaluator=evaluator, sizes=sizes, draws=draws, rounds=ROUNDS)


def share(found, seed):
    """Mean share of eight errors of a seed under which pairs succeed."""
    judge = default_evaluator("r2h-v2").kinematic
    return holding(judge, trials(), found.T_obj_ee, found.T_world_ee, RGB, 8, seed).double().mean() / 8


def test_without_errors_it_is_the_search_of_the_oracle():
    evaluator = default_evaluator("r2h-v2")
    told = oracle.predict(trials(), evaluator.scene, evaluator=evaluator, rounds=ROUNDS)
    for draws in each((0, 2)):
        found = answers(draws, Sizes(ObjectErrors(), EXACT))
        assert torch.equal(found.T_obj_ee, told.T_obj_ee) and torch.equal(found.T_world_ee, told.T_world_ee)


def test_what_it_takes_holds_under_errors_that_it_has_not_drawn_better_than_what_a_plain_search_takes():
    plain = answers(0)
    assert share(answers(), seed=77) > share(plain, seed=77) + 0.1


def test_errors_are_those_of_the_object_and_of_the_hand_one_verdict_each():
    judge, some = default_evaluator("r2h-v2").kinematic, trials()
    found = answers()
    exact = 3 * judge.score(found.T_obj_ee, found.T_world_ee, some).success
    from r2h_batch.base import rng

    for sizes in each((RGB, FAR_HAND)):
        count = torch.zeros(len(some), dtype=torch.int64)
        for k in range(3):
            own = int(rng.key_of(f"robust 5 {k}")[0])
            grasp = taken_grasps(replace(sizes.object, seed=own), judge.scene.objects, found.T_obj_ee, some)
            hand = estimated_hand(
                judge.scene, some.trial_id, some.hand_index, some.T_world_hand, seed=own, noise=sizes.hand
            )
            assert torch.equal(grasp, found.T_obj_ee) == (sizes is FAR_HAND)
            assert not torch.equal(hand, some.T_world_hand)
            count += judge.score(grasp, found.T_world_ee, replace(some, T_world_hand=hand)).success
        assert torch.equal(holding(judge, some, found.T_obj_ee, found.T_world_ee, sizes, 3, 5), count)
        assert not torch.equal(count, exact)
    assert torch.equal(
        holding(judge, some, found.T_obj_ee, found.T_world_ee, Sizes(ObjectErrors(), EXACT), 3, 5),
        exact,
    )


def test_a_pair_that_can_no_longer_win_is_not_judged_to_the_end_and_no_answer_changes(monkeypatch):
    every, judged = answers(), []
    evaluator, real = default_evaluator("r2h-v2"), type(default_evaluator("r2h-v2")).score
    monkeypatch.setattr(type(evaluator), "score", lambda self, *a, **k: judged.append(len(a[0])) or real(self, *a, **k))

    def searched():
        judged.clear()
        found = robust.predict(trials(), evaluator.scene, evaluator=evaluator, sizes=RGB, draws=DRAWS, rounds=ROUNDS)
        assert torch.equal(found.T_obj_ee, every.T_obj_ee) and torch.equal(found.T_world_ee, every.T_world_ee)
        return sum(judged)

    rows = searched()
    monkeypatch.setattr(robust, "holding", lambda *a, beyond: holding(*a))
    assert rows < searched()


def test_pairs_that_can_exceed_their_rivals_are_counted_to_the_end_and_others_are_given_up(monkeypatch):
    judge, some, found = default_evaluator("r2h-v2").kinematic, trials(), answers(0)
    pairs = judge, some, found.T_obj_ee, found.T_world_ee, RGB, 8, 5
    count = holding(*pairs)
    assert len(count.unique()) > 4 and count.max() == 8
    for rival in each((-torch.inf, -1.0, 0.0, 3.0, 5.0, 7.0, 8.0)):
        beyond = torch.full((len(some),), rival, dtype=torch.float64)
        held = holding(*pairs, beyond=beyond)
        assert torch.equal(held[count > rival], count[count > rival])
        assert (held <= count).all() and (held[count <= rival] <= max(rival, 0)).all()
    mixed = torch.tensor([-torch.inf, 8.0, 0.0, 3.0], dtype=torch.float64).repeat(len(some) // 4)
    held, asked = holding(*pairs, beyond=mixed), []
    wins = count > mixed
    assert torch.equal(held[wins], count[wins]) and not held[mixed == 8.0].any()
    real = type(judge).score
    monkeypatch.setattr(type(judge), "score", lambda self, *a, **k: asked.append(len(a[0])) or real(self, *a, **k))
    holding(*pairs, beyond=torch.full_like(mixed, -torch.inf))
    holding(*pairs, beyond=torch.full_like(mixed, 8.0))
    assert asked == [8 * len(some)]  # without rivals one call; of hopeless pairs none


def test_answers_have_the_same_bits_alone_and_in_any_order():
    evaluator, every = default_evaluator("r2h-v2"), answers()
    for rows in each((torch.tensor([4]), torch.tensor([3, 0]))):
        found = robust.predict(
            trials()[rows], evaluator.scene, evaluator=evaluator, sizes=RGB, draws=DRAWS, rounds=ROUNDS
        )
        assert torch.equal(found.T_obj_ee, every.T_obj_ee[rows])
        assert torch.equal(found.T_world_ee, every.T_world_ee[rows])


def test_a_wrong_number_of_errors_is_refused():
    evaluator = default_evaluator("r2h-v2")
    with pytest.raises((ValueError, TypeError), match="draws is -1"):
        robust.predict(trials(), evaluator.scene, evaluator=evaluator, draws=-1)
