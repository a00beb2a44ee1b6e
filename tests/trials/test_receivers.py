"""Receivers with bodies (r2h-v1): what is drawn lies within what is published, and is the same on every machine."""

import numpy as np
import pytest
import torch
from hand_twins import palms

from r2h_batch.trials.protocol import make_trials, trials_digest, trials_with_ids
from r2h_batch.types import Trials

N = 1500
FROZEN = "67a519ecb7e700f6284e0ee9b02eabdb2e2f2fd4f3c28ec20ef40f8601e95fa4"
"""Of 500 trials a split: r2h-v1 never changes; docs/choices.md names it too."""


@pytest.fixture(scope="module")
def people() -> Trials:
    return make_trials(trials=N, protocol="r2h-v1")


def angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def parts(trials: Trials) -> tuple[np.ndarray, ...]:
    assert trials.receiver is not None
    r = trials.receiver.double().numpy()
    return r[:, 0, :3], r[:, 1, :3], r[:, 2, :3], r


@pytest.mark.check
def test_the_protocol_is_frozen_and_r2h_v0_is_untouched():
    assert trials_digest(make_trials(trials=500, protocol="r2h-v1")) == FROZEN
    v0 = "ae15c731e024708c9c09de56fd9102a25c0816eae951a93d4b5944d619ddda1f"
    assert trials_digest(make_trials(trials=500)) == v0 and make_trials(trials=1).receiver is None
    with pytest.raises(ValueError, match=r"r2h-v2.*allowed are r2h-v0, r2h-v1"):
        make_trials(trials=1, protocol="r2h-v2")


def test_a_person_is_the_same_alone_in_another_order_and_in_a_longer_run(people):
    assert people.receiver is not None
    rows = torch.tensor([4, 1777, 12, 2999])
    again = trials_with_ids(people.trial_id[rows], protocol="r2h-v1")
    assert again.receiver is not None and torch.equal(again.receiver, people.receiver[rows])
    assert torch.equal(again.T_world_hand, people.T_world_hand[rows]) and torch.equal(
        again.hand_index, people.hand_index[rows]
    )


def test_palms_lie_in_the_set_of_r2h_v0_and_arms_keep_off_body_and_table(people):
    c, n = palms(people)
    _, elbow, wrist, r = parts(people)
    far = np.hypot(c[:, 0], c[:, 1])
    assert far.min() > 0.45 - 1e-5 and far.max() < 0.80 + 1e-5 and c[:, 2].min() > 0.1 - 1e-5 and c[:, 2].max() < 0.6001
    to_robot = angle(n, -c * [1, 1, 0])
    assert (np.minimum(to_robot, angle(n, np.tile([0.0, 0, 1], (len(n), 1)))) < 75.01).all() and to_robot.max() < 120.01
    t = np.linspace(0, 1, 33)[None, :, None]
    points = elbow[:, None] + t * (wrist - elbow)[:, None]
    low, high = np.array([-0.5, -0.6, -0.05]), np.array([0.45, 0.6, 0.0])
    gap = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=2).min(1)
    assert (gap > r[:, 1, 3] - 0.003).all()
    d = points - r[:, None, 3, :3]
    ahead = d[..., 0] * r[:, None, 3, 3] + d[..., 1] * r[:, None, 4, 3]
    aside = d[..., 1] * r[:, None, 3, 3] - d[..., 0] * r[:, None, 4, 3]
    depth = (r[:, None, 4, :3] - np.abs(np.stack([ahead, aside, d[..., 2]], 2))).min(2)
    assert depth.max() < 0.01  # between the points that were asked
    assert (r[:, 3, 0] - r[:, 4, 0] > 0.45 + 0.049).all()  # chests stand beyond the table's edge
    faces = angle(np.c_[r[:, 3, 3], r[:, 4, 3], np.zeros(len(r))], -r[:, 3, :3] * [1, 1, 0])
    assert faces.max() <= 20.01
