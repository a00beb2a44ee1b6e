"""Errors of single frames: as published, mirrored for left hands, the same for a trial in any batch; and who sees them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from r2h_batch import load_benchmark
from r2h_batch.methods.predictors import PredictorNoise, predict_target
from r2h_batch.scene.arrays import stored_arrays

FRAMES = PredictorNoise(target_errors="frames")


@pytest.fixture(scope="module")
def trials(scene):
    return load_benchmark("r2h-v1").with_objects(scene.objects).trials(1500)


def errors_of(scene, trials, noise):
    """Turns (n, 3) and palm shifts (n, 3) of what is seen, in each hand's own directions, float64, from the poses alone."""
    seen, hands = predict_target(trials, scene, noise=noise), scene.hands
    row = trials.hand_index.long()
    B = hands.directions[row].numpy()
    E = np.linalg.inv(trials.T_world_hand.double().numpy()) @ seen.T_world_hand.double().numpy()
    palm = hands.palm_point[row].double().numpy()
    turn = Rotation.from_matrix(B.transpose(0, 2, 1) @ E[:, :3, :3] @ B).as_rotvec()
    moved = np.einsum("nij,nj->ni", E[:, :3, :3], palm) + E[:, :3, 3] - palm
    return turn, np.einsum("nji,nj->ni", B, moved)


def test_what_is_drawn_is_one_of_the_stored_frames_in_the_hands_own_directions(scene, trials):
    turn, shift = errors_of(scene, trials, FRAMES)
    stored = stored_arrays("receiving", "hand_errors.npz")
    known = np.concatenate([stored["turn_rad"], 10 * stored["shift_m"]], 1).astype(np.float64)
    found = np.concatenate([turn, 10 * shift], 1)
    small = np.linalg.norm(turn, axis=1) < 3.0  # at half a turn the axis' sign is rounding
    gap = np.array([np.abs(known - f).max(1).min() for f in found[small]])
    assert small.sum() > 2900 and gap.max() < 2e-5
    assert len(np.unique(np.round(found, 4), axis=0)) > 1900  # drawn from all of them


def test_left_and_right_hands_have_the_same_errors_in_their_own_directions(scene, trials):
    """The same draw for both sides, by taking the same trials on a hand of the other side."""
    side, B, one = scene.hands.set.side, scene.hands.directions, trials[:40]
    right, left = (int(torch.nonzero(side == s)[0]) for s in (0, 1))
    on = [replace(one, hand_index=torch.full_like(one.hand_index, k)) for k in (right, left)]
    both = [errors_of(scene, trials, FRAMES) for trials in on]
    assert np.abs(both[0][0] - both[1][0]).max() < 1e-4 and np.abs(both[0][1] - both[1][1]).max() < 1e-6
    assert (torch.linalg.det(B[side == 0]) > 0.999).all() and (torch.linalg.det(B[side == 1]) < -0.999).all()


@pytest.mark.parametrize("errors", ["frames", "tails"])
def test_a_trial_has_its_error_in_any_batch_and_none_at_factor_0(scene, trials, errors):
    noise = PredictorNoise(target_errors=errors)
    every = predict_target(trials[:50], scene, noise=noise).T_world_hand
    assert torch.equal(predict_target(trials[17:18], scene, noise=noise).T_world_hand, every[17:18])
    exact = predict_target(trials[:50], scene, noise=noise.scaled(0)).T_world_hand
    assert torch.equal(exact, trials[:50].T_world_hand)
