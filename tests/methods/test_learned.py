"""Method `learned` with its shipped weights: what they learned from, that rows stand for themselves, that it hands over."""

from importlib import resources

import pytest
import torch
from rounds import each

from r2h_batch import Evaluator, load_benchmark
from r2h_batch.config import EvalConfig, ExecConfig
from r2h_batch.methods import learned
from r2h_batch.methods.ranker.network import MAX_BYTES
from r2h_batch.methods.ranker.observe import Seen, observe
from r2h_batch.scene.objects import POINTS

EXACT = "donot_use_mm_for_euclid_dist"


@pytest.fixture(scope="module")
def judge() -> Evaluator:
    return Evaluator(load_benchmark(), EvalConfig(execute=ExecConfig(sim="none")), threads=1)


def test_the_shipped_weights_are_small_and_learned_from_nothing_that_is_tested():
    weights = resources.files("r2h_batch.assets.ranker") / learned.WEIGHTS
    assert len(weights.read_bytes()) < MAX_BYTES // 2
    told = learned.trained_on()
    tested = {o.name for o in load_benchmark().objects} | {o.name for o in load_benchmark("r2h-v1").objects}
    assert len(told) == 80 and not tested & set(told) and all("_s1005_" in name for name in told)


def test_a_row_is_the_same_alone_in_any_order_and_with_another_batch(judge):
    trials = load_benchmark().trials(6)
    whole = learned.predict(trials, judge.scene)
    order = torch.tensor([7, 0, 11, 3])
    some = learned.predict(trials[order], judge.scene)
    assert torch.equal(some.T_obj_ee, whole.T_obj_ee[order]) and torch.equal(some.T_world_ee, whole.T_world_ee[order])
    alone = learned.predict(trials[7:8], judge.scene)
    assert torch.equal(alone.T_world_ee[0], whole.T_world_ee[7])
    other = learned.predict(trials, judge.scene, seed=1)
    assert not torch.equal(other.T_world_ee, whole.T_world_ee)


def test_a_small_cloud_says_of_its_points_what_the_whole_one_says(judge):
    trials = load_benchmark().trials(3)
    few, _ = observe(trials, judge.scene, Seen(cloud=64, contacts=True))
    every, _ = observe(trials, judge.scene, Seen(cloud=POINTS, contacts=True, spread=False))
    for n in each(range(len(trials))):
        away, at = torch.cdist(few["cloud"][n], every["cloud"][n], compute_mode=EXACT).min(1)
        assert away.max() == 0 and len({*at.tolist()}) == 64
        for name in ("normals", "part", "region", "contact"):
            assert torch.equal(few[name][n], every[name][n][at]), name


def test_it_hands_over_and_the_region_is_what_it_goes_by(judge):
    trials = load_benchmark().trials(48)
    seen = judge.score(*poses(learned.predict(trials, judge.scene)), trials)
    blind = judge.score(*poses(learned.predict(trials, judge.scene, region="hidden")), trials)
    functional = trials.trial_id % 2 == 1
    assert seen.success[~functional].float().mean() > 0.85 and seen.success[functional].float().mean() > 0.8
    assert blind.success[functional].float().mean() < seen.success[functional].float().mean() - 0.1


def poses(found) -> tuple[torch.Tensor, torch.Tensor]:
    return found.T_obj_ee, found.T_world_ee


def test_a_second_round_and_wrong_options(judge):
    trials = load_benchmark().trials(3)
    once, twice = (learned.predict(trials, judge.scene, second=n) for n in (0, 32))
    assert not torch.equal(once.T_world_ee, twice.T_world_ee)
    for options, said in each(
        [({"region": "told"}, "region is 'told'"), ({"weights": "none.safetensors"}, "none.safetensors")]
    ):
        with pytest.raises(ValueError, match=said):
            learned.predict(trials, judge.scene, **options)
