"""Estimates that a method that sees is told (r2h_batch.observe.estimates)."""

import numpy as np
import pytest
import torch
from rays_twin import RIG, cell
from rounds import each

from r2h_batch.config import OBJECT_ERRORS, ObjectErrors
from r2h_batch.methods.predictors import predict_target
from r2h_batch.observe.estimates import believed_objects, believed_receiver, image_keys
from r2h_batch.observe.seeing import look
from r2h_batch.scene.tables import MIDDLE_ROOT


def angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))


def test_hands_are_estimated_as_methods_that_are_told_see_them():
    scene, trials, _ = cell(count=60)
    exact, believed = (believed_receiver(scene, trials, seed=0, noise=k) for k in (0.0, 1.0))
    palm, normal, _ = scene.palm(trials.hand_index, trials.T_world_hand)
    assert torch.equal(exact.palm, palm) and torch.equal(exact.normal, normal)
    joints = scene.hands.joints.double()[trials.hand_index.long()]
    T = trials.T_world_hand.double()
    along = torch.einsum("nij,nj->ni", T[:, :3, :3], joints[:, MIDDLE_ROOT] - joints[:, 0])
    along = along - (along * normal).sum(1, keepdim=True) * normal
    along = along / along.norm(dim=1, keepdim=True)
    assert (angles(along.numpy(), exact.along.double().numpy()) < 0.1).all()
    assert exact.left.sum() == (scene.hands.set.side[trials.hand_index.long()] == 1).sum() > 0
    off = (believed.palm - palm).norm(dim=1).numpy()
    # three normal numbers of 12 mm: a mean length of 19 mm
    assert off.mean() == pytest.approx(0.012 * np.sqrt(8 / np.pi), rel=0.15)
    assert 5 < angles(believed.normal.numpy(), normal.numpy()).mean() < 11
    told = predict_target(trials, scene, seed=0)
    assert (believed.palm - told.palm_point).abs().max() < 1e-6
    assert (believed.normal - told.palm_normal).abs().max() < 1e-6


def test_known_objects_lie_where_the_level_of_error_puts_them():
    scene, trials, T = cell(count=60)
    exact = believed_objects(scene, trials, T, ObjectErrors())
    assert torch.equal(exact.T_world_obj, T)
    for i in each(range(0, len(trials), 17)):
        model = scene.objects[int(trials.object_index[i])]
        assert np.array_equal(exact.vertices[int(exact.mesh[i])], model.vertices)
        assert np.array_equal(exact.faces[int(exact.mesh[i])], model.faces)
    for level in each(("lab", "field", "rgb")):
        shift, turn = OBJECT_ERRORS[level]
        seen = believed_objects(scene, trials, T, ObjectErrors(shift, turn)).T_world_obj.double().numpy()
        E = np.linalg.inv(T.double().numpy()) @ seen
        turned = np.degrees(np.arccos(np.clip((np.trace(E[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))
        assert np.sqrt((turned**2).mean() / 3) == pytest.approx(turn, rel=0.15)


def test_keys_are_of_the_images_and_differ_from_trial_to_trial():
    scene, trials, T = cell()
    seen = look(scene, trials, RIG, T)
    assert torch.equal(image_keys(seen.object, seen.hand), seen.key)
    assert len(torch.unique(seen.key)) == len(trials) and bool((seen.key >= 0).all())
    part = look(scene, trials[torch.tensor([2])], RIG, T[2:3])
    assert int(part.key[0]) == int(seen.key[2])
    assert not torch.equal(look(scene, trials, RIG, T, seed=1).key, seen.key)
