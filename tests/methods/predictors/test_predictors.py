"""Inputs of methods: exact without noise, as far off as stated with it, and the same for a trial in any batch."""

import numpy as np
import pytest
import torch
from rounds import each

from r2h_batch import load_benchmark
from r2h_batch.base.errors import UsageError
from r2h_batch.methods.predictors import (
    PredictorNoise,
    predict_parts,
    predict_receiving,
    predict_target,
    retrieve_receiving,
)
from r2h_batch.scene.hand import palm_frame
from r2h_batch.trials.holding.instructions import intents_of
from r2h_batch.trials.holding.receiving import load_receiving

EXACT = PredictorNoise().scaled(0)


@pytest.fixture(scope="module")
def trials(scene):
    return load_benchmark("r2h-v1").with_objects(scene.objects).trials(200)


def test_a_receiving_hand_without_noise_is_a_frozen_grasp_of_object_and_side(scene, trials) -> None:
    grasps, few = load_receiving(scene.objects), slice(0, 20)
    seen = predict_receiving(trials, scene, noise=EXACT)
    assert torch.equal(seen.T_obj_hand, grasps.T_obj_hand[seen.grasp])
    assert torch.equal(grasps.object_index[seen.grasp], trials.object_index)
    assert torch.equal(seen.side, scene.hands.set.side.to(torch.int8)[trials.hand_index.long()])
    assert torch.equal(grasps.side[seen.grasp], seen.side)
    for name in ("joints", "vertices"):
        assert torch.equal(getattr(seen, name)[few], getattr(grasps, name)[seen.grasp[few]])
    assert len(seen.grasp.unique()) > 0.25 * len(grasps)


def test_the_receiving_hands_error_is_as_stated_and_scales(scene, trials) -> None:
    true = predict_receiving(trials, scene, noise=EXACT)
    for factor in (1.0, 0.5):
        noise = PredictorNoise().scaled(factor)
        seen = predict_receiving(trials, scene, noise=noise)
        assert torch.equal(seen.grasp, true.grasp)
        shift = seen.palm_point - true.palm_point
        assert torch.allclose(shift.square().mean().sqrt(), torch.tensor(noise.receiving_translation_m), rtol=0.05)
        R = (seen.T[:, :3, :3].mT @ true.T[:, :3, :3]).double()
        angle = torch.rad2deg(torch.arccos(((R.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
        expected = noise.receiving_rotation_deg * 3**0.5
        assert torch.allclose(angle.square().mean().sqrt(), torch.tensor(expected).double(), rtol=0.05)


def test_the_target_hand_is_the_trials_own_without_noise_and_as_far_off_as_stated_with_it(scene, trials) -> None:
    point, normal, center = scene.palm(trials.hand_index, trials.T_world_hand)
    true = predict_target(trials, scene, noise=EXACT)
    assert torch.equal(true.T_world_hand, trials.T_world_hand)
    assert (true.palm_point - point).abs().max() < 1e-6 and (true.palm_normal - normal).abs().max() < 2e-6
    assert (true.ball_center - center).abs().max() < 1e-6
    seen, noise = predict_target(trials, scene), PredictorNoise()
    shift = seen.palm_point - true.palm_point
    assert torch.allclose(shift.square().mean().sqrt(), torch.tensor(noise.target_translation_m), rtol=0.05)
    tip = seen.vertices[:5, int(scene.hands.model.tip_vertices[1])] - seen.joints[:5, 0]
    assert (torch.nn.functional.normalize(tip, dim=1) - seen.wrist_to_middle[:5]).abs().max() < 1e-5
    own_point, own_normal = palm_frame(seen.joints, seen.side)
    assert torch.equal(own_point, seen.palm_point) and torch.equal(own_normal, seen.palm_normal)


@pytest.mark.parametrize(
    ("predict", "names"),
    [
        (predict_receiving, ("T", "grasp", "joints", "vertices", "wrist_to_middle")),
        (retrieve_receiving, ("T", "grasp")),
        (predict_target, ("T", "ball_center", "vertices")),
        (predict_parts, ("label", "usage")),
    ],
)
def test_a_row_depends_on_seed_and_trial_id_only(scene, trials, predict, names) -> None:
    whole, other = predict(trials, scene, seed=3), predict(trials, scene, seed=4)
    for rows in (0, 1, 2, 33):
        order = torch.randperm(len(trials), generator=torch.Generator().manual_seed(rows))[:rows]
        part = predict(trials[order], scene, seed=3)
        for name in each(names):
            value = getattr(whole, name)
            assert torch.equal(value[order], getattr(part, name)), (name, rows)
            assert not torch.equal(value, getattr(other, name))


def test_retrieval_answers_the_instruction(scene, trials) -> None:
    grasps, few = load_receiving(scene.objects), trials[torch.arange(0, len(trials), 7)]
    for default in (None, [scene.objects[i].instruction for i in few.object_index.tolist()]):
        assert torch.equal(grasps.object_index[retrieve_receiving(few, scene, default).grasp], few.object_index)
    bowls = few[few.object_index == 1]
    for text, part in (("give me the bowl by the rim", "rim"), ("the bowl, I am eating", "wall")):
        seen = retrieve_receiving(bowls, scene, [text] * len(bowls))
        intent = next(i for i in intents_of(scene.objects[1]) if i.part == part)
        assert set(grasps.part[seen.grasp].tolist()) <= set(intent.labels)
    with pytest.raises(UsageError, match="is about cup, but this trial's object is bowl"):
        retrieve_receiving(bowls, scene, ["the cup please"] * len(bowls))


def test_parts_are_the_objects_labels_and_with_noise_a_border_moves_as_a_whole(scene, trials) -> None:
    few = trials[torch.arange(0, len(trials), 14)]
    seen = predict_parts(few, scene, noise=EXACT)
    for row, index in enumerate(few.object_index.tolist()):
        model = scene.objects[index]
        assert np.array_equal(seen.label[row].numpy(), model.point_part)
        assert np.array_equal(seen.usage[row].numpy(), model.receiver_face[model.point_face])
    hammer = trials[trials.object_index == 6]
    true, seen = predict_parts(hammer, scene, noise=EXACT), predict_parts(hammer, scene)
    grown, shrunk = (seen.usage & ~true.usage).sum(1) > 0, (~seen.usage & true.usage).sum(1) > 0
    assert 0.25 < float(grown.float().mean()) < 0.9 and 0.25 < float(shrunk.float().mean()) < 0.9
    assert float((grown & shrunk).float().mean()) < 0.5  # mostly one or the other, not salt and pepper
