"""The two bounds: random is what it says, the oracle solves what can be solved, both row by row."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
import trimesh
from problems import default_evaluator as evaluator
from scipy import stats

from r2h_batch import load_benchmark
from r2h_batch.config import Thresholds
from r2h_batch.evaluate import Evaluator
from r2h_batch.methods import oracle, random
from r2h_batch.methods.candidates import candidates_of
from r2h_batch.scene.objects import build_object, load_objects
from r2h_batch.types import Outcome, Predictions, Trials

N = 30


def same(a: Predictions, b: Predictions) -> bool:
    return all(torch.equal(getattr(a, k), getattr(b, k)) for k in ("trial_id", "T_obj_ee", "T_world_ee"))


def rotations(T: torch.Tensor) -> np.ndarray:
    R = T[:, :3, :3].double()
    assert (R @ R.mT - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-5 and torch.linalg.det(R).min() > 0.99
    return R.numpy()


def test_built_in_objects_have_100_stored_candidates_and_a_users_object_gets_its_own():
    every = candidates_of(load_objects())
    assert [len(c) for c in every] == [100] * 16
    mine = build_object(trimesh.creation.box((0.03, 0.05, 0.12)), "cup", "S0")  # called like a built-in one
    (own,) = candidates_of((mine,))
    assert len(own) > 20 and own.T_obj_ee.shape[1:] == (4, 4)
    assert not np.array_equal(own.T_obj_ee[:5], every[4].T_obj_ee[:5])
    assert np.abs(own.T_obj_ee[:, :3, 3]).max() < 0.1  # on the box, not on the cup


def test_random_draws_every_candidate_alike_and_the_tcp_uniformly_in_the_ball_and_in_orientation():
    trials, scene = load_benchmark("r2h-v1").trials(12_000, splits=["S0"]), evaluator("r2h-v1").scene
    predictions = random.predict(trials, scene)
    counts = np.zeros((6, 100), int)
    for i, c in enumerate(candidates_of(scene.objects)[:6]):
        mine = predictions.T_obj_ee[trials.object_index == i].numpy()
        index = {T.tobytes(): k for k, T in enumerate(c.T_obj_ee)}
        np.add.at(counts[i], [index[T.tobytes()] for T in mine], 1)
    assert counts.sum() == 12_000 and stats.chisquare(counts.ravel()).pvalue > 1e-3
    _, _, center = scene.palm(trials.hand_index, trials.T_world_hand)
    offset = (predictions.T_world_ee[:, :3, 3] - center).double().numpy() / 0.20
    radius = np.linalg.norm(offset, axis=1)
    assert radius.max() <= 1 + 1e-5 and stats.kstest(radius**3, "uniform").pvalue > 1e-3
    R = rotations(predictions.T_world_ee)
    for even in (*(offset / radius[:, None]).T, R[:, 0, 0], R[:, 2, 2], R[:, 1, 0]):
        assert stats.kstest(even, "uniform", (-1, 2)).pvalue > 1e-3
    assert abs(np.corrcoef(offset[:, 2], R[:, 2, 2])[0, 1]) < 0.03


@cache
def bounds() -> tuple[Trials, Predictions, Predictions]:
    trials, scene = load_benchmark("r2h-v1").trials(N), evaluator("r2h-v1").scene
    return (
        trials,
        random.predict(trials, scene),
        oracle.predict(trials, scene, evaluator=evaluator("r2h-v1"), rounds=12),
    )


def test_the_oracle_solves_nearly_all_trials_with_their_own_candidates_and_random_few():
    trials, low, high = bounds()
    found = [evaluator("r2h-v1").score(p.T_obj_ee, p.T_world_ee, trials) for p in (low, high)]
    low_rate, high_rate = (s.success.float().view(2, N).mean(1) for s in found)
    assert (high_rate >= 0.97).all(), f"unsolved: {trials.trial_id[~found[1].success].tolist()}"
    assert 0.05 < low_rate[0] < 0.40 and 0.01 < low_rate[1] < 0.25
    missed = ~found[1].success
    assert (found[1].outcome[missed] >= int(Outcome.PLAN)).all()  # what fails, fails as late as it can
    own = candidates_of(evaluator("r2h-v1").scene.objects)
    for i, T in zip(trials.object_index.tolist(), high.T_obj_ee.numpy(), strict=True):
        assert (own[i].T_obj_ee == T).all((1, 2)).any()
    rotations(high.T_world_ee)


def test_answers_depend_on_seed_and_trial_id_alone():
    trials, low, high = bounds()
    rows, scene = torch.tensor([5, 57, 34, 1]), evaluator("r2h-v1").scene
    assert same(random.predict(trials[rows], scene), low[rows])
    assert same(oracle.predict(trials[rows], scene, evaluator=evaluator("r2h-v1"), rounds=12), high[rows])
    other = random.predict(trials, scene, seed=1)
    assert not (other.T_world_ee[:, :3, 3] == low.T_world_ee[:, :3, 3]).all(1).any()
    assert low.method == "random" and torch.equal(low.trial_id, trials.trial_id)
    assert (
        len(random.predict(trials[:0], scene))
        == len(oracle.predict(trials[:0], scene, evaluator=evaluator("r2h-v1")))
        == 0
    )


def test_the_proposal_that_got_farthest_is_kept_over_the_rounds():
    """A ball of 1 mm is hardly ever met, so trials stay unsolved and differ in how far off they are."""
    benchmark = replace(load_benchmark("r2h-v1"), thresholds=Thresholds(reach_radius_m=0.001))
    hard, trials = Evaluator(benchmark), benchmark.trials(6)
    fan = oracle.Fan(trials, hard, 0)
    rounds = torch.stack([oracle.how_far(hard.score(*fan.proposals(np.arange(12), r), trials)) for r in range(3)])
    for r in (1, 3):
        answer = oracle.predict(trials, hard.scene, evaluator=hard, rounds=r)
        reached = oracle.how_far(hard.score(answer.T_obj_ee, answer.T_world_ee, trials))
        assert torch.equal(reached, rounds[:r].amax(0)) and not (rounds[:r] == 6).any(0).all()
    assert len(set(rounds.argmax(0).tolist())) > 2
